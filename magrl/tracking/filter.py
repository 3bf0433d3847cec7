"""Kalman filter that estimates a field and its horizontal gradient along a dead-reckoned track, as pure functions.

Each element of the field has its own filter with three states: the value e at the vehicle and the gradient g = (g_N,
g_E). Between two readings the vehicle moves by a displacement d, which changes the value by g·d and lets the gradient
drift; a reading corrects the value, and by its covariance with the value also the gradient. The functions batch over
leading dimensions and take any number of elements E.

Arguments and results are in the element's unit and in kilometers, a :class:`FieldTrack` itself is in scaled units
(:data:`ELEMENT_SCALES`, :data:`DISTANCE_SCALE_KM`), which keep float32 well conditioned. For other elements than D, I,
B_H, pass ``scales`` and ``curvature``, as tensors where they should stay on an accelerator.

Types, shapes and Python numbers are checked. Values inside tensors are not: NaN or a negative standard deviation gives
NaN. Differences are not wrapped: see :func:`continued`.
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

ELEMENT_PERIODS = (360.0, 0.0, 0.0)
"""Period of D, I [deg], B_H [nT] in readings; 0 for elements that are not wrapped."""

DISTANCE_SCALE_KM = 100.0  # unit of distance in a FieldTrack

CURVATURE = (0.015, 0.018, 12.0)
"""Standard deviation of the change of a gradient along the way: D, I [deg], B_H [nT], per (100 km)^2, typical of the
Earth's field. The error of a linear step grows with it."""

VARIANCE_FLOOR = 1e-4
"""Smallest variance of a reading in float32, in squared scaled units: a standard deviation of 0.003°, 0.015°, 1 nT. In
float64 it is 1e-8 of that, below the rounding of readings in float32."""

PerElement = Tensor | Sequence[float]  # a value of each element: (..., E), or E numbers


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


class GradientRelation(NamedTuple):
    """Linear relation of the gradients at a place: the sum of ``weights (..., E, 2)`` times the gradients northward and
    eastward [element unit / km] is ``value (...)``, with a standard deviation ``std (...)``.

    Example:
        >>> GradientRelation(torch.tensor([[1.0, 0.0], [0.0, -1.0]]), torch.tensor(0.0), torch.tensor(0.1)).value
        tensor(0.)
    """

    weights: Tensor
    value: Tensor
    std: Tensor


def start(
    reading: Tensor, prior: GradientPrior, sensor_std: PerElement, scales: PerElement = ELEMENT_SCALES
) -> FieldTrack:
    """Return the state after the first reading, of its dtype.

    Args:
        reading: ``(..., E)`` first reading, in the element's unit.
        prior: expected gradient and its standard deviations along and across an azimuth.
        sensor_std: standard deviation of the noise, ``(..., E)`` or E numbers; see :data:`VARIANCE_FLOOR`.
        scales: units of the elements in the state, ``(..., E)`` or E numbers.

    Raises:
        ValueError: for shapes that do not match, or a negative number in ``sensor_std``.

    Example:
        >>> from magrl.tracking import dipole_prior
        >>> reading = torch.tensor([8.0, -16.0, 35000.0])
        >>> track = start(reading, dipole_prior(reading), (0.05, 0.05, 5.0))
        >>> track.mean.shape, track.covariance.shape
        (torch.Size([3, 3]), torch.Size([3, 3, 3]))
    """
    check_tensor(reading=reading)
    check_type(GradientPrior, prior=prior)
    count = reading.shape[-1] if reading.ndim else 0
    check_tensor(count, 2, prior_gradient=prior.gradient, prior_std=prior.std)
    check_tensor(azimuth=prior.azimuth)
    unit = _nonnegative_or_nan("scales", scales, count, reading)
    per_unit = (DISTANCE_SCALE_KM / unit).unsqueeze(-1)
    north, east = (prior.gradient.to(reading.dtype) * per_unit).unbind(-1)
    along, across = (prior.std.to(reading.dtype).where(prior.std >= 0, math.nan) * per_unit).square().unbind(-1)
    cos, sin = (f(prior.azimuth).to(along).unsqueeze(-1) for f in (torch.cos, torch.sin))
    block = along * cos * cos + across * sin * sin, (along - across) * cos * sin, along * sin * sin + across * cos * cos
    entries = reading / unit, north, east, _variance(sensor_std, unit), 0 * along, 0 * along, *block
    value, north, east, *covariance = (entry.movedim(-1, 0) for entry in torch.broadcast_tensors(*entries))
    return _track((value, north, east), covariance)


def predict(
    track: FieldTrack, displacement: Tensor, curvature: PerElement = CURVATURE, scales: PerElement = ELEMENT_SCALES
) -> FieldTrack:
    """Return the state after a move, before the reading at its end: mean F x and covariance F P F^T + Q.

    F has the rows (1, d_N, d_E), (0, 1, 0), (0, 0, 1). The gradient drifts with the way: Q has ``c^2 |d|^2 I`` for the
    gradient, ``c^2 |d|^4 / 4`` for the value and ``c^2 |d|^2 d / 2`` between them.

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
    unit = _units(track, scales)
    check_tensor(2, displacement=displacement)
    drift = _nonnegative_or_nan("curvature", curvature, unit.shape[-1], unit) / unit
    shape = _broadcast(track.mean.shape[:-1], (*displacement.shape[:-1], unit.shape[-1]), drift.shape)
    (value, north, east), (p00, p01, p02, p11, p12, p22) = _entries(track, shape)
    dn, de = (displacement.to(value.dtype) / DISTANCE_SCALE_KM).unbind(-1)  # the same for all elements
    length2 = dn * dn + de * de
    q = _elements_first(drift, shape).square() * length2
    fp01, fp02 = p01 + p11 * dn + p12 * de, p02 + p12 * dn + p22 * de  # first row of F P; the others are those of P
    variance = p00 + (p01 + fp01) * dn + (p02 + fp02) * de + q * (length2 / 4)
    mean = value + north * dn + east * de, north, east
    return _track(mean, (variance, fp01 + q * (dn / 2), fp02 + q * (de / 2), p11 + q, p12, p22 + q))


def update(
    track: FieldTrack, reading: Tensor, sensor_std: PerElement, scales: PerElement = ELEMENT_SCALES
) -> FieldTrack:
    """Return the state after a reading z = H x + noise, H = (1, 0, 0): mean x + K (z - H x), covariance in Joseph form.

    In float32, P - K H P loses positive definiteness after long moves. (I - K H) P (I - K H)^T + K R K^T (Bucy and
    Joseph, 1968) loses it only where the variances of g along and across the track differ by a factor of about 1e7.

    Args:
        track: state from :func:`predict`.
        reading: ``(..., E)``, in the element's unit.
        sensor_std: standard deviation of its noise, ``(..., E)`` or E numbers; see :data:`VARIANCE_FLOOR`.
        scales: those of :func:`start`.

    Raises:
        ValueError: for shapes that do not match, or a negative number in ``sensor_std``.

    Example:
        >>> track = FieldTrack(torch.zeros(1, 3), torch.eye(3).unsqueeze(0))
        >>> update(track, torch.tensor([2.0]), sensor_std=(1.0,), scales=(1.0,)).mean[0, 0]
        tensor(1.)
    """
    unit = _units(track, scales)
    check_tensor(unit.shape[-1], reading=reading)
    reading, variance = reading.to(unit.dtype) / unit, _variance(sensor_std, unit)
    shape = _broadcast(track.mean.shape[:-1], reading.shape, variance.shape)
    (value, north, east), (p00, p01, p02, p11, p12, p22) = _entries(track, shape)
    r, innovation = _elements_first(variance, shape), _elements_first(reading, shape) - value  # R, z - H x
    s = p00 + r  # S = H P H^T + R
    gain, gain_n, gain_e = p00 / s, p01 / s, p02 / s  # K = P H^T / S
    mean = value + gain * innovation, north + gain_n * innovation, east + gain_e * innovation
    rest, noise = r / s, gain * r  # 1 - K_0 and K_0 R, the same number, each rounded as its formula needs it
    row = rest * (p01 - gain_n * p00) + gain_n * noise, rest * (p02 - gain_e * p00) + gain_e * noise
    left_n, left_e = p01 - s * gain_n, p02 - s * gain_e  # P H^T - K S: 0 but for rounding
    block = p11 - gain_n * (p01 + left_n), p12 - gain_n * p02 - gain_e * left_n, p22 - gain_e * (p02 + left_e)
    return _track(mean, (rest * rest * p00 + gain * noise, *row, *block))


def relate(
    track: FieldTrack, relation: GradientRelation, scales: PerElement = ELEMENT_SCALES
) -> tuple[FieldTrack, Tensor]:
    """Return the state given a relation of its gradients, and what the elements then share.

    The relation couples the elements: their joint covariance becomes that of the blocks ``covariance`` minus
    ``u u^T``, with ``u`` the second result. Go on with the state from before: the relation holds at every place anew.

    Args:
        track: state.
        relation: of the gradients at the present place.
        scales: those of :func:`start`.

    Returns:
        The state with its mean updated and its covariance as before, and ``(..., E, 3)``.

    Raises:
        ValueError: for shapes that do not match.

    Example:
        >>> track = FieldTrack(torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]), torch.eye(3).expand(2, 3, 3))
        >>> same = GradientRelation(torch.tensor([[1.0, 0.0], [-1.0, 0.0]]), torch.tensor(0.0), torch.tensor(0.0))
        >>> relate(track, same, scales=(1.0, 1.0))[0].mean[:, 1]  # two gradients that must be the same
        tensor([0.5000, 0.5000])
    """
    unit = _units(track, scales)
    check_tensor(unit.shape[-1], 2, weights=relation.weights)
    rows = relation.weights.to(unit.dtype) * (unit / DISTANCE_SCALE_KM).unsqueeze(-1)  # H, 0 for the values
    cross = (track.covariance[..., 1:] * rows.unsqueeze(-2)).sum(-1)  # P H^T
    s = (rows * cross[..., 1:]).sum((-2, -1)) + relation.std.to(rows).square()  # S = H P H^T + R
    innovation = relation.value.to(rows) - (rows * track.mean[..., 1:]).sum((-2, -1))
    mean = track.mean + cross * (innovation / s)[..., None, None]
    return FieldTrack(mean, track.covariance), cross * s.rsqrt()[..., None, None]


def estimated_field(track: FieldTrack, scales: PerElement = ELEMENT_SCALES) -> Tensor:
    """Return the estimated field ``(..., E)``, in the element's unit; angles are not wrapped.

    Example:
        >>> estimated_field(FieldTrack(torch.tensor([[2.0, 0.0, 0.0]]), torch.zeros(1, 3, 3)), scales=(100.0,))
        tensor([200.])
    """
    return track.mean[..., 0] * _units(track, scales)


def estimated_gradient(track: FieldTrack, scales: PerElement = ELEMENT_SCALES) -> Tensor:
    """Return the estimated gradient ``(..., E, 2)`` northward and eastward [element unit / km].

    Example:
        >>> track = FieldTrack(torch.tensor([[0.0, 1.0, 2.0]]), torch.zeros(1, 3, 3))
        >>> estimated_gradient(track, scales=(100.0,))
        tensor([[1., 2.]])
    """
    return track.mean[..., 1:] * (_units(track, scales) / DISTANCE_SCALE_KM).unsqueeze(-1)


def continued(values: Tensor, track: FieldTrack, scales: PerElement, periods: PerElement) -> Tensor:
    """Return values ``(..., E)`` whose angles are within half a turn of the estimate.

    Example:
        >>> track = FieldTrack(torch.tensor([[200 / 0.3, 0.0, 0.0]]), torch.eye(3).unsqueeze(0))
        >>> continued(torch.tensor([-170.0]), track, (0.3,), (360.0,))
        tensor([190.])
    """
    period = torch.as_tensor(periods, dtype=values.dtype, device=values.device)
    return values - period * torch.round((values - estimated_field(track, scales)) / 360)


def _units(track: FieldTrack, scales: PerElement) -> Tensor:
    """Return the units of the elements of a state, ``(..., E)``; raise for anything else than a state."""
    check_type(FieldTrack, track=track)
    check_tensor(3, mean=track.mean)
    check_tensor(3, 3, covariance=track.covariance)
    if track.mean.ndim < 2 or track.covariance.shape[:-1] != track.mean.shape:
        wanted = "mean and covariance must have the shapes (..., E, 3) and (..., E, 3, 3)"
        raise ValueError(f"{wanted}, got {[tuple(tensor.shape) for tensor in track]}")
    return _nonnegative_or_nan("scales", scales, track.mean.shape[-2], track.mean)


def _entries(track: FieldTrack, shape: torch.Size) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
    """Return e, g_N, g_E and the six entries of their covariance by rows, ``(E, ...)`` of a shape ``(..., E)``.

    By entries, as 3 x 3 matrix products are slower, and may round to TF32 or, under autocast, to bfloat16.
    """
    mean, covariance = track.mean.expand(*shape, 3), track.covariance.expand(*shape, 3, 3)
    p0, p1, p2 = covariance.movedim((-2, -1, -3), (0, 1, 2)).contiguous()
    return mean.movedim((-1, -2), (0, 1)).contiguous().unbind(), (*p0, *p1[1:], p2[2])


def _track(mean: Sequence[Tensor], covariance: Sequence[Tensor]) -> FieldTrack:
    """Return the state of the entries of :func:`_entries`."""
    p00, p01, p02, p11, p12, p22 = covariance
    matrix = torch.stack((p00, p01, p02, p01, p11, p12, p02, p12, p22)).unflatten(0, (3, 3))
    return FieldTrack(torch.stack(tuple(mean)).movedim((0, 1), (-1, -2)), matrix.movedim((0, 1, 2), (-2, -1, -3)))


def _elements_first(values: Tensor, shape: torch.Size) -> Tensor:
    """Return a value of each element ``(..., E)`` as ``(E, ...)``, expanded to a shape ``(..., E)``."""
    return values.expand(shape).movedim(-1, 0).contiguous()


def _broadcast(shape: torch.Size, *others: tuple[int, ...]) -> torch.Size:
    """Return the shape ``(..., E)`` of all; torch.broadcast_shapes takes longer than ten sums of 1024 vehicles."""
    return shape if all(x == shape[-len(x) :] for x in others) else torch.broadcast_shapes(shape, *others)


def _variance(sensor_std: PerElement, unit: Tensor) -> Tensor:
    """Return the variance of a reading ``(..., E)`` in squared scaled units, not below the floor."""
    std = _nonnegative_or_nan("sensor_std", sensor_std, unit.shape[-1], unit)
    return (std / unit).square().clamp_min(VARIANCE_FLOOR * (1e-8 if unit.dtype == torch.float64 else 1.0))


def _nonnegative_or_nan(name: str, values: PerElement, count: int, like: Tensor) -> Tensor:
    """Return a value of each element ``(..., E)``, of another tensor's dtype; raise for a negative Python number, and
    replace negative entries of a tensor, which must not be read here, by NaN."""
    if isinstance(values, Tensor):
        check_tensor(count, **{name: values})
        return values.to(like.dtype).where(values >= 0, math.nan)
    check_numbers(count, **{name: values})
    smallest: dict[str, Any] = {name: min(values, default=1.0)}
    check_number(0, above=name == "scales", **smallest)
    return like.new_tensor(values)
