"""Observations made of others: headings as vectors, what is left to the target, gradients, theoretical headings."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import cast

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.func import jacfwd, vmap
from torchrl.data import Binary, Bounded, TensorSpec, Unbounded

from magrl import guidance
from magrl.checks import check_number, check_tensor
from magrl.elements import element_index
from magrl.fields import FieldModel, elements_gradient_at
from magrl.geodesy import wrap_angle
from magrl.transforms.base import Keys, ObservationTransform, expect_keys, key_list, several_keys


class AngleVector(ObservationTransform):
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
        super().__init__(in_keys=key_list(in_keys), out_keys=key_list(out_keys))
        if len(self.in_keys) != len(self.out_keys):
            raise ValueError(f"in_keys {self.in_keys} do not pair with out_keys {self.out_keys}")

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(next_tensordict)
        for key, angle in zip(self.out_keys, values or (), strict=values is not None):
            next_tensordict.set(key, torch.cat((torch.cos(angle), torch.sin(angle)), -1))
        return next_tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Adds a box of [-1, 1] for each vector."""
        for in_key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            leaf = self._leaf(observation_spec, in_key)
            if leaf.shape[-1:] != (1,):
                raise ValueError(f"AngleVector reads angles of shape (..., 1); {in_key!r} is {tuple(leaf.shape)}")
            shape = (*leaf.shape[:-1], 2)
            observation_spec[out_key] = Bounded(-1.0, 1.0, shape, device=leaf.device, dtype=leaf.dtype)
        return observation_spec


class TargetDifference(ObservationTransform):
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
        super().__init__(in_keys=several_keys(in_keys), out_keys=key_list(out_keys))
        expect_keys(self, 2, 1)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(next_tensordict)
        if values is not None:
            next_tensordict.set(self.out_keys[0], values[1] - values[0])
        return next_tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Adds the difference, bounded where both of its parts are."""
        value, target = (self._leaf(observation_spec, key) for key in self.in_keys)
        if value.shape != target.shape:
            raise ValueError(f"{self.in_keys} must have one shape, got {tuple(value.shape)} and {tuple(target.shape)}")
        spec: TensorSpec = Unbounded(value.shape, device=value.device, dtype=value.dtype)
        if isinstance(value, Bounded) and isinstance(target, Bounded):
            low, high = target.space.low - value.space.high, target.space.high - value.space.low
            spec = Bounded(low, high, value.shape, device=value.device, dtype=value.dtype)
        observation_spec[self.out_keys[0]] = spec
        return observation_spec


class FieldGradient(ObservationTransform):
    """The true horizontal gradient of a field at a position. Privileged: for rewards and named oracles only.

    Args:
        field: the field model, usually ``env.field``, for the gradient of D, I, B_H. In another domain, any function
            of a position ``(2,)`` that returns values ``(E,)`` and can be differentiated by torch.
        in_keys: one position ``(..., 2)``: latitude, longitude [deg]; for a function, whatever it takes.
        out_keys: one gradient ``(..., 3, 2)``: D [deg/km], I [deg/km], B_H [nT/km], northward and eastward. Of a
            function ``(..., E, 2)``: value unit per unit of position, along the two axes of the position.

    Raises:
        ValueError: for a field that is neither, more keys than one, or a function whose values are not ``(E,)``.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.env import GeomagneticNavEnv
        >>> base = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> TransformedEnv(base, FieldGradient(base.field)).reset()["field_gradient"].shape
        torch.Size([2, 3, 2])
        >>> from tensordict import TensorDict
        >>> FieldGradient(lambda p: p**2)(TensorDict(position=torch.tensor([1.0, 3.0])))["field_gradient"]
        tensor([[2., 0.],
                [0., 6.]])
    """

    def __init__(
        self,
        field: FieldModel | Callable[[Tensor], Tensor],
        in_keys: NestedKey | Keys = ("position",),
        out_keys: NestedKey | Keys = ("field_gradient",),
    ) -> None:
        super().__init__(in_keys=key_list(in_keys), out_keys=key_list(out_keys))
        expect_keys(self, 1, 1)
        if not hasattr(field, "value_and_gradient") and not callable(field):
            raise ValueError(
                "field must have value_and_gradient(latitude, longitude), or be a function of a position (2,), "
                f"got {type(field).__name__}"
            )
        self.field = field

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(next_tensordict)
        if values is not None:
            next_tensordict.set(self.out_keys[0], self._apply_transform(values[0]))
        return next_tensordict

    def _apply_transform(self, position: Tensor) -> Tensor:
        if hasattr(self.field, "value_and_gradient"):
            return elements_gradient_at(cast(FieldModel, self.field), position).to(torch.get_default_dtype())
        check_tensor(2, position=position)
        gradient = vmap(jacfwd(self.field))(position.reshape(-1, 2))
        if gradient.ndim != 3:
            raise ValueError(f"field must turn a position (2,) into values (E,), got {tuple(gradient.shape[1:-1])}")
        return gradient.reshape(*position.shape[:-1], *gradient.shape[1:])

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Adds the gradient, unbounded."""
        leaf = self._leaf(observation_spec, self.in_keys[0])
        if leaf.shape[-1:] != (2,):
            raise ValueError(f"FieldGradient reads positions of shape (..., 2), got {tuple(leaf.shape)}")
        shape, dtype = torch.Size((*leaf.shape[:-1], 3, 2)), torch.get_default_dtype()
        if not hasattr(self.field, "value_and_gradient"):
            like = self._apply_transform(leaf.zero())
            shape, dtype = like.shape, like.dtype
        observation_spec[self.out_keys[0]] = Unbounded(shape, device=leaf.device, dtype=dtype)
        return observation_spec


class GradientHeading(ObservationTransform):
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
        super().__init__(in_keys=several_keys(in_keys), out_keys=several_keys(out_keys))
        expect_keys(self, 3, 2)
        check_number(0, 90, min_crossing_deg=min_crossing_deg)
        if min_crossing_deg == 90:
            raise ValueError(f"min_crossing_deg must be in [0, 90), got {min_crossing_deg}")
        if not isinstance(pair, (tuple, list)):
            raise ValueError(f"pair must be two different elements, by name or by index from 0, got {pair!r}")
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
        """Adds the heading, in [-pi, pi], and its mask."""
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
