"""Scenario files: their content, and what is wrong with it."""

from __future__ import annotations

import copy
import json
import math
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from magrl.envs import GeomagneticNavEnv, Region, Regions, load_scenario
from magrl.field import IGRF
from magrl.files import MAX_FILE_BYTES

ROOT = Path(__file__).parent.parent.parent
AZORES = Regions.of(Region((36, 46), (-32, -22)))
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
max_move_km = 20
max_turn_deg = 45
zeta = 0.02
arrival = "distance"
radius_km = 30
start_heading = "random"

[region]
latitude = [36, 46]
longitude = [-32, -22]

[[tasks]]
name = "Ponta Delgada to \\".................."
start = [37.74, -25.67]
target = [39.45, -31.13]

[[tasks]]
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
        assert scenario.region == AZORES
        assert (str(scenario.date)[:10], scenario.generation, scenario.altitude_km) == ("2026-07-01", 14, 10.0)
        assert (scenario.distance_range_km, scenario.margin_deg) == ((200, 400), 4)
        assert scenario.objective_floors == (0.1, 0.3, 100)
        assert scenario.names == ('Ponta Delgada to "..................', "task 2")
        assert scenario.tasks is not None
        assert scenario.tasks.start.flatten().tolist() == pytest.approx([37.74, -25.67, 40, -30], abs=1e-12)
        assert scenario.tasks.target.flatten().tolist() == pytest.approx([39.45, -31.13, 42, -28], abs=1e-12)


def test_defaults_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "small.json"
    path.write_text(json.dumps({"region": sound()["region"], "date": 2026.5}), encoding="utf-8")
    scenario = load_scenario(str(path))
    assert (scenario.generation, scenario.altitude_km, scenario.margin_deg) == (14, 0.0, 5.0)
    assert scenario.distance_range_km == (300, 500)
    assert (scenario.tasks, scenario.names, scenario.objective_floors) == (None, (), None)


def test_the_example_file_loads() -> None:
    scenario = load_scenario(ROOT / "docs" / "examples" / "azores.toml")
    assert scenario.region == AZORES
    assert len(scenario.names) == len(scenario.tasks.start) == 3


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no scenario file at .*nowhere\.toml"):
        load_scenario(tmp_path / "nowhere.toml")
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(ValueError, match=r"folder\.toml"):
        load_scenario(tmp_path / "folder.toml")
    with pytest.raises(TypeError, match="path must be a Path or str, got 5"):
        load_scenario(5)


def test_a_scenario_holds_the_options_of_its_episodes(tmp_path) -> None:
    (tmp_path / "deep.toml").write_text(TOML.replace("altitude_km = 10.0", "altitude_km = -3"), encoding="utf-8")
    env = GeomagneticNavEnv(load_scenario(tmp_path / "deep.toml"), num_envs=3, seed=0)
    assert (env.max_steps, env.max_move_km, env.zeta, env.start_heading) == (80, 20.0, 0.02, "random")
    assert (env.max_turn_rad, env.arrival.rule, env.arrival.radius_km) == (math.pi / 4, "distance", 30.0)
    assert env.action_spec.space.high[0].tolist() == pytest.approx([20.0, math.pi / 4])
    assert env.reset()["heading"].abs().min() > 0
    deep = IGRF("2026-07-01", 14)(torch.tensor(40.0), torch.tensor(-27.0), -3.0)
    torch.testing.assert_close(env.field(torch.tensor(40.0), torch.tensor(-27.0)), deep, rtol=0, atol=1e-4)


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
    [(DROPPED, OPTIONAL), (None, {"objective_floors"}), ("x", {"name"}), ([], {"tasks"})]
    + [(value, set()) for value in (True, {"a": 1}, [[1, 2]], math.nan, 10**400)],
    ids=range(9),
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


def test_an_unknown_key_is_named_with_the_choices(tmp_path: Path) -> None:
    (tmp_path / "mine.json").write_text(json.dumps(sound() | {"wings": 2}), encoding="utf-8")
    with pytest.raises(ValueError, match="unknown key 'wings': choose from region, distance_range_km, distance_law,"):
        load_scenario(tmp_path / "mine.json")


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.yaml", b"", "the file must end in .toml or .json, got '.yaml'"),
        ("a.toml", b"[region", "the file is not valid TOML"),
        ("a.json", b'{"region": 1, "region": 2}', "the key 'region' is repeated"),
        ("a.json", b"[" * 100_000, "JSON"),
        ("a.json", b" " * (MAX_FILE_BYTES + 1), f"the file holds more than {MAX_FILE_BYTES} bytes"),
        ("a.json", b"[]", "a scenario file must hold a table, got []"),
    ],
    ids=range(6),
)
def test_unreadable_files(tmp_path: Path, name: str, content: bytes, says: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=name) as error:
        load_scenario(tmp_path / name)
    assert says in str(error.value)
