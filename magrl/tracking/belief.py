"""How well a reading fits the track, and how steep the field may be."""

from __future__ import annotations

import torch
from torch import Tensor

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
from magrl.tracking.priors import field_curvature


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
    curvature = field_curvature(estimated_field(track, scales))
    predicted = predict(track, displacement, curvature, scales)
    unit, usual = _units(predicted, scales), _units(predicted, ELEMENT_SCALES)
    innovation = continued(reading, predicted, scales, ELEMENT_PERIODS) / unit - predicted.mean[:, 0]
    noise = _variance(sensor_std, usual).clamp_min(VARIANCE_FLOOR)
    variance = predicted.covariance[:, 0, 0] + noise * (usual / unit).square()
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
