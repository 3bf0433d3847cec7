"""The observation view: which keys an agent observes, and how they are scaled for its networks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor
from torchrl.envs import CatTensors, Transform

from magrl.checks import check_number, check_numbers, check_type
from magrl.field import FieldBank, FieldModel, elements_range
from magrl.transforms.observation import AngleVector, TargetDifference
from magrl.transforms.scaling import MinMaxNorm


@dataclass(frozen=True, kw_only=True)
class ObservationView:
    """Keys that an agent observes, and their scaling; see :meth:`magrl.envs.GeomagneticNavEnv.observation_view`.

    Args:
        observe_heading: whether cosine and sine of the heading are observed. Without them the state is that of Eq. 3-1,
            from which a policy without memory cannot tell the direction of its next move.
        observe_difference: whether target elements minus measured elements are observed.
        field_low: D [deg], I [deg], B_H [nT] that are scaled to -1.
        field_high: D [deg], I [deg], B_H [nT] that are scaled to 1.
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].

    Raises:
        ValueError: for bounds that are not finite or do not rise, a move or a turn out of range, or switches that are
            not bool.

    Example:
        >>> view = ObservationView(observe_heading=True, observe_difference=True, field_low=(8.0, -40.0, 33000.0),
        ...                        field_high=(12.0, -10.0, 37000.0), max_move_km=50.0, max_turn_rad=1.5)
        >>> view.size
        13
    """

    observe_heading: bool
    observe_difference: bool
    field_low: tuple[float, float, float]
    field_high: tuple[float, float, float]
    max_move_km: float
    max_turn_rad: float

    state_keys: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        check_numbers(3, field_low=self.field_low, field_high=self.field_high)
        if not all(low < high for low, high in zip(self.field_low, self.field_high, strict=True)):
            raise ValueError(f"field_low {self.field_low} must lie below field_high {self.field_high}")
        check_number(0, above=True, max_move_km=self.max_move_km)
        check_number(0, math.pi, above=True, max_turn_rad=self.max_turn_rad)
        for name in ("observe_heading", "observe_difference"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} must be True or False, got {getattr(self, name)!r}")

    @property
    def in_keys(self) -> tuple[str, ...]:
        """Keys of the environment that are observed."""
        return ("field", "target_field", "move", *(("heading",) if self.observe_heading else ()))

    @property
    def size(self) -> int:
        """Number of entries of ``observation``."""
        return 8 + 3 * self.observe_difference + 2 * self.observe_heading

    def observation_transforms(self) -> list[Transform]:
        """Return the transforms from the public keys to ``observation`` ``(..., size)``."""
        low, high = torch.tensor(self.field_low), torch.tensor(self.field_high)
        keys = ["field", "target_field", "move"]
        bounds = {"field": (low, high), "target_field": (low, high), "move": self._action_bounds()}
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
        return [*steps, CatTensors(scaled, "observation", del_keys=False, sort=False)]

    def action_transform(self, *, declared: bool = False) -> MinMaxNorm:
        """Return the transform from actions in [-1, 1] to distance [km] and turn [rad].

        Args:
            declared: whether actions have a third number, which declares the arrival and is in [-1, 1] anyway.

        Raises:
            TypeError: for ``declared`` that is not a bool.
        """
        check_type(bool, declared=declared)
        low, high = self._action_bounds()
        if declared:
            low, high = torch.cat((low, torch.tensor([-1.0]))), torch.cat((high, torch.tensor([1.0])))
        return MinMaxNorm(in_keys_inv=["action"], bounds={"action": (low, high)})

    def _action_bounds(self) -> tuple[Tensor, Tensor]:
        high = torch.tensor((self.max_move_km, self.max_turn_rad))
        return high * torch.tensor((0, -1)), high

    def check_covers(self, field: FieldModel, position: Tensor) -> None:
        """Raise unless the elements of a field at some positions lie in the scaled range or a quarter of it beyond.

        The margin is what a path across half of the region changes, and more than the field changes in some years.

        Args:
            field: field model to fly in.
            position: ``(..., 2)`` latitude, longitude [deg].

        Raises:
            ValueError: naming the element and both ranges; or for a bank of fields.
        """
        if isinstance(field, FieldBank):
            raise ValueError(f"the policy was trained in one region, this field has {len(field)}: fly it in one")
        there = (end.tolist() for end in elements_range(field, position))
        for name, unit, least, most, low, high in zip(
            ("D", "I", "B_H"), ("°", "°", " nT"), self.field_low, self.field_high, *there, strict=True
        ):
            slack = (most - least) / 4
            if low < least - slack or high > most + slack:
                raise ValueError(
                    f"the policy was trained where {name} is {least:.1f} to {most:.1f}{unit}; here it is {low:.1f} to "
                    f"{high:.1f}{unit}: train one for this region and date"
                )
