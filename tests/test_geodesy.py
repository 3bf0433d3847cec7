"""Positions, legs, distances and bearings, against closed forms and against GeographicLib."""

import math

import pytest
import torch
from geographiclib.geodesic import Geodesic
from support.tracks import f64

from magrl.geodesy import (
    WGS84_A_KM,
    WGS84_B_KM,
    WGS84_F,
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


def globe(count, seed):
    """Points uniform over the globe, and headings [rad]; the first are at the poles, the antimeridian, the equator."""
    unit = torch.rand(3, count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    latitude, longitude = torch.rad2deg(torch.asin(2 * unit[0] - 1)), 360 * unit[1] - 180
    latitude[:10], latitude[10:20], latitude[20:30], latitude[30:40] = 90, -90, 89.999, 0
    longitude[40:50], longitude[50:60], longitude[60:70] = 180, -180, 179.999
    return latitude, longitude, (2 * unit[2] - 1) * math.pi


def inverse(*ends):
    """Distance [km], bearing [rad] and arc [deg] of each pair, by GeographicLib."""
    rows = [KARNEY.Inverse(*pair) for pair in zip(*(x.tolist() for x in ends), strict=True)]
    distance, bearing, arc = (f64(*(row[key] for row in rows)) for key in ("s12", "azi1", "a12"))
    return distance / 1e3, torch.deg2rad(bearing), arc


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize(("wrap", "half"), [(wrap_angle, math.pi), (wrap_longitude, 180.0)])
def test_wrapped_angles_are_the_same_in_the_half_open_turn(wrap, half, dtype):
    """Over 25 decades, at every multiple of half a turn, and one rounding step to either side of all of them."""
    unit = 2 * torch.rand(1000, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 1
    spread = (unit * 10.0 ** torch.arange(-20, 6, dtype=torch.float64).unsqueeze(-1)).flatten()
    multiples = half / 2 * torch.arange(-400, 401, dtype=torch.float64)
    values = torch.cat((spread, multiples, f64(0.0, -0.0, 1e-40, -1e-40, -1e-300))).to(dtype)
    values = torch.cat((values, *(torch.nextafter(values, torch.full_like(values, sign)) for sign in (1e9, -1e9))))
    wrapped, edge = wrap(values), torch.tensor(half, dtype=dtype)
    assert wrapped.dtype == dtype
    assert ((wrapped <= edge) & (wrapped > -edge)).all()
    turns = ((values.double() - wrapped.double()) / (2 * half))[values.abs() < 100 * half]
    assert ((turns - turns.round()).abs() < 200 * torch.finfo(dtype).eps).all()


def test_positions_and_their_frames():
    """On the axes by hand; elsewhere, the derivatives of a position are its radii of curvature along its frame.

    The point off the axes is the example in the technical report of WMM2025 (Table 3a, doi:10.25923/prbc-s316).
    """
    assert (KARNEY.a, KARNEY.f) == (1e3 * WGS84_A_KM, WGS84_F)
    place = to_ecef(*f64(-80, 240, 100))
    radius_km = float(place.norm())
    assert radius_km == pytest.approx(6457.4023484473705, rel=0, abs=1e-11)
    assert math.asin(float(place[2]) / radius_km) == pytest.approx(-1.3951289589, rel=0, abs=5.1e-11)
    axes = f64(0, 0, 0, 0, 90, 2, 0, 180, 0, 90, 33, 1, -90, -70, 0).reshape(5, 3)
    wanted = f64(WGS84_A_KM, 0, 0, 0, WGS84_A_KM + 2, 0, -WGS84_A_KM, 0, 0, 0, 0, WGS84_B_KM + 1, 0, 0, -WGS84_B_KM)
    torch.testing.assert_close(to_ecef(*axes.unbind(1)), wanted.reshape(5, 3), rtol=0, atol=1e-11)
    latitude, longitude, _ = globe(500, 5)
    latitude = latitude.clamp(-85, 85)
    frame, (meridian, across) = local_frame(latitude, longitude), curvature_radii(latitude)
    for row, radius in enumerate((meridian, across * torch.cos(torch.deg2rad(latitude)))):
        step = 1e-3 * torch.eye(2)[row].double()
        ahead, behind = (to_ecef(latitude + sign * step[0], longitude + sign * step[1]) for sign in (1, -1))
        slope = (ahead - behind) / math.radians(2e-3)
        torch.testing.assert_close(slope, radius.unsqueeze(-1) * frame[:, row], rtol=0, atol=1e-4)
    torch.testing.assert_close(torch.linalg.cross(frame[:, 0], frame[:, 1]), frame[:, 2], rtol=0, atol=1e-15)
    down = to_ecef(latitude, longitude, -3.0) - to_ecef(latitude, longitude)
    torch.testing.assert_close(down, 3 * frame[:, 2], rtol=0, atol=1e-11)


def test_dtypes_are_kept():
    for dtype in DTYPES:
        place = [torch.full((2, 0), x, dtype=dtype) for x in (-8.0, 164.0, 0.0, 50.0)]
        for out in (*move(*place), *geodesic(*place), wrap_angle(place[2]), wrap_longitude(place[1])):
            assert (out.shape, out.dtype) == ((2, 0), dtype)
    assert [float(x) for x in geodesic(*torch.tensor([0, 0, 0, 1]))] == pytest.approx(
        [111.319491, math.pi / 2], abs=1e-4
    )


@pytest.mark.parametrize(("distance_km", "within_km"), [(0.0, 1e-8), (1.0, 1e-7), (50.0, 2e-6), (500.0, 2e-3)])
def test_move_follows_the_geodesic(distance_km, within_km):
    """The promise is 5 mm at 50 km and 5 m at 500 km; a third of it is needed. Also across a pole."""
    latitude, longitude, heading = globe(1000, 6)
    latitude[-2:], longitude[-2:], heading[-2:] = f64(89.8, -89.8), 30.0, f64(0.0, math.pi)
    found = move(latitude, longitude, heading, torch.full_like(latitude, distance_km))
    legs = zip(latitude.tolist(), longitude.tolist(), torch.rad2deg(heading).tolist(), strict=True)
    ends = [KARNEY.Direct(*leg, distance_km * 1e3) for leg in legs]
    there = to_ecef(f64(*(x["lat2"] for x in ends)), f64(*(x["lon2"] for x in ends)))
    assert (to_ecef(*found) - there).norm(dim=-1).max() < within_km
    assert (found[1].abs() <= 180).all()


def test_geodesic_is_that_of_geographiclib():
    """Also along the equator, due south, which is plus pi, and toward poles that are written with any longitude."""
    start, end = globe(2000, 10)[:2], tuple(x.flip(0) for x in globe(2000, 11)[:2])
    distance, bearing = geodesic(*start, *end)
    expected, azimuth, arc = inverse(*start, *end)
    sound = arc < 170
    assert sound.sum() > 1900
    assert (distance - expected)[sound].abs().max() < 1e-7
    assert wrap_angle(bearing - azimuth)[sound].abs().max() < 1e-9
    rows = f64(0, 0, 0, 120, 0, 1, 0, 0, 0, 179.5, 0, -179.5, 10, 20, -10, 20, 10, 20, -90, 0, 10, 20, 5, 380)
    distance, bearing = geodesic(*rows.reshape(6, 4).unbind(1))
    assert distance[:3].tolist() == pytest.approx([math.radians(x) * WGS84_A_KM for x in (120, 1, 1)], abs=1e-6)
    assert torch.rad2deg(bearing).tolist() == pytest.approx([90, -90, 90, 180, 180, 180], abs=1e-9)


def test_coincident_points():
    place = f64(0.0, 12.3, -89.0, 90.0, -90.0, 0.0, 45.6, 180.0, 0.0, 10.0).reshape(2, 5)
    assert not torch.stack(geodesic(*place, *place)).any()
    assert not torch.stack(geodesic(*place.float(), *place.float())).any()


@pytest.mark.parametrize(("nearest_deg", "all_known"), [(0.0, False), (2.0, True)])
def test_a_nearly_antipodal_pair_gives_the_truth_or_nan(nearest_deg, all_known):
    """The second points are up to 2 degrees further than ``nearest_deg`` from the antipodes of the first."""
    latitude, longitude, heading = globe(1000, 14)
    off = nearest_deg + 2 * torch.rand(1000, generator=torch.Generator().manual_seed(15), dtype=torch.float64)
    arcs = zip(-latitude, longitude + 180, torch.rad2deg(heading), off, strict=True)
    ends = [KARNEY.ArcDirect(*map(float, arc)) for arc in arcs]
    pairs = latitude, longitude, f64(*(x["lat2"] for x in ends)), f64(*(x["lon2"] for x in ends))
    distance, bearing = geodesic(*pairs)
    expected, azimuth, _ = inverse(*pairs)
    known = ~distance.isnan()
    assert torch.equal(known, ~bearing.isnan())
    assert known.any()
    assert bool(known.all()) == all_known
    assert (distance - expected)[known].abs().max() < 1e-6
    assert wrap_angle(bearing - azimuth)[known].abs().max() < 1e-7


def test_nan_gives_nan_and_what_is_off_the_earth_is_named():
    for place in range(4):
        inputs = [f64(1.0), f64(2.0), f64(3.0), f64(4.0)]
        inputs[place] = f64(math.nan)
        assert all(x.isnan().all() for x in geodesic(*inputs))
        assert all(x.isnan().all() for x in move(*inputs)) == (place != 1)
        inputs[place] = f64(-90.5)
        if place % 2 == 0:
            with pytest.raises(ValueError, match=r"^latitude -90\.5 is not between -90 and 90 degrees$"):
                geodesic(*inputs)
    check_positions(f64(90.0), f64(540.0))
    for latitude, longitude, message in (
        (90.5, 0, "latitude 90.5 is"),
        (math.nan, 0, "latitude nan"),
        (0, 1e999, "inf"),
    ):
        with pytest.raises(ValueError, match=message):
            check_positions(f64(0.0, latitude), f64(0.0, longitude))


def test_displacements_by_hand():
    """3-4-5 triangles, and errors that undo a leg or turn it around."""
    distance, heading = torch.tensor([3.0, 5.0, 2.0]), torch.tensor([0.0, math.pi / 2, math.pi])
    error = torch.tensor([[0.0, 4.0], [0.0, -5.0], [3.0, 0.0]])
    moved = displaced(distance, heading, error)
    torch.testing.assert_close(moved, torch.tensor([[3.0, 4.0], [0.0, 0.0], [1.0, 0.0]]), rtol=0, atol=1e-6)
    length, course = polar(torch.tensor([[[3.0, 4.0], [0.0, -2.0], [-1.0, 0.0]]]))
    torch.testing.assert_close(length, torch.tensor([[5.0, 2.0, 1.0]]))
    torch.testing.assert_close(course, torch.tensor([[math.atan2(4, 3), -math.pi / 2, math.pi]]))


BOXES = {
    "latitudes must be 2 finite numbers, got 5": (5, (0, 1)),
    r"latitudes \(1, 1\) must rise from south to north": ((1, 1), (0, 1)),
    r"latitudes \(0, 91\) must rise": ((0, 91), (0, 1)),
    r"latitudes \(-90\.5, 0\) must rise": ((-90.5, 0), (0, 1)),
    r"longitudes \(5, 5\) must rise": ((0, 1), (5, 5)),
    r"longitudes \(170, -170\) must rise .* \(170, 190\)": ((0, 1), (170, -170)),
    r"longitudes \(0, 361\) must rise .* at most 360 degrees": ((0, 1), (0, 361)),
}


@pytest.mark.parametrize("message", BOXES)
def test_boxes_that_do_not_rise_raise(message):
    with pytest.raises(ValueError, match=message):
        check_box(*BOXES[message])
    check_box((-90, 90), (-180, 180))
