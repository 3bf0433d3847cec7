"""The local coefficients of the field at a place: how they change along legs, and the field at displacements."""

from __future__ import annotations

import torch
from torch import Tensor

from magrl.geodesy import curvature_radii
from magrl.pilot.harmonics import RADIUS, UNIT_KM, arc, constant, field_rows, generators, powers, size
from magrl.pilot.prior import DEGREE, HIGHEST, closure

COEFFICIENTS = size(DEGREE)
"""Number of coefficients of a belief."""
TERMS = 5  # degree of the polynomials for the field there: 1.6 nT of error at 1000 km, 0.1 at 700


def radii(latitude: Tensor) -> tuple[Tensor, Tensor]:
    """Return the radii of curvature [km] along the meridian and across it; the sphere's where a latitude is NaN.

    Example:
        >>> radii(torch.tensor(float("nan")))[0]
        tensor(6371.2002)
    """
    known, middle = ~latitude.isnan(), RADIUS * UNIT_KM
    meridian, vertical = (torch.where(known, radius, middle) for radius in curvature_radii(latitude))
    return meridian, vertical


def slopes(coefficients: Tensor, place: Tensor) -> Tensor:
    """Return how coefficients ``(..., K)`` change northward and eastward of a place: ``(..., K, 2)`` [per km]."""
    return (slope_rows(place[..., 0]) @ coefficients[..., None, :, None]).squeeze(-1).mT


def slope_rows(latitude: Tensor) -> Tensor:
    """Return the derivatives ``(..., 2, K, K)`` of the coefficients northward and eastward [per km], with the axes as
    they are there."""
    turn, derivative = generators(DEGREE).turn.to(latitude), closed_derivatives().to(latitude)
    meridian, vertical = (radius[..., None, None] for radius in radii(latitude))
    angle = torch.deg2rad(torch.where(latitude.isnan(), 0.0, latitude))
    north = derivative[0] / UNIT_KM + turn[0] / meridian
    east = derivative[1] / UNIT_KM + turn[1] / vertical + (torch.tan(angle)[..., None, None] / vertical) * turn[2]
    return torch.stack((north, east), -3)


def closed_derivatives() -> Tensor:
    """Return the derivatives ``(2, K, K)`` northward and eastward, with degree 4 as its regression."""
    derivative = generators(DEGREE + 1).derivative[:2, :COEFFICIENTS]
    return derivative @ closure().extend[: size(DEGREE + 1)]


def carry(north: Tensor, east: Tensor, *angles: Tensor) -> Tensor:
    """Return exp(X) ``(..., K, K)`` of a leg [unit] that turns the vertical by angles northward and eastward [rad], to
    the fourth order."""
    steps = torch.cat((closed_derivatives(), generators(DEGREE).turn[:2])).to(north)
    matrix = torch.tensordot(torch.stack((north, east, *angles), -1), steps, 1)
    one = torch.eye(matrix.shape[-1]).to(matrix)
    square = matrix @ matrix
    return one + matrix + square @ (one / 2 + matrix / 6 + square / 24)


def levers(points: Tensor) -> Tensor:
    """Return the field at displacements ``(..., M, 2)`` [unit] as rows ``(..., M, 3, K)`` on the coefficients.

    Example:
        >>> levers(torch.zeros(1, 2)).shape
        torch.Size([1, 3, 15])
    """
    rows = monomial_rows(TERMS).to(points)  # (J, 3, K)
    return (powers(points, TERMS) @ rows.flatten(1)).unflatten(-1, (3, COEFFICIENTS))


@constant
def monomial_rows(terms: int) -> Tensor:
    """Return the field at a displacement ``(J, 3, K)`` for each of its monomials."""
    return field_rows(HIGHEST, terms) @ closure().extend


def carried_back(field: Tensor, latitude: Tensor, points: Tensor) -> Tensor:
    """Return fields at displacements from a place in axes that are carried from there.

    Args:
        field: ``(..., M, 3)`` north, east, down at the ends of the displacements.
        latitude: ``(...)`` of the place [deg].
        points: ``(..., M, 2)`` displacements along great circles [unit].

    Returns:
        ``(..., M, 3)``.

    Example:
        >>> carried_back(torch.eye(3)[:1], torch.tensor(60.0), torch.tensor([[0.0, 0.1]])).round(decimals=3)
        tensor([[ 1.0000, -0.0270,  0.0000]])
    """
    return torch.stack(unturned(field, latitude, points)[0], -1)


def unturned(field: Tensor, latitude: Tensor, points: Tensor) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """Return the parts of a field in the axes that are carried from a place, and the slope of the angle."""
    meridian, vertical = (radius.to(points).unsqueeze(-1) for radius in radii(latitude))
    north, east = points.unbind(-1)
    n, e = north * (UNIT_KM / meridian), east * (UNIT_KM / vertical)
    angle = torch.deg2rad(latitude).to(points).unsqueeze(-1)
    turn = arc(torch.sin(angle), torch.cos(angle), n, e)
    x, y, z = field.unbind(-1)
    x, y = x * turn.cos_turn + y * turn.sin_turn, y * turn.cos_turn - x * turn.sin_turn
    tilt_n, tilt_e = n - north / RADIUS, e - east / RADIUS  # of the vertical, more than on the sphere
    return (x - tilt_n * z, y - tilt_e * z, z + tilt_n * x + tilt_e * y), turn.slope / meridian


def inverse3(matrix: Tensor) -> Tensor:
    """Return the inverses of symmetric matrices ``(..., 3, 3)``, in closed form.

    Example:
        >>> inverse3(torch.diag(torch.tensor([1.0, 2.0, 4.0]))).diagonal()
        tensor([1.0000, 0.5000, 0.2500])
    """
    x, y, z = matrix.unbind(-2)
    adjugate = torch.stack([torch.linalg.cross(*rows) for rows in ((y, z), (z, x), (x, y))], -1)
    return adjugate / (x.unsqueeze(-2) @ adjugate[..., :1]).squeeze(-1).unsqueeze(-1)


def inverse2(matrix: Tensor) -> Tensor:
    """Return the inverses of symmetric matrices ``(..., 2, 2)``.

    Example:
        >>> inverse2(torch.diag(torch.tensor([2.0, 4.0]))).diagonal()
        tensor([0.5000, 0.2500])
    """
    nn, ne, ee = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]
    return (torch.stack((ee, -ne, -ne, nn), -1) / (nn * ee - ne * ne).unsqueeze(-1)).unflatten(-1, (2, 2))


def cholesky2(matrix: Tensor, least: float) -> tuple[Tensor, Tensor, Tensor]:
    """Return the Cholesky factor of matrices ``(..., 2, 2)``, which may be singular by rounding, as its first, its
    lower left and its last entry ``(...)``; squares on the diagonal are not below a least one.

    Example:
        >>> cholesky2(torch.tensor([[4.0, 2.0], [2.0, 10.0]]), 1e-6)
        (tensor(2.), tensor(1.), tensor(3.))
    """
    first = matrix[..., 0, 0].clamp_min(least).sqrt()
    below = matrix[..., 0, 1] / first
    return first, below, (matrix[..., 1, 1] - below * below).clamp_min(least).sqrt()
