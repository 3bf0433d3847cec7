"""Collection in several processes and on Ray, through TorchRL's collectors."""

import importlib.util
import json
import signal
import sys
from functools import partial
from pathlib import Path

import pytest
import td3_gradient_guided as recipe
import torch

from magrl.agents import make_actor
from magrl.envs import GeomagneticNavEnv
from magrl.training import parse_config
from magrl.training.collectors import make_collector, worker_seed

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
def test_weights_reach_the_workers(backend: str) -> None:
    """Weights that change here act there, and every vehicle is collected once."""
    base = GeomagneticNavEnv(num_envs=8, seed=0)
    view = base.observation_view()
    actor = make_actor(view.size, SMALL.num_cells)
    collector = make_collector(
        recipe.make_env(base, view, SMALL),
        actor,
        workers=[partial(recipe.worker_env, SMALL, view, index) for index in range(2)],
        backend=backend,
        frames_per_batch=8,
        total_frames=800,
    )
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


@pytest.mark.parametrize("backend", BACKENDS)
def test_interrupted_training_of_several_processes_resumes(backend: str, tmp_path: Path, signalled) -> None:
    """Other processes start new episodes; everything else continues, and frames and updates add up."""
    run = tmp_path / "run"
    with signalled(4, signal.SIGTERM), pytest.raises(SystemExit):
        recipe.train(SMALL.replace(out=run, collector_backend=backend))
    recipe.train(parse_config(recipe.Config, recipe.PRESETS, recipe.RECIPE, "", ["--resume", str(run)]))
    result = json.loads((run / "eval.json").read_text())
    assert (result["frames"], result["updates"]) == (80, 9)


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
