"""Observations of agents of one region: its keys, scaled."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor
from torchrl.data import Bounded, TensorSpec, Unbounded
from torchrl.envs import CatTensors, EnvBase, Transform

from magrl.checks import check_number, check_numbers, check_type
from magrl.field import FieldBank, FieldModel, elements_range
from magrl.field.elements import NAMES
from magrl.transforms.areas import SEEN
from magrl.transforms.base import Keys, ObservationTransform
from magrl.transforms.currents import CurrentReading, ExpectedCurrents
from magrl.transforms.legs import Fix, RecentLegs
from magrl.transforms.scaling import MinMaxNorm

READING_SIZES = {"field": 3, "target_field": 3, "leg": 2, "heading": 1, "elapsed_steps": 1}
"""Numbers of the public keys of a step."""


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

    def __init__(self, in_keys: Keys, out_keys: Keys) -> None:
        super().__init__(in_keys, out_keys)
        if len(self.in_keys) != len(self.out_keys):
            raise ValueError(f"in_keys {self.in_keys} do not pair with out_keys {self.out_keys}")

        self.in_sizes = dict.fromkeys(self.in_keys, (1,))

    def _compute(self, values: list[Tensor]) -> list[Tensor]:
        return [torch.cat((torch.cos(angle), torch.sin(angle)), -1) for angle in values]

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add a box of [-1, 1] for each vector."""
        super().transform_observation_spec(observation_spec)
        for in_key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            leaf = observation_spec[in_key]
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

    default_in_keys = ("field", "target_field")
    default_out_keys = ("field_difference",)

    def _compute(self, values: list[Tensor]) -> list[Tensor]:
        return [values[1] - values[0]]

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


@dataclass(frozen=True, kw_only=True)
class _View:
    """Base class of views: the limits of actions and their scaling."""

    max_leg_km: float
    max_turn_rad: float

    @property
    def geometry(self) -> ObservationView | None:
        """The view, if :class:`~magrl.navigators.networks.Geometry` reads the observation."""
        return None

    @property
    def mirror(self) -> Tensor | None:
        """Linear map ``(size, size)`` of an observation to the mirror image, if that is an episode of the task, too."""
        return None

    def __post_init__(self) -> None:
        check_number(0, above=True, max_leg_km=self.max_leg_km)
        check_number(0, math.pi, above=True, max_turn_rad=self.max_turn_rad)

    def needed(self, env: EnvBase) -> list[Transform]:  # noqa: ARG002
        """Return the transforms that an environment needs before those of the observation: none."""
        return []

    def action_transform(self, *, declared: bool = False) -> MinMaxNorm:
        """Return the transform from actions in [-1, 1] to distance [km] and turn [rad].

        Args:
            declared: whether actions have a third number, which declares the arrival and is in [-1, 1] anyway.
        """
        low, high = self._action_bounds()
        if declared:
            low, high = torch.cat((low, torch.tensor([-1.0]))), torch.cat((high, torch.tensor([1.0])))
        return MinMaxNorm(in_keys_inv=["action"], bounds={"action": (low, high)})

    def _action_bounds(self) -> tuple[Tensor, Tensor]:
        high = torch.tensor((self.max_leg_km, self.max_turn_rad))
        return high * torch.tensor((0, -1)), high


@dataclass(frozen=True, kw_only=True)
class ObservationView(_View):
    """Keys that an agent observes, and their scaling; see :meth:`magrl.envs.GeomagneticNavEnv.observation_view`.

    Args:
        observe_heading: whether cosine and sine of the heading are observed. Without them the state is Eq. (8),
            from which a policy without memory cannot tell the direction of its next leg.
        observe_difference: whether target elements minus measured elements are observed.
        observe_areas: whether no-go areas in sight are observed (:class:`~magrl.transforms.NoGoAreas`).
        field_low: D [deg], I [deg], B_H [nT] that are scaled to -1.
        field_high: D [deg], I [deg], B_H [nT] that are scaled to 1.
        max_leg_km: longest leg [km].
        max_turn_rad: largest turn [rad].

    Raises:
        ValueError: for bounds that are not finite or do not rise, a leg or a turn out of range, or switches that are
            not bool.

    Example:
        >>> view = ObservationView(observe_heading=True, observe_difference=True, field_low=(8.0, -40.0, 33000.0),
        ...                        field_high=(12.0, -10.0, 37000.0), max_leg_km=50.0, max_turn_rad=1.5)
        >>> view.size
        13
    """

    observe_heading: bool = True
    observe_difference: bool = True
    observe_areas: bool = False
    field_low: tuple[float, float, float]
    field_high: tuple[float, float, float]

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers(3, field_low=self.field_low, field_high=self.field_high)
        if not all(low < high for low, high in zip(self.field_low, self.field_high, strict=True)):
            raise ValueError(f"field_low {self.field_low} must lie below field_high {self.field_high}")
        switches = ("observe_heading", "observe_difference", "observe_areas")
        check_type(bool, **{name: getattr(self, name) for name in switches})

    @property
    def in_keys(self) -> tuple[str, ...]:
        """Keys of the environment that are observed."""
        switched = (*(("heading",) if self.observe_heading else ()), *(("areas",) if self.observe_areas else ()))
        return ("field", "target_field", "leg", *switched)

    @property
    def size(self) -> int:
        """Number of entries of ``observation``."""
        return list(self.columns.values())[-1].stop

    @property
    def columns(self) -> dict[str, slice]:
        """Entries of ``observation`` by name, in their order."""
        sizes = {"field": 3, "target_field": 3, "leg": 2, "difference": 3 * self.observe_difference}
        sizes |= {"heading": 2 * self.observe_heading, "areas": 3 * SEEN * self.observe_areas}
        ends = accumulate(sizes.values())
        return {key: slice(end - size, end) for (key, size), end in zip(sizes.items(), ends, strict=True) if size}

    @property
    def geometry(self) -> ObservationView | None:
        """The view, if :class:`~magrl.navigators.networks.Geometry` adds something to it."""
        return self if self.observe_areas or (self.observe_heading and self.observe_difference) else None

    def observation_transforms(self) -> list[Transform]:
        """Return the transforms from the public keys to ``observation`` ``(..., size)``."""
        low, high = torch.tensor(self.field_low), torch.tensor(self.field_high)
        keys = ["field", "target_field", "leg"]
        bounds = {"field": (low, high), "target_field": (low, high), "leg": self._action_bounds()}
        steps: list[Transform] = []
        if self.observe_difference:
            # A quarter of the region's range is about the change over a path across half of it.
            bounds["field_difference"] = ((low - high) / 4, (high - low) / 4)
            keys.append("field_difference")
            steps.append(TargetDifference())
        scaled = [f"{key}_scaled" for key in keys]
        steps.append(MinMaxNorm(keys, scaled, bounds=bounds))
        if self.observe_heading:
            scaled.append("heading_vector")
            steps.append(AngleVector("heading", "heading_vector"))
        scaled += ["areas"] * self.observe_areas
        return [*steps, CatTensors(scaled, "observation", del_keys=False, sort=False)]

    @property
    def field_limits(self) -> tuple[list[float], list[float]]:
        """Lowest and highest elements at which the view is used: the scaled range and a quarter of it beyond.

        The margin is what a path across half of the region changes, and more than the field changes in some years.
        """
        ends = list(zip(self.field_low, self.field_high, strict=True))
        return [low - (high - low) / 4 for low, high in ends], [high + (high - low) / 4 for low, high in ends]

    def check_covers(self, field: FieldModel, position: Tensor) -> None:
        """Raise unless the elements of a field at some positions lie within :attr:`field_limits`.

        Args:
            field: field model to fly in.
            position: ``(..., 2)`` latitude, longitude [deg].

        Raises:
            ValueError: naming the element and both ranges; or for a bank of fields.
        """
        if isinstance(field, FieldBank):
            raise ValueError(f"the policy was trained in one region, this field has {len(field)}: fly it in one")
        ends = self.field_low, self.field_high, *(end.tolist() for end in elements_range(field, position))
        for name, unit, lowest, highest, least, most, low, high in zip(
            NAMES, ("°", "°", " nT"), *self.field_limits, *ends, strict=True
        ):
            if not lowest <= low <= high <= highest:
                raise ValueError(
                    f"the policy was trained where {name} is {least:.1f} to {most:.1f}{unit}; here it is {low:.1f} to "
                    f"{high:.1f}{unit}: train one for this region and date"
                )


@dataclass(frozen=True, kw_only=True)
class LegsView(_View):
    """Describe the observation of the last legs (:class:`~magrl.transforms.RecentLegs`), of the current at the
    vehicle's place (:class:`~magrl.transforms.CurrentReading`), which needs a map, and of the currents to expect around
    it (:class:`~magrl.transforms.ExpectedCurrents`).

    Args:
        count: number of legs.
        max_steps: steps of an episode.
        max_leg_km: longest leg [km].
        max_turn_rad: largest turn [rad].

    Raises:
        ValueError: for a count or a number of steps below 1, or a leg or a turn out of range.

    Example:
        >>> LegsView(max_steps=60, max_leg_km=25.0, max_turn_rad=1.5).size
        111
    """

    count: int = 8
    max_steps: int

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number(1, whole=True, count=self.count, max_steps=self.max_steps)

    @property
    def in_keys(self) -> tuple[str, ...]:
        """Keys of the environment that are observed."""
        return tuple(kind.default_out_keys[0] for kind in (RecentLegs, CurrentReading, ExpectedCurrents))

    @property
    def size(self) -> int:
        """Number of entries of ``observation``."""
        return RecentLegs(self.count).size + CurrentReading.size + ExpectedCurrents.size

    @property
    def mirror(self) -> Tensor:
        """Linear map ``(size, size)`` of an observation to the mirror image: what is to the right changes its sign."""
        signs = torch.tensor([1.0, -1, 1, 1, 1, *self.count * [1, -1, 1, -1, 1], 1, -1])
        return torch.block_diag(torch.diag(signs), ExpectedCurrents.mirror())

    def needed(self, env: EnvBase) -> list[Transform]:
        """Return the transforms that write what is observed, with the map of an environment."""
        base: Any = getattr(env, "base_env", env)
        known = {*env.observation_spec.keys()}
        fix, current = (
            [*kind.default_in_keys, *(key for key in kind.optional_in_keys if key in known)]
            for kind in (Fix, CurrentReading)
        )
        return [
            Fix(base.field, base.scenario.edge, fix),
            CurrentReading(base.field, in_keys=current),
            RecentLegs(self.count, self.max_steps),
            ExpectedCurrents(),
        ]

    def observation_transforms(self) -> list[Transform]:
        """Return the transform from the key to ``observation`` ``(..., size)``."""
        return [CatTensors(list(self.in_keys), "observation", del_keys=False, sort=False)]


@dataclass(frozen=True, kw_only=True)
class ReadingView(_View):
    """Describe a plain observation: keys of the readings in physical units, for networks that scale by themselves.

    Args:
        keys: observed keys, in the order of their numbers: among :data:`READING_SIZES`.
        max_leg_km: longest leg [km].
        max_turn_rad: largest turn [rad].

    Raises:
        ValueError: for other keys, or a leg or a turn out of range.

    Example:
        >>> ReadingView(max_leg_km=50.0, max_turn_rad=1.5).size
        9
    """

    keys: Sequence[str] = ("field", "target_field", "leg", "heading")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_type((list, tuple), keys=self.keys)
        if not self.keys or len({*self.keys}) < len(self.keys) or not {*self.keys} <= READING_SIZES.keys():
            raise ValueError(f"keys must be some of {', '.join(READING_SIZES)}, each once, got {self.keys}")

    @property
    def in_keys(self) -> tuple[str, ...]:
        """Keys of the environment that are observed."""
        return tuple(self.keys)

    @property
    def size(self) -> int:
        """Number of entries of ``observation``."""
        return sum(READING_SIZES[key] for key in self.keys)

    def observation_transforms(self) -> list[Transform]:
        """Return the transform from the keys to ``observation`` ``(..., size)``."""
        return [CatTensors(list(self.keys), "observation", del_keys=False, sort=False)]
