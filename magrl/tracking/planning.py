"""The next move of a vehicle that navigates by its own track, chosen for what it gains and for what it will teach."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from magrl.checks import check_tensor
from magrl.tracking.filter import (
    DISTANCE_SCALE_KM,
    ELEMENT_SCALES,
    FieldTrack,
    PerElement,
    _entries,
    _nonnegative_or_nan,
    _units,
    _variance,
)
from magrl.tracking.posterior import WayPosterior
from magrl.tracking.priors import curl_relation
from magrl.tracking.track import related

CAUTION = 0.3
"""Weight of the uncertainty of the way after a reading; this and :data:`LENGTHS` are from scans on random planets
(docs/navigators.md)."""
STEP_PRICE = 0.5
"""Default price of a step [% of SPL]."""
CHEAP_KM = 2.0
"""Price up to which a step is cheap [km]."""
RESERVE_KM = 5.0
"""Accuracy [km] of the mean of the readings for which steps are kept in reserve; this and :data:`RESERVE_SHARE` are
chosen on random planets."""
RESERVE_SHARE = 0.2
"""Largest share of the limit that is kept in reserve."""
MISSING_KM = 1000.0
"""Accuracy [km] of a reading beyond which it is a missing one, which says nothing about the sensors."""
NEAR_KM = 30.0
"""Distance at which the uncertainty along the way starts to matter beside that across it [km]."""
SLOPES = (0.004, 0.015, 4.0)
"""Typical gradient of D, I [deg/km], B_H [nT/km]: what a quasi-Newton navigator without a map expects, in size."""
LENGTHS = (0.1, 0.3, 0.6, 1.0)
"""Lengths of the moves that are compared by default; the whole way, if it is shorter, is another."""
SHORTEST = 1 / 40
"""The least length of a move that is compared, as a share of the way."""
ANGLES_DEG = (-90, -60, -45, -30, -20, -10, 0, 10, 20, 30, 45, 60, 90)
"""Their directions, from that of the way [deg]."""
CORRECTION = 0.5
"""Unit of the corrections of a plan: of the logarithm of the length, and of the direction [rad]."""
_Entries = tuple[Tensor, Tensor, Tensor]  # of a symmetric matrix: nn, ne, ee


def sensor_length(std: Tensor) -> Tensor:
    """Return the way over which the elements typically change as much as the errors of a reading ``(...)`` [km].

    A position takes two elements, so that the second smallest way of the three counts.

    Args:
        std: ``(..., 3)`` standard deviations of D [deg], I [deg], B_H [nT].

    Example:
        >>> sensor_length(torch.tensor([0.04, 0.03, 0.4]))
        tensor(2.)
    """
    check_tensor(3, std=std)
    return (std / std.new_tensor(SLOPES)).sort(-1).values[..., 1]


def step_price(
    percent: Tensor | float,
    range_km: float,
    way: Tensor,
    step: Tensor,
    sensor_std: PerElement,
    max_steps: int,
    max_move_km: float,
) -> Tensor:
    """Return the price of a step ``(...)`` [km]: it rises as the steps beyond those of the way run out.

    The search at the end takes more readings where one is less accurate: as many steps are kept in reserve as readings
    whose mean is accurate to :data:`RESERVE_KM`, at most :data:`RESERVE_SHARE` of the limit. With a price p [km]
    while many are left, and r steps of the limit for each that is left beyond the reserve, it is the larger of
    ``p r^2`` and ``min(p, 2 km) r^4``: where a step is cheap, a vehicle that has used half of the limit is in search of
    the destination, and small moves teach little.

    Args:
        percent: price while many are left [% of SPL]: p is this share of ``range_km``.
        range_km: way that counts as 100 % [km].
        way: ``(..., 2)`` [km].
        step: ``(...)`` number of the step.
        sensor_std: standard deviations of a reading, ``(..., 3)`` or 3 numbers.
        max_steps: step limit of the episode.
        max_move_km: longest move.

    Example:
        >>> way = torch.tensor([100.0, 0.0])
        >>> step_price(0.5, 200.0, way, torch.tensor(22), (0.0, 0.0, 0.0), 50, 50.0)
        tensor(16.)
        >>> step_price(0.5, 200.0, way, torch.tensor(18), (0.1, 0.15, 20.0), 50, 50.0)  # a reading is accurate to 10 km
        tensor(16.)
    """
    length = sensor_length(torch.as_tensor(sensor_std, dtype=way.dtype, device=way.device))
    reserve = (length / RESERVE_KM).square().clamp_max(RESERVE_SHARE * max_steps)
    reserve = torch.where(length < MISSING_KM, reserve, 0.0)
    spare = max_steps - step - 1.5 * way.norm(dim=-1) / max_move_km - reserve
    rise, price = (max_steps / spare.clamp_min(1.0)).square(), torch.as_tensor(percent) * range_km / 100
    return torch.maximum(price, price.clamp_max(CHEAP_KM) * rise) * rise


def planned_move(
    track: FieldTrack,
    aim: Tensor,
    posterior: WayPosterior,
    sensor_std: PerElement,
    step_km: Tensor,
    max_move_km: float,
    range_km: float,
    caution: float = CAUTION,
    lengths: Sequence[float] = LENGTHS,
    scales: PerElement = ELEMENT_SCALES,
    bias_std: PerElement | None = None,
    curvature: PerElement | None = None,
) -> Tensor:
    """Return the displacement ``(..., 2)`` [km] of the next move, northward and eastward.

    It compares moves of several lengths and directions (:data:`ANGLES_DEG`) and takes the least sum of three costs
    [km]:

    - the path: the length of the move minus the mean progress, over the posterior of the way;
    - the detour that the uncertainty of the way may then cost, times ``caution``: the covariance of the filter after
      the reading at the end of the move does not depend on what will be read;
    - the price of the steps that remain.

    Args:
        track: state of the filter of D, I, B_H.
        aim: ``(..., 2)`` way to aim at, northward and eastward [km]; the posterior is shifted to have its mean there.
        posterior: posterior of the way.
        sensor_std: standard deviations of the next reading, ``(..., 3)`` or 3 numbers.
        step_km: ``(...)`` price of a step [km], see :func:`step_price`.
        max_move_km: longest move.
        range_km: prior standard deviation of the way along each axis [km].
        caution: weight of the uncertainty.
        lengths: of the moves that are compared, as fractions of the longest; at least :data:`SHORTEST` of the way.
        scales: those of :func:`~magrl.tracking.start`.
        bias_std: standard deviation of a constant error of the readings, which no reading reduces.
        curvature: standard deviation of the change of a gradient along the way, as in :func:`~magrl.tracking.way_to`.

    Raises:
        ValueError: for shapes that do not match, or a negative standard deviation.

    Source:
        A. A. Feldbaum, Dual control theory, Automation and Remote Control 21 (1960): an action both steers and probes.

    Example:
        >>> from magrl.tracking import dipole_prior, start, way_posterior
        >>> here, target = torch.tensor([[8.0, -16.0, 35000.0], [9.0, -20.0, 34500.0]], dtype=torch.float64)
        >>> track = start(here, dipole_prior(here), (0.02, 0.02, 2.0))
        >>> posterior = way_posterior(track, target, range_km=300.0)
        >>> aim, price = posterior.way().displacement, torch.tensor(1.0)
        >>> planned_move(track, aim, posterior, (0.02, 0.02, 2.0), price, max_move_km=50.0, range_km=300.0).shape
        torch.Size([2])
    """
    check_tensor(2, aim=aim)
    aim = aim.to(track.mean.dtype)
    moves = _moves(aim, lengths, max_move_km)
    left = aim.unsqueeze(-2) - moves
    shift = aim - (posterior.points * posterior.weights.unsqueeze(-1)).sum(-2)
    distance = posterior.mean_distance(moves - shift.unsqueeze(-2)).to(aim.dtype)  # that of now is the same for all
    cost = moves.norm(dim=-1) + distance * (1 + step_km / max_move_km).unsqueeze(-1)
    after = _covariance_after(track, moves, left, sensor_std, range_km, scales, bias_std, curvature)
    best = (cost + caution * _detour(left, after)).argmin(-1)[..., None, None]
    return moves.gather(-2, best.expand(*best.shape[:-1], 2)).squeeze(-2)


def corrected(way: Tensor, correction: Tensor) -> Tensor:
    """Return a planned displacement with a correction that does not depend on its length.

    Args:
        way: ``(..., 2)`` planned displacement [km].
        correction: ``(..., 2)`` of the logarithm of its length, and of its direction, in units of
            :data:`CORRECTION`.

    Example:
        >>> corrected(torch.tensor([20.0, 0.0]), torch.zeros(2))
        tensor([20.,  0.])
        >>> corrected(torch.tensor([20.0, 0.0]), torch.tensor([2.0, 3.0])).round()  # e times as far, to the right
        tensor([ 4., 54.])
    """
    check_tensor(2, way=way, correction=correction)
    stretch, angle = (CORRECTION * correction).unbind(-1)
    (x, y), cos, sin = way.unbind(-1), torch.cos(angle), torch.sin(angle)
    return torch.exp(stretch).unsqueeze(-1) * torch.stack((cos * x - sin * y, sin * x + cos * y), -1)


def _moves(way: Tensor, lengths: Sequence[float], max_move_km: float) -> Tensor:
    """Return the displacements ``(..., M, 2)`` [km] that are compared, given the way ``(..., 2)``."""
    distance = way.norm(dim=-1, keepdim=True)
    whole, least = (x.clamp_max(max_move_km) for x in (distance, SHORTEST * distance))
    fixed = torch.maximum(way.new_tensor(lengths) * max_move_km, least)
    bearing = torch.atan2(way[..., 1:], way[..., :1]) + torch.deg2rad(way.new_tensor(ANGLES_DEG))
    directions = torch.stack((torch.cos(bearing), torch.sin(bearing)), -1)
    return (torch.cat((fixed, whole), -1)[..., None, None] * directions.unsqueeze(-3)).flatten(-3, -2)


def _covariance_after(
    track: FieldTrack,
    moves: Tensor,
    left: Tensor,
    sensor_std: PerElement,
    range_km: float,
    scales: PerElement,
    bias_std: PerElement | None,
    curvature: PerElement | None,
) -> _Entries:
    """Return the expected covariance of the way, three entries ``(..., M)`` [km^2], after moves and readings.

    The gradients that a reading will teach are unknown, but not their mean square: that of the present estimate plus
    what the covariance decreases. The drift of the gradients is left out, as it does not depend on the choice. It is
    computed by entries, elements first: products of 3 x 3 matrices take five times longer.
    """
    unit = _units(track, scales)
    now, shared = related(track, curl_relation, scales)
    after = _after(track, moves, _variance(sensor_std, unit))
    elements = (track.mean[..., :1] + track.mean[..., 1:] @ (moves.mT / DISTANCE_SCALE_KM)) * unit.unsqueeze(-1)
    shared_after = _shared(elements.mT, after, unit)
    dn, de = (left / DISTANCE_SCALE_KM).unbind(-1)
    p00, p01, p02, p11, p12, p22 = after
    variance = p00 + dn * (2 * p01 + p11 * dn + 2 * p12 * de) + de * (2 * p02 + p22 * de)
    variance = variance + _square("bias_std", bias_std, track, unit)
    variance = variance + _square("curvature", curvature, track, unit) * (dn * dn + de * de).square() / 4
    weight, together = variance.reciprocal(), shared_after[0] + shared_after[1] * dn + shared_after[2] * de
    row = weight * together  # the inverse covariance of the elements: diag(weight) + row row^T / rest
    rest = (1 - (row * together).sum(0)).reciprocal()
    teaching = weight + row.square() * rest
    before = _entries(track, track.mean.shape[:-1])[1][3:]
    nn, ne, ee = ((teaching * (b.unsqueeze(-1) - a)).sum(0) for a, b in zip((p11, p12, p22), before, strict=True))
    given = (rows.movedim((-1, -2), (0, 1)).unsqueeze(-1) for rows in (now.mean[..., 1:], shared[..., 1:]))
    for (north, east), sign in zip((*given, shared_after[1:]), (1, -1, 1), strict=True):
        wn, we, rn, re = weight * north, weight * east, (row * north).sum(0), (row * east).sum(0)
        nn = nn + sign * ((wn * north).sum(0) + rn * rn * rest)
        ne = ne + sign * ((wn * east).sum(0) + rn * re * rest)
        ee = ee + sign * ((we * east).sum(0) + re * re * rest)
    return _inverse(nn, ne, ee, range_km)


def _after(track: FieldTrack, moves: Tensor, noise: Tensor) -> Sequence[Tensor]:
    """Return the six entries ``(E, ..., M)`` of the covariance after moves ``(..., M, 2)`` and a reading."""
    p00, p01, p02, p11, p12, p22 = (
        entry.unsqueeze(-1) for entry in _entries(track, torch.Size((*moves.shape[:-2], noise.shape[-1])))[1]
    )
    dn, de = (moves / DISTANCE_SCALE_KM).unbind(-1)
    fp01, fp02 = p01 + p11 * dn + p12 * de, p02 + p12 * dn + p22 * de
    variance = p00 + (p01 + fp01) * dn + (p02 + fp02) * de
    r = noise.movedim(-1, 0)
    share = r.unsqueeze(-1) if r.ndim > 1 else r.reshape(-1, *(1 for _ in moves.shape[:-1]))
    total = (variance + share).reciprocal()
    share, gain_n, gain_e = share * total, fp01 * total, fp02 * total
    block = p11 - gain_n * fp01, p12 - gain_n * fp02, p22 - gain_e * fp02
    return variance * share, fp01 * share, fp02 * share, *block


def _shared(elements: Tensor, covariance: Sequence[Tensor], unit: Tensor) -> Sequence[Tensor]:
    """Return what the curl relation at places of elements ``(..., M, E)`` makes them share: 3 x ``(E, ..., M)``."""
    relation = curl_relation(elements)
    rows = relation.weights * (unit / DISTANCE_SCALE_KM)[..., None, :, None]
    north, east = rows.movedim((-1, -2), (0, 1)).contiguous()
    _, p01, p02, p11, p12, p22 = covariance
    cross = p01 * north + p02 * east, p11 * north + p12 * east, p12 * north + p22 * east
    scale = ((north * cross[1] + east * cross[2]).sum(0) + relation.std.square()).rsqrt()
    return [entry * scale for entry in cross]


def _square(name: str, std: PerElement | None, track: FieldTrack, unit: Tensor) -> Tensor | float:
    """Return the squares of standard deviations as ``(E, ..., 1)``, in squared scaled units; 0 for None."""
    if std is None:
        return 0.0
    values = _nonnegative_or_nan(name, std, unit.shape[-1], unit) / unit
    return values.square().expand(track.mean.shape[:-1]).movedim(-1, 0).unsqueeze(-1)


def _inverse(nn: Tensor, ne: Tensor, ee: Tensor, range_km: float) -> _Entries:
    """Return the covariance [km^2] of a normal matrix; where rounding leaves it singular, that of the range alone."""
    ridge = (DISTANCE_SCALE_KM / range_km) ** 2
    nn, ee = nn + ridge, ee + ridge
    determinant = nn * ee - ne * ne
    valid, scale = determinant != 0, DISTANCE_SCALE_KM**2 / determinant
    entries = (ee * scale, range_km**2), (-ne * scale, 0.0), (nn * scale, range_km**2)
    return tuple(entry.where(valid, otherwise) for entry, otherwise in entries)  # type: ignore[return-value]


def _detour(left: Tensor, covariance: _Entries) -> Tensor:
    """Return the detour ``(..., M)`` [km] for remaining ways ``(..., M, 2)`` of a covariance.

    It is the hypotenuse over the way and the standard deviation across it, minus the way. Near the destination, the
    standard deviation along the way counts as well.
    """
    (nn, ne, ee), distance = covariance, left.norm(dim=-1)
    north, east = (left / distance.clamp_min(1e-9).unsqueeze(-1)).unbind(-1)
    along = nn * north * north + 2 * ne * north * east + ee * east * east
    across = nn + ee - along
    return torch.sqrt(distance.square() + across + along / (1 + (distance / NEAR_KM).square())) - distance
