"""Where the destination is, given its elements: the posterior of the displacement as weighted points.

At a displacement d along a great circle, the field is linear in the coefficients of a belief, H(d) c
(:func:`~magrl.pilot.harmonics.field_rows`, with the higher degrees as their regression). It is given in axes that
are carried along the great circle; north there differs from theirs by the angle gamma(d) of the meridians, by which the
vector of the destination's elements is turned back, and the vertical on the ellipsoid by a small angle more. The
posterior's density is the density of the vector, under the normal distribution of the predicted field, times a normal
prior of the displacement. It may have long tails and several maxima, so it is evaluated at points of two densities:
around its mode, and around the vehicle at all distances.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from magrl.field.elements import field_vector
from magrl.pilot.anomalies import crust_correlation, crust_share
from magrl.pilot.belief import ANOMALY, MODEL_NT, PLACE, Belief
from magrl.pilot.displacement import DestinationPosterior, Displacement, displacement_between
from magrl.pilot.harmonics import UNIT_KM, constant, powers, turning
from magrl.pilot.local import COEFFICIENTS, cholesky2, levers, monomial_rows, unturned
from magrl.pilot.prior import DEGREE, HIGHEST, closure
from magrl.sensor_std import PERFECT, SensorStd

RANGE_KM = 400.0
"""Default of the prior standard deviation of the displacement along each axis [km]."""
_NEAR_KM, _FAR_KM = 4.0, 2000.0  # distances between which the points around the vehicle thin out; none is farther
_ELSEWHERE_LOG = -39.0  # its log density: e^-7, over the volume of all fields on the Earth [nT^3]
_SLACK_NT = 100.0  # deviation of the field at the mode within which a destination is in reach
_SPREAD = 1.5  # standard deviations of the points around the mode, over the mode's
_LEAST_NT = 1.0  # horizontal field whose direction is north
_LEAST_KM = 0.1  # standard deviation of the points around the mode
_LEAST_WEIGHT = 1e-12  # below, products of weights would be denormal numbers, which are slow
_STEPS = 5  # of the search for the mode
_DIFFERENCE_KM = 1.0  # of the derivatives of the predicted field there


class Destination(NamedTuple):
    """A destination as seen from a belief, in units of 1000 km and nT.

    Attributes:
        belief: what is known of the field; where the crust has one, the share of the anomaly that the destination has,
            too, is part of the field.
        field: ``(..., 3)`` at the destination, in the axes there.
        range: prior standard deviation of the displacement along each axis.
        noise: ``(...)`` variance of the field in each axis that the belief does not know: of the given elements.
        crust: ``(...)`` standard deviation of the crust's field in each axis.
        share: ``(..., 3, 3)`` of the anomaly that is crust; 0 between places.
        between: displacement between the places of vehicle and destination, where both are known.

    Example:
        >>> Destination._fields[:4]
        ('belief', 'field', 'range', 'noise')
    """

    belief: Belief
    field: Tensor
    range: float
    noise: Tensor
    crust: Tensor
    share: Tensor
    between: Displacement | None = None

    def noise_at(self, square: Tensor) -> Tensor:
        """Return the variance of the field in each axis that the belief does not know, at squared distances [unit^2].

        The crust's field there differs from that here by ``2 (1 - rho)`` of its variance, with their correlation rho.
        """
        noise, crust = (part.to(square).unsqueeze(-1) for part in (self.noise, 2 * self.crust.square()))
        return noise + crust * (1 - crust_correlation(square))


def destination(
    belief: Belief,
    elements: Tensor,
    range_km: float,
    crust_nt: Tensor | float = 0.0,
    errors: SensorStd = PERFECT,
    std: Tensor | None = None,
    place: Tensor | None = None,
    place_km: float = 0.0,
) -> Destination:
    """Return the destination where the field has given elements.

    Args:
        belief: what is known of the field.
        elements: ``(..., 3)``: D [deg], I [deg], B_H [nT] at the destination.
        range_km: prior standard deviation of the displacement along each axis [km].
        crust_nt: ``(...)`` standard deviation of the crust's field in each axis [nT].
        errors: accuracy of the readings, tensors ``(..., 3)``.
        std: ``(3,)`` standard deviations of the elements; 0 by default.
        place: ``(..., 2)`` latitude, longitude [deg] of the destination, where that is known and the vehicle knows its
            own; the elements count before (:func:`~magrl.pilot.survey.surveyed`).
        place_km: its root mean square error [km].

    Example:
        >>> from magrl.pilot.belief import start
        >>> belief = start(torch.tensor([3.0, 65.0, 18000.0]), SensorStd())
        >>> destination(belief, torch.tensor([3.0, 66.0, 17500.0]), 300.0).noise
        tensor(4., dtype=torch.float64)
    """
    field, crust, between = field_vector(elements.double()), torch.as_tensor(crust_nt).to(belief.mean), None
    noise, share = torch.full_like(crust, MODEL_NT**2), torch.zeros_like(belief.covariance[..., :3, :3])
    if place is not None:
        apart = displacement_between(belief.place, place)
        between = Displacement(apart, belief.covariance[..., PLACE, PLACE] + torch.eye(2).to(apart) * (place_km**2 / 2))
    else:
        noise, share = noise + _variance(field, std), crust_share(belief.field, errors, crust)
        step = torch.diag_embed(torch.ones_like(belief.mean))
        step[..., :3, ANOMALY] = share
        mean = (step @ belief.mean.unsqueeze(-1)).squeeze(-1)
        belief = Belief(mean, step @ belief.covariance @ step.mT, belief.place)
    return Destination(belief, field, range_km / UNIT_KM, noise, crust, share, between)


def _variance(field: Tensor, std: Tensor | None) -> Tensor:
    """Return the mean variance ``(...)`` of a field in its axes [nT^2] that is given by elements of an accuracy."""
    if std is None:
        return torch.zeros_like(field[..., 0])
    x, y, z = field.unbind(-1)
    level = x * x + y * y
    d, i, h = (std.to(field).square() * std.new_tensor((math.pi / 180, math.pi / 180, 1)).to(field).square()).unbind(-1)
    return (level * d + (level + z * z).square() / level * i + (1 + z * z / level) * h) / 3


def log_density(goal: Destination, points: Tensor) -> Tensor:
    """Return the logarithm ``(..., M)`` of the posterior's density at displacements ``(..., M, 2)`` [km], but a
    constant.

    Example:
        >>> from magrl.sensor_std import SensorStd
        >>> from magrl.pilot.belief import start
        >>> there = destination(start(torch.tensor([3.0, 65.0, 18000.0]), SensorStd()), torch.zeros(3), 300.0)
        >>> log_density(there, torch.zeros(5, 2)).shape
        torch.Size([5])
    """
    points = points / UNIT_KM
    return _log_density(goal, points, _moments(goal.belief, points))


def mode(goal: Destination) -> Displacement:
    """Return about where the posterior is largest, by Gauss-Newton steps, and the inverse of their normal matrix.

    The covariance of the field there counts as constant in each step. The first step has the mean covariance over the
    prior of the displacement, the others that at the solution before.

    Example:
        >>> from magrl.sensor_std import SensorStd
        >>> from magrl.pilot.belief import start
        >>> here = torch.tensor([3.0, 65.0, 18000.0])
        >>> mode(destination(start(here, SensorStd()), here, 300.0)).mean.round().abs()
        tensor([0., 0.], dtype=torch.float64)
    """
    cross = torch.eye(2).to(goal.field)
    around = (torch.cat((cross, -cross)) * (goal.range * math.sqrt(2))).expand(*goal.field.shape[:-1], 4, 2)
    start = _covariance(goal, around, _moments(goal.belief, around))[1]
    covariance = [entry.mean(-1, keepdim=True) for entry in start]
    corners = torch.cat((torch.zeros_like(cross[:1]), cross)) * (_DIFFERENCE_KM / UNIT_KM)
    place, ridge = torch.zeros_like(goal.field[..., :2]), goal.range**-2
    for index in range(_STEPS):
        points = place.unsqueeze(-2) + corners
        moments = _moments(goal.belief, points)
        residual, at = _covariance(goal, points, moments)
        inverse, _ = _inverse([entry[..., :1] for entry in at] if index else covariance)
        value, north, east = residual.split(1, -1)
        north, east = ((value - x) * (UNIT_KM / _DIFFERENCE_KM) for x in (north, east))  # slopes of the prediction
        pairs = (north, north), (north, east), (east, east), (north, value), (east, value)
        nn, ne, ee, nr, er = (_quadratic(inverse, *pair).squeeze(-1) for pair in pairs)
        nn, ee = nn + ridge, ee + ridge
        nr, er = nr - ridge * place[..., 0], er - ridge * place[..., 1]
        determinant = (nn * ee - ne * ne).unsqueeze(-1)
        place = place + torch.stack((ee * nr - ne * er, nn * er - ne * nr), -1) / determinant
        place = place * (_FAR_KM / UNIT_KM / place.norm(dim=-1, keepdim=True)).clamp_max(1)
    matrix = torch.stack((ee, -ne, -ne, nn), -1) / determinant
    return Displacement(place * UNIT_KM, matrix.unflatten(-1, (2, 2)) * UNIT_KM**2)


def posterior(goal: Destination, count: int = 256) -> DestinationPosterior:
    """Return the posterior of the displacement to a destination, in single precision.

    A quarter of the points are around the mode, the others around the vehicle; the weight of each is the density over
    the density of all points there.

    Args:
        goal: the destination.
        count: number of points.

    Source:
        A. B. Owen and Y. Zhou, Safe and effective importance sampling, Journal of the American Statistical Association
        95 (2000): weights for points of several densities.

    Example:
        >>> from magrl.sensor_std import SensorStd
        >>> from magrl.pilot.belief import start
        >>> belief = start(torch.tensor([0.0, 60.0, 20000.0]), SensorStd(torch.tensor([0.05, 0.05, 5.0])))
        >>> there = destination(belief, torch.tensor([0.0, 61.0, 19000.0]), 300.0)
        >>> posterior(there).displacement().mean.round(decimals=-1)
        tensor([ 30., -10.])
    """
    if goal.between is not None:
        return _normal(goal.between, count)
    displacement = mode(goal)
    distance = displacement.mean.norm(dim=-1, keepdim=True)
    ahead = torch.tensor([1.0, 0.0]).to(distance)
    heading = torch.where(distance > 0, displacement.mean / distance, ahead)
    points, density = _points(Displacement(*(part.float() for part in displacement)), heading.float(), count)
    near, around = (points / UNIT_KM).split((count // 4, count - count // 4), -2)
    parts = (near, _moments(goal.belief, near)), (around, _moments_around(goal.belief, heading, count))
    logarithms = [_log_density(goal, *part) for part in parts]
    far = points.norm(dim=-1) > _FAR_KM  # where the polynomials do not hold
    mass = (torch.cat(logarithms, -1) - density.log()).masked_fill(far, -torch.inf)
    weights = torch.softmax(mass, -1)
    volume = math.log(2 * math.pi * (goal.range * UNIT_KM) ** 2) + 1.5 * math.log(2 * math.pi)  # of prior and field
    reached = torch.sigmoid(torch.logsumexp(mass, -1) - volume - _ELSEWHERE_LOG)
    place = (displacement.mean / UNIT_KM).unsqueeze(-2)
    miss = _covariance(goal, place, _moments(goal.belief, place))[0].squeeze(-1).norm(dim=-1)
    reached = torch.where(miss < _SLACK_NT, 1.0, reached)  # crust and sensors deviate by so much, too
    return DestinationPosterior(points, weights.where(weights > _LEAST_WEIGHT, 0.0), reached)


def _normal(displacement: Displacement, count: int) -> DestinationPosterior:
    """Return points of a normal distribution, of equal weights."""
    points = unit_points(4 * count)[0].to(displacement.mean)
    first, below, second = cholesky2(displacement.covariance.unsqueeze(-3), _LEAST_KM**2)
    x, y = points.unbind(-1)
    apart = torch.stack((first * x, below * x + second * y), -1)
    apart = apart - apart.mean(-2, keepdim=True)
    places = (displacement.mean.unsqueeze(-2) + apart).float()
    return DestinationPosterior(places, torch.full_like(places[..., 0], 1 / count), torch.ones_like(places[..., 0, 0]))


def _with_latitude(levers: Tensor, field: Tensor, slope: Tensor) -> Tensor:
    """Return rows with the effect of the latitude's offset, which turns a field ``(..., M, 3)`` by ``slope`` for each
    kilometer."""
    x, y, _ = field.unbind(-1)
    return torch.cat((levers, torch.stack((-slope * y, slope * x, torch.zeros_like(x)), -1).unsqueeze(-1)), -1)


class _Moments(NamedTuple):
    """Moments of the predicted field in axes that are carried to M points: the mean ``(..., 3, M)``, the covariance
    with the latitude's offset ``(..., 3, M)`` and the six entries of the covariance without it ``(..., M)``; all but
    these in axes that are turned so that a ``heading (..., 2)``, a unit vector, is their first."""

    mean: Tensor
    cross: Tensor
    entries: Sequence[Tensor]
    heading: Tensor


_ENTRIES = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # of a symmetric matrix


def _moments(belief: Belief, points: Tensor) -> _Moments:
    """Return the moments at displacements ``(..., M, 2)`` [unit], in their dtype."""
    lever, state = levers(points), _state(belief).to(points)
    spread = (lever.flatten(-3, -2) @ state).unflatten(-2, (-1, 3))  # (..., M, 3, K + 2)
    mean, cross = spread[..., -2:].permute(*range(points.ndim - 2), -1, -2, -3).unbind(-3)
    product = spread[..., :-2] @ lever.mT
    ahead = torch.eye(2).to(points)[0].expand_as(points[..., 0, :])
    return _Moments(mean, cross, [product[..., i, j] for i, j in _ENTRIES], ahead)


def _moments_around(belief: Belief, heading: Tensor, count: int) -> _Moments:
    """Return the moments at the points around the vehicle, which are the same for all vehicles but for a turn."""
    lever, products, upper = _around(count)
    turn = turning(heading[..., 0], -heading[..., 1], DEGREE)
    state = _state(belief)
    covariance = (turn @ state[..., :-2] @ turn.mT).flatten(-2).index_select(-1, upper.to(heading.device))
    entries = (covariance @ products.to(covariance)).unflatten(-1, (6, -1)).float().unbind(-2)
    vectors = (turn @ state[..., -2:]).mT @ lever.to(covariance)
    mean, cross = vectors.unflatten(-1, (3, -1)).float().unbind(-3)
    return _Moments(mean, cross, entries, heading.float())


def _state(belief: Belief) -> Tensor:
    """Return the coefficients' covariance, their mean and their covariance with the latitude's offset, as columns."""
    mean, block = belief.mean[..., :COEFFICIENTS, None], belief.covariance[..., :COEFFICIENTS, : COEFFICIENTS + 1]
    return torch.cat((block[..., :-1], mean, block[..., -1:]), -1)


@constant
def _around(count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the field at the points around the vehicle: its rows ``(K, 3 M)``, and for its covariance the rows of the
    upper triangle of the coefficients' covariance ``(K (K + 1) / 2, 6 M)``, and where these are in it, flattened."""
    points = unit_points(count)[1] / UNIT_KM
    lever = torch.tensordot(powers(points, HIGHEST), monomial_rows(HIGHEST), 1)  # (M, 3, K)
    first, second = torch.triu_indices(COEFFICIENTS, COEFFICIENTS)
    rows = []
    for i, j in _ENTRIES:
        product = lever[:, i, :, None] * lever[:, j, None, :]
        whole = product + product.mT - torch.diag_embed(product.diagonal(dim1=-2, dim2=-1))
        rows.append(whole[:, first, second])
    return lever.permute(2, 1, 0).flatten(1), torch.cat(rows).mT.contiguous(), first * COEFFICIENTS + second


def _log_density(goal: Destination, points: Tensor, moments: _Moments) -> Tensor:
    """Return :func:`log_density` at displacements ``(..., M, 2)`` [unit], given the moments there."""
    residual, covariance = _covariance(goal, points, moments)
    inverse, volume = _inverse(covariance, MODEL_NT**6)  # the least volume, but for rounding
    square = _quadratic(inverse, residual, residual) + points.square().sum(-1) / goal.range**2
    return -(square + volume.log()) / 2


def _covariance(goal: Destination, points: Tensor, moments: _Moments) -> tuple[Tensor, list[Tensor]]:
    """Return the destination's field minus the predicted one ``(..., 3, M)`` in the axes of the moments, and the six
    entries of its covariance ``(..., M)``.

    To the moments it adds the latitude's offset, which turns the field by ``slope`` for each kilometer, the field that
    is left out, and what the belief does not know.
    """
    target, slope = _carried(goal, points, moments.heading)
    (x, y, _), (cx, cy, cz) = moments.mean.unbind(-2), moments.cross.unbind(-2)
    offset, variance = (
        part.to(points).unsqueeze(-1)
        for part in (goal.belief.mean[..., COEFFICIENTS], goal.belief.covariance[..., COEFFICIENTS, COEFFICIENTS])
    )
    x, y = -slope * y, slope * x  # derivatives of the field with respect to the latitude
    residual = target - moments.mean - torch.stack((x * offset, y * offset, torch.zeros_like(x)), -2)
    apart = points.square().sum(-1) ** DEGREE * closure().left_out_nt ** 2 + goal.noise_at(points.square().sum(-1))
    xx, xy, xz, yy, yz, zz = moments.entries
    xx, xz = xx + 2 * x * cx + x * x * variance + apart, xz + x * cz
    xy, yy, yz = xy + x * cy + y * cx + x * y * variance, yy + 2 * y * cy + y * y * variance + apart, yz + y * cz
    return _without_declination(goal, residual, [xx, xy, xz, yy, yz, zz + apart], moments.mean)


def _without_declination(
    goal: Destination, residual: Tensor, covariance: list[Tensor], mean: Tensor
) -> tuple[Tensor, list[Tensor]]:
    """Return a residual ``(..., 3, M)`` and its covariance along the predicted magnetic north and downward, where the
    belief's axes are from magnetic north: D of the destination is then not comparable.

    The second of the axes is left with a residual of 0.
    """
    xx, xy, xz, yy, yz, zz = covariance
    north, east = mean[..., 0, :], mean[..., 1, :]
    level = torch.hypot(north, east).clamp_min(_LEAST_NT)
    cos, sin, none = north / level, east / level, torch.zeros_like(level)
    along = torch.hypot(*goal.field[..., :2].to(mean).unbind(-1)).unsqueeze(-1) - level
    other = cos * cos * xx + 2 * cos * sin * xy + sin * sin * yy, none, cos * xz + sin * yz
    magnetic = goal.belief.magnetic.unsqueeze(-1)
    turned = [*other, none + goal.noise.to(none).unsqueeze(-1), none, zz]
    residual = torch.where(magnetic.unsqueeze(-1), torch.stack((along, none, residual[..., 2, :]), -2), residual)
    return residual, [torch.where(magnetic, new, old) for new, old in zip(turned, covariance, strict=True)]


def _carried(goal: Destination, points: Tensor, heading: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return the destination's field in the axes that are carried from the vehicle ``(..., 3, M)``, turned so that
    the heading is their first, and the derivative of the angle of the meridians with respect to the latitude
    ``(..., M)`` [rad/km].
    """
    field = goal.field.to(points).unsqueeze(-2)
    (x, y, z), slope = unturned(field, goal.belief.latitude, points)
    if heading is not None:
        cos, sin = heading.unsqueeze(-2).unbind(-1)
        x, y = x * cos + y * sin, y * cos - x * sin
    return torch.stack((x, y, z), -2), slope


def _inverse(entries: Sequence[Tensor], least: float = 0.0) -> tuple[list[Tensor], Tensor]:
    """Return the six entries of the inverses of covariances, and their determinants, at least some number."""
    a, b, c, d, e, f = entries
    minors = d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b
    determinant = (a * minors[0] + b * minors[1] + c * minors[2]).clamp_min(least)
    return [minor / determinant for minor in minors], determinant


def _quadratic(entries: Sequence[Tensor], left: Tensor, right: Tensor) -> Tensor:
    """Return the form of a symmetric matrix of columns ``(..., 3, M)``."""
    a, b, c, d, e, f = entries
    (x, y, z), (u, v, w) = left.unbind(-2), right.unbind(-2)
    return x * (a * u + b * v + c * w) + y * (b * u + d * v + e * w) + z * (c * u + e * v + f * w)


def _points(displacement: Displacement, heading: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return points ``(..., M, 2)`` around a displacement of a heading ``(..., 2)`` and around the vehicle [km].

    Their density ``(..., M)``, unnormalized, is the second value.

    They are laid out along and across the displacement, so that they turn with it.
    """
    normal, around = (points.to(displacement.mean) for points in unit_points(count))
    distance, (cos, sin) = displacement.mean.norm(dim=-1), heading.unbind(-1)
    turn = torch.stack((torch.stack((cos, -sin), -1), torch.stack((sin, cos), -1)), -2)  # columns: along, across
    covariance = turn.mT @ displacement.covariance @ turn * _SPREAD**2
    first, below, second = cholesky2(covariance.unsqueeze(-3), _LEAST_KM**2)
    x, y = normal.unbind(-1)
    near = torch.stack((distance.unsqueeze(-1) + first * x, below * x + second * y), -1)
    points = torch.cat((near, around.expand(*near.shape[:-2], *around.shape)), -2)
    along, across = points.unbind(-1)
    z0 = (along - distance.unsqueeze(-1)) / first
    z1 = (across - below * z0) / second
    bell = torch.exp(-(z0 * z0 + z1 * z1) / 2) * (len(normal) / (2 * math.pi)) / (first * second)
    inverse_square = len(around) / (2 * math.pi * _MASS) / points.square().sum(-1).clamp_min(_NEAR_KM**2)
    return points @ turn.mT, bell + inverse_square


_MASS = 0.5 + math.log(_FAR_KM / _NEAR_KM)  # of the density within the nearest distance and beyond, over 2 pi


@constant
def unit_points(count: int) -> tuple[Tensor, Tensor]:
    """Return quasi-random points: a quarter of a standard normal, and the others around the vehicle [km].

    Their density is the inverse square of the distance, and constant within the nearest.
    """
    first = torch.quasirandom.SobolEngine(2, scramble=True, seed=0).draw(count // 4, dtype=torch.float64)
    second = torch.quasirandom.SobolEngine(2, scramble=True, seed=1).draw(count - count // 4, dtype=torch.float64)
    share, turn = second.unbind(-1)
    beyond, bearing = share * _MASS - 0.5, 2 * math.pi * turn
    radius = _NEAR_KM * torch.where(beyond < 0, (2 * beyond + 1).clamp_min(0).sqrt(), torch.exp(beyond))
    around = torch.stack((radius * torch.cos(bearing), radius * torch.sin(bearing)), -1)
    return torch.special.ndtri(first.clamp(1e-6, 1 - 1e-6)), around
