"""Rewards for short paths, and the true way to the destination, which is privileged: for critics and rewards only."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded

from magrl.checks import check_number, check_tensor
from magrl.geodesy import geodesic
from magrl.transforms.base import (
    Keys,
    ObservationTransform,
    expect_keys,
    key_list,
    observed_spec,
    several_keys,
    sorted_keys,
    with_state,
)


class TrueWay(ObservationTransform):
    """Write the true way to the destination in the vehicle's frame. Privileged: for critics and rewards only.

    Args:
        in_keys: position ``(..., 2)`` and target position ``(..., 2)``, latitude and longitude [deg], and the heading
            ``(..., 1)`` [rad].
        out_keys: one way ``(..., 2)``: forward and to the right [km], along the geodesic.

    Raises:
        ValueError: for another number of keys.

    Example:
        >>> from tensordict import TensorDict
        >>> here, there = torch.tensor([[0.0, 160.0]]), torch.tensor([[0.0, 161.0]])
        >>> td = TensorDict(position=here, target_position=there, heading=torch.zeros(1, 1))
        >>> TrueWay()(td)["true_way"].round().int()  # a degree to the east of a vehicle that heads north
        tensor([[  0, 111]], dtype=torch.int32)
    """

    def __init__(
        self,
        in_keys: Keys = ("position", "target_position", "heading"),
        out_keys: NestedKey | Keys = ("true_way",),
    ) -> None:
        super().__init__(in_keys=several_keys(in_keys), out_keys=key_list(out_keys))
        expect_keys(self, 3, 1)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(next_tensordict)
        if values is not None:
            next_tensordict.set(self.out_keys[0], self._way(*values))
        return next_tensordict

    @staticmethod
    def _way(position: Tensor, target: Tensor, heading: Tensor) -> Tensor:
        distance_km, bearing = geodesic(*position.unbind(-1), *target.unbind(-1))
        angle = bearing - heading.squeeze(-1)
        return (distance_km.unsqueeze(-1) * torch.stack((torch.cos(angle), torch.sin(angle)), -1)).to(heading.dtype)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the way, unbounded."""
        leaf = self._leaf(observation_spec, self.in_keys[2])
        observation_spec[self.out_keys[0]] = Unbounded((*leaf.shape[:-1], 2), device=leaf.device, dtype=leaf.dtype)
        return observation_spec


def detour_reward(
    moved_km: Tensor,
    progress_km: Tensor,
    task_km: Tensor,
    arrived: Tensor,
    lost: Tensor,
    *,
    arrival: float = 10.0,
    detour: float = 10.0,
    step: float = 0.08,
    lost_penalty: float = 5.0,
) -> Tensor:
    """Return the reward of a move for arriving on a short path.

    Without the cost of a step, the return of an episode that arrives is ``arrival`` minus ``detour`` times the wasted
    part of the path in units of the task.

    Args:
        moved_km: ``(...)`` length of the move [km].
        progress_km: ``(...)`` by how much the move shortened the true way [km].
        task_km: ``(...)`` distance from start to destination [km].
        arrived: ``(...)`` bool.
        lost: ``(...)`` bool.
        arrival: reward for arriving.
        detour: penalty for a detour as long as the task.
        step: penalty for each move.
        lost_penalty: penalty for leaving the region.

    Returns:
        ``(...)``.

    Example:
        >>> yes, no = torch.tensor(True), torch.tensor(False)
        >>> detour_reward(torch.tensor(50.0), torch.tensor(30.0), torch.tensor(400.0), yes, no)
        tensor(9.4200)
    """
    check_tensor(moved_km=moved_km, progress_km=progress_km, task_km=task_km)
    wasted = (moved_km - progress_km) / task_km
    return arrival * arrived - detour * wasted - step - lost_penalty * lost


class DetourReward(ObservationTransform):
    """Write a reward for arriving on a short path, see :func:`detour_reward`.

    In place of the reward of the environment. It reads the true way before and after the move, so it is privileged.

    Args:
        in_keys: true way ``(..., 2)`` [km], last move ``(..., K)`` with the distance [km] first, start position and
            target position ``(..., 2)`` [deg], and the flags ``(..., 1)`` success and terminated.
        out_keys: one reward ``(..., 1)``.
        arrival: reward for arriving.
        detour: penalty for a detour as long as the task.
        step: penalty for each move.
        lost_penalty: penalty for leaving the region.

    Raises:
        ValueError: for a negative weight, or another number of keys.

    Example:
        >>> from magrl.envs.geomagnetic import GeomagneticNavEnv
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> env = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), Compose(TrueWay(), DetourReward()))
        >>> env.rollout(3)["next", "reward"].shape
        torch.Size([2, 3, 1])
    """

    def __init__(
        self,
        in_keys: Keys = ("true_way", "move", "start_position", "target_position", "success", "terminated"),
        out_keys: NestedKey | Keys = ("reward",),
        *,
        arrival: float = 10.0,
        detour: float = 10.0,
        step: float = 0.08,
        lost_penalty: float = 5.0,
    ) -> None:
        super().__init__(in_keys=several_keys(in_keys), out_keys=key_list(out_keys))
        expect_keys(self, 6, 1)
        check_number(0, arrival=arrival, detour=detour, step=step, lost_penalty=lost_penalty)
        self.weights = {"arrival": arrival, "detour": detour, "step": step, "lost_penalty": lost_penalty}

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:  # noqa: ARG002
        return tensordict_reset  # a reset has no reward

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        values, before = self._read(next_tensordict), tensordict.get(self.in_keys[0], None)
        if before is None and not self.missing_tolerance:
            known = f"among {sorted_keys(tensordict)}"
            raise KeyError(f"DetourReward reads {self.in_keys[0]!r} before the move, which is not {known}")
        if values is None or before is None:
            return next_tensordict
        after, move, start, target, success, terminated = values
        task_km, _ = geodesic(*start.unbind(-1), *target.unbind(-1))
        reward = detour_reward(
            move[..., :1],
            before.norm(dim=-1, keepdim=True) - after.norm(dim=-1, keepdim=True),
            task_km.unsqueeze(-1).to(move.dtype),
            success,
            terminated & ~success,
            **self.weights,
        )
        return next_tensordict.set(self.out_keys[0], reward)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the reward of transitions."""
        if tensordict.get("next", None) is None:
            raise KeyError(f"DetourReward needs transitions, with 'next', got {sorted_keys(tensordict)}")
        self._step(tensordict, tensordict["next"])
        return tensordict

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
        """Make the reward unbounded; a key that the environment lacks gets the shape of a flag."""
        way = self._observed_way()
        reward_spec[self.out_keys[0]] = Unbounded((*way.shape[:-1], 1), device=way.device, dtype=way.dtype)
        return reward_spec

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """Make the true way part of the state, so that batched and parallel environments pass it to the next step."""
        return with_state(super().transform_input_spec(input_spec), {self.in_keys[0]: self._observed_way()})

    def _observed_way(self) -> TensorSpec:
        return self._leaf(observed_spec(self), self.in_keys[0])


class DistanceCost(ObservationTransform):
    """Subtract a cost of the distance of each move from a reward.

    Without it, a move that brings the vehicle no nearer costs no more than waiting.

    Args:
        cost: cost of a move [1/km].
        in_keys: one move ``(..., K)``, with the distance [km] first.
        out_keys: one reward ``(..., 1)``, from which the cost is subtracted.

    Raises:
        ValueError: for a negative cost, or another number of keys.

    Example:
        >>> from tensordict import TensorDict
        >>> step = TensorDict(next=TensorDict(move=torch.tensor([40.0, 0.1]), reward=torch.tensor([3.0])))
        >>> DistanceCost(0.05)(step)["next", "reward"]
        tensor([1.])
    """

    def __init__(
        self, cost: float, in_keys: NestedKey | Keys = ("move",), out_keys: NestedKey | Keys = ("reward",)
    ) -> None:
        super().__init__(in_keys=key_list(in_keys), out_keys=key_list(out_keys))
        expect_keys(self, 1, 1)
        check_number(0, cost=cost)
        self.cost = float(cost)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:  # noqa: ARG002
        return tensordict_reset  # a reset has no reward

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(next_tensordict)
        if values is None:
            return next_tensordict
        reward = next_tensordict[self.out_keys[0]]
        return next_tensordict.set(self.out_keys[0], reward - self.cost * values[0][..., :1])

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Subtract the cost from the reward of transitions."""
        if tensordict.get("next", None) is None:
            raise KeyError(
                f"DistanceCost needs transitions, with move and reward under 'next', got {sorted_keys(tensordict)}"
            )
        self._call(tensordict["next"])
        return tensordict

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
        """Remove the bounds of the reward."""
        leaf = reward_spec[self.out_keys[0]]
        reward_spec[self.out_keys[0]] = Unbounded(leaf.shape, device=leaf.device, dtype=leaf.dtype)
        return reward_spec
