"""One thread is as fast as several on small tensors, and a busy neighbour then costs nothing."""

import contextlib
import itertools
import os
from collections.abc import Callable, Iterator

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # read when torch is imported

import pytest
import torch
from hypothesis import settings

torch.set_num_threads(1)

# Every run checks the same examples, so that a failure is a change in the code. HYPOTHESIS_PROFILE=search draws others.
settings.register_profile("ci", derandomize=True, max_examples=50, deadline=None, database=None)
settings.register_profile("search", max_examples=1000, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci"))


@pytest.fixture
def signalled(monkeypatch) -> Callable:
    """A context in which a recipe's training gets a signal in an iteration, counted from 1."""

    @contextlib.contextmanager
    def context(recipe, iteration: int, number: int) -> Iterator[None]:
        anneal, calls = recipe.Learner.anneal, itertools.count(1)

        def signals(*args) -> None:
            if next(calls) == iteration:
                os.kill(os.getpid(), number)
            anneal(*args)

        with monkeypatch.context() as patch:
            patch.setattr(recipe.Learner, "anneal", signals)
            yield

    return context
