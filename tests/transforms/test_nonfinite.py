"""A non-finite value stops a training before it reaches a checkpoint, and the error names its place."""

from pathlib import Path

import pytest
import td3_gradient_guided as recipe
import torch

from magrl.training.checkpoints import read_checkpoint

SMALL = {
    "num_envs": 4,
    "num_cells": (8,),
    "batch_size": 8,
    "buffer_size": 200,
    "init_random_frames": 8,
    "updates_per_batch": 1,
    "eval_every": 100,
    "eval_tasks_small": 2,
    "eval_tasks": 2,
    "total_frames": 80,
    "wandb_mode": "disabled",
    "checkpoint_every": 0.0,
}
BAD_STEP = 5  # of twenty


def poison_step(monkeypatch: pytest.MonkeyPatch, key: str, place: tuple[int, ...], value: float) -> None:
    """Make one entry of what the training environment returns non-finite from some step on."""
    step, steps = recipe.GeomagneticNavEnv._step, []

    def poisoned(self, tensordict):
        after = step(self, tensordict)
        steps.append(self.num_envs)
        if steps.count(4) >= BAD_STEP and self.num_envs == 4:
            after[key] = after[key].clone()
            after[key][place] = value
        return after

    monkeypatch.setattr(recipe.GeomagneticNavEnv, "_step", poisoned)


def poison_field(monkeypatch: pytest.MonkeyPatch) -> None:
    """The third vehicle measures NaN."""
    poison_step(monkeypatch, "field", (2, 1), float("nan"))


def poison_reward(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second vehicle's reward is infinite."""
    poison_step(monkeypatch, "reward", (1, 0), float("inf"))


def poison_weight(monkeypatch: pytest.MonkeyPatch) -> None:
    """A weight of the actor becomes infinite in an update."""
    value_loss, calls = recipe.TD3Loss.value_loss, []

    def poisoned(self, transitions):
        calls.append(1)
        if len(calls) == BAD_STEP:
            with torch.no_grad():
                self.actor_parameters()[0][0] = float("inf")
        return value_loss(self, transitions)

    monkeypatch.setattr(recipe.TD3Loss, "value_loss", poisoned)


def poison_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    """The critics' loss is NaN once."""
    value_loss, calls = recipe.TD3Loss.value_loss, []

    def poisoned(self, transitions):
        calls.append(1)
        loss, extra = value_loss(self, transitions)
        return loss * (float("nan") if len(calls) == BAD_STEP else 1.0), extra

    monkeypatch.setattr(recipe.TD3Loss, "value_loss", poisoned)


@pytest.mark.parametrize(
    ("poison", "message"),
    [
        (poison_field, r"after 16 frames: next\.field is not finite in rows \[2\]"),
        (poison_reward, r"after 16 frames: next\.(episode_)?reward is not finite in rows \[1\]"),
        (poison_weight, r"after update 5: actor_network_params.* is not finite in rows \[0"),
        (poison_loss, r"after update 5: loss_critic is not finite in rows \[0\]"),
    ],
    ids=["field", "reward", "weight", "loss"],
)
def test_training_stops_at_the_first_non_finite_value(tmp_path: Path, monkeypatch, poison, message: str) -> None:
    poison(monkeypatch)
    with pytest.raises(FloatingPointError, match=message):
        recipe.train(recipe.Config(**SMALL, out=tmp_path / "run"))
    files = sorted((tmp_path / "run" / "checkpoints").glob("*.pt"))
    assert files

    def check(state: object) -> None:
        if isinstance(state, dict):
            for value in state.values():
                check(value)
        elif isinstance(state, (list, tuple)):
            for value in state:
                check(value)
        elif isinstance(state, torch.Tensor) and state.is_floating_point():
            assert torch.isfinite(state).all()

    for file in files:
        parts = read_checkpoint(file)["parts"]
        filled = parts["buffer"]["_storage"]["_len"]
        storage = parts["buffer"].pop("_storage")["_storage"]
        check(parts)
        check({key: value[:filled] for key, value in storage.items() if isinstance(value, torch.Tensor) and value.ndim})
