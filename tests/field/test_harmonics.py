"""Solid harmonics and the linear maps between their tables, against closed forms, SciPy and autograd."""

import math

import pytest
import scipy.special
import torch

from magrl.field.harmonics import (
    basis,
    chebyshev,
    chebyshev_nodes,
    contract,
    differentiate,
    field_table,
    gradient_table,
    products,
    separate,
    waves,
)
from magrl.geodesy import REFERENCE_RADIUS_KM

ROOT3 = math.sqrt(3)


def random_table(degree, seed):
    """A table ``g - i h`` with nothing above its diagonal and no sine of order 0."""
    generator = torch.Generator().manual_seed(seed)
    table = torch.randn(degree + 1, degree + 1, generator=generator, dtype=torch.complex128).tril()
    table[:, 0] = table[:, 0].real.to(torch.complex128)
    return table


def random_points(count, seed, radius=(0.9, 1.3)):
    """``(count, 3)`` km in random directions, at radii in units of the reference radius."""
    generator = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=-1)
    low, high = radius
    length = low + (high - low) * torch.rand(count, 1, generator=generator, dtype=torch.float64)
    return direction * length * REFERENCE_RADIUS_KM


def potential(table, ecef_km):
    """V / a [nT], term by term, with none of the library's layout but the order of the basis."""
    rows = iter(basis(ecef_km, len(table) - 1))
    total = 0
    for n in range(len(table)):
        for m in range(n + 1):
            total = total + table[n, m].real * next(rows) - table[n, m].imag * next(rows)
    return total


def column(degree, entries):
    table = torch.zeros(degree + 1, degree + 1, dtype=torch.complex128)
    for (n, m), value in entries.items():
        table[n, m] = value
    return table


def meaningful(tables):
    """Tables without what a basis never sees: the sine of order 0."""
    tables = tables.clone()
    tables[..., 0] = tables[..., 0].real.to(tables.dtype)
    return tables


# --- differentiate ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("degree", "potential_entries", "along_x", "along_y", "along_z"),
    [
        # 1/r: the gradient is -(x, y, z)/r^3, and x/r^3, y/r^3, z/r^3 are g11, h11, g10
        (0, {(0, 0): 1}, {(1, 1): -1}, {(1, 1): 1j}, {(1, 0): -1}),
        # z/r^3: -3xz/r^5 = -sqrt(3) g21, -3yz/r^5 = -sqrt(3) h21, (r^2 - 3z^2)/r^5 = -2 g20
        (1, {(1, 0): 1}, {(2, 1): -ROOT3}, {(2, 1): 1j * ROOT3}, {(2, 0): -2}),
        # x/r^3: (r^2 - 3x^2)/r^5 = g20 - sqrt(3) g22, -3xy/r^5 = -sqrt(3) h22, -3xz/r^5 = -sqrt(3) g21
        (1, {(1, 1): 1}, {(2, 0): 1, (2, 2): -ROOT3}, {(2, 2): 1j * ROOT3}, {(2, 1): -ROOT3}),
        # y/r^3: -3xy/r^5 = -sqrt(3) h22, (r^2 - 3y^2)/r^5 = g20 + sqrt(3) g22, -3yz/r^5 = -sqrt(3) h21
        (1, {(1, 1): -1j}, {(2, 2): 1j * ROOT3}, {(2, 0): 1, (2, 2): ROOT3}, {(2, 1): 1j * ROOT3}),
    ],
    ids=["monopole", "axial dipole", "dipole along x", "dipole along y"],
)
def test_derivative_tables_worked_by_hand(degree, potential_entries, along_x, along_y, along_z):
    found = differentiate(column(degree, potential_entries))
    expected = torch.stack([column(degree + 1, entries) for entries in (along_x, along_y, along_z)])
    torch.testing.assert_close(meaningful(found), expected, rtol=0, atol=1e-14)


# --- basis ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [0, 1, 2, 8, 15])
def test_basis_is_the_schmidt_normalized_legendre_functions(degree):
    ecef = random_points(50, 3)
    x, y, z = ecef.T.numpy() / REFERENCE_RADIUS_KM
    radius, longitude = (x**2 + y**2 + z**2) ** 0.5, torch.atan2(*ecef[:, [1, 0]].T).numpy()
    rows = []
    for n in range(degree + 1):
        for m in range(n + 1):
            norm = math.sqrt((2 if m else 1) * math.factorial(n - m) / math.factorial(n + m))
            legendre = (-1) ** m * scipy.special.lpmv(m, n, z / radius)  # SciPy has the Condon-Shortley phase
            term = torch.from_numpy(norm * legendre / radius ** (n + 1))
            rows += [term * torch.from_numpy(m * longitude).cos(), term * torch.from_numpy(m * longitude).sin()]
    found = basis(ecef, degree)
    assert found.shape == ((degree + 1) * (degree + 2), 50)
    torch.testing.assert_close(found, torch.stack(rows), rtol=1e-11, atol=1e-13)


# --- field and gradient -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [1, 2, 6, 13])
def test_field_is_minus_the_gradient_of_the_potential(degree):
    table, ecef = random_table(degree, 5), random_points(20, 6).requires_grad_()
    (slope,) = torch.autograd.grad((REFERENCE_RADIUS_KM * potential(table, ecef)).sum(), ecef)
    found = (field_table(table) @ basis(ecef.detach(), degree + 1)).T
    torch.testing.assert_close(found, -slope, rtol=1e-10, atol=1e-10 * float(slope.abs().max()))


@pytest.mark.parametrize("degree", [1, 6])
def test_gradient_is_the_derivative_of_the_field(degree):
    """And has no trace, since there are no sources, and is symmetric, since there is no curl."""
    table, ecef = random_table(degree, 7), random_points(10, 8)
    weights = field_table(table)
    jacobian = torch.stack(
        [torch.autograd.functional.jacobian(lambda p: (weights @ basis(p[None], degree + 1))[:, 0], p) for p in ecef]
    )
    found = (gradient_table(table) @ basis(ecef, degree + 2)).T.unflatten(-1, (3, 3))
    torch.testing.assert_close(found, jacobian, rtol=1e-10, atol=1e-10 * float(jacobian.abs().max()))
    batch = torch.stack((table, 2 * table))
    torch.testing.assert_close(gradient_table(batch)[1], 2 * gradient_table(table), rtol=0, atol=0)
    torch.testing.assert_close(field_table(batch)[1], 2 * weights, rtol=0, atol=0)


# --- separated synthesis ----------------------------------------------------------------------------------------------


def cylindrical(ecef_km):
    """Distance from the axis, height over the equator [km], cosine and sine of the longitude."""
    x, y, z = ecef_km.unbind(-1)
    axis = torch.hypot(x, y)
    return axis, z, x / axis, y / axis


def separated(weights, degree, ecef_km):
    axis, z, cosine, sine = cylindrical(ecef_km)
    features, lift = products(axis, z, degree)
    return contract(separate(weights, degree), features, waves(cosine, sine, lift, degree))


@pytest.mark.parametrize("degree", [1, 2, 3, 8, 15, 40])
def test_separated_weights_give_what_the_basis_gives(degree):
    generator = torch.Generator().manual_seed(12)
    weights = torch.randn(4, (degree + 1) * (degree + 2), generator=generator, dtype=torch.float64)
    ecef = random_points(50, 13, radius=(0.98, 1.5))
    torch.testing.assert_close(
        separated(weights, degree, ecef), weights @ basis(ecef, degree), rtol=0, atol=1e-12 * degree**2
    )


@pytest.mark.parametrize("count", [2, 3, 8, 27])
def test_chebyshev_polynomials_and_their_coefficients(count):
    x = torch.linspace(-1, 1, 11, dtype=torch.float64)
    expected = torch.stack([torch.cos(k * torch.acos(x)) for k in range(count)])
    torch.testing.assert_close(chebyshev(x, count), expected, rtol=0, atol=1e-13)
    angles, to_coefficients = chebyshev_nodes(count)
    identity = to_coefficients @ chebyshev(angles.cos(), count).T
    torch.testing.assert_close(identity, torch.eye(count, dtype=torch.float64), rtol=0, atol=1e-14)
