"""IGRF against values by other programs, WMMHR-2025 against its published file, and dates in every form."""

import gzip
import hashlib
import math
from datetime import date as calendar_date
from datetime import datetime, timedelta, timezone
from functools import partial
from pathlib import Path

import numpy as np
import pandas
import ppigrf
import pytest
import torch
from support.field_checks import globe
from support.tracks import f64

import magrl.field
from magrl.envs import Scenario
from magrl.field import WMMHR, FieldBank, RegionalField, SphericalHarmonicField, elements_at, wmmhr_coefficients
from magrl.field.igrf import IGRF, igrf_coefficients, parse_date
from magrl.field.synthesis import basis, field_table
from magrl.field.wmmhr import WMMHR_SHA256
from magrl.paper import DATE, EXAMPLE_START, EXAMPLE_TARGET, GENERATION

DATA = Path(__file__).parent.parent / "data"
MODELS = Path(magrl.field.__file__).parent
COEFFICIENT_FILES = {13: str(MODELS / "igrf13.shc"), 14: ppigrf.ppigrf.shc_fn_igrf14}
LAST_YEAR = {13: 2025, 14: 2030}
FIRST_INSTANT = datetime(1900, 1, 1)


def test_igrf_gives_published_values() -> None:
    """To the printed digit of NOAA's grids, and within the rounding of IAGA's programs."""
    rows = [line.split() for line in (DATA / "igrf_values.txt").read_text().splitlines() if line[0] != "#"]
    assert len(rows) == 25
    for generation, date, *numbers in rows:
        altitude_km, latitude, longitude, *field, tolerance = map(float, numbers)
        model = IGRF(date if "-" in date else float(date), int(generation), altitude_km=altitude_km)
        off = model(f64(latitude), f64(longitude)) - torch.tensor(field)
        assert off.abs().max() < tolerance, (generation, date, off)


def test_igrf_14_gives_the_test_values_of_iaga() -> None:
    """On a sphere, where north is along its meridian; one row cuts digits off."""
    for year, colatitude, longitude, radius_km, *published in np.loadtxt(DATA / "igrf14_sphere.txt").tolist():
        theta, lon = math.radians(colatitude), math.radians(longitude)
        up = f64(math.sin(theta) * math.cos(lon), math.sin(theta) * math.sin(lon), math.cos(theta))
        south = f64(math.cos(theta) * math.cos(lon), math.cos(theta) * math.sin(lon), -math.sin(theta))
        east = f64(-math.sin(lon), math.cos(lon), 0.0)
        field = field_table(igrf_coefficients(year)) @ basis(radius_km * up.unsqueeze(0), 14)
        found = torch.stack((-south, east, -up)) @ field.squeeze(-1)
        assert found.tolist() == pytest.approx(published, rel=0, abs=0.01), year


def test_the_points_of_the_paper() -> None:
    """To the printed digit: the paper cuts angles off."""
    found = elements_at(IGRF(DATE, GENERATION), torch.stack((f64(*EXAMPLE_START), f64(*EXAMPLE_TARGET))))
    assert (1e3 * found[:, :2]).trunc().tolist() == [[8019, -16150], [9228, -26923]]
    assert found[:, 2].tolist() == pytest.approx([35467.990, 35199.415], rel=0, abs=0.0015)


def test_both_generations_share_the_definitive_field() -> None:
    """The files come from two sources."""
    for year in range(1900, 2020, 5):
        assert torch.equal(igrf_coefficients(year, 13), igrf_coefficients(year, 14)), year


@pytest.mark.parametrize("generation", COEFFICIENT_FILES)
def test_igrf_matches_ppigrf(generation):
    """5000 points over the globe, -5 to 600 km high, at five epochs; between them ppigrf counts days.

    The project promises 0.01 nT; the 0.0004 nT that are left come from the series in ppigrf's change of coordinates.
    """
    rng = np.random.default_rng(generation)
    for k, year in enumerate(np.sort(rng.choice(range(1900, LAST_YEAR[generation] + 1, 5), 5, replace=False)).tolist()):
        latitude, longitude = globe(1000, 100 * generation + k)
        altitude_km = torch.from_numpy(rng.uniform(-5, 600, 1000))
        positions = (x.numpy() for x in (longitude, latitude, altitude_km))
        east, north, up = ppigrf.igrf(*positions, datetime(year, 1, 1), coeff_fn=COEFFICIENT_FILES[generation])
        expected = torch.from_numpy(np.stack((north[0], east[0], -up[0]), -1))
        found = IGRF(year, generation)(latitude, longitude, altitude_km)
        assert (found - expected).abs().max() < 0.001, year


def test_coefficients_at_an_epoch_and_between_two():
    """IGRF-13 as published: g10, g11, h11 of 2020 and g10 of 2015."""
    table = igrf_coefficients("2020-01-01", 13)
    assert table.shape == (14, 14)
    assert complex(table[1, 0]) == pytest.approx(-29404.8, abs=1e-9)
    assert complex(table[1, 1]) == pytest.approx(-1450.9 - 4652.5j, abs=1e-9)
    for date in ("2017-07-02 12:00", 2017.5):
        middle = igrf_coefficients(date, 13)
        assert middle[1, 0].real.item() == pytest.approx((-29441.46 - 29404.8) / 2, abs=1e-9)


# --- dates ------------------------------------------------------------------------------------------------------------


def test_dates_in_every_form():
    """Decimal years count leap days, and calendar dates are midnights."""
    for form in (
        datetime(2022, 7, 2, 12),
        datetime(2022, 7, 3, 0, tzinfo=timezone(timedelta(hours=12))),
        "2022-07-02 12:00",
        "2022-07-02T22:00:00+10:00",
        2022.5,
        np.float32(2022.5),
        np.datetime64("2022-07-02T12:00"),
        pandas.Timestamp("2022-07-02T12:00"),
    ):
        assert parse_date(form) == datetime(2022, 7, 2, 12)
        assert parse_date(form).tzinfo is None
    assert parse_date(2020.5) == datetime(2020, 7, 2)
    assert parse_date(2022) == datetime(2022, 1, 1)
    assert parse_date(calendar_date(2022, 7, 2)) == datetime(2022, 7, 2)


@pytest.mark.parametrize("generation", COEFFICIENT_FILES)
def test_dates_from_first_to_last_day_of_the_model(generation):
    last = datetime(LAST_YEAR[generation], 1, 1)
    for date in (1900.0, "1900-01-01", last):
        assert IGRF(date, generation)(f64(0.0), f64(0.0)).isfinite().all()
    for date in (FIRST_INSTANT - timedelta(days=1), (last + timedelta(days=1)).isoformat()):
        with pytest.raises(ValueError, match=rf"IGRF-{generation}.*1900-01-01 to {last.date()}"):
            IGRF(date, generation)


BAD_DATES = (math.nan, -1.0, 0.5, 1e5, "yesterday", "2022-13-01", True, None, [], np.datetime64("NaT"), pandas.NaT)
MISTAKES = [
    *((partial(IGRF, date), "date") for date in BAD_DATES),
    *(
        (partial(WMMHR, date), "is outside WMMHR-2025, .* to 2030-01-01")
        for date in ("2024-12-31", "2030-01-02", 2024.9)
    ),
    *((partial(IGRF, 2020.0, bad), rf"generation {bad!r} is not available.*13, 14") for bad in (12, 15, "14")),
    *(
        (call, rf"altitude_km {km} is not from -15 to 1000 km .* in meters\?")
        for km in (1001.0, -16.0)
        for call in (partial(IGRF, 2020.0, altitude_km=km), partial(IGRF(2020.0), f64(0.0), f64(0.0), km))
    ),
]


@pytest.mark.parametrize(("call", "message"), MISTAKES)
def test_mistakes(call, message):
    with pytest.raises(ValueError, match=message):
        call()


# --- WMMHR-2025

BOX = (-10.0, 0.0), (160.0, 170.0)


@pytest.fixture(scope="module")
def wmmhr() -> WMMHR:
    return WMMHR(2029.5)


def test_coefficients_are_those_of_the_published_file() -> None:
    path = MODELS / "wmmhr2025.cof.gz"
    assert hashlib.sha256(gzip.decompress(path.read_bytes())).hexdigest() == WMMHR_SHA256
    table = wmmhr_coefficients(2025.0)
    assert complex(table[1, 0]) == -29351.7976
    assert complex(table[133, 133]) == 0.01 + 0.0005j
    assert (table != 0).sum() == 9044
    assert not table.triu(1).any()


def test_wmmhr_gives_its_published_values(wmmhr) -> None:
    """At heights of 3 to 93 km, at its epoch and 4.5 years later; its change in time is linear and of degree 15.

    North is published with another rounding: a synthesis in 30 digits agrees with ours to 4e-11 nT.
    """
    table = torch.from_numpy(np.loadtxt(DATA / "wmmhr2025_test_values.txt"))
    years, altitude_km, latitude, longitude = table[:, :4].T
    rate = (wmmhr_coefficients(2029.5) - wmmhr_coefficients(2025.0)) / 4.5
    change = SphericalHarmonicField(rate[:16, :16])(latitude, longitude, altitude_km)
    found = wmmhr(latitude, longitude, altitude_km) + (years - 2029.5).unsqueeze(-1) * change
    assert table.shape == (16, 10)
    assert ((found - table[:, 4:7]).abs().amax(0) < f64(4e-4, 2e-6, 2e-6)).all()
    assert (change - table[:, 7:]).abs().max() < 1e-5
    assert not rate[16:].any()


def test_expansions_of_wmmhr(wmmhr) -> None:
    """A region and a bank agree with the model and its gradient."""
    region = RegionalField(wmmhr, *BOX, degree=24)
    assert region.error_nt < 1e-4
    latitude, longitude = torch.tensor([-9.7, -3.0, -0.1]).double(), torch.tensor([160.2, 164.0, 169.0]).double()
    value, gradient = wmmhr.value_and_gradient(latitude, longitude)
    assert (region.value_and_gradient(latitude, longitude)[1] - gradient).abs().max() < 1e-5
    edges = (torch.tensor([x], dtype=torch.float64) for x in BOX)
    gauss, zero = wmmhr_coefficients(2029.5).unsqueeze(0), torch.zeros(1, dtype=torch.int64)
    bank = FieldBank.build(gauss, zero, *edges, degree=24)
    assert (bank(latitude, longitude, zero) - value).abs().max() < 1e-4


def test_a_date_of_another_generation_names_it() -> None:
    for make in (lambda: IGRF("2026-07-01", generation=13), lambda: Scenario(date="2026-07-01")):
        with pytest.raises(ValueError, match=r"outside IGRF-13, .* to 2025-01-01: generation=14 is valid then$"):
            make()
    with pytest.raises(ValueError, match=r"to 2030-01-01$"):
        IGRF("2040-01-01")
