"""Spherical harmonics against SciPy and autograd; their fields against published values; random planets."""

import math
from pathlib import Path

import numpy as np
import pytest
import scipy.special
import torch
from support.field_checks import central_differences, globe, relative_error
from support.tracks import f64
from torch import Tensor

from magrl.field import igrf_coefficients, random_planets
from magrl.field.elements import measured_elements
from magrl.field.igrf import IGRF
from magrl.field.planets import power_spectrum
from magrl.field.spherical import SphericalHarmonicField
from magrl.field.synthesis import (
    basis,
    chebyshev,
    chebyshev_nodes,
    contract,
    field_table,
    gradient_table,
    products,
    separate,
    waves,
)
from magrl.geodesy import REFERENCE_RADIUS_KM


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


# --- basis ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [0, 1, 15])
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


@pytest.mark.parametrize("degree", [0, 1, 6])
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


def separated(weights, degree, ecef_km):
    x, y, z = ecef_km.unbind(-1)
    axis = torch.hypot(x, y)
    features, lift = products(axis, z, degree)
    return contract(separate(weights, degree), features, waves(x / axis, y / axis, lift, degree))


@pytest.mark.parametrize("degree", [1, 2, 3, 15, 40])
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


ROUNDING_NT = 1e-8
DATA = Path(__file__).parent.parent / "data"


@pytest.fixture(scope="module")
def igrf() -> IGRF:
    return IGRF("2022-01-01", generation=13)


def assert_same(found, expected):
    torch.testing.assert_close(found, expected, rtol=0, atol=ROUNDING_NT)


def wmm2025(year):
    """The Gauss coefficients of the World Magnetic Model: lines of n, m, g, h [nT] and their rates [nT/year]."""
    gauss = torch.zeros(13, 13, dtype=torch.complex128)
    for line in (DATA / "wmm2025.cof").read_text(encoding="utf-8").splitlines()[1:-2]:
        n, m, g, h, g_rate, h_rate = map(float, line.split())
        gauss[int(n), int(m)] = complex(g + (year - 2025) * g_rate, -h - (year - 2025) * h_rate)
    return gauss


def test_another_model_gives_its_published_values():
    """WMM2025, whose table is printed to 0.1 nT and 0.01 degrees, sea level and 100 km high, now and in 2027.5.

    The technical report has more digits of one row (Table 3b, doi:10.25923/prbc-s316).
    """
    found = SphericalHarmonicField(wmm2025(2027.5))(f64(-80.0), f64(240.0), 100.0)[0]
    assert found.tolist() == pytest.approx([5983.9760496518, 14760.1359757868, -49317.6706154255], rel=0, abs=1e-9)
    table = np.loadtxt(DATA / "wmm2025_test_values.txt")
    assert table.shape == (12, 11)
    for year, altitude_km, latitude, longitude, *published in table.tolist():
        found = SphericalHarmonicField(wmm2025(year))(f64(latitude), f64(longitude), altitude_km)[0]
        declination, inclination, horizontal = measured_elements(found).tolist()
        nanotesla = [*found.tolist(), horizontal, float(found.norm())]
        assert nanotesla == pytest.approx(published[:5], rel=0, abs=0.0501)
        assert [inclination, declination] == pytest.approx(published[5:], rel=0, abs=0.00501)


@pytest.mark.parametrize("altitude_km", [-5.0, 600.0])
def test_gradient_matches_central_differences(igrf, altitude_km):
    latitude, longitude = globe(300, 2, highest_latitude=85)
    value, gradient = igrf.value_and_gradient(latitude, longitude, altitude_km)

    def model(lat, lon):
        return igrf(lat, lon, altitude_km)

    assert relative_error(gradient, central_differences(model, latitude, longitude, altitude_km)) < 1e-8
    assert_same(value, model(latitude, longitude))


@pytest.mark.parametrize("pole", [90.0, -90.0])
def test_a_pole_is_an_ordinary_point(igrf, pole):
    """The field is the same from every side; turning the meridian of north by 90 degrees turns its components."""
    latitude, longitude = f64(pole).expand(4), f64(0.0, 90.0, 180.0, -90.0)
    field = igrf(latitude, longitude)
    assert_same(field[:, 2], field[:1, 2].expand(4))
    turned = field[0, :2].flip(0) * f64(-1, 1) * math.copysign(1, pole)
    assert_same(field[1, :2], turned)
    assert_same(field[2, :2], -field[0, :2])
    beside = igrf(latitude * (1 - 1e-8), longitude)
    torch.testing.assert_close(beside, field, rtol=0, atol=0.01)  # a tenth of a meter away
    assert all(x.isfinite().all() for x in igrf.value_and_gradient(latitude, longitude))


def test_altitudes_broadcast_and_chunks_do_not_show(igrf, monkeypatch):
    latitude, longitude = globe(20, 4)
    altitude_km = f64(0.0, 100.0, 600.0).unsqueeze(-1)
    expected = igrf.value_and_gradient(latitude, longitude, altitude_km)
    monkeypatch.setattr(IGRF, "CHUNK", 7)
    found = igrf.value_and_gradient(latitude, longitude, altitude_km)
    assert found[0].shape == (3, 20, 3)
    for one, other in zip(found, expected, strict=True):
        assert_same(one, other)
    assert_same(found[0][2], igrf(latitude, longitude, 600.0))


ZERO = torch.zeros(2, 2, dtype=torch.complex128)
MISTAKES = {
    "latitude 90.1": (90.1, 0.0, 0.0),
    "latitude nan": (math.nan, 0.0, 0.0),
    "longitude inf": (0.0, math.inf, 0.0),
    "altitude_km nan is not": (0.0, 0.0, math.nan),
    "altitude_km inf is not": (0.0, 0.0, math.inf),
    "altitude_km -16.0 is not from -15 to 1000 km": {"altitude_km": -16.0},
    "gauss must be a tensor of complex numbers": {"gauss": torch.zeros(2, 2)},
    r"gauss must have the shape .*, got \(2, 3\)": {"gauss": torch.zeros(2, 3, dtype=torch.complex64)},
    "gauss holds non-finite": {"gauss": torch.full((2, 2), complex(0, math.nan))},
}


@pytest.mark.parametrize("message", MISTAKES)
def test_positions_off_the_earth_and_bad_tables_raise(message):
    def call(bad):
        field = SphericalHarmonicField(**{"gauss": ZERO} | (bad if isinstance(bad, dict) else {}))
        return field.value_and_gradient(*(f64(0.0, x) for x in bad))

    with pytest.raises((TypeError, ValueError), match=message):
        call(MISTAKES[message])


EARTH = igrf_coefficients("2022-01-01", 13)
COUNT = 4000


@pytest.fixture(scope="module")
def planets() -> Tensor:
    return random_planets(COUNT, seed=0)


def dipoles(planets: Tensor) -> Tensor:
    """Dipole moments as vectors x, y, z, ``(count, 3)`` [nT]."""
    return torch.stack((planets[:, 1, 1].real, -planets[:, 1, 1].imag, planets[:, 1, 0].real), -1)


def coefficients(planets: Tensor, n: int) -> Tensor:
    """The 2n + 1 coefficients g and h of a degree, ``(count, 2n + 1)``."""
    return torch.cat((planets[:, n, : n + 1].real, planets[:, n, 1 : n + 1].imag), -1)


def test_power_is_the_mean_square_field_on_the_sphere() -> None:
    """By quadrature, exact for degree 6: Gauss' in the sine of the latitude, equal steps in longitude."""
    table = random_table(3, 9)
    sine, weight = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(8))
    longitude = torch.arange(16, dtype=torch.float64) * math.tau / 16
    across = torch.sqrt(1 - sine**2).unsqueeze(1)
    points = torch.stack((across * longitude.cos(), across * longitude.sin(), sine.unsqueeze(1).expand(8, 16)), -1)
    for n in (1, 2, 3):
        one = torch.zeros_like(table)
        one[n] = table[n]
        field = field_table(one) @ basis(REFERENCE_RADIUS_KM * points.reshape(-1, 3), 4)
        square = field.square().sum(0).reshape(8, 16).mean(1) @ weight / 2
        assert square.item() == pytest.approx(power_spectrum(table)[n].item(), rel=1e-12), n


def test_the_spectrum_is_the_earth_s(planets: Tensor) -> None:
    """The mean factors are 1 + 0.6²/12 for the dipole and 1.25 for each other degree."""
    ratio = power_spectrum(planets)[:, 1:] / power_spectrum(EARTH)[1:]
    expected = torch.tensor([1 + 0.6**2 / 12] + [1.25] * 12, dtype=torch.float64)
    standard_error = ratio.std(0) / math.sqrt(COUNT)
    assert ((ratio.mean(0) - expected).abs() < 4 * standard_error).all()
    assert (standard_error < 0.02).all()


def test_the_power_of_a_degree_varies_by_planet_and_degree(planets: Tensor) -> None:
    """At a high degree, the factor of 0.5 to 2 is most of the variance of the power: 0.1875 + 2 (1.75) / (2n + 1)."""
    ratio = power_spectrum(planets)[:, 1:] / power_spectrum(EARTH)[1:]
    for n in (2, 7, 13):
        assert ratio[:, n - 1].var().item() == pytest.approx(0.1875 + 3.5 / (2 * n + 1), rel=0.12), n
    assert torch.corrcoef(ratio[:, 10:].T).fill_diagonal_(0).abs().max() < 0.08


def test_dipoles_are_tilted_and_have_the_earth_s_polarity(planets: Tensor) -> None:
    moment = dipoles(planets)
    strength = moment.norm(dim=-1) / dipoles(EARTH.unsqueeze(0)).norm()
    tilt = torch.rad2deg(torch.acos(-moment[:, 2] / moment.norm(dim=-1)))
    side = torch.rad2deg(torch.atan2(moment[:, 1], moment[:, 0]))
    for values, low, high in ((strength, 0.7, 1.3), (tilt, 0.0, 40.0), (side, -180.0, 180.0)):
        assert ((values >= low) & (values <= high)).all()
        quartiles = torch.quantile((values - low) / (high - low), torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64))
        assert quartiles.tolist() == pytest.approx([0.25, 0.5, 0.75], abs=0.03)
    assert (EARTH[1, 0].real < 0) & (planets[:, 1, 0].real < 0).all()


def test_a_seed_gives_the_same_planets_and_another_gives_others() -> None:
    state = torch.get_rng_state()
    first = random_planets(5, seed=7)
    assert torch.equal(first, random_planets(5, seed=7))
    assert torch.equal(state, torch.get_rng_state())
    other = random_planets(5, seed=8)
    below = torch.ones(14, 14).tril().bool()
    below[0] = False
    assert (first != other)[:, below].all()
    assert (first[:-1] != first[1:])[:, below].all()
