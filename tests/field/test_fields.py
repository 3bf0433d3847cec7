"""The field models against ppigrf, against the paper, and against themselves."""

import copy
import math
import re
from datetime import date as calendar_date
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pandas
import ppigrf
import pytest
import torch
from torch import nn

from magrl.field.elements import measured_elements, seven_elements
from magrl.field.igrf import IGRF, igrf_coefficients, parse_date
from magrl.field.model import elements_at, elements_gradient_at
from magrl.field.regional import RegionalField
from magrl.field.spherical import SphericalHarmonicField
from magrl.geodesy import REFERENCE_RADIUS_KM, WGS84_A_KM, WGS84_B_KM, curvature_radii

COEFFICIENT_FILES = {13: ppigrf.ppigrf.shc_fn_igrf13, 14: ppigrf.ppigrf.shc_fn_igrf14}
LAST_YEAR = {13: 2025, 14: 2030}
FIRST_INSTANT = datetime(1900, 1, 1)
PAPER_DATE = "2022-01-01"
ROUNDING_NT = 1e-8
DATA = Path(__file__).parent.parent / "data"


def f64(*values):
    return torch.tensor(values, dtype=torch.float64)


def globe(count, seed, highest_latitude=89.9):
    """Latitude and longitude [deg] of points uniform over the globe."""
    generator = torch.Generator().manual_seed(seed)
    reach = math.sin(math.radians(highest_latitude))
    latitude = torch.rad2deg(torch.asin(reach * (2 * torch.rand(count, generator=generator, dtype=torch.float64) - 1)))
    return latitude, 360 * torch.rand(count, generator=generator, dtype=torch.float64) - 180


def axial_dipole(g10=-30000.0):
    gauss = torch.zeros(2, 2, dtype=torch.complex128)
    gauss[1, 0] = g10
    return SphericalHarmonicField(gauss)


@pytest.fixture(scope="module")
def igrf():
    return IGRF(PAPER_DATE, generation=13)


@pytest.fixture(scope="module")
def region(igrf):
    """The paper's box with 5.5 degrees about it."""
    return RegionalField(igrf, (-15.5, 5.5), (154.5, 175.5))


# --- IGRF -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("generation", COEFFICIENT_FILES)
def test_igrf_matches_ppigrf(generation):
    """10 000 points over the globe, -5 to 600 km high, at ten dates from 1900 on.

    The project promises 0.01 nT; the 0.0004 nT that are left come from the series in ppigrf's change of coordinates.
    """
    rng = np.random.default_rng(generation)
    span = datetime(LAST_YEAR[generation] - 1, 12, 31) - FIRST_INSTANT
    dates = [FIRST_INSTANT + timedelta(days=int(day)) for day in np.sort(rng.integers(0, span.days + 1, 9))]
    for k, date in enumerate((FIRST_INSTANT, *dates)):
        latitude, longitude = globe(1000, 100 * generation + k)
        altitude_km = torch.from_numpy(rng.uniform(-5, 600, 1000))
        positions = (x.numpy() for x in (longitude, latitude, altitude_km))
        east, north, up = ppigrf.igrf(*positions, date, coeff_fn=COEFFICIENT_FILES[generation])
        expected = torch.from_numpy(np.stack((north[0], east[0], -up[0]), -1))
        found = IGRF(date, generation)(latitude, longitude, altitude_km)
        assert (found - expected).abs().max() < 0.001, date


@pytest.mark.parametrize(
    ("position", "elements"),
    [((-2.0, 162.0), (8.019, -16.150, 35467.990)), ((-8.0, 164.0), (9.228, -26.923, 35199.415))],
)
def test_the_paper_s_example_points(igrf, position, elements):
    found = elements_at(igrf, f64(*position)).tolist()
    assert found[:2] == pytest.approx(elements[:2], abs=0.002)
    assert found[2] == pytest.approx(elements[2], abs=1.5)


def test_the_paper_s_figures_are_not_those_of_generation_14():
    found = elements_at(IGRF(PAPER_DATE, generation=14), f64(-8.0, 164.0)).tolist()
    assert abs(found[2] - 35199.415) > 3


def test_coefficients_at_an_epoch_and_between_two():
    """IGRF-13 as published: g10, g11, h11 of 2020 and g10 of 2015."""
    table = igrf_coefficients("2020-01-01", 13)
    assert table.shape == (14, 14)
    assert complex(table[1, 0]) == pytest.approx(-29404.8, abs=1e-9)
    assert complex(table[1, 1]) == pytest.approx(-1450.9 - 4652.5j, abs=1e-9)
    ends = [datetime(2015, 1, 1), datetime(2020, 1, 1)]
    middle = igrf_coefficients(ends[0] + (ends[1] - ends[0]) / 2, 13)
    assert middle[1, 0].real.item() == pytest.approx((-29441.46 - 29404.8) / 2, abs=1e-9)


def test_default_generation_is_14():
    assert torch.equal(igrf_coefficients(2021.0), igrf_coefficients(2021.0, 14))
    assert not torch.equal(igrf_coefficients(2021.0), igrf_coefficients(2021.0, 13))


def wmm2025(year):
    """The Gauss coefficients of the World Magnetic Model: lines of n, m, g, h [nT] and their rates [nT/year]."""
    gauss = torch.zeros(13, 13, dtype=torch.complex128)
    for line in (DATA / "wmm2025.cof").read_text().splitlines()[1:-2]:
        n, m, g, h, g_rate, h_rate = map(float, line.split())
        gauss[int(n), int(m)] = complex(g + (year - 2025) * g_rate, -h - (year - 2025) * h_rate)
    return gauss


def test_another_model_gives_its_published_values():
    """WMM2025, whose table is printed to 0.1 nT and 0.01 degrees, sea level and 100 km high, now and in 2027.5."""
    table = np.loadtxt(DATA / "wmm2025_test_values.txt")
    assert table.shape == (12, 11)
    for year, altitude_km, latitude, longitude, *published in table.tolist():
        found = seven_elements(SphericalHarmonicField(wmm2025(year))(f64(latitude), f64(longitude), altitude_km)[0])
        nanotesla = (found.B_x, found.B_y, found.B_z, found.B_H, found.B_F)
        assert [float(x) for x in nanotesla] == pytest.approx(published[:5], rel=0, abs=0.0501)
        assert [float(x) for x in (found.I, found.D)] == pytest.approx(published[5:], rel=0, abs=0.00501)


# --- dates ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "form",
    [
        datetime(2022, 7, 2, 12),
        datetime(2022, 7, 2, 12, tzinfo=timezone.utc),
        datetime(2022, 7, 3, 0, tzinfo=timezone(timedelta(hours=12))),
        datetime(2022, 7, 2, 5, tzinfo=timezone(timedelta(hours=-7))),
        "2022-07-02T12:00:00",
        "2022-07-02 12:00",
        "2022-07-02T22:00:00+10:00",
        2022.5,
        np.float64(2022.5),
        np.float32(2022.5),
        np.datetime64("2022-07-02T12:00"),
        pandas.Timestamp("2022-07-02T12:00"),
    ],
    ids=str,
)
def test_one_date_in_every_form(form):
    assert parse_date(form) == datetime(2022, 7, 2, 12)
    assert parse_date(form).tzinfo is None
    assert torch.equal(igrf_coefficients(form), igrf_coefficients("2022-07-02T12:00"))


@pytest.mark.parametrize(
    ("year", "instant"),
    [(2022, datetime(2022, 1, 1)), (2020.5, datetime(2020, 7, 2)), (1900.0, datetime(1900, 1, 1))],
)
def test_a_decimal_year_counts_leap_days(year, instant):
    assert parse_date(year) == instant


@pytest.mark.parametrize("generation", COEFFICIENT_FILES)
def test_the_whole_span_of_the_model_is_accepted(generation):
    last = LAST_YEAR[generation]
    for first_and_last in ((1900.0, float(last)), ("1900-01-01", f"{last}-01-01")):
        for date in first_and_last:
            field = IGRF(date, generation)(f64(0.0), f64(0.0))
            assert torch.isfinite(field).all()


@pytest.mark.parametrize("generation", COEFFICIENT_FILES)
@pytest.mark.parametrize("side", ["before", "after"])
def test_a_day_outside_the_model_is_refused_with_its_span(generation, side):
    last = datetime(LAST_YEAR[generation], 1, 1)
    date = FIRST_INSTANT - timedelta(days=1) if side == "before" else last + timedelta(days=1)
    for form in (date, date.isoformat()):
        with pytest.raises(ValueError, match=rf"IGRF-{generation}.*1900-01-01 to {last.date()}"):
            IGRF(form, generation)


@pytest.mark.parametrize("read", [parse_date, IGRF])
def test_bad_dates_are_refused(read):
    for date in (
        math.nan,
        math.inf,
        -1.0,
        0.5,
        1e5,
        "yesterday",
        "",
        "2022-13-01",
        True,
        None,
        [],
        np.datetime64("NaT"),
        pandas.NaT,
    ):
        with pytest.raises(ValueError, match="date"):
            read(date)


def test_many_dates_are_each_that_of_its_place():
    """Against one model for each date, in every form of dates, with gradients; and on an epoch, first and last day."""
    dates = ["1900-01-01", 1957.25, calendar_date(2019, 3, 4), np.datetime64("2020-01-01"), "2029-12-31", "2030-01-01"]
    latitude, longitude = globe(len(dates), 11)
    altitude_km = torch.linspace(-10, 500, len(dates), dtype=torch.float64)
    many = IGRF(dates)
    values, gradients = many.value_and_gradient(latitude, longitude, altitude_km)
    for k, date in enumerate(dates):
        value, gradient = IGRF(date).value_and_gradient(latitude[k], longitude[k], altitude_km[k])
        torch.testing.assert_close(values[k], value, rtol=0, atol=ROUNDING_NT)
        torch.testing.assert_close(gradients[k], gradient, rtol=0, atol=ROUNDING_NT)
    torch.testing.assert_close(many(latitude, longitude, altitude_km), values, rtol=0, atol=ROUNDING_NT)
    for form in (many.date, many.date.astype("M8[ns]"), pandas.Series(many.date), pandas.DatetimeIndex(many.date)):
        torch.testing.assert_close(IGRF(form)(latitude, longitude, altitude_km), values, rtol=0, atol=ROUNDING_NT)


def test_dates_broadcast_with_positions():
    latitude, longitude = globe(3, 12)
    series = IGRF(np.array([[2000.0], [2021.0]]), altitude_km=100.0)
    expected = torch.stack([IGRF(year, altitude_km=100.0)(latitude, longitude) for year in (2000.0, 2021.0)])
    torch.testing.assert_close(series(latitude, longitude), expected, rtol=0, atol=ROUNDING_NT)
    assert series.value_and_gradient(latitude, longitude)[1].shape == (2, 3, 3, 2)
    assert IGRF([2020.0])(f64(1.0), f64(2.0)).shape == (1, 3)


def test_bad_dates_among_many_are_refused():
    for dates, message in (
        ([], r"at least one date, got \[\]"),
        ([2020.0, "May"], "date 'May' is not an ISO date"),
        ([2020.0, "1850-01-01"], "date 1850-01-01T00:00:00 is outside IGRF-14"),
        (np.array(["2020-01-01", "NaT"], dtype="M8[D]"), "date .*NaT.* is missing"),
        (pandas.Series([None], dtype="M8[ns]"), "date .*NaT.* is missing"),
        ([np.datetime64(20000, "Y")], "is not in a year between"),
    ):
        with pytest.raises(ValueError, match=message):
            IGRF(dates)
    with pytest.raises(ValueError, match=re.escape("shape (3,) do not broadcast with dates of shape (2,)")):
        IGRF([2020.0, 2021.0])(*globe(3, 0))


@pytest.mark.parametrize("date", [2020.0, [2020.0, 2021.0]])
def test_an_altitude_in_meters_is_questioned(date):
    for altitude_km in (5000.0, 1001.0, -16.0):
        with pytest.raises(ValueError, match=rf"altitude_km {altitude_km} is not from -15 to 1000 km .* in meters\?"):
            IGRF(date, altitude_km=altitude_km)
        with pytest.raises(ValueError, match=rf"altitude_km {altitude_km} is not from -15 to 1000 km .* in meters\?"):
            IGRF(date)(*globe(2, 0), altitude_km)


def test_a_calendar_date_is_its_midnight():
    assert parse_date(calendar_date(2022, 7, 2)) == datetime(2022, 7, 2)


def test_other_generations_are_refused():
    for generation in (12, 15, 0, "14"):
        with pytest.raises(ValueError, match=rf"generation {generation!r} is not available.*13, 14"):
            IGRF(PAPER_DATE, generation)


# --- synthesis --------------------------------------------------------------------------------------------------------


def test_axial_dipole_worked_by_hand():
    """g10 = -30000 nT: northward on the equator; twice as strong at the poles, down at the north, up at the south."""
    found = axial_dipole()(f64(0.0, 90.0, -90.0), f64(50.0, 0.0, 0.0))
    equator, pole = 30000 * (REFERENCE_RADIUS_KM / WGS84_A_KM) ** 3, 60000 * (REFERENCE_RADIUS_KM / WGS84_B_KM) ** 3
    expected = f64(equator, 0, 0, 0, 0, pole, 0, 0, -pole).reshape(3, 3)
    torch.testing.assert_close(found, expected, rtol=0, atol=ROUNDING_NT)


def test_altitude_is_that_of_the_model_unless_given():
    latitude, longitude = globe(20, 1)
    high = IGRF(PAPER_DATE, 13, altitude_km=400.0)
    low = IGRF(PAPER_DATE, 13)
    for found, expected in (
        (high(latitude, longitude), low(latitude, longitude, 400.0)),
        (high(latitude, longitude, 0.0), low(latitude, longitude)),
        (high.value_and_gradient(latitude, longitude)[1], low.value_and_gradient(latitude, longitude, 400.0)[1]),
    ):
        torch.testing.assert_close(found, expected, rtol=0, atol=ROUNDING_NT)
    assert (high(latitude, longitude).norm(dim=-1) < low(latitude, longitude).norm(dim=-1)).all()


@pytest.mark.parametrize("altitude_km", [-5.0, 0.0, 600.0, 36000.0])
def test_the_model_s_altitude_and_the_same_given_agree(altitude_km):
    """One is a short series made for that altitude, the other the whole expansion: over the globe and at its poles."""
    latitude, longitude = globe(500, 6)
    latitude[:2] = f64(90.0, -90.0)
    model = SphericalHarmonicField(igrf_coefficients(PAPER_DATE, 13), altitude_km=altitude_km)
    given = model.value_and_gradient(latitude, longitude, altitude_km)
    torch.testing.assert_close(model(latitude, longitude), given[0], rtol=0, atol=ROUNDING_NT)
    found = model.value_and_gradient(latitude[2:], longitude[2:])
    torch.testing.assert_close(found[1], given[1][2:], rtol=1e-9, atol=1e-9)


def central_differences(model, latitude, longitude, altitude_km, step_deg=0.02):
    """Fourth-order derivative northward and eastward [nT/km] of the components at constant altitude."""

    def slope(north, east):
        def at(k):
            return model(latitude + k * step_deg * north, longitude + k * step_deg * east, altitude_km)

        return (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * math.radians(step_deg))

    meridian, prime_vertical = curvature_radii(latitude)
    per_north = 1 / (meridian + altitude_km)
    per_east = 1 / ((prime_vertical + altitude_km) * torch.cos(torch.deg2rad(latitude)))
    return torch.stack((slope(1, 0) * per_north[:, None], slope(0, 1) * per_east[:, None]), -1)


def relative_error(found, expected):
    """Largest difference over the last two dimensions, against the largest entry, of the worst point."""
    return float(((found - expected).abs().amax((-2, -1)) / expected.abs().amax((-2, -1))).max())


@pytest.mark.parametrize("generation", COEFFICIENT_FILES)
@pytest.mark.parametrize("altitude_km", [-5.0, 0.0, 600.0])
def test_gradient_matches_central_differences(generation, altitude_km):
    model = IGRF("2019-05-05", generation)
    latitude, longitude = globe(300, 2, highest_latitude=85)
    value, gradient = model.value_and_gradient(latitude, longitude, altitude_km)
    expected = central_differences(model, latitude, longitude, torch.full_like(latitude, altitude_km))
    assert relative_error(gradient, expected) < 1e-8
    torch.testing.assert_close(value, model(latitude, longitude, altitude_km), rtol=0, atol=ROUNDING_NT)


def test_gradient_of_the_elements_matches_central_differences(igrf):
    latitude, longitude = globe(300, 3, highest_latitude=60)

    def elements(lat, lon, _):
        return measured_elements(igrf(lat, lon))

    expected = central_differences(elements, latitude, longitude, torch.zeros_like(latitude))
    found = elements_gradient_at(igrf, torch.stack((latitude, longitude), -1))
    assert ((found - expected).abs() / expected.abs().amax(-1, keepdim=True)).max() < 1e-8


def test_gradients_in_the_paper_s_box_have_the_known_size(igrf):
    """Per 100 km: D about 0.2 deg, I about 1.7 deg, B_H 50 to 150 nT."""
    grid = torch.cartesian_prod(torch.linspace(-10, 0, 11), torch.linspace(160, 170, 11)).double()
    per_100km = 100 * elements_gradient_at(igrf, grid).norm(dim=-1).median(0).values
    assert per_100km.tolist() == [pytest.approx(0.2, abs=0.1), pytest.approx(1.7, abs=0.2), pytest.approx(100, abs=50)]


@pytest.mark.parametrize("pole", [90.0, -90.0])
def test_a_pole_is_an_ordinary_point(igrf, pole):
    longitude = f64(0.0, 45.0, 179.0, -120.0)
    field = igrf(torch.full_like(longitude, pole), longitude)
    assert torch.isfinite(field).all()
    strength = field.norm(dim=-1)
    torch.testing.assert_close(strength, strength[:1].expand(4), rtol=0, atol=ROUNDING_NT)
    torch.testing.assert_close(field[:, 2], field[:1, 2].expand(4), rtol=0, atol=ROUNDING_NT)
    beside = igrf(torch.full_like(longitude, math.copysign(89.999999, pole)), longitude)
    torch.testing.assert_close(beside, field, rtol=0, atol=0.01)  # a tenth of a meter away
    assert all(torch.isfinite(x).all() for x in igrf.value_and_gradient(torch.full_like(longitude, pole), longitude))


@pytest.mark.parametrize("pole", [90.0, -90.0])
def test_north_at_a_pole_follows_the_given_meridian(igrf, pole):
    """Turning the meridian by 90 degrees turns the horizontal components by as much."""
    (north, east, _), (north2, east2, _) = igrf(f64(pole, pole), f64(10.0, 100.0))
    turned = (east2, -north2) if pole > 0 else (-east2, north2)
    assert north.item() == pytest.approx(turned[0].item(), abs=ROUNDING_NT)
    assert east.item() == pytest.approx(turned[1].item(), abs=ROUNDING_NT)


def test_the_dateline_is_no_seam(igrf):
    latitude = torch.linspace(-89, 89, 30, dtype=torch.float64).unsqueeze(-1)
    value, gradient = igrf.value_and_gradient(latitude, f64(180.0, -180.0, 540.0))
    for other in (1, 2):
        torch.testing.assert_close(value[:, other], value[:, 0], rtol=0, atol=ROUNDING_NT)
        torch.testing.assert_close(gradient[:, other], gradient[:, 0], rtol=0, atol=ROUNDING_NT)


@pytest.mark.parametrize("model", ["igrf", "region"])
def test_batch_shapes_and_dtypes(model, request):
    field = request.getfixturevalue(model)
    for shape in ((), (3,), (2, 3), (0,), (2, 0)):
        for dtype in (torch.float32, torch.float64):
            check_shape_and_dtype(field, shape, dtype)


def check_shape_and_dtype(field, shape, dtype):
    latitude, longitude = torch.full(shape, -8.0, dtype=dtype), torch.full(shape, 164.0, dtype=dtype)
    value, gradient = field.value_and_gradient(latitude, longitude)
    for found, expected in (
        (field(latitude, longitude), (*shape, 3)),
        (value, (*shape, 3)),
        (gradient, (*shape, 3, 2)),
    ):
        assert found.shape == expected
        assert found.dtype == torch.float64
    one = field(f64(-8.0), f64(164.0))[0]
    torch.testing.assert_close(value, one.expand_as(value), rtol=0, atol=ROUNDING_NT)


@pytest.mark.parametrize("model", ["igrf", "region"])
def test_positions_broadcast(model, request):
    field = request.getfixturevalue(model)
    latitude, longitude = f64(-8.0, -5.0, -2.0).unsqueeze(-1), f64(160.0, 165.0)
    value, gradient = field.value_and_gradient(latitude, longitude)
    assert value.shape == (3, 2, 3)
    assert gradient.shape == (3, 2, 3, 2)
    for row in range(3):
        for column in range(2):
            one = field.value_and_gradient(latitude[row, 0], longitude[column])
            torch.testing.assert_close(value[row, column], one[0], rtol=0, atol=ROUNDING_NT)
            torch.testing.assert_close(gradient[row, column], one[1], rtol=0, atol=ROUNDING_NT)


def test_altitudes_broadcast(igrf):
    found = igrf(f64(-8.0), f64(164.0), f64(0.0, 100.0, 600.0))
    assert found.shape == (3, 3)
    torch.testing.assert_close(found[2], igrf(f64(-8.0), f64(164.0), 600.0)[0], rtol=0, atol=ROUNDING_NT)


@pytest.mark.parametrize("model", ["igrf", "region"])
@pytest.mark.parametrize(
    "cast", [lambda m: m.to(torch.float32), nn.Module.float, nn.Module.half], ids=["to", "float", "half"]
)
def test_a_cast_to_lower_precision_is_not_obeyed(model, cast, request):
    field, position = copy.deepcopy(request.getfixturevalue(model)), (f64(-8.0), f64(164.0))
    before = field(*position)
    assert cast(field) is field
    assert {x.dtype for x in field.buffers()} == {torch.float64}
    assert torch.equal(field(*position), before)


@pytest.mark.parametrize("count", [20_000, 40_000])
def test_many_points_are_those_points_one_by_one(igrf, region, count):
    """More than any chunk holds."""
    position = inside((-15.5, 5.5), (154.5, 175.5), count)
    chosen = torch.tensor([0, 1, 2067, 2068, 16383, 16384, count - 1])
    few = tuple(x[chosen] for x in position)
    for model in (igrf, region):
        torch.testing.assert_close(model(*position)[chosen], model(*few), rtol=0, atol=ROUNDING_NT)
        for found, expected in zip(model.value_and_gradient(*position), model.value_and_gradient(*few), strict=True):
            torch.testing.assert_close(found[chosen], expected, rtol=0, atol=ROUNDING_NT)


@pytest.mark.parametrize("model", ["igrf", "region"])
def test_models_are_traced_whole(model, request):
    """Nothing in them breaks the graph that torch.compile makes."""
    field, position = request.getfixturevalue(model), (f64(-8.0, -2.0), f64(164.0, 162.0))
    whole = torch.compile(field.forward, fullgraph=True, backend="eager")
    torch.testing.assert_close(whole(*position), field(*position), rtol=0, atol=ROUNDING_NT)


@pytest.mark.parametrize("model", ["igrf", "region"])
def test_models_can_be_differentiated(model, request):
    """Their own gradient, northward per km, is what autograd finds per degree."""
    field = request.getfixturevalue(model)
    latitude, longitude = f64(-8.0, -2.0).requires_grad_(), f64(164.0, 162.0)
    (slope,) = torch.autograd.grad(field(latitude, longitude).sum(), latitude)
    meridian, _ = curvature_radii(latitude.detach())
    expected = field.value_and_gradient(latitude.detach(), longitude)[1][..., 0].sum(-1) * torch.deg2rad(meridian)
    torch.testing.assert_close(slope, expected, rtol=1e-9, atol=0)


@pytest.mark.parametrize("count", [1, 7, 20])
def test_chunks_do_not_show(igrf, count):
    small = IGRF(PAPER_DATE, 13, chunk=7)
    position = globe(count, 4)
    torch.testing.assert_close(small(*position), igrf(*position), rtol=0, atol=ROUNDING_NT)
    for found, expected in zip(small.value_and_gradient(*position), igrf.value_and_gradient(*position), strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=ROUNDING_NT)


@pytest.mark.parametrize("method", ["forward", "value_and_gradient"])
def test_positions_off_the_earth_are_refused(igrf, method):
    """A bad latitude, longitude or altitude beside a good one."""
    for *position, message in (
        (90.1, 0.0, 0.0, "latitude 90.1"),
        (-90.1, 0.0, 0.0, "latitude -90.1"),
        (math.nan, 0.0, 0.0, "latitude nan"),
        (0.0, math.nan, 0.0, "longitude nan"),
        (0.0, math.inf, 0.0, "longitude inf"),
        (0.0, 0.0, math.nan, "altitude_km"),
        (0.0, 0.0, math.inf, "altitude_km"),
    ):
        with pytest.raises(ValueError, match=message):
            getattr(igrf, method)(*(f64(0.0, x) for x in position))


def test_bad_tables_and_options_are_refused():
    for shape in ((4,), (2, 3), (1, 1), (2, 2, 2), (0, 0)):
        with pytest.raises(ValueError, match=re.escape(f"square (N + 1, N + 1) table with N >= 1, got shape {shape}")):
            SphericalHarmonicField(torch.zeros(shape, dtype=torch.complex128))
    for bad in (complex(math.nan, 0), complex(0, math.nan), complex(math.inf, 0)):
        gauss = torch.zeros(3, 3, dtype=torch.complex128)
        gauss[1, 1] = bad
        with pytest.raises(ValueError, match="finite"):
            SphericalHarmonicField(gauss)
    for chunk in (0, -5):
        with pytest.raises(ValueError, match=f"{chunk}"):
            IGRF(PAPER_DATE, chunk=chunk)
    for altitude_km in (math.nan, math.inf, -101.0):
        with pytest.raises(ValueError, match=f"altitude_km .*{altitude_km}"):
            IGRF(PAPER_DATE, altitude_km=altitude_km)


# --- regional expansion -----------------------------------------------------------------------------------------------


def inside(latitude, longitude, count=2000, seed=5):
    """Random points of a box, its corners among them."""
    generator = torch.Generator().manual_seed(seed)
    unit = torch.rand(count, 2, generator=generator, dtype=torch.float64)
    unit[:4] = f64(0, 0, 0, 1, 1, 0, 1, 1).reshape(4, 2)
    return tuple(low + (high - low) * u for (low, high), u in zip((latitude, longitude), unit.unbind(-1), strict=True))


def test_region_is_the_model_inside(igrf, region):
    position = inside((-15.5, 5.5), (154.5, 175.5))
    expected, expected_gradient = igrf.value_and_gradient(*position)
    value, gradient = region.value_and_gradient(*position)
    assert region.error_nt < 1e-5
    assert (value - expected).abs().max() < 1e-5
    assert torch.equal(region(*position), value)
    assert relative_error(gradient, expected_gradient) < 1e-6


def test_region_states_the_largest_error(igrf):
    coarse = RegionalField(igrf, (-10, 0), (160, 170), degree=5, tolerance_nt=10.0)
    position = inside((-10.0, 0.0), (160.0, 170.0))
    found = float((coarse(*position) - igrf(*position)).abs().max())
    assert coarse.error_nt > 1e-4
    assert 0.5 * coarse.error_nt < found < 1.2 * coarse.error_nt


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_outside_is_nan_and_never_an_extrapolation(region, dtype):
    """One position inside, six outside."""
    latitude = torch.tensor([-5.0, -15.5001, 5.5001, -5.0, -5.0, -5.0, 80.0], dtype=dtype)
    longitude = torch.tensor([165.0, 165.0, 165.0, 154.4999, 175.5001, -15.0, 0.0], dtype=dtype)
    for found in (region(latitude, longitude), *region.value_and_gradient(latitude, longitude)):
        assert torch.isfinite(found[0]).all()
        assert torch.isnan(found[1:]).all()


def test_a_position_that_is_nan_gives_nan(region):
    assert torch.isnan(region(f64(math.nan, -5.0), f64(165.0, math.nan))).all()


@pytest.mark.parametrize("longitude", [(170.0, 190.0), (-190.0, -170.0), (530.0, 550.0)])
def test_a_box_across_the_antimeridian(igrf, longitude):
    field = RegionalField(igrf, (-10.0, 4.0), longitude)
    latitude = f64(-9.0, -3.0, 0.0, 4.0)
    for turn in (
        f64(171.0, 179.5, 180.0, 189.0),
        f64(-189.0, -180.5, -180.0, -171.0),
        f64(171.0, 179.5, -180.0, -171.0),
    ):
        value, gradient = field.value_and_gradient(latitude, turn)
        expected = igrf.value_and_gradient(latitude, turn)
        torch.testing.assert_close(value, expected[0], rtol=0, atol=1e-5)
        assert relative_error(gradient, expected[1]) < 1e-6
    assert torch.isnan(field(latitude, f64(169.9, 191.0, -168.0, 0.0))).all()


DECIMAL_BOXES = [
    (((south - 60) / 10, (south + 37) / 10), ((west - 1000) / 10, (west - 947) / 10))
    for south, west in zip(range(0, 120, 11), range(0, 2600, 213), strict=False)
]


def test_the_edges_belong_to_the_box_however_they_round(igrf):
    for latitude, longitude in DECIMAL_BOXES:
        field = RegionalField(igrf, latitude, longitude)
        assert torch.isfinite(field(f64(*latitude), f64(*longitude))).all(), (latitude, longitude)


def test_region_with_a_geographic_pole_on_its_edge(igrf):
    field = RegionalField(igrf, (80.0, 90.0), (-20.0, 20.0))
    latitude, longitude = f64(81.0, 89.0, 90.0), f64(-19.0, 3.0, 10.0)
    torch.testing.assert_close(field(latitude, longitude), igrf(latitude, longitude), rtol=0, atol=1e-3)


@pytest.mark.parametrize(("degree", "tolerance_nt"), [(2, 1e-3), (4, 1e-3), (12, 1e-13)])
def test_a_missed_tolerance_is_refused_with_its_numbers(igrf, degree, tolerance_nt):
    message = rf"degree {degree} misses the model by \d[\d.e+-]* nT .*\(-10, 0\).*\(160, 170\).*{tolerance_nt:.3g} nT"
    with pytest.raises(ValueError, match=message):
        RegionalField(igrf, (-10, 0), (160, 170), degree=degree, tolerance_nt=tolerance_nt)


def test_bad_boxes_and_settings_are_refused(igrf):
    for latitude, longitude, options, message in (
        ((0, -10), (160, 170), {}, r"latitudes \(0, -10\)"),
        ((0, 0), (160, 170), {}, r"latitudes \(0, 0\)"),
        ((-10, 91), (160, 170), {}, r"latitudes \(-10, 91\)"),
        ((-10, math.nan), (160, 170), {}, "latitudes"),
        ((-10, 0), (170, 160), {}, r"longitudes \(170, 160\)"),
        ((-10, 0), (170, -170), {}, r"longitudes \(170, -170\).*\(170, 190\)"),
        ((-10, 0), (160, 160), {}, r"longitudes \(160, 160\)"),
        ((-10, 0), (0, 361), {}, r"longitudes \(0, 361\)"),
        ((-10, 0), (math.nan, 170), {}, "longitudes"),
        ((-10, 0), (160, 170), {"degree": 0}, "degree .* got 0"),
        ((-10, 0), (160, 170), {"tolerance_nt": 0.0}, "tolerance_nt .* got 0"),
        ((-10, 0), (160, 170), {"tolerance_nt": -1.0}, "tolerance_nt .* got -1"),
        ((-10, 0), (160, 170), {"tolerance_nt": math.nan}, "tolerance_nt .* got nan"),
    ):
        with pytest.raises(ValueError, match=message):
            RegionalField(igrf, latitude, longitude, **options)


@pytest.mark.parametrize("shape", [(), (4,), (2, 3)])
def test_elements_at_positions(region, shape):
    position = f64(-8.0, 164.0).expand(*shape, 2)
    elements, gradient = elements_at(region, position), elements_gradient_at(region, position)
    assert elements.shape == (*shape, 3)
    assert gradient.shape == (*shape, 3, 2)
    assert elements.reshape(-1, 3)[0].tolist() == pytest.approx([9.228, -26.923, 35199.415], abs=1.5)


def test_models_hold_no_parameters_and_survive_a_state_dict(igrf, region):
    for model in (igrf, region):
        assert not list(model.parameters())
        assert not any(x.requires_grad for x in model.buffers())
    twin = RegionalField(IGRF(1950.0), (-15.5, 5.5), (154.5, 175.5))
    twin.load_state_dict(region.state_dict())
    assert torch.equal(twin(f64(-8.0), f64(164.0)), region(f64(-8.0), f64(164.0)))
