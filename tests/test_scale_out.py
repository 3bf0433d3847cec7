"""Collection in several processes and on Ray, through TorchRL's collectors."""

import importlib.util
import json
import signal
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from magrl import td3
from magrl.env import GeomagneticNavEnv

sys.path.insert(0, str(Path(__file__).parent.parent / "recipes"))
import td3_gradient_guided as recipe

SMALL = replace(
    recipe.Config(),
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


@pytest.fixture(autouse=True, scope="module")
def _ray_ends_with_the_module():
    yield
    if "ray" in sys.modules:
        sys.modules["ray"].shutdown()


@pytest.mark.parametrize("backend", BACKENDS)
def test_training_in_two_processes(backend: str, tmp_path: Path) -> None:
    """Weights that change here act there, every vehicle is collected once, and the run is whole."""
    recipe.train(replace(SMALL, out=tmp_path / "run", collector_backend=backend))
    result = json.loads((tmp_path / "run" / "eval.json").read_text())
    assert (result["frames"], result["updates"]) == (80, 9)

    base = GeomagneticNavEnv(num_envs=8, seed=0)
    view = td3.policy_config(base, SMALL.num_cells, layer_norm=True)
    config = replace(SMALL, collector_backend=backend, init_random_frames=0, total_frames=800)
    actor = td3.make_actor(view)
    env = recipe.make_env(base, config, view, guided=True)
    collector = recipe.make_collector(config, env, view, actor, guided=True)
    try:
        batches = iter(collector)
        first = next(batches).reshape(-1)
        assert first.shape == (8,)
        assert len(first["start_position"].unique(dim=0)) == 8
        with torch.no_grad():
            actor[0].module[-1].bias.fill_(50.0)
        collector.update_policy_weights_()
        later = [next(batches)["action"] for _ in range(3)][-1]
        assert (first["action"].abs() < 0.99).any()
        assert (later > 0.99).all()
    finally:
        collector.shutdown()


def test_stopped_training_of_several_processes_resumes(tmp_path: Path, signalled) -> None:
    """Other processes start new episodes; everything else goes on, and the frames add up."""
    with signalled(recipe, 4, signal.SIGTERM), pytest.raises(SystemExit):
        recipe.train(replace(SMALL, out=tmp_path / "run"))
    recipe.train(recipe.parse("td3_gradient_guided.py", ["--resume", str(tmp_path / "run")]))
    result = json.loads((tmp_path / "run" / "eval.json").read_text())
    assert (result["frames"], result["updates"]) == (80, 9)


def test_vehicles_that_cannot_be_shared_out_are_refused() -> None:
    with pytest.raises(ValueError, match="8 vehicles cannot be shared out evenly to 3 collectors"):
        replace(SMALL, collectors=3)
    with pytest.raises(ValueError, match="collector_backend must be one of"):
        replace(SMALL, collector_backend="pigeon")
