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


def poisoned(function):
    """Return a loss that is not finite from its fifth call on."""
    calls = []

    def method(self, data):
        value, *rest = function(self, data)
        calls.append(1)
        return value * (math.nan if len(calls) >= BAD_STEP else 1), *rest

    return method


def test_training_stops_at_the_first_non_finite_value(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recipe.TD3Loss, "value_loss", poisoned(recipe.TD3Loss.value_loss))
    with pytest.raises(FloatingPointError, match=r"after update 5: loss_critic is not finite in rows \[0\]"):
        recipe.train(small(recipe, tmp_path / "run", **SMALL))
    (file,) = sorted((tmp_path / "run" / "checkpoints").glob("*.safetensors"))[-1:]
    weights = read_checkpoint(file)["parts"]["loss"]
    assert all(torch.isfinite(value).all() for value in weights.values() if isinstance(value, torch.Tensor))
