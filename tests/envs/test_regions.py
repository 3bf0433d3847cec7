"""Boxes on the ellipsoid: edges, margins, reach, distances, each alone and by index."""

import math

import pytest
import torch
from geographiclib.geodesic import Geodesic
from support.field_checks import f64

from magrl.envs import PAPER_REGION, Region, Regions
from magrl.envs.regions import one_region
from magrl.geodesy import geodesic, move

ANTIMERIDIAN = Region((-5, 5), (170, 190))
ARCTIC = Region((80, 90), (-180, 180))
WORLD = Region((-90, 90), (-180, 180))


CONTAINED = [
    (PAPER_REGION, (-5.0, 165.0), True),
    (PAPER_REGION, (0.0, 170.0), True),
    (PAPER_REGION, (-5.0, 165.0 - 720), True),
    (PAPER_REGION, (0.001, 165.0), False),
    (PAPER_REGION, (-5.0, 170.001), False),
    (PAPER_REGION, (-5.0, -15.0), False),
    (PAPER_REGION, (math.nan, 165.0), False),
    (ANTIMERIDIAN, (0.0, 180.0), True),
    (ANTIMERIDIAN, (0.0, -180.0), True),
    (ANTIMERIDIAN, (0.0, -170.0), True),
    (ANTIMERIDIAN, (0.0, -169.9), False),
    (ANTIMERIDIAN, (0.0, 169.9), False),
    (ARCTIC, (90.0, 123.0), True),
    (ARCTIC, (80.0, 180.0), True),
    (ARCTIC, (79.9, 0.0), False),
    (WORLD, (-90.0, 1234.5), True),
]


def decimal_boxes(count, seed):
    """Boxes whose edges have one decimal, which no binary number holds."""
    generator = torch.Generator().manual_seed(seed)
    south, west = (
        torch.randint(-890, 700, (count,), generator=generator),
        torch.randint(-1800, 1800, (count,), generator=generator),
    )
    height, width = (torch.randint(1, 200, (count,), generator=generator) for _ in range(2))
    rows = torch.stack((south, south + height, west, west + width), -1).tolist()
    return [Region((a / 10, b / 10), (c / 10, d / 10)) for a, b, c, d in rows]


def test_unwrapped():
    position, expected = f64((0.0, 171.0), (1.0, -171.0), (2.0, 180.0)), f64((0.0, 171.0), (1.0, 189.0), (2.0, 180.0))
    moved = torch.stack([position + f64(0.0, 360.0 * turns) for turns in (-2, 0, 1)])
    torch.testing.assert_close(ANTIMERIDIAN.unwrapped(moved), expected.expand(3, 3, 2))
    assert ANTIMERIDIAN.unwrapped(moved.float().expand(4, 3, 3, 2)).shape == (4, 3, 3, 2)


def test_holding():
    inside, outside = f64((-5.0, 165.0)), f64(((-12.0, 165.0), (3.0, 150.0)), ((-5.0, 171.0), (1.0, 160.0)))
    assert PAPER_REGION.holding(inside) == PAPER_REGION
    assert PAPER_REGION.holding(outside) == Region((-12, 3), (150, 171))


def test_longitudes_across_the_antimeridian_are_refused_with_a_remedy():
    for east, message in ((-170, r"longitudes \(170, -170\).*\(170, 190\)"), (530.5, r"longitudes \(170, 530.5\)")):
        with pytest.raises(ValueError, match=message):
            Region((-10, 0), (170, east))


def test_each_position_is_in_the_box_of_its_index():
    boxes = [PAPER_REGION, ANTIMERIDIAN, ARCTIC, WORLD]
    regions = Regions.of(boxes)
    position = f64(*(place for _, place, _ in CONTAINED))
    index = torch.tensor([boxes.index(box) for box, *_ in CONTAINED])
    expected = [[held] for *_, held in CONTAINED]
    assert regions.contains(position, index).tolist() == expected
    assert [Regions.of(box).contains(f64(*place)).tolist() for box, place, _ in CONTAINED] == expected
    assert regions.contains(position.expand(2, -1, 2), index).shape == (2, len(index), 1)
    for bad, error, says in (
        (torch.tensor(4), ValueError, r"index 4 is not in \[0, 4\)"),
        (f64(0), TypeError, "int64"),
    ):
        with pytest.raises(error, match=says):
            regions.contains(f64(0.0, 0.0), bad)


def test_edges_belong_to_the_region_however_they_round():
    regions = Regions.of(decimal_boxes(200, 1))
    corners = regions.grid(2).flatten(1, 2)
    assert regions.contains(corners, torch.arange(200).unsqueeze(-1)).all()


def test_expanded():
    for region, margin, expected in (
        (PAPER_REGION, 0.0, PAPER_REGION),
        (PAPER_REGION, 5.0, Region((-15, 5), (155, 175))),
        (PAPER_REGION, 85.0, Region((-90, 85), (75, 255))),
        (ARCTIC, 5.0, Region((75, 90), (-180, 180))),
        (Region((-85, 60), (0, 340)), 20.0, Region((-90, 80), (-10, 350))),
        (WORLD, 10.0, WORLD),
    ):
        (found,) = Regions.of(region).expanded(margin)
        assert found.latitude == pytest.approx(expected.latitude, abs=1e-9)
        assert found.longitude == pytest.approx(expected.longitude, abs=1e-9)
    boxes = Regions.of(decimal_boxes(200, 2))
    west, east = boxes.expanded(200.0).longitude.T
    torch.testing.assert_close(east - west, torch.full_like(west, 360.0))
    torch.testing.assert_close((west + east) / 2, boxes.longitude.mean(1))


REACH = [
    (PAPER_REGION, 50.0),
    (PAPER_REGION, 55.5),  # just over half a degree
    (ANTIMERIDIAN, 1000.0),
    (Region((75, 89.8), (0, 20)), 50.0),  # over the pole
    (Region((-89.8, -85), (0, 20)), 50.0),
    (Region((0, 10), (0, 355)), 50.0),
]


@pytest.mark.parametrize(("region", "max_move_km"), REACH)
def test_reachable_holds_every_place_that_a_move_can_reach(region, max_move_km):
    """From the edge in any direction."""
    heading = torch.linspace(-math.pi, math.pi, 73, dtype=torch.float64)
    side = Regions.of(region).grid(41)[0]
    rim = torch.cat((side[0], side[-1], side[:, 0], side[:, -1]))
    reached = torch.stack(move(*rim.unsqueeze(1).unbind(-1), heading, f64(max_move_km)), -1)
    assert Regions.of(region).reachable(max_move_km).contains(reached).all()


def test_no_distance_exceeds_the_longest():
    """On a grid of each box; the bound is also reached, being that of two corners."""
    regions = Regions.of([*decimal_boxes(30, 3), PAPER_REGION, Region((-45, 45), (0, 90))])
    points = regions.grid(7).flatten(1, 2)
    apart = geodesic(*points.unsqueeze(2).unbind(-1), *points.unsqueeze(1).unbind(-1))[0].amax((1, 2))
    torch.testing.assert_close(apart, regions.longest_km, rtol=1e-9, atol=0)
    for km in Regions.of([WORLD, Region((-80, 80), (0, 10)), Region((-1, 1), (0, 181))]).longest_km:
        assert Geodesic.WGS84.Inverse(-90, 0, 90, 0)["s12"] / 1e3 < km < 20500


def test_regions_are_a_batch_of_boxes():
    regions = Regions.of([PAPER_REGION, ARCTIC])
    assert list(regions) == [PAPER_REGION, ARCTIC]
    assert Regions.of(regions) is regions
    assert regions == Regions.of([PAPER_REGION, ARCTIC]) != Regions.of(PAPER_REGION)
    assert repr(regions) == "Regions(Region(latitude=(-10.0, 0.0), longitude=(160.0, 170.0)), and 1 more)"
    assert one_region(PAPER_REGION) == one_region(Regions.of(PAPER_REGION)) == PAPER_REGION
    with pytest.raises(ValueError, match="got 2: take one of them"):
        one_region(regions)
    with pytest.raises(ValueError, match=r"with K >= 1, got \(0, 2\)"):
        Regions.of([])
