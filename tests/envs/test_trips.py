"""Trips: random ones in one box and in several, and frozen sets."""

import math

import pytest
import torch
from geographiclib.geodesic import Geodesic
from support.tracks import f64

from magrl import paper
from magrl.envs import PAPER_REGION, Region, Regions, Trips, named_trips, trip_set
from magrl.envs import trips as trips_module
from magrl.envs.trips import check_trips, sample_trips
from magrl.geodesy import geodesic, wrap_longitude

ANTIMERIDIAN = Region((-5, 5), (170, 190))
ARCTIC = Region((80, 90), (-180, 180))
WORLD = Region((-90, 90), (-180, 180))


def distances(trips):
    return geodesic(*trips.start.unbind(-1), *trips.target.unbind(-1))[0]


def draw(count, region=PAPER_REGION, distance_range_km=paper.DISTANCE_KM, *, seed=0, episode=0):
    vehicle = torch.arange(count)
    return sample_trips(Regions.of(region), distance_range_km, seed, vehicle, torch.full_like(vehicle, episode))


# --- sample_trips -----------------------------------------------------------------------------------------------------

PLACES = {
    "paper": (PAPER_REGION, (300.0, 500.0)),
    "across the antimeridian": (ANTIMERIDIAN, (500.0, 1500.0)),
    "round the pole": (ARCTIC, (300.0, 900.0)),
    "high and wide": (Region((60, 85), (0, 80)), (1000.0, 2000.0)),
    "across most of the box": (PAPER_REGION, (900.0, 1300.0)),
    "beyond a box of 157 km": (Region((0, 1), (0, 1)), (10.0, 2000.0)),
}


FAR = {"half the globe away": (WORLD, (9000.0, 9010.0))}  # where a leg is kilometers off its geodesic
CORNERS = pytest.param(PAPER_REGION, (1410.0, 1450.0), marks=pytest.mark.slow)  # of 1565 km


@pytest.mark.parametrize(("region", "distance_range_km"), [*(PLACES | FAR).values(), CORNERS])
def test_both_ends_lie_in_the_region_at_a_distance_in_the_range(region, distance_range_km):
    trips = draw(100, region, distance_range_km)
    assert trips.start.dtype == trips.target.dtype == torch.float64
    assert Regions.of(region).contains(torch.stack(trips[:2])).all()
    ends = torch.cat((trips.start, trips.target), -1).tolist()
    apart_km = f64(*(Geodesic.WGS84.Inverse(*pair, Geodesic.DISTANCE)["s12"] / 1e3 for pair in ends))
    assert apart_km.min() > distance_range_km[0] - 1e-6
    assert apart_km.max() < distance_range_km[1] + 1e-6


def rejection_sampled(region, distance_range_km, count, seed):
    """The definition, taken literally: uniform pairs over the region, kept if their distance is in the range."""
    generator = torch.Generator().manual_seed(seed)
    south, north = (math.sin(math.radians(x)) for x in region.latitude)
    west, east = region.longitude
    kept, have = [], 0
    while have < count:
        unit = torch.rand(2, 100_000, 2, generator=generator, dtype=torch.float64)
        latitude = torch.rad2deg(torch.asin(south + (north - south) * unit[..., 0]))
        pair = Trips(*torch.stack((latitude, wrap_longitude(west + (east - west) * unit[..., 1])), -1))
        apart = distances(pair)
        sound = (apart >= distance_range_km[0]) & (apart <= distance_range_km[1])
        kept.append(torch.cat((pair.start[sound], pair.target[sound]), -1))
        have += int(sound.sum())
    rows = torch.cat(kept)[:count]
    return Trips(rows[:, :2], rows[:, 2:])


def features(trips, region, distance_range_km):
    """Numbers of each trip whose means tell two distributions of pairs apart, ``(M, 12)``."""
    south, north = region.latitude
    half = (region.longitude[1] - region.longitude[0]) / 2
    columns = []
    for position in trips[:2]:
        latitude = (position[:, 0] - south) / (north - south)
        longitude = wrap_longitude(position[:, 1] - region.longitude[0] - half) / half
        corner, middle = (latitude > 0.8) & (longitude > 0.6), ((latitude - 0.5).abs() < 0.15) & (longitude.abs() < 0.3)
        columns += [latitude, longitude, latitude**2, corner, middle]
    apart = (distances(trips) - distance_range_km[0]) / (distance_range_km[1] - distance_range_km[0])
    return torch.stack([x.double() for x in (*columns, apart, apart**2)], -1)


@pytest.mark.parametrize("place", PLACES)
def test_trips_are_distributed_as_rejection_sampled_pairs(place):
    count = 5_000
    drawn, expected = (
        features(trips, *PLACES[place])
        for trips in (draw(count, *PLACES[place], seed=11), rejection_sampled(*PLACES[place], count, 12))
    )
    standard_error = torch.sqrt((drawn.var(0) + expected.var(0)) / count)
    assert (standard_error > 0).all()
    assert ((drawn.mean(0) - expected.mean(0)) / standard_error).abs().max() < 4


# --- frozen sets ------------------------------------------------------------------------------------------------------


def test_several_regions_draw_the_trips_of_each_alone():
    """As sample_trips draws them in that region alone; each region is drawn about equally often."""
    boxes = [PAPER_REGION, Region((40, 60), (170, 200)), ARCTIC, Region((-55, -45), (-70, -50))]
    vehicle, episode = torch.arange(4000), torch.arange(4000) % 3
    trips = sample_trips(Regions.of(boxes), (300, 500), 5, vehicle, episode)
    assert trips.region.dtype == torch.int64
    assert (trips.region.bincount(minlength=4) - 1000).abs().max() < 4 * math.sqrt(750)
    for k, box in enumerate(boxes):
        rows = trips.region == k
        alone = sample_trips(Regions.of(box), (300, 500), 5, vehicle[rows], episode[rows])
        assert (alone.region == 0).all()
        assert trips.start[rows, 0].std() > 0.2 * (box.latitude[1] - box.latitude[0])
        for found, expected in zip(trips[:2], alone[:2], strict=True):
            torch.testing.assert_close(found[rows], expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("law", ["area", "log"])
def test_a_trip_is_a_function_of_seed_vehicle_and_episode(law):
    regions = Regions.of([PAPER_REGION, Region((40, 60), (170, 200))])
    vehicle, episode = torch.arange(500), torch.arange(500) % 3
    together = sample_trips(regions, (200, 900), 3, vehicle, episode, law)
    order = torch.randperm(500, generator=torch.Generator().manual_seed(0))[:77]
    few = sample_trips(regions, (200, 900), 3, vehicle[order], episode[order], law)
    for found, expected in zip(few, together, strict=True):
        torch.testing.assert_close(found, expected[order], rtol=0, atol=1e-11)
    for seed, later in ((4, episode), (3, episode + 3)):
        other = sample_trips(regions, (200, 900), seed, vehicle, later, law)
        assert (other.start != together.start).all()
    assert len(together.start.unique(dim=0)) == 500
    assert [len(column) for column in sample_trips(regions, (200, 900), 3, vehicle[:0], episode[:0], law)] == [0] * 3


def test_a_large_batch_is_drawn_in_chunks_of_the_same_trips(monkeypatch):
    """The time of a reset is linear in the number of vehicles: no array grows with it."""
    vehicle = torch.arange(20)
    whole = sample_trips(Regions.of(PAPER_REGION), (300, 500), 0, vehicle, vehicle)
    sizes, candidates = [], trips_module._candidates
    monkeypatch.setattr(trips_module, "CHUNK", 8)
    monkeypatch.setattr(trips_module, "_candidates", lambda *args: sizes.append(len(args[1])) or candidates(*args))
    parts = sample_trips(Regions.of(PAPER_REGION), (300, 500), 0, vehicle, vehicle)
    for one, other in zip(whole, parts, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-12)
    assert max(sizes) == 8


def test_log_uniform_distances():
    """Kolmogorov-Smirnov at 1 %; ends uniform over the ring would have three quarters of them beyond 600 km."""
    regions, vehicle = Regions.of([Region((40, 60), (170, 200)), Region((-55, -40), (-70, -50))]), torch.arange(4000)
    trips = sample_trips(regions, (100, 1200), 7, vehicle, vehicle % 3, "log")
    apart = distances(trips)
    assert apart.min() > 99.999
    assert apart.max() < 1200.03
    steps = torch.linspace(0, 1, 4001, dtype=torch.float64)
    share = (torch.log(apart / 100) / math.log(12)).sort().values
    assert torch.maximum((share - steps[:-1]).abs(), (share - steps[1:]).abs()).max() < 1.63 / math.sqrt(4000)
    ranks = torch.stack((trips.start[:, 0].argsort().argsort(), apart.argsort().argsort())).double()
    assert torch.corrcoef(ranks)[0, 1].abs() < 0.05
    assert regions.contains(torch.stack(trips[:2]), trips.region).all()


def test_checked_trips_are_wrapped_float64_in_region_0():
    start, target = torch.tensor([[-5.0, 165.0], [-2.0, 522.0]]), torch.tensor([[-8.0, 164.0], [-10.0, 170.0]])
    checked = check_trips(Trips(start, target), Regions.of(PAPER_REGION))
    assert checked.start.dtype == checked.target.dtype == torch.float64
    assert checked.start.tolist() == [[-5.0, 165.0], [-2.0, 162.0]]
    assert torch.equal(checked.target, target.double())
    assert checked.region.tolist() == [0, 0]
    check_trips(Trips(f64([-5.0, 165.0]), f64([-5.00001, 165.0])), Regions.of(PAPER_REGION))  # 1.1 m


GOOD = f64([-5.0, 165.0], [-2.0, 162.0])
ZERO = torch.zeros(2, dtype=torch.int64)


def checked(start, target, region=None):
    return lambda: check_trips(Trips(start, target, region), Regions.of(PAPER_REGION))


def drawn(distance_range_km, law):
    return lambda: trip_set(1, 0, Regions.of([PAPER_REGION, Region((0, 1), (0, 1))]), distance_range_km, law)


MISTAKES = {
    r"trips.start must have the shape \(..., 2\)": checked(torch.zeros(2, 3), torch.zeros(2, 3)),
    r"\(M, 2\).*\(2, 2\) and \(1, 2\)": checked(GOOD, GOOD[:1]),
    "latitude 95": checked(GOOD, f64([-5.0, 165.0], [95.0, 165.0])),
    r"start of trip 1 .*, \[1.0, 165.0\], lies outside": checked(f64([-5.0, 165.0], [1.0, 165.0]), GOOD),
    "trip 1 .* starts at its destination": checked(GOOD, f64([-8.0, 164.0], [-2.000008, 522.0])),
    "nearly its antipode": lambda: check_trips(Trips(f64([30.0, 10.0]), f64([-29.9, -170.1])), Regions.of(WORLD)),
    r"trips.region 1 is not in \[0, 1\)": checked(GOOD, GOOD.flip(0), ZERO + 1),
    r"trips.region must hold 2 indices, one a trip, got \(1,\)": checked(GOOD, GOOD.flip(0), ZERO[:1]),
    r"no two points of Region\(latitude=\(0.0, 1.0\).* more than 157 km": drawn((200, 300), "area"),
    r"\(0, 300\) must be two rising numbers above 0 with distance_law 'log'": drawn((0, 300), "log"),
    "'test-1000'.*'test-10'": lambda: named_trips("test-10"),
}


@pytest.mark.parametrize("says", MISTAKES)
def test_mistakes(says):
    with pytest.raises(ValueError, match=says):
        MISTAKES[says]()


def test_a_range_that_the_region_all_but_cannot_hold_ends_in_an_error(monkeypatch):
    monkeypatch.setattr(trips_module, "MAX_ROUNDS", 3)
    with pytest.raises(RuntimeError, match=r"24 tries.*\(1565\.0, 1566\.0\)"):
        draw(4, distance_range_km=(1565.0, 1566.0))
