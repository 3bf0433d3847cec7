"""Decision of a vehicle that must know by itself that it has arrived: declare now, or learn more first."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from magrl.geodesy import wrap_angle
from magrl.pilot.destination import Destination, unit_points
from magrl.pilot.displacement import DestinationPosterior
from magrl.pilot.forecast import covariance_after
from magrl.pilot.local import cholesky2
from magrl.sensor_std import SensorStd

# Chosen on random planets.
STOPS = (0.0, 0.25, 0.4, 0.5, 0.6, 0.7, 0.8)
"""Distances from the estimated place to which a vehicle may come to read, as shares of the radius."""
SHORT = 0.25
"""The least distance at which it stops is half of the estimate's error, at most this share of the radius."""
TURN_DEG = 90.0
"""Turn before each further reading there, so that errors which turn with the vehicle, such as iron, average out."""
READINGS = (1, 2, 4, 8, 16, 32)
"""Numbers of further readings there that are compared with declaring now."""
_NONE = 0.01  # readings, for a forecast without one


class Progress(NamedTuple):
    """What a decision knows of the path, its steps and their price.

    Attributes:
        path: ``(...)`` flown [km].
        home: ``(..., 2)`` displacement from the start, northward and eastward [km].
        steps_left: ``(...)`` number of steps that are left after this one.
        price: ``(...)`` price of a step [% of SPL].
        max_leg_km: longest leg.
    """

    path: Tensor
    home: Tensor
    steps_left: Tensor
    price: Tensor | float
    max_leg_km: float


class ArrivalDecision(NamedTuple):
    """When a vehicle declares its arrival: the probability ``(...)`` of being right now, the probability at which going
    on is worth as much, the highest that more readings can reach, the displacement ``(..., 2)`` to the estimated place,
    and the distance from it at which to stop for them [km].

    Example:
        >>> ArrivalDecision(*torch.tensor([0.9, 0.8, 0.9]), torch.zeros(2), torch.tensor(10.0)).declare
        tensor(True)
    """

    probability: Tensor
    worth: Tensor
    attainable: Tensor
    displacement: Tensor
    stop_km: Tensor

    @property
    def declare(self) -> Tensor:
        """Whether to declare now: never at a probability of 0, also where going on is worth nothing."""
        return (self.probability >= self.worth) & (self.probability > 0)


def arrival_decision(
    goal: Destination, posterior: DestinationPosterior, errors: SensorStd, progress: Progress, radius_km: float
) -> ArrivalDecision:
    """Return whether to declare that the destination is within a radius, or where to stop and read on.

    It compares what is expected of a declaration now and later, as SPL less the price of the steps, both over the SPL
    of an arrival now. Later is after a leg toward the estimated place, to one of :data:`STOPS` before it, and 1 to 32
    readings there. Readings do not reduce the errors that are constant. Without steps left, going on is worth nothing.

    The posterior has tails that a normal forecast of it has not. Within the radius, forecasts are reduced by half of
    what the same forecast without any reading is above the probability now; the other half is what readings resolve.

    Args:
        goal: the destination as seen from the belief.
        posterior: its posterior.
        errors: accuracy of the readings, tensors ``(..., 3)``.
        progress: path, steps and their price.
        radius_km: distance from the destination within which a declaration is right [km].

    Example:
        >>> from magrl.pilot.belief import start
        >>> from magrl.pilot.destination import destination, posterior
        >>> here, errors = torch.tensor([8.0, -16.0, 35000.0]), SensorStd(torch.tensor([0.02, 0.02, 2.0]))
        >>> goal = destination(start(here, errors), here, range_km=300.0)
        >>> progress = Progress(torch.tensor(400.0), torch.tensor([400.0, 0.0]), torch.tensor(9), 0.5, 50.0)
        >>> arrival_decision(goal, posterior(goal), errors, progress, radius_km=25.0).probability > 0.8
        tensor(True)
    """
    probability, displacement = posterior.within(radius_km), posterior.aim(radius_km).to(goal.field)
    counts = torch.tensor((_NONE, *READINGS)).to(displacement)
    readings = counts[1:]
    distance, stops = displacement.norm(dim=-1, keepdim=True), radius_km * torch.tensor(STOPS).to(displacement)
    place = displacement.unsqueeze(-2).expand(*displacement.shape[:-1], len(counts), 2)
    covariance = covariance_after(goal, displacement, place, errors, counts).float()
    apart = displacement.unsqueeze(-2) * (stops / distance.clamp_min(1e-6)).unsqueeze(-1)
    now = _within(covariance[..., :1, :, :], displacement.unsqueeze(-2).float(), radius_km).to(displacement)[..., 0, 0]
    later = _within(covariance[..., 1:, :, :], apart.float(), radius_km).to(displacement)  # (..., K, J)
    tails = (1 + (probability / now.clamp_min(1e-6)).clamp_max(1)) / 2
    later = later * torch.where(distance[..., 0] < radius_km, tails, 1.0)[..., None, None]
    possible = (readings <= progress.steps_left.unsqueeze(-1)).unsqueeze(-1) & (stops <= distance).unsqueeze(-2)
    later = later.where(possible, 0.0)
    worth, best = (later * _efficiency(progress, displacement, distance - stops, readings)).flatten(-2).max(-1)
    attainable = torch.maximum(probability, later.flatten(-2).amax(-1))
    error = covariance[..., 0, :, :].diagonal(dim1=-2, dim2=-1).mean(-1).sqrt().to(displacement)
    stop_km = torch.maximum(stops[best % len(STOPS)], (error / 2).clamp_max(SHORT * radius_km))
    return ArrivalDecision(probability, worth, attainable, displacement, stop_km)


def _efficiency(progress: Progress, displacement: Tensor, further: Tensor, readings: Tensor) -> Tensor:
    """Return the SPL of an arrival after a further path ``(..., J)`` [km] and readings ``(K,)``, less the price of the
    steps, over the SPL of an arrival now: ``(..., K, J)``."""
    straight = (progress.home.to(displacement) + displacement).norm(dim=-1).clamp_min(1.0)
    flown = progress.path.to(displacement)
    path = torch.maximum(flown, straight)
    share = path.unsqueeze(-1) / torch.maximum(flown.unsqueeze(-1) + further, straight.unsqueeze(-1))
    steps = readings.unsqueeze(-1) + (further / progress.max_leg_km).unsqueeze(-2)
    price = torch.as_tensor(progress.price).to(displacement) / 100 * (path / straight)
    return share.unsqueeze(-2) - price[..., None, None] * steps


def approach(
    displacement: Tensor, heading: Tensor, stop_km: Tensor, max_leg_km: Tensor | float, max_turn_rad: Tensor | float
) -> Tensor:
    """Return the action ``(..., 2)``, distance [km] and turn [rad], that goes toward the estimated place.

    Where the turn is larger than the largest, the vehicle turns where it is. Where it has come near enough and reads
    on, it turns by :data:`TURN_DEG` to the right.

    Args:
        displacement: ``(..., 2)`` northward and eastward [km].
        heading: ``(..., 1)`` [rad].
        stop_km: ``(..., 1)`` distance from the place at which the leg ends.
        max_leg_km: longest leg.
        max_turn_rad: largest turn.

    Example:
        >>> approach(torch.tensor([0.0, 30.0]), torch.tensor([0.0]), torch.tensor([10.0]), 50.0, 1.6).round(decimals=2)
        tensor([20.0000,  1.5700])
        >>> approach(torch.tensor([0.0, 8.0]), torch.tensor([0.0]), torch.tensor([10.0]), 50.0, 3.0).round(decimals=2)
        tensor([0.0000, 1.5700])
    """
    north, east = displacement.split(1, -1)
    turn = wrap_angle(torch.atan2(east, north) - heading)
    limit = torch.as_tensor(max_turn_rad, dtype=displacement.dtype, device=displacement.device)
    longest = torch.as_tensor(max_leg_km, dtype=displacement.dtype, device=displacement.device)
    distance = (torch.hypot(north, east) - stop_km).clamp_min(0).clamp_max(longest)
    turn = turn.where(distance > 0, math.radians(TURN_DEG))
    return torch.cat((distance.where(turn.abs() <= limit, 0.0), torch.minimum(torch.maximum(turn, -limit), limit)), -1)


def _within(covariance: Tensor, apart: Tensor, radius_km: float) -> Tensor:
    """Return the probability ``(..., K, J)`` that a place is within a radius of the vehicle, where its estimate has an
    error of covariances ``(..., K, 2, 2)`` and is at displacements ``(..., J, 2)`` [km]."""
    x, y = unit_points(512)[0].to(covariance).unbind(-1)
    first, below, second = cholesky2(covariance.unsqueeze(-3), 1e-6)
    north, east = first * x, below * x + second * y  # (..., K, 128)
    dn, de = (part[..., None, :, None] for part in apart.unbind(-1))
    square = (dn + north.unsqueeze(-2)).square() + (de + east.unsqueeze(-2)).square()
    return (square <= radius_km**2).to(covariance).mean(-1)
