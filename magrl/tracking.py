"""Kalman filter that estimates a field and its horizontal gradient along a dead-reckoned track, as pure functions.

Each element of the field has its own filter with three states: the value e at the vehicle and the gradient g = (g_N,
g_E). Between two readings the vehicle moves by a displacement d, which changes the value by g·d and lets the gradient
drift; a reading corrects the value, and by its covariance with the value also the gradient. The functions batch over
leading dimensions and take any number of elements E.

Arguments and results are in the element's unit and in kilometers, a :class:`FieldTrack` itself is in scaled units
(:data:`ELEMENT_SCALES`, :data:`DISTANCE_SCALE_KM`), which keep float32 well conditioned. For other elements than D, I,
B_H, pass ``scales`` and ``curvature``, as tensors where they should stay on an accelerator.

Types, shapes and Python numbers are checked. Values inside tensors are not read, because the functions run in every
step: NaN in gives NaN out, and a negative standard deviation inside a tensor counts as NaN. Differences are not
wrapped: a declination that crosses 180 degrees must be continued beyond it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from magrl.checks import check_number, check_numbers, check_tensor, check_type

ELEMENT_SCALES = (0.3, 1.5, 100.0)
"""Units of D [deg], I [deg], B_H [nT] in a :class:`FieldTrack`: about their change over 100 km."""

DISTANCE_SCALE_KM = 100.0
"""Unit of distance in a :class:`FieldTrack` [km]."""

CURVATURE = (0.015, 0.018, 8.0)
"""Standard deviation of the change of a gradient along the way: D, I [deg], B_H [nT], per (100 km)^2."""

VARIANCE_FLOOR = 1e-4
"""Smallest variance of a reading, in squared scaled units: a standard deviation of 0.003°, 0.015°, 1 nT."""

DIPOLE_STD = ((0.39, 0.54), (0.27, 0.24), (190.0, 135.0))
"""Deviation of the gradients of D, I [deg], B_H [nT] from a dipole, along and across magnetic north: rms per 100 km."""

EARTH_RADIUS_KM = 6371.2
"""Reference radius of the geomagnetic field [km]."""

PerElement = Tensor | Sequence[float]
"""A value of each element: a tensor ``(..., E)`` or E numbers."""

_LEAST_VARIANCE = 1e-8  # of a remaining difference: keeps the squares of the weights inside float32


class FieldTrack(NamedTuple):
    """State of the filter in scaled units: ``mean (..., E, 3)`` of e, g_N, g_E and ``covariance (..., E, 3, 3)``.

    Example:
        >>> track = FieldTrack(torch.zeros(5, 3, 3), torch.eye(3).expand(5, 3, 3, 3))
        >>> track.mean.shape
        torch.Size([5, 3, 3])
    """

    mean: Tensor
    covariance: Tensor


class GradientPrior(NamedTuple):
    """Gradient ``(..., E, 2)`` northward and eastward, and its standard deviations ``(..., E, 2)`` along and across an
    azimuth ``(...)`` [rad, clockwise from true north], both in the element's unit per km.

    Example:
        >>> GradientPrior(torch.zeros(3, 2), torch.ones(3, 2), torch.tensor(0.1)).azimuth
        tensor(0.1000)
    """

    gradient: Tensor
    std: Tensor
    azimuth: Tensor


class Way(NamedTuple):
    """Displacement ``(..., 2)`` northward and eastward [km] and its covariance ``(..., 2, 2)`` [km^2].

    Example:
        >>> Way(torch.zeros(2), torch.eye(2)).displacement
        tensor([0., 0.])
    """

    displacement: Tensor
    covariance: Tensor


def dipole_prior(reading: Tensor) -> GradientPrior:
    """Return the gradient of a dipole field through a reading of D, I, B_H, and how far fields deviate from it.

    With the magnetic latitude phi of tan(phi) = tan(I) / 2, towards magnetic north (azimuth D) dI/ds =
    2 / ((1 + 3 sin^2 phi) R) and dB_H/ds = -B_H tan(phi) / R; D is constant.

    Args:
        reading: ``(..., 3)``: D [deg], I [deg], B_H [nT].

    Returns:
        Gradient ``(..., 3, 2)`` and standard deviations ``(3, 2)`` along and across magnetic north, in deg/km, deg/km,
        nT/km, and the azimuth of magnetic north ``(...)`` [rad].

    Example:
        >>> prior = dipole_prior(torch.tensor([0.0, 0.0, 30000.0]))  # at the magnetic equator
        >>> prior.gradient[1]  # I increases northward by 1.8 degrees per 100 km
        tensor([0.0180, 0.0000])
    """
    check_tensor(3, reading=reading)
    azimuth, inclination = torch.deg2rad(reading[..., :2]).unbind(-1)
    latitude = torch.atan2(torch.sin(inclination), 2 * torch.cos(inclination))
    dip_slope = torch.rad2deg(2 / (1 + 3 * torch.sin(latitude).square())) / EARTH_RADIUS_KM
    strength_slope = -reading[..., 2] * torch.tan(latitude) / EARTH_RADIUS_KM
    slopes = torch.stack((torch.zeros_like(dip_slope), dip_slope, strength_slope), -1)
    northward = torch.stack((torch.cos(azimuth), torch.sin(azimuth)), -1)
    std = torch.tensor(DIPOLE_STD, dtype=slopes.dtype, device=slopes.device) / 100
    return GradientPrior(slopes.unsqueeze(-1) * northward.unsqueeze(-2), std, azimuth)


def start(
    reading: Tensor,
    prior_gradient: Tensor,
    prior_std: Tensor,
    noise_std: PerElement,
    azimuth: Tensor | None = None,
    scales: PerElement = ELEMENT_SCALES,
) -> FieldTrack:
    """Return the state after the first reading.

    Args:
        reading: ``(..., E)`` first reading, in the element's unit.
        prior_gradient: ``(..., E, 2)`` expected gradient northward and eastward [element unit / km].
        prior_std: ``(..., E, 2)`` its standard deviations along and across ``azimuth`` [element unit / km].
        noise_std: standard deviation of its noise, ``(..., E)`` or E numbers; see :data:`VARIANCE_FLOOR`.
        azimuth: ``(...)`` [rad, clockwise from true north], usually of magnetic north; without it, 0.
        scales: units of the elements in the state, ``(..., E)`` or E numbers.

    Returns:
        The state, of the dtype of ``reading``.

    Raises:
        ValueError: for shapes that do not match, or a negative number in ``noise_std``.

    Example:
        >>> reading, noise = torch.tensor([8.0, -16.0, 35000.0]), (0.05, 0.05, 5.0)
        >>> prior = dipole_prior(reading)
        >>> track = start(reading, prior.gradient, prior.std, noise, prior.azimuth)
        >>> track.mean.shape, track.covariance.shape
        (torch.Size([3, 3]), torch.Size([3, 3, 3]))
    """
    check_tensor(reading=reading)
    count = reading.shape[-1] if reading.ndim else 0
    check_tensor(count, 2, prior_gradient=prior_gradient, prior_std=prior_std)
    unit = _positive("scales", scales, count, reading)
    azimuth = torch.zeros_like(reading[..., 0]) if azimuth is None else azimuth
    check_tensor(azimuth=azimuth)
    noise = (_positive("noise_std", noise_std, count, reading) / unit).square().clamp_min(VARIANCE_FLOOR)
    per_unit = (DISTANCE_SCALE_KM / unit).unsqueeze(-1)
    gradient = prior_gradient.to(reading.dtype) * per_unit
    spread = prior_std.to(reading.dtype).where(prior_std >= 0, math.nan) * per_unit
    cos, sin = torch.cos(azimuth).to(reading.dtype), torch.sin(azimuth).to(reading.dtype)
    axes = torch.stack((cos, -sin, sin, cos), -1).unflatten(-1, (2, 2))  # columns along and across
    root = axes.unsqueeze(-3) * spread.unsqueeze(-2)
    block = (root.unsqueeze(-2) * root.unsqueeze(-3)).sum(-1)
    return _track(reading / unit, gradient, noise, torch.zeros_like(gradient), block)


def predict(
    track: FieldTrack, displacement: Tensor, curvature: PerElement = CURVATURE, scales: PerElement = ELEMENT_SCALES
) -> FieldTrack:
    """Return the state after a move, before the reading at its end.

    The value becomes e + g·d. The gradient drifts with the way, so that cov(g) grows by ``c^2 |d|^2 I``, var(e)
    by ``c^2 |d|^4 / 4`` and cov(e, g) by ``c^2 |d|^2 d / 2``.

    Args:
        track: state before the move.
        displacement: ``(..., 2)`` northward and eastward [km].
        curvature: standard deviation c, ``(..., E)`` or E numbers [element unit / (100 km)^2].
        scales: those of :func:`start`.

    Raises:
        ValueError: for shapes that do not match, or a negative number in ``curvature``.

    Example:
        >>> track = FieldTrack(torch.tensor([[0.0, 1.0, 0.0]]), torch.zeros(1, 3, 3))
        >>> predict(track, torch.tensor([50.0, 0.0]), curvature=(1.0,), scales=(1.0,)).mean
        tensor([[0.5000, 1.0000, 0.0000]])
    """
    count = _check_track(track)
    check_tensor(2, displacement=displacement)
    # By parts: 3 x 3 matrix products are slower, and may round to TF32 or, under autocast, to bfloat16.
    value, gradient, variance, cross, block = _parts(track)
    drift = _positive("curvature", curvature, count, value) / _positive("scales", scales, count, value)
    d = (displacement.to(value.dtype) / DISTANCE_SCALE_KM).unsqueeze(-2)  # (..., 1, 2), the same for all elements
    length2 = d.square().sum(-1)
    growth = drift.square() * length2
    moved = cross + (block * d.unsqueeze(-2)).sum(-1)
    return _track(
        value + (gradient * d).sum(-1),
        gradient,
        variance + ((cross + moved) * d).sum(-1) + growth * length2 / 4,
        moved + growth.unsqueeze(-1) * d / 2,
        block + growth[..., None, None] * torch.eye(2, dtype=value.dtype, device=value.device),
    )


def update(
    track: FieldTrack, reading: Tensor, noise_std: PerElement, scales: PerElement = ELEMENT_SCALES
) -> FieldTrack:
    """Return the state after a reading, with the covariance in Joseph form.

    In float32, P - K H P loses positive definiteness after long moves. (I - K H) P (I - K H)^T + K R K^T (Bucy and
    Joseph, 1968) loses it only where the variances of g along and across the track differ by a factor of about 1e7.

    Args:
        track: state from :func:`predict`.
        reading: ``(..., E)``, in the element's unit.
        noise_std: standard deviation of its noise, ``(..., E)`` or E numbers; see :data:`VARIANCE_FLOOR`.
        scales: those of :func:`start`.

    Raises:
        ValueError: for shapes that do not match, or a negative number in ``noise_std``.

    Example:
        >>> track = FieldTrack(torch.zeros(1, 3), torch.eye(3).unsqueeze(0))
        >>> update(track, torch.tensor([2.0]), noise_std=(1.0,), scales=(1.0,)).mean[0, 0]
        tensor(1.)
    """
    count = _check_track(track)
    check_tensor(count, reading=reading)
    value, gradient, variance, cross, block = _parts(track)
    unit = _positive("scales", scales, count, value)
    noise = (_positive("noise_std", noise_std, count, value) / unit).square().clamp_min(VARIANCE_FLOOR)
    total = variance + noise
    kept, gain, slope = noise / total, variance / total, cross / total.unsqueeze(-1)  # 1 - K_e, K_e, K_g
    surprise = reading.to(value.dtype) / unit - value
    mixed = slope.unsqueeze(-1) * cross.unsqueeze(-2)
    return _track(
        value + gain * surprise,
        gradient + slope * surprise.unsqueeze(-1),
        kept.square() * variance + gain.square() * noise,
        kept.unsqueeze(-1) * (cross - slope * variance.unsqueeze(-1)) + slope * (gain * noise).unsqueeze(-1),
        block - mixed - mixed.mT + total[..., None, None] * slope.unsqueeze(-1) * slope.unsqueeze(-2),
    )


def estimated_gradient(track: FieldTrack, scales: PerElement = ELEMENT_SCALES) -> Tensor:
    """Return the estimated gradient ``(..., E, 2)`` northward and eastward [element unit / km].

    Example:
        >>> track = FieldTrack(torch.tensor([[0.0, 1.0, 2.0]]), torch.zeros(1, 3, 3))
        >>> estimated_gradient(track, scales=(100.0,))
        tensor([[1., 2.]])
    """
    count = _check_track(track)
    return track.mean[..., 1:] * (_positive("scales", scales, count, track.mean) / DISTANCE_SCALE_KM).unsqueeze(-1)


def way_to(track: FieldTrack, target: Tensor, range_km: float, scales: PerElement = ELEMENT_SCALES) -> Way:
    """Return the displacement to the place where the field has given values, and its uncertainty.

    It minimizes the sum over the elements of ``(r - g·d)^2 / var(d)``, plus ``|d|^2 / range^2``, with the remaining
    difference r and the filter's variance of r - g·d. It takes three solves, each with the variances at the solution
    before it; the first has their mean over ways of the range.

    Args:
        track: state.
        target: ``(..., E)`` values at the destination, in the element's unit.
        range_km: prior standard deviation of the way along each axis [km].
        scales: those of :func:`start`.

    Returns:
        The displacement [km] and its covariance [km^2], the inverse of the normal matrix.

    Raises:
        ValueError: for shapes that do not match, or a range that is not above 0.

    Example:
        >>> gradient = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 2.0]])  # the first element grows northward
        >>> track = FieldTrack(gradient, 1e-6 * torch.eye(3).expand(2, 3, 3))
        >>> way_to(track, torch.tensor([3.0, 4.0]), 1000.0, scales=(1.0, 1.0)).displacement.round()
        tensor([300., 200.])
    """
    count = _check_track(track)
    check_tensor(count, target=target)
    check_number(0, above=True, range_km=range_km)
    value, gradient, variance, cross, block = _parts(track)
    remaining = target.to(value.dtype) / _positive("scales", scales, count, value) - value
    reach = range_km / DISTANCE_SCALE_KM
    expected = variance + reach**2 * block.diagonal(dim1=-2, dim2=-1).sum(-1)
    for _ in range(3):
        way, way_covariance = _solve(remaining, gradient, 1 / expected.clamp_min(_LEAST_VARIANCE), reach**-2)
        d = way.unsqueeze(-2)
        expected = variance + ((2 * cross + (block * d.unsqueeze(-2)).sum(-1)) * d).sum(-1)
    return Way(way * DISTANCE_SCALE_KM, way_covariance * DISTANCE_SCALE_KM**2)


def _solve(remaining: Tensor, gradient: Tensor, weight: Tensor, ridge: float) -> tuple[Tensor, Tensor]:
    """Return the weighted least-squares solution ``(..., 2)`` and the inverse of its normal matrix.

    Determinant and numerators are sums over pairs of elements (Cauchy-Binet): unlike a c - b^2 they do not cancel in
    float32 where gradients are nearly parallel.
    """
    north, east = gradient.unbind(-1)
    cross = north.unsqueeze(-1) * east.unsqueeze(-2) - east.unsqueeze(-1) * north.unsqueeze(-2)
    pairs = weight.unsqueeze(-1) * weight.unsqueeze(-2) * cross
    a, b, c = ((weight * x * y).sum(-1) for x, y in ((north, north), (north, east), (east, east)))
    determinant = (pairs * cross).sum((-2, -1)) / 2 + ridge * (a + c + ridge)
    inverse = torch.stack((c + ridge, -b, -b, a + ridge), -1).unflatten(-1, (2, 2)) / determinant[..., None, None]
    pulls = (remaining.unsqueeze(-1) * pairs).sum(-2)
    sides = torch.stack((pulls * east, -pulls * north), -1) + (ridge * weight * remaining).unsqueeze(-1) * gradient
    return sides.sum(-2) / determinant.unsqueeze(-1), inverse


def _parts(track: FieldTrack) -> tuple[Tensor, ...]:
    """Return e ``(..., E)``, g ``(..., E, 2)``, var(e) ``(..., E)``, cov(e, g) ``(..., E, 2)`` and cov(g)."""
    mean, covariance = track
    return mean[..., 0], mean[..., 1:], covariance[..., 0, 0], covariance[..., 0, 1:], covariance[..., 1:, 1:]


def _track(value: Tensor, gradient: Tensor, variance: Tensor, cross: Tensor, block: Tensor) -> FieldTrack:
    """Return the state of parts that broadcast to the same leading dimensions, symmetrized."""
    shape = torch.broadcast_shapes(value.shape, gradient.shape[:-1], variance.shape, cross.shape[:-1], block.shape[:-2])
    value, variance = value.expand(shape).unsqueeze(-1), variance.expand(shape).unsqueeze(-1)
    cross, block = cross.expand(*shape, 2), ((block + block.mT) / 2).expand(*shape, 2, 2)
    upper, lower = torch.cat((variance, cross), -1).unsqueeze(-2), torch.cat((cross.unsqueeze(-1), block), -1)
    return FieldTrack(torch.cat((value, gradient.expand(*shape, 2)), -1), torch.cat((upper, lower), -2))


def _check_track(track: FieldTrack) -> int:
    """Return the number of elements of a state; raise for anything else than a state."""
    check_type(FieldTrack, track=track)
    check_tensor(3, mean=track.mean)
    check_tensor(3, 3, covariance=track.covariance)
    if track.mean.ndim < 2 or track.covariance.shape[:-1] != track.mean.shape:
        shapes = [tuple(tensor.shape) for tensor in track]
        raise ValueError(f"mean and covariance must have the shapes (..., E, 3) and (..., E, 3, 3), got {shapes}")
    return track.mean.shape[-2]


def _positive(name: str, values: PerElement, count: int, like: Tensor) -> Tensor:
    """Return a value of each element, ``(..., E)``, of another tensor's dtype."""
    if isinstance(values, Tensor):
        check_tensor(count, **{name: values})
        return values.to(like.dtype).where(values >= 0, math.nan)
    check_numbers(count, **{name: values})
    smallest: dict[str, Any] = {name: min(values, default=1.0)}
    check_number(0, above=name == "scales", **smallest)
    return like.new_tensor(values)
