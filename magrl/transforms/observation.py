"""Observations derived from others: angles as vectors, and differences to a target."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import Bounded, TensorSpec, Unbounded

from magrl.transforms.base import Keys, ObservationTransform, expect_keys, key_list, several_keys


class AngleVector(ObservationTransform):
    """Write angles as cosine and sine, without a jump at the half turn.

    Args:
        in_keys: angles ``(..., 1)`` [rad].
        out_keys: vectors ``(..., 2)`` cosine, sine.

    Raises:
        ValueError: for keys that do not pair.

    Example:
        >>> from tensordict import TensorDict
        >>> AngleVector(["heading"], ["course"])(TensorDict(heading=torch.zeros(1)))["course"]
        tensor([1., 0.])
    """

    def __init__(self, in_keys: NestedKey | Keys, out_keys: NestedKey | Keys) -> None:
        super().__init__(in_keys=key_list(in_keys), out_keys=key_list(out_keys))
        if len(self.in_keys) != len(self.out_keys):
            raise ValueError(f"in_keys {self.in_keys} do not pair with out_keys {self.out_keys}")

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(next_tensordict)
        for key, angle in zip(self.out_keys, values or (), strict=values is not None):
            next_tensordict.set(key, torch.cat((torch.cos(angle), torch.sin(angle)), -1))
        return next_tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add a box of [-1, 1] for each vector."""
        for in_key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            leaf = self._leaf(observation_spec, in_key)
            if leaf.shape[-1:] != (1,):
                raise ValueError(f"AngleVector reads angles of shape (..., 1); {in_key!r} is {tuple(leaf.shape)}")
            shape = (*leaf.shape[:-1], 2)
            observation_spec[out_key] = Bounded(-1.0, 1.0, shape, device=leaf.device, dtype=leaf.dtype)
        return observation_spec


class TargetDifference(ObservationTransform):
    """Write the difference between target values and present values.

    It is a linear map of values that are observed anyway, but a network need not learn it, and it can be scaled to the
    length of an episode instead of the size of a region.

    Args:
        in_keys: present values and target values, each ``(..., E)``.
        out_keys: target values minus present values ``(..., E)``.

    Raises:
        ValueError: for another number of keys.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict(field=torch.tensor([8.0, -16.0]), target_field=torch.tensor([9.0, -20.0]))
        >>> TargetDifference()(td)["field_difference"]
        tensor([ 1., -4.])
    """

    def __init__(
        self, in_keys: Keys = ("field", "target_field"), out_keys: NestedKey | Keys = ("field_difference",)
    ) -> None:
        super().__init__(in_keys=several_keys(in_keys), out_keys=key_list(out_keys))
        expect_keys(self, 2, 1)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(next_tensordict)
        if values is not None:
            next_tensordict.set(self.out_keys[0], values[1] - values[0])
        return next_tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the difference, bounded if both of its parts are."""
        value, target = (self._leaf(observation_spec, key) for key in self.in_keys)
        if value.shape != target.shape:
            raise ValueError(f"{self.in_keys} must have one shape, got {tuple(value.shape)} and {tuple(target.shape)}")
        spec: TensorSpec = Unbounded(value.shape, device=value.device, dtype=value.dtype)
        if isinstance(value, Bounded) and isinstance(target, Bounded):
            low, high = target.space.low - value.space.high, target.space.high - value.space.low
            spec = Bounded(low, high, value.shape, device=value.device, dtype=value.dtype)
        observation_spec[self.out_keys[0]] = spec
        return observation_spec
