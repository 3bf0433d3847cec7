"""WMMHR-2025 against its published values, random crusts against the physics and the spectrum that they claim."""

from __future__ import annotations

import gzip
import hashlib
import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

import magrl.field
from magrl.envs import GeomagneticNavEnv, Scenario
from magrl.field import (
    WMMHR,
    CrustedField,
    FieldBank,
    RandomCrust,
    RegionalField,
    crustal_spectrum,
    igrf_coefficients,
    wmmhr_coefficients,
)
from magrl.field.planets import power_spectrum
from magrl.field.wmmhr import WMMHR_SHA256
from magrl.geodesy import REFERENCE_RADIUS_KM, curvature_radii, move

DATA = Path(__file__).parent.parent / "data"
BOX = (-10.0, 0.0), (160.0, 170.0)


@cache
def wmmhr(date: float) -> WMMHR:
    return WMMHR(date)


def places(count: int, latitude, longitude, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    uniform = torch.rand(2, count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    low, high = torch.tensor((latitude, longitude), dtype=torch.float64).T
    lat, lon = low.unsqueeze(-1) + (high - low).unsqueeze(-1) * uniform
    return lat, lon


def rms(x: torch.Tensor) -> float:
    return float(x.square().mean().sqrt())


def differences(field, latitude: torch.Tensor, longitude: torch.Tensor, step_km: float = 0.05) -> torch.Tensor:
    """Central differences of a field northward and eastward: ``(P, 3, 2)`` [nT/km]."""
    columns = []
    for heading in (0.0, math.pi / 2):
        ends = [
            field(*move(latitude, longitude, torch.full_like(latitude, turn), torch.full_like(latitude, step_km)))
            for turn in (heading, heading + math.pi)
        ]
        columns.append((ends[0] - ends[1]) / (2 * step_km))
    return torch.stack(columns, -1)


# --- WMMHR-2025 -------------------------------------------------------------------------------------------------------


def test_coefficients_are_those_of_the_published_file() -> None:
    path = Path(magrl.field.__file__).parent / "wmmhr2025.cof.gz"
    assert hashlib.sha256(gzip.decompress(path.read_bytes())).hexdigest() == WMMHR_SHA256
    assert path.stat().st_size < 100_000
    table = wmmhr_coefficients(2025.0)
    assert complex(table[1, 0]) == -29351.7976
    assert complex(table[133, 133]) == 0.01 + 0.0005j
    assert (table != 0).sum() == 9044
    assert not table.triu(1).any()


def test_wmmhr_gives_its_published_values() -> None:
    """At heights of 3 to 93 km, at its epoch and 4.5 years later; its change in time is linear."""
    table = torch.from_numpy(np.loadtxt(DATA / "wmmhr2025_test_values.txt"))
    years, altitude_km, latitude, longitude = table[:, :4].T
    early, late = (wmmhr(year)(latitude, longitude, altitude_km) for year in (2025.0, 2029.5))
    found = torch.where(years.unsqueeze(-1) == 2025.0, early, late)
    assert table.shape == (16, 10)
    assert (found - table[:, 4:7]).abs().max() < 1e-3
    assert ((late - early) / 4.5 - table[:, 7:]).abs().max() < 1e-5


@pytest.mark.parametrize("date", ["2024-12-31", "2030-01-02", 2024.9])
def test_dates_outside_wmmhr_are_refused(date) -> None:
    with pytest.raises(ValueError, match="is outside WMMHR-2025, which is valid from 2025-01-01 to 2030-01-01"):
        WMMHR(date)


def test_gradient_of_wmmhr() -> None:
    """Against differences of the field; also at the model's own altitude, which has a synthesis of its own."""
    latitude, longitude = places(20, (-80.0, 80.0), (0.0, 360.0))
    value, gradient = wmmhr(2025.0).value_and_gradient(latitude, longitude)
    assert (gradient - differences(wmmhr(2025.0), latitude, longitude)).abs().max() < 1e-5
    other = wmmhr(2025.0).value_and_gradient(latitude, longitude, 0.0)
    assert (value - other[0]).abs().max() < 1e-5
    assert (gradient - other[1]).abs().max() < 1e-5


def test_power_of_wmmhr() -> None:
    """The core is that of IGRF-14; the crust has 60 nT, and within a factor of 2 the power of the spectrum."""
    power = power_spectrum(wmmhr_coefficients(2025.0))
    core = wmmhr_coefficients(2025.0)[:14, :14] - igrf_coefficients(2025.0)
    assert power_spectrum(core).sum().sqrt() < 15
    assert float(power[16:].sum().sqrt()) == pytest.approx(60.2, abs=0.1)
    ratio = crustal_spectrum(torch.arange(30.0, 134.0)) / power[30:]
    assert ratio.min() > 0.5
    assert ratio.max() < 2


def test_regional_expansion_of_wmmhr() -> None:
    latitude, longitude = places(200, *BOX)
    with pytest.raises(ValueError, match="degree 16 misses the model"):
        RegionalField(wmmhr(2025.0), *BOX, degree=16)
    region = RegionalField(wmmhr(2025.0), *BOX, degree=24)
    assert region.error_nt < 1e-4
    exact = wmmhr(2025.0).value_and_gradient(latitude, longitude)[1]
    assert (region.value_and_gradient(latitude, longitude)[1] - exact).abs().max() < 1e-5


def test_bank_of_wmmhr() -> None:
    """Two boxes of it, whose expansions agree with the model."""
    edges = torch.tensor([[-10.0, 0.0], [40.0, 50.0]]), torch.tensor([[160.0, 170.0], [-10.0, 4.0]])
    bank = FieldBank.build(
        wmmhr_coefficients(2025.0).unsqueeze(0), torch.zeros(2, dtype=torch.int64), *edges, degree=24
    )
    latitude, longitude = torch.tensor([-3.0, 47.0]), torch.tensor([169.0, -8.0])
    difference = bank(latitude, longitude, torch.arange(2)) - wmmhr(2025.0)(latitude, longitude)
    assert difference.abs().max() < 1e-3


# --- random crust -----------------------------------------------------------------------------------------------------


def test_gradient_of_random_crust() -> None:
    """At high latitude and altitude, across the antimeridian, against differences of the field on the ellipsoid."""
    box = (50.0, 65.0), (170.0, 195.0)
    crust = RandomCrust(*box, seed=3)
    latitude, longitude = places(50, (51.0, 64.0), (171.0, 194.0))
    value, gradient = crust.value_and_gradient(latitude, longitude)
    torch.testing.assert_close(crust(latitude, longitude - 360), value, rtol=0, atol=1e-9)
    assert rms(gradient) > 1
    assert (gradient - differences(crust, latitude, longitude, 0.01)).abs().max() < 2e-5
    high = RandomCrust(*box, seed=3, altitude_km=30.0)
    stretch = 1 + 30.0 / torch.stack(curvature_radii(latitude), -1)  # kilometers at that altitude for one on the ground
    gradient = high.value_and_gradient(latitude, longitude)[1] * stretch.unsqueeze(1)
    assert (gradient - differences(high, latitude, longitude, 0.01)).abs().max() < 2e-5


@pytest.mark.parametrize("box", [BOX, ((40.0, 60.0), (0.0, 25.0))])
@pytest.mark.parametrize("altitude_km", [0.0, 100.0])
def test_random_crust_has_no_curl_and_no_divergence(box, altitude_km) -> None:
    """In the local frame, which turns along a parallel and over the Earth's curvature."""
    latitude, longitude = places(1000, *box)
    crust, above = (RandomCrust(*box, seed=1, altitude_km=altitude_km + step) for step in (0.0, 0.01))
    value, gradient = crust.value_and_gradient(latitude, longitude)
    north, east, down = value.unbind(-1)
    upward = (above(latitude, longitude) - value) / 0.01
    meridian, across = (radius + altitude_km for radius in curvature_radii(latitude))
    turning = torch.tan(torch.deg2rad(latitude)) / across
    curl = gradient[:, 0, 1] - gradient[:, 1, 0] + east * turning
    assert curl.abs().max() < 1e-12
    # In a vertical plane the field northward changes upward as the one upward changes northward.
    assert rms(upward[:, 0] + gradient[:, 2, 0] + north / meridian) < 1e-3 * rms(upward[:, 0])
    divergence = gradient[:, 0, 0] + gradient[:, 1, 1] - north * turning - upward[:, 2]
    assert rms(divergence - down * (1 / meridian + 1 / across)) < 0.01 * rms(upward[:, 2])


def test_random_crust_has_the_published_spectrum() -> None:
    """Power of a band and of each component, wavelength, and decay with altitude, over ten fields."""
    assert crustal_spectrum(torch.tensor(290.0)).item() == pytest.approx(0.52 * 291 * (1 - math.exp(-1)))
    latitude, longitude = places(500, *BOX)
    fields = [RandomCrust(*BOX, seed, degrees=(200, 203), waves=100) for seed in range(10)]
    value, gradient = (
        torch.stack(x) for x in zip(*(f.value_and_gradient(latitude, longitude) for f in fields), strict=True)
    )
    power = value.square().mean((0, 1))
    expected = float(crustal_spectrum(torch.arange(200.0, 204.0)).sum())
    assert float(power.sum()) == pytest.approx(expected, rel=0.1)
    assert float(power[2]) == pytest.approx(expected / 2, rel=0.1)
    assert float(power[0] / power[1]) == pytest.approx(1, abs=0.2)
    assert rms(gradient[..., 2, :]) * math.sqrt(2) / rms(value[..., 2]) == pytest.approx(
        202 / REFERENCE_RADIUS_KM, rel=0.03
    )
    high = RandomCrust(*BOX, 0, degrees=(200, 203), waves=100, altitude_km=50.0)(latitude, longitude)
    assert rms(high) / rms(value[0]) == pytest.approx((1 + 50 / REFERENCE_RADIUS_KM) ** -203.5, rel=0.01)


def test_default_crust_has_154_nt() -> None:
    """And more of it is a matter of the strength."""
    latitude, longitude = places(500, *BOX)
    values = torch.stack([RandomCrust(*BOX, seed)(latitude, longitude) for seed in range(5)])
    assert rms(values) * math.sqrt(3) == pytest.approx(154, rel=0.08)
    half = RandomCrust(*BOX, 0, strength=0.5)(latitude, longitude)
    torch.testing.assert_close(half, values[0] / 2)


def test_random_crust_is_a_function_of_its_seed() -> None:
    """Not of the generator of torch, of other places in a call, or of the chunks."""
    latitude, longitude = places(1500, *BOX)
    torch.manual_seed(0)
    first = RandomCrust(*BOX, seed=7)(latitude, longitude)
    state = torch.random.get_rng_state()
    again = RandomCrust(*BOX, seed=7)(latitude, longitude)
    assert torch.equal(first, again)
    assert torch.equal(state, torch.random.get_rng_state())
    alone = RandomCrust(*BOX, seed=7)(latitude[1400:1403], longitude[1400:1403])
    torch.testing.assert_close(alone, first[1400:1403], rtol=0, atol=1e-9)
    assert rms(RandomCrust(*BOX, seed=8)(latitude, longitude) - first) > 50


def test_random_crust_ends_with_its_box() -> None:
    crust = RandomCrust(*BOX, seed=0)
    edges = torch.tensor([-10.0, 0.0, -5.0, -5.0]), torch.tensor([160.0, 170.0, 160.0, -190.0])
    assert crust(*edges).isfinite().all()
    beyond = torch.tensor([-10.01, 0.01, -5.0]), torch.tensor([165.0, 165.0, 159.99])
    assert crust(*beyond).isnan().all()
    with pytest.raises(ValueError, match=r"reach 23\.2 degrees from their center"):
        RandomCrust((40.0, 60.0), (0.0, 60.0), seed=0)


def test_crusted_field_in_the_environment() -> None:
    """The vehicles measure the sum."""
    scenario = Scenario()
    box = scenario.reachable()[0]
    smooth, crust = scenario.build_field(), RandomCrust(box.latitude, box.longitude, seed=0, strength=0.1)
    both = CrustedField(smooth, crust)
    env = GeomagneticNavEnv(Scenario(field=both), num_envs=3, seed=0)
    start = env.reset()
    place = start["position"].unbind(-1)
    b = smooth(*place) + crust(*place)
    assert start["field"][:, 2].tolist() == pytest.approx(b[:, :2].norm(dim=-1).tolist(), abs=0.01)
    gradient = smooth.value_and_gradient(*place)[1] + crust.value_and_gradient(*place)[1]
    assert torch.equal(both.value_and_gradient(*place)[1], gradient)
