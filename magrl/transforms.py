"""Transforms for any TorchRL environment: scaling, gradient guidance and its reward.

A transform handles keys and specs; the mathematics is in :mod:`magrl.guidance` and :mod:`magrl.fields`. Every
transform takes ``in_keys`` and ``out_keys`` (nested ones too), works in ``Compose``, and in a replay buffer or as a
module where that makes sense.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase, Transform

from magrl import guidance
from magrl.elements import element_index
from magrl.fields import FieldModel, elements_gradient_at
from magrl.geodesy import wrap_angle

Keys = Sequence[NestedKey]


class _ObservationTransform(Transform):
    """What the transforms that add an observation share: they also run at reset, and on plain TensorDicts."""

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:  # noqa: ARG002
        return self._call(tensordict_reset)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict)

    def _read(self, tensordict: TensorDictBase) -> list[Tensor] | None:
        """The values at ``in_keys``, or None where keys may be missing and one is."""
        values = [tensordict.get(key, None) for key in self.in_keys]
        missing = [key for key, value in zip(self.in_keys, values, strict=True) if value is None]
        if not missing:
            return values
        if self.missing_tolerance:
            return None
        raise KeyError(f"{type(self).__name__} reads {missing}, which are not among {sorted_keys(tensordict)}")

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """Refuses to write over what the environment reads back: its next step would start from the written value.

        Raises:
            ValueError: naming the key.
        """
        state = input_spec["full_state_spec"]
        for key in self.out_keys:
            if state is not None and key in state.keys(True, True) and key not in self.in_keys_inv:
                raise ValueError(
                    f"{type(self).__name__} would overwrite {key!r}, which the environment reads back as its state: "
                    "write to another out_key"
                )
        return input_spec

    def _leaf(self, spec: Composite, key: NestedKey) -> TensorSpec:
        if key not in spec.keys(True, True):
            raise KeyError(f"{type(self).__name__} reads {key!r}, which is not among {sorted_keys(spec)}")
        return spec[key]


def sorted_keys(container: TensorDictBase | Composite) -> list[str]:
    """The leaves of a TensorDict or a spec, for messages."""
    return sorted(str(key) for key in container.keys(True, True))


def _key_list(keys: NestedKey | Keys) -> list[NestedKey]:
    """One key or several, as a list; a tuple of strings is one nested key."""
    if isinstance(keys, str) or (isinstance(keys, tuple) and keys and all(isinstance(k, str) for k in keys)):
        return [unravel_key(keys)]
    return [unravel_key(key) for key in keys]


class MinMaxNorm(_ObservationTransform):
    """Scales entries from their bounds to an interval, and actions back.

    Going out of the env, ``in_keys`` are scaled from [low, high] to ``interval`` and written to ``out_keys``. Coming
    in, the policy's ``out_keys_inv`` are scaled back and written to ``in_keys_inv`` for the env. Values beyond their
    bounds are scaled by the same line: nothing is clamped. Bounds come from the specs of the env that the transform
    is attached to, or are given; they are kept without batch dimensions, so that a state_dict fits any batch size.

    Args:
        in_keys: entries to scale.
        out_keys: where to; in place by default.
        in_keys_inv: entries of the env to fill from scaled ones, usually ``["action"]``.
        out_keys_inv: their scaled names; the same by default.
        bounds: for each env-side key its (low, high), numbers or tensors that broadcast on the last dimensions;
            keys that are left out take theirs from the specs.
        interval: what the bounds are mapped to.

    Raises:
        ValueError: for bounds that are not finite or not rising, bounds for a key that is not used, an empty
            interval, or an in-place key that is part of the env's state.
        RuntimeError: when bounds are needed that were neither given nor found in a spec.

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
        in_keys, in_keys_inv = _key_list(in_keys), _key_list(in_keys_inv)
        super().__init__(
            in_keys=in_keys,
            out_keys=in_keys if out_keys is None else _key_list(out_keys),
            in_keys_inv=in_keys_inv,
            out_keys_inv=in_keys_inv if out_keys_inv is None else _key_list(out_keys_inv),
        )
        for ins, outs in ((self.in_keys, self.out_keys), (self.in_keys_inv, self.out_keys_inv)):
            if len(ins) != len(outs):
                raise ValueError(f"{len(ins)} input keys {ins} do not pair with {len(outs)} output keys {outs}")
        if not (math.isfinite(interval[0]) and math.isfinite(interval[1]) and interval[0] < interval[1]):
            raise ValueError(f"interval must be two rising finite numbers, got {interval}")
        self.interval = (float(interval[0]), float(interval[1]))
        self._bounded_keys = list(dict.fromkeys([*self.in_keys, *self.in_keys_inv]))
        for index in range(len(self._bounded_keys)):
            self.register_buffer(f"low_{index}", None)
            self.register_buffer(f"high_{index}", None)
        self._given = set()
        for key, (low, high) in (bounds or {}).items():
            if unravel_key(key) not in self._bounded_keys:
                raise ValueError(f"bounds are given for {key!r}, which is none of the keys {self._bounded_keys}")
            self._given.add(unravel_key(key))
            self._set_bounds(unravel_key(key), *(_as_float(bound) for bound in (low, high)))

    # Bounds

    def _set_bounds(self, key: NestedKey, low: Tensor, high: Tensor) -> None:
        dtype = torch.promote_types(low.dtype, high.dtype)
        low, high = torch.broadcast_tensors(low.to(dtype), high.to(dtype))
        extreme = torch.finfo(dtype).max  # how a spec writes that a side is open
        finite = torch.isfinite(high - low) & (low > -extreme) & (high < extreme)
        if not (finite & (low < high)).all():
            raise ValueError(
                f"MinMaxNorm needs finite bounds that rise for {key!r}, got low {low.tolist()}, high {high.tolist()}"
            )
        index = self._bounded_keys.index(key)
        setattr(self, f"low_{index}", low.clone())
        setattr(self, f"high_{index}", high.clone())

    def _bounds(self, key: NestedKey) -> tuple[Tensor, Tensor]:
        index = self._bounded_keys.index(key)
        if getattr(self, f"low_{index}") is None:
            self._bounds_from_parent(key)
        return getattr(self, f"low_{index}"), getattr(self, f"high_{index}")

    def set_container(self, container: Transform | EnvBase) -> None:
        """Reads the bounds of the environment that the transform is attached to, where its specs have any."""
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
        if key in self._given or getattr(self, f"low_{index}") is not None:
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
        """Scales a value of ``key`` from its bounds to the interval: ``(...)`` to ``(...)``, in floats."""
        value = _as_float(value)
        low, high = (bound.to(value.device, value.dtype) for bound in self._bounds(key))
        start, end = self.interval
        return start + (end - start) * ((value - low) / (high - low))

    def denormalize(self, key: NestedKey, value: Tensor) -> Tensor:
        """Scales a value of ``key`` from the interval back to its bounds: ``(...)`` to ``(...)``."""
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
        for in_key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            if in_key in observation_spec.keys(True, True) or in_key not in self.in_keys_inv:
                leaf = self._leaf(observation_spec, in_key)
                observation_spec[out_key] = self._scaled_spec(in_key, leaf, observation_spec)
        return observation_spec

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
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


class AngleVector(_ObservationTransform):
    """An angle as its cosine and sine: what a network can read without a jump at the half turn.

    Args:
        in_keys: angles ``(..., 1)`` [rad].
        out_keys: vectors ``(..., 2)`` cosine, sine.

    Example:
        >>> from tensordict import TensorDict
        >>> AngleVector(["heading"], ["course"])(TensorDict(heading=torch.zeros(1)))["course"]
        tensor([1., 0.])
    """

    def __init__(self, in_keys: NestedKey | Keys, out_keys: NestedKey | Keys) -> None:
        super().__init__(in_keys=_key_list(in_keys), out_keys=_key_list(out_keys))
        if len(self.in_keys) != len(self.out_keys):
            raise ValueError(f"in_keys {self.in_keys} do not pair with out_keys {self.out_keys}")

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(next_tensordict)
        for key, angle in zip(self.out_keys, values or (), strict=values is not None):
            next_tensordict.set(key, torch.cat((torch.cos(angle), torch.sin(angle)), -1))
        return next_tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        for in_key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            leaf = self._leaf(observation_spec, in_key)
            if leaf.shape[-1:] != (1,):
                raise ValueError(f"AngleVector reads angles of shape (..., 1); {in_key!r} is {tuple(leaf.shape)}")
            shape = (*leaf.shape[:-1], 2)
            observation_spec[out_key] = Bounded(-1.0, 1.0, shape, device=leaf.device, dtype=leaf.dtype)
        return observation_spec


class TargetDifference(_ObservationTransform):
    """What is left to the target: the target's values less the values here.

    A linear map of what is observed anyway, but one that a network need not learn, and that can be scaled to the
    length of a journey instead of the size of a region.

    Args:
        in_keys: values here and values at the target, each ``(..., E)``.
        out_keys: one difference ``(..., E)``.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict(field=torch.tensor([8.0, -16.0]), target_field=torch.tensor([9.0, -20.0]))
        >>> TargetDifference()(td)["field_difference"]
        tensor([ 1., -4.])
    """

    def __init__(
        self, in_keys: Keys = ("field", "target_field"), out_keys: NestedKey | Keys = ("field_difference",)
    ) -> None:
        super().__init__(in_keys=[unravel_key(k) for k in in_keys], out_keys=_key_list(out_keys))
        _expect_keys(self, 2, 1)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(next_tensordict)
        if values is not None:
            next_tensordict.set(self.out_keys[0], values[1] - values[0])
        return next_tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        value, target = (self._leaf(observation_spec, key) for key in self.in_keys)
        if value.shape != target.shape:
            raise ValueError(f"{self.in_keys} must have one shape, got {tuple(value.shape)} and {tuple(target.shape)}")
        spec: TensorSpec = Unbounded(value.shape, device=value.device, dtype=value.dtype)
        if isinstance(value, Bounded) and isinstance(target, Bounded):
            low, high = target.space.low - value.space.high, target.space.high - value.space.low
            spec = Bounded(low, high, value.shape, device=value.device, dtype=value.dtype)
        observation_spec[self.out_keys[0]] = spec
        return observation_spec


class FieldGradient(_ObservationTransform):
    """The true horizontal gradient of D, I, B_H at a position. Privileged: for rewards and named oracles only.

    Args:
        field: the field model, usually ``env.field``.
        in_keys: one position ``(..., 2)``: latitude, longitude [deg].
        out_keys: one gradient ``(..., 3, 2)``: D [deg/km], I [deg/km], B_H [nT/km], northward and eastward.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.env import GeomagneticNavEnv
        >>> base = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> TransformedEnv(base, FieldGradient(base.field)).reset()["field_gradient"].shape
        torch.Size([2, 3, 2])
    """

    def __init__(
        self,
        field: FieldModel,
        in_keys: NestedKey | Keys = ("position",),
        out_keys: NestedKey | Keys = ("field_gradient",),
    ) -> None:
        super().__init__(in_keys=_key_list(in_keys), out_keys=_key_list(out_keys))
        _expect_keys(self, 1, 1)
        if not hasattr(field, "value_and_gradient"):
            raise ValueError(f"field must have value_and_gradient(latitude, longitude), got {type(field).__name__}")
        self.field = field

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(next_tensordict)
        if values is not None:
            gradient = elements_gradient_at(self.field, values[0])
            next_tensordict.set(self.out_keys[0], gradient.to(torch.get_default_dtype()))
        return next_tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        leaf = self._leaf(observation_spec, self.in_keys[0])
        if leaf.shape[-1:] != (2,):
            raise ValueError(f"FieldGradient reads positions of shape (..., 2), got {tuple(leaf.shape)}")
        shape = (*leaf.shape[:-1], 3, 2)
        observation_spec[self.out_keys[0]] = Unbounded(shape, device=leaf.device, dtype=torch.get_default_dtype())
        return observation_spec


class GradientHeading(_ObservationTransform):
    """The theoretical heading of the parallel approach (Eq. 3-15), on any pair of elements.

    Privileged where the gradient is: a heading that follows from the true gradient is not for a policy to read.

    Args:
        in_keys: three entries: values here ``(..., E)``, values at the destination ``(..., E)``, and the gradient
            ``(..., E, 2)`` northward and eastward (or along any two axes that the headings are measured from).
        out_keys: the heading ``(..., 1)`` [rad] and a mask ``(..., 1)``, False where the gradients are too near to
            parallel to tell a direction (the heading is 0 there).
        pair: the two elements, by name (``"D"``, ``"I"``, ``"B_H"``) or by index. The difference in D is wrapped.
        min_crossing_deg: least angle at which the two gradients must cross [deg].

    Raises:
        ValueError: for an unknown element, a pair of one, a crossing angle outside [0, 90), or wrong shapes.

    Example:
        >>> from tensordict import TensorDict
        >>> here, there = torch.tensor([8.0, -16.0, 35000.0]), torch.tensor([8.0, -20.0, 35000.0])
        >>> gradient = torch.tensor([[0.0, 0.002], [0.017, 0.0], [0.1, 0.1]])  # D grows eastward, I northward
        >>> td = TensorDict(field=here, target_field=there, field_gradient=gradient)
        >>> GradientHeading()(td)["gradient_heading"]  # so the way to a lower I is south
        tensor([3.1416])
    """

    def __init__(
        self,
        in_keys: Keys = ("field", "target_field", "field_gradient"),
        out_keys: Keys = ("gradient_heading", "gradient_heading_valid"),
        *,
        pair: tuple[str | int, str | int] = ("D", "I"),
        min_crossing_deg: float = 2.0,
    ) -> None:
        # A plain sequence of strings is several keys here, never one nested key.
        super().__init__(in_keys=[unravel_key(k) for k in in_keys], out_keys=[unravel_key(k) for k in out_keys])
        _expect_keys(self, 3, 2)
        if not 0 <= min_crossing_deg < 90:
            raise ValueError(f"min_crossing_deg must be in [0, 90), got {min_crossing_deg}")
        self.pair = [element_index(name) if isinstance(name, str) else name for name in pair]
        if len(set(self.pair)) != 2 or not all(isinstance(i, int) and i >= 0 for i in self.pair):
            raise ValueError(f"pair must be two different elements, by name or by index from 0, got {pair}")
        self.wraps = [name == "D" for name in pair]
        self.min_crossing = math.radians(min_crossing_deg)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(next_tensordict)
        if values is not None:
            heading, valid = self._apply_transform(*values)
            next_tensordict.set(self.out_keys[0], heading)
            next_tensordict.set(self.out_keys[1], valid)
        return next_tensordict

    def _apply_transform(self, value: Tensor, target: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
        error = (target - value)[..., self.pair]
        wrapped = torch.rad2deg(wrap_angle(torch.deg2rad(error)))
        error = torch.where(torch.tensor(self.wraps, device=error.device), wrapped, error)
        gradient = gradient[..., self.pair, :].to(error.dtype)
        return guidance.parallel_approach(torch.zeros_like(error), error, gradient, self.min_crossing)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        value, target, gradient = (self._leaf(observation_spec, key) for key in self.in_keys)
        if value.shape != target.shape or gradient.shape != (*value.shape, 2) or max(self.pair) >= value.shape[-1]:
            raise ValueError(
                f"GradientHeading needs values (..., E), targets (..., E) and gradients (..., E, 2) that hold elements "
                f"{self.pair}, got {tuple(value.shape)}, {tuple(target.shape)}, {tuple(gradient.shape)}"
            )
        shape = (*value.shape[:-1], 1)
        observation_spec[self.out_keys[0]] = Bounded(-math.pi, math.pi, shape, device=value.device, dtype=value.dtype)
        observation_spec[self.out_keys[1]] = Binary(1, shape, device=value.device, dtype=torch.bool)
        return observation_spec


class AlignmentReward(Transform):
    """Adds to the reward of a step what its angle deserves beside a reference (Eq. 3-6).

    The reference is read where the move was chosen, the angle where it led: the heading of the move just made. In a
    replay buffer or as a module, the angle and the reward are those under ``"next"``.

    Args:
        in_keys: the angle and the reference [rad], of equal shape; and, if wanted, a mask of the reference: where it
            is False the term is 0.
        out_keys: one reward, to which the term is added; created if the env has none of that name.
        weight: zeta_3 [1/rad].
        offset: deviation at which the term changes sign [rad]. The paper's pi/4 pays at every aligned step, so that
            dawdling pays too; 0 only ever takes away.

    Raises:
        ValueError: for a weight or an offset that is not finite, or another number of keys.

    Example:
        >>> from tensordict import TensorDict
        >>> step = TensorDict(reference=torch.zeros(1), next=TensorDict(angle=torch.zeros(1), reward=torch.ones(1)))
        >>> AlignmentReward(["angle", "reference"], weight=4 / math.pi)(step)["next", "reward"]
        tensor([2.])
    """

    def __init__(
        self,
        in_keys: Keys = ("heading", "gradient_heading", "gradient_heading_valid"),
        out_keys: NestedKey | Keys = ("reward",),
        *,
        weight: float = 3.0,
        offset: float = math.pi / 4,
    ) -> None:
        super().__init__(in_keys=[unravel_key(k) for k in in_keys], out_keys=_key_list(out_keys))
        if len(self.in_keys) not in (2, 3) or len(self.out_keys) != 1:
            raise ValueError(
                f"AlignmentReward reads an angle, a reference and perhaps a mask, and writes one reward; "
                f"got in_keys {self.in_keys}, out_keys {self.out_keys}"
            )
        if not (math.isfinite(weight) and math.isfinite(offset)):
            raise ValueError(f"weight and offset must be finite, got {weight} and {offset}")
        self.weight, self.offset = float(weight), float(offset)

    def term(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> Tensor:
        """The alignment term of a step, in the shape of the angle: what is added to the reward."""
        angle, (reference, *mask) = next_tensordict[self.in_keys[0]], (tensordict[key] for key in self.in_keys[1:])
        value = guidance.alignment_reward(angle, reference, self.weight, self.offset)
        return torch.where(mask[0], value, 0.0) if mask else value

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        for key, source in zip(self.in_keys, (next_tensordict, tensordict, tensordict), strict=False):
            if source.get(key, None) is None:
                if self.missing_tolerance:
                    return next_tensordict
                raise KeyError(f"AlignmentReward reads {key!r}, which is not among {sorted_keys(source)}")
        term = self.term(tensordict, next_tensordict)
        reward = next_tensordict.get(self.out_keys[0], None)
        next_tensordict.set(self.out_keys[0], term if reward is None else reward + term)
        return next_tensordict

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if tensordict.get("next", None) is None:
            raise KeyError(
                "AlignmentReward needs whole transitions: the reference at the root and the angle and reward under "
                f"'next', got {sorted_keys(tensordict)}"
            )
        self._step(tensordict, tensordict["next"])
        return tensordict

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
        key = self.out_keys[0]
        if key in reward_spec.keys(True, True):
            leaf = reward_spec[key]
            reward_spec[key] = Unbounded(leaf.shape, device=leaf.device, dtype=leaf.dtype)
        else:
            leaf = self._observed(self.in_keys[0])
            reward_spec[key] = Unbounded(leaf.shape, device=leaf.device, dtype=leaf.dtype)
        return reward_spec

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """Makes the reference part of the state, so that batched and parallel envs hand it to the next step."""
        input_spec = input_spec.clone()
        if input_spec["full_state_spec"] is None:
            input_spec["full_state_spec"] = Composite(shape=input_spec.shape, device=input_spec.device)
        for key in self.in_keys[1:]:
            input_spec["full_state_spec"][key] = self._observed(key).clone()
        return input_spec

    def _observed(self, key: NestedKey) -> TensorSpec:
        parent = self.parent
        spec = Composite() if parent is None else parent.full_observation_spec
        if key not in spec.keys(True, True):
            raise KeyError(f"AlignmentReward reads {key!r}, which is not among the observations {sorted_keys(spec)}")
        return spec[key]


def _as_float(value: Tensor | float) -> Tensor:
    """A tensor of floats: numbers in float64, whole-number tensors in the default dtype."""
    if not isinstance(value, Tensor):
        return torch.as_tensor(value, dtype=torch.float64)
    return value if value.is_floating_point() else value.to(torch.get_default_dtype())


def _expect_keys(transform: Transform, num_in: int, num_out: int) -> None:
    if len(transform.in_keys) != num_in or len(transform.out_keys) != num_out:
        raise ValueError(
            f"{type(transform).__name__} takes {num_in} in_keys and {num_out} out_keys, "
            f"got {transform.in_keys} and {transform.out_keys}"
        )
