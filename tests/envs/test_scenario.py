"""Scenarios: their validation, their fields and floors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

from magrl import paper
from magrl.envs import GeomagneticNavEnv, Region, Scenario, Tasks, task_set
from magrl.field import IGRF, RegionalField, elements_at

AZORES = Region((36, 46), (-32, -22))
NAN, INF = math.nan, math.inf


def places(*positions: tuple[float, ...]) -> Tensor:
    return torch.tensor(positions, dtype=torch.float64)


def test_the_default_scenario_is_the_papers_to_the_bit() -> None:
    scenario = Scenario()
    assert (scenario.region[0].latitude, scenario.region[0].longitude) == (paper.LATITUDE, paper.LONGITUDE)
    assert (scenario.distance_range_km, scenario.generation) == (paper.DISTANCE_KM, paper.GENERATION)
    assert (str(scenario.date), scenario.altitude_km, scenario.margin_deg) == ("2022-01-01 00:00:00", 0.0, 5.0)
    assert (scenario.tasks, scenario.names, scenario.field) == (None, (), None)
    field = RegionalField(IGRF("2022-01-01", 13), (-15.5, 5.5), (154.5, 175.5))
    assert torch.equal(scenario.build_field().coefficients, field.coefficients)
    one, other = (GeomagneticNavEnv(*given, num_envs=3, seed=0).rollout(1) for given in ((), (scenario,)))
    for key in ("field", "position"):
        assert torch.equal(one[key], other[key])
    assert torch.equal(scenario.random_tasks(5, 1).target, task_set(5, 1).target)


def test_field_is_that_of_the_date_and_altitude() -> None:
    """Against IGRF itself, called with the altitude; ten kilometers up B_H is 0.46 to 0.50 % weaker there."""
    scenario = Scenario(region=AZORES, date="2026-07-01", generation=14, altitude_km=10.0)
    latitude, longitude = torch.tensor([40.0, 37.0]), torch.tensor([-30.0, -23.0])
    expected = IGRF("2026-07-01", 14)(latitude, longitude, 10.0)
    assert (scenario.build_field()(latitude, longitude) - expected).abs().max() < 1e-5
    place = torch.stack((latitude, longitude), -1).double()
    ground = scenario.replace(altitude_km=0.0)
    weaker = 1 - elements_at(scenario.build_field(), place)[:, 2] / elements_at(ground.build_field(), place)[:, 2]
    assert ((weaker > 0.0046) & (weaker < 0.0050)).all()


def test_floors_are_25_km_of_travel_there() -> None:
    """B_H changes by 445 nT in 100 km round the Azores, and by 52 in the paper's region, whose floor is 15 nT."""
    scenario = Scenario(region=AZORES, date="2026-07-01", generation=14, objective_floors=None)
    floors = scenario.floors(scenario.build_field())
    assert floors[0].tolist() == pytest.approx((0.113, 0.268, 110.4), rel=1e-3)
    env = GeomagneticNavEnv(scenario, seed=0)
    assert torch.equal(env.objective_floors, floors)
    assert Scenario().floors(Scenario().build_field()).tolist() == [[0.05, 0.4, 15.0]]
    followed = Scenario(objective_floors=None)
    assert followed.floors(followed.build_field())[0].tolist() == pytest.approx((0.05, 0.4, 15.0), rel=0.5)


def test_floors_take_a_field_that_cannot_be_hashed() -> None:
    """A frozen class has a hash, but not where its values have none."""

    @dataclass(frozen=True)
    class Field:
        values: list[RegionalField]

        def __getattr__(self, name: str) -> object:
            return getattr(self.values[0], name)

    field = Scenario().build_field()
    scenario = Scenario(objective_floors=None)
    assert torch.equal(scenario.floors(Field([field])), scenario.floors(field))


def test_replace_checks_anew_and_changes_nothing_else() -> None:
    values = {"region": AZORES, "date": "2026-07-01", "generation": 14, "altitude_km": 2.0, "margin_deg": 3.0}
    scenario = Scenario(**values, distance_range_km=(200.0, 400.0), objective_floors=None)
    tasks = scenario.random_tasks(3, seed=0)
    framed = scenario.with_tasks(tasks)
    assert torch.equal(framed.tasks.start, tasks.start)
    assert framed.with_tasks(None) == scenario
    assert framed.replace(altitude_km=5).altitude_km == 5
    assert scenario.replace(altitude_km=-11).altitude_km == -11
    with pytest.raises(ValueError, match="lies outside"):
        Scenario().with_tasks(tasks)
    with pytest.raises(ValueError, match="frozen"):
        scenario.altitude_km = 5.0


POLAR: dict[str, tuple[dict[str, Any], str, dict[str, Any]]] = {
    "a margin that ends at the pole": (
        {"region": Region((75, 85), (0, 20))},
        "vehicles reach a pole in Region(latitude=(69.5, 90.0), longitude=(-170.0, 190.0)), where the declination "
        "takes every value: reduce margin_deg or the region, or move it toward the equator",
        {"margin_deg": 4.0},
    ),
    "both kinds of poles, with whatever margin": (
        {"region": Region((75, 85), (120, 140))},
        "takes every value: reduce margin_deg or the region, or move it",
        {"region": Region((69, 79), (120, 140))},
    ),
    "the magnetic pole": (
        {"region": Region((72, 82), (120, 140))},
        "region.latitude, region.longitude: the declination turns through south in Region(latitude=(66.5, 87.5)",
        {"margin_deg": 2.0},
    ),
}


@pytest.mark.parametrize("name", POLAR)
def test_a_region_near_a_pole_is_refused_with_a_remedy_that_works(name: str) -> None:
    values, says, remedy = POLAR[name]
    scenario = Scenario(**values, date="2026-07-01", generation=14)
    for build in (scenario.build_field, lambda: GeomagneticNavEnv(scenario, seed=0)):
        with pytest.raises(ValueError, match=r"^region\.latitude") as error:
            build()
        assert says in str(error.value)
        assert "\n" not in str(error.value)
        assert len(str(error.value)) < 300
    env = GeomagneticNavEnv(scenario.replace(**remedy), num_envs=8, seed=0)
    after = env.rollout(5, break_when_any_done=False)["next"]
    assert after["field"].isfinite().all()
    assert env.field.error_nt < 1e-3


BAD_VALUES: list[tuple[str, object, str]] = [
    ("wings", 0.01, "unknown key 'wings': choose from region, distance_range_km, distance_law, date"),
    ("distance_range_km", (5000.0, 6000.0), "(5000.0, 6000.0): no two points of Region(latitude=(-10.0, 0.0)"),
    ("date", 2026.0, "2026-01-01T00:00:00 is outside IGRF-13, which is valid from 1900-01-01 to 2025-01-01"),
    ("tasks", torch.zeros(9, 4), "tasks must be Tasks(start, target), each (M, 2) latitude and longitude [deg], got"),
    ("names", ("a",), "names must hold one name for each of 0 tasks, got ('a',)"),
]


@pytest.mark.parametrize(("name", "value", "says"), BAD_VALUES)
def test_a_bad_value_is_named_with_its_field_and_the_remedy(name: str, value: object, says: str) -> None:
    with pytest.raises(ValueError, match=name) as error:
        Scenario(**{name: value})
    assert says in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 300


def test_what_was_given_stays_given() -> None:
    scenario = Scenario(zeta=0.01, max_steps=80).replace(margin_deg=4)
    assert [scenario.given(name) for name in ("zeta", "max_steps", "margin_deg", "max_move_km")] == [0.01, 80, 4, None]


def test_an_own_field_needs_no_date_of_igrf() -> None:
    def field(latitude: Tensor, longitude: Tensor) -> Tensor:
        return torch.stack((latitude, longitude, latitude), -1)

    scenario = Scenario(field=field, date=2500.5)
    assert scenario.build_field() is field


def test_a_destination_outside_needs_a_margin_that_the_error_gives() -> None:
    """Twelve degrees south of the region, and seven beyond the antimeridian from it."""
    tasks = Tasks(places((-5.0, 165.0), (-5.0, 165.0)), places((-21.7, 165.0), (-5.0, -179.0)))
    with pytest.raises(ValueError, match=r"lies outside .*: raise margin_deg from 5 to at least 12$"):
        Scenario(tasks=tasks)
    env = GeomagneticNavEnv(Scenario(tasks=tasks, margin_deg=12), num_envs=2, seed=0)
    assert env.edge.contains(env.reset()["target_position"]).all()
    with pytest.raises(ValueError, match=r"to at least 11$"):
        Scenario(tasks=Tasks(tasks.start[1:], tasks.target[1:]))
