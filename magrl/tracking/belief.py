"""How well readings fit the track, what this says of their noise, and how steep the field may be."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from magrl.checks import check_tensor
from magrl.tracking.filter import (
    ELEMENT_PERIODS,
    ELEMENT_SCALES,
    VARIANCE_FLOOR,
    FieldTrack,
    PerElement,
    _units,
    _variance,
    continued,
    estimated_field,
    predict,
)
from magrl.tracking.planning import MISSING_KM, SLOPES
from magrl.tracking.priors import field_curvature
from magrl.tracking.track import reading_std

# Chosen on random planets.
SHEET_READINGS = 4.0
"""Number of readings that count as much as the data sheet, where its noise is estimated."""
SHARED = 0.5
"""Weight of an element's readings in the estimates of the other elements."""
DEAD_BAND = 0.4
"""Deviation of the logarithm of the variance up to which the data sheet is kept; beyond, it is subtracted."""
LARGEST_SCORE = 8.0
"""Largest evidence of one element in a reading, that of three standard deviations: a spike counts no more."""
LARGEST_RATIO = 64.0
"""Largest ratio of the variances: with the dead band, the standard deviation is scaled by at most 6.5."""


class NoiseEstimate(NamedTuple):
    """Logarithm ``(..., E)`` of the variance of the noise over that of the data sheet, and the effective number
    ``(..., E)`` of readings from which it is known.

    Example:
        >>> NoiseEstimate(torch.tensor([0.3, 1.8]), torch.tensor([9.0, 9.0])).factor.round(decimals=2)
        tensor([1.0000, 2.0100])
    """

    log_ratio: Tensor
    readings: Tensor

    @property
    def factor(self) -> Tensor:
        """Factor ``(..., E)`` of the standard deviation on the data sheet; 1 within :data:`DEAD_BAND`."""
        beyond = (self.log_ratio.abs() - DEAD_BAND).clamp_min(0)
        return (self.log_ratio.sign() * beyond / 2).exp()


def noise_estimate(
    before: NoiseEstimate,
    track: FieldTrack,
    displacement: Tensor,
    reading: Tensor,
    sensor_std: Tensor,
    drift_std: Tensor,
) -> NoiseEstimate:
    """Return the estimate of the noise of D, I, B_H after another reading.

    With the variance ``S = P + R + slow errors`` of the innovation ν, ``ν^2 / S - 1`` is 0 on average where R, with the
    estimate so far, is right. The logarithm of R moves by it with the weight ``(R / S)^2``, over the sum of these
    weights and of :data:`SHEET_READINGS`: an innovation that comes from an unknown gradient says little of the noise.
    Elements share a part of the evidence (:data:`SHARED`), as a data sheet is often wrong for all of them. An element
    without noise, or with so much that its reading is missing (:data:`~magrl.tracking.planning.MISSING_KM`), gives no
    evidence.

    Args:
        before: estimate before the reading; zeros at the start.
        track: state of the filter before the move.
        displacement: ``(..., 2)`` northward and eastward [km].
        reading: ``(..., 3)`` at its end.
        sensor_std: ``(..., 3)`` standard deviations of its noise on the data sheet.
        drift_std: ``(..., 3)`` those of slow errors.

    Raises:
        ValueError: for shapes that do not match.

    Source:
        R. K. Mehra, On the identification of variances and adaptive Kalman filtering, IEEE Transactions on Automatic
        Control 15 (1970): noise from innovations, here recursively and for one track.

    Example:
        >>> track = FieldTrack(torch.zeros(3, 3), torch.zeros(3, 3, 3))
        >>> none, std = torch.zeros(3), torch.tensor([0.3, 1.5, 100.0])
        >>> reading = torch.tensor([0.6, 1.5, 100.0])  # D deviates by two standard deviations
        >>> noise_estimate(NoiseEstimate(none, none), track, torch.zeros(2), reading, std, none)
        NoiseEstimate(log_ratio=tensor([0.5000, 0.2500, 0.2500]), readings=tensor([2., 2., 2.]))
    """
    check_tensor(3, reading=reading, sensor_std=sensor_std, drift_std=drift_std)
    innovation, variance, unit = _innovation(track, displacement, reading, ELEMENT_SCALES)
    noise = (sensor_std / unit).square() * before.log_ratio.exp()
    slow = reading_std(torch.zeros_like(drift_std), drift_std) / unit
    total = variance + noise + slow.square()
    known = (sensor_std > 0) & (sensor_std / sensor_std.new_tensor(SLOPES) < MISSING_KM)
    weight = torch.where(known, noise / total, 0.0).square()
    score = (weight * (innovation.square() / total - 1)).clamp_max(LARGEST_SCORE).where(known, 0.0)
    score, weight = (SHARED * x.sum(-1, keepdim=True) + (1 - SHARED) * x for x in (score, weight))
    readings = before.readings + weight
    limit = math.log(LARGEST_RATIO)
    log_ratio = before.log_ratio + score / (SHEET_READINGS + readings)
    return NoiseEstimate(log_ratio.clamp(-limit, limit), readings)


def surprise(
    track: FieldTrack,
    displacement: Tensor,
    reading: Tensor,
    sensor_std: PerElement,
    scales: PerElement = ELEMENT_SCALES,
) -> float:
    """Return the mean over D, I, B_H of the squared innovation of a reading over its variance S.

    It is 1 on average where the filter is right. The noise has the floor :data:`~magrl.tracking.VARIANCE_FLOOR`.

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
    innovation, variance, unit = _innovation(track, displacement, reading, scales)
    usual = _units(track, ELEMENT_SCALES)
    noise = _variance(sensor_std, usual).clamp_min(VARIANCE_FLOOR)
    return (innovation.square() / (variance + noise * (usual / unit).square())).mean().item()


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


def _innovation(
    track: FieldTrack, displacement: Tensor, reading: Tensor, scales: PerElement
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the innovation ``(..., E)`` of a reading, the variance of its prediction, and the units of both."""
    predicted = predict(track, displacement, field_curvature(estimated_field(track, scales)), scales)
    unit = _units(predicted, scales)
    innovation = continued(reading, predicted, scales, ELEMENT_PERIODS) / unit - predicted.mean[..., 0]
    return innovation, predicted.covariance[..., 0, 0], unit
