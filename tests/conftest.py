"""Settings of all tests, and fixtures of the trainings: one thread is as fast as several on small tensors."""

import contextlib
import csv
import gc
import itertools
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import settings

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT / "recipes"), str(ROOT / "docs" / "tables")]

# Every run checks the same examples, so that a failure is a change in the code. HYPOTHESIS_PROFILE=search draws others.
settings.register_profile("ci", derandomize=True, max_examples=25, deadline=None, database=None)
settings.register_profile("search", max_examples=1000, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


def pytest_collection_finish() -> None:
    """Use one thread, and exclude the imported modules from garbage collections, which would search them each time."""
    import torch  # here, so that the process that starts the others does not wait for it

    torch.set_num_threads(1)
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def few_planets() -> Iterator[None]:
    """Fly the named tasks over 8 regions of random planets: 1024 take seconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("magrl.named_tasks.PLANET_REGIONS", 8)
        yield


@pytest.fixture
def signalled(monkeypatch) -> Callable:
    """Return a context in which a training gets a signal after it has collected batch ``iteration``, counted from 1."""
    from magrl.training.curves import TrainingStatistics

    @contextlib.contextmanager
    def context(iteration: int, number: int) -> Iterator[None]:
        add, calls = TrainingStatistics.add, itertools.count(1)

        def signals(self, batch) -> None:
            if next(calls) == iteration:
                os.kill(os.getpid(), number)
            add(self, batch)

        with monkeypatch.context() as patch:
            patch.setattr(TrainingStatistics, "add", signals)
            yield

    return context


@pytest.fixture(scope="session")
def outcome() -> Callable:
    """Return a function that reads a run folder: the curves without their timing, and the weights of the policy."""
    from torch import Tensor

    from magrl.navigators import load_policy

    def read(folder: Path) -> tuple[list[dict[str, str]], dict[str, Tensor]]:
        with (folder / "train.csv").open(encoding="utf-8") as file:
            rows = [{key: value for key, value in row.items() if key != "seconds"} for row in csv.DictReader(file)]
        policy = load_policy(folder / "policy.safetensors")
        weights = getattr(policy, "actor", policy).state_dict()
        return rows, {key: value for key, value in weights.items() if isinstance(value, Tensor)}

    return read


@pytest.fixture(scope="session")
def same_outcome(outcome: Callable) -> Callable:
    """Return a function that compares two runs: equal curves, and weights that are equal to the bit."""

    def same(one: Path, other: Path) -> bool:
        (rows, weights), (expected, expected_weights) = outcome(one), outcome(other)
        equal = all(weights[key].equal(expected_weights[key]) for key in weights | expected_weights)
        return rows == expected and equal

    return same


@pytest.fixture
def without_figures(monkeypatch) -> None:
    """Replace the figures of a training, which take half the time of a small one, by empty files."""
    from magrl.training.curves import RunLog

    monkeypatch.setattr(RunLog, "figure", lambda self, name, _: (self.folder / f"{name}.png").touch())
