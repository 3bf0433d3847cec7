"""Decision of a vehicle that must know by itself that it has arrived: declare now, or learn more first."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from magrl.checks import check_number, check_tensor
from magrl.geodesy import wrap_angle
from magrl.tracking.filter import (
    DISTANCE_SCALE_KM,
    ELEMENT_PERIODS,
    ELEMENT_SCALES,
    FieldTrack,
    PerElement,
    _nonnegative_or_nan,
    _units,
    _variance,
    estimated_field,
)
from magrl.tracking.posterior import WayPosterior, _normal, way_posterior
from magrl.tracking.priors import common_error, curl_relation, field_curvature
from magrl.tracking.track import related

# Chosen on random planets.
TRIP_KM = 800.0
"""Path before the decision [km]: another kilometer has to make a right declaration about 1/800 more likely."""
STEP_KM = 0.5
"""Path that a reading costs [km]."""
DRIFT_SHARE = 0.5
"""Share of the variance of slow errors that the readings of a track do not average."""
RANGE_KM = 500.0
"""Prior standard deviation of the way along each axis [km]."""
STOPS = (0.0, 0.25, 0.4, 0.5, 0.6, 0.7, 0.8)
"""Distances from the estimated place to which a vehicle may come to read, as shares of the radius."""
SHORT = 0.25
"""The least distance at which it stops, as a share of the radius: estimates vary by more."""
TURN_DEG = 90.0
"""Turn before each further reading there, so that errors which turn with the vehicle, such as iron, average out."""
READINGS = (1, 2, 4, 8, 16, 32)
"""Numbers of further readings there that are compared with declaring now."""


class ArrivalDecision(NamedTuple):
    """Probability ``(...)`` of being right now, that at which going on is worth as much, the highest that more readings
    can reach, the distance [km] from the estimated place at which to stop for them, and the posterior of the way.

    Example:
        >>> there = WayPosterior(torch.zeros(1, 2), torch.ones(1))
        >>> ArrivalDecision(*torch.tensor([0.9, 0.8, 0.9, 10.0]), there).declare
        tensor(True)
    """

    probability: Tensor
    worth: Tensor
    attainable: Tensor
    stop_km: Tensor
    posterior: WayPosterior

    @property
    def declare(self) -> Tensor:
        """Whether to declare now."""
        return self.probability >= self.worth


def arrival_decision(
    track: FieldTrack,
    target: Tensor,
    sensor_std: PerElement,
    bias_std: PerElement,
    drift_std: PerElement,
    steps_left: Tensor,
    radius_km: float,
    range_km: float = RANGE_KM,
) -> ArrivalDecision:
    """Return whether to declare that the target is within a radius, or where to stop and read on.

    It compares the probability of being right now with that after a way toward the estimated place, to one of
    :data:`STOPS` before it, and 1 to 32 readings there, times the share of the path that remains useful: a path of
    :data:`TRIP_KM` over itself, the way and :data:`STEP_KM` for each reading. Readings reduce the variance of the field
    at the vehicle, but not that of a constant error. Slow errors change with the heading and the time: the readings of
    a track have averaged a part of them, and :data:`DRIFT_SHARE` of their variance is left. Without steps left, going
    on is worth nothing.

    Args:
        track: state of the filter of D, I, B_H.
        target: ``(..., 3)`` D [deg], I [deg], B_H [nT] at the target.
        sensor_std: standard deviations of new errors of a reading, ``(..., 3)`` or 3 numbers.
        bias_std: the same of constant and slow errors.
        drift_std: the same of slow errors alone, at most ``bias_std``.
        steps_left: ``(...)`` number of steps that are left after this one.
        radius_km: distance from the target within which a declaration is right [km].
        range_km: prior standard deviation of the way along each axis [km].

    Raises:
        ValueError: for shapes that do not match, a radius or range that is not above 0, or a negative standard
            deviation.

    Example:
        >>> from magrl.tracking import dipole_prior, start
        >>> here = torch.tensor([8.0, -16.0, 35000.0])
        >>> track = start(here, dipole_prior(here), (0.02, 0.02, 2.0))
        >>> std = (0.02, 0.02, 2.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        >>> decision = arrival_decision(track, here, *std, torch.tensor(9), radius_km=25.0, range_km=300.0)
        >>> decision.probability.round(decimals=2), decision.declare  # another reading is worth more
        (tensor(0.9000), tensor(False))
    """
    check_number(0, above=True, radius_km=radius_km)
    known, shared = related(track, curl_relation)
    field = estimated_field(known)
    curvature, common = field_curvature(field), common_error(field)
    unit, count = _units(known, ELEMENT_SCALES), 3
    lasting = {"bias_std": bias_std, "drift_std": drift_std}
    bias, drift = (_nonnegative_or_nan(name, std, count, unit).square() for name, std in lasting.items())
    bias = bias - (1 - DRIFT_SHARE) * torch.minimum(drift, bias)
    options = ELEMENT_SCALES, shared, bias.sqrt(), ELEMENT_PERIODS, curvature, common
    posterior = way_posterior(known, target, range_km, *options)
    probability, way = posterior.within(radius_km), posterior.way().displacement
    noise = _variance(sensor_std, unit).unsqueeze(-2)
    bias, alike = (x.unsqueeze(-2) for x in (bias / unit.square(), common * bias.sqrt() / unit))
    readings = torch.tensor(READINGS, dtype=unit.dtype, device=unit.device)
    there = _variance_at(known, way / DISTANCE_SCALE_KM).unsqueeze(-2)
    stops = radius_km * torch.tensor(STOPS, dtype=unit.dtype, device=unit.device)
    distance = way.norm(dim=-1, keepdim=True)
    apart = way.unsqueeze(-2) * (stops / distance.clamp_min(1e-6)).unsqueeze(-1)
    variance = 1 / (1 / there + readings.unsqueeze(-1) / noise) + bias - alike.square()
    later = _within(known, variance, alike, apart, radius_km)
    possible = (readings <= steps_left.unsqueeze(-1)).unsqueeze(-1) & (stops <= distance).unsqueeze(-2)
    later = later.where(possible, 0.0)
    cost = (distance - stops).unsqueeze(-2) + STEP_KM * readings.unsqueeze(-1)
    worth, best = (later * (TRIP_KM / (TRIP_KM + cost))).flatten(-2).max(-1)
    attainable = torch.maximum(probability, later.flatten(-2).amax(-1))
    stop_km = stops[best % len(STOPS)].clamp_min(SHORT * radius_km)
    return ArrivalDecision(probability, worth, attainable, stop_km, posterior)


def approach(
    way: Tensor, heading: Tensor, stop_km: Tensor, max_move_km: Tensor | float, max_turn_rad: Tensor | float
) -> Tensor:
    """Return the action ``(..., 2)``, distance [km] and turn [rad], that goes toward the estimated place.

    Where the turn is larger than the largest, the vehicle turns where it is. Where it has come near enough and reads
    on, it turns by :data:`TURN_DEG` to the right.

    Args:
        way: ``(..., 2)`` northward and eastward [km].
        heading: ``(..., 1)`` [rad].
        stop_km: ``(..., 1)`` distance from the place at which the move ends.
        max_move_km: longest move.
        max_turn_rad: largest turn.

    Example:
        >>> approach(torch.tensor([0.0, 30.0]), torch.tensor([0.0]), torch.tensor([10.0]), 50.0, 1.6).round(decimals=2)
        tensor([20.0000,  1.5700])
        >>> approach(torch.tensor([0.0, 8.0]), torch.tensor([0.0]), torch.tensor([10.0]), 50.0, 3.0).round(decimals=2)
        tensor([0.0000, 1.5700])
    """
    check_tensor(2, way=way)
    north, east = way.split(1, -1)
    turn = wrap_angle(torch.atan2(east, north) - heading)
    limit = torch.as_tensor(max_turn_rad, dtype=way.dtype, device=way.device)
    longest = torch.as_tensor(max_move_km, dtype=way.dtype, device=way.device)
    distance = (torch.hypot(north, east) - stop_km).clamp_min(0).clamp_max(longest)
    turn = turn.where(distance > 0, math.radians(TURN_DEG))
    return torch.cat((distance.where(turn.abs() <= limit, 0.0), torch.minimum(torch.maximum(turn, -limit), limit)), -1)


def _variance_at(track: FieldTrack, way: Tensor) -> Tensor:
    """Return the variance ``(..., E)`` of the field at the end of a way ``(..., 2)``, in scaled units."""
    dn, de = (x.unsqueeze(-1) for x in way.unbind(-1))
    p = track.covariance
    variance = p[..., 0, 0] + dn * (2 * p[..., 0, 1] + p[..., 1, 1] * dn + 2 * p[..., 1, 2] * de)
    return (variance + de * (2 * p[..., 0, 2] + p[..., 2, 2] * de)).clamp_min(1e-12)


def _within(track: FieldTrack, variance: Tensor, alike: Tensor, apart: Tensor, radius_km: float) -> Tensor:
    """Return the probability ``(..., K, J)`` that a place is within a radius of the vehicle.

    It is that of covariances diag(variance) + alike alike^T ``(..., K, E)`` of the field there and displacements
    ``(..., J, 2)`` [km] to the estimate of the place. The error of the estimate has the covariance of the least squares
    solution.
    """
    gradient = track.mean[..., 1:]
    squares = gradient.unsqueeze(-1) * gradient.unsqueeze(-2) + track.covariance[..., 1:, 1:]  # (..., E, 2, 2)
    nn, ne, ee = (
        (squares[..., i, j].unsqueeze(-2) / variance).sum(-1)[..., None, None] for i, j in ((0, 0), (0, 1), (1, 1))
    )
    row = alike / variance
    north, east = (row @ gradient * (1 + (alike * row).sum(-1, keepdim=True)).rsqrt()).split(1, -1)
    nn, ne, ee = (a - b.unsqueeze(-1) for a, b in ((nn, north * north), (ne, north * east), (ee, east * east)))
    x, y = _NORMAL.to(nn).unbind(-1)
    first = nn.clamp_min(1e-12).rsqrt()  # N = L L^T; the points solve L^T d = normal
    below = ne * first
    second = (ee - below * below).clamp_min(1e-12).rsqrt()
    east = second * y
    north = first * (x - below * east)
    dn, de = (part[..., None, :, None] / DISTANCE_SCALE_KM for part in apart.unbind(-1))
    return (torch.hypot(dn + north, de + east) * DISTANCE_SCALE_KM <= radius_km).to(variance.dtype).mean(-1)


_NORMAL = _normal(128, seed=2)
