"""What is known of the field around a vehicle in advance: the local coefficients of random planets, in closed form.

The Gauss coefficients of :func:`~magrl.field.planets.random_planets` are independent, and but for the axial dipole all
of a degree have one variance. About local axes (the pole is in the direction of z) a coefficient of degree n and order
m has these local coefficients (:mod:`~magrl.pilot.harmonics`), of that order and of each degree k from max(m, 1) on:

    -(-1)^(n + m) sqrt((2 - delta_m0) / ((n - m)! (n + m)!)) (n + k)! R^(1 - k)    (half of it where m > 0)

So the local coefficients are normal, too, and only their part by the axial dipole depends on the latitude.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from magrl.field.elements import elements_jacobian
from magrl.field.planets import gauss_moments
from magrl.pilot.harmonics import RADIUS, constant, field_rows, generators, orders, size, turning
from magrl.sensor_std import SensorStd

DEGREE = 3
"""Highest degree of the coefficients that a belief holds; with 4, nothing is gained (random planets)."""
ANGLES = 12
"""Number of directions of true north from magnetic north, where it is not known."""
CELLS = 36
"""Number of cells of latitude. Their 5 degrees are less than what a first reading leaves of it (about 10)."""
HIGHEST = 8
"""Highest degree that is predicted from the degrees of a belief; with 6, half as much more is left out at 1200 km."""
LEAST_COS = 0.2
"""Least cosine of the inclination in the downward part of an anomaly, which follows from the error of I."""
_FOLLOWED = 10  # highest degree of the coefficients whose effect is counted as left out


def local_coefficient(n: int, order: int, k: int) -> float:
    """Return the local coefficient of degree k of a Gauss coefficient of degree n = 1 nT about local axes.

    Args:
        n: degree of the Gauss coefficient.
        order: order of both; negative for the coefficient of the sine.
        k: degree of the local coefficient.

    Example:
        >>> local_coefficient(1, 1, 1), round(local_coefficient(1, 0, 1))  # at the equator and at the pole of a dipole
        (-1.0, 2)
    """
    m = abs(order)
    if k < m or n < m:
        return 0.0
    norm = math.sqrt((2 - (m == 0)) / (math.factorial(n - m) * math.factorial(n + m)))
    return -((-1) ** (n + m)) * norm * math.factorial(n + k) * RADIUS ** (1 - k) * (0.5 if m else 1.0)


def local_covariance(variance: Tensor, degree: int) -> Tensor:
    """Return the covariance ``(K, K)`` of local coefficients, where all Gauss coefficients of a degree have a variance.

    Args:
        variance: ``(N + 1,)`` variances of the Gauss coefficients by degree [nT^2].
        degree: highest degree of the local coefficients.

    Example:
        >>> local_covariance(torch.tensor([0.0, 1.0]), 1).diagonal()
        tensor([1., 1., 4.], dtype=torch.float64)
    """
    places = orders(degree)
    table = [[local_coefficient(n, m, k) for k, m in places] for n in range(1, len(variance))]
    columns = torch.tensor(table, dtype=torch.float64)
    order = torch.tensor([m for _, m in places])
    return (columns.mT * variance[1:].double()) @ columns * (order == order.unsqueeze(-1))


class Closure(NamedTuple):
    """What higher degrees do, which a belief does not hold, given the degrees that it holds.

    Attributes:
        extend: ``(K', K)``, the coefficients of degrees 1 to :data:`HIGHEST`, from degrees 1 to N.
        drift: ``(K, K)`` [nT^2 per unit^2], covariance of the coefficients after a leg by the coefficients of degree
            N + 1 that differ from the expected ones.
        left_out_nt: standard deviation of the field at a distance of a unit by all that differs from the expected
            [nT]; it grows with the N-th power of the distance.

    Example:
        >>> closure().extend.shape
        torch.Size([80, 15])
    """

    extend: Tensor
    drift: Tensor
    left_out_nt: float


@constant
def closure() -> Closure:
    """Return the regression of the coefficients of higher degrees on a belief's, under the spectrum.

    Its covariance has no preferred direction (the dipole's variance is shared over its three coefficients), so the
    regression commutes with turns.

    Example:
        >>> round(closure().left_out_nt, 1)
        17.5
    """
    axial, axial_variance, variance = gauss_moments()
    variance = variance.clone()
    variance[1] = (axial**2 + axial_variance + 2 * variance[1]) / 3
    covariance, low, all_ = local_covariance(variance, _FOLLOWED), size(DEGREE), size(HIGHEST)
    known = covariance[:low, :low]
    scale = known.diagonal().rsqrt()
    inverse = torch.linalg.inv(known * scale * scale.unsqueeze(-1)) * scale * scale.unsqueeze(-1)
    extend = torch.cat((torch.eye(low, dtype=torch.float64), covariance[low:all_, :low] @ inverse))
    apart = torch.eye(len(covariance), dtype=torch.float64)
    apart[:all_, :low] -= extend
    left = apart @ covariance @ apart.mT
    north = field_rows(_FOLLOWED, _FOLLOWED)
    alone = [j * (j + 1) // 2 for j in range(_FOLLOWED + 1)]  # powers of the distance northward, at a unit
    northward = north[alone].sum(0)
    left_out = float((northward @ left @ northward.mT).trace() / 3) ** 0.5
    steps = generators(_FOLLOWED).derivative[:2, :low]
    drift = (steps @ left @ steps.mT).mean(0)
    return Closure(extend, drift, left_out)


class Cells(NamedTuple):
    """Places that a vehicle may be at, with the coefficients of the field there.

    Attributes:
        latitude: ``(C,)`` [rad].
        log_weight: ``(C,)`` logarithm of the probability, plus half the logarithm of the determinant of ``precision``.
        mean: ``(C, K)`` of the coefficients.
        field_covariance: ``(C, 3, 3)`` of the field.
        precision: ``(C, 3, 3)`` inverse of that.
        gain: ``(C, K + 1 - 3, 3)`` regression of the other coefficients and the latitude on the field.
        covariance: ``(C, K + 1 - 3, K + 1 - 3)`` of those, given the field.

    Example:
        >>> latitude_cells().mean.shape
        torch.Size([36, 15])
    """

    latitude: Tensor
    log_weight: Tensor
    mean: Tensor
    field_covariance: Tensor
    precision: Tensor
    gain: Tensor
    covariance: Tensor


def cells(latitude: Tensor, weight: Tensor, mean: Tensor, joint: Tensor) -> Cells:
    """Return cells of places.

    Args:
        latitude: ``(C,)`` [rad].
        weight: ``(C,)`` probabilities, unnormalized.
        mean: ``(C, K)`` of the coefficients.
        joint: ``(C, K + 1, K + 1)`` covariance of the coefficients and the latitude [rad].
    """
    field = joint[:, :3, :3].clone()
    precision = torch.linalg.inv(field).contiguous()
    gain = joint[:, 3:, :3] @ precision
    rest = joint[:, 3:, 3:] - gain @ joint[:, :3, 3:]
    return Cells(latitude, torch.log(weight) + torch.logdet(precision) / 2, mean, field, precision, gain, rest)


@constant
def latitude_cells(angles: int = 1) -> Cells:
    """Return the prior in each cell of latitude.

    Args:
        angles: number of directions of the axes, evenly around: 1 for axes that point northward, more for axes of an
            unknown direction. There are as many cells for each latitude.

    Example:
        >>> latitude_cells().mean[-1, :3].round()  # 2.5 degrees from the north pole
        tensor([ 1196.,     0., 54797.], dtype=torch.float64)
    """
    axial, axial_variance, variance = gauss_moments()
    edge = torch.linspace(-math.pi / 2, math.pi / 2, CELLS + 1, dtype=torch.float64)
    latitude = (edge[1:] + edge[:-1]) / 2
    dipole = [[local_coefficient(1, m, k) if m == axis else 0.0 for axis in (1, 0)] for k, m in orders(DEGREE)]
    north_down = torch.stack((torch.cos(latitude), -torch.sin(latitude)), -1)
    unit = north_down @ torch.tensor(dipole, dtype=torch.float64).mT  # coefficients of an axial dipole of 1 nT
    axial_part = (axial_variance - variance[1]) * unit.unsqueeze(-1) * unit.unsqueeze(-2)
    joint = local_covariance(variance, DEGREE) + axial_part
    joint = torch.nn.functional.pad(joint, (0, 1, 0, 1))
    joint[:, -1, -1] = (math.pi / CELLS) ** 2 / 12
    around = 2 * math.pi * torch.arange(angles, dtype=torch.float64) / angles
    turn = turning(torch.cos(around), torch.sin(around), DEGREE)
    mean = (turn @ (axial * unit)[:, None, :, None]).squeeze(-1).flatten(0, 1)
    turn = torch.nn.functional.pad(turn, (0, 1, 0, 1))
    turn[:, -1, -1] = 1.0
    joint, latitude = (turn @ joint.unsqueeze(1) @ turn.mT).flatten(0, 1), latitude.repeat_interleave(angles)
    return cells(latitude, torch.cos(latitude), mean, joint)


MOST_CELLS = 512
"""Number of cells that are weighed by their whole likelihood: those nearest to the first reading."""


def expected(field: Tensor, where: Cells) -> tuple[Tensor, Tensor]:
    """Return the prior around a first reading, whose own information is still to be added.

    The cells, weighted by the likelihood of the field, are joined to one normal distribution with their moments given
    that field. The field itself keeps the covariance that it has before the reading.

    Args:
        field: ``(..., 3)`` north, east, down [nT].
        where: cells.

    Returns:
        Mean ``(..., K + 1)`` of the coefficients and the latitude [rad], and covariance ``(..., K + 1, K + 1)``.

    Example:
        >>> mean, _ = expected(torch.tensor([15000.0, 0.0, 45000.0], dtype=torch.float64), latitude_cells())
        >>> round(math.degrees(mean[-1]))  # latitude
        47
    """
    where = Cells(*(x.to(field) for x in where))
    if len(where.mean) <= MOST_CELLS:
        return _joined(field, where)
    flat = field.reshape(-1, 3)
    apart = flat.unsqueeze(1) - where.mean[:, :3]
    square = ((apart.unsqueeze(-2) @ where.precision).squeeze(-2) * apart).sum(-1)
    chosen = (where.log_weight - square / 2).topk(MOST_CELLS, -1).indices
    parts = [_joined(point, Cells(*(x[rows] for x in where))) for point, rows in zip(flat, chosen, strict=True)]
    mean, covariance = (torch.stack(part) for part in zip(*parts, strict=True))
    return mean.reshape(*field.shape[:-1], -1), covariance.reshape(*field.shape[:-1], *covariance.shape[1:])


def _joined(field: Tensor, where: Cells) -> tuple[Tensor, Tensor]:
    """Return :func:`expected` of all cells."""
    apart = field.unsqueeze(-2) - where.mean[:, :3]  # (..., C, 3)
    square = (apart.unsqueeze(-2) @ where.precision @ apart.unsqueeze(-1)).squeeze((-2, -1))
    weight = torch.softmax(where.log_weight - square / 2, -1)
    prior = torch.cat((where.mean[:, 3:], where.latitude.unsqueeze(-1)), -1)
    means = prior + (where.gain @ apart.unsqueeze(-1)).squeeze(-1)  # (..., C, K - 2), given the field
    mean = (weight.unsqueeze(-2) @ means).squeeze(-2)
    spread = (means - mean.unsqueeze(-2)) * weight.sqrt().unsqueeze(-1)
    given, gain, wide = (torch.tensordot(weight, x, 1) for x in (where.covariance, where.gain, where.field_covariance))
    lever = torch.cat((torch.eye(3).to(field).expand(*gain.shape[:-2], 3, 3), gain), -2)
    rest = torch.nn.functional.pad(given + spread.mT @ spread, (3, 0, 3, 0))
    return torch.cat((field, mean), -1), lever @ wide @ lever.mT + rest


def lasting_covariances(
    field: Tensor, errors: SensorStd, crust_nt: Tensor | float = 0.0
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the covariances ``(..., 3, 3)`` of constant errors of D, I [deg], B_H [nT], of the anomaly [nT^2], and of
    iron along the vehicle's axes [nT^2].

    The stated drift contains the effect of the iron on the elements, as a mean over the headings. What is left is the
    effect of the anomaly, which has independent parts along magnetic north (that is the error of B_H), across it (B_H
    times the error of D), and downward (what is left of the error of I), or of the crust, where that is larger.

    Args:
        field: ``(..., 3)`` north, east, down [nT].
        errors: accuracy of the readings, tensors ``(..., 3)``.
        crust_nt: ``(...)`` standard deviation of the crust's field in each axis [nT].

    Example:
        >>> errors = SensorStd(bias=torch.tensor([0.5, 0.0, 0.0]), drift=torch.tensor([0.3, 0.0, 0.0]))
        >>> lasting_covariances(torch.tensor([20000.0, 0.0, 30000.0]), errors)[0].diagonal()
        tensor([0.1600, 0.0000, 0.0000], dtype=torch.float64)
    """
    bias, drift, iron = (torch.as_tensor(std).to(field.device, torch.float64).square() for std in errors[1:])
    field = field.double()
    bias = torch.where(bias < math.inf, bias, 0.0)  # D is then no reading
    level = iron[..., :2].mean(-1)
    axes = torch.stack((level, level, iron[..., 2]), -1)
    spread = (elements_jacobian(field).square() @ axes.unsqueeze(-1)).squeeze(-1)
    d, i, along = (drift - spread).clamp_min(0).unbind(-1)
    x, y, z = field.unbind(-1)
    square, total = x * x + y * y, field.square().sum(-1)
    across, tilt = torch.deg2rad(d.sqrt()).square() * square, torch.deg2rad(i.sqrt()).square() * total
    down = (tilt - z * z / total * along).clamp_min(0) / (square / total).clamp_min(LEAST_COS**2)
    cos, sin, none = x / square.sqrt(), y / square.sqrt(), torch.zeros_like(along)
    turn = torch.stack((cos, -sin, none, sin, cos, none, none, none, none + 1), -1).unflatten(-1, (3, 3))
    stated = torch.stack((along, across, down), -1)
    crust = torch.as_tensor(crust_nt).to(stated).square().unsqueeze(-1)
    anomaly = turn @ torch.diag_embed(torch.maximum(stated, crust)) @ turn.mT
    return torch.diag_embed((bias - drift).clamp_min(0)), anomaly, torch.diag_embed(iron)
