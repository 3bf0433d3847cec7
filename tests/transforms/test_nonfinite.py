"""A non-finite value stops a training before it reaches a checkpoint, and the error names its place."""

import math
from pathlib import Path

import pytest
import td3_gradient_guided as recipe
import torch
from support.recipes import small

from magrl.training.checkpoints import read_checkpoint

SMALL = {"num_envs": 4, "num_cells": (8,), "batch_size": 8, "init_random_frames": 8, "updates_per_batch": 1}
SMALL |= {"eval_every": 100, "eval_tasks_small": 2, "eval_tasks": 2, "total_frames": 80, "checkpoint_every": 0.0}
BAD_STEP = 5  # of twenty


def poisoned(function, value: float, key: str | None = None, place: tuple[int, ...] = ()):
    """Return a method of which the result, or an entry of it, is not finite from its fifth call in training on."""
    calls = []

    def method(self, data):
        result = function(self, data)
        if getattr(self, "num_envs", 4) != 4:  # an evaluation
            return result
        calls.append(1)
        if len(calls) < BAD_STEP:
            return result
        if key is None:
            return result[0] * value, result[1]
        result[key] = result[key].clone()
        result[key][place] = value
        return result

    return method


@pytest.mark.parametrize(
    ("poison", "message"),
    [
        (("_step", math.nan, "field", (2, 1)), r"after 16 frames: next\.field is not finite in rows \[2\]"),
        (("value_loss", math.nan), r"after update 5: loss_critic is not finite in rows \[0\]"),
    ],
    ids=["field", "loss"],
)
def test_training_stops_at_the_first_non_finite_value(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, poison: tuple, message: str
) -> None:
    name, *options = poison
    owner = recipe.GeomagneticNavEnv if name == "_step" else recipe.TD3Loss
    monkeypatch.setattr(owner, name, poisoned(getattr(owner, name), *options))
    with pytest.raises(FloatingPointError, match=message):
        recipe.train(small(recipe, tmp_path / "run", **SMALL))
    (file,) = sorted((tmp_path / "run" / "checkpoints").glob("*.safetensors"))[-1:]
    weights = read_checkpoint(file)["parts"]["loss"]
    assert all(torch.isfinite(value).all() for value in weights.values() if isinstance(value, torch.Tensor))
