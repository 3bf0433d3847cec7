"""Scenarios of random regions, and the environment over a bank of them."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import check_env_specs

from magrl.envs import (
    GeomagneticNavEnv,
    Region,
    Regions,
    Scenario,
    Tasks,
    earth_scenario,
    planet_scenario,
)
from magrl.field import IGRF, FieldBank, RegionalField, SphericalHarmonicField, elements_at, random_planets
from magrl.field.elements import measured_elements

COUNT = 6


@cache
def planets() -> Scenario:
    return planet_scenario(COUNT, seed=1)


def make(num_envs: int = 64, scenario: Scenario | None = None, **options: Any) -> GeomagneticNavEnv:
    return GeomagneticNavEnv(
        scenario or planets(), num_envs=num_envs, **{"seed": 0, "start_heading": "random"} | options
    )


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
    box = Regions.of(region).expanded(scenario.margin_deg).reachable(50)[0]
    field = RegionalField(SphericalHarmonicField(gauss), box.latitude, box.longitude, degree=degree)
    return Scenario(region=region, field=field, objective_floors=scenario.objective_floors)


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


def test_a_vehicle_is_lost_beyond_the_margin_of_its_own_region() -> None:
    """Due north from the northern edge: with 1 degree of margin, lost between 100 and 150 km."""
    scenario = planet_scenario(3, seed=2, margin_deg=1.0)
    (edges, longitude), index = (scenario.region.latitude, scenario.region.longitude.mean(1)), torch.tensor([2, 0, 1])
    start = torch.stack((edges[:, 1], longitude), -1)[index]
    target = torch.stack((edges.mean(1), longitude), -1)[index]
    env = make(3, scenario.with_tasks(Tasks(start, target, index)), start_heading="north")
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
    scenario = planet_scenario(20, seed=1, min_intensity_nt=0.0, max_latitude=75.0, tolerance_nt=10.0)
    gauss = random_planets(10, 1)
    checked(scenario, lambda k: SphericalHarmonicField(gauss[k // 2]), 0.0, 75.0)


def test_regions_of_the_earth() -> None:
    """IGRF-14 at the date; and the regions leave out the places of weak horizontal field, as south of Australia."""
    scenario = earth_scenario(40, seed=0, date="2015-07-01", max_latitude=70.0)
    igrf = IGRF("2015-07-01", 14)
    middle = checked(scenario, lambda _: igrf, 8000.0, 70.0)
    exact = igrf(*middle.unbind(-1))
    torch.testing.assert_close(scenario.field(*middle.unbind(-1), torch.arange(40)), exact, rtol=0, atol=1e-3)
    assert (str(scenario.date.date()), scenario.generation) == ("2015-07-01", 14)


@pytest.mark.parametrize(
    "options", [{"half_size_deg": 30.0}, {"tolerance_nt": 1e-6}, {"crust": True, "max_move_km": 500.0}], ids=str
)
def test_the_degree_of_the_expansions_follows_from_the_tolerance(options: dict) -> None:
    bank = earth_scenario(1, 0, **options).field
    assert bank.degree > (52 if "crust" in options else earth_scenario(1, 0).field.degree) >= 12
    assert bank.error_nt <= options.get("tolerance_nt", 0.1)


def test_specs_and_seeds() -> None:
    check_env_specs(make(7), break_when_any_done="both")
    one, again = fly(make(40, max_steps=9)), fly(make(40, max_steps=9))
    for key in one.keys(True, True):
        assert torch.equal(one[key], again[key]), key


def bank_of(*boxes: Region) -> dict[str, Any]:
    """Return several regions and a bank for them, as fields of a scenario."""
    regions, planet = Regions.of(boxes), torch.zeros(len(boxes), dtype=torch.int64)
    return {
        "region": regions,
        "field": FieldBank.build(random_planets(1, 0), planet, regions.latitude, regions.longitude),
    }


TINY = Region((20, 21), (0, 1))
BAD: list[tuple[Callable[[], object], str]] = [
    (lambda: planet_scenario(2, 0, degree=5), "misses the field by"),
    (lambda: planet_scenario(2, 0, distance_range_km=(4e3, 5e3)), "(4000.0, 5000.0): no two points of"),
    (lambda: Scenario(**bank_of(Region((-5, 5), (0, 10)), TINY)), "no two points of Region(latitude=(20.0"),
    (lambda: Scenario(region=planets().region), "region holds 6 boxes, and field 1 expansions"),
    (lambda: Scenario(field=planets().field), "region holds 1 boxes, and field 6 expansions"),
    (lambda: planets().with_tasks(Tasks(*planets().random_tasks(9, seed=0)[:2])), "lies outside Region("),
    (lambda: make(2, max_move_km=900.0), "the field is not defined on all of Region("),
]


@pytest.mark.parametrize(("call", "says"), BAD, ids=[says for _, says in BAD])
def test_what_regions_and_field_do_not_hold_is_refused(call: Callable[[], object], says: str) -> None:
    with pytest.raises(ValueError, match=re.escape(says)):
        call()
