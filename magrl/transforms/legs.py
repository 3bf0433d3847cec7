"""Fixes of the position by a map of the field, and what they say of the last legs, such as of currents."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, Unbounded

from magrl.checks import check_number
from magrl.field.elements import element_difference, elements_gradient, measured_elements
from magrl.field.model import FieldModel, elements_at
from magrl.geodesy import geodesic, move_place, polar, to_ecef
from magrl.guidance import displacement_to
from magrl.pilot.displacement import displacement_between
from magrl.sensor_std import STD_KEYS
from magrl.transforms.areas import turned
from magrl.transforms.base import Keys, ObservationTransform, StatefulTransform
from magrl.transforms.sequences import per_nanotesla

GRID, STEPS = 31, 4
"""Places of the map in each direction from which a fix starts, and steps of Newton's method from the best of them."""
ALIKE_NT, NEIGHBORS_KM = 0.1, 200.0
"""Elements that differ by less are the same [nT]; places that are nearer to each other are not compared [km]."""
FAR_KM, NEAR_KM, LEG_KM = 400.0, 20.0, 100.0
"""Units of the distance to the destination and of its logarithm, and of the distance of a leg [km]."""


class Fix(ObservationTransform):
    """Write the places at which a map of the field has the elements that were read, by Newton's method.

    It is the place of least squares: each element counts by its accuracy, where all are known and not 0, and otherwise
    as a disturbance of the field does, in nT. Elements with errors give fixes with errors. Nothing that it writes is
    privileged unless an input is.

    Args:
        field: map of the field, such as ``env.field``; no bank.
        region: region of the map (:class:`magrl.envs.Regions`), in which elements have one place.
        in_keys: reading and target ``(..., 3)``: D [deg], I [deg], B_H [nT]; and the standard deviations of a reading
            ``(..., 3)``, which may be left out.
        out_keys: their places ``(..., 2)``, latitude and longitude [deg], float64.

    Raises:
        ValueError: for a bank of fields, or a region in which two places have the same elements.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> base = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> state = TransformedEnv(base, Fix(base.field, base.region)).reset()
        >>> torch.allclose(state["fix"], state["position"], atol=1e-3)
        True
    """

    default_in_keys = ("field", "target_field")
    default_out_keys = ("fix", "target_fix")
    optional_in_keys = STD_KEYS[:1]
    in_sizes = {"field": (3,), "target_field": (3,), STD_KEYS[0]: (3,)}
    places: Tensor
    middle: Tensor
    scaled: Tensor

    def __init__(
        self, field: FieldModel, region: Any, in_keys: Keys | None = None, out_keys: Keys | None = None
    ) -> None:
        super().__init__(in_keys, out_keys)
        if getattr(field, "indexed", False) or len(region) != 1:
            raise ValueError(f"a map is of one region, got {len(region)}")
        self.field = field
        self.register_buffer("places", region.grid(GRID).reshape(-1, 2))
        elements = elements_at(field, self.places).double()
        self.register_buffer("middle", elements[len(elements) // 2])
        self.register_buffer("scaled", self._scaled(elements))
        self._check_map(elements)

    def _check_map(self, elements: Tensor) -> None:
        """Raise if a place of the grid and another one have the same elements."""
        here, points = self.places, to_ecef(*self.places.unbind(-1))
        neighbors = torch.cdist(points, points) < NEIGHBORS_KM
        second = torch.cdist(self.scaled, self.scaled).masked_fill(neighbors, torch.inf).argmin(-1)
        found, residual = self._solved(elements, per_nanotesla(elements), here[second])
        away = geodesic(*here.unbind(-1), *found.unbind(-1))[0]
        same = (residual < ALIKE_NT) & (away > 1.0)
        if same.any():
            first, other = (place[same][0].tolist() for place in (here, found))
            where = "({:.1f}, {:.1f}) and ({:.1f}, {:.1f})".format(*first, *other)
            raise ValueError(f"the map is ambiguous: {where} have the same elements; give a smaller region")

    def _scaled(self, elements: Tensor) -> Tensor:
        """Return elements less those in the middle of the map, in about nT."""
        return element_difference(elements, self.middle) / per_nanotesla(self.middle)

    def _solved(self, elements: Tensor, unit: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
        """Return the place at which the map has elements, near a first one, and how far they differ there."""
        for _ in range(STEPS):
            value, gradient = self.field.value_and_gradient(*place.unbind(-1))
            error = element_difference(elements, measured_elements(value)) / unit
            jacobian = elements_gradient(value, gradient) / unit.unsqueeze(-1)
            distance, bearing = polar(displacement_to(error, jacobian))
            place = move_place(place, bearing, distance.clamp_max(FAR_KM))
        return place, error.norm(dim=-1)

    def _compute(self, values: list[Tensor]) -> list[Tensor]:
        elements = torch.stack(values[:2]).double()
        unit, std = per_nanotesla(elements), values[-1].double()
        if len(values) > 2:
            unit = torch.where((std > 0).all(-1, keepdim=True), std, unit)
        near = self.places[torch.cdist(self._scaled(elements), self.scaled).argmin(-1)]
        return list(self._solved(elements, unit, near)[0].unbind(0))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the places."""
        observation_spec = super().transform_observation_spec(observation_spec)
        for key in self.out_keys:
            self._add(observation_spec, self._leaf(observation_spec, self.in_keys[0]), key, 2, dtype=torch.float64)
        return observation_spec


class RecentLegs(StatefulTransform):
    """Write what fixes say of the last legs: their places, and how far the vehicle was set in each of them.

    A current sets a vehicle beside its leg, and the set of the last legs shows where currents are. All vectors are in
    the frame of the heading, so that a policy need not learn each direction anew.

    Args:
        count: number of legs.
        max_steps: steps of an episode.
        in_keys: place of the vehicle and of the destination ``(..., 2)``, latitude and longitude [deg], such as of
            :class:`Fix`; last leg ``(..., 2)`` with the distance [km] first; heading ``(..., 1)`` [rad]; and number of
            the step ``(..., 1)``.
        out_keys: observation ``(..., 5 + 5 count)``: cosine and sine of the bearing of the destination, its distance
            d / 400 km, ln(d / 20 km + 0.1), the share of the steps; and of each leg, the last one first, the
            displacement from its middle / 100 km (2), the set over the distance (2), and 1, or five
            times 0 before the first ones. And the state ``(..., count, 5)`` float64: the displacement from the
            middle of each leg to the destination [km], its set northward and eastward, and 1.

    Raises:
        ValueError: for a count or a number of steps below 1.

    Example:
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> base = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> TransformedEnv(base, Compose(Fix(base.field, base.region), RecentLegs())).rollout(3)["recent_legs"].shape
        torch.Size([2, 3, 45])
    """

    default_in_keys = ("fix", "target_fix", "leg", "heading", "elapsed_steps")
    default_out_keys = ("recent_legs", "legs")
    in_sizes = {"fix": (2,), "target_fix": (2,), "heading": (1,), "elapsed_steps": (1,)}

    def __init__(self, count: int = 8, max_steps: int = 50, in_keys: Keys | None = None, **keys: Any) -> None:
        super().__init__(in_keys, **keys)
        check_number(1, whole=True, count=count, max_steps=max_steps)
        self.count, self.max_steps = int(count), int(max_steps)

    @property
    def size(self) -> int:
        """Numbers of the observation."""
        return 5 + 5 * self.count

    @property
    def state_keys(self) -> list[NestedKey]:
        """Keys that a step reads from the TensorDict before it: the legs, and the place."""
        return [self.out_keys[1], self.in_keys[0]]

    def _begin(self, tensordict: TensorDictBase, values: list[Tensor], mask: Tensor | None) -> None:  # noqa: ARG002
        fix = values[0]
        self._write(tensordict, values, fix.new_zeros(*fix.shape[:-1], self.count, 5))

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:
        fix, target, command, heading, _ = values
        legs, before = state
        moved, left = displacement_between(before, fix), displacement_between(fix, target)
        distance, course = command[..., :1].double(), heading.double()
        through = distance * torch.cat((torch.cos(course), torch.sin(course)), -1)
        drift = (moved - through) / distance.clamp_min(1.0)
        leg = torch.cat((left + moved / 2, drift, torch.ones_like(distance)), -1)
        self._write(tensordict, values, torch.cat((leg.unsqueeze(-2), legs[..., :-1, :]), -2))

    def _write(self, tensordict: TensorDictBase, values: list[Tensor], legs: Tensor) -> None:
        fix, target, _, heading, step = values
        displacement, back = displacement_between(fix, target), -heading.double()
        distance, (ahead, right) = displacement.norm(dim=-1, keepdim=True), turned(displacement, back).split(1, -1)
        places, drifts, known = legs.split((2, 2, 1), -1)
        places, back = places - displacement.unsqueeze(-2), back.unsqueeze(-2)
        seen = torch.cat((turned(places, back) / LEG_KM, turned(drifts, back), known), -1)
        bearing = torch.cat((ahead, right), -1) / distance.clamp_min(1e-6)
        share = step.double() / self.max_steps
        parts = bearing, distance / FAR_KM, torch.log(distance / NEAR_KM + 0.1), share, (seen * known).flatten(-2)
        tensordict.set(self.out_keys[0], torch.cat(parts, -1).to(heading.dtype)).set(self.out_keys[1], legs)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the observation and the state."""
        observation_spec = super().transform_observation_spec(observation_spec)
        place, heading = (self._leaf(observation_spec, self.in_keys[number]) for number in (0, 3))
        self._add(observation_spec, heading, self.out_keys[0], self.size)
        shape = (*place.shape[:-1], self.count, 5)
        observation_spec[self.out_keys[1]] = Unbounded(shape, device=place.device, dtype=place.dtype)
        return observation_spec
