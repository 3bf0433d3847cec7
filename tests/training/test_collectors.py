"""Collectors in Ray actors: the newest weights, seeds of their own, and what happens when one ends."""

from __future__ import annotations

import copy
import os
import runpy
import signal
import sys
import tempfile
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import ppo_anywhere
import ppo_memory
import pytest
import torch
from support.recipes import small
from tensordict import TensorDictBase
from torchrl.modules import ProbabilisticActor

from magrl.training import Run, UsageError
from magrl.training.collectors import LostCollectorError, RemoteCollector

UPDATES = {"learning_rate": 0.1, "final_learning_rate": 0.1, "batch_size": 16, "num_envs": 8}


@pytest.fixture
def ray_folder(monkeypatch) -> Iterator[None]:
    """A folder for the sockets of Ray, whose paths may have 107 characters."""
    with tempfile.TemporaryDirectory(dir="/tmp", ignore_cleanup_errors=True) as folder:
        monkeypatch.setenv("RAY_TMPDIR", folder)
        yield


@pytest.fixture
def seen(monkeypatch) -> list[tuple[TensorDictBase, ProbabilisticActor]]:
    """Batches that a training gets, each with the policy at that time."""
    batches, found = Run.batches, []

    def noted(run: Run) -> Iterator[TensorDictBase]:
        for batch in batches(run):
            actor = next(part for part in run.collector._policy if isinstance(part, ProbabilisticActor))
            found.append((batch.clone(), copy.deepcopy(actor)))
            yield batch

    monkeypatch.setattr(Run, "batches", noted)
    return found


def worst_ratio(batch: TensorDictBase, actor: ProbabilisticActor) -> float:
    """Largest absolute logarithm of the ratio of the probability by a policy and by the one that collected."""
    with torch.no_grad():
        log_prob = actor.get_dist(batch).log_prob(batch["correction"])
    return (log_prob - batch["correction_log_prob"]).abs().max().item()


def check_newest_weights(seen: list[tuple[TensorDictBase, ProbabilisticActor]]) -> None:
    """Those of the update before would differ: the rate is so large. The first updates are the critic's."""
    assert [worst_ratio(*pair) for pair in seen] == pytest.approx([0.0] * len(seen), abs=1e-4)
    stale = [worst_ratio(batch, before) for (_, before), (batch, _) in pairwise(seen[1:])]
    assert min(stale) > 0.05


def train(module: ModuleType, out: Path, **options: object) -> None:
    few = {"total_frames": 8 * 2 * 4, "memory_batches": 1, "sequences": 8, "collectors": 2} | UPDATES
    module.train(small(module, out, **few | options))


@pytest.mark.slow
@pytest.mark.usefixtures("ray_folder", "without_figures")
def test_two_nodes_have_the_weights_of_the_last_update_and_give_what_one_gives(tmp_path, seen, same_outcome) -> None:
    """Twenty updates; all vehicles have trips of their own, and their corrections differ."""
    import ray
    from ray.cluster_utils import Cluster

    train(ppo_anywhere, tmp_path / "one", total_frames=320)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        cluster.add_node(num_cpus=1)  # an actor needs one
        with pytest.raises(UsageError, match="3 collectors need a processor each, the Ray cluster has 2"):
            train(ppo_anywhere, tmp_path / "three", collectors=3, num_envs=9, address=cluster.address)
        train(ppo_anywhere, tmp_path / "two", total_frames=320, address=cluster.address)
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert same_outcome(tmp_path / "one", tmp_path / "two")
    assert len(seen) == 40
    check_newest_weights(seen[20:])
    first = seen[0][0]
    assert first.shape == (8, 2)
    assert all(len(first[key][:, 0].unique(dim=0)) == 8 for key in ("target_position", "correction"))


@pytest.mark.slow
@pytest.mark.usefixtures("ray_folder", "without_figures")
def test_a_memory_is_collected_with_the_newest_weights(tmp_path: Path, seen) -> None:
    train(ppo_memory, tmp_path / "run")
    check_newest_weights(seen)


@pytest.mark.slow
@pytest.mark.usefixtures("ray_folder", "without_figures")
def test_training_that_lost_an_actor_resumes(tmp_path: Path, seen, monkeypatch, capsys, outcome) -> None:
    """From a checkpoint after the last update, with other trips than before."""
    import ray

    def killing(self: RemoteCollector) -> Iterator[TensorDictBase]:
        for number, batch in enumerate(iterate(self)):
            if number == 2:
                pid = self._actors.remote_collectors[1].__ray_call__.remote(lambda _: os.getpid())
                os.kill(ray.get(pid), signal.SIGKILL)
            yield batch

    iterate, run = RemoteCollector.__iter__, tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(RemoteCollector, "__iter__", killing)
        with pytest.raises(LostCollectorError, match=r"^a collector ended: [^.]* died[^.]*$"):
            train(ppo_anywhere, run, log_every=1)
    assert f"To resume: --resume {run}" in capsys.readouterr().err
    assert not ray.is_initialized()
    assert [path.stem for path in (run / "checkpoints").iterdir()] == ["checkpoint-000000000048"]
    ppo_anywhere.main(["--resume", str(run)])
    assert [row["frames"] for row in outcome(run)[0]] == ["16", "32", "48", "64"]
    assert not torch.equal(seen[0][0]["target_position"], seen[3][0]["target_position"])
    check_newest_weights(seen)


@pytest.mark.slow
@pytest.mark.usefixtures("ray_folder", "without_figures")
def test_signal_ends_actors_and_leaves_a_checkpoint(tmp_path: Path, signalled) -> None:
    """Ray would end the process at once after SIGTERM."""
    import ray

    with signalled(2, signal.SIGTERM), pytest.raises(SystemExit) as stop:
        train(ppo_anywhere, tmp_path / "run")
    assert stop.value.code == 143
    assert [path.stem for path in (tmp_path / "run" / "checkpoints").iterdir()] == ["checkpoint-000000000032"]
    assert not ray.is_initialized()


def test_without_ray_one_line_says_what_to_install(tmp_path: Path, monkeypatch, capsys) -> None:
    words = "--collectors 2 --num-envs 8 --num-regions 4 --batch-size 8 --eval-trips 2 --eval-trips-small 2 --out run"
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.setattr(sys, "argv", [ppo_anywhere.RECIPE, *words.split()])
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        runpy.run_path(ppo_anywhere.__file__, run_name="__main__")
    assert stop.value.code == 2
    message = "ppo_anywhere.py: this needs the package ray: pip install 'magrl[ray]'"
    assert capsys.readouterr().err.strip() == message
    assert not (tmp_path / "run").exists()
