"""Reliability of the filter's estimates: probabilities of arrival, and how well a reading fits the track.

Probabilities are means over a fixed set of 1024 quasi-random points of the normal distribution, so that equal estimates
have equal probabilities.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

import torch
from torch import Tensor

from magrl import guidance
from magrl.checks import check_number, check_numbers, check_tensor
from magrl.tracking.filter import ELEMENT_SCALES, VARIANCE_FLOOR, FieldTrack, check_track

_POINTS = 1024
_FARTHEST = 4.8  # absolute value of a point, at most
_LEAST_SHARE = 1e-6  # of the noise in the variance of a prediction


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
    at_first, remaining = ([t - e for t, e in zip(target, here, strict=True)] for here in (first, estimate))
    for difference in (at_first, remaining):
        difference[0] = math.remainder(difference[0], 360)
    weights = [max(abs(d), least) ** -2 for d, least in zip(at_first, guidance.OBJECTIVE_FLOORS, strict=True)]
    nearest = [max(abs(r) - _FARTHEST * s, 0.0) for r, s in zip(remaining, std, strict=True)]
    if sum(w * r * r for w, r in zip(weights, nearest, strict=True)) >= zeta:
        return 0.0  # as the points below would say, in a tenth of the time
    left, deviation, weight = torch.tensor((remaining, std, weights), dtype=torch.float64)
    return ((left + deviation * _normal()).square() @ weight < zeta).double().mean().item()


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
    track: FieldTrack, reading: Sequence[float], noise_std: Sequence[float], scales: Sequence[float] = ELEMENT_SCALES
) -> float:
    """Return the mean square of a reading's deviation from its prediction, over the variance of that deviation.

    It is 1 on average where the filter is right. It follows from the state after the reading: the deviation from it is
    that from the prediction times the share of the noise in the variance.

    Args:
        track: state of one vehicle after the reading.
        reading: of E elements, in their units; angles within half a turn of the estimate.
        noise_std: standard deviations of its noise, as in :func:`~magrl.tracking.update`.
        scales: those of :func:`~magrl.tracking.start`.

    Example:
        >>> from magrl.tracking import update
        >>> before = FieldTrack(torch.zeros(1, 3), 3.0 * torch.eye(3).unsqueeze(0))
        >>> after = update(before, torch.tensor([4.0]), noise_std=(1.0,), scales=(1.0,))
        >>> surprise(after, (4.0,), (1.0,), (1.0,))  # 4^2 over 3 + 1
        4.0
    """
    count = check_track(track)
    check_numbers(count, reading=reading, noise_std=noise_std, scales=scales)
    squares = []
    known = zip(reading, noise_std, scales, track.mean[:, 0].tolist(), track.covariance[:, 0, 0].tolist(), strict=True)
    for read, std, unit, value, variance in known:
        noise = max((std / unit) ** 2, VARIANCE_FLOOR)
        share = max(1 - variance / noise, _LEAST_SHARE)
        squares.append((read / unit - value) ** 2 / (share * noise))
    return sum(squares) / count


def steepest(track: FieldTrack, element: int, scales: Sequence[float] = ELEMENT_SCALES) -> float:
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
    check_numbers(check_track(track), scales=scales)
    covariance = track.covariance[element, 1:, 1:]
    largest = torch.linalg.eigvalsh(covariance.double())[-1].clamp_min(0).sqrt()
    return (track.mean[element, 1:].norm() + 2 * largest).item() * scales[element]
