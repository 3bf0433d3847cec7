"""Boxes on the ellipsoid, alone and by index; scenarios of random regions, and the environment over several."""

import math
import re
from collections.abc import Callable
from functools import cache
from typing import Any

import pytest
import torch
from geographiclib.geodesic import Geodesic
from support.tracks import f64
from torch import Tensor
from torchrl.envs.utils import check_env_specs

from magrl.envs import (
    PAPER_REGION,
    GeomagneticNavEnv,
    Region,
    Regions,
    Scenario,
    Trips,
    earth_scenario,
    planet_scenario,
)
from magrl.envs.regions import one_region
from magrl.field import IGRF, RegionalField, SphericalHarmonicField, elements_at, random_planets
from magrl.field.elements import measured_elements
from magrl.geodesy import geodesic, move

ANTIMERIDIAN = Region((-5, 5), (170, 190))
ARCTIC = Region((80, 90), (-180, 180))
WORLD = Region((-90, 90), (-180, 180))


CONTAINED = [
    (PAPER_REGION, True, [(-5.0, 165.0), (0.0, 170.0), (-5.0, 165.0 - 720)]),
    (PAPER_REGION, False, [(0.001, 165.0), (-5.0, 170.001), (-5.0, -15.0), (math.nan, 165.0)]),
    (ANTIMERIDIAN, True, [(0.0, 180.0), (0.0, -180.0), (0.0, -170.0)]),
    (ANTIMERIDIAN, False, [(0.0, -169.9), (0.0, 169.9)]),
    (ARCTIC, True, [(90.0, 123.0), (80.0, 180.0)]),
    (ARCTIC, False, [(79.9, 0.0)]),
    (WORLD, True, [(-90.0, 1234.5)]),
]
PLACES = [(box, place, held) for box, held, places in CONTAINED for place in places]


def decimal_boxes(count, seed):
    """Boxes whose edges have one decimal, which no binary number holds."""
    generator = torch.Generator().manual_seed(seed)
    ends = ((-890, 700), (-1800, 1800), (1, 200), (1, 200))
    south, west, height, width = (torch.randint(*each, (count,), generator=generator) for each in ends)
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


def test_each_position_is_in_the_box_of_its_index():
    boxes = [PAPER_REGION, ANTIMERIDIAN, ARCTIC, WORLD]
    regions = Regions.of(boxes)
    position = f64(*(place for _, place, _ in PLACES))
    index = torch.tensor([boxes.index(box) for box, *_ in PLACES])
    expected = [[held] for *_, held in PLACES]
    assert regions.contains(position, index).tolist() == expected
    assert [Regions.of(box).contains(f64(*place)).tolist() for box, place, _ in PLACES] == expected
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


@pytest.mark.parametrize(("region", "max_leg_km"), REACH)
def test_reachable_holds_every_place_that_a_leg_can_reach(region, max_leg_km):
    """From the edge in any direction."""
    heading = torch.linspace(-math.pi, math.pi, 73, dtype=torch.float64)
    side = Regions.of(region).grid(41)[0]
    rim = torch.cat((side[0], side[-1], side[:, 0], side[:, -1]))
    reached = torch.stack(move(*rim.unsqueeze(1).unbind(-1), heading, f64(max_leg_km)), -1)
    assert Regions.of(region).reachable(max_leg_km).contains(reached).all()


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


COUNT = 6


@cache
def planets() -> Scenario:
    return planet_scenario(COUNT, seed=1)


def make(num_envs: int = 64, scenario: Scenario | None = None, **options: Any) -> GeomagneticNavEnv:
    return GeomagneticNavEnv(
        scenario or planets(), num_envs=num_envs, **{"seed": 0, "start_heading": "random"} | options
    )


def single(scenario: Scenario, index: int, gauss: Tensor, degree: int = 12) -> Scenario:
    """One region of a scenario, as a scenario of one region over its planet."""
    region = scenario.region[index]
    box = Regions.of(region).expanded(scenario.margin_deg).reachable(50)[0]
    field = RegionalField(SphericalHarmonicField(gauss), box.latitude, box.longitude, degree=degree)
    return Scenario(region=region, field=field, objective_floors=scenario.objective_floors)


def test_each_vehicle_measures_the_field_of_its_own_planet() -> None:
    steps = make(96).rollout(12, break_when_any_done=False)["next"]
    gauss = random_planets(COUNT // 2, 1)
    assert len(steps["region"].unique()) == COUNT
    for k in range(COUNT):
        rows = (steps["region"] == k).squeeze(-1)
        exact = SphericalHarmonicField(gauss[k // 2])
        for key, place in (("field", "position"), ("target_field", "target_position")):
            expected = measured_elements(exact(*steps[rows][place].unbind(-1)))
            torch.testing.assert_close(steps[rows][key].double(), expected, rtol=1e-6, atol=1e-5)


def test_a_vehicle_is_lost_beyond_the_margin_of_its_own_region() -> None:
    """Due north from the northern edge: with 1 degree of margin, lost between 100 and 150 km."""
    scenario = planet_scenario(3, seed=2, margin_deg=1.0)
    (edges, longitude), index = (scenario.region.latitude, scenario.region.longitude.mean(1)), torch.tensor([2, 0, 1])
    start = torch.stack((edges[:, 1], longitude), -1)[index]
    target = torch.stack((edges.mean(1), longitude), -1)[index]
    env = make(3, scenario.with_trips(Trips(start, target, index)), start_heading="north")
    td, lost = env.reset(), []
    for _ in range(3):
        step = env.step(td.set("action", torch.tensor([50.0, 0.0]).expand(3, 2)))["next"]
        lost.append(step["terminated"].flatten().tolist())
        td = step.exclude("reward")
    assert lost == [[False] * 3, [False] * 3, [True] * 3]
    assert not step["success"].any()


def test_floors_are_those_of_each_region() -> None:
    """25 km of the mean gradient there, as a scenario of that region alone gives it."""
    scenario, gauss = planets(), random_planets(COUNT // 2, 1)
    env = make(32)
    for k in (0, 5):
        alone = single(scenario, k, gauss[k // 2])
        (expected,) = alone.floors(alone.build_field())
        assert env.objective_floors[k].tolist() == pytest.approx(expected.tolist(), rel=1e-6)
    first = env.reset()
    change = (first["target_field"] - first["field"]).double().abs()
    floors = env.objective_floors[first["region"].squeeze(-1)]
    torch.testing.assert_close(first["objective_weights"].double(), change.maximum(floors) ** -2, rtol=1e-6, atol=0)
    assert (change < floors).any()
    given = make(2, scenario.replace(objective_floors=(1.0, 2.0, 3.0))).objective_floors
    assert given.tolist() == [[1.0, 2.0, 3.0]] * COUNT


def checked(scenario: Scenario, exact: Callable[[int], Any], low: float, max_latitude: float) -> Tensor:
    """Check the conditions of each region against the exact field, finely; return their middles."""
    edge = scenario.reachable()
    for k in range(len(scenario.region)):
        box = scenario.region[k]
        assert max(map(abs, box.latitude)) <= max_latitude + 1e-9
        assert elements_at(exact(k), Regions.of(box).grid(41))[..., 2].min() > 0.99 * low  # tried on a coarser grid
        declination = elements_at(exact(k), Regions.of(edge[k]).grid(41))[..., 0]
        assert declination.amax() - declination.amin() < 200  # with a jump, or a pole inside, it is almost 360
    return torch.stack((scenario.region.latitude.mean(1), scenario.region.longitude.mean(1)), -1)


@pytest.mark.parametrize(("low", "max_latitude"), [(15000.0, 70.0), (0.0, 75.0)])
def test_regions_of_planets_meet_their_conditions(low: float, max_latitude: float) -> None:
    """The declination is continuous even where the field may be weak."""
    options = {"min_intensity_nt": low, "max_latitude": max_latitude, "tolerance_nt": 10.0}
    scenario, gauss = planet_scenario(8, seed=7, **options), random_planets(4, 7)
    middle = checked(scenario, lambda k: SphericalHarmonicField(gauss[k // 2]), low, max_latitude)
    assert middle[:, 0].std() > 20
    width = (scenario.region.longitude.diff(dim=1).squeeze(-1) / 2) * torch.cos(torch.deg2rad(middle[:, 0]))
    torch.testing.assert_close(width, torch.full_like(width, 10.0))


def test_regions_of_planets_are_those_of_the_seed() -> None:
    same, other = (planet_scenario(COUNT, seed) for seed in (1, 2))
    assert torch.equal(same.region.latitude, planets().region.latitude)
    assert torch.equal(same.field.coefficients, planets().field.coefficients)
    assert not torch.equal(other.region.latitude, planets().region.latitude)


def test_regions_of_the_earth() -> None:
    """IGRF-14 at the date; and the regions leave out the places of weak horizontal field, as south of Australia."""
    scenario = earth_scenario(20, seed=0, date="2015-07-01", max_latitude=70.0)
    igrf = IGRF("2015-07-01", 14)
    middle = checked(scenario, lambda _: igrf, 8000.0, 70.0)
    exact = igrf(*middle.unbind(-1))
    torch.testing.assert_close(scenario.field(*middle.unbind(-1), torch.arange(20)), exact, rtol=0, atol=1e-3)
    assert (str(scenario.date.date()), scenario.generation) == ("2015-07-01", 14)


@pytest.mark.parametrize(
    "options",
    [
        {"half_size_deg": 30.0},
        {"tolerance_nt": 1e-6},
        pytest.param({"crust": True, "max_leg_km": 500.0}, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_the_degree_of_the_expansions_follows_from_the_tolerance(options: dict) -> None:
    bank = earth_scenario(1, 0, **options).field
    assert bank.degree > (52 if "crust" in options else earth_scenario(1, 0).field.degree) >= 12
    assert bank.error_nt <= options.get("tolerance_nt", 0.1)


def test_specs_match_the_data() -> None:
    check_env_specs(make(7), break_when_any_done="both")


BAD: list[tuple[Callable[[], object], str]] = [
    (lambda: planet_scenario(2, 0, degree=5), "misses the field by"),
    (lambda: planet_scenario(2, 0, distance_range_km=(4e3, 5e3)), "(4000.0, 5000.0): no two points of"),
    (lambda: Scenario(region=planets().region), "region holds 6 boxes, and field 1 expansions"),
    (lambda: Scenario(field=planets().field), "region holds 1 boxes, and field 6 expansions"),
    (lambda: planets().with_trips(Trips(*planets().random_trips(9, seed=0)[:2])), "lies outside Region("),
    (lambda: make(2, max_leg_km=900.0), "the field is not defined on all of Region("),
]


@pytest.mark.parametrize(("call", "says"), BAD, ids=[says for _, says in BAD])
def test_what_regions_and_field_do_not_hold_is_refused(call: Callable[[], object], says: str) -> None:
    with pytest.raises(ValueError, match=re.escape(says)):
        call()
