"""Solid harmonics around a vehicle: the potential of a field near it, and how it changes when the vehicle moves.

Outside its sources a magnetic field is the gradient of a harmonic function psi (B = -grad V, psi = -V). Around a place
psi is a sum of solid harmonics in local Cartesian axes, x northward, y eastward and z downward:

    rho = 2 Re R_n^m, 2 Im R_n^m (m > 0), R_n^0,    R_n^m = r^n P_nm(cos theta) e^{i m lambda} / (n + m)!

with the Legendre functions P_nm of geomagnetism (no Condon-Shortley phase) and theta from the z axis. Its coefficients
are ordered by degree n, and in each degree by falling order m. Coefficients of degree 1 belong to x, y, z: they are the
field itself, north, east, down. A constant is left out. Derivatives of a harmonic function and its rotations are
harmonic, so both are matrices on the coefficients; with lengths in units of 1000 km, the coefficients are in nT per
unit^(n - 1).

In this normalization derivatives have the weights 1 and -1, and rotations are ladders:

    (d_x - i d_y) R_n^m = R_{n-1}^{m-1},   (d_x + i d_y) R_n^m = -R_{n-1}^{m+1},   d_z R_n^m = R_{n-1}^m
    (z (d_x - i d_y) - (x - i y) d_z) R_n^m = (n - m + 1) R_n^{m-1},   (x d_y - y d_x) R_n^m = i m R_n^m
    (z (d_x + i d_y) - (x + i y) d_z) R_n^m = -(n + m + 1) R_n^{m+1},   R_n^{-m} = (-1)^m conj(R_n^m)

Source: M. A. Epton and B. Dembart, Multipole translation theory for the three-dimensional Laplace and Helmholtz
equations, SIAM Journal on Scientific Computing 16 (1995), with another sign of odd orders.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, wraps
from typing import NamedTuple, ParamSpec, TypeVar

import torch
from torch import Tensor
from torch.utils._python_dispatch import _disable_current_modes

from magrl.geodesy import REFERENCE_RADIUS_KM

P = ParamSpec("P")
T = TypeVar("T")

UNIT_KM = 1000.0
"""Unit of length of the coefficients [km]."""
RADIUS = REFERENCE_RADIUS_KM / UNIT_KM
"""Radius of the sphere on which the vehicle moves [unit]; :mod:`~magrl.pilot` corrects for the ellipsoid."""


def constant(function: Callable[P, T]) -> Callable[P, T]:
    """Compute the value of a function once for each argument; in a compiled graph it is a constant.

    It is kept for other modes, too, where the first call is in inference mode.

    Example:
        >>> constant(size)(3)
        15
    """
    cached: Callable[P, T] = cache(torch.inference_mode(False)(function))  # type: ignore[assignment]

    @torch.compiler.assume_constant_result
    @wraps(function)
    def value(*args: P.args, **options: P.kwargs) -> T:
        with _disable_current_modes():  # a number and not a part of the graph, where a trace asks first
            return cached(*args, **options)

    return value


def size(degree: int) -> int:
    """Return the number of coefficients of the degrees 1 to ``degree``.

    Example:
        >>> size(3)
        15
    """
    return degree * (degree + 2)


def orders(degree: int) -> list[tuple[int, int]]:
    """Return degree and order of each coefficient; the order is negative for the imaginary part.

    Example:
        >>> orders(1)
        [(1, 1), (1, -1), (1, 0)]
    """
    return [(n, sign * m) for n in range(1, degree + 1) for m in range(n, -1, -1) for sign in (1, -1)[: 1 + (m > 0)]]


class Generators(NamedTuple):
    """Matrices ``(3, K, K)`` on the coefficients: the derivatives along x, y and z, and the turns of the axes.

    The turns are of a vehicle on a unit sphere that moves north (x d_z - z d_x) or east (y d_z - z d_y), and that
    of axes whose azimuths become larger (y d_x - x d_y), all per radian.

    Example:
        >>> generators(2).derivative[2][:3, 7]  # what z^2 / 2 - (x^2 + y^2) / 4 adds to the field downward
        tensor([0., 0., 1.], dtype=torch.float64)
    """

    derivative: Tensor
    turn: Tensor


@constant
def generators(degree: int) -> Generators:
    """Return the generators of translations and rotations for the degrees 1 to ``degree``.

    Example:
        >>> generators(3).turn.shape
        torch.Size([3, 15, 15])
    """
    place = {order: k for k, order in enumerate(orders(degree))}  # here -m stands for R_n^{-m}

    n, m = (torch.tensor(x, dtype=torch.complex128) for x in zip(*place, strict=True))

    def ladder(step_n: int, step_m: int, weight: Tensor) -> Tensor:
        """Return the matrix that takes R_n^m to a weight times R_{n + step_n}^{m + step_m}."""
        matrix = torch.zeros(len(place), len(place), dtype=torch.complex128)
        for (degree, order), k in place.items():
            if (target := (degree + step_n, order + step_m)) in place:
                matrix[k, place[target]] = weight[k]
        return matrix

    one = torch.ones_like(n)
    minus, plus = ladder(-1, -1, one), ladder(-1, 1, -one)  # d_x - i d_y, d_x + i d_y
    lower, rise = ladder(0, -1, n - m + 1), ladder(0, 1, -(n + m + 1))
    derivative = (minus + plus) / 2, (minus - plus) * (1j / 2), ladder(-1, 0, one)
    turn = -(rise + lower) / 2, (rise - lower) * (1j / 2), ladder(0, 0, -1j * m)
    parts = torch.zeros_like(minus)  # rows: the real harmonics as sums of R_n^m and R_n^{-m}
    for (degree, order), k in place.items():
        unit = (1 if order >= 0 else -1j) * (1 if order else 0.5)
        parts[k, place[degree, abs(order)]] += unit
        parts[k, place[degree, -abs(order)]] += unit * (-1) ** order * (1 if order >= 0 else -1)
    inverse = torch.linalg.inv(parts)
    real = [torch.stack([(parts @ matrix @ inverse).real.mT for matrix in kind]) for kind in (derivative, turn)]
    return Generators(*(matrix.contiguous() for matrix in real))


def turning(cos: Tensor, sin: Tensor, degree: int) -> Tensor:
    """Return the matrices ``(..., K, K)`` that turn coefficients to axes in which azimuths are larger by an angle.

    Args:
        cos: ``(...)`` cosine of the angle.
        sin: ``(...)`` its sine.
        degree: highest degree.

    Example:
        >>> turning(torch.tensor(0.0), torch.tensor(1.0), 1) @ torch.tensor([1.0, 0.0, 5.0])  # what was north is east
        tensor([0., 1., 5.])
    """
    waves = [(torch.ones_like(cos), torch.zeros_like(sin)), (cos, sin)]  # of m times the angle
    for _ in range(degree - 1):
        x, y = waves[-1]
        waves.append((x * cos - y * sin, x * sin + y * cos))
    cosines, sines = (torch.stack([waves[abs(m)][part] for _, m in orders(degree)], -1) for part in (0, 1))
    return torch.diag_embed(cosines) + generators(degree).turn[2].to(cos).sign() * sines.unsqueeze(-1)


def powers(displacement: Tensor, degree: int) -> Tensor:
    """Return the monomials ``(..., (J + 1) (J + 2) / 2)`` of degrees 0 to J of displacements.

    Args:
        displacement: ``(..., 2)`` northward and eastward.
        degree: J.

    Example:
        >>> powers(torch.tensor([2.0, 3.0]), 2)
        tensor([1., 2., 3., 4., 6., 9.])
    """
    north, east = displacement.unbind(-1)
    rows = [[torch.ones_like(north)]]
    for _ in range(degree):
        rows.append([north * term for term in rows[-1]] + [east * rows[-1][-1]])
    return torch.stack([term for row in rows for term in row], -1)


class Arc(NamedTuple):
    """A displacement along a great circle, each ``(...)``: cosine and sine of the angle gamma by which azimuths are
    larger at its end than in axes that are carried along; the derivatives of gamma and of the latitude at its end with
    respect to the latitude at its start; and sine and cosine of the latitude at its end, the latter not below
    :data:`LEAST_COS`.

    Example:
        >>> Arc._fields
        ('cos_turn', 'sin_turn', 'slope', 'rate', 'sin', 'cos')
    """

    cos_turn: Tensor
    sin_turn: Tensor
    slope: Tensor
    rate: Tensor
    sin: Tensor
    cos: Tensor


LEAST_COS = 0.02
"""Least cosine of a latitude in derivatives, 1 degree from a pole: there they do not hold, but stay finite."""


def arc(sin: Tensor, cos: Tensor, north: Tensor, east: Tensor) -> Arc:
    """Return the turn of north along a great circle.

    With theta^2 = n^2 + e^2, S = sin(theta) / theta, K = (1 - cos(theta)) / theta^2 and the latitudes phi and phi',
    sin(phi') = sin(phi) (1 - theta^2 K) + cos(phi) n S and cos(phi') (cos(gamma), sin(gamma)) =
    (cos(phi) (1 - n^2 K) - sin(phi) n S, e (sin(phi) S + cos(phi) n K)).

    Where the latitude is not known, axes are not turned: gamma and the derivatives are those without a turn.

    Args:
        sin: ``(...)`` sine of the latitude at the start; NaN where it is not known.
        cos: ``(...)`` its cosine.
        north: ``(...)`` angle n of the displacement northward [rad], below 1.
        east: ``(...)`` angle e of the displacement eastward [rad].

    Example:
        >>> turn = arc(*(torch.tensor(x, dtype=torch.float64) for x in (0.8, 0.6, 0.0, 0.01)))
        >>> round(float(turn.sin_turn), 5)  # tan(latitude) times 0.01
        0.01333
    """
    square = north * north + east * east
    s, k = 1 - square / 6 * (1 - square / 20 * (1 - square / 42)), 0.5 - square / 24 * (1 - square / 30)
    along, across = cos * (1 - north * north * k) - sin * north * s, east * (sin * s + cos * north * k)
    cos_end = torch.sqrt(along * along + across * across).clamp_min(LEAST_COS)
    sin_end = sin * (1 - square * k) + cos * north * s
    rate = (cos * (1 - square * k) - sin * north * s) / cos_end
    known, slope = ~sin.isnan(), east * s / cos_end.square()
    cos_turn = torch.where(known, along / cos_end, 1.0)
    sin_turn, slope, rate = (torch.where(known, part, 0.0) for part in (across / cos_end, slope, rate))
    return Arc(cos_turn, sin_turn, slope, rate, sin_end, cos_end)


def field_rows(degree: int, terms: int) -> Tensor:
    """Return the field at a place on the sphere as polynomials of the displacement.

    A vehicle that moves along a great circle by p = (n, e), and takes its axes with it without turning them about the
    vertical, then has the coefficients exp(n X + e Y) c, with the generators X and Y of legs of a unit north and east;
    the first three are the field there. The exponential is expanded in monomials of n and e.

    Args:
        degree: highest degree of the coefficients.
        terms: highest degree J of the monomials. Derivatives end with ``degree - 1``; turns
            fall by the factor (distance / radius) / J.

    Returns:
        ``(..., 3, K)`` for each of :func:`powers`.

    Example:
        >>> field_rows(1, 1)[1]  # a field that is downward here is partly northward a unit to the north
        tensor([[ 0.0000,  0.0000,  0.1570],
                [ 0.0000,  0.0000,  0.0000],
                [-0.1570,  0.0000,  0.0000]], dtype=torch.float64)
    """
    derivative, turn = generators(degree)
    north, east = (derivative[i] + turn[i] / RADIUS for i in (0, 1))
    words = [[torch.eye(size(degree), dtype=torch.float64)[:3]]]  # sums of all products of as many X and Y
    for _ in range(terms):
        before = words[-1]
        both = [before[i] @ north + before[i - 1] @ east for i in range(1, len(before))]
        words.append([before[0] @ north, *both, before[-1] @ east])
    return torch.stack([word / math.factorial(j) for j, row in enumerate(words) for word in row])
