"""What is known of the field around a vehicle in advance: the local coefficients of random planets, in closed form.

The Gauss coefficients of :func:`~magrl.field.planets.random_planets` are independent, and but for the axial dipole all
of a degree have one variance. About local axes (the pole is in the direction of z) a coefficient of degree n and order
m has these local coefficients (:mod:`~magrl.tracking.harmonics`), of that order and of each degree k from max(m, 1) on:

    -(-1)^(n + m) sqrt((2 - delta_m0) / ((n - m)! (n + m)!)) (n + k)! R^(1 - k)    (half of it where m > 0)

So the local coefficients are normal, too, and only their part by the axial dipole depends on the latitude.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from magrl.field.planets import gauss_moments
from magrl.tracking.harmonics import RADIUS, constant, field_rows, generators, orders, size, turning

DEGREE = 3
"""Highest degree of the coefficients that a belief holds; with 4, nothing is gained (random planets)."""
ANGLES = 12
"""Number of directions of true north from magnetic north, where it is not known."""
CELLS = 36
"""Number of cells of latitude. Their 5 degrees are less than what a first reading leaves of it (about 10)."""
HIGHEST = 8
"""Highest degree that is expected from those of a belief; with 6, half as much more is left out at 1200 km."""
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
        extend: ``(K', K)``, the coefficients of degrees 1 to :data:`HIGHEST`, from those of 1 to N.
        drift: ``(K, K)`` [nT^2 per unit^2], covariance of the coefficients after a move by the coefficients of degree
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
    """Return the regression of the coefficients of higher degrees on those of a belief, under the spectrum.

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


class LatitudeCells(NamedTuple):
    """The prior in cells of latitude, given the field at the vehicle: constants for :func:`expected`.

    Attributes:
        latitude: ``(C,)`` middle of each cell [rad].
        log_weight: ``(C,)`` logarithm of the share of the sphere, over the root of the determinant of the covariance.
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


@constant
def latitude_cells(angles: int = 1) -> LatitudeCells:
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
    field = joint[:, :3, :3].clone()
    around = 2 * math.pi * torch.arange(angles, dtype=torch.float64) / angles
    turn = turning(torch.cos(around), torch.sin(around), DEGREE)
    mean = (turn @ (axial * unit)[:, None, :, None]).squeeze(-1).flatten(0, 1)
    turn = torch.nn.functional.pad(turn, (0, 1, 0, 1))
    turn[:, -1, -1] = 1.0
    joint, latitude = (turn @ joint.unsqueeze(1) @ turn.mT).flatten(0, 1), latitude.repeat_interleave(angles)
    field = joint[:, :3, :3].clone()
    precision = torch.linalg.inv(field).contiguous()
    gain = joint[:, 3:, :3] @ precision
    rest = joint[:, 3:, 3:] - gain @ joint[:, :3, 3:]
    log_weight = torch.log(torch.cos(latitude)) + torch.logdet(precision) / 2
    return LatitudeCells(latitude, log_weight, mean, field, precision, gain, rest)


def expected(field: Tensor, angles: int = 1) -> tuple[Tensor, Tensor]:
    """Return the prior around a first reading, whose own information is still to be added.

    The cells of latitude, weighted by the likelihood of the field, are joined to one normal distribution with their
    moments given that field. The field itself keeps the covariance that it has before the reading.

    Args:
        field: ``(..., 3)`` north, east, down [nT].
        angles: as of :func:`latitude_cells`.

    Returns:
        Mean ``(..., K + 1)`` of the coefficients and the latitude [rad], and covariance ``(..., K + 1, K + 1)``.

    Example:
        >>> mean, _ = expected(torch.tensor([15000.0, 0.0, 45000.0], dtype=torch.float64))
        >>> round(math.degrees(mean[-1]))  # latitude
        47
    """
    cells = LatitudeCells(*(x.to(field) for x in latitude_cells(angles)))
    apart = field.unsqueeze(-2) - cells.mean[:, :3]  # (..., C, 3)
    square = (apart.unsqueeze(-2) @ cells.precision @ apart.unsqueeze(-1)).squeeze((-2, -1))
    weight = torch.softmax(cells.log_weight - square / 2, -1)
    prior = torch.cat((cells.mean[:, 3:], cells.latitude.unsqueeze(-1)), -1)
    means = prior + (cells.gain @ apart.unsqueeze(-1)).squeeze(-1)  # (..., C, K - 2), given the field
    mean = (weight.unsqueeze(-2) @ means).squeeze(-2)
    spread = (means - mean.unsqueeze(-2)) * weight.sqrt().unsqueeze(-1)
    given, gain, wide = (torch.tensordot(weight, x, 1) for x in (cells.covariance, cells.gain, cells.field_covariance))
    lever = torch.cat((torch.eye(3).to(field).expand(*gain.shape[:-2], 3, 3), gain), -2)
    rest = torch.nn.functional.pad(given + spread.mT @ spread, (3, 0, 3, 0))
    return torch.cat((field, mean), -1), lever @ wide @ lever.mT + rest
