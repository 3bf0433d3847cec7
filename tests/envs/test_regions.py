"""Many regions: boxes by index, tasks in them, the environment over a bank, and scenarios of random regions."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import check_env_specs

from magrl.agents import FieldPolicy, PolicyConfig
from magrl.envs import (
    GeomagneticNavEnv,
    Region,
    Regions,
    RegionTasks,
    Scenario,
    Tasks,
    earth_scenario,
    planet_scenario,
    task_set,
)
from magrl.envs.random_regions import region_scenario
from magrl.envs.tasks import sample_tasks
from magrl.evaluation import episode_measures, evaluation_rollout
from magrl.evaluation.navigators import make_navigator
from magrl.field import IGRF, FieldBank, RegionalField, SphericalHarmonicField, elements_at, random_planets
from magrl.field.elements import measured_elements
from magrl.geodesy import geodesic

BOXES = [
    Region((-10, 0), (160, 170)),
    Region((40, 60), (170, 200)),
    Region((80, 90), (-180, 180)),
    Region((-55, -45), (-70, -50)),
]
REGIONS = Regions.of(BOXES)
COUNT = 6


@cache
def planets() -> Scenario:
    return planet_scenario(COUNT, seed=1)


def make(num_envs: int = 64, scenario: Scenario | None = None, **options: Any) -> GeomagneticNavEnv:
    return GeomagneticNavEnv(
        scenario or planets(), num_envs=num_envs, **{"seed": 0, "start_heading": "random"} | options
    )


def counters(count: int) -> tuple[Tensor, Tensor]:
    vehicle = torch.arange(count)
    return vehicle, vehicle % 3


def fly(env: GeomagneticNavEnv, steps: int = 30, seed: int = 0) -> TensorDictBase:
    """Transitions ``(T, N)`` of random moves over several episodes: who is done starts anew."""
    draws = torch.rand(steps, env.num_envs, 2, generator=torch.Generator().manual_seed(seed))
    td, found = env.reset(), []
    for draw in draws:
        action = env.action_low + (env.action_high - env.action_low) * draw
        step, td = env.step_and_maybe_reset(td.set("action", action.float()))
        found.append(step)
    return torch.stack(found)


def single(scenario: Scenario, index: int, gauss: Tensor, degree: int = 12) -> Scenario:
    """One region of a scenario, as a scenario of one region over its planet."""
    region = scenario.region[index]
    box = region.expanded(scenario.margin_deg).reachable(50)
    field = RegionalField(SphericalHarmonicField(gauss), box.latitude, box.longitude, degree=degree)
    return Scenario(region=region, field=field, objective_floors=scenario.objective_floors)


# --- boxes by index ---------------------------------------------------------------------------------------------------


def test_regions_are_their_boxes() -> None:
    """Each box does what a Region does: edges, margin, reach, longest distance, grid."""
    assert [REGIONS[k] for k in range(len(REGIONS))] == BOXES
    for change in (lambda box: box.expanded(3.3), lambda box: box.reachable(120.0)):
        assert [change(REGIONS)[k] for k in range(4)] == [change(box) for box in BOXES]
    assert REGIONS.longest_km.tolist() == pytest.approx([box.longest_km() for box in BOXES], rel=1e-12)
    torch.testing.assert_close(REGIONS.grid(7), torch.stack([box.grid(7) for box in BOXES]), rtol=0, atol=1e-13)


def test_each_position_is_in_the_box_of_its_index() -> None:
    generator = torch.Generator().manual_seed(0)
    index = torch.randint(4, (5000,), generator=generator)
    unit = torch.rand(5000, 2, generator=generator, dtype=torch.float64) * 1.4 - 0.2
    low, high = (torch.tensor([(box.latitude[k], box.longitude[k]) for box in BOXES])[index] for k in (0, 1))
    position = (low + (high - low) * unit).clamp(-90, 400)
    position[:, 1] -= 360 * torch.randint(-1, 2, (5000,), generator=generator)
    found = REGIONS.contains(position.clamp_max(90 * 9), index)
    expected = torch.stack([box.contains(position) for box in BOXES])[index, torch.arange(5000)]
    assert torch.equal(found, expected)
    assert 1000 < found.sum() < 4500
    assert REGIONS.contains(position.expand(2, -1, 2), index).shape == (2, 5000, 1)


# --- tasks ------------------------------------------------------------------------------------------------------------


def test_a_task_is_that_of_its_region() -> None:
    """As sample_tasks draws it in that region alone; each region is drawn about equally often."""
    vehicle, episode = counters(4000)
    tasks = sample_tasks(REGIONS, (300, 500), 5, vehicle, episode)
    assert tasks.region.dtype == torch.int64
    assert (tasks.region.bincount(minlength=4) - 1000).abs().max() < 4 * math.sqrt(750)
    for k, box in enumerate(BOXES):
        rows = tasks.region == k
        south, north = box.latitude
        assert tasks.start[rows, 0].std() > 0.2 * (north - south)  # the place does not follow from the region's draw
        alone = sample_tasks(box, (300, 500), 5, vehicle[rows], episode[rows])
        for found, expected in ((tasks.start[rows], alone.start), (tasks.target[rows], alone.target)):
            torch.testing.assert_close(found, expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("law", ["area", "log"])
def test_tasks_are_functions_of_seed_vehicle_and_episode(law: str) -> None:
    vehicle, episode = counters(500)
    together = sample_tasks(REGIONS, (200, 900), 3, vehicle, episode, law)
    order = torch.randperm(500, generator=torch.Generator().manual_seed(0))[:77]
    few = sample_tasks(REGIONS, (200, 900), 3, vehicle[order], episode[order], law)
    for found, expected in zip(few, together, strict=True):
        torch.testing.assert_close(found, expected[order], rtol=0, atol=1e-12)
    other = sample_tasks(REGIONS, (200, 900), 4, vehicle, episode, law)
    assert (other.region != together.region).double().mean() > 0.6


def test_log_uniform_distances_in_one_and_in_many_regions() -> None:
    """Kolmogorov-Smirnov at 1 %; ends uniform over the ring would have three quarters of them beyond 600 km."""
    vehicle, episode = counters(4000)
    for region in (REGIONS, BOXES[1]):
        tasks = sample_tasks(region, (100, 1200), 7, vehicle, episode, "log")
        distance, _ = geodesic(*tasks.start.unbind(-1), *tasks.target.unbind(-1))
        assert distance.min() > 99.999
        assert distance.max() < 1200.03
        steps = torch.linspace(0, 1, 4001, dtype=torch.float64)
        share = (torch.log(distance / 100) / math.log(12)).sort().values
        assert torch.maximum((share - steps[:-1]).abs(), (share - steps[1:]).abs()).max() < 1.63 / math.sqrt(4000)
        north = (tasks.start[:, 0].argsort().argsort() / 4000, distance.argsort().argsort() / 4000)
        assert torch.corrcoef(torch.stack(north))[0, 1].abs() < 0.05
        index = (tasks.region,) if isinstance(tasks, RegionTasks) else ()
        assert region.contains(torch.stack((tasks.start, tasks.target)), *index).all()


# --- the environment --------------------------------------------------------------------------------------------------


def test_specs_match_the_data() -> None:
    for num_envs in (1, 7):
        check_env_specs(make(num_envs), break_when_any_done="both")
    env = make(5)
    assert env.observation_spec["region"].shape == (5, 1)
    assert "region" in set(env.state_spec.keys())
    assert "region" not in set(GeomagneticNavEnv().observation_spec.keys())


def test_each_vehicle_measures_the_field_of_its_own_planet() -> None:
    env = make(96)
    steps = fly(env, 12)["next"]
    gauss = random_planets(COUNT // 2, 1)
    assert len(steps["region"].unique()) == COUNT
    for k in range(COUNT):
        rows = (steps["region"] == k).squeeze(-1)
        exact = SphericalHarmonicField(gauss[k // 2])
        for key, place in (("field", "position"), ("target_field", "target_position")):
            expected = measured_elements(exact(*steps[rows][place].unbind(-1)))
            torch.testing.assert_close(steps[rows][key].double(), expected, rtol=1e-6, atol=1e-5)


def test_a_bank_of_one_region_is_that_region() -> None:
    """The same tasks, rewards and ends of episodes as over one region with the same field."""
    gauss = random_planets(1, 4)
    many = region_scenario(gauss, torch.zeros(1, dtype=torch.int64), 4).replace(objective_floors=(0.05, 0.4, 15.0))
    a, b = fly(make(100, many, max_steps=20), 60), fly(make(100, single(many, 0, gauss[0]), max_steps=20), 60)
    assert a["next", "done"].sum() > 100
    assert torch.equal(a["next", "done"], b["next", "done"])
    for key in ("position", "target_position", "field", "objective", "reward", "heading"):
        torch.testing.assert_close(a["next", key], b["next", key], rtol=1e-4, atol=1e-4)
    assert set(a["next"].keys()) - set(b["next"].keys()) == {"region"}


def test_runs_repeat_to_the_bit_and_rows_are_independent() -> None:
    one, again = fly(make(40, max_steps=9)), fly(make(40, max_steps=9))
    for key in one.keys(True, True):
        assert torch.equal(one[key], again[key]), key
    env = make(40)
    first = env.reset()
    mask = torch.zeros(40, 1, dtype=torch.bool)
    mask[[3, 17]] = True
    second = env.reset(first.clone().set("_reset", mask))
    kept = ~mask.squeeze(-1)
    for key in ("region", "position", "field", "objective_weights"):
        assert torch.equal(first[key][kept], second[key][kept])
    whole = make(40)
    whole.reset()
    after = whole.reset()
    for key in ("region", "target_position", "field", "heading"):
        torch.testing.assert_close(second[key][~kept], after[key][~kept], rtol=0, atol=1e-9)


def test_a_vehicle_is_lost_beyond_the_margin_of_its_own_region() -> None:
    """Due north from the northern edge: with 1 degree of margin, lost between 100 and 150 km."""
    scenario = planet_scenario(3, seed=2, margin_deg=1.0)
    (edges, longitude), index = (scenario.region.latitude, scenario.region.longitude.mean(1)), torch.tensor([2, 0, 1])
    start = torch.stack((edges[:, 1], longitude), -1)[index]
    target = torch.stack((edges.mean(1), longitude), -1)[index]
    env = make(3, scenario.with_tasks(RegionTasks(start, target, index)), start_heading="north")
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
        expected = alone.floors(alone.build_field())
        assert env.objective_floors[k].tolist() == pytest.approx(expected.tolist(), rel=1e-6)
    first = env.reset()
    change = (first["target_field"] - first["field"]).double().abs()
    floors = env.objective_floors[first["region"].squeeze(-1)]
    torch.testing.assert_close(first["objective_weights"].double(), change.maximum(floors) ** -2, rtol=1e-6, atol=0)
    assert (change < floors).any()
    given = make(2, scenario.replace(objective_floors=(1.0, 2.0, 3.0))).objective_floors
    assert given.tolist() == [[1.0, 2.0, 3.0]] * COUNT


def test_frozen_tasks_are_flown_in_their_regions() -> None:
    tasks = planets().random_tasks(10, seed=3)
    env = make(4, planets().with_tasks(tasks))
    for episode in range(3):
        rows = (torch.arange(4) + 4 * episode) % 10
        first = env.reset()
        assert torch.equal(first["region"].squeeze(-1), tasks.region[rows])
        assert torch.equal(first["target_position"], tasks.target[rows])
    assert torch.equal(task_set(10, 3, planets().region, (300, 500)).start, tasks.start)


# --- random regions ---------------------------------------------------------------------------------------------------


def checked(scenario: Scenario, exact: Callable[[int], Any], low: float, max_latitude: float) -> Tensor:
    """Check the conditions of each region against the exact field, finely; return their middles."""
    edge = scenario.reachable(50)
    for k in range(len(scenario.region)):
        box = scenario.region[k]
        assert max(map(abs, box.latitude)) <= max_latitude + 1e-9
        assert elements_at(exact(k), box.grid(41))[..., 2].min() > 0.99 * low  # tried on a coarser grid
        declination = elements_at(exact(k), edge[k].grid(41))[..., 0]
        assert declination.amax() - declination.amin() < 200  # with a jump, or a pole inside, it is almost 360
    return torch.stack((scenario.region.latitude.mean(1), scenario.region.longitude.mean(1)), -1)


def test_regions_of_planets_meet_their_conditions() -> None:
    scenario = planet_scenario(24, seed=7, min_intensity_nt=15000.0, max_latitude=70.0)
    gauss = random_planets(12, 7)
    middle = checked(scenario, lambda k: SphericalHarmonicField(gauss[k // 2]), 15000.0, 70.0)
    assert middle[:, 0].max() > 20 > -20 > middle[:, 0].min()
    same, other = (planet_scenario(24, seed, min_intensity_nt=15000.0, max_latitude=70.0) for seed in (7, 8))
    assert torch.equal(same.region.latitude, scenario.region.latitude)
    assert torch.equal(same.field.coefficients, scenario.field.coefficients)
    assert not torch.equal(other.region.latitude, scenario.region.latitude)
    width = (scenario.region.longitude.diff(dim=1).squeeze(-1) / 2) * torch.cos(torch.deg2rad(middle[:, 0]))
    torch.testing.assert_close(width, torch.full_like(width, 10.0))


def test_declination_is_continuous_even_where_the_field_may_be_weak() -> None:
    scenario = planet_scenario(40, seed=1, min_intensity_nt=0.0, max_latitude=75.0, tolerance_nt=10.0)
    gauss = random_planets(20, 1)
    checked(scenario, lambda k: SphericalHarmonicField(gauss[k // 2]), 0.0, 75.0)


def test_regions_of_the_earth() -> None:
    """IGRF-14 at the date; and the regions leave out the places of weak horizontal field, as south of Australia."""
    scenario = earth_scenario(40, seed=0, date="2015-07-01", max_latitude=70.0)
    igrf = IGRF("2015-07-01", 14)
    middle = checked(scenario, lambda _: igrf, 8000.0, 70.0)
    exact = igrf(*middle.unbind(-1))
    torch.testing.assert_close(scenario.field(*middle.unbind(-1), torch.arange(40)), exact, rtol=0, atol=1e-3)
    assert (str(scenario.date.date()), scenario.generation) == ("2015-07-01", 14)


def test_larger_regions_hold_longer_distances() -> None:
    options = {"half_size_deg": 20, "degree": 16, "distance_range_km": (150, 1800), "distance_law": "log"}
    scenario = planet_scenario(4, seed=0, **options)
    env = make(200, scenario, max_steps=120)
    distance, _ = geodesic(*env.reset()["position"].unbind(-1), *env.reset()["target_position"].unbind(-1))
    assert torch.isfinite(fly(env, 20)["next", "field"]).all()
    tasks = scenario.random_tasks(500, 0)
    distance, _ = geodesic(*tasks.start.unbind(-1), *tasks.target.unbind(-1))
    assert 380 < distance.median() < 700


# --- bad input --------------------------------------------------------------------------------------------------------


def bank_of(boxes: Regions) -> FieldBank:
    return FieldBank.build(
        random_planets(1, 0), torch.zeros(len(boxes), dtype=torch.int64), boxes.latitude, boxes.longitude
    )


SMALL = Regions.of([Region((-5, 5), (0, 10)), Region((20, 21), (0, 1))])
INSIDE = torch.tensor([[0.0, 1.0]]).double(), torch.tensor([[0.0, 4.0]]).double()
ZERO = torch.zeros(1, dtype=torch.int64)
BAD: list[tuple[Callable[[], object], type[Exception], str]] = [
    (lambda: Regions.of([]), ValueError, "with K >= 1, got (0, 2) and (0, 2)"),
    (lambda: planet_scenario(0, 0), ValueError, "count must be a whole number from 1 on, got 0"),
    (lambda: earth_scenario(2, -1), ValueError, "seed must be a whole number from 0"),
    (lambda: earth_scenario(2, 0, "2055-01-01"), ValueError, "2055-01-01T00:00:00 is outside IGRF-14"),
    (
        lambda: planet_scenario(2, 0, half_size_deg=61),
        ValueError,
        "half_size_deg must be a finite number above 0 up to 60",
    ),
    (lambda: planet_scenario(2, 0, size=3), TypeError, "size"),
    (
        lambda: planet_scenario(2, 0, min_intensity_nt=1e6),
        ValueError,
        "no place was found in 100 tries for region 0 on planet 0",
    ),
    (lambda: planet_scenario(2, 0, degree=5), ValueError, "misses the field by"),
    (
        lambda: planet_scenario(2, 0, distance_range_km=(4000, 5000)),
        ValueError,
        "distance_range_km (4000.0, 5000.0): no two points of Region",
    ),
    (
        lambda: planet_scenario(2, 0, distance_range_km=(100, 5000), distance_law="log"),
        ValueError,
        "distance_range_km (100.0, 5000.0): no two points of Region",
    ),
    (lambda: planets().replace(distance_law="even"), ValueError, "distance_law must be 'area' or 'log', got 'even'"),
    (
        lambda: planets().replace(distance_range_km=(0, 500), distance_law="log"),
        ValueError,
        "distance_range_km (0.0, 500.0) must start above 0 with distance_law 'log'",
    ),
    (lambda: Scenario(region=SMALL, field=bank_of(SMALL)), ValueError, "no two points of Region(latitude=(20.0, 21.0)"),
    (lambda: Scenario(region=SMALL), ValueError, "region holds 2 boxes of Regions, and field no expansions"),
    (lambda: Scenario(field=planets().field), ValueError, "region holds no boxes of Regions, and field 6 expansions"),
    (
        lambda: planets().replace(field=bank_of(SMALL)),
        ValueError,
        "region holds 6 boxes of Regions, and field 2 expansions",
    ),
    (lambda: planets().with_tasks(Tasks(*INSIDE)), ValueError, "tasks over 6 regions must be RegionTasks"),
    (lambda: planets().with_tasks(RegionTasks(*INSIDE, ZERO + 6)), ValueError, "tasks.region 6 is not in [0, 6)"),
    (lambda: planets().with_tasks(RegionTasks(*INSIDE, ZERO.float())), TypeError, "tasks.region must be int64"),
    (lambda: planets().with_tasks(RegionTasks(*INSIDE, ZERO.repeat(2))), ValueError, "must hold 1 indices"),
    (lambda: planets().with_tasks(RegionTasks(*INSIDE, [0])), ValueError, "tasks.region must be an instance of Tensor"),
    (
        lambda: planets().with_tasks(planets().random_tasks(3, 0)._replace(region=ZERO.repeat(3))),
        ValueError,
        "lies outside Region(",
    ),
    (lambda: Scenario(tasks=RegionTasks(*INSIDE, ZERO)), ValueError, "tasks must be two (M, 2) tensors"),
    (lambda: make(2, max_move_km=900.0), ValueError, "the field is not defined on all of region 0 with its margin"),
    (lambda: make(2, render_mode="rgb_array"), ValueError, "draws one region, the scenario has 6: take None"),
    (lambda: make(2).observation_view(), ValueError, "this environment has 6"),
]


@pytest.mark.parametrize(("call", "kind", "says"), BAD, ids=[says for *_, says in BAD])
def test_bad_input_is_refused_with_value_and_remedy(
    call: Callable[[], object], kind: type[Exception], says: str
) -> None:
    with pytest.raises(kind) as error:
        call()
    assert says in str(error.value)


def test_a_policy_of_one_region_refuses_a_bank() -> None:
    view = GeomagneticNavEnv(seed=0).observation_view()
    with pytest.raises(ValueError, match="trained in one region, this field has 6"):
        view.check_covers(planets().field, REGIONS.grid(3))


def test_navigators_with_a_map_of_one_region_refuse_a_bank() -> None:
    env = make(2)
    trained = FieldPolicy(PolicyConfig(GeomagneticNavEnv(seed=0).observation_view(), (8,)))
    for navigate in (
        lambda: make_navigator("mean_jacobian", env),
        lambda: make_navigator("ga", env),
        lambda: trained.check_fits(env),
    ):
        with pytest.raises(ValueError, match=rf"one region.*{COUNT}"):
            navigate()


def test_navigators_fly_over_a_bank() -> None:
    env = make(64)
    for name, least in (("parallel", 0.9), ("geodesic", 1.0), ("secant", 0.9), ("kalman", 0.9)):
        measured = episode_measures(evaluation_rollout(env, make_navigator(name, env)))
        assert measured["success"].double().mean() >= least, name
        assert measured["spl"].mean() > 0.8, name
