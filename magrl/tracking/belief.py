"""Reliability of the filter's estimates: probabilities of arrival, and how well a reading fits the track.

Probabilities are means over a fixed set of 1024 quasi-random points of the normal distribution, so that equal estimates
have equal probabilities.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import torch
from torch import Tensor

from magrl.checks import check_number, check_numbers, check_tensor
from magrl.field.elements import element_difference
from magrl.tracking.filter import (
    ELEMENT_PERIODS,
    ELEMENT_SCALES,
    FieldTrack,
    PerElement,
    _units,
    _variance,
    continued,
    estimated_field,
    predict,
)
from magrl.tracking.priors import field_curvature
from magrl.tracking.search import arrival_weights

_POINTS = 1024


@cache
def _normal() -> Tensor:
    """Points of the standard normal distribution in three dimensions, ``(1024, 3)``."""
    points = torch.quasirandom.SobolEngine(3, scramble=True, seed=0).draw(_POINTS, dtype=torch.float64)
    return torch.special.ndtri(points.clamp(1e-6, 1 - 1e-6))


def probability_below(
    first: Sequence[float], target: Sequence[float], estimate: Sequence[float], std: Sequence[float], zeta: float
) -> float:
    """Return the probability that the objective F (Eq. 2-6) is below a threshold, for independent normal errors.

    Args:
        first: D [deg], I [deg], B_H [nT] where the way began.
        target: the same at the destination.
        estimate: the same at the vehicle, as estimated.
        std: standard deviations of the errors of the estimate.
        zeta: threshold.

    Example:
        >>> first, target = (0.0, 60.0, 20000.0), (10.0, 60.0, 20000.0)
        >>> probability_below(first, target, (9.0, 60.0, 20000.0), (0.5, 0.0, 0.0), 0.01)
        0.5
    """
    check_numbers(3, first=first, target=target, estimate=estimate, std=std)
    check_number(0, above=True, zeta=zeta)
    start, end, here, deviation = torch.tensor((first, target, estimate, std), dtype=torch.float64)
    ends = element_difference(end, here) + deviation * _normal()
    return (ends.square() @ arrival_weights(start, end, zeta) < 1).double().mean().item()


def probability_within(way: Tensor, covariance: Tensor, radius_km: float) -> float:
    """Return the probability that the destination is within a radius, for a normal error of the way to it.

    Args:
        way: ``(2,)`` estimated way [km].
        covariance: ``(2, 2)`` its covariance [km^2].
        radius_km: radius [km].

    Example:
        >>> probability_within(torch.tensor([3.0, 4.0]), 1e-6 * torch.eye(2), 6.0)
        1.0
    """
    check_tensor(2, way=way)
    check_tensor(2, 2, covariance=covariance)
    check_number(0, above=True, radius_km=radius_km)
    values, axes = torch.linalg.eigh(covariance.double())
    ends = way.double() + (_normal()[:, :2].to(way.device) * values.clamp_min(0).sqrt()) @ axes.mT
    return (ends.norm(dim=-1) <= radius_km).double().mean().item()


def surprise(
    track: FieldTrack,
    displacement: Tensor,
    reading: Tensor,
    sensor_std: PerElement,
    scales: PerElement = ELEMENT_SCALES,
) -> float:
    """Return the mean over D, I, B_H of the squared innovation of a reading over its variance S.

    It is 1 on average where the filter is right. The noise has the floor of :data:`~magrl.tracking.ELEMENT_SCALES`,
    whatever the scales are.

    Args:
        track: state of one vehicle before the move.
        displacement: ``(2,)`` northward and eastward [km].
        reading: ``(3,)`` at its end.
        sensor_std: standard deviations of its noise, as in :func:`~magrl.tracking.update`.
        scales: those of :func:`~magrl.tracking.start`.

    Example:
        >>> track = FieldTrack(torch.zeros(3, 3), 3.0 * torch.eye(3).expand(3, 3, 3))
        >>> surprise(track, torch.zeros(2), torch.tensor([0.0, 6.0, 0.0]), (0.3, 1.5, 100.0))  # 4^2 over 3 + 1, and 0
        1.3333333333333333
    """
    track = FieldTrack(*(tensor.double() for tensor in track))
    curvature = field_curvature(estimated_field(track, scales))
    predicted = predict(track, displacement, curvature, scales)
    unit, usual = _units(predicted, scales), _units(predicted, ELEMENT_SCALES)
    innovation = continued(reading, predicted, scales, ELEMENT_PERIODS) / unit - predicted.mean[:, 0]
    variance = predicted.covariance[:, 0, 0] + _variance(sensor_std, usual) * (usual / unit).square()
    return (innovation.square() / variance).mean().item()


def steepest(track: FieldTrack, element: int, scales: PerElement = ELEMENT_SCALES) -> float:
    """Return the greatest gradient that an element may have: the estimate and two standard deviations.

    Args:
        track: state of one vehicle.
        element: number of the element.
        scales: those of :func:`~magrl.tracking.start`.

    Returns:
        Gradient [element unit / 100 km].

    Example:
        >>> track = FieldTrack(torch.tensor([[0.0, 3.0, 4.0]]), torch.eye(3).unsqueeze(0))
        >>> steepest(track, 0, scales=(1.0,))
        7.0
    """
    largest = torch.linalg.eigvalsh(track.covariance[element, 1:, 1:].double())[-1].clamp_min(0).sqrt()
    return ((track.mean[element, 1:].norm() + 2 * largest) * _units(track, scales)[element]).item()
