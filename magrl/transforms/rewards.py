"""Rewards for short paths, and the true displacement to the destination, which is privileged."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite

from magrl.checks import check_number, check_numbers
from magrl.geodesy import geodesic
from magrl.random_numbers import stream_uniform
from magrl.transforms.base import Keys, ObservationTransform, StatefulTransform, StepReward, key_list
from magrl.transforms.episode import Episode, EpisodeNumbers

SPL_REWARD = 10.0
"""Reward for an SPL of 1."""


class TrueDisplacement(ObservationTransform):
    """Write the true displacement to the destination in the vehicle's frame. Privileged: for critics and rewards only.

    Args:
        in_keys: position ``(..., 2)`` and target position ``(..., 2)``, latitude and longitude [deg], and the heading
            ``(..., 1)`` [rad].
        out_keys: one displacement ``(..., 2)``: forward and to the right [km], along the geodesic.

    Raises:
        ValueError: for another number of keys.

    Example:
        >>> from tensordict import TensorDict
        >>> here, there = torch.tensor([[0.0, 160.0]]), torch.tensor([[0.0, 161.0]])
        >>> td = TensorDict(position=here, target_position=there, heading=torch.zeros(1, 1))
        >>> TrueDisplacement()(td)["true_displacement"].round().int()  # a degree to the east, heading north
        tensor([[  0, 111]], dtype=torch.int32)
    """

    default_in_keys = ("position", "target_position", "heading")
    default_out_keys = ("true_displacement",)

    def _compute(self, values: list[Tensor]) -> list[Tensor]:
        position, target, heading = values
        distance_km, bearing = geodesic(*position.unbind(-1), *target.unbind(-1))
        angle = bearing - heading.squeeze(-1)
        displacement = distance_km.unsqueeze(-1) * torch.stack((torch.cos(angle), torch.sin(angle)), -1)
        return [displacement.to(heading.dtype)]

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the displacement, unbounded."""
        self._add(observation_spec, self._leaf(observation_spec, self.in_keys[2]), self.out_keys[0], 2)
        return observation_spec


class HighestSPL(StatefulTransform):
    """Write the highest SPL (success weighted by path length) in reach, and what is earned of it. Privileged.

    The highest SPL is that of the straight path from the present position: the distance of the trip over the path so
    far plus the true displacement. After an arrival it is the SPL of the episode, after any other end 0. Earned is the
    SPL at an arrival. Before one, and at any other end, it is half of the share of the trip that is made times the
    highest SPL in reach: negative where the vehicle is farther than the trip is long, and 0 at the start.

    Args:
        in_keys: true displacement ``(..., 2)`` [km], last leg ``(..., K)`` with the distance [km] first, and the flags
            ``(..., 1)`` success and done.
        out_keys: the highest SPL ``(..., 1)`` in [0, 1], the earned one ``(..., 1)``, and the state: the path as
            commanded and the distance of the trip ``(..., 1)`` [km].

    Raises:
        ValueError: for another number of keys.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> env = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), Compose(TrueDisplacement(), HighestSPL()))
        >>> after = env.rollout(3)["next"]
        >>> bool((after["earned_spl"] < after["highest_spl"] / 2).all())
        True
    """

    default_in_keys = ("true_displacement", "leg", "success", "done")
    default_out_keys = ("highest_spl", "earned_spl", "path_km", "trip_km")
    out_sizes = dict.fromkeys(default_out_keys, (1,))

    @property
    def state_keys(self) -> list[NestedKey]:
        """Keys that a step reads from the TensorDict before it: the path and the distance of the trip."""
        return self.out_keys[2:]

    def _begin(self, tensordict: TensorDictBase, values: list[Tensor], mask: Tensor | None) -> None:  # noqa: ARG002
        trip_km = values[0].norm(dim=-1, keepdim=True).clamp_min(1e-6)  # a trip of no length has an SPL, too
        one = torch.ones_like(trip_km)
        self._write_named(tensordict, highest_spl=one, earned_spl=0 * one, path_km=0 * one, trip_km=trip_km)

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:
        (displacement, leg, success, done), (before_km, trip_km) = values, state
        path_km, left_km = before_km + leg[..., :1], displacement.norm(dim=-1, keepdim=True)
        whole_km = torch.maximum(torch.where(success, path_km, path_km + left_km), trip_km)
        highest = (trip_km / whole_km).masked_fill(done & ~success, 0.0)
        earned = torch.where(success, trip_km, (trip_km - left_km) / 2) / whole_km
        self._write_named(tensordict, highest_spl=highest, earned_spl=earned, path_km=path_km, trip_km=trip_km)


class SPLReward(StepReward):
    """Write 10 times the change of what is earned of the SPL (:class:`HighestSPL`). Privileged.

    The rewards of an episode add up to 10 times its SPL if it arrives, and to less than 5 if it fails. They are changes
    of a potential of place and path. It replaces the reward of the environment.

    Args:
        in_keys: what is earned ``(..., 1)``; and the price of a step ``(..., 1)`` [% of SPL], which may be left out.
            ``"highest_spl"`` as the first one gives rewards for efficiency alone, whose sum is less by 10.
        out_keys: one reward ``(..., 1)``.

    Raises:
        ValueError: for another number of keys.

    Source:
        A. Y. Ng, D. Harada and S. Russell, Policy invariance under reward transformations, ICML (1999).

    Example:
        >>> from tensordict import TensorDict
        >>> after = TensorDict(earned_spl=torch.tensor([0.375]))
        >>> SPLReward()(TensorDict(earned_spl=torch.tensor([0.25]), next=after))["next", "reward"]
        tensor([1.2500])
    """

    default_in_keys = ("earned_spl",)
    optional_in_keys = ("step_price",)

    @property
    def state_keys(self) -> list[NestedKey]:
        """Keys that a step reads from the TensorDict before it: what is earned."""
        return self.in_keys[:1]

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:
        change = values[0] - state[0]
        tensordict.set(self.out_keys[0], SPL_REWARD * (change - sum(values[1:]) / 100))


class RandomStepPrice(EpisodeNumbers):
    """Draw the price of a step for each episode, log-uniform, so that one policy learns the whole range.

    Args:
        price_range: lowest and highest price [% of SPL].
        **options: ``in_keys``, ``out_keys`` and ``seed`` of :class:`~magrl.transforms.episode.EpisodeNumbers`.

    Raises:
        ValueError: for other than two rising numbers above 0.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from torchrl.envs import TransformedEnv
        >>> env = TransformedEnv(GeomagneticNavEnv(num_envs=5, seed=0), RandomStepPrice((0.1, 1.0)))
        >>> price = env.reset()["step_price"]
        >>> bool(((price >= 0.1) & (price <= 1.0)).all())
        True
    """

    default_in_keys = ("heading",)
    default_out_keys = ("step_price",)
    stream_key = "step_price_stream"
    size = draws = 1

    def __init__(self, price_range: Sequence[float], **options: Any) -> None:
        super().__init__(**options)
        self.numbers_key = self.out_keys[0]
        check_numbers(2, price_range=price_range)
        low, high = map(float, price_range)
        if not 0 < low <= high:
            raise ValueError(f"price_range must be two rising numbers above 0, got {price_range!r}")
        self.price_range = low, high

    def _constants(self, stream: Tensor) -> Tensor:
        low, high = self.price_range
        return low * (high / low) ** stream_uniform(stream, 1)

    def _disturb(self, tensordict: TensorDictBase, values: list[Tensor], episode: Episode) -> Tensor:  # noqa: ARG002
        return episode.numbers


class EpisodeSum(StatefulTransform):
    """Write the sums of observations over an episode, such as of the terms of the reward.

    TorchRL's ``RewardSum`` takes rewards alone.

    Args:
        in_keys: numbers ``(..., E)``, 0 at a reset. Each sum is named after its key, with the prefix ``episode_``.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from torchrl.envs import TransformedEnv
        >>> env = TransformedEnv(GeomagneticNavEnv(seed=0), EpisodeSum(["reward_proximity"]))
        >>> after = env.rollout(3)["next"]
        >>> torch.allclose(after["episode_reward_proximity"], after["reward_proximity"].cumsum(1))
        True
    """

    def __init__(self, in_keys: Keys) -> None:
        parts = [key if isinstance(key, tuple) else (key,) for key in key_list(in_keys)]
        super().__init__(in_keys, [(*path, f"episode_{name}") for *path, name in parts])

    @property
    def state_keys(self) -> list[NestedKey]:
        """Keys that a step reads from the TensorDict before it: the sums."""
        return self.out_keys

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the sums, unbounded."""
        observation_spec = super().transform_observation_spec(observation_spec)
        for key, total in zip(self.in_keys, self.out_keys, strict=True):
            leaf = self._leaf(observation_spec, key)
            self._add(observation_spec, leaf, total, *leaf.shape[-1:])
        return observation_spec

    def _begin(self, tensordict: TensorDictBase, values: list[Tensor], mask: Tensor | None) -> None:  # noqa: ARG002
        self._advance(tensordict, values, values)

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:
        for key, value, before in zip(self.out_keys, values, state, strict=True):
            tensordict.set(key, before + value)


class DistanceCost(StepReward):
    """Subtract a cost of the distance of each leg from a reward.

    Without it, a leg that brings the vehicle no nearer costs no more than waiting.

    Args:
        cost: cost of a leg [1/km].
        in_keys: one leg ``(..., K)``, with the distance [km] first.
        out_keys: one reward ``(..., 1)``, from which the cost is subtracted.

    Raises:
        ValueError: for a negative cost, or another number of keys.

    Example:
        >>> from tensordict import TensorDict
        >>> step = TensorDict(next=TensorDict(leg=torch.tensor([40.0, 0.1]), reward=torch.tensor([3.0])))
        >>> DistanceCost(0.05)(step)["next", "reward"]
        tensor([1.])
    """

    default_in_keys = ("leg",)
    state_keys = ()

    def __init__(self, cost: float, in_keys: Keys | None = None, out_keys: Keys | None = None) -> None:
        super().__init__(in_keys, out_keys)
        check_number(0, cost=cost)
        self.cost = float(cost)

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:  # noqa: ARG002
        key, cost = self.out_keys[0], self.cost * values[0][..., :1]
        tensordict.set(key, tensordict[key] - cost)
