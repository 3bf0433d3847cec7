"""A number that is none stops a training before it reaches a checkpoint, and says where it was."""

import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from magrl.checkpoints import read_checkpoint

sys.path.insert(0, str(Path(__file__).parent.parent / "recipes"))
import td3_gradient_guided as recipe

SMALL = replace(
    recipe.Config(),
    num_envs=4,
    num_cells=(8,),
    batch_size=8,
    buffer_size=200,
    init_random_frames=8,
    updates_per_batch=1,
    eval_every=100,
    eval_tasks_small=2,
    eval_tasks=2,
    total_frames=80,
    wandb_mode="disabled",
    checkpoint_every=0.0,
)
BAD_STEP = 5  # of twenty


def poison_field(monkeypatch: pytest.MonkeyPatch) -> None:
    """The third vehicle reads NaN from some step on."""
    step = recipe.GeomagneticNavEnv._step
    steps = []

    def poisoned(self, tensordict):
        after = step(self, tensordict)
        steps.append(self.num_envs)
        if steps.count(4) >= BAD_STEP and self.num_envs == 4:
            field = after["field"].clone()
            field[2, 1] = float("nan")
            after["field"] = field
        return after

    monkeypatch.setattr(recipe.GeomagneticNavEnv, "_step", poisoned)


def poison_reward(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second vehicle's reward is infinite from some step on."""
    step = recipe.GeomagneticNavEnv._step
    steps = []

    def poisoned(self, tensordict):
        after = step(self, tensordict)
        steps.append(self.num_envs)
        if steps.count(4) >= BAD_STEP and self.num_envs == 4:
            after["reward"] = after["reward"].clone().index_fill(0, torch.tensor([1]), float("inf"))
        return after

    monkeypatch.setattr(recipe.GeomagneticNavEnv, "_step", poisoned)


def poison_weight(monkeypatch: pytest.MonkeyPatch) -> None:
    """A weight of the actor becomes infinite in an update."""
    update = recipe.Learner.update

    def poisoned(self, *args):
        update(self, *args)
        if self.updates == BAD_STEP:
            with torch.no_grad():
                next(p for p in self.loss.actor_network_params.values(True, True) if p.requires_grad)[0] = float("inf")

    monkeypatch.setattr(recipe.Learner, "update", poisoned)


def poison_loss(monkeypatch: pytest.MonkeyPatch) -> None:
    """The critics' loss is NaN once."""
    update = recipe.Learner.update

    def poisoned(self, *args):
        update(self, *args)
        if self.updates == BAD_STEP:
            self.loss_critic = self.loss_critic * float("nan")

    monkeypatch.setattr(recipe.Learner, "update", poisoned)


@pytest.mark.parametrize(
    ("poison", "said"),
    [
        (poison_field, r"after 16 frames: next\.field is not finite in rows \[2\]"),
        (poison_reward, r"after 16 frames: next\.(episode_)?reward is not finite in rows \[1\]"),
        (poison_weight, r"after update 5: (target_)?actor_network_params.* is not finite in rows \[0"),
        (poison_loss, r"after update 5: loss_critic is not finite in rows \[0\]"),
    ],
    ids=["field", "reward", "weight", "loss"],
)
def test_training_stops_at_the_first_number_that_is_none(tmp_path: Path, monkeypatch, poison, said: str) -> None:
    poison(monkeypatch)
    with pytest.raises(FloatingPointError, match=said):
        recipe.train(replace(SMALL, out=tmp_path / "run"))
    files = sorted((tmp_path / "run" / "checkpoints").glob("*.pt"))
    assert files

    def check(state: object) -> None:
        if isinstance(state, dict):
            for value in state.values():
                check(value)
        elif isinstance(state, torch.Tensor) and state.is_floating_point():
            assert torch.isfinite(state).all()

    for file in files:
        parts = read_checkpoint(file)["parts"]
        filled = parts["buffer"]["_storage"]["_len"]
        storage = parts["buffer"].pop("_storage")["_storage"]
        check(parts)
        check({key: value[:filled] for key, value in storage.items() if isinstance(value, torch.Tensor) and value.ndim})
