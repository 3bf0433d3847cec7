"""References in currents: rules that know the places and currents of the way, or the whole map of currents.

Places are in the plane of the destination, northward and eastward of it [km]; currents and speeds are over the speed of
the vehicle.
"""

from __future__ import annotations

import math
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
HALF_KM, CELL_KM, SWEEPS = 700.0, 25.0, 80
HEADINGS, FINAL = 24, 72
"""Headings of the legs that are compared in the plan, and of the next leg."""
LOST = 5000.0
"""Cost of leaving the plan [km]."""


def unit(angle: Tensor) -> Tensor:
    """Return unit vectors ``(..., 2)``, northward and eastward."""
    return torch.stack((torch.cos(angle), torch.sin(angle)), -1)


def place_of(position: Tensor, target: Tensor) -> Tensor:
    """Return places in the plane of the destination ``(..., 2)`` [km]."""
    distance, bearing = geodesic(*position.double().unbind(-1), *target.double().unbind(-1))
    return -distance.unsqueeze(-1) * unit(bearing)


class Grid:
    """Nodes of the plane, and the least distance through the water from each to the destination, by value iteration."""

    def __init__(self) -> None:
        axis = torch.arange(-HALF_KM, HALF_KM + 1, CELL_KM)
        self.count = len(axis)
        self.nodes = torch.cartesian_prod(axis, axis)
        self.goal = self.nodes.norm(dim=-1) < RADIUS_KM
        self.legs = LEG_KM * unit(torch.arange(HEADINGS) * 2 * math.pi / HEADINGS)

    def weights(self, place: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the four nodes around places ``(...)``, their weights, and whether places are in the plane."""
        cell = (place + HALF_KM) / CELL_KM
        inside = ((cell >= 0) & (cell <= self.count - 1)).all(-1)
        low = cell.clamp(0, self.count - 1 - 1e-3).floor()
        (a, b), index = (cell - low).clamp(0, 1).unbind(-1), (low[..., 0] * self.count + low[..., 1]).long()
        nodes = torch.stack((index, index + 1, index + self.count, index + self.count + 1), -1)
        return nodes, torch.stack(((1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b), -1), inside

    def left(self, cost: Tensor, place: Tensor) -> Tensor:
        """Return the distance left at places ``(..., 2)``, given that at the nodes ``(G,)``."""
        nodes, weights, inside = self.weights(place)
        left = (cost[nodes] * weights).sum(-1).where(inside, torch.tensor(LOST))
        return left.masked_fill(place.norm(dim=-1) < RADIUS_KM, 0.0)

    def plan(self, current: Tensor) -> Tensor:
        """Return the distance left at the nodes ``(G,)`` in a current ``(G, 2)``, which holds for a leg."""
        ends = self.nodes.unsqueeze(1) + self.legs + LEG_KM * current.unsqueeze(1)
        nodes, weights, inside = self.weights(ends)
        arrived = ends.norm(dim=-1) < RADIUS_KM
        cost = torch.full((len(self.nodes),), LOST).masked_fill(self.goal, 0.0)
        for _ in range(SWEEPS):
            left = (cost[nodes] * weights).sum(-1).where(inside, torch.tensor(LOST)).masked_fill(arrived, 0.0)
            new = torch.minimum(cost, left.amin(-1) + LEG_KM)
            if (cost - new).max() < 1.0:
                return new
            cost = new
        return cost


class CurrentRule(Navigator):
    """Base class: remember places and their currents, and steer by the place in the plane.

    Reads fixes and currents, as an environment with observation ``"legs"`` has them.
    """

    in_keys = ["fix", "target_fix", "current", "heading", "elapsed_steps"]
    optional_keys = ()

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        none = seen["fix"].new_zeros(*seen["fix"].shape[:-1], LEGS + 1, 2)
        return {"places": none, "currents": none.clone()}

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        place, step = place_of(seen["fix"], seen["target_fix"]), seen["elapsed_steps"].squeeze(-1)
        heading, rows = seen["heading"].squeeze(-1).double(), torch.arange(len(place))
        places, currents = memory["places"].clone(), memory["currents"].clone()
        places[rows, step], currents[rows, step] = place, turned(seen["current"].double(), heading.unsqueeze(-1))
        memory.update({"places": places, "currents": currents})
        course, length = self.chosen(place, places, currents, step)
        return steer(heading, course, length, self.max_leg_km, self.max_turn_rad)

    def chosen(self, place: Tensor, places: Tensor, currents: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
        """Return course [rad] and length [km] of the next leg."""
        raise NotImplementedError


class Offset(CurrentRule):
    """Steer for the destination, so that a share of the current is offset."""

    SHARE = 0.5

    def chosen(self, place: Tensor, places: Tensor, currents: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:  # noqa: ARG002
        distance, bearing = polar(-place)
        here = currents[torch.arange(len(place)), step]
        beside = self.SHARE * (here * unit(bearing + math.pi / 2)).sum(-1)
        return bearing - torch.asin(beside.clamp(-1, 1)), distance


class Estimated(CurrentRule):
    """Plan each leg on the mean of a Gaussian process of the currents, with their true spectrum, given those so far."""

    WAVES, ERROR = 192, 0.2
    """Waves of the process, and the standard deviation of a current that is read, which keeps the mean smooth: .05, .1,
    .2, .3 and .4 have an SPL of 91.2, 90.4, 92.5, 91.8 and 90.0 on 40 episodes of seed 77."""

    def __init__(self, *limits: Any, **options: Any) -> None:
        super().__init__(*limits, **options)
        generator = torch.Generator().manual_seed(0)
        height, angle = torch.rand(2, self.WAVES, generator=generator)
        share = torch.sqrt(1 - (2 * height - 1).square())  # of a wave of random direction in space that is level
        self.wave = share.unsqueeze(-1) * unit(2 * math.pi * angle) * 2 * math.pi / EDDY_MOTION["eddy_km"]
        across = torch.stack((-self.wave[:, 1], self.wave[:, 0]), -1) / self.wave.norm(dim=-1, keepdim=True)
        self.across, self.grid = across * (share * math.sqrt(3 / self.WAVES)).unsqueeze(-1), Grid()
        self.rms = EDDY_MOTION["eddies_km_h"] / EDDY_MOTION["speed_km_h"]
        self.nodes = self.features(self.grid.nodes)

    def features(self, place: Tensor) -> Tensor:
        """Return the current of each wave ``(P, 2, 2 M)`` at places."""
        phase = place @ self.wave.T
        return torch.cat([part.unsqueeze(1) * self.across.T for part in (torch.cos(phase), torch.sin(phase))], -1)

    def chosen(self, place: Tensor, places: Tensor, currents: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
        rows = [self._course(*row) for row in zip(place.float(), places.float(), currents.float(), step, strict=True)]
        return torch.stack(rows).double(), place.norm(dim=-1).clamp(5.0, LEG_KM)

    def _course(self, place: Tensor, places: Tensor, currents: Tensor, step: Tensor) -> Tensor:
        """Return the course of a vehicle."""
        if place.norm() < RADIUS_KM:  # its episode is over
            return torch.tensor(0.0)
        seen = self.features(places[: step + 1]).flatten(0, 1).double()
        precision = torch.eye(2 * self.WAVES, dtype=torch.float64) * 2 / self.rms**2 + seen.T @ seen / self.ERROR**2
        mean = torch.linalg.solve(precision, seen.T @ currents[: step + 1].flatten().double() / self.ERROR**2).float()
        return self._best(place, self.grid.plan(self.nodes @ mean), (self.features(place[None]) @ mean)[0])

    def _best(self, place: Tensor, cost: Tensor, current: Tensor) -> Tensor:
        """Return the course after which the least distance is left."""
        angle = torch.arange(FINAL) * 2 * math.pi / FINAL
        ends = place + place.norm().clamp(5.0, LEG_KM) * (unit(angle) + current)
        return angle[self.grid.left(cost, ends).argmin()]


class Mapped(Estimated):
    """Plan on the true map of the currents: an oracle."""

    in_keys = [*CurrentRule.in_keys, "motion_error", "target_position"]
    oracle = True

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        costs = [self.grid.plan(self._map(*row, self.grid.nodes)) for row in self._rows(seen)]
        return {**super().first_memory(seen), "cost": torch.stack(costs)}

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        self._now = list(zip(self._rows(seen), memory["cost"], strict=True))
        return super().decide(seen, memory)

    def chosen(self, place: Tensor, places: Tensor, currents: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:  # noqa: ARG002
        place = place.float()
        here = [self._map(*row, one[None])[0] for (row, _), one in zip(self._now, place, strict=True)]
        costs = [cost for _, cost in self._now]
        rows = [self._best(*row) for row in zip(place, costs, here, strict=True)]
        return torch.stack(rows).double(), place.double().norm(dim=-1).clamp(5.0, LEG_KM)

    @staticmethod
    def _rows(seen: TensorDictBase) -> list[tuple[Tensor, Tensor]]:
        return list(zip(seen["motion_error"].double(), seen["target_position"].double(), strict=True))

    def _map(self, numbers: Tensor, target: Tensor, place: Tensor) -> Tensor:
        """Return the current ``(P, 2)`` at places."""
        distance, bearing = polar(place.double())
        there = move_place(target.expand(len(place), 2), bearing, distance)
        phases, directions = numbers[3:].tensor_split([EDDIES], -1)
        return (self.rms * eddy_velocity(there, eddy_waves(directions, EDDY_MOTION["eddy_km"]), phases)).float()


CURRENT_RULES = {"offset": Offset, "estimated": Estimated, "mapped": Mapped}
"""Rules by their names in bars.py."""
