"""Posterior of the way to the place where a field has given values: weighted points in place of one normal.

Where gradients are uncertain, the posterior has long tails and may have several maxima: across the track a small
gradient and a long way explain the same difference as a large gradient and a short way. The normal approximation of
:func:`~magrl.tracking.way_to` is then too sure of itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
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

_AT_ONCE = 13  # moves whose distances to all points are held at once
_NEAR_KM, _FAR_KM = 4.0, 2000.0  # distances between which the points around the vehicle thin out
_SPREAD = 1.5  # standard deviations of the points around the estimated way, over those of the way
_UNSURE = 4  # weight of the variance of the likeliest way in its share of the aim
_LEAST_VARIANCE = 1e-8  # of a remaining difference, in squared scaled units
_LEAST_AREA = 1e-6  # of the points around the way, in squared scaled units: a standard deviation of 0.1 km
_LEAST_SHARE = 1e-6  # of a variance, left by a relation
_LEAST_WEIGHT = 1e-12  # below, products of weights would be denormal numbers, which are slow


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
        north, east = apart.unbind(-1)
        nn, ne, ee = ((self.weights * product).sum(-1) for product in (north * north, north * east, east * east))
        return Way(mean, torch.stack((nn, ne, ne, ee), -1).unflatten(-1, (2, 2)))

    def aim(self, likeliest: Way) -> Way:
        """Return the way to aim at: between the mean and the likeliest way, the nearer to the latter the surer it is.

        The share of the likeliest way d of covariance C is ``|d|^2 / (|d|^2 + 4 tr C)``. Where the posterior has two
        maxima, its mean lies between them, and no move makes progress there. The covariance is that of the posterior.

        Args:
            likeliest: that of :func:`~magrl.tracking.way_to`, ``(..., 2)`` and ``(..., 2, 2)``.

        Example:
            >>> posterior = WayPosterior(torch.tensor([[0.0, 10.0], [0.0, 30.0]]), torch.tensor([0.25, 0.75]))
            >>> posterior.aim(Way(torch.tensor([0.0, 30.0]), 50 * torch.eye(2))).displacement.round(decimals=1)
            tensor([ 0.0000, 28.5000])
        """
        mean, covariance = self.way()
        square = likeliest.displacement.square().sum(-1, keepdim=True)
        variance = likeliest.covariance.diagonal(dim1=-2, dim2=-1).sum(-1, keepdim=True)
        share = square / (square + _UNSURE * variance).clamp_min(1e-6)
        return Way(mean + share * (likeliest.displacement - mean), covariance)

    def mean_distance(self, moves: Tensor) -> Tensor:
        """Return the mean distances ``(..., K)`` [km] of the place after moves ``(..., K, 2)`` [km], as float32.

        Example:
            >>> posterior = WayPosterior(torch.tensor([[30.0, 0.0], [0.0, 40.0]]), torch.tensor([0.5, 0.5]))
            >>> posterior.mean_distance(torch.tensor([[0.0, 0.0], [30.0, 0.0]])).round()
            tensor([35., 25.])
        """
        points, moves = self.points.float(), moves.float()
        # |d - m|^2 as one matrix product, with 0.01 km^2 for its rounding
        left = torch.cat((moves, moves.square().sum(-1, keepdim=True) + 0.01, torch.ones_like(moves[..., :1])), -1)
        right = torch.cat((-2 * points, torch.ones_like(points[..., :1]), points.square().sum(-1, keepdim=True)), -1)
        weights = self.weights.float().unsqueeze(-1)
        parts = [((some @ right.mT).sqrt_() @ weights).squeeze(-1) for some in left.split(_AT_ONCE, -2)]
        return torch.cat(parts, -1)

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
    common: Tensor | None = None,
    fine: bool = True,
) -> WayPosterior:
    """Return the posterior of the displacement to the place where the field has given values.

    Its density is ``|S(d)|^-1/2 exp(-1/2 ((r - g·d)^T S(d)^-1 (r - g·d) + |d|^2 / range^2))``, in the notation of
    :func:`~magrl.tracking.way_to`. It is exact for the filter's normal state. A quarter of the points are around the
    way of :func:`~magrl.tracking.way_to`, the others around the vehicle, weighted by the density over that of the
    points.

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
        common: ``(..., E)`` from :func:`~magrl.tracking.common_error`, how constant errors are correlated; without it,
            they are independent.
        fine: whether there are 512 points, as probabilities need, or 256 in single precision, which suffice for means.

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
    dtype, unit_points = (way.displacement.dtype, _FINE) if fine else (torch.float32, _COARSE)
    center, spread = way.displacement / DISTANCE_SCALE_KM, way.covariance / DISTANCE_SCALE_KM**2
    points, density = _points(Way(center.to(dtype), spread.to(dtype)), unit_points)
    unit = _units(track, scales)
    elements, none = unit.shape[-1], (0.0,) * unit.shape[-1]
    bias = _nonnegative_or_nan("bias_std", none if bias_std is None else bias_std, elements, unit) / unit
    bend = _nonnegative_or_nan("curvature", none if curvature is None else curvature, elements, unit) / unit
    target = target if periods is None else continued(target, track, scales, periods)
    remaining = target.to(unit.dtype) / unit
    alike = None if common is None else bias * common.to(unit.dtype)
    own = bias.square() if alike is None else bias.square() - alike.square()
    rows = _polynomials(track, remaining, own, bend.square() / 4, shared).to(dtype)
    dn, de = points.unbind(-1)
    square = dn * dn + de * de
    powers = torch.stack((torch.ones_like(dn), dn, de, dn * dn, dn * de, de * de, square * square), -2)
    residual, variance, *together = (rows @ powers).split(elements, -2)  # (..., E, M) each
    alike = None if alike is None else alike.to(dtype).unsqueeze(-1)
    exponent, volume = _misfit(residual, variance.clamp_min(_LEAST_VARIANCE), alike, together)
    exponent = exponent + square * (DISTANCE_SCALE_KM / range_km) ** 2
    weights = torch.softmax(-exponent / 2 - volume.log() / 2 - density.log(), -1)
    return WayPosterior(points * DISTANCE_SCALE_KM, weights.where(weights > _LEAST_WEIGHT, 0.0))


def _polynomials(track: FieldTrack, target: Tensor, bias: Tensor, bend: Tensor, shared: Tensor | None) -> Tensor:
    """Return coefficients ``(..., K, 7)`` of 1, n, e, n^2, n e, e^2 and (n^2 + e^2)^2 for displacements (n, e).

    They give the residual r - g·d of each element, its variance, and what the elements share; in scaled units.
    """
    value, north, east = track.mean.unbind(-1)
    p00, p01, p02, p11, p12, p22 = (
        track.covariance[..., i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    )
    zero = torch.zeros_like(value)
    rows: list[tuple[Tensor, ...]] = [
        (target - value, -north, -east, zero, zero, zero, zero),
        (p00 + bias, 2 * p01, 2 * p02, p11, 2 * p12, p22, bend),
    ]
    if shared is not None:
        rows.append((*shared.unbind(-1), zero, zero, zero, zero))
    return torch.cat([torch.stack(torch.broadcast_tensors(*row), -1) for row in rows], -2)


def _misfit(
    residual: Tensor, variance: Tensor, alike: Tensor | None, together: Sequence[Tensor]
) -> tuple[Tensor, Tensor]:
    """Return r^T S^-1 r and the determinant of S = diag(variance) + a a^T - t t^T, for columns ``(..., E, M)``.

    By the rule of Sherman and Morrison, which is also that of each determinant.
    """
    square, determinant = (residual * (residual / variance)).sum(-2), variance.prod(-2)
    if alike is not None:
        row = alike / variance
        more = 1 + (alike * row).sum(-2)
        square, determinant = square - (residual * row).sum(-2).square() / more, determinant * more
    for shares in together:
        column = shares / variance
        if alike is not None:
            column = column - row * ((shares * row).sum(-2) / more).unsqueeze(-2)
        left = (1 - (shares * column).sum(-2)).clamp_min(_LEAST_SHARE)
        square, determinant = square + (residual * column).sum(-2).square() / left, determinant * left
    return square, determinant


def _points(way: Way, unit_points: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Return points ``(..., M, 2)`` around a way and the vehicle, and their density ``(..., M)``, unnormalized.

    They are laid out along and across the way, so that they turn with it.
    """
    normal, around = (points.to(way.displacement) for points in unit_points)
    (north, east), distance = way.displacement.unbind(-1), way.displacement.norm(dim=-1)
    heads = distance > 0
    cos, sin = torch.where(heads, north / distance, 1.0), torch.where(heads, east / distance, 0.0)
    turn = torch.stack((torch.stack((cos, -sin), -1), torch.stack((sin, cos), -1)), -2)  # columns: along, across
    covariance = turn.mT @ way.covariance @ turn * _SPREAD**2
    first = covariance[..., 0, 0].clamp_min(_LEAST_AREA).sqrt().unsqueeze(-1)  # Cholesky factor
    below = covariance[..., 0, 1].unsqueeze(-1) / first
    second = (covariance[..., 1, 1].unsqueeze(-1) - below * below).clamp_min(_LEAST_AREA).sqrt()
    x, y = normal.unbind(-1)
    near = torch.stack((distance.unsqueeze(-1) + first * x, below * x + second * y), -1)
    points = torch.cat((near, around.expand(*near.shape[:-2], *around.shape)), -2)
    along, across = points.unbind(-1)
    z0 = (along - distance.unsqueeze(-1)) / first
    z1 = (across - below * z0) / second
    bell = torch.exp(-(z0 * z0 + z1 * z1) / 2) * (len(normal) / (2 * math.pi)) / (first * second)
    nearest = (_NEAR_KM / DISTANCE_SCALE_KM) ** 2
    inverse_square = len(around) / (2 * math.pi * _MASS) / points.square().sum(-1).clamp_min(nearest)
    return points @ turn.mT, bell + inverse_square


def _sobol(count: int, seed: int) -> Tensor:
    """Return quasi-random points ``(count, 2)`` between 0 and 1."""
    return torch.quasirandom.SobolEngine(2, scramble=True, seed=seed).draw(count, dtype=torch.float64)


def _normal(count: int, seed: int = 0) -> Tensor:
    """Return quasi-random points ``(count, 2)`` of a standard normal."""
    return torch.special.ndtri(_sobol(count, seed).clamp(1e-6, 1 - 1e-6))


def _around(count: int) -> Tensor:
    """Return points ``(count, 2)`` around the vehicle in scaled units.

    Their density is that of the inverse square of the distance, and constant within the nearest.
    """
    share, turn = _sobol(count, seed=1).unbind(-1)
    beyond, bearing = share * _MASS - 0.5, 2 * math.pi * turn
    radius = torch.where(beyond < 0, (2 * beyond + 1).clamp_min(0).sqrt(), torch.exp(beyond))
    return _NEAR_KM / DISTANCE_SCALE_KM * torch.stack((radius * torch.cos(bearing), radius * torch.sin(bearing)), -1)


_MASS = 0.5 + math.log(_FAR_KM / _NEAR_KM)  # of the density within the nearest distance and beyond, over 2 pi
_FINE, _COARSE = (_normal(128), _around(384)), (_normal(64), _around(192))
