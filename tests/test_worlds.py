"""A world from the user's own file: what it says is what is flown, and what is wrong is said by file, key and value."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from magrl import td3
from magrl.env import GeomagneticNavEnv, paper_field
from magrl.fields import IGRF, elements_at
from magrl.geodesy import geodesic
from magrl.tasks import PAPER_REGION, Region, task_set
from magrl.worlds import MAX_BYTES, World, load_world

RECIPES = Path(__file__).parent.parent / "recipes"
TOML = """
[region]
latitude = [36, 46]
longitude = [-32, -22]

[field]
date = 2026-07-01
generation = 14
altitude_km = 10.0

[journeys]
distance_range_km = [200, 400]
objective_floors = [0.1, 0.3, 100]

[[tasks]]
name = "Ponta Delgada to Flores"
start = [37.74, -25.67]
target = [39.45, -31.13]

[[tasks]]
start = [40, -30]
target = [42, 332]
"""


def sound() -> dict[str, Any]:
    """The smallest file of each key, as tables."""
    return {
        "region": {"latitude": [36, 46], "longitude": [-32, -22]},
        "field": {"date": "2026-07-01", "generation": 14, "altitude_km": 10.0},
        "journeys": {"distance_range_km": [200, 400], "objective_floors": [0.1, 0.3, 100]},
        "tasks": [
            {"name": "Ponta Delgada to Flores", "start": [37.74, -25.67], "target": [39.45, -31.13]},
            {"start": [40, -30], "target": [42, 332]},
        ],
    }


def load(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, RECIPES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("suffix", [".toml", ".json"])
def test_file_says_all_of_a_world(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"azores{suffix}"
    path.write_text(TOML if suffix == ".toml" else json.dumps(sound()))
    world = load_world(path)
    assert world.region == Region((36, 46), (-32, -22))
    assert (str(world.date)[:10], world.generation, world.altitude_km) == ("2026-07-01", 14, 10.0)
    assert world.distance_range_km == (200, 400)
    assert world.objective_floors == (0.1, 0.3, 100)
    assert world.names == ("Ponta Delgada to Flores", "task 2")
    assert world.tasks is not None
    assert world.tasks.start.tolist() == [[37.74, -25.67], [40, -30]]
    assert world.tasks.target.tolist() == [[39.45, -31.13], [42, 332]]


def test_defaults_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "small.json"
    path.write_text(json.dumps({"region": sound()["region"], "field": {"date": 2026.5}}))
    world = load_world(path)
    assert (world.generation, world.altitude_km, world.distance_range_km) == (14, 0.0, (300, 500))
    assert world.tasks is None
    assert world.names == ()
    assert world.objective_floors is None


def test_default_world_is_the_papers_to_the_bit() -> None:
    world, env = World(), GeomagneticNavEnv(num_envs=3, seed=0)
    assert torch.equal(world.field().coefficients, paper_field().coefficients)
    same = GeomagneticNavEnv(num_envs=3, seed=0, **world.options())
    one, other = env.rollout(1), same.rollout(1)
    assert torch.equal(one["field"], other["field"])
    assert torch.equal(one["position"], other["position"])
    assert torch.equal(world.random_tasks(5, 1).target, task_set(5, 1).target)


def test_field_is_that_of_the_date_and_altitude() -> None:
    """Against IGRF itself, called with the altitude; ten kilometres up B_H is 0.46 to 0.50 % weaker there."""
    world = World(Region((36, 46), (-32, -22)), date="2026-07-01", generation=14, altitude_km=10.0)
    latitude, longitude = torch.tensor([40.0, 37.0]), torch.tensor([-30.0, -23.0])
    expected = IGRF("2026-07-01", 14)(latitude, longitude, 10.0)
    assert (world.field()(latitude, longitude) - expected).abs().max() < 1e-5
    place = torch.stack((latitude, longitude), -1).double()
    ground = World(world.region, date="2026-07-01", generation=14)
    weaker = 1 - elements_at(world.field(), place)[:, 2] / elements_at(ground.field(), place)[:, 2]
    assert ((weaker > 0.0046) & (weaker < 0.0050)).all()


def test_random_journeys_lie_in_the_region_and_range() -> None:
    world = World(Region((36, 46), (-32, -22)), (200, 400), "2026-07-01", 14)
    tasks = world.random_tasks(50, 3)
    distance, _ = geodesic(*tasks.start.unbind(-1), *tasks.target.unbind(-1))
    assert ((distance >= 200) & (distance <= 400)).all()
    assert world.region.contains(torch.stack(tasks)).all()
    env = GeomagneticNavEnv(num_envs=2, seed=0, **world.options())
    assert (env.distance_range_km, env.region) == ((200, 400), world.region)


def test_floors_are_25_km_of_travel_there() -> None:
    """B_H changes by 445 nT in 100 km round the Azores, and by 52 in the paper's region, whose floor is 15 nT."""
    world = load_world(RECIPES.parent / "docs" / "examples" / "azores.toml")
    floors = world.options()["objective_floors"]
    assert floors == pytest.approx((0.113, 0.268, 110.4), rel=1e-3)
    assert World().options()["objective_floors"] == (0.05, 0.4, 15.0)
    paper = World(objective_floors=None).options()["objective_floors"]
    assert paper == pytest.approx((0.05, 0.4, 15.0), rel=0.5)
    assert len(world.names) == 3


DELETE = object()


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("wings", 2, "unknown key 'wings'"),
        ("region.north", 2, "region: unknown key 'north'; known are latitude, longitude"),
        ("region", [1], "region must be a table with latitude, longitude, got [1]"),
        ("region", DELETE, "region is missing"),
        ("field", DELETE, "field is missing"),
        ("field.date", DELETE, "field: date is missing"),
        ("region.latitude", [36], "region.latitude must be 2 numbers"),
        ("region.latitude", [36, "46"], "such as [40, 50], got [36, '46']"),
        ("region.latitude", [36, True], "region.latitude must be 2 numbers"),
        ("region.latitude", [36, float("nan")], "region.latitude must be 2 numbers"),
        ("region.latitude", [46, 36], "region: latitudes (46.0, 36.0) must rise"),
        ("region.latitude", [36, 96], "region: latitudes (36.0, 96.0)"),
        ("region.longitude", [-22, -32], "region: longitudes (-22.0, -32.0)"),
        ("region.longitude", [3600, 3610], "region.longitude must lie between -360 and 360"),
        (
            "field.date",
            "yesterday",
            "must be a date such as '2026-07-01' or a year such as 2026.5, got 'yest",
        ),
        ("field.date", [2026], "got [2026]"),
        ("field.date", "2036-01-01", "is outside IGRF-14, which is valid from 1900-01-01 to 2030-01-01"),
        ("field.date", 10**400, "a year such as 2026.5, got 1000"),
        ("field.generation", 12, "IGRF generation 12 is not available: choose from [13, 14]"),
        ("field.generation", 13.5, "field.generation must be 13 or 14, got 13.5"),
        ("field.altitude_km", -1, "field.altitude_km must be a finite number from 0 up to 600, got -1"),
        ("field.altitude_km", "high", "got 'high'"),
        ("journeys.distance_range_km", [500, 300], "distance_range_km (500.0, 300.0) must be two rising numbers"),
        ("journeys.distance_range_km", [3000, 5000], "are more than"),
        ("journeys.objective_floors", [0.05, 0.4], "journeys.objective_floors must be 3 numbers, above 0"),
        (
            "journeys.objective_floors",
            [0.05, 0.4, 0],
            "above 0, of D, I in degrees and of B_H in nT, got [0.05, 0.4, 0]",
        ),
        ("journeys.distance_km", [3, 5], "unknown key 'distance_km'; known are distance_range_km, objective_floors"),
        ("tasks", {"start": [1, 2]}, "tasks must be a list"),
        ("tasks", [5], "tasks, entry 1 must be a table with start, target, name, got 5"),
        ("tasks", [{"start": [40, -30]}], "tasks, entry 1: target is missing"),
        (
            "tasks",
            [{"start": [40, -30], "target": [41, -21]}],
            "[41.0, -21.0] must lie in the region, latitude 36",
        ),
        ("tasks", [{"start": [140, -30], "target": [41, -22]}], "tasks, entry 1: start [140.0, -30.0] must lie in"),
        ("tasks", [{"start": [40, -30], "target": [41, -22], "name": ""}], "name must be a text of 1 to 200"),
        ("tasks", [{"start": [40, -30], "target": [41, -22], "name": "a\nb"}], "printable characters, got 'a\\nb'"),
        ("tasks", [{"start": [40, -30], "target": [41, -22], "name": 5}], "got 5"),
    ],
)
def test_what_is_wrong_is_said_by_file_key_and_value(tmp_path: Path, key: str, value: object, says: str) -> None:
    content, path = sound(), tmp_path / "mine.json"
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
        load_world(path)
    assert says in str(error.value)
    assert len(str(error.value)) < 500


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.yaml", b"", "ends in .toml or .json, not in '.yaml'"),
        ("a.toml", b"[region", "it is not TOML"),
        ("a.json", b"{", "it is not JSON"),
        ("a.json", b'{"region": 1, "region": 2}', "the key 'region' is there twice"),
        ("a.json", b"\xff\xfe\x00", "it is not UTF-8"),
        ("a.json", b"[" * 100_000, "JSON"),
        ("a.toml", b"a = " + b"[" * 5_000, "TOML"),
        ("a.json", b" " * (MAX_BYTES + 1), f"it holds more than {MAX_BYTES} bytes"),
        ("a.json", b"[]", "the file must be a table"),
    ],
    ids=lambda value: None if isinstance(value, bytes) else value,
)
def test_what_is_no_world_is_refused(tmp_path: Path, name: str, content: bytes, says: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=name) as error:
        load_world(tmp_path / name)
    assert says in str(error.value)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no file of a world at .*nowhere\.toml"):
        load_world(tmp_path / "nowhere.toml")
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(ValueError, match=r"folder\.toml"):
        load_world(tmp_path / "folder.toml")


def test_policy_is_refused_where_it_was_not_trained() -> None:
    here = GeomagneticNavEnv(seed=0)
    config = td3.policy_config(here, (8,), layer_norm=False)
    td3.check_fits(config, here)
    later = World(PAPER_REGION, date="2026-07-01", generation=14)
    td3.check_fits(config, GeomagneticNavEnv(seed=0, **later.options()))
    azores = World(Region((36, 46), (-32, -22)), date="2026-07-01", generation=14)
    with pytest.raises(ValueError, match=r"trained where D is 7\.3 to 10\.4°; here it is -10\.0 to -5\.4°"):
        td3.check_fits(config, GeomagneticNavEnv(seed=0, **azores.options()))


def test_training_and_evaluation_take_the_same_file(tmp_path: Path) -> None:
    """Trained in the user's world, flown on the user's tasks; the file may be gone before the evaluation."""
    path = tmp_path / "azores.toml"
    path.write_text(TOML)
    recipe, evaluate = load("td3_gradient_guided"), load("evaluate")
    small = {"num_envs": 8, "total_frames": 64, "num_cells": (8,), "batch_size": 16, "eval_every": 4}
    small |= {"eval_tasks_small": 3, "eval_tasks": 4, "wandb_mode": "disabled", "init_random_frames": 8}
    run = tmp_path / "run"
    recipe.train(recipe.Config(world=path, out=run, **small))
    assert (run / "world.toml").read_text() == TOML
    assert json.loads((run / "config.json").read_text())["world"] == "world.toml"
    (run / "eval.json").unlink()
    assert recipe.parse("td3_gradient_guided.py", ["--resume", str(run)]).world == run / "world.toml"

    out, names = tmp_path / "out", (f"gg_td3={run}", "parallel")
    options = {"export": tmp_path / "maps" / "flights.geojson", "wandb_mode": "disabled"}
    summaries = evaluate.evaluate(evaluate.Config(names, world=path, out=out, **options))
    assert summaries["parallel"][0]["num_tasks"] == 2
    assert summaries["parallel"][0]["success_rate"] == 100
    features = json.loads((tmp_path / "maps" / "flights.geojson").read_text())["features"]
    assert [feature["properties"]["name"] for feature in features] == ["Ponta Delgada to Flores", "task 2"] * 2
    assert {feature["properties"]["navigator"] for feature in features} == {"gg_td3", "parallel"}
    with pytest.raises(ValueError, match=r"gg_td3=.*trained where D is"):
        evaluate.evaluate(evaluate.Config(names[:1], tasks="figure-4-1", out=tmp_path / "other"))
    random = evaluate.evaluate(
        evaluate.Config(("parallel",), tasks="paper-100", world=path, out=tmp_path / "random", wandb_mode="disabled")
    )
    assert random["parallel"][0]["num_tasks"] == 100
    with pytest.raises(ValueError, match="--tasks figure-4-1 lies in the paper's region"):
        evaluate.evaluate(evaluate.Config(names, tasks="figure-4-1", world=path, out=tmp_path / "other"))
    with pytest.raises(ValueError, match=r"\.geojson, \.gpx, \.kml"):
        evaluate.evaluate(evaluate.Config(names, world=path, out=tmp_path / "other", export=tmp_path / "a.shp"))
    assert not (tmp_path / "other").exists()


def test_a_world_that_is_none_leaves_no_run_folder(tmp_path: Path) -> None:
    recipe = load("td3_gradient_guided")
    path = tmp_path / "big.json"
    path.write_text(json.dumps({"region": {"latitude": [-60, 60], "longitude": [0, 90]}, "field": {"date": 2026.5}}))
    with pytest.raises(ValueError, match="shrink the box"):
        recipe.train(recipe.Config(world=path, out=tmp_path / "run", wandb_mode="disabled"))
    assert not (tmp_path / "run").exists()
