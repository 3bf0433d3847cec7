"""Scenarios: their validation, their fields and floors, and the files that hold them."""

from __future__ import annotations

import datetime
import importlib.util
import json
import math
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

from magrl import paper
from magrl.agents import FieldPolicy, PolicyConfig
from magrl.envs import PAPER_REGION, GeomagneticNavEnv, Region, Scenario, Tasks, load_scenario, task_set
from magrl.envs.scenario_files import MAX_FILE_BYTES
from magrl.field import IGRF, RegionalField, elements_at
from magrl.geodesy import geodesic, move
from magrl.training import parse_config

ROOT = Path(__file__).parent.parent.parent
AZORES = Region((36, 46), (-32, -22))
HIGH_LATITUDE = Region((60.0, 70.0), (10.0, 30.0))
NAN, INF = math.nan, math.inf
TOML = """
date = 2026-07-01
generation = 14
altitude_km = 10.0
margin_deg = 4
distance_range_km = [200, 400]
objective_floors = [0.1, 0.3, 100]

[region]
latitude = [36, 46]
longitude = [-32, -22]

[[tasks]]
name = "Ponta Delgada to Flores"
start = [37.74, -25.67]
target = [39.45, -31.13]

[[tasks]]
start = [40, -30]
target = [42, 332]
"""


def sound() -> dict[str, Any]:
    """Return the content of the same file, as tables."""
    return {
        "region": {"latitude": [36, 46], "longitude": [-32, -22]},
        "date": "2026-07-01",
        "generation": 14,
        "altitude_km": 10.0,
        "margin_deg": 4,
        "distance_range_km": [200, 400],
        "objective_floors": [0.1, 0.3, 100],
        "tasks": [
            {"name": "Ponta Delgada to Flores", "start": [37.74, -25.67], "target": [39.45, -31.13]},
            {"start": [40, -30], "target": [42, 332]},
        ],
    }


def places(*positions: tuple[float, ...]) -> Tensor:
    return torch.tensor(positions, dtype=torch.float64)


# --- the model --------------------------------------------------------------------------------------------------------


def test_the_default_scenario_is_the_papers_to_the_bit() -> None:
    scenario = Scenario()
    assert (scenario.region.latitude, scenario.region.longitude) == (paper.LATITUDE, paper.LONGITUDE)
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


def test_random_episodes_lie_in_the_region_and_range() -> None:
    scenario = Scenario(region=AZORES, distance_range_km=(200, 400), date="2026-07-01", generation=14)
    tasks = scenario.random_tasks(50, 3)
    distance, _ = geodesic(*tasks.start.unbind(-1), *tasks.target.unbind(-1))
    assert ((distance >= 200) & (distance <= 400)).all()
    assert AZORES.contains(torch.stack(tasks)).all()
    env = GeomagneticNavEnv(scenario, num_envs=50, seed=3)
    first = env.reset()
    for key, expected in (("position", tasks.start), ("target_position", tasks.target)):
        assert torch.equal(first[key], expected)
    assert (env.scenario, env.region) == (scenario, AZORES)


def test_floors_are_25_km_of_travel_there() -> None:
    """B_H changes by 445 nT in 100 km round the Azores, and by 52 in the paper's region, whose floor is 15 nT."""
    scenario = Scenario(region=AZORES, date="2026-07-01", generation=14, objective_floors=None)
    floors = scenario.floors(scenario.build_field())
    assert floors.tolist() == pytest.approx((0.113, 0.268, 110.4), rel=1e-3)
    env = GeomagneticNavEnv(scenario, seed=0)
    assert torch.equal(env.objective_floors, floors)
    assert Scenario().floors(Scenario().build_field()).tolist() == [0.05, 0.4, 15.0]
    followed = Scenario(objective_floors=None)
    assert followed.floors(followed.build_field()).tolist() == pytest.approx((0.05, 0.4, 15.0), rel=0.5)


def test_a_date_may_be_given_in_every_form() -> None:
    noon = datetime.datetime(2026, 7, 1)
    for date in ("2026-07-01", datetime.date(2026, 7, 1), noon, "2026-07-01T00:00:00"):
        assert Scenario(date=date, generation=14).date == noon
    assert Scenario(date=2026, generation=14).date == datetime.datetime(2026, 1, 1)


def test_replace_checks_anew_and_changes_nothing_else() -> None:
    values = {"region": AZORES, "date": "2026-07-01", "generation": 14, "altitude_km": 2.0, "margin_deg": 3.0}
    scenario = Scenario(**values, distance_range_km=(200.0, 400.0), objective_floors=None)
    tasks = scenario.random_tasks(3, seed=0)
    framed = scenario.with_tasks(tasks)
    assert torch.equal(framed.tasks.start, tasks.start)
    assert framed.with_tasks(None) == scenario
    assert framed.replace(altitude_km=5).altitude_km == 5
    assert scenario.replace(altitude_km=-11).altitude_km == -11
    for altitude_km in (-16, 5000):
        with pytest.raises(
            ValueError, match=f"from -15 to 1000 km, negative for a depth, got {altitude_km}.* is it in met"
        ):
            scenario.replace(altitude_km=altitude_km)
    with pytest.raises(ValueError, match="lies outside"):
        Scenario().with_tasks(tasks)
    with pytest.raises(ValueError, match="frozen"):
        scenario.altitude_km = 5.0


REACH = {
    "paper": (PAPER_REGION, 5.0, 50.0),
    "high latitude": (HIGH_LATITUDE, 5.0, 50.0),
    "no margin": (HIGH_LATITUDE, 0.0, 50.0),
    "a move of just over half a degree": (PAPER_REGION, 5.0, 55.5),
    "the longest move": (Region((-5.0, 5.0), (175.0, 185.0)), 5.0, 1000.0),
    "near the pole": (Region((75.0, 84.0), (0.0, 20.0)), 5.0, 50.0),
    "over the pole": (Region((75.0, 85.0), (0.0, 20.0)), 5.0, 50.0),
    "over the south pole": (Region((-89.8, -85.0), (0.0, 20.0)), 0.0, 50.0),
    "all around": (Region((0.0, 10.0), (0.0, 355.0)), 5.0, 50.0),
}


def test_reachable_holds_every_place_that_a_move_can_reach() -> None:
    """From the edge of the margin in any direction, by the longest move."""
    heading = torch.linspace(-math.pi, math.pi, 73, dtype=torch.float64)
    for name, (region, margin_deg, max_move_km) in REACH.items():
        scenario = Scenario(region=region, margin_deg=margin_deg)
        assert scenario.edge == region.expanded(margin_deg)
        side = scenario.edge.grid(41)
        rim = torch.cat((side[0], side[-1], side[:, 0], side[:, -1]))
        inputs = (*rim.unsqueeze(1).unbind(-1), heading, torch.tensor(max_move_km, dtype=torch.float64))
        reached = torch.stack(move(*inputs), -1)
        assert scenario.reachable(max_move_km).contains(reached).all(), name


POLAR: dict[str, tuple[dict[str, Any], str, dict[str, Any]]] = {
    "a margin that ends at the pole": (
        {"region": Region((75, 85), (0, 20))},
        "vehicles reach a pole in Region(latitude=(69.5, 90.0), longitude=(-170.0, 190.0)), where all longitudes meet "
        "and the declination takes every value: reduce margin_deg to 4, or move the region 1° toward the equator",
        {"margin_deg": 4.0},
    ),
    "the same in the south": (
        {"region": Region((-85, -75), (0, 20))},
        "reduce margin_deg to 4, or move the region 1° toward the equator",
        {"region": Region((-84, -74), (0, 20))},
    ),
    "with a law that allows no distance of zero": (
        {"region": Region((75, 85), (0, 20)), "distance_law": "log"},
        "reduce margin_deg to 4, or move the region 1° toward the equator",
        {"margin_deg": 4.0},
    ),
    "both kinds of poles, with whatever margin": (
        {"region": Region((75, 85), (120, 140))},
        "takes every value: move the region 6° toward the equator",
        {"region": Region((69, 79), (120, 140))},
    ),
    "the magnetic pole": (
        {"region": Region((72, 82), (120, 140))},
        "region.latitude, region.longitude: the declination turns through south in Region(latitude=(66.5, 87.5)",
        {"margin_deg": 2.0},
    ),
}


@pytest.mark.parametrize("name", POLAR)
def test_a_region_near_a_pole_is_refused_with_a_remedy_that_works(name: str, tmp_path: Path) -> None:
    values, says, remedy = POLAR[name]
    scenario = Scenario(**values, date="2026-07-01", generation=14)
    for build in (scenario.build_field, lambda: GeomagneticNavEnv(scenario, seed=0)):
        with pytest.raises(ValueError, match=r"^region\.latitude") as error:
            build()
        assert says in str(error.value)
        assert "\n" not in str(error.value)
        assert len(str(error.value)) < 300
    region = {key: list(getattr(scenario.region, key)) for key in ("latitude", "longitude")}
    (tmp_path / "polar.json").write_text(json.dumps({"region": region, "date": "2026-07-01"}))
    with pytest.raises(ValueError, match=r"polar\.json: region\.latitude") as error:
        load_scenario(tmp_path / "polar.json")
    assert says in str(error.value)
    env = GeomagneticNavEnv(scenario.replace(**remedy), num_envs=8, seed=0)
    after = env.rollout(5, break_when_any_done=False)["next"]
    assert after["field"].isfinite().all()
    assert env.field.error_nt < 1e-3


def test_an_own_field_may_cover_a_pole() -> None:
    """It is not expanded; what the environment needs of it, it checks itself."""
    field = IGRF(2026.5)
    assert Scenario(region=Region((75, 85), (0, 20)), field=field).build_field() is field


INSIDE = places((-5.0, 165.0))
BAD_VALUES: list[tuple[str, object, str]] = [
    ("wings", 0.01, "unknown key 'wings': choose from region, distance_range_km, distance_law, date"),
    ("region", ((0, 1), (0, 1)), "region must be a Region, or a table of latitude and longitude"),
    ("region", None, "region must be a Region, or a table of latitude and longitude"),
    ("distance_range_km", (500.0, 300.0), "distance_range_km (500.0, 300.0) must be two rising numbers from 0 on"),
    ("distance_range_km", (300.0, 300.0), "distance_range_km (300.0, 300.0) must be two rising numbers from 0 on"),
    ("distance_range_km", (-1.0, 300.0), "distance_range_km (-1.0, 300.0) must be two rising numbers from 0 on"),
    (
        "distance_range_km",
        (NAN, 300.0),
        "distance_range_km must be 2 finite numbers, shortest and longest in km, got (nan",
    ),
    (
        "distance_range_km",
        (300.0, INF),
        "distance_range_km must be 2 finite numbers, shortest and longest in km, got (300",
    ),
    ("distance_range_km", (300.0,), "distance_range_km must be 2 finite numbers, shortest and longest in km, got (300"),
    ("distance_range_km", 300.0, "distance_range_km must be 2 finite numbers, shortest and longest in km, got 300.0"),
    ("distance_range_km", (5000.0, 6000.0), "(5000.0, 6000.0): no two points of Region(latitude=(-10.0, 0.0)"),
    ("date", "yesterday", "date 'yesterday' is not an ISO date such as '2022-01-01'"),
    ("date", None, "date None is neither a datetime, nor ISO text, nor a decimal year"),
    ("date", NAN, "date nan is not a year between 1 and 9999"),
    ("date", 2026.0, "2026-01-01T00:00:00 is outside IGRF-13, which is valid from 1900-01-01 to 2025-01-01"),
    ("generation", 12, "generation must be 13 or 14, got 12"),
    ("generation", "13", "generation must be 13 or 14, got '13'"),
    ("altitude_km", -16.0, "altitude_km must be from -15 to 1000 km, negative for a depth, got -16.0"),
    ("altitude_km", 1001.0, "altitude_km must be from -15 to 1000 km, negative for a depth, got 1001.0"),
    ("altitude_km", NAN, "altitude_km must be a finite number, got nan"),
    ("altitude_km", "high", "altitude_km must be a valid number, got 'high'"),
    ("altitude_km", True, "altitude_km must be a valid number, got True"),
    ("margin_deg", -1.0, "margin_deg must be greater than or equal to 0, got -1.0"),
    ("margin_deg", NAN, "margin_deg must be a finite number, got nan"),
    ("margin_deg", INF, "margin_deg must be a finite number, got inf"),
    (
        "objective_floors",
        (0.05, 0.4),
        "objective_floors must be 3 finite numbers, of D [deg], I [deg] and B_H [nT], got",
    ),
    ("objective_floors", (0.05, 0.4, 15.0, 1.0), "objective_floors must be 3 finite numbers, of D [deg]"),
    (
        "objective_floors",
        (0.05, NAN, 15.0),
        "objective_floors must be 3 finite numbers, of D [deg], I [deg] and B_H [nT]",
    ),
    ("objective_floors", (0.0, 0.4, 15.0), "objective_floors must be above 0, got (0.0, 0.4, 15.0)"),
    ("objective_floors", (0.05, 0.4, -15.0), "objective_floors must be above 0, got (0.05, 0.4, -15.0)"),
    ("field", "IGRF", "field must be called as field(latitude, longitude), got 'IGRF'"),
    ("distance_law", "even", "distance_law must be 'area' or 'log', got 'even'"),
    ("tasks", 5, "tasks must be Tasks, or over many regions RegionTasks, got 5"),
    ("tasks", Tasks([[-5.0, 165.0]], INSIDE), "tasks.start must be an instance of Tensor, got [[-5.0, 165.0]]"),
    ("tasks", Tasks(places((5.1, 165.0)), INSIDE), "start of task 0 (the first is task 0), [5.1, 165.0], lies outside"),
    (
        "tasks",
        Tasks(INSIDE.expand(2, 2), places((-5.0, 165.0), (-5.0, 154.0))),
        "target of task 1 (the first is task 0), [-5.0, 154.0], lies outside Region(latitude=(-15.0, 5.0)",
    ),
    ("tasks", Tasks(INSIDE, INSIDE), "task 0 (the first is task 0) starts at its destination, [-5.0, 165.0]: move one"),
    ("tasks", Tasks(INSIDE, places((NAN, 165.0))), "tasks: latitude nan"),
    ("tasks", Tasks(places((-5.0, NAN)), INSIDE), "tasks: longitude nan"),
    ("tasks", Tasks(places((-95.0, 165.0)), INSIDE), "tasks: latitude -95.0 is not between -90 and 90 degrees"),
    ("tasks", Tasks(torch.zeros(0, 2), torch.zeros(0, 2)), "tasks must be two (M, 2) tensors with M >= 1, got (0, 2)"),
    ("tasks", Tasks(torch.zeros(2), torch.zeros(2)), "tasks must be two (M, 2) tensors with M >= 1, got (2,)"),
    ("tasks", Tasks(torch.zeros(4, 3), torch.zeros(4, 3)), "tasks must be two (M, 2) tensors with M >= 1, got (4, 3)"),
    ("tasks", Tasks(torch.zeros(2, 2), torch.zeros(3, 2)), "with M >= 1, got (2, 2) and (3, 2)"),
    ("names", ("a",), "names must hold one name for each of 0 tasks, got ('a',)"),
    ("max_steps", 0, "max_steps must be greater than or equal to 1, got 0"),
    ("max_move_km", 5000.0, "max_move_km must be less than or equal to 1000, got 5000"),
    ("max_turn_deg", 0.0, "max_turn_deg must be greater than 0, got 0"),
    ("zeta", 3.0, "zeta must be below 3, got 3"),
    ("arrival", "said", "arrival must be 'objective', 'distance' or 'declared', got 'said'"),
    ("arrival_radius_km", 0.0, "arrival_radius_km must be greater than 0, got 0"),
    ("start_heading", "south", "start_heading must be 'north' or 'random', got 'south'"),
]


def test_bad_values_are_refused_with_field_value_and_remedy() -> None:
    for name, value, says in BAD_VALUES:
        with pytest.raises(ValueError, match=name) as error:
            Scenario(**{name: value})
        assert says in str(error.value), name
        assert "\n" not in str(error.value)
        assert len(str(error.value)) < 300
    assert {name for name, *_ in BAD_VALUES} == {"wings", *Scenario.model_fields}
    for names in (("a", "b"), ("a", 5)):
        with pytest.raises(ValueError, match="names"):
            Scenario(tasks=Tasks(INSIDE, places((-6.0, 165.0))), names=names)


def test_every_bad_value_of_a_scenario_is_named() -> None:
    with pytest.raises(ValueError, match=r"altitude_km must .*, got -16.*; margin_deg must .*, got -2"):
        Scenario(altitude_km=-16, margin_deg=-2)


def test_an_own_field_needs_no_date_of_igrf() -> None:
    def field(latitude: Tensor, longitude: Tensor) -> Tensor:
        return torch.stack((latitude, longitude, latitude), -1)

    scenario = Scenario(field=field, date=2500.5)
    assert scenario.build_field() is field


# --- files ------------------------------------------------------------------------------------------------------------


def test_a_file_holds_all_of_a_scenario(tmp_path: Path) -> None:
    for name, content in (
        ("azores.toml", TOML),
        ("azores.json", json.dumps(sound())),
        ("AZORES.JSON", json.dumps(sound())),
    ):
        (tmp_path / name).write_text(content)
        scenario = load_scenario(tmp_path / name)
        assert scenario.region == AZORES
        assert (str(scenario.date)[:10], scenario.generation, scenario.altitude_km) == ("2026-07-01", 14, 10.0)
        assert (scenario.distance_range_km, scenario.margin_deg) == ((200, 400), 4)
        assert scenario.objective_floors == (0.1, 0.3, 100)
        assert scenario.names == ("Ponta Delgada to Flores", "task 2")
        assert scenario.tasks is not None
        assert scenario.tasks.start.flatten().tolist() == pytest.approx([37.74, -25.67, 40, -30], abs=1e-12)
        assert scenario.tasks.target.flatten().tolist() == pytest.approx([39.45, -31.13, 42, -28], abs=1e-12)


def test_defaults_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "small.json"
    path.write_text(json.dumps({"region": sound()["region"], "date": 2026.5}))
    scenario = load_scenario(str(path))
    assert (scenario.generation, scenario.altitude_km, scenario.margin_deg) == (14, 0.0, 5.0)
    assert scenario.distance_range_km == (300, 500)
    assert (scenario.tasks, scenario.names, scenario.objective_floors) == (None, (), None)


def test_the_example_file_loads() -> None:
    scenario = load_scenario(ROOT / "docs" / "examples" / "azores.toml")
    assert scenario.region == AZORES
    assert len(scenario.names) == len(scenario.tasks.start) == 3
    assert scenario.floors(scenario.build_field()).tolist() == pytest.approx((0.113, 0.268, 110.4), rel=1e-3)


DELETE = object()
HERE = {"start": [40, -30], "target": [41, -22]}
BAD_CONTENT: list[tuple[str, object, str]] = [
    ("wings", 2, "unknown key 'wings': choose from region, distance_range_km, distance_law, date"),
    ("field", 2, "the tables [field] and [journeys] are of an earlier version"),
    ("names", ["a", "b"], "unknown key 'names': write name = ... in each of the tasks"),
    (
        "region.north",
        2,
        "region must be a Region, or a table of latitude and longitude, each [low, high] in degrees, got",
    ),
    ("region", [1], "a table of latitude and longitude, each [low, high] in degrees, got [1]"),
    ("region", DELETE, "region is missing: a scenario file must hold region and date"),
    ("region.latitude", DELETE, "got {'longitude': [-32, -22]}"),
    ("region.latitude", [36], "region: latitudes must be 2 finite numbers, got (36,)"),
    ("region.latitude", [36, "46"], "region: latitudes must be 2 finite numbers, got (36, '46')"),
    ("region.latitude", [36, True], "region: latitudes must be 2 finite numbers, got (36, True)"),
    ("region.latitude", [36, NAN], "region: latitudes must be 2 finite numbers, got (36, nan)"),
    ("region.latitude", [46, 36], "region: latitudes (46, 36) must rise"),
    ("region.latitude", [36, 96], "region: latitudes (36, 96)"),
    ("region.longitude", [-22, -32], "region: longitudes (-22, -32) must rise"),
    (
        "region.longitude",
        [3600, 3610],
        "region: longitudes must lie between -360 and 360 degrees, got (3600.0, 3610.0)",
    ),
    ("date", DELETE, "date is missing: a scenario file must hold region and date"),
    ("date", "yesterday", "date 'yesterday' is not an ISO date such as '2022-01-01'"),
    ("date", [2026], "date [2026] is neither a datetime, nor ISO text, nor a decimal year"),
    ("date", True, "date True is neither a datetime, nor ISO text, nor a decimal year"),
    ("date", "2036-01-01", "is outside IGRF-14, which is valid from 1900-01-01 to 2030-01-01"),
    ("date", 10**400, "000... is not a year between 1 and 9999"),
    ("generation", 12, "generation must be 13 or 14, got 12"),
    ("generation", 13.5, "generation must be 13 or 14, got 13.5"),
    ("generation", True, "generation must be 13 or 14, got True"),
    ("altitude_km", 5000, "altitude_km must be from -15 to 1000 km, negative for a depth, got 5000.0: is it in met"),
    ("max_steps", 2.5, "max_steps must be a valid integer, got 2.5"),
    ("altitude_km", "high", "altitude_km must be a valid number, got 'high'"),
    ("distance_range_km", [500, 300], "distance_range_km (500.0, 300.0) must be two rising numbers"),
    ("distance_range_km", [3000, 5000], "are more than 1391 km apart"),
    (
        "distance_range_km",
        [300, 10**400],
        "distance_range_km must be 2 finite numbers, shortest and longest in km, got",
    ),
    (
        "objective_floors",
        [0.05, 0.4],
        "objective_floors must be 3 finite numbers, of D [deg], I [deg] and B_H [nT], got",
    ),
    ("objective_floors", [0.05, 0.4, 0], "objective_floors must be above 0, got [0.05, 0.4, 0]"),
    ("distance_km", [3, 5], "unknown key 'distance_km': choose from region, distance_range_km"),
    ("tasks", {"start": [1, 2]}, "tasks must be a list of tables with start and target, got {'start': [1, 2]}"),
    ("tasks", [5], "tasks, entry 1, must be a table with start and target, got 5"),
    ("tasks", [HERE, {"start": [40, -30]}], "tasks, entry 2: target is missing"),
    ("tasks", [HERE | {"color": "red"}], "tasks, entry 1: unknown key 'color': choose from start, target, name"),
    (
        "tasks",
        [HERE | {"target": [41, -15]}],
        "tasks: the target of task 0 (the first is task 0), [41.0, -15.0], lies outside",
    ),
    (
        "tasks",
        [HERE, HERE | {"target": [40, 330.000001]}],
        "tasks, entry 2: start and target are the same place, [40.0, -30.0]: move one of them, or remove the entry",
    ),
    ("tasks", [HERE | {"start": [140, -30]}], "tasks: latitude 140.0 is not between -90 and 90 degrees"),
    (
        "tasks",
        [HERE | {"start": [40]}],
        "tasks, entry 1: start must be 2 finite numbers, latitude and longitude in degrees",
    ),
    ("tasks", [HERE | {"target": [40, "W"]}], "latitude and longitude in degrees, got [40, 'W']"),
    ("tasks", [HERE | {"name": ""}], "tasks, entry 1: name must be a text of 1 to 200 printable characters, got ''"),
    ("tasks", [HERE | {"name": "a\nb"}], "printable characters, got 'a\\nb'"),
    ("tasks", [HERE | {"name": "a" * 201}], "printable characters, got 'aaa"),
    ("tasks", [HERE | {"name": 5}], "got 5"),
]


def test_bad_content_is_refused_with_file_key_and_value(tmp_path: Path) -> None:
    path = tmp_path / "mine.json"
    for key, value, says in BAD_CONTENT:
        content = sound()
        if key == "distance_range_km":
            del content["tasks"]  # with tasks of its own, a scenario draws none
        *tables, last = key.split(".")
        table = content
        for name in tables:
            table = table[name]
        if value is DELETE:
            del table[last]
        else:
            table[last] = value
        path.write_text(json.dumps(content))
        with pytest.raises(ValueError, match=r"mine\.json: ") as error:
            load_scenario(path)
        assert says in str(error.value), key
        assert "\n" not in str(error.value)
        assert len(str(error.value).removeprefix(str(path))) < 300


OLD = """
[region]
latitude = [36, 46]
longitude = [-32, -22]

[field]
date = 2026-07-01

[journeys]
distance_range_km = [200, 400]
"""


def test_a_file_of_the_previous_version_is_refused_with_the_remedy(tmp_path: Path) -> None:
    path = tmp_path / "old.toml"
    for content in (OLD, OLD[: OLD.index("[journeys]")], OLD.replace("[field]", "[tasks]")):
        path.write_text(content)
        with pytest.raises(
            ValueError, match=r"old\.toml: the tables \[field\] and \[journeys\] .*earlier version"
        ) as error:
            load_scenario(path)
        assert "(date, generation, altitude_km, distance_range_km, objective_floors) at the top of the file" in str(
            error.value
        )
        assert "above [region]" in str(error.value)
    path.write_text("date = 2026-07-01\ndistance_range_km = [200, 400]\n" + OLD[: OLD.index("[field]")])
    assert load_scenario(path).distance_range_km == (200, 400)


def test_unreadable_files_are_refused(tmp_path: Path) -> None:
    for name, content, says in (
        ("a.yaml", b"", "a scenario file must end in .toml or .json, got '.yaml'"),
        ("a.toml", b"[region", "the file is not valid TOML"),
        ("a.json", b"{", "the file is not valid JSON"),
        ("a.json", b'{"region": 1, "region": 2}', "the key 'region' is repeated"),
        ("a.json", b"\xff\xfe\x00", "the file is not UTF-8"),
        ("a.json", b"[" * 100_000, "JSON"),
        ("a.toml", b"a = " + b"[" * 5_000, "TOML"),
        ("a.json", b" " * (MAX_FILE_BYTES + 1), f"the file holds more than {MAX_FILE_BYTES} bytes"),
        ("a.json", b"[]", "a scenario file must hold a table, got []"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=name) as error:
            load_scenario(tmp_path / name)
        assert says in str(error.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no scenario file at .*nowhere\.toml"):
        load_scenario(tmp_path / "nowhere.toml")
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(ValueError, match=r"folder\.toml"):
        load_scenario(tmp_path / "folder.toml")
    with pytest.raises(TypeError, match="path must be a Path or str, got 5"):
        load_scenario(5)


# --- policies and recipes ---------------------------------------------------------------------------------------------


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "recipes" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_policy_is_refused_where_it_was_not_trained() -> None:
    here = GeomagneticNavEnv(seed=0)
    policy = FieldPolicy(PolicyConfig(here.observation_view(), (8,), layer_norm=False))
    policy.check_fits(here)
    later = Scenario(date="2026-07-01", generation=14)
    policy.check_fits(GeomagneticNavEnv(later, seed=0))
    azores = later.replace(region=AZORES)
    with pytest.raises(ValueError, match=r"trained where D is 7\.3 to 10\.4°; here it is -10\.0 to -5\.4°"):
        policy.check_fits(GeomagneticNavEnv(azores, seed=0))


def test_training_and_evaluation_take_the_same_file(tmp_path: Path) -> None:
    """Trained in the user's scenario, evaluated on its tasks; the file may be gone before the evaluation."""
    path, away = tmp_path / "azores.toml", {"wandb_mode": "disabled"}
    path.write_text(TOML)
    recipe, evaluate = load("td3_gradient_guided"), load("evaluate")
    small = {"num_envs": 8, "total_frames": 64, "num_cells": (8,), "batch_size": 16, "eval_every": 4}
    small |= {"eval_tasks_small": 3, "eval_tasks": 4, "init_random_frames": 8}
    run = tmp_path / "run"
    recipe.train(recipe.Config(scenario=path, out=run, **small, **away))
    assert (run / "scenario.toml").read_text() == TOML
    assert json.loads((run / "config.json").read_text())["scenario"] == "scenario.toml"
    (run / "eval.json").unlink()
    arguments = (recipe.Config, recipe.PRESETS, recipe.RECIPE, recipe.__doc__, ["--resume", str(run)])
    assert parse_config(*arguments).scenario == run / "scenario.toml"

    out, names = tmp_path / "out", (f"gg_td3={run}", "parallel")
    exported = tmp_path / "maps" / "flights.geojson"
    summaries = evaluate.evaluate(evaluate.Config(names, scenario=path, out=out, export=exported, **away))
    assert summaries["parallel"][0]["num_tasks"] == 2
    assert summaries["parallel"][0]["success_rate"] == 100
    features = json.loads(exported.read_text())["features"]
    assert [feature["properties"]["name"] for feature in features] == ["Ponta Delgada to Flores", "task 2"] * 2
    assert {feature["properties"]["navigator"] for feature in features} == {"gg_td3", "parallel"}
    random = evaluate.evaluate(
        evaluate.Config(("parallel",), tasks="paper-100", scenario=path, out=tmp_path / "random", **away)
    )
    assert random["parallel"][0]["num_tasks"] == 100
    other = {"out": tmp_path / "other", **away}
    for message, options in (
        (r"gg_td3=.*trained where D is", {"navigators": names[:1], "tasks": "figure-4-1"}),
        (
            "--tasks figure-4-1 lies in the paper's region",
            {"navigators": names, "tasks": "figure-4-1", "scenario": path},
        ),
        (r"\.geojson, \.gpx, \.kml", {"navigators": names, "scenario": path, "export": tmp_path / "a.shp"}),
    ):
        with pytest.raises(ValueError, match=message):
            evaluate.evaluate(evaluate.Config(**options, **other))
    assert not (tmp_path / "other").exists()


def test_a_region_too_large_for_a_field_leaves_no_run_folder(tmp_path: Path) -> None:
    recipe, path = load("td3_gradient_guided"), tmp_path / "big.json"
    path.write_text(json.dumps({"region": {"latitude": [-60, 60], "longitude": [0, 90]}, "date": 2026.5}))
    with pytest.raises(ValueError, match=r"big\.json: region.*misses the model by .* nT.*: choose a smaller region"):
        recipe.train(recipe.Config(scenario=path, out=tmp_path / "run", wandb_mode="disabled"))
    assert not (tmp_path / "run").exists()


# --- options of episodes ----------------------------------------------------------------------------------------------


def test_a_scenario_holds_the_options_of_its_episodes(tmp_path) -> None:
    path = tmp_path / "long.toml"
    path.write_text(
        """date = 2022-01-01
altitude_km = -3
max_steps = 80
max_move_km = 20
max_turn_deg = 45
zeta = 0.02
arrival = "distance"
arrival_radius_km = 30
start_heading = "random"
region = {latitude = [-10, 0], longitude = [160, 170]}
"""
    )
    env = GeomagneticNavEnv(load_scenario(path), num_envs=3, seed=0)
    assert (env.max_steps, env.max_move_km, env.zeta, env.start_heading) == (80, 20.0, 0.02, "random")
    assert (env.max_turn_rad, env.arrival.rule, env.arrival.radius_km) == (math.pi / 4, "distance", 30.0)
    assert env.action_spec.space.high[0].tolist() == pytest.approx([20.0, math.pi / 4])
    assert env.reset()["heading"].abs().min() > 0
    deep = IGRF("2022-01-01")(torch.tensor(-5.0), torch.tensor(165.0), -3.0)
    torch.testing.assert_close(env.field(torch.tensor(-5.0), torch.tensor(165.0)), deep, rtol=0, atol=1e-4)


def test_options_are_those_given_then_of_the_scenario_then_the_default() -> None:
    scenario = Scenario(max_steps=80, max_turn_deg=90)
    assert GeomagneticNavEnv(scenario, seed=0).max_steps == 80
    assert GeomagneticNavEnv(scenario, zeta=0.5, seed=0).zeta == 0.5
    assert GeomagneticNavEnv(scenario, max_steps=80, max_turn_rad=math.pi / 2, seed=0).max_move_km == 50
    with pytest.raises(ValueError, match=r"max_steps is 80 in the scenario, and 50 was given.*scenario\.replace"):
        GeomagneticNavEnv(scenario, max_steps=50)


def test_a_destination_outside_needs_a_margin_that_the_error_gives() -> None:
    """Twelve degrees south of the region, and seven beyond the antimeridian from it."""
    tasks = Tasks(places((-5.0, 165.0), (-5.0, 165.0)), places((-21.7, 165.0), (-5.0, -179.0)))
    with pytest.raises(ValueError, match=r"lies outside .*: raise margin_deg from 5 to at least 12$"):
        Scenario(tasks=tasks)
    env = GeomagneticNavEnv(Scenario(tasks=tasks, margin_deg=12), num_envs=2, seed=0)
    assert env.edge.contains(env.reset()["target_position"]).all()
    with pytest.raises(ValueError, match=r"to at least 11$"):
        Scenario(tasks=Tasks(tasks.start[1:], tasks.target[1:]))
