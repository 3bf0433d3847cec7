"""Posterior of the way to the place where a field has given values: weighted points in place of one normal.

Where gradients are uncertain, the posterior has long tails and may have several maxima: across the track a small
gradient and a long way explain the same difference as a large gradient and a short way. The normal approximation of
:func:`~magrl.tracking.way_to` is then too sure of itself.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from magrl.checks import check_number
from magrl.tracking.filter import (
    DISTANCE_SCALE_KM,
    ELEMENT_SCALES,
    FieldTrack,
    PerElement,
    _nonnegative_or_nan,
    _units,
    continued,
)
from magrl.tracking.way import Way, way_to

_NEAR_KM, _FAR_KM = 4.0, 2000.0  # distances between which the points around the vehicle thin out
_SPREAD = 1.5  # standard deviations of the points around the estimated way, over those of the way
_LEAST_VARIANCE = 1e-8  # of a remaining difference, in squared scaled units
_LEAST_AREA = 1e-6  # of the points around the way, in squared scaled units: a standard deviation of 0.1 km
_LEAST_SHARE = 1e-6  # of a variance, left by a relation


class WayPosterior(NamedTuple):
    """Displacements ``(..., M, 2)`` northward and eastward [km] and their probabilities ``(..., M)``.

    Example:
        >>> posterior = WayPosterior(torch.tensor([[0.0, 10.0], [0.0, 30.0]]), torch.tensor([0.25, 0.75]))
        >>> posterior.way().displacement, posterior.within(25.0)
        (tensor([ 0., 25.]), tensor(0.2500))
    """

    points: Tensor
    weights: Tensor

    def way(self) -> Way:
        """Return the mean and the covariance."""
        mean = (self.points * self.weights.unsqueeze(-1)).sum(-2)
        apart = self.points - mean.unsqueeze(-2)
        products = apart.unsqueeze(-1) * apart.unsqueeze(-2)
        return Way(mean, (products * self.weights[..., None, None]).sum(-3))

    def within(self, radius_km: float) -> Tensor:
        """Return the probability ``(...)`` that the place is within a radius [km] of the vehicle."""
        check_number(0, above=True, radius_km=radius_km)
        return (self.weights * (self.points.norm(dim=-1) <= radius_km)).sum(-1)

    def radius(self, probability: float) -> Tensor:
        """Return the least radius ``(...)`` [km] around the vehicle that holds the place with a probability.

        Example:
            >>> points = torch.tensor([[0.0, 30.0], [0.0, 10.0]])
            >>> WayPosterior(points, torch.tensor([0.25, 0.75])).radius(0.7)
            tensor(10.)
        """
        check_number(0, 1, probability=probability)
        distance, order = self.points.norm(dim=-1).sort(-1)
        held = self.weights.gather(-1, order).cumsum(-1)
        first = (held < probability).sum(-1, keepdim=True).clamp_max(held.shape[-1] - 1)
        return distance.gather(-1, first).squeeze(-1)


def way_posterior(
    track: FieldTrack,
    target: Tensor,
    range_km: float,
    scales: PerElement = ELEMENT_SCALES,
    shared: Tensor | None = None,
    bias_std: PerElement | None = None,
    periods: PerElement | None = None,
    curvature: PerElement | None = None,
) -> WayPosterior:
    """Return the posterior of the displacement to the place where the field has given values.

    Its density is ``|S(d)|^-1/2 exp(-1/2 ((r - g·d)^T S(d)^-1 (r - g·d) + |d|^2 / range^2))``, in the notation of
    :func:`~magrl.tracking.way_to`. It is exact for the filter's normal state. The points are 128 around the way of
    :func:`~magrl.tracking.way_to` and 384 around the vehicle, weighted by the density over that of the points.

    Args:
        track: state.
        target: ``(..., E)`` values at the place, in the element's unit.
        range_km: prior standard deviation of the way along each axis [km].
        scales: those of :func:`~magrl.tracking.start`.
        shared: ``(..., E, 3)`` from :func:`~magrl.tracking.relate`; without it, the elements are independent.
        bias_std: standard deviation of a constant error of the readings, ``(..., E)`` or E numbers.
        periods: of angles, whose remaining differences are wrapped; None for none.
        curvature: standard deviation of the change of a gradient along the way, as in :func:`~magrl.tracking.predict`:
            it adds ``c^2 |d|^4 / 4`` to S(d). None for constant gradients.

    Raises:
        ValueError: for shapes that do not match, a range that is not above 0, or a negative standard deviation.

    Source:
        A. B. Owen and Y. Zhou, Safe and effective importance sampling, Journal of the American Statistical Association
        95 (2000): weights for points of several densities.

    Example:
        >>> gradient = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 2.0]])  # the first element grows northward
        >>> track = FieldTrack(gradient, 1e-4 * torch.eye(3).expand(2, 3, 3))
        >>> way_posterior(track, torch.tensor([3.0, 4.0]), 1000.0, scales=(1.0, 1.0)).way().displacement.round()
        tensor([300., 200.])
    """
    way = way_to(track, target, range_km, scales, shared, bias_std, periods, curvature)
    points, density = _points(Way(way.displacement / DISTANCE_SCALE_KM, way.covariance / DISTANCE_SCALE_KM**2))
    unit = _units(track, scales)
    count, none = unit.shape[-1], (0.0,) * unit.shape[-1]
    bias = _nonnegative_or_nan("bias_std", none if bias_std is None else bias_std, count, unit) / unit
    bend = _nonnegative_or_nan("curvature", none if curvature is None else curvature, count, unit) / unit
    target = target if periods is None else continued(target, track, scales, periods)

    # (..., E, M) from here on
    value, gn, ge = (track.mean[..., i, None] for i in range(3))
    p00, p01, p02, p11, p12, p22 = (
        track.covariance[..., i, j, None] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    )
    dn, de = (x.unsqueeze(-2) for x in points.unbind(-1))
    square = dn * dn + de * de
    residual = (target.to(unit.dtype) / unit).unsqueeze(-1) - value - gn * dn - ge * de
    variance = p00 + dn * (2 * p01 + p11 * dn + 2 * p12 * de) + de * (2 * p02 + p22 * de)
    variance = variance + bias.square().unsqueeze(-1) + bend.square().unsqueeze(-1) * (square * square / 4)
    variance = variance.clamp_min(_LEAST_VARIANCE)
    exponent = (residual.square() / variance + variance.log()).sum(-2)
    if shared is not None:
        u0, u1, u2 = (shared[..., i, None] for i in range(3))
        together = u0 + u1 * dn + u2 * de
        left = (1 - (together.square() / variance).sum(-2)).clamp_min(_LEAST_SHARE)
        exponent = exponent + (residual * together / variance).sum(-2).square() / left + left.log()
    exponent = exponent + square.squeeze(-2) * (DISTANCE_SCALE_KM / range_km) ** 2
    return WayPosterior(points * DISTANCE_SCALE_KM, torch.softmax(-exponent / 2 - density.log(), -1))


def _points(way: Way) -> tuple[Tensor, Tensor]:
    """Return points ``(..., M, 2)`` around a way and the vehicle, and their density ``(..., M)``, unnormalized."""
    center, covariance = way.displacement.unsqueeze(-2), way.covariance * _SPREAD**2
    first = covariance[..., 0, 0].clamp_min(_LEAST_AREA).sqrt().unsqueeze(-1)  # Cholesky factor
    below = covariance[..., 0, 1].unsqueeze(-1) / first
    second = (covariance[..., 1, 1].unsqueeze(-1) - below * below).clamp_min(_LEAST_AREA).sqrt()
    normal, around = _NORMAL.to(center), _AROUND.to(center)
    x, y = normal.unbind(-1)
    near = center + torch.stack((first * x, below * x + second * y), -1)
    points = torch.cat((near, around.expand(*near.shape[:-2], *around.shape)), -2)
    dn, de = (points - center).unbind(-1)
    z0 = dn / first
    z1 = (de - below * z0) / second
    bell = torch.exp(-(z0 * z0 + z1 * z1) / 2) * (len(normal) / (2 * math.pi)) / (first * second)
    nearest = (_NEAR_KM / DISTANCE_SCALE_KM) ** 2
    return points, bell + _AROUND_DENSITY / points.square().sum(-1).clamp_min(nearest)


def _sobol(count: int, seed: int) -> Tensor:
    """Return quasi-random points ``(count, 2)`` between 0 and 1."""
    return torch.quasirandom.SobolEngine(2, scramble=True, seed=seed).draw(count, dtype=torch.float64)


def _around(count: int) -> Tensor:
    """Return points ``(count, 2)`` around the vehicle in scaled units.

    Their density is that of the inverse square of the distance, and constant within the nearest.
    """
    share, turn = _sobol(count, seed=1).unbind(-1)
    beyond, bearing = share * _MASS - 0.5, 2 * math.pi * turn
    radius = torch.where(beyond < 0, (2 * beyond + 1).clamp_min(0).sqrt(), torch.exp(beyond))
    return _NEAR_KM / DISTANCE_SCALE_KM * torch.stack((radius * torch.cos(bearing), radius * torch.sin(bearing)), -1)


_MASS = 0.5 + math.log(_FAR_KM / _NEAR_KM)  # of the density within the nearest distance and beyond, over 2 pi
_NORMAL = torch.special.ndtri(_sobol(128, seed=0).clamp(1e-6, 1 - 1e-6))  # standard normal
_AROUND = _around(384)
_AROUND_DENSITY = len(_AROUND) / (2 * math.pi * _MASS)
