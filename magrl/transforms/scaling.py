"""Min-max scaling of observations and actions."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase, Transform

from magrl.checks import check_numbers, check_tensor
from magrl.transforms.base import Keys, ObservationTransform, key_list


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
        bounds: (low, high) of each key of the environment, numbers or tensors of one shape, the last dimensions;
            other keys take theirs from the specs, and ``("next", key)`` those of ``key``.
        interval: image of the bounds.

    Raises:
        ValueError: for bounds that are not finite and rising, bounds of a key that is not used, bounds that are neither
            given nor in a spec, an empty interval, or an in-place key that is part of the environment's state.

    Example:
        >>> from tensordict import TensorDict
        >>> norm = MinMaxNorm(["speed"], bounds={"speed": (0.0, 50.0)})
        >>> norm(TensorDict(speed=torch.tensor([0.0, 25.0, 50.0])))["speed"]
        tensor([-1.,  0.,  1.])
    """

    invertible = True

    def __init__(
        self,
        in_keys: Keys = (),
        out_keys: Keys | None = None,
        in_keys_inv: Keys = (),
        out_keys_inv: Keys | None = None,
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
        bounds = {unravel_key(key): pair for key, pair in (bounds or {}).items()}
        after = {unravel_key(("next", key)): pair for key, pair in bounds.items()}
        after = {key: after[key] for key in self._bounded_keys if key in after}
        for key, pair in (bounds | after | bounds).items():
            if not isinstance(pair, (tuple, list)) or len(pair) != 2:
                raise ValueError(f"the bounds of {key!r} must be (low, high), got {pair!r}")
            self._set_bounds(key, *(_as_float(bound) for bound in pair))

    # Bounds

    def _index(self, key: NestedKey) -> int:
        if key not in self._bounded_keys:
            raise ValueError(f"MinMaxNorm does not scale {key!r}: its keys are {self._bounded_keys}")
        return self._bounded_keys.index(key)

    def _set_bounds(self, key: NestedKey, low: Tensor, high: Tensor) -> None:
        dtype = torch.promote_types(low.dtype, high.dtype)
        if low.shape != high.shape and low.ndim and high.ndim:
            shapes = f"{tuple(low.shape)} and {tuple(high.shape)}"
            raise ValueError(f"the bounds of {key!r} must be numbers, or have one shape, got {shapes}")
        low, high = torch.broadcast_tensors(low.to(dtype), high.to(dtype))
        extreme = torch.finfo(dtype).max  # an open side in a spec
        finite = torch.isfinite(high - low) & (low > -extreme) & (high < extreme)
        if not (finite & (low < high)).all():
            raise ValueError(
                f"MinMaxNorm needs finite bounds that rise for {key!r}, got low {low.tolist()}, high {high.tolist()}: "
                f"give bounds={{{key!r}: (low, high)}} with a number on every side"
            )
        index = self._index(key)
        setattr(self, f"low_{index}", low.clone())
        setattr(self, f"high_{index}", high.clone())

    def _bounds(self, key: NestedKey, shape: torch.Size) -> tuple[Tensor, Tensor]:
        """Return the bounds of a key, whose value has a shape."""
        index = self._index(key)
        if getattr(self, f"low_{index}") is None:
            raise ValueError(
                f"MinMaxNorm knows no bounds for {key!r}: give bounds={{{key!r}: (low, high)}}, or attach the "
                "transform to an environment whose spec for it is bounded"
            )
        low, high = getattr(self, f"low_{index}"), getattr(self, f"high_{index}")
        if any(size not in (1, actual) for size, actual in zip(low.shape[::-1], shape[::-1], strict=False)):
            raise ValueError(
                f"MinMaxNorm has bounds of the shape {tuple(low.shape)} for {key!r}, which has {tuple(shape)}"
                + ": view.action_transform(declared=True) scales actions that declare" * (key == "action")
            )
        return low, high

    def set_container(self, container: Transform | EnvBase) -> None:
        """Read the bounds that are missing from the specs of the environment that the transform is attached to."""
        super().set_container(container)
        parent = self.parent if self._missing() else None  # TorchRL builds a parent anew for each transform
        if parent is None:
            return
        for name in ("full_action_spec", "full_observation_spec", "full_state_spec"):
            missing = self._missing()
            spec = getattr(parent, name) if missing else Composite()  # TorchRL computes each from all transforms
            for key in missing:
                leaf = spec[key] if key in spec.keys(True, True) else None
                if isinstance(leaf, Bounded):
                    row = (0,) * len(parent.batch_size)
                    self._set_bounds(key, leaf.space.low[row], leaf.space.high[row])

    def _missing(self) -> list[NestedKey]:
        """Return the keys without bounds."""
        return [key for key in self._bounded_keys if getattr(self, f"low_{self._index(key)}") is None]

    # Data

    def normalize(self, key: NestedKey, value: Tensor) -> Tensor:
        """Return a value of ``key`` scaled from its bounds to the interval: ``(...)`` to ``(...)``, floating point."""
        value = _as_float(value)
        low, high = (bound.to(value.device, value.dtype) for bound in self._bounds(key, value.shape))
        start, end = self.interval
        return start + (end - start) * ((value - low) / (high - low))

    def denormalize(self, key: NestedKey, value: Tensor) -> Tensor:
        """Return a value of ``key`` scaled from the interval back to its bounds: ``(...)`` to ``(...)``."""
        check_tensor(**{str(key): value})
        value = _as_float(value)
        low, high = (bound.to(value.device, value.dtype) for bound in self._bounds(key, value.shape))
        start, end = self.interval
        return torch.lerp(low.expand_as(value), high.expand_as(value), (value - start) / (end - start))

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        for key, scaled in zip(self.in_keys, self.out_keys, strict=True):
            next_tensordict.set(scaled, self.normalize(key, *self._read(next_tensordict, [key])))
        return next_tensordict

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        lost = [key for key in self.in_keys_inv if key not in self.in_keys]
        if lost and self.container is None:
            raise ValueError(
                f"MinMaxNorm outside of an environment, as in a replay buffer, would store {lost} in units that no "
                "sample is scaled from: name them in in_keys, too; data of an environment with MinMaxNorm are scaled"
            )
        for key, scaled in zip(self.in_keys_inv, self.out_keys_inv, strict=True):
            tensordict.set(key, self.denormalize(key, *self._read(tensordict, [scaled])))
        return tensordict

    # Specs

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the scaled entries; bounded ones stay bounded."""
        for in_key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            if in_key in observation_spec.keys(True, True) or in_key not in self.in_keys_inv:
                observation_spec[out_key] = self._scaled_spec(in_key, self._leaf(observation_spec, in_key))
        return observation_spec

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """Scale the specs of the entries that the policy writes, under their scaled names."""
        input_spec = super().transform_input_spec(input_spec).clone()
        for in_key, out_key in zip(self.in_keys_inv, self.out_keys_inv, strict=True):
            for name in ("full_action_spec", "full_state_spec"):
                spec = input_spec[name]
                if spec is not None and in_key in spec.keys(True, True):
                    leaf = spec[in_key]
                    del spec[in_key]
                    spec[out_key] = self._scaled_spec(in_key, leaf)
        return input_spec

    def _scaled_spec(self, key: NestedKey, spec: TensorSpec) -> TensorSpec:
        self._bounds(key, spec.shape)  # an error before the first episode
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
