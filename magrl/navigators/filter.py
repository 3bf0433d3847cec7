"""Kalman filter of elements and their gradients along a dead-reckoned track, each element by itself.

A quasi-Newton navigator needs no model of the field. Each element has three states, its value e at the vehicle and its
gradient (g_N, g_E): a move by d changes the value by g·d, and a reading corrects the value and, by their covariance,
the gradient. All functions batch over leading dimensions and take any number of elements E.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from magrl.checks import check_number, check_tensor
from magrl.tracking import Way
from magrl.tracking.local import inverse2

CURVATURE = (1.5e-6, 1.8e-6, 1.2e-3)
"""Standard deviation of the change of a gradient along the way: D, I [deg], B_H [nT], per km^2, typical of the Earth's
field. The error of a linear step grows with it."""
PERIODS = (360.0, 0.0, 0.0)
"""Period of D, I [deg], B_H [nT] in readings; 0 for elements that are not wrapped."""
ROUNDING = 1e-7
"""Relative rounding of a reading in float32, its least standard deviation."""


class FieldTrack(NamedTuple):
    """Mean ``(..., E, 3)`` of value and gradient northward and eastward [per km], and covariance ``(..., E, 3, 3)``.

    Example:
        >>> track = FieldTrack(torch.zeros(5, 3, 3), torch.eye(3).expand(5, 3, 3, 3))
        >>> track.mean.shape
        torch.Size([5, 3, 3])
    """

    mean: Tensor
    covariance: Tensor


class GradientPrior(NamedTuple):
    """Expected gradient ``(..., E, 2)`` northward and eastward [element unit / km], and its standard deviations.

    Example:
        >>> GradientPrior(torch.zeros(3, 2), torch.ones(3, 2)).std.shape
        torch.Size([3, 2])
    """

    gradient: Tensor
    std: Tensor


def start(reading: Tensor, prior: GradientPrior, sensor_std: Tensor) -> FieldTrack:
    """Return the state after the first reading.

    Args:
        reading: ``(..., E)`` first reading.
        prior: expected gradient.
        sensor_std: ``(..., E)`` standard deviations of the noise.

    Example:
        >>> prior = GradientPrior(torch.zeros(3, 2), torch.ones(3, 2))
        >>> start(torch.tensor([8.0, -16.0, 35000.0]), prior, torch.ones(3)).covariance.shape
        torch.Size([3, 3, 3])
    """
    check_tensor(2, gradient=prior.gradient)
    gradient = prior.gradient.expand(*reading.shape, 2).to(reading)
    variance = torch.cat((_std(reading, sensor_std).unsqueeze(-1), prior.std.expand_as(gradient).to(reading)), -1)
    return FieldTrack(torch.cat((reading.unsqueeze(-1), gradient), -1), torch.diag_embed(variance.square()))


def read(
    track: FieldTrack, displacement: Tensor, reading: Tensor, sensor_std: Tensor, curvature: Tensor, periods: Tensor
) -> FieldTrack:
    """Return the state after a move and the reading at its end.

    The gradient drifts with the way: with the curvature c, its variance grows by ``c^2 |d|^2``, that of the value by
    ``c^2 |d|^4 / 4``, and their covariance by ``c^2 |d|^2 d / 2``.

    Args:
        track: state before the move.
        displacement: ``(..., 2)`` northward and eastward [km].
        reading: ``(..., E)``.
        sensor_std: ``(..., E)`` standard deviations of its noise.
        curvature: ``(E,)`` see :data:`CURVATURE`.
        periods: ``(E,)`` see :data:`PERIODS`.

    Example:
        >>> track = FieldTrack(torch.tensor([[0.0, 1.0, 0.0]]), torch.diag_embed(torch.ones(1, 3)))
        >>> none, move = torch.zeros(1), torch.tensor([2.0, 0.0])
        >>> read(track, move, torch.tensor([2.0]), none, none, none).mean  # as expected
        tensor([[2., 1., 0.]])
    """
    check_tensor(2, displacement=displacement)
    move = displacement.unsqueeze(-2).to(track.mean)
    step = torch.eye(3).to(move).expand(*move.shape[:-1], 3, 3).clone()
    step[..., 0, 1:] = move
    lever = torch.cat((move.unsqueeze(-2) / 2, torch.eye(2).to(move).expand(*move.shape[:-1], 2, 2)), -2)
    drift = (curvature.square() * move.square().sum(-1))[..., None, None] * lever @ lever.mT
    mean = (step @ track.mean.unsqueeze(-1)).squeeze(-1)
    covariance = step @ track.covariance @ step.mT + drift
    cross = covariance[..., 0]
    gain = cross / (cross[..., :1] + _std(reading, sensor_std).square().unsqueeze(-1))
    mean = mean + gain * wrapped(reading - mean[..., 0], periods).unsqueeze(-1)
    return FieldTrack(mean, covariance - gain.unsqueeze(-1) * cross.unsqueeze(-2))


def way_to(
    track: FieldTrack, target: Tensor, range_km: float, bias_std: Tensor, curvature: Tensor, periods: Tensor
) -> Way:
    """Return the displacement to the place where the field has given values, and its covariance.

    It minimizes ``(r - g·d)^T S(d)^-1 (r - g·d) + |d|^2 / range^2``, with the remaining differences r and their
    variances S(d), in three solves; the first has the mean of S over ways of the range.

    Args:
        track: state.
        target: ``(..., E)`` values at the destination.
        range_km: prior standard deviation of the way along each axis [km].
        bias_std: ``(..., E)`` standard deviations of a constant error of the readings, which gradients do not have.
        curvature: ``(E,)`` see :data:`CURVATURE`: it adds ``c^2 |d|^4 / 4`` to S(d).
        periods: ``(E,)`` see :data:`PERIODS`.

    Example:
        >>> gradient = torch.tensor([[0.0, 0.01, 0.0], [0.0, 0.0, 0.02]])  # the first element grows northward
        >>> track, none = FieldTrack(gradient, 1e-10 * torch.eye(3).expand(2, 3, 3)), torch.zeros(2)
        >>> way_to(track, torch.tensor([3.0, 4.0]), 1000.0, none, none, none).displacement.round()
        tensor([300., 200.])
    """
    check_number(0, above=True, range_km=range_km)
    slopes, eye = track.mean[..., 1:], torch.eye(2).to(track.mean)
    left = wrapped(target.to(slopes) - track.mean[..., 0], periods)
    value = track.covariance[..., 0, 0] + bias_std.to(slopes).square()
    spread = track.covariance[..., 1:, 1:]
    variance = value + range_km**2 * spread.diagonal(dim1=-2, dim2=-1).sum(-1) + 2 * (curvature * range_km**2).square()
    for _ in range(3):
        weighted = slopes / variance.clamp_min(1e-16).unsqueeze(-1)
        covariance = inverse2(weighted.mT @ slopes + eye / range_km**2)
        way = (covariance @ weighted.mT @ left.unsqueeze(-1)).squeeze(-1)
        ahead = torch.cat((torch.ones_like(way[..., :1]), way), -1)[..., None, :, None]
        variance = (ahead.mT @ track.covariance @ ahead).squeeze((-1, -2)) + bias_std.to(slopes).square()
        variance = variance + (curvature * way.square().sum(-1, keepdim=True) / 2).square()
    return Way(way, covariance)


def wrapped(difference: Tensor, periods: Tensor) -> Tensor:
    """Return differences ``(..., E)`` of elements, those with a period within half of it.

    Example:
        >>> wrapped(torch.tensor([350.0, 350.0]), torch.tensor([360.0, 0.0]))
        tensor([-10., 350.])
    """
    return difference - periods * torch.round(difference / torch.where(periods > 0, periods, math.inf))


def _std(reading: Tensor, sensor_std: Tensor) -> Tensor:
    """Return the standard deviation of a reading, not below its rounding."""
    return torch.maximum(sensor_std.to(reading), reading.abs() * ROUNDING)
