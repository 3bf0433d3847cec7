"""Goals as in Gymnasium-Robotics, for hindsight experience replay: the field to be reached, and the reward for it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl import guidance
from magrl.checks import check_number, check_tensor
from magrl.transforms.base import Keys, StatefulTransform, StepReward
from magrl.transforms.views import ObservationView


class GoalObservation(StatefulTransform):
    """Write what a vehicle observes beside its goal, what it has achieved, and its goal.

    A goal is D, I, B_H, scaled to the region, and the decimal logarithms of the weights of the objective F (Eq. 2-6) in
    these units, so that :func:`goal_reward` is the paper's rule of arrival. The weights, of the first reading of an
    episode, are the same in both goals.

    Args:
        view: scaling of fields and moves.
        zeta: arrival threshold on F.
        floors: least differences of D [deg], I [deg], B_H [nT] in F.
        **keys: ``in_keys``: reading and target ``(..., 3)``, last move ``(..., 2)`` [km, rad] and heading ``(..., 1)``
            [rad]; ``out_keys``: observation ``(..., 4)``, last move and cosine and sine of the heading, achieved goal
            and desired goal ``(..., 6)``.

    Raises:
        ValueError: for a threshold or floors that are not above 0.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from torchrl.envs import TransformedEnv
        >>> base = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> goals = GoalObservation(base.observation_view(), base.zeta, base.objective_floors[0].tolist())
        >>> TransformedEnv(base, goals).reset()["desired_goal"].shape
        torch.Size([2, 6])
    """

    default_in_keys = ("field", "target_field", "move", "heading")
    default_out_keys = ("observation", "achieved_goal", "desired_goal")
    out_sizes = {"observation": (4,), "achieved_goal": (6,), "desired_goal": (6,)}

    def __init__(self, view: ObservationView, zeta: float, floors: Sequence[float], **keys: Any) -> None:
        super().__init__(**keys)
        check_number(0, above=True, zeta=zeta, floors=min(floors))
        low, high = torch.tensor((view.field_low, view.field_high))
        self.register_buffer("_center", (high + low) / 2, persistent=False)
        self.register_buffer("_half", (high - low) / 2, persistent=False)
        self.register_buffer("_floors", torch.tensor(floors), persistent=False)
        self.zeta, self.longest = zeta, (view.max_move_km, view.max_turn_rad)

    @property
    def state_keys(self) -> Keys:
        """Keys that a step reads from the TensorDict before it: the desired goal."""
        return self.out_keys[2:]

    def _begin(self, tensordict: TensorDictBase, values: list[Tensor], mask: Tensor | None) -> None:  # noqa: ARG002
        reading, target, *_ = values
        weights = guidance.objective_weights(reading, target, self._floors.to(reading)) / self.zeta
        factors = (weights.sqrt() * self._half).log10()
        self._advance(tensordict, values, [torch.cat(((target - self._center) / self._half, factors), -1)])

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:
        (reading, _, move, heading), (desired,) = values, state
        achieved = torch.cat(((reading - self._center) / self._half, desired[..., 3:]), -1)
        observed = torch.cat((move / move.new_tensor(self.longest), torch.cos(heading), torch.sin(heading)), -1)
        for key, value in zip(self.out_keys, (observed, achieved, desired), strict=True):
            tensordict.set(key, value)


def goal_reward(achieved_goal: Tensor, desired_goal: Tensor) -> Tensor:
    """Return 1 where the achieved goal is an arrival at the desired one, 0 elsewhere: ``(...)``.

    A negative reward of each step, as in Gymnasium-Robotics, would reward leaving the region, which ends an episode.

    Args:
        achieved_goal: ``(..., 6)`` of :class:`GoalObservation`.
        desired_goal: ``(..., 6)``.

    Example:
        >>> here, there = torch.tensor([[0.0, 0.0, 0.0, 1.0, 1.0, 1.0], [0.2, 0.0, 0.0, 1.0, 1.0, 1.0]])
        >>> goal_reward(here, there), goal_reward(there, there)
        (tensor(0.), tensor(1.))
    """
    check_tensor(6, achieved_goal=achieved_goal, desired_goal=desired_goal)
    difference = (desired_goal - achieved_goal)[..., :3] * 10 ** desired_goal[..., 3:]
    return (difference.square().sum(-1) < 1).to(desired_goal.dtype)


class GoalReward(StepReward):
    """Write the reward of :func:`goal_reward`, in place of that of the environment.

    Args:
        in_keys: achieved and desired goal ``(..., 6)``.
        out_keys: one reward ``(..., 1)``.

    Raises:
        ValueError: for another number of keys.

    Example:
        >>> from tensordict import TensorDict
        >>> step = TensorDict(next=TensorDict(achieved_goal=torch.ones(6), desired_goal=torch.ones(6)))
        >>> GoalReward()(step)["next", "reward"]
        tensor([1.])
    """

    default_in_keys = ("achieved_goal", "desired_goal")
    state_keys = ()

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:  # noqa: ARG002
        tensordict.set(self.out_keys[0], goal_reward(*values).unsqueeze(-1))
