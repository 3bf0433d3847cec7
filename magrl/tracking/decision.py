"""Decision of a vehicle that must know by itself that it has arrived: declare now, or learn more first."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from magrl.checks import check_number, check_tensor
from magrl.tracking.filter import (
    DISTANCE_SCALE_KM,
    ELEMENT_SCALES,
    FieldTrack,
    PerElement,
    _nonnegative_or_nan,
    _units,
    _variance,
)
from magrl.tracking.posterior import _NORMAL, WayPosterior

TRIP_KM = 400.0
"""Path that certainty is worth: a vehicle goes on for a kilometer if that makes a right declaration 1/400 more likely."""
STEP_KM = 0.2
"""Path that a reading costs [km]."""
READINGS = (1, 2, 4, 8, 16, 32)
"""Numbers of further readings at the estimated place that are compared with declaring now."""


class ArrivalDecision(NamedTuple):
    """Whether to declare ``(...)``, and probabilities ``(...)`` of being right now and after the best further readings.

    Example:
        >>> ArrivalDecision(torch.tensor(True), torch.tensor(0.9), torch.tensor(0.9)).declare
        tensor(True)
    """

    declare: Tensor
    probability: Tensor
    attainable: Tensor


def arrival_decision(
    track: FieldTrack,
    posterior: WayPosterior,
    sensor_std: PerElement,
    bias_std: PerElement,
    steps_left: Tensor,
    radius_km: float,
    scales: PerElement = ELEMENT_SCALES,
) -> ArrivalDecision:
    """Return whether to declare that the target is within a radius, or to go to the estimated place and read on.

    It compares the probability of being right now with that after 1 to 32 more readings at the estimated place, minus
    what they cost: the way there over :data:`TRIP_KM`, and :data:`STEP_KM` for each. A reading there reduces the
    variance of the field at the vehicle, not that of a constant error. Without steps left, it declares.

    Args:
        track: state of the filter, with the gradients that the posterior was computed from.
        posterior: of the way to the target.
        sensor_std: ``(..., E)`` or E numbers: standard deviations of new errors of a reading.
        bias_std: the same of constant and slow errors.
        steps_left: ``(...)`` number of steps that are left.
        radius_km: distance from the target within which a declaration is right [km].
        scales: those of :func:`~magrl.tracking.start`.

    Raises:
        ValueError: for shapes that do not match, a radius that is not above 0, or a negative standard deviation.

    Example:
        >>> sure = FieldTrack(torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), 1e-4 * torch.eye(3).expand(2, 3, 3))
        >>> there = WayPosterior(torch.zeros(1, 2), torch.ones(1))
        >>> std = (0.01, 0.01), (0.0, 0.0)
        >>> arrival_decision(sure, there, *std, torch.tensor(9), radius_km=25.0, scales=(1.0, 1.0)).declare
        tensor(True)
    """
    check_number(0, above=True, radius_km=radius_km)
    unit = _units(track, scales)
    way = posterior.way()
    noise, count = _variance(sensor_std, unit), unit.shape[-1]
    bias = (_nonnegative_or_nan("bias_std", bias_std, count, unit) / unit).square()
    readings = torch.tensor(READINGS, dtype=unit.dtype, device=unit.device)
    variance = _variance_at(track, way.displacement / DISTANCE_SCALE_KM)
    later = 1 / (1 / variance.unsqueeze(-2) + readings.unsqueeze(-1) / noise.unsqueeze(-2)) + bias.unsqueeze(-2)
    attainable = _within(track, later, radius_km)
    cost = way.displacement.norm(dim=-1, keepdim=True) + STEP_KM * readings
    possible = readings <= steps_left.unsqueeze(-1)
    value = (attainable * (TRIP_KM / (TRIP_KM + cost))).where(possible, 0.0).amax(-1)
    probability = posterior.within(radius_km)
    best = attainable.where(possible, 0.0).amax(-1)
    return ArrivalDecision((probability >= value) | (steps_left <= 0), probability, torch.maximum(probability, best))


def _variance_at(track: FieldTrack, way: Tensor) -> Tensor:
    """Return the variance ``(..., E)`` of the field at the end of a way ``(..., 2)``, in scaled units."""
    dn, de = (x.unsqueeze(-1) for x in way.unbind(-1))
    p = track.covariance
    variance = p[..., 0, 0] + dn * (2 * p[..., 0, 1] + p[..., 1, 1] * dn + 2 * p[..., 1, 2] * de)
    return (variance + de * (2 * p[..., 0, 2] + p[..., 2, 2] * de)).clamp_min(1e-12)


def _within(track: FieldTrack, variance: Tensor, radius_km: float) -> Tensor:
    """Return the probability ``(..., K)`` of a place within a radius, for variances ``(..., K, E)`` of the field there.

    The estimated place is then that of the vehicle, with the covariance of the least squares solution.
    """
    gradient = track.mean[..., 1:]
    squares = gradient.unsqueeze(-1) * gradient.unsqueeze(-2) + track.covariance[..., 1:, 1:]  # (..., E, 2, 2)
    nn, ne, ee = (
        (squares[..., i, j].unsqueeze(-2) / variance).sum(-1).unsqueeze(-1) for i, j in ((0, 0), (0, 1), (1, 1))
    )
    x, y = _NORMAL.to(nn).unbind(-1)
    first = nn.clamp_min(1e-12).rsqrt()  # N = L L^T; the points solve L^T d = normal
    below = ne * first
    second = (ee - below * below).clamp_min(1e-12).rsqrt()
    east = second * y
    north = first * (x - below * east)
    return (torch.hypot(north, east) * DISTANCE_SCALE_KM <= radius_km).to(variance.dtype).mean(-1)
