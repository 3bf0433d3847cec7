"""Rewards for short paths, and the true way to the destination, which is privileged: for critics and rewards only."""

from __future__ import annotations

from inspect import signature

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite

from magrl.checks import check_number, check_tensor
from magrl.geodesy import geodesic
from magrl.transforms.base import GivenKeys, ObservationTransform, StepReward


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

    default_in_keys = ("position", "target_position", "heading")
    default_out_keys = ("true_way",)

    def _compute(self, values: list[Tensor]) -> list[Tensor]:
        position, target, heading = values
        distance_km, bearing = geodesic(*position.unbind(-1), *target.unbind(-1))
        angle = bearing - heading.squeeze(-1)
        way = distance_km.unsqueeze(-1) * torch.stack((torch.cos(angle), torch.sin(angle)), -1)
        return [way.to(heading.dtype)]

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the way, unbounded."""
        self._add(observation_spec, self._leaf(observation_spec, self.in_keys[2]), self.out_keys[0], 2)
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


class DetourReward(StepReward):
    """Write a reward for arriving on a short path, see :func:`detour_reward`.

    In place of the reward of the environment. It reads the true way before and after the move, so it is privileged.

    Args:
        in_keys: true way ``(..., 2)`` [km], last move ``(..., K)`` with the distance [km] first, start position and
            target position ``(..., 2)`` [deg], and the flags ``(..., 1)`` success and terminated.
        out_keys: one reward ``(..., 1)``.
        **weights: those of :func:`detour_reward`.

    Raises:
        ValueError: for a negative weight, or another number of keys.
        TypeError: for an unknown weight.

    Example:
        >>> from magrl.envs.geomagnetic import GeomagneticNavEnv
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> env = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), Compose(TrueWay(), DetourReward()))
        >>> env.rollout(3)["next", "reward"].shape
        torch.Size([2, 3, 1])
    """

    default_in_keys = ("true_way", "move", "start_position", "target_position", "success", "terminated")

    def __init__(self, in_keys: GivenKeys = None, out_keys: GivenKeys = None, **weights: float) -> None:
        super().__init__(in_keys, out_keys)
        signature(detour_reward).bind_partial(**weights)  # an unknown weight is an error before the first step
        check_number(0, **weights)  # type: ignore[arg-type]
        self.weights = weights

    @property
    def state_keys(self) -> list[NestedKey]:
        """Keys that a step reads from the TensorDict before it: the true way."""
        return self.in_keys[:1]

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:
        after, move, start, target, success, terminated = values
        task_km, _ = geodesic(*start.unbind(-1), *target.unbind(-1))
        reward = detour_reward(
            move[..., :1],
            state[0].norm(dim=-1, keepdim=True) - after.norm(dim=-1, keepdim=True),
            task_km.unsqueeze(-1).to(move.dtype),
            success,
            terminated & ~success,
            **self.weights,
        )
        tensordict.set(self.out_keys[0], reward)


class DistanceCost(StepReward):
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

    default_in_keys = ("move",)
    state_keys = ()

    def __init__(self, cost: float, in_keys: GivenKeys = None, out_keys: GivenKeys = None) -> None:
        super().__init__(in_keys, out_keys)
        check_number(0, cost=cost)
        self.cost = float(cost)

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:  # noqa: ARG002
        key, cost = self.out_keys[0], self.cost * values[0][..., :1]
        tensordict.set(key, tensordict[key] - cost)
