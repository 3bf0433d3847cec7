"""References in currents: rules that know the places and currents of the way, or the whole map of currents.

Places are in the plane of the destination [km], along the line from it to the start and to the right of that; courses
are clockwise from that line; currents and speeds are over the speed of the vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

from magrl.errors.motion import EDDIES, eddy_velocity, eddy_waves
from magrl.geodesy import geodesic, move_place, polar, steer
from magrl.named_tasks import EDDY_MOTION
from magrl.navigators import Navigator
from magrl.transforms.areas import turned

import torch
from tensordict import TensorDictBase
from torch import Tensor

LEG_KM, RADIUS_KM, LEGS = 25.0, 25.0, 60
AHEAD_KM, BESIDE_KM, CELL_KM = (-200.0, 700.0), (-350.0, 350.0), 25.0
"""Extent of the plan along the line to the start and beside it, and its cells: with 12.5 km, the plan on the true
currents has an SPL .2 higher, in twice the time."""
HEADINGS, FINAL, LENGTHS = 24, 72, (25.0, 18.0, 12.5, 8.0, 5.0)
"""Headings of the legs of the plan, and headings and lengths [km] of the next leg, which are compared."""
INSIDE = 0.9
"""Share of the radius within which a leg of the plan arrives: at the edge, currents of a cell beside are too good."""
FIRST, SWEEPS, LOST = 60, 8, 3000.0
"""Sweeps of the first plan, and of one that begins with the plan before; cost of leaving the plan [km]."""
Velocity = Callable[[Tensor], Tensor]


def unit(angle: Tensor) -> Tensor:
    """Return unit vectors ``(..., 2)``, ahead and to the right."""
    return torch.stack((torch.cos(angle), torch.sin(angle)), -1)


def place_of(position: Tensor, target: Tensor) -> Tensor:
    """Return places northward and eastward of the destination ``(..., 2)`` [km]."""
    distance, bearing = geodesic(*position.double().unbind(-1), *target.double().unbind(-1))
    return -distance.unsqueeze(-1) * unit(bearing)


def carried(place: Tensor, leg: Tensor, velocity: Velocity) -> Tensor:
    """Return the ends ``(..., 2)`` of legs through the water, by the midpoint rule."""
    hours = leg.norm(dim=-1, keepdim=True)
    return place + leg + hours * velocity(place + (leg + hours * velocity(place)) / 2)


class Grid:
    """Nodes of the plane, and the least distance through the water from each to the destination, by value iteration."""

    def __init__(self) -> None:
        axes = [torch.arange(low, high + 1, CELL_KM) for low, high in (AHEAD_KM, BESIDE_KM)]
        self.nodes, self.row = torch.cartesian_prod(*axes), len(axes[1])
        self.low, self.last = self.nodes[0], torch.tensor([len(axis) - 1 for axis in axes])
        self.legs = LEG_KM * unit(torch.arange(HEADINGS) * 2 * math.pi / HEADINGS)

    def weights(self, place: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the four nodes around places ``(4, ...)``, their weights, and whether places are in the plane."""
        cell = (place - self.low) / CELL_KM
        inside = ((cell >= 0) & (cell <= self.last)).all(-1)
        cell = torch.minimum(cell.clamp_min(0), self.last - 1e-3)
        (a, b), (i, j) = cell.frac().unbind(-1), cell.long().unbind(-1)
        node = i * self.row + j
        nodes = torch.stack((node, node + 1, node + self.row, node + self.row + 1))
        return nodes, torch.stack(((1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b)), inside

    def left(self, cost: Tensor, place: Tensor) -> Tensor:
        """Return the distance left at places ``(..., 2)``, given that at the nodes ``(G,)``."""
        nodes, weights, inside = self.weights(place)
        left = (cost[nodes] * weights).sum(0).where(inside, torch.tensor(LOST))
        return left.masked_fill(place.norm(dim=-1) < RADIUS_KM, 0.0)

    def plan(self, current: Tensor, cost: Tensor, sweeps: int) -> Tensor:
        """Return the distance left at the nodes ``(G,)`` in a current ``(G, 2)``, given a first guess of it."""
        start = self.nodes.unsqueeze(1)
        nodes, weights, _ = self.weights(start + (self.legs + LEG_KM * current.unsqueeze(1)) / 2)  # middles of legs
        ends = start + self.legs + LEG_KM * (current[nodes] * weights.unsqueeze(-1)).sum(0)
        nodes, weights, inside = self.weights(ends)
        arrived = ends.norm(dim=-1) < INSIDE * RADIUS_KM
        weights = weights * (inside & ~arrived)
        rest = LEG_KM + LOST * ~(inside | arrived)
        for _ in range(sweeps):
            cost = ((cost[nodes] * weights).sum(0) + rest).amin(-1).clamp_max(LOST)
        return cost


class CurrentRule(Navigator):
    """Base class: remember places and their currents, and steer by the place in the plane.

    Reads fixes and currents, as an environment with observation ``"legs"`` has them.
    """

    in_keys = ["fix", "target_fix", "current", "heading", "elapsed_steps"]
    optional_keys = ()

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        _, bearing = polar(place_of(seen["fix"], seen["target_fix"]))
        none = seen["fix"].new_zeros(*seen["fix"].shape[:-1], LEGS + 1, 2)
        return {"axis": bearing.unsqueeze(-1), "places": none, "currents": none.clone()}

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        heading, axis = seen["heading"].double() - memory["axis"], memory["axis"]
        place = turned(place_of(seen["fix"], seen["target_fix"]), -axis)
        now, rows = seen["elapsed_steps"].squeeze(-1), torch.arange(len(place))
        places, currents = memory["places"].clone(), memory["currents"].clone()
        places[rows, now], currents[rows, now] = place, turned(seen["current"].double(), heading)
        memory.update({"places": places, "currents": currents})
        course, length = self.chosen(place, seen, memory)
        return steer(heading.squeeze(-1), course, length, self.max_leg_km, self.max_turn_rad)

    def chosen(self, place: Tensor, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return course [rad] and length [km] of the next leg."""
        raise NotImplementedError


class Offset(CurrentRule):
    """Steer for the destination, so that a share of the current is offset."""

    SHARE = 0.5

    def chosen(self, place: Tensor, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        distance, bearing = polar(-place)
        here = memory["currents"][torch.arange(len(place)), seen["elapsed_steps"].squeeze(-1)]
        beside = self.SHARE * (here * unit(bearing + math.pi / 2)).sum(-1)
        return bearing - torch.asin(beside.clamp(-1, 1)), distance


class Estimated(CurrentRule):
    """Plan each leg on the mean of a Gaussian process of the currents, with their true spectrum, given those so far."""

    WAVES, ERROR = 192, 0.003
    """Waves of the process, and the error of a reading: .01 and .003 have an SPL of 98.3 and 98.6 on 100 episodes of
    seed 78, .05 and .02 97.5 and 98.3 with the set of each leg read, too."""

    def __init__(self, *limits: Any, **options: Any) -> None:
        super().__init__(*limits, **options)
        generator = torch.Generator().manual_seed(0)
        height, angle = torch.rand(2, self.WAVES, generator=generator)
        share = torch.sqrt(1 - (2 * height - 1).square())  # of a wave of random direction in space that is level
        self.wave = share.unsqueeze(-1) * unit(2 * math.pi * angle) * 2 * math.pi / EDDY_MOTION["eddy_km"]
        across = torch.stack((-self.wave[:, 1], self.wave[:, 0]), -1) / self.wave.norm(dim=-1, keepdim=True)
        self.across, self.grid = across * (share * math.sqrt(3 / self.WAVES)).unsqueeze(-1), Grid()
        self.rms = EDDY_MOTION["eddies_km_h"] / EDDY_MOTION["speed_km_h"]
        self.nodes, angle = self.features(self.grid.nodes), torch.arange(FINAL) * 2 * math.pi / FINAL
        self.lengths, self.angles = torch.cartesian_prod(torch.tensor(LENGTHS), angle).unbind(-1)

    def features(self, place: Tensor) -> Tensor:
        """Return the current of each wave ``(P, 2, 2 M)`` at places."""
        phase = place @ self.wave.T
        return torch.cat([part.unsqueeze(1) * self.across.T for part in (torch.cos(phase), torch.sin(phase))], -1)

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        return {**super().first_memory(seen), "cost": self.grid.nodes.norm(dim=-1).expand(len(seen["fix"]), -1).clone()}

    def chosen(self, place: Tensor, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        parts = (memory[key].float() for key in ("places", "currents", "cost"))
        rows = [self._leg(*row) for row in zip(place.float(), seen["elapsed_steps"], *parts, strict=True)]
        course, length, cost = (torch.stack(part) for part in zip(*rows, strict=True))
        memory["cost"] = cost
        return course.double(), length.double()

    def _leg(self, place: Tensor, now: Tensor, places: Tensor, currents: Tensor, cost: Tensor) -> tuple[Tensor, ...]:
        """Return course and length of the next leg of a vehicle, and the distance left at the nodes."""
        seen, variance = self.features(places[: now + 1]).flatten(0, 1).double(), self.rms**2 / 2
        gram = variance * seen @ seen.T + self.ERROR**2 * torch.eye(len(seen), dtype=torch.float64)
        weight = (variance * seen.T @ torch.linalg.solve(gram, currents[: now + 1].flatten().double())).float()
        cost = self.grid.plan(self.nodes @ weight, cost, SWEEPS if now > 1 else FIRST)
        return *self._best(place, cost, partial(self._mean, weight)), cost

    def _mean(self, weight: Tensor, place: Tensor) -> Tensor:
        cosine, sine = weight.chunk(2)
        phase = place @ self.wave.T
        return (torch.cos(phase) * cosine + torch.sin(phase) * sine) @ self.across

    def _best(self, place: Tensor, cost: Tensor, velocity: Velocity) -> tuple[Tensor, Tensor]:
        """Return course and length of the leg with which the least distance is left."""
        legs = self.lengths.unsqueeze(-1) * unit(self.angles)
        best = (self.lengths + self.grid.left(cost, carried(place, legs, velocity))).argmin()
        return self.angles[best], self.lengths[best]


class Mapped(Estimated):
    """Plan on the true map of the currents: an oracle."""

    in_keys = [*CurrentRule.in_keys, "motion_error", "target_position"]
    oracle = True

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        first = super().first_memory(seen)
        maps = zip(self._maps(seen, first["axis"]), first["cost"], strict=True)
        costs = [self.grid.plan(velocity(self.grid.nodes), cost, FIRST) for velocity, cost in maps]
        return {**first, "cost": torch.stack(costs)}

    def chosen(self, place: Tensor, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        maps = self._maps(seen, memory["axis"])
        rows = [self._best(*row) for row in zip(place.float(), memory["cost"], maps, strict=True)]
        course, length = (torch.stack(part).double() for part in zip(*rows, strict=True))
        return course, length

    def _maps(self, seen: TensorDictBase, axis: Tensor) -> list[Velocity]:
        parts = seen["motion_error"].double(), seen["target_position"].double(), axis
        return [partial(self._map, *row) for row in zip(*parts, strict=True)]

    def _map(self, numbers: Tensor, target: Tensor, axis: Tensor, place: Tensor) -> Tensor:
        """Return the current ``(..., 2)`` at places."""
        distance, bearing = polar(turned(place.double(), axis))
        there = move_place(target.expand_as(place), bearing, distance)
        phases, directions = numbers[3:].tensor_split([EDDIES], -1)
        velocity = self.rms * eddy_velocity(there, eddy_waves(directions, EDDY_MOTION["eddy_km"]), phases)
        return turned(velocity, -axis).float()


CURRENT_RULES = {"offset": Offset, "estimated": Estimated, "mapped": Mapped}
"""Rules by their names in bars.py."""
