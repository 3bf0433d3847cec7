"""Regions, the counter-based generator, and the tasks drawn with it."""

import hashlib
import math

import pytest
import torch
from geographiclib.geodesic import Geodesic

from magrl import paper
from magrl.counters import counter_uniform
from magrl.envs import PAPER_REGION, TASK_SETS, Region, Tasks, named_tasks, task_set
from magrl.envs import tasks as tasks_module
from magrl.envs.task_checks import check_tasks, without_way
from magrl.envs.tasks import sample_tasks
from magrl.geodesy import geodesic, wrap_longitude

ANTIMERIDIAN = Region((-5, 5), (170, 190))
ARCTIC = Region((80, 90), (-180, 180))
WORLD = Region((-90, 90), (-180, 180))


def f64(*values):
    return torch.tensor(values, dtype=torch.float64)


def distances(tasks):
    return geodesic(*tasks.start.unbind(-1), *tasks.target.unbind(-1))[0]


def draw(count, region=PAPER_REGION, distance_range_km=paper.DISTANCE_KM, *, seed=0, episode=0):
    vehicle = torch.arange(count)
    return sample_tasks(region, distance_range_km, seed, vehicle, torch.full_like(vehicle, episode))


# --- regions ----------------------------------------------------------------------------------------------------------


CONTAINED = [
    (PAPER_REGION, (-5.0, 165.0), True),
    (PAPER_REGION, (-10.0, 160.0), True),
    (PAPER_REGION, (0.0, 170.0), True),
    (PAPER_REGION, (-5.0, 165.0 - 720), True),
    (PAPER_REGION, (0.001, 165.0), False),
    (PAPER_REGION, (-10.001, 165.0), False),
    (PAPER_REGION, (-5.0, 159.999), False),
    (PAPER_REGION, (-5.0, 170.001), False),
    (PAPER_REGION, (-5.0, -15.0), False),
    (PAPER_REGION, (math.nan, 165.0), False),
    (PAPER_REGION, (-5.0, math.nan), False),
    (ANTIMERIDIAN, (0.0, 180.0), True),
    (ANTIMERIDIAN, (0.0, -180.0), True),
    (ANTIMERIDIAN, (0.0, 170.0), True),
    (ANTIMERIDIAN, (0.0, -170.0), True),
    (ANTIMERIDIAN, (0.0, 190.0), True),
    (ANTIMERIDIAN, (0.0, -169.9), False),
    (ANTIMERIDIAN, (0.0, 169.9), False),
    (ANTIMERIDIAN, (0.0, 0.0), False),
    (ARCTIC, (90.0, 123.0), True),
    (ARCTIC, (80.0, -180.0), True),
    (ARCTIC, (80.0, 180.0), True),
    (ARCTIC, (79.9, 0.0), False),
    (WORLD, (-90.0, 1234.5), True),
]


def test_contains():
    found = [region.contains(f64(*position)).tolist() for region, position, _ in CONTAINED]
    assert found == [[held] for *_, held in CONTAINED]


def test_contains_keeps_the_batch():
    for dtype in (torch.float32, torch.float64):
        for shape in ((), (3,), (2, 3), (0,)):
            found = PAPER_REGION.contains(torch.tensor([-5.0, 165.0], dtype=dtype).expand(*shape, 2))
            assert found.shape == (*shape, 1)
            assert found.dtype == torch.bool
            assert found.all()


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


def test_edges_belong_to_the_region_however_they_round():
    missed = []
    for region in decimal_boxes(200, 1):
        corners = torch.cartesian_prod(f64(*region.latitude), f64(*region.longitude))
        if not region.contains(corners).all():
            missed.append(region)
    assert not missed


def test_unwrapped():
    position, expected = f64((0.0, 171.0), (1.0, -171.0), (2.0, 180.0)), f64((0.0, 171.0), (1.0, 189.0), (2.0, 180.0))
    moved = torch.stack([position + f64(0.0, 360.0 * turns) for turns in (-2, 0, 1)])
    torch.testing.assert_close(ANTIMERIDIAN.unwrapped(moved), expected.expand(3, 3, 2))
    assert ANTIMERIDIAN.unwrapped(moved.float().expand(4, 3, 3, 2)).shape == (4, 3, 3, 2)


def test_holding():
    inside, outside = f64((-5.0, 165.0)), f64(((-12.0, 165.0), (3.0, 150.0)), ((-5.0, 171.0), (1.0, 160.0)))
    assert PAPER_REGION.holding(inside) == PAPER_REGION
    assert PAPER_REGION.holding(outside) == Region((-12, 3), (150, 171))


def test_expanded():
    for region, margin, expected in (
        (PAPER_REGION, 0.0, PAPER_REGION),
        (PAPER_REGION, 5.0, Region((-15, 5), (155, 175))),
        (PAPER_REGION, 85.0, Region((-90, 85), (75, 255))),
        (ANTIMERIDIAN, 5.0, Region((-10, 10), (165, 195))),
        (ARCTIC, 5.0, Region((75, 90), (-180, 180))),
        (Region((-85, 60), (0, 340)), 20.0, Region((-90, 80), (-10, 350))),
        (WORLD, 10.0, WORLD),
    ):
        found = region.expanded(margin)
        assert found.latitude == pytest.approx(expected.latitude, abs=1e-9)
        assert found.longitude == pytest.approx(expected.longitude, abs=1e-9)


def test_a_margin_beyond_a_full_turn_gives_the_full_turn():
    for region in decimal_boxes(200, 2):
        west, east = region.expanded(200.0).longitude
        assert east - west == pytest.approx(360, abs=1e-9)
        assert (west + east) / 2 == pytest.approx(sum(region.longitude) / 2, abs=1e-9)


def test_impossible_regions_are_refused():
    for latitude, longitude, message in (
        ((0, -10), (160, 170), r"latitudes \(0, -10\)"),
        ((5, 5), (160, 170), r"latitudes \(5, 5\)"),
        ((-91, 0), (160, 170), r"latitudes \(-91, 0\)"),
        ((80, 90.5), (160, 170), r"latitudes \(80, 90.5\)"),
        ((math.nan, 0), (160, 170), "latitudes"),
        ((-10, 0), (170, 160), r"longitudes \(170, 160\)"),
        ((-10, 0), (170, -170), r"longitudes \(170, -170\).*\(170, 190\)"),
        ((-10, 0), (160, 160), r"longitudes \(160, 160\)"),
        ((-10, 0), (-180, 180.5), r"longitudes \(-180, 180.5\)"),
        ((-10, 0), (160, math.inf), "longitudes"),
    ):
        with pytest.raises(ValueError, match=message):
            Region(latitude, longitude)


def test_no_distance_exceeds_the_longest():
    """On a grid of each box; the bound is also reached, being that of two corners."""
    regions = [*decimal_boxes(30, 3), PAPER_REGION, Region((-45, 45), (0, 90))]
    points = torch.stack([region.grid(7).reshape(-1, 2) for region in regions])
    apart = geodesic(*points.unsqueeze(2).unbind(-1), *points.unsqueeze(1).unbind(-1))[0].amax((1, 2))
    assert apart.tolist() == pytest.approx([region.longest_km() for region in regions], rel=1e-9)


def test_a_large_region_holds_up_to_half_the_globe():
    for region in (WORLD, Region((-80, 80), (0, 10)), Region((-1, 1), (0, 181))):
        assert Geodesic.WGS84.Inverse(-90, 0, 90, 0)["s12"] / 1e3 < region.longest_km() < 20500


# --- counter_uniform --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=[0, 7, -1, 2**63 - 1], ids="seed {}".format)
def uniform(request):
    """100 000 numbers: 1000 vehicles, 20 episodes, 5 draws."""
    rows = torch.cartesian_prod(torch.arange(1000), torch.arange(20)).reshape(1000, 20, 2)
    return counter_uniform(request.param, rows, 5)


def test_uniform_numbers_fill_the_unit_interval(uniform):
    """Mean, variance and a hundred bins of 1e5 numbers, each within what chance allows once in ten thousand."""
    assert uniform.dtype == torch.float64
    assert uniform.shape == (1000, 20, 5)
    assert uniform.min() >= 0
    assert uniform.max() < 1
    count = uniform.numel()
    assert abs(float(uniform.mean()) - 1 / 2) < 4 * math.sqrt(1 / 12 / count)
    assert abs(float(uniform.var()) - 1 / 12) < 4 * math.sqrt(1 / 180 / count)
    bins = torch.histc(uniform, 100, 0, 1)
    chi2 = float(((bins - count / 100) ** 2 / (count / 100)).sum())
    assert abs(chi2 - 99) < 4 * math.sqrt(2 * 99)


def test_neighboring_streams_are_uncorrelated(uniform):
    for dimension, name in enumerate(("vehicles", "episodes", "draws")):
        size = uniform.shape[dimension]
        here, next_ = (uniform.narrow(dimension, start, size - 1).flatten() for start in (0, 1))
        correlation = float(torch.corrcoef(torch.stack((here, next_)))[0, 1])
        assert abs(correlation) < 4 / math.sqrt(len(here)), name


def test_neighboring_seeds_are_uncorrelated():
    rows = torch.arange(50_000).unsqueeze(-1)
    both = torch.stack([counter_uniform(seed, rows, 2).flatten() for seed in (1, 2)])
    assert abs(float(torch.corrcoef(both)[0, 1])) < 4 / math.sqrt(both.shape[1])
    assert (both[0] == both[1]).sum() == 0


def test_distinct_streams_and_draws_differ():
    rows = torch.cartesian_prod(torch.arange(-20, 20), torch.arange(-20, 20))
    assert len(counter_uniform(3, rows, 4).unique()) == 4 * len(rows)


def test_the_order_of_the_counters_matters():
    assert not torch.equal(counter_uniform(3, torch.tensor([1, 2]), 4), counter_uniform(3, torch.tensor([2, 1]), 4))


def test_numbers_depend_on_the_row_alone():
    rows = torch.randint(-(2**62), 2**62, (2, 3, 4, 2), generator=torch.Generator().manual_seed(4))
    together = counter_uniform(5, rows, 6)
    assert together.shape == (2, 3, 4, 6)
    flat = counter_uniform(5, rows.reshape(-1, 2).flip(0), 6).flip(0)
    assert torch.equal(together.reshape(-1, 6), flat)
    assert torch.equal(together[1, 2, 3], counter_uniform(5, rows[1, 2, 3], 6))
    assert torch.equal(together[..., :2], counter_uniform(5, rows, 2))


def test_a_seed_is_any_64_bit_pattern():
    rows = torch.arange(100).unsqueeze(-1)
    for seed, same in ((-1, 2**64 - 1), (-(2**63), 2**63)):
        assert torch.equal(counter_uniform(seed, rows, 2), counter_uniform(same, rows, 2))
        assert not torch.equal(counter_uniform(seed, rows, 2), counter_uniform(0, rows, 2))


def splitmix_finalizer(value):
    """The published mixing step, on Python integers."""
    value = ((value ^ (value >> 30)) * 0xBF58476D1CE4E5B9) % 2**64
    value = ((value ^ (value >> 27)) * 0x94D049BB133111EB) % 2**64
    return value ^ (value >> 31)


def test_the_generator_is_the_one_it_names():
    golden = 0x9E3779B97F4A7C15
    for seed, counter in ((0, 0), (1, 5), (-3, 12345), (2**63, -1)):
        key = splitmix_finalizer(seed % 2**64)
        key = splitmix_finalizer(key ^ splitmix_finalizer((counter + golden) % 2**64))
        expected = [(splitmix_finalizer((key + k * golden) % 2**64) >> 11) / 2**53 for k in (1, 2, 3)]
        assert counter_uniform(seed, torch.tensor([counter]), 3).tolist() == expected


# --- sample_tasks -----------------------------------------------------------------------------------------------------

PLACES = {
    "paper": (PAPER_REGION, (300.0, 500.0)),
    "across the antimeridian": (ANTIMERIDIAN, (500.0, 1500.0)),
    "round the pole": (ARCTIC, (300.0, 900.0)),
    "high and wide": (Region((60, 85), (0, 80)), (1000.0, 2000.0)),
    "across most of the box": (PAPER_REGION, (900.0, 1300.0)),
}


FAR = {"half the globe away": (WORLD, (9000.0, 9010.0))}  # where a leg is kilometers off its geodesic


@pytest.mark.parametrize("place", PLACES | FAR)
def test_both_ends_lie_in_the_region_at_a_distance_in_the_range(place):
    region, (shortest, longest) = (PLACES | FAR)[place]
    tasks = draw(2000, region, (shortest, longest))
    assert tasks.start.shape == tasks.target.shape == (2000, 2)
    assert tasks.start.dtype == tasks.target.dtype == torch.float64
    assert region.contains(tasks.start).all()
    assert region.contains(tasks.target).all()
    ends = torch.cat((tasks.start, tasks.target), -1).tolist()
    apart_km = f64(*(Geodesic.WGS84.Inverse(*pair, Geodesic.DISTANCE)["s12"] / 1e3 for pair in ends))
    assert apart_km.min() > shortest - 1e-6
    assert apart_km.max() < longest + 1e-6
    check_tasks(tasks, region)


def rejection_sampled(region, distance_range_km, count, seed):
    """The definition, taken literally: uniform pairs over the region, kept if their distance is in the range."""
    generator = torch.Generator().manual_seed(seed)
    south, north = (math.sin(math.radians(x)) for x in region.latitude)
    west, east = region.longitude
    kept, have = [], 0
    while have < count:
        unit = torch.rand(2, 100_000, 2, generator=generator, dtype=torch.float64)
        latitude = torch.rad2deg(torch.asin(south + (north - south) * unit[..., 0]))
        pair = Tasks(*torch.stack((latitude, wrap_longitude(west + (east - west) * unit[..., 1])), -1))
        apart = distances(pair)
        sound = (apart >= distance_range_km[0]) & (apart <= distance_range_km[1])
        kept.append(torch.cat((pair.start[sound], pair.target[sound]), -1))
        have += int(sound.sum())
    rows = torch.cat(kept)[:count]
    return Tasks(rows[:, :2], rows[:, 2:])


def features(tasks, region, distance_range_km):
    """Numbers of each task whose means tell two distributions of pairs apart, ``(M, 12)``."""
    south, north = region.latitude
    half = (region.longitude[1] - region.longitude[0]) / 2
    columns = []
    for position in tasks:
        latitude = (position[:, 0] - south) / (north - south)
        longitude = wrap_longitude(position[:, 1] - region.longitude[0] - half) / half
        corner, middle = (latitude > 0.8) & (longitude > 0.6), ((latitude - 0.5).abs() < 0.15) & (longitude.abs() < 0.3)
        columns += [latitude, longitude, latitude**2, corner, middle]
    apart = (distances(tasks) - distance_range_km[0]) / (distance_range_km[1] - distance_range_km[0])
    return torch.stack([x.double() for x in (*columns, apart, apart**2)], -1)


@pytest.mark.parametrize("place", PLACES)
def test_tasks_are_distributed_as_rejection_sampled_pairs(place):
    count = 10_000
    drawn, expected = (
        features(tasks, *PLACES[place])
        for tasks in (draw(count, *PLACES[place], seed=11), rejection_sampled(*PLACES[place], count, 12))
    )
    standard_error = torch.sqrt((drawn.var(0) + expected.var(0)) / count)
    assert (standard_error > 0).all()
    assert ((drawn.mean(0) - expected.mean(0)) / standard_error).abs().max() < 4


def test_a_vehicle_s_tasks_do_not_depend_on_the_batch():
    vehicle, episode = torch.arange(200) % 50, torch.arange(200) // 50
    together = sample_tasks(PAPER_REGION, paper.DISTANCE_KM, 3, vehicle, episode)
    order = torch.randperm(200, generator=torch.Generator().manual_seed(5))
    shuffled = sample_tasks(PAPER_REGION, paper.DISTANCE_KM, 3, vehicle[order], episode[order])
    some = slice(20, 27)
    few = sample_tasks(PAPER_REGION, paper.DISTANCE_KM, 3, vehicle[some], episode[some])
    for all_, other, part in zip(together, shuffled, few, strict=True):
        torch.testing.assert_close(other, all_[order], rtol=0, atol=1e-11)
        torch.testing.assert_close(part, all_[some], rtol=0, atol=1e-11)


def test_seeds_and_episodes_draw_other_tasks():
    tasks = draw(100)
    for change in ({"seed": 1}, {"seed": -1}, {"episode": 1}):
        others = draw(100, **change)
        assert (tasks.start != others.start).all()
        assert (tasks.target != others.target).all()


def test_vehicles_draw_different_tasks():
    tasks = draw(1000)
    assert len(tasks.start.unique(dim=0)) == len(tasks.target.unique(dim=0)) == 1000


def test_no_vehicles_draw_no_tasks():
    assert [x.shape for x in draw(0)] == [(0, 2), (0, 2)]


def test_invalid_distance_ranges_are_refused():
    for distance_range_km in ((500, 300), (300, 300), (-1, 300), (0, math.inf), (math.nan, 300), (300, math.nan)):
        with pytest.raises(ValueError, match="distance_range_km") as error:
            draw(1, distance_range_km=distance_range_km)
        assert str(distance_range_km) in str(error.value)


def test_a_range_that_the_region_cannot_hold_is_refused():
    """The paper's box measures 1565 km from corner to corner."""
    with pytest.raises(ValueError, match=r"\(1600, 1700\).*160.*170.*more than 1565 km"):
        draw(1, distance_range_km=(1600, 1700))


def test_a_range_that_the_region_all_but_cannot_hold_ends_in_an_error(monkeypatch):
    monkeypatch.setattr(tasks_module, "MAX_ROUNDS", 3)
    with pytest.raises(RuntimeError, match=r"24 tries.*\(1565\.0, 1566\.0\)"):
        draw(4, distance_range_km=(1565.0, 1566.0))


def test_a_range_may_reach_beyond_the_region():
    """A degree square holds up to 157 km: whatever lies beyond must neither fail nor change the tasks' distribution."""
    region = Region((0, 1), (0, 1))
    expected = distances(rejection_sampled(region, (10.0, 200.0), 20_000, 6))
    standard_error = float(expected.std()) / math.sqrt(500)
    for longest in (200.0, 2000.0, 20000.0):
        tasks = draw(500, region, (10.0, longest))
        assert region.contains(tasks.target).all()
        assert abs(float(distances(tasks).mean() - expected.mean())) < 4 * standard_error


# --- frozen sets ------------------------------------------------------------------------------------------------------


def test_a_task_set_is_the_first_episodes_of_its_vehicles():
    for found, expected in zip(task_set(50, seed=9), draw(50, seed=9), strict=True):
        assert torch.equal(found, expected)


def test_a_longer_set_begins_with_the_shorter():
    for few, many in zip(task_set(10, seed=1), task_set(100, seed=1), strict=True):
        torch.testing.assert_close(few, many[:10], rtol=0, atol=1e-11)


FROZEN = {
    0: "1a627b469584a227b99a648c42461a8686124585f106559fb4d6a328806ef0ed",
    1: "0dde0f5f7c23765f8d0aeef69cba41935c345c03a73adca6dc3bead3f26c718a",
}


def test_task_sets_are_frozen():
    """Published results name a set by its seed: to a tenth of a meter, it must be the same for ever."""
    for seed, digest in FROZEN.items():
        rounded = torch.cat(task_set(100, seed=seed), -1).mul(1e6).round().to(torch.int64)
        assert hashlib.sha256(rounded.numpy().tobytes()).hexdigest() == digest, seed


def test_an_empty_set_is_refused():
    for num_tasks in (0, -3):
        with pytest.raises(ValueError, match=f"num_tasks.*{num_tasks}"):
            task_set(num_tasks, seed=0)


GOOD = [[-5.0, 165.0], [-2.0, 162.0]]


def test_sound_tasks_are_accepted_as_float64():
    target = [[-8.0, 164.0], [-10.0, 170.0]]
    for convert in (torch.tensor, lambda rows: f64(*rows), list):  # float32, float64, no tensors
        checked = check_tasks(Tasks(convert(GOOD), convert(target)), PAPER_REGION)
        assert isinstance(checked, Tasks)
        assert checked.start.dtype == checked.target.dtype == torch.float64
        assert torch.equal(checked.start, f64(*GOOD))
        assert torch.equal(checked.target, f64(*target))


def test_unsound_tasks_are_refused():
    for start, target, message in (
        (f64(-5.0, 165.0), f64(-5.0, 165.0), r"\(M, 2\).*\(2,\) and \(2,\)"),
        (f64(*GOOD), f64(*GOOD[:1]), r"\(M, 2\).*\(2, 2\) and \(1, 2\)"),
        (torch.zeros(2, 3), torch.zeros(2, 3), r"\(2, 3\)"),
        (torch.zeros(1, 2, 2), torch.zeros(1, 2, 2), r"\(1, 2, 2\)"),
        (torch.zeros(0, 2), torch.zeros(0, 2), r"M >= 1.*\(0, 2\)"),
        (f64(GOOD[0], [math.nan, 165.0]), f64(*GOOD), "latitude nan"),
        (f64(*GOOD), f64(GOOD[0], [-5.0, math.nan]), "longitude nan"),
        (f64(GOOD[0], [95.0, 165.0]), f64(*GOOD), "latitude 95"),
        (f64(GOOD[0], [1.0, 165.0]), f64(*GOOD), r"start of task 1 .*, \[1.0, 165.0\], lies outside Region"),
        (f64(*GOOD), f64([-5.0, 150.0], GOOD[1]), r"target of task 0 .*, \[-5.0, 150.0\], lies outside Region"),
        (f64(*GOOD), f64([-8.0, 164.0], GOOD[1]), r"task 1 .* starts at its destination, \[-2.0, 162.0\]: move"),
        (f64(*GOOD), f64([-8.0, 164.0], [-2.000008, 522.0]), r"task 1 .* starts at its destination"),  # 0.9 m away
    ):
        with pytest.raises(ValueError, match=message):
            check_tasks(Tasks(start, target), PAPER_REGION)


def test_a_task_of_more_than_a_meter_is_one():
    """1.1 m to the south; and a start at another turn of the same longitude is the same place."""
    check_tasks(Tasks(f64([-5.0, 165.0]), f64([-5.00001, 165.0])), PAPER_REGION)
    start, target = f64([-5.0, 165.0], [-5.0, 165.0]), f64([-5.00001, 165.0], [-5.0, -195.0])
    assert without_way(start, target).tolist() == [False, True]


NAMED_SETS = {
    "test-1000": (1000, "10423570ca1ee8a2"),
    "paper-100": (100, "ba5ab14cd5080e8c"),
    "figure-4-1": (1, "f43a0a947f5097e1"),
}


def test_named_task_sets_are_frozen() -> None:
    """Rounded to a centimeter, so that the last bits of a platform's sine do not matter."""
    assert set(TASK_SETS) == NAMED_SETS.keys()
    for name, (count, digest) in NAMED_SETS.items():
        tasks = named_tasks(name)
        assert tasks.start.shape == tasks.target.shape == (count, 2)
        rounded = (torch.cat(tasks) * 1e7).round().long().numpy()
        assert hashlib.sha256(rounded.tobytes()).hexdigest()[:16] == digest, name


def test_an_unknown_task_set_is_refused() -> None:
    with pytest.raises(ValueError, match=r"'test-10'.*test-1000"):
        named_tasks("test-10")


def test_frozen_seeds_are_reserved() -> None:
    seeds = {paper.VALIDATION_SEED, paper.TEST_SEED, paper.SWEEP_SEED, paper.PAPER_SEED}
    assert len(seeds) == 4
    assert min(seeds) > paper.FIRST_RESERVED_SEED
