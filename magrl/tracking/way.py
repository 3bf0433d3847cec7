"""The way to the place where a field has given values, by the estimates of the filter."""

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
    _broadcast,
    _elements_first,
    _entries,
    _nonnegative_or_nan,
    _units,
    continued,
)

_LEAST_VARIANCE = 1e-8  # of a remaining difference: keeps the squares of the weights inside float32
_LEAST_SHARE = 1e-6  # of a variance, left by a relation


class Way(NamedTuple):
    """Displacement ``(..., 2)`` northward and eastward [km] and its covariance ``(..., 2, 2)`` [km^2].

    Example:
        >>> Way(torch.zeros(2), torch.eye(2)).displacement
        tensor([0., 0.])
    """

    displacement: Tensor
    covariance: Tensor


def way_to(
    track: FieldTrack,
    target: Tensor,
    range_km: float,
    scales: PerElement = ELEMENT_SCALES,
    shared: Tensor | None = None,
    bias_std: PerElement | None = None,
    periods: PerElement | None = None,
    curvature: PerElement | None = None,
) -> Way:
    """Return the displacement to the place where the field has given values, and its uncertainty.

    It minimizes ``(r - g·d)^T S(d)^-1 (r - g·d) + |d|^2 / range^2``, with the remaining differences r and the filter's
    covariance S(d) of r - g·d. It takes three solves, each with the covariance at the solution before it; the first
    has its mean over ways of the range. The covariance of the way is the inverse of the normal matrix.

    Args:
        track: state.
        target: ``(..., E)`` values at the destination, in the element's unit.
        range_km: prior standard deviation of the way along each axis [km].
        scales: those of :func:`start`.
        shared: ``(..., E, 3)`` from :func:`relate`; without it, the elements are independent.
        bias_std: standard deviation of a constant error of the readings, ``(..., E)`` or E numbers. It is not in the
            state: gradients do not depend on it, but all remaining differences do.
        periods: of angles, whose remaining differences are wrapped, as :data:`~magrl.tracking.ELEMENT_PERIODS`; None
            for none.
        curvature: standard deviation of the change of a gradient along the way, as in :func:`~magrl.tracking.predict`:
            it adds ``c^2 |d|^4 / 4`` to S(d). None for constant gradients.

    Raises:
        ValueError: for shapes that do not match, a range that is not above 0, or a negative standard deviation.

    Example:
        >>> gradient = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 2.0]])  # the first element grows northward
        >>> track = FieldTrack(gradient, 1e-6 * torch.eye(3).expand(2, 3, 3))
        >>> way_to(track, torch.tensor([3.0, 4.0]), 1000.0, scales=(1.0, 1.0)).displacement.round()
        tensor([300., 200.])
    """
    unit = _units(track, scales)
    count = unit.shape[-1]
    check_tensor(count, target=target)
    check_number(0, above=True, range_km=range_km)
    target = target if periods is None else continued(target, track, scales, periods)
    target = target.to(unit.dtype) / unit
    bias = _nonnegative_or_nan("bias_std", (0.0,) * count if bias_std is None else bias_std, count, unit) / unit
    bend = _nonnegative_or_nan("curvature", (0.0,) * count if curvature is None else curvature, count, unit) / unit
    shape = _broadcast(track.mean.shape[:-1], target.shape, bias.shape, bend.shape)
    (value, north, east), (p00, p01, p02, p11, p12, p22) = _entries(track, shape)
    p00 = p00 + _elements_first(bias, shape).square()
    bend = _elements_first(bend, shape).square()
    ridge = (DISTANCE_SCALE_KM / range_km) ** 2
    terms = torch.stack((_elements_first(target, shape) - value, north, east))
    expected, twice1, twice2, twice12 = p00 + (p11 + p22 + 2 * bend / ridge) / ridge, 2 * p01, 2 * p02, 2 * p12
    together = None
    for _ in range(3):
        remaining, gn, ge = _whitened(terms, expected, together)
        determinant, dn, de = _solution(remaining, gn, ge, ridge)
        expected = p00 + dn * (twice1 + p11 * dn + twice12 * de) + de * (twice2 + p22 * de)
        expected = expected + bend * (dn * dn + de * de).square() / 4
        if shared is not None:
            u0, u1, u2 = shared.expand(*shape, 3).movedim((-1, -2), (0, 1))
            together = u0 + u1 * dn + u2 * de
    nn, ne, ee = torch.stack((gn * gn, gn * ge, ge * ge)).sum(1)
    inverse = torch.stack((ee + ridge, -ne, -ne, nn + ridge), -1) * (DISTANCE_SCALE_KM**2 / determinant).unsqueeze(-1)
    return Way(torch.stack((dn, de), -1) * DISTANCE_SCALE_KM, inverse.unflatten(-1, (2, 2)))


def _whitened(terms: Tensor, variance: Tensor, together: Tensor | None) -> Tensor:
    """Return terms ``(3, E, ...)`` times the root of the inverse of S = diag(variance) - together together^T."""
    scale = variance.clamp_min(_LEAST_VARIANCE).rsqrt()
    terms = terms * scale
    if together is None:
        return terms
    unit = together * scale
    left = (1 - unit.square().sum(0)).clamp_min(_LEAST_SHARE).sqrt()
    return terms + unit * ((terms * unit).sum(1, keepdim=True) / (left * (1 + left)))


def _solution(remaining: Tensor, north: Tensor, east: Tensor, ridge: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return the determinant of the normal matrix and the solution, for equations ``(E, ...)`` of unit variance.

    They are sums over elements and over pairs of elements (Cauchy-Binet): unlike a c - b^2 such sums do not cancel in
    float32 where gradients are nearly parallel.
    """
    i, j = torch.triu_indices(len(north), len(north), 1, device=north.device)
    (ri, rj), (ni, nj), (ei, ej) = ((x[i], x[j]) for x in (remaining, north, east))
    crossing = ni * ej - ei * nj
    singles = torch.stack((north * north + east * east, remaining * north, remaining * east)).sum(1)
    pairs = (crossing * torch.stack((crossing, ri * ej - rj * ei, rj * ni - ri * nj))).sum(1)
    determinant, dn, de = ridge * singles + pairs
    determinant = determinant + ridge**2
    return determinant, dn / determinant, de / determinant
