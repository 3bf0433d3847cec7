"""Min-max scaling of observations and actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase, Transform

from magrl.checks import check_numbers
from magrl.transforms.base import Keys, ObservationTransform, key_list, sorted_keys


class MinMaxNorm(ObservationTransform):
    """Scale entries from their bounds to an interval, and actions back.

    On the way out of the environment, ``in_keys`` are scaled from [low, high] to ``interval`` and written to
    ``out_keys``. On the way in, the policy's ``out_keys_inv`` are scaled back and written to ``in_keys_inv``. Values
    beyond their bounds are scaled linearly too, not clamped. Bounds are given, or come from the specs of the
    environment that the transform is attached to; they have no batch dimensions, so that a state_dict fits any batch
    size.

    Args:
        in_keys: entries to scale.
        out_keys: names of the scaled entries; in place by default.
        in_keys_inv: entries of the environment that are filled from scaled ones, usually ``["action"]``.
        out_keys_inv: names of those scaled entries; the same by default.
        bounds: (low, high) of each key of the environment, numbers or tensors that broadcast on the last dimensions;
            other keys take theirs from the specs.
        interval: image of the bounds.

    Raises:
        ValueError: for bounds that are not finite and rising, bounds of a key that is not used, an empty interval, or
            an in-place key that is part of the environment's state.
        RuntimeError: if bounds are needed that were neither given nor found in a spec.

    Example:
        >>> from tensordict import TensorDict
        >>> norm = MinMaxNorm(["speed"], bounds={"speed": (0.0, 50.0)})
        >>> norm(TensorDict(speed=torch.tensor([0.0, 25.0, 50.0])))["speed"]
        tensor([-1.,  0.,  1.])
    """

    invertible = True

    def __init__(
        self,
        in_keys: NestedKey | Keys = (),
        out_keys: NestedKey | Keys | None = None,
        in_keys_inv: NestedKey | Keys = (),
        out_keys_inv: NestedKey | Keys | None = None,
        *,
        bounds: Mapping[NestedKey, tuple[Tensor | float, Tensor | float]] | None = None,
        interval: tuple[float, float] = (-1.0, 1.0),
    ) -> None:
        in_keys, in_keys_inv = key_list(in_keys), key_list(in_keys_inv)
        super().__init__(
            in_keys=in_keys,
            out_keys=in_keys if out_keys is None else key_list(out_keys),
            in_keys_inv=in_keys_inv,
            out_keys_inv=in_keys_inv if out_keys_inv is None else key_list(out_keys_inv),
        )
        for ins, outs in ((self.in_keys, self.out_keys), (self.in_keys_inv, self.out_keys_inv)):
            if len(ins) != len(outs):
                raise ValueError(f"{len(ins)} input keys {ins} do not pair with {len(outs)} output keys {outs}")
        check_numbers(2, interval=interval)
        if not interval[0] < interval[1]:
            raise ValueError(f"interval must be two rising numbers, got {interval}")
        self.interval = (float(interval[0]), float(interval[1]))
        self._bounded_keys = list(dict.fromkeys([*self.in_keys, *self.in_keys_inv]))
        for index in range(len(self._bounded_keys)):
            self.register_buffer(f"low_{index}", None)
            self.register_buffer(f"high_{index}", None)
        if not isinstance(bounds or {}, Mapping):
            raise ValueError(f"bounds must be a mapping from keys to (low, high), got {bounds!r}")
        for key, pair in (bounds or {}).items():
            if not isinstance(pair, (tuple, list)) or len(pair) != 2:
                raise ValueError(f"the bounds of {key!r} must be (low, high), got {pair!r}")
            if unravel_key(key) not in self._bounded_keys:
                raise ValueError(f"bounds are given for {key!r}, which is not among the keys {self._bounded_keys}")
            self._set_bounds(unravel_key(key), *(_as_float(bound) for bound in pair))

    # Bounds

    def _set_bounds(self, key: NestedKey, low: Tensor, high: Tensor) -> None:
        dtype = torch.promote_types(low.dtype, high.dtype)
        low, high = torch.broadcast_tensors(low.to(dtype), high.to(dtype))
        extreme = torch.finfo(dtype).max  # an open side in a spec
        finite = torch.isfinite(high - low) & (low > -extreme) & (high < extreme)
        if not (finite & (low < high)).all():
            raise ValueError(
                f"MinMaxNorm needs finite bounds that rise for {key!r}, got low {low.tolist()}, high {high.tolist()}: "
                f"give bounds={{{key!r}: (low, high)}} with a number on every side"
            )
        index = self._bounded_keys.index(key)
        setattr(self, f"low_{index}", low.clone())
        setattr(self, f"high_{index}", high.clone())

    def _bounds(self, key: NestedKey) -> tuple[Tensor, Tensor]:
        if key not in self._bounded_keys:
            raise KeyError(f"MinMaxNorm does not scale {key!r}: its keys are {self._bounded_keys}")
        index = self._bounded_keys.index(key)
        if getattr(self, f"low_{index}") is None:
            self._bounds_from_parent(key)
        return getattr(self, f"low_{index}"), getattr(self, f"high_{index}")

    def set_container(self, container: Transform | EnvBase) -> None:
        """Read the bounds of the environment that the transform is attached to, where its specs have any."""
        super().set_container(container)
        parent = self.parent
        if parent is not None:
            for key in self._bounded_keys:
                for spec in (parent.full_observation_spec, parent.full_action_spec, parent.full_state_spec):
                    if key in spec.keys(True, True) and isinstance(spec[key], Bounded):
                        self._bounds_from_spec(key, spec[key], len(parent.batch_size))

    def _bounds_from_parent(self, key: NestedKey) -> None:
        parent = self.parent
        if parent is None:
            raise RuntimeError(
                f"MinMaxNorm knows no bounds for {key!r}: give them as bounds={{{key!r}: (low, high)}}, or attach the "
                "transform to an environment whose spec for it is bounded"
            )
        for spec in (parent.full_observation_spec, parent.full_action_spec, parent.full_state_spec):
            if key in spec.keys(True, True):
                self._bounds_from_spec(key, spec[key], len(parent.batch_size))
                return
        raise RuntimeError(f"MinMaxNorm found no spec for {key!r} in the environment")

    def _bounds_from_spec(self, key: NestedKey, spec: TensorSpec, batch_dims: int) -> None:
        index = self._bounded_keys.index(key)
        if getattr(self, f"low_{index}") is not None:
            return
        if not isinstance(spec, Bounded):
            raise ValueError(
                f"MinMaxNorm needs bounds for {key!r}, but its spec is {type(spec).__name__}: "
                f"give bounds={{{key!r}: (low, high)}}"
            )
        first = (0,) * batch_dims
        self._set_bounds(key, spec.space.low[first], spec.space.high[first])

    def _load_from_state_dict(self, state_dict: Mapping[str, Any], prefix: str, *args: Any) -> None:
        for name, buffer in list(self._buffers.items()):
            if buffer is None and prefix + name in state_dict:
                self._buffers[name] = torch.empty_like(state_dict[prefix + name])
        super()._load_from_state_dict(state_dict, prefix, *args)

    # Data

    def normalize(self, key: NestedKey, value: Tensor) -> Tensor:
        """Return a value of ``key`` scaled from its bounds to the interval: ``(...)`` to ``(...)``, floating point."""
        value = _as_float(value)
        low, high = (bound.to(value.device, value.dtype) for bound in self._bounds(key))
        start, end = self.interval
        return start + (end - start) * ((value - low) / (high - low))

    def denormalize(self, key: NestedKey, value: Tensor) -> Tensor:
        """Return a value of ``key`` scaled from the interval back to its bounds: ``(...)`` to ``(...)``."""
        low, high = (bound.to(value.device, value.dtype) for bound in self._bounds(key))
        start, end = self.interval
        return torch.lerp(low.expand_as(value), high.expand_as(value), (value - start) / (end - start))

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        for in_key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            value = next_tensordict.get(in_key, None)
            if value is not None:
                next_tensordict.set(out_key, self.normalize(in_key, value))
            elif not self.missing_tolerance:
                raise KeyError(f"MinMaxNorm reads {in_key!r}, which is not among {sorted_keys(next_tensordict)}")
        return next_tensordict

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        for in_key, out_key in zip(self.in_keys_inv, self.out_keys_inv, strict=True):
            value = tensordict.get(out_key, None)
            if value is not None:
                tensordict.set(in_key, self.denormalize(in_key, value))
            elif not self.missing_tolerance:
                raise KeyError(f"MinMaxNorm reads {out_key!r}, which is not among {sorted_keys(tensordict)}")
        return tensordict

    # Specs

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the scaled entries; bounded ones stay bounded."""
        for in_key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            if in_key in observation_spec.keys(True, True) or in_key not in self.in_keys_inv:
                leaf = self._leaf(observation_spec, in_key)
                observation_spec[out_key] = self._scaled_spec(in_key, leaf, observation_spec)
        return observation_spec

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """Scale the specs of the entries that the policy writes, under their scaled names."""
        input_spec = super().transform_input_spec(input_spec).clone()
        for in_key, out_key in zip(self.in_keys_inv, self.out_keys_inv, strict=True):
            for name in ("full_action_spec", "full_state_spec"):
                spec = input_spec[name]
                if spec is not None and in_key in spec.keys(True, True):
                    spec[out_key] = self._scaled_spec(in_key, spec[in_key], spec)
                    if in_key != out_key:
                        del spec[in_key]
        return input_spec

    def _scaled_spec(self, key: NestedKey, spec: TensorSpec, root: Composite) -> TensorSpec:
        self._bounds_from_spec(key, spec, len(root.shape))
        if not isinstance(spec, Bounded):
            dtype = spec.dtype if spec.dtype.is_floating_point else torch.get_default_dtype()
            return Unbounded(spec.shape, device=spec.device, dtype=dtype)
        low, high = self.normalize(key, spec.space.low), self.normalize(key, spec.space.high)
        return Bounded(low, high, spec.shape, device=spec.device, dtype=low.dtype)


def _as_float(value: Tensor | float) -> Tensor:
    """Return a floating-point tensor: numbers in float64, integer tensors in the default dtype."""
    if not isinstance(value, Tensor):
        return torch.as_tensor(value, dtype=torch.float64)
    return value if value.is_floating_point() else value.to(torch.get_default_dtype())
