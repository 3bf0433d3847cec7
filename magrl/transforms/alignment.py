"""Gradient guidance: the gradient of a field, the theoretical heading, and the alignment reward."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.func import jacfwd, vmap
from torchrl.data import Binary, Bounded, Composite

from magrl import guidance
from magrl.checks import check_number
from magrl.field import FieldBank
from magrl.field.elements import element_index
from magrl.field.model import FieldModel, elements_gradient_at
from magrl.geodesy import wrap_angle
from magrl.transforms.base import Keys, ObservationTransform, StepReward


class FieldGradient(ObservationTransform):
    """Write the true horizontal gradient of a field at a position. Privileged: for rewards and oracles only.

    Args:
        field: field model, usually ``env.field``, or a bank of them, for the gradient of D, I, B_H; or, in another
            domain, any function of a position ``(2,)`` that returns values ``(E,)`` and can be differentiated by torch.
        in_keys: one position ``(..., 2)``: latitude, longitude [deg], or the argument of the function; for a bank also
            the region ``(..., 1)``, int64.
        out_keys: one gradient ``(..., 3, 2)``: D [deg/km], I [deg/km], B_H [nT/km], northward and eastward; of a
            function ``(..., E, 2)``: unit of the value per unit of position, along the two axes of the position.

    Raises:
        ValueError: for a field that is neither, another number of keys, or a function whose values are not ``(E,)``.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.envs.geomagnetic import GeomagneticNavEnv
        >>> base = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> TransformedEnv(base, FieldGradient(base.field)).reset()["field_gradient"].shape
        torch.Size([2, 3, 2])
        >>> from tensordict import TensorDict
        >>> FieldGradient(lambda p: p**2)(TensorDict(position=torch.tensor([1.0, 3.0])))["field_gradient"]
        tensor([[2., 0.],
                [0., 6.]])
    """

    default_in_keys = ("position",)
    default_out_keys = ("field_gradient",)
    optional_in_keys = ("region",)
    in_sizes = {"position": (2,), "region": (1,)}

    def __init__(
        self,
        field: FieldModel | FieldBank | Callable[[Tensor], Tensor],
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        indexed = getattr(field, "indexed", False)
        super().__init__(["position", "region"] if indexed and in_keys is None else in_keys, out_keys)
        if ("region" in self.in_names) != indexed:
            raise ValueError(f"in_keys must have a region for a bank of fields, and for nothing else, got {in_keys}")
        self.elements = hasattr(field, "value_and_gradient")
        if not self.elements and not callable(field):
            raise ValueError(
                "field must have value_and_gradient(latitude, longitude), or be a function of a position (2,), "
                f"got {type(field).__name__}"
            )
        self.field = field

    def _compute(self, values: list[Tensor]) -> list[Tensor]:
        position, *region = values
        if self.elements:
            index = region[0].squeeze(-1) if region else None
            return [elements_gradient_at(self.field, position, index).to(torch.get_default_dtype())]
        gradient = vmap(jacfwd(self.field))(position.reshape(-1, 2))
        if gradient.ndim != 3:
            raise ValueError(f"field must turn a position (2,) into values (E,), got {tuple(gradient.shape[1:-1])}")
        return [gradient.reshape(*position.shape[:-1], *gradient.shape[1:])]

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the gradient, unbounded."""
        leaf = super().transform_observation_spec(observation_spec)[self.in_keys[0]]
        count, dtype = 3, torch.get_default_dtype()
        if not self.elements:
            (like,) = self._compute([leaf.zero()])
            count, dtype = like.shape[-2], like.dtype
        self._add(observation_spec, leaf, self.out_keys[0], count, 2, dtype=dtype)
        return observation_spec


def _pair_indices(pair: object) -> list[int]:
    """Return two different elements by index.

    Raises:
        ValueError: for anything else than two different elements, by name or by index.
    """
    given = pair if isinstance(pair, (tuple, list)) else ()
    indices = [element_index(name) if isinstance(name, str) else name for name in given]
    if len(set(indices)) != 2 or not all(isinstance(i, int) and i >= 0 for i in indices):
        raise ValueError(f"pair must be 'auto' or two different elements, by name or by index from 0, got {pair!r}")
    return indices


class GradientHeading(ObservationTransform):
    """Write the theoretical heading of the parallel approach (Eq. (21)), on any pair of elements.

    The paper's pair (D, I) crosses well in its region. Elsewhere the gradients of a fixed pair may be parallel;
    ``pair="auto"`` takes at each place the pair that crosses best, so that the heading is defined wherever one is.

    Privileged if the gradient is: a policy must not read a heading that follows from the true gradient.

    Args:
        in_keys: present values ``(..., E)``, values at the destination ``(..., E)``, and the gradient ``(..., E, 2)``
            northward and eastward (or along any two axes that the headings are measured from).
        out_keys: the heading ``(..., 1)`` [rad] and a mask ``(..., 1)``, False where the gradients are too close to
            parallel to determine a direction (the heading is 0 there).
        pair: two elements, by name (``"D"``, ``"I"``, ``"B_H"``) or by index; or ``"auto"``, where the values are D, I,
            B_H. The difference in D is taken the shorter way around; by index, none is.

    Raises:
        ValueError: for an unknown element, a pair of equal elements, or shapes that do not match.

    Example:
        >>> from tensordict import TensorDict
        >>> here, there = torch.tensor([8.0, -16.0, 35000.0]), torch.tensor([8.0, -20.0, 35000.0])
        >>> gradient = torch.tensor([[0.0, 0.002], [0.017, 0.0], [0.1, 0.1]])  # D grows eastward, I northward
        >>> td = TensorDict(field=here, target_field=there, field_gradient=gradient)
        >>> GradientHeading()(td)["gradient_heading"]  # a lower I is to the south
        tensor([3.1416])
    """

    default_in_keys = ("field", "target_field", "field_gradient")
    default_out_keys = ("gradient_heading", "gradient_heading_valid")

    def __init__(
        self,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
        *,
        pair: tuple[str | int, str | int] | str = ("D", "I"),
    ) -> None:
        super().__init__(in_keys, out_keys)
        self.pair = None if pair == "auto" else _pair_indices(pair)
        self.wrapped = [0] if pair == "auto" or "D" in pair else []

    def _compute(self, values: list[Tensor]) -> tuple[Tensor, Tensor]:
        value, target, gradient = values
        self._check_elements(value.shape[-1])
        error, gradient = target - value, gradient.to(value.dtype)
        for column in self.wrapped:
            error[..., column] = torch.rad2deg(wrap_angle(torch.deg2rad(error[..., column])))
        if self.pair is not None:
            error, gradient = error[..., self.pair], gradient[..., self.pair, :]
        else:
            pair = guidance.best_pair(gradient)
            error, gradient = error.gather(-1, pair), gradient.gather(-2, pair.unsqueeze(-1).expand(*pair.shape, 2))
        return guidance.parallel_approach(torch.zeros_like(error), error, gradient)

    def _check_elements(self, count: int) -> None:
        if max(indices := self.pair or [0, 1, 2]) >= count:
            raise ValueError(f"GradientHeading takes elements {indices}, counted from 0, but the values have {count}")

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the heading, in [-pi, pi], and its mask."""
        value, target, gradient = (self._leaf(observation_spec, key) for key in self.in_keys)
        if value.shape != target.shape or gradient.shape != (*value.shape, 2):
            raise ValueError(
                "GradientHeading needs values (..., E), targets (..., E) and gradients (..., E, 2), got "
                f"{tuple(value.shape)}, {tuple(target.shape)}, {tuple(gradient.shape)}"
            )
        self._check_elements(value.shape[-1])
        shape = (*value.shape[:-1], 1)
        observation_spec[self.out_keys[0]] = Bounded(-math.pi, math.pi, shape, device=value.device, dtype=value.dtype)
        observation_spec[self.out_keys[1]] = Binary(1, shape, device=value.device, dtype=torch.bool)
        return observation_spec


class AlignmentReward(StepReward):
    """Add the alignment term of Eq. (12) to the reward: high where an angle is close to a reference.

    The reference is read before the leg, the angle (the heading of the leg just made) after it. In a replay buffer or
    as a module, the angle and the reward are those under ``"next"``.

    Args:
        in_keys: the angle and the reference ``(..., 1)`` [rad]; and optionally a mask of the reference, where False
            makes the term 0.
        out_keys: one reward, to which the term is added (created if the environment has none of that name), and
            optionally an observation of the term alone, such as ``["reward", "reward_alignment"]``.
        weight: zeta_3 [1/rad].
        offset: deviation at which the term changes sign [rad]. With the paper's pi/4 every aligned step is rewarded, so
            that slow progress is rewarded too; with 0 the term is never positive.

    Raises:
        ValueError: for a non-finite weight or offset, or another number of keys.

    Example:
        >>> from tensordict import TensorDict
        >>> step = TensorDict(reference=torch.zeros(1), next=TensorDict(angle=torch.zeros(1), reward=torch.ones(1)))
        >>> AlignmentReward(["angle", "reference"], weight=4 / math.pi)(step)["next", "reward"]
        tensor([2.])
    """

    default_in_keys = ("heading", "gradient_heading", "gradient_heading_valid")
    optional_in_keys = ("gradient_heading_valid",)
    optional_out_keys = ("reward_alignment",)
    out_sizes = {"reward_alignment": (1,)}

    def __init__(
        self,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
        *,
        weight: float = 3.0,
        offset: float = math.pi / 4,
    ) -> None:
        super().__init__(in_keys, out_keys)
        check_number(weight=weight, offset=offset)
        self.weight, self.offset = float(weight), float(offset)

    @property
    def step_keys(self) -> list[NestedKey]:
        """Keys that a step reads from the TensorDict after it: the angle."""
        return self.in_keys[:1]

    @property
    def state_keys(self) -> list[NestedKey]:
        """Keys that a step reads from the TensorDict before it: the reference and its mask."""
        return self.in_keys[1:]

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:
        term = guidance.alignment_reward(values[0], state[0], self.weight, self.offset)
        for mask in state[1:]:
            term = torch.where(mask, term, 0.0)
        reward = tensordict.get(self.out_keys[0], None)
        tensordict.set(self.out_keys[0], term if reward is None else reward + term)
        for key in self.out_keys[1:]:
            tensordict.set(key, term)
