"""Collection in several processes and on Ray, through TorchRL's collectors."""

import importlib.util
import json
import signal
import sys
from pathlib import Path

import pytest
import td3_gradient_guided as recipe
import torch

from magrl.training import parse_config
from magrl.training.collectors import worker_seed

SMALL = recipe.Config(
    num_envs=8,
    num_cells=(8,),
    batch_size=16,
    buffer_size=200,
    init_random_frames=16,
    updates_per_batch=1,
    eval_every=5,
    eval_tasks_small=2,
    eval_tasks=2,
    total_frames=80,
    wandb_mode="disabled",
    collectors=2,
)
BACKENDS = [
    "process",
    pytest.param("ray", marks=pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="ray is an extra")),
]

pytestmark = pytest.mark.usefixtures("without_figures")


@pytest.fixture(autouse=True, scope="module")
def _ray_ends_with_the_module():
    yield
    if "ray" in sys.modules:
        sys.modules["ray"].shutdown()


@pytest.mark.parametrize("backend", BACKENDS)
def test_interrupted_training_of_several_processes_resumes(
    backend: str, tmp_path: Path, signalled, monkeypatch
) -> None:
    """Other processes start new episodes; frames and updates add up, and weights that change here act there."""
    run, made = tmp_path / "run", {}
    with signalled(4, signal.SIGTERM), pytest.raises(SystemExit):
        recipe.train(SMALL.replace(out=run, collector_backend=backend))

    def recorded(name: str, kind: type) -> None:
        class Recorded(kind):
            def __init__(self, *args, **options) -> None:
                super().__init__(*args, **options)
                made[name] = self

        monkeypatch.setattr(recipe, kind.__name__, Recorded)

    def turn_right(*_: object, **__: object) -> None:
        with torch.no_grad():
            made["loss"].networks.actor[0].module[-1].bias.fill_(50.0)

    recorded("loss", recipe.TD3Loss)
    recorded("buffer", recipe.TensorDictReplayBuffer)
    monkeypatch.setattr(recipe, "optimize", turn_right)
    recipe.train(parse_config(recipe.Config, recipe.PRESETS, recipe.RECIPE, "", ["--resume", str(run)]))
    result = json.loads((run / "eval.json").read_text())
    assert (result["frames"], result["updates"]) == (80, 9)
    stored = made["buffer"][:]
    assert all(len(batch["observation"].unique(dim=0)) == SMALL.num_envs for batch in stored.split(SMALL.num_envs))
    assert (stored["action"][: 4 * SMALL.num_envs] < 0).any()
    assert (stored["action"][-SMALL.num_envs :] > 0.3).all()  # 1, less the noise of exploration


def test_workers_train_on_random_tasks_of_the_scenario() -> None:
    """Not on those of its file, which the agent is evaluated on."""
    config = SMALL.replace(scenario=Path(__file__).parent.parent.parent / "docs" / "examples" / "azores.toml")
    scenario = config.load_scenario()
    assert scenario.tasks is not None
    env = recipe.worker_env(config, recipe.GeomagneticNavEnv(scenario.with_tasks(None)).observation_view(), 0)
    assert len(env.reset()["position"].unique(dim=0)) == SMALL.num_envs // 2


def test_vehicles_that_cannot_be_divided_are_refused() -> None:
    with pytest.raises(ValueError, match="num_envs 8 cannot be divided evenly among 3 collectors"):
        SMALL.replace(collectors=3)
    with pytest.raises(ValueError, match="collector_backend must be 'process' or 'ray', got 'pigeon'"):
        SMALL.replace(collector_backend="pigeon")


def test_workers_fly_tasks_of_their_own() -> None:
    """And none of the tasks of the validation or the test."""
    seeds = [worker_seed(seed, index) for seed in (0, 1, 1_999_999_999) for index in range(3)]
    assert len(set(seeds)) == len(seeds)
    assert all(0 <= seed < 2_000_000_000 for seed in seeds)
