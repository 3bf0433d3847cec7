"""Scenarios: their validation, fields and floors, and their files."""

import copy
import json
import math
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from magrl import paper
from magrl.envs import GeomagneticNavEnv, Region, Regions, Scenario, Trips, load_scenario, trip_set
from magrl.field import IGRF, RegionalField, elements_at

AZORES = Region((36, 46), (-32, -22))


def places(*positions: tuple[float, ...]) -> Tensor:
    return torch.tensor(positions, dtype=torch.float64)


def test_the_default_scenario_is_the_papers_to_the_bit() -> None:
    scenario = Scenario()
    assert (scenario.region[0].latitude, scenario.region[0].longitude) == (paper.LATITUDE, paper.LONGITUDE)
    assert (scenario.distance_range_km, scenario.generation) == (paper.DISTANCE_KM, paper.GENERATION)
    field = RegionalField(IGRF("2022-01-01", 13), (-15.5, 5.5), (154.5, 175.5))
    assert torch.equal(scenario.build_field().coefficients, field.coefficients)
    one, other = (GeomagneticNavEnv(*given, num_envs=3, seed=0).rollout(1) for given in ((), (scenario,)))
    for key in ("field", "position"):
        assert torch.equal(one[key], other[key])
    assert torch.equal(scenario.random_trips(5, 1).target, trip_set(5, 1).target)


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


def test_replace_checks_anew_and_changes_nothing_else() -> None:
    values = {"region": AZORES, "date": "2026-07-01", "generation": 14, "altitude_km": 2.0, "margin_deg": 3.0}
    scenario = Scenario(**values, distance_range_km=(200.0, 400.0), objective_floors=None)
    trips = scenario.random_trips(3, seed=0)
    framed = scenario.with_trips(trips)
    assert torch.equal(framed.trips.start, trips.start)
    assert framed.with_trips(None) == scenario
    changed = framed.replace(altitude_km=5)
    assert changed.altitude_km == 5
    assert [changed.given(name) for name in ("altitude_km", "margin_deg", "max_leg_km")] == [5, 3.0, None]
    with pytest.raises(ValueError, match="lies outside"):
        Scenario().with_trips(trips)
    with pytest.raises(ValueError, match="frozen"):
        scenario.altitude_km = 5.0


POLAR: dict[str, tuple[dict[str, Any], str, dict[str, Any]]] = {
    "a margin that ends at the pole": (
        {"region": Region((75, 85), (0, 20))},
        "vehicles reach a pole in Region(latitude=(69.5, 90.0), longitude=(-170.0, 190.0)), where the declination "
        "takes every value: reduce margin_deg or the region, or move it toward the equator",
        {"margin_deg": 4.0},
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
    ("wings", 0.01, "unknown key 'wings': choose from max_steps, max_leg_km, max_turn_deg, zeta"),
    ("distance_range_km", (5000.0, 6000.0), "(5000.0, 6000.0): no two points of Region(latitude=(-10.0, 0.0)"),
    ("date", 2026.0, "2026-01-01T00:00:00 is outside IGRF-13, which is valid from 1900-01-01 to 2025-01-01"),
    ("trips", torch.zeros(9, 4), "trips must be Trips(start, target), each (M, 2) latitude and longitude [deg], got"),
    ("names", ("a",), "names must hold one name for each of 0 trips, got ('a',)"),
]


@pytest.mark.parametrize(("name", "value", "says"), BAD_VALUES)
def test_a_bad_value_is_named_with_its_field_and_the_remedy(name: str, value: object, says: str) -> None:
    with pytest.raises(ValueError, match=name) as error:
        Scenario(**{name: value})
    assert says in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 300


def test_an_own_field_needs_no_date_of_igrf() -> None:
    field = IGRF("2022-01-01", 13)
    assert Scenario(field=field, date=2500.5).build_field() is field


def test_a_destination_outside_needs_a_margin_that_the_error_gives() -> None:
    """Twelve degrees south of the region, and seven beyond the antimeridian from it."""
    trips = Trips(places((-5.0, 165.0), (-5.0, 165.0)), places((-21.7, 165.0), (-5.0, -179.0)))
    with pytest.raises(ValueError, match=r"lies outside .*: raise margin_deg from 5 to at least 12$"):
        Scenario(trips=trips)
    env = GeomagneticNavEnv(Scenario(trips=trips, margin_deg=12), num_envs=2, seed=0)
    assert env.edge.contains(env.reset()["target_position"]).all()
    with pytest.raises(ValueError, match=r"to at least 11$"):
        Scenario(trips=Trips(trips.start[1:], trips.target[1:]))


TOML = """
# .........................
date = 2026-07-01 # .........................
generation = 14
altitude_km = 10.0
margin_deg = 4
distance_range_km = [200, 400]
objective_floors = [0.1, 0.3, 100]
distance_law = "log"
max_steps = 80
max_leg_km = 20
max_turn_deg = 45
zeta = 0.02
arrival = "distance"
radius_km = 30
start_heading = "random"

[region]
latitude = [36, 46]
longitude = [-32, -22]

[[trips]]
name = "Ponta Delgada to \\".................."
start = [37.74, -25.67]
target = [39.45, -31.13]

[[trips]]
start = [40, -30]
target = [42, 332]
"""


def sound() -> dict[str, Any]:
    """Return the content of the same file, as tables with a date that JSON can hold."""
    return tomllib.loads(TOML) | {"date": "2026-07-01"}


def test_a_file_holds_all_of_a_scenario(tmp_path: Path) -> None:
    for name, content in (
        ("azores.toml", TOML),
        ("AZORES.JSON", json.dumps(sound())),
    ):
        (tmp_path / name).write_text(content, encoding="utf-8")
        scenario = load_scenario(tmp_path / name)
        assert scenario.region == Regions.of(AZORES)
        assert (str(scenario.date)[:10], scenario.generation, scenario.altitude_km) == ("2026-07-01", 14, 10.0)
        assert (scenario.distance_range_km, scenario.margin_deg) == ((200, 400), 4)
        assert scenario.objective_floors == (0.1, 0.3, 100)
        assert scenario.names == ('Ponta Delgada to "..................', "trip 2")
        assert scenario.trips is not None
        assert scenario.trips.start.flatten().tolist() == pytest.approx([37.74, -25.67, 40, -30], abs=1e-12)
        assert scenario.trips.target.flatten().tolist() == pytest.approx([39.45, -31.13, 42, -28], abs=1e-12)
    env = GeomagneticNavEnv(scenario, num_envs=3, seed=0)
    assert (env.max_steps, env.max_leg_km, env.zeta, env.start_heading) == (80, 20.0, 0.02, "random")
    assert (env.max_turn_rad, env.arrival, env.scenario.radius_km) == (math.pi / 4, "distance", 30.0)
    assert env.action_spec.space.high[0].tolist() == pytest.approx([20.0, math.pi / 4])
    assert env.reset()["heading"].abs().min() > 0


def test_defaults_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "small.json"
    path.write_text(json.dumps({"region": sound()["region"], "date": 2026.5}), encoding="utf-8")
    scenario = load_scenario(str(path))
    assert (scenario.generation, scenario.altitude_km, scenario.margin_deg) == (14, 0.0, 5.0)
    assert scenario.distance_range_km == (300, 500)
    assert (scenario.trips, scenario.names, scenario.objective_floors) == (None, (), None)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no scenario file at .*nowhere\.toml"):
        load_scenario(tmp_path / "nowhere.toml")
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(ValueError, match=r"folder\.toml"):
        load_scenario(tmp_path / "folder.toml")
    with pytest.raises(TypeError, match="path must be a Path or str, got 5"):
        load_scenario(5)


DROPPED = object()


def changed(content: Any, value: object) -> Iterator[tuple[str, Any]]:
    """The content of a file with one part replaced or dropped, and the name of that part."""
    for key in [*content] if isinstance(content, dict) else range(len(content)) if isinstance(content, list) else []:
        parts = [("", value), *changed(content[key], value)]
        for name, part in parts:
            other = copy.copy(content)
            other[key] = part
            if part is DROPPED:
                del other[key]
            yield name or (key if isinstance(key, str) else ""), other


OPTIONAL = {*tomllib.loads(TOML).keys(), "name"} - {"region", "date"}


@pytest.mark.parametrize(
    ("value", "taken"),
    [(DROPPED, OPTIONAL), (None, {"objective_floors"}), ("x", {"name"}), ([], {"trips"})]
    + [(value, set()) for value in (True, [[1, 2]], math.nan)],
    ids=range(7),
)
def test_bad_content_is_named_with_file_and_key(tmp_path: Path, value: object, taken: set[str]) -> None:
    """Each part of a file, dropped or of another type; what may be so is taken."""
    path, found, said = tmp_path / "mine.json", set(), []
    for key, content in changed(sound(), value):
        path.write_text(json.dumps(content), encoding="utf-8")
        try:
            load_scenario(path)
            found.add(key)
        except ValueError as error:
            file, _, text = str(error).partition(": ")
            named = key in text or key in ("latitude", "longitude", "start", "target")
            said.append((file == str(path), named, len(text) < 300, "\n" in text))
    assert found == taken
    assert {*said} == {(True, True, True, False)}


UNREADABLE: dict[str, tuple[str, bytes]] = {
    "the file must end in .toml or .json, got '.yaml'": ("a.yaml", b""),
    "the file is not valid TOML": ("a.toml", b"[region"),
    "JSON": ("a.json", b"[" * 100_000),
    "a scenario file must hold a table, got []": ("a.json", b"[]"),
}


@pytest.mark.parametrize("says", UNREADABLE)
def test_unreadable_files(tmp_path: Path, says: str) -> None:
    name, content = UNREADABLE[says]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=name) as error:
        load_scenario(tmp_path / name)
    assert says in str(error.value)
