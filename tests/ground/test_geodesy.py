"""Positions, moves, distances and bearings, against closed forms and against GeographicLib."""

import itertools
import math

import pytest
import torch
from geographiclib.geodesic import Geodesic
from support.field_checks import f64

from magrl.geodesy import (
    WGS84_A_KM,
    WGS84_B_KM,
    check_box,
    check_positions,
    curvature_radii,
    displaced,
    geodesic,
    local_frame,
    move,
    polar,
    to_ecef,
    wrap_angle,
    wrap_longitude,
)

KARNEY = Geodesic.WGS84
DTYPES = (torch.float32, torch.float64)
SHAPES = ((), (3,), (2, 3), (0,))


def globe(count, seed):
    """Points uniform over the globe; the first ones sit at the poles, on the antimeridian and on the equator."""
    generator = torch.Generator().manual_seed(seed)
    latitude = torch.rad2deg(torch.asin(2 * torch.rand(count, generator=generator, dtype=torch.float64) - 1))
    longitude = 360 * torch.rand(count, generator=generator, dtype=torch.float64) - 180
    latitude[:10], latitude[10:20], latitude[20:30], latitude[30:40] = 90, -90, 89.999, 0
    longitude[40:50], longitude[50:60], longitude[60:70] = 180, -180, 179.999
    return latitude, longitude


def headings(count, seed):
    generator = torch.Generator().manual_seed(seed)
    return (2 * torch.rand(count, generator=generator, dtype=torch.float64) - 1) * math.pi


def karney_inverse(latitude1, longitude1, latitude2, longitude2):
    """Distance [km], bearing [rad] and arc [deg] of each pair."""
    columns = (x.tolist() for x in (latitude1, longitude1, latitude2, longitude2))
    found = [KARNEY.Inverse(*pair, Geodesic.DISTANCE | Geodesic.AZIMUTH) for pair in zip(*columns, strict=True)]
    return (
        f64(*(x["s12"] / 1e3 for x in found)),
        torch.deg2rad(f64(*(x["azi1"] for x in found))),
        f64(*(x["a12"] for x in found)),
    )


def apart_km(latitude1, longitude1, latitude2, longitude2):
    """Distance of points so close that their chord is their distance."""
    return (to_ecef(latitude1, longitude1) - to_ecef(latitude2, longitude2)).norm(dim=-1)


# --- angles -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
def test_wrap_of_known_angles(dtype):
    turns = f64(0.0, 0.25, 0.5, -0.5, 1.5, -1.5, 0.75, -0.75, 7)
    wrapped = f64(0.0, 0.25, 0.5, 0.5, 0.5, 0.5, -0.25, 0.25, 0)
    assert torch.equal(wrap_longitude((360 * turns).to(dtype)).double(), 360 * wrapped)
    angle = wrap_angle((2 * math.pi * turns).to(dtype)).double()
    off_by = torch.remainder(angle - 2 * math.pi * wrapped + math.pi, 2 * math.pi) - math.pi
    assert (off_by.abs() < 8 * torch.finfo(dtype).eps * (1 + turns.abs())).all()


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("wrap", "half"), [(wrap_angle, math.pi), (wrap_longitude, 180.0)])
def test_wrap_stays_in_the_half_open_turn(wrap, half, dtype):
    """Over 25 decades, at every multiple of half a turn, and one rounding step to either side of all of them."""
    generator = torch.Generator().manual_seed(1)
    scales = 10.0 ** torch.arange(-20, 6, dtype=torch.float64).unsqueeze(-1)
    spread = ((2 * torch.rand(1000, generator=generator, dtype=torch.float64) - 1) * scales).flatten()
    multiples = half * torch.arange(-200, 201, dtype=torch.float64)
    values = torch.cat((spread, multiples, f64(0.0, -0.0, 1e-40, -1e-40, -1e-300))).to(dtype)
    up, down = (torch.nextafter(values, torch.full_like(values, way)) for way in (math.inf, -math.inf))
    values = torch.cat((values, up, down))
    wrapped, edge = wrap(values), torch.tensor(half, dtype=dtype)
    assert wrapped.dtype == dtype
    assert (wrapped <= edge).all()
    assert (wrapped > -edge).all()
    turns = (values.double() - wrapped.double()) / (2 * half)
    small = values.abs() < 100 * half
    assert ((turns - turns.round())[small].abs() < 200 * torch.finfo(dtype).eps).all()


# --- frames and coordinates -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("latitude", "meridian", "prime_vertical"),
    [
        (0.0, WGS84_B_KM**2 / WGS84_A_KM, WGS84_A_KM),
        (90.0, WGS84_A_KM**2 / WGS84_B_KM, WGS84_A_KM**2 / WGS84_B_KM),
        (-90.0, WGS84_A_KM**2 / WGS84_B_KM, WGS84_A_KM**2 / WGS84_B_KM),
        (45.0, 6367.381815619549, 6388.838290121148),
    ],
)
def test_curvature_radii(latitude, meridian, prime_vertical):
    found = torch.stack(curvature_radii(torch.tensor(latitude, dtype=torch.float64)))
    torch.testing.assert_close(found, f64(meridian, prime_vertical), rtol=1e-12, atol=0)


@pytest.mark.parametrize(
    ("latitude", "longitude", "altitude_km", "ecef"),
    [
        (0.0, 0.0, 0.0, (WGS84_A_KM, 0.0, 0.0)),
        (0.0, 90.0, 2.0, (0.0, WGS84_A_KM + 2, 0.0)),
        (0.0, 180.0, 0.0, (-WGS84_A_KM, 0.0, 0.0)),
        (90.0, 33.0, 1.0, (0.0, 0.0, WGS84_B_KM + 1)),
        (-90.0, -70.0, 0.0, (0.0, 0.0, -WGS84_B_KM)),
    ],
)
def test_to_ecef_on_the_axes(latitude, longitude, altitude_km, ecef):
    found = to_ecef(*f64(latitude, longitude, altitude_km))
    torch.testing.assert_close(found, f64(*ecef), rtol=0, atol=1e-11)


@pytest.mark.parametrize("column", [0, 1])
def test_local_frame_points_where_the_position_moves(column):
    """North and east are the derivatives of the position by latitude and longitude."""
    latitude, longitude = globe(500, 5)
    latitude = latitude.clamp(-85, 85)
    step = f64(1e-3, 0.0) if column == 0 else f64(0.0, 1e-3)
    ahead, behind = (to_ecef(latitude + way * step[0], longitude + way * step[1]) for way in (1, -1))
    direction = torch.nn.functional.normalize(ahead - behind, dim=-1)
    frame = local_frame(latitude, longitude)
    torch.testing.assert_close(frame[:, column], direction, rtol=0, atol=1e-9)
    torch.testing.assert_close(torch.linalg.cross(frame[:, 0], frame[:, 1]), frame[:, 2], rtol=0, atol=1e-15)
    down = to_ecef(latitude, longitude, -3.0) - to_ecef(latitude, longitude)
    torch.testing.assert_close(down, 3 * frame[:, 2], rtol=0, atol=1e-11)


def test_shapes_and_dtypes():
    for shape, dtype in itertools.product(SHAPES, DTYPES):
        check_shapes_and_dtypes(shape, dtype)


def check_shapes_and_dtypes(shape, dtype):
    latitude, longitude = torch.full(shape, -8.0, dtype=dtype), torch.full(shape, 164.0, dtype=dtype)
    assert local_frame(latitude, longitude).shape == (*shape, 3, 3)
    assert to_ecef(latitude, longitude).shape == (*shape, 3)
    heading, distance = torch.zeros(shape, dtype=dtype), torch.full(shape, 50.0, dtype=dtype)
    end = move(latitude, longitude, heading, distance)
    for out in (*end, *geodesic(latitude, longitude, *end), wrap_angle(heading), wrap_longitude(longitude)):
        assert out.shape == shape
        assert out.dtype == dtype


# --- moves ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("distance_km", "within_km"), [(0.0, 1e-8), (1.0, 1e-7), (50.0, 2e-6), (500.0, 2e-3)], ids="{}km".format
)
def test_move_follows_the_geodesic(distance_km, within_km):
    """The promise is 5 mm at 50 km and 5 m at 500 km; a third of it is needed."""
    latitude, longitude = globe(1000, 6)
    heading = headings(1000, 7)
    found = move(latitude, longitude, heading, torch.full_like(latitude, distance_km))
    legs = zip(latitude.tolist(), longitude.tolist(), torch.rad2deg(heading).tolist(), strict=True)
    ends = [KARNEY.Direct(*leg, distance_km * 1e3) for leg in legs]
    apart = apart_km(*found, f64(*(x["lat2"] for x in ends)), f64(*(x["lon2"] for x in ends)))
    assert apart.max() < within_km
    assert (found[1].abs() <= 180).all()


@pytest.mark.parametrize(("pole", "heading"), [(90.0, 0.0), (-90.0, math.pi)])
def test_move_across_a_pole_comes_down_the_other_side(pole, heading):
    before = pole - math.copysign(0.2, pole)
    to_pole = geodesic(*f64(before, 30.0, pole, 30.0))[0]
    latitude, longitude = move(*f64(before, 30.0, heading), 2 * to_pole)
    assert float(latitude) == pytest.approx(before, abs=1e-9)
    assert float(longitude) == pytest.approx(-150.0, abs=1e-7)


# --- geodesics --------------------------------------------------------------------------------------------------------


def test_geodesic_matches_geographiclib():
    start, end = globe(2000, 10), tuple(x.flip(0) for x in globe(2000, 11))
    distance, bearing = geodesic(*start, *end)
    expected, azimuth, arc = karney_inverse(*start, *end)
    sound = arc < 170
    assert sound.sum() > 1900
    assert (distance - expected)[sound].abs().max() < 1e-7
    assert wrap_angle(bearing - azimuth)[sound].abs().max() < 1e-9


@pytest.mark.parametrize("dtype", DTYPES)
def test_coincident_points(dtype):
    latitude = torch.tensor([0.0, 12.3, -89.0, 90.0, -90.0], dtype=dtype)
    longitude = torch.tensor([0.0, 45.6, 180.0, 0.0, 10.0], dtype=dtype)
    distance, bearing = geodesic(latitude, longitude, latitude, longitude)
    assert (distance == 0).all()
    assert (bearing == 0).all()


@pytest.mark.parametrize(
    ("longitude1", "longitude2", "bearing_deg"),
    [(0.0, 1.0, 90.0), (1.0, 0.0, -90.0), (0.0, 120.0, 90.0), (179.5, -179.5, 90.0), (-100.0, 79.0, 90.0)],
)
def test_geodesic_along_the_equator(longitude1, longitude2, bearing_deg):
    distance, bearing = geodesic(*f64(0.0, longitude1, 0.0, longitude2))
    arc = abs(math.remainder(longitude2 - longitude1, 360))
    assert float(distance) == pytest.approx(math.radians(arc) * WGS84_A_KM, abs=1e-6)
    assert math.degrees(float(bearing)) == pytest.approx(bearing_deg, abs=1e-9)


def test_bearing_due_south_is_plus_pi():
    """Also towards a pole that is written with another longitude, to either side."""
    latitude, longitude = f64(-10.0, 5.0, -90.0, -90.0), f64(20.0, 380.0, 0.0, 40.0)
    bearing = geodesic(f64(10.0), f64(20.0), latitude, longitude)[1]
    assert (bearing - math.pi).abs().max() < 1e-13


@pytest.mark.parametrize(("nearest_deg", "all_known"), [(0.0, False), (2.0, True)])
def test_a_nearly_antipodal_pair_gives_the_truth_or_nan(nearest_deg, all_known):
    """The second points are up to 2 degrees further than ``nearest_deg`` from the antipodes of the first."""
    latitude, longitude = globe(1000, 14)
    off = nearest_deg + 2 * torch.rand(1000, generator=torch.Generator().manual_seed(15), dtype=torch.float64)
    arcs = zip(-latitude, longitude + 180, torch.rad2deg(headings(1000, 16)), off, strict=True)
    ends = [KARNEY.ArcDirect(*map(float, arc)) for arc in arcs]
    pairs = latitude, longitude, f64(*(x["lat2"] for x in ends)), f64(*(x["lon2"] for x in ends))
    distance, bearing = geodesic(*pairs)
    expected, azimuth, _ = karney_inverse(*pairs)
    known = ~distance.isnan()
    assert torch.equal(known, ~bearing.isnan())
    assert known.any()
    assert bool(known.all()) == all_known
    assert (distance - expected)[known].abs().max() < 1e-6
    assert wrap_angle(bearing - azimuth)[known].abs().max() < 1e-7


def test_geodesic_of_whole_degrees_is_not_cut_to_whole_kilometers():
    distance, bearing = geodesic(*torch.tensor([0, 0, 0, 1]))
    assert float(distance) == pytest.approx(111.319491, abs=1e-4)
    assert float(bearing) == pytest.approx(math.pi / 2, abs=1e-6)
    single, double = torch.ones(2), f64(1.0, 2.0)
    for inputs in ((double, single, single, single), (single, single, single, double)):
        assert [x.dtype for x in geodesic(*inputs)] == [torch.float64, torch.float64]


@pytest.mark.parametrize("place", [0, 1, 2, 3])
def test_nan_gives_nan_and_a_latitude_beyond_a_pole_raises(place):
    inputs = [f64(1.0), f64(2.0), f64(3.0), f64(4.0)]
    inputs[place] = f64(math.nan)
    assert all(x.isnan().all() for x in geodesic(*inputs))
    assert all(x.isnan().all() for x in move(*inputs)) == (place != 1)
    inputs[place] = f64(-90.5)
    if place % 2 == 0:
        with pytest.raises(ValueError, match=r"^latitude -90\.5 is not between -90 and 90 degrees$"):
            geodesic(*inputs)


def test_displacements_of_moves():
    """3 km northward and 4 km eastward."""
    total = displaced(f64(5.0), f64(math.atan2(4, 3)), f64(0.0, 0.0).unsqueeze(0))
    torch.testing.assert_close(total, f64(3.0, 4.0).unsqueeze(0))
    distance, heading = polar(total + f64(-3.0, 0.0))
    assert (float(distance), float(heading)) == pytest.approx((4.0, math.pi / 2))


@pytest.mark.parametrize(
    ("latitude", "longitude", "message"),
    [
        (5, (0, 1), "latitudes must be 2 finite numbers, got 5"),
        ((1, 1), (0, 1), r"latitudes \(1, 1\) must rise from south to north"),
        ((0, 91), (0, 1), r"latitudes \(0, 91\) must rise"),
        ((-90.5, 0), (0, 1), r"latitudes \(-90\.5, 0\) must rise"),
        ((0, 1), (5, 5), r"longitudes \(5, 5\) must rise"),
        ((0, 1), (170, -170), r"longitudes \(170, -170\) must rise .* \(170, 190\)"),
        ((0, 1), (0, 361), r"longitudes \(0, 361\) must rise .* at most 360 degrees"),
        ((0, 1), (0, math.inf), r"longitudes must be 2 finite numbers, got \(0, inf\)"),
    ],
)
def test_boxes_that_do_not_rise_raise(latitude, longitude, message):
    with pytest.raises(ValueError, match=message):
        check_box(latitude, longitude)
    check_box((-90, 90), (-180, 180))


@pytest.mark.parametrize(
    ("latitude", "longitude", "message"),
    [
        (90.5, 0.0, "^latitude 90.5 is not between -90 and 90 degrees$"),
        (math.nan, 0.0, "^latitude nan"),
        (0.0, math.inf, "^longitude inf is not a finite number of degrees$"),
    ],
)
def test_positions_off_the_earth_raise(latitude, longitude, message):
    check_positions(f64(90.0), f64(540.0))
    with pytest.raises(ValueError, match=message):
        check_positions(f64(0.0, latitude), f64(0.0, longitude))


def test_displacements_by_hand() -> None:
    """3-4-5 triangles, and errors that undo a move or turn it around."""
    distance, heading = torch.tensor([3.0, 5.0, 2.0]), torch.tensor([0.0, math.pi / 2, math.pi])
    error = torch.tensor([[0.0, 4.0], [0.0, -5.0], [3.0, 0.0]])
    moved = displaced(distance, heading, error)
    torch.testing.assert_close(moved, torch.tensor([[3.0, 4.0], [0.0, 0.0], [1.0, 0.0]]), rtol=0, atol=1e-6)
    tables = distance.expand(2, 3), heading.expand(2, 3), error.expand(2, 3, 2)
    assert torch.equal(displaced(*tables), moved.expand(2, 3, 2))
    assert polar(moved.expand(2, 3, 2))[0].shape == (2, 3)
    length, course = polar(torch.tensor([[3.0, 4.0], [0.0, -2.0], [-1.0, 0.0]]))
    torch.testing.assert_close(length, torch.tensor([5.0, 2.0, 1.0]))
    torch.testing.assert_close(course, torch.tensor([math.atan2(4, 3), -math.pi / 2, math.pi]))
    for call, name in (
        (lambda: displaced(5.0, heading, error), "distance"),
        (lambda: displaced(distance, 5.0, error), "heading"),
        (lambda: displaced(distance, heading, error[:, :1]), "error"),
        (lambda: polar(error[:, :1]), "displacement"),
    ):
        with pytest.raises((TypeError, ValueError), match=name):
            call()
