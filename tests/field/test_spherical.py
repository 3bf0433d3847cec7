"""Fields of spherical harmonics: a dipole by hand, published values, derivatives, poles and altitudes."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from support.field_checks import central_differences, f64, globe, relative_error

from magrl.field.elements import measured_elements
from magrl.field.igrf import IGRF
from magrl.field.spherical import SphericalHarmonicField
from magrl.geodesy import REFERENCE_RADIUS_KM, WGS84_A_KM, WGS84_B_KM

ROUNDING_NT = 1e-8
DATA = Path(__file__).parent.parent / "data"


@pytest.fixture(scope="module")
def igrf() -> IGRF:
    return IGRF("2022-01-01", generation=13)


def assert_same(found, expected):
    torch.testing.assert_close(found, expected, rtol=0, atol=ROUNDING_NT)


def test_axial_dipole_worked_by_hand():
    """g10 = -30000 nT: northward on the equator; twice as strong at the poles, down at the north, up at the south."""
    gauss = torch.zeros(2, 2, dtype=torch.complex128)
    gauss[1, 0] = -30000.0
    found = SphericalHarmonicField(gauss)(f64(0.0, 90.0, -90.0), f64(50.0, 0.0, 0.0))
    equator, pole = 30000 * (REFERENCE_RADIUS_KM / WGS84_A_KM) ** 3, 60000 * (REFERENCE_RADIUS_KM / WGS84_B_KM) ** 3
    assert_same(found, f64(equator, 0, 0, 0, 0, pole, 0, 0, -pole).reshape(3, 3))


def wmm2025(year):
    """The Gauss coefficients of the World Magnetic Model: lines of n, m, g, h [nT] and their rates [nT/year]."""
    gauss = torch.zeros(13, 13, dtype=torch.complex128)
    for line in (DATA / "wmm2025.cof").read_text(encoding="utf-8").splitlines()[1:-2]:
        n, m, g, h, g_rate, h_rate = map(float, line.split())
        gauss[int(n), int(m)] = complex(g + (year - 2025) * g_rate, -h - (year - 2025) * h_rate)
    return gauss


def test_another_model_gives_its_published_values():
    """WMM2025, whose table is printed to 0.1 nT and 0.01 degrees, sea level and 100 km high, now and in 2027.5."""
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


@pytest.mark.parametrize(
    ("latitude", "longitude", "altitude_km", "message"),
    [
        (90.1, 0.0, 0.0, "latitude 90.1"),
        (math.nan, 0.0, 0.0, "latitude nan"),
        (0.0, math.inf, 0.0, "longitude inf"),
        (0.0, 0.0, math.nan, "altitude_km nan is not"),
        (0.0, 0.0, math.inf, "altitude_km inf is not"),
    ],
)
def test_positions_off_the_earth_raise(latitude, longitude, altitude_km, message):
    model = SphericalHarmonicField(torch.zeros(2, 2, dtype=torch.complex128))
    for function in (model, model.value_and_gradient):
        with pytest.raises(ValueError, match=message):
            function(f64(0.0, latitude), f64(0.0, longitude), f64(0.0, altitude_km))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"altitude_km": -101.0}, "altitude_km -101.0 is not a finite number from -100 km on"),
        ({"gauss": torch.zeros(2, 2)}, "gauss must be a tensor of complex numbers"),
        ({"gauss": torch.zeros(2, 3, dtype=torch.complex64)}, r"gauss must have the shape .*, got \(2, 3\)"),
        ({"gauss": torch.full((2, 2), complex(0, math.nan))}, "gauss holds non-finite"),
    ],
)
def test_bad_tables_and_options_raise(options, message):
    with pytest.raises((TypeError, ValueError), match=message):
        SphericalHarmonicField(**{"gauss": torch.zeros(2, 2, dtype=torch.complex128)} | options)
