"""The map of the whole Earth: the environment without edges, the properties of tasks, table and figure."""

import importlib.util
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tensordict import TensorDict

from magrl.envs import Scenario, Tasks
from magrl.field import IGRF
from magrl.training import UsageError

SCRIPT = Path(__file__).parent.parent.parent / "recipes" / "tables" / "globe.py"


@pytest.fixture(scope="module")
def globe():
    spec = importlib.util.spec_from_file_location("globe", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules["globe"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def field() -> IGRF:
    return IGRF("2025-01-01")


class Slopes:
    """A field of 30 000 nT to the north, in which D and I change by some floors of the objective over 25 km."""

    def __init__(self, declination: tuple[float, float], inclination: tuple[float, float]) -> None:
        self.gradient = torch.zeros(3, 2, dtype=torch.float64)
        for row, floor, slope in ((1, 0.05, declination), (2, 0.4, inclination)):
            self.gradient[row] = 30_000 * torch.tensor(slope).double() * math.radians(floor) / 25

    def value_and_gradient(self, latitude: torch.Tensor, longitude: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        shape = torch.broadcast_shapes(latitude.shape, longitude.shape)
        value = torch.tensor([30_000.0, 0, 0]).double().expand(*shape, 3)
        return value, self.gradient.expand(*shape, 3, 2)


def test_weakest_change_is_in_floors_of_the_objective(globe) -> None:
    here = torch.zeros(1, 2, dtype=torch.float64)
    assert globe.weakest_change(Slopes((2, 0), (0, 3)), here).item() == pytest.approx(2)
    assert globe.weakest_change(Slopes((3, 3), (1, -1)), here).item() == pytest.approx(math.sqrt(2))
    assert globe.weakest_change(Slopes((2, 4), (1, 2)), here).item() == pytest.approx(0, abs=1e-9)


def test_vehicles_cross_the_pole_and_are_not_lost(globe, field) -> None:
    start, target = torch.tensor([[89.9, 20.0]]).double(), torch.tensor([[86.0, -160.0]]).double()
    env = globe.GlobeEnv(
        Scenario(region=globe.EARTH, margin_deg=0, field=field, tasks=Tasks(start, target)), num_envs=1, seed=0
    )
    after = env.step(env.reset().set("action", torch.tensor([[50.0, 0.0]])))["next"]
    assert after["position"][0].tolist() == pytest.approx([89.652, -160.0], abs=1e-3)  # a degree is 111.7 km there
    assert not after["terminated"].item()
    assert env.observation_spec.is_in(env.reset())


def test_properties_of_a_task(globe, field) -> None:
    """The path from 62 to 66 degrees south along 135.3 degrees east leads by the dip pole, where B_H vanishes."""
    start, target = (
        torch.tensor([[-62.0, 135.3], [0.0, 10.0]]).double(),
        torch.tensor([[-66.0, 135.3], [0, 14]]).double(),
    )
    known = globe.properties(field, Tasks(start, target))
    assert known["latitude"].tolist() == [62, 0]
    assert known["intensity_nt"][0] < 500
    assert known["intensity_nt"][1] > 25_000


def test_table_has_every_task_once_in_each_group(globe) -> None:
    success = torch.tensor([True, False, True, True])
    measures = {"success": success, "spl": torch.tensor([1.0, 0.0, 0.9, 0.7]), "steps": torch.tensor([8, 50, 10, 12])}
    known = {
        "latitude": torch.tensor([0.0, 90.0, 30.0, 74.0]),
        "intensity_nt": torch.tensor([30e3, 0.0, 8e3, 7e3]),
        "weakest": torch.tensor([2.0, 0.01, 0.5, 0.05]),
    }
    lines = globe.table((measures, measures), known, (0.05, 0.05, 5.0)).splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]
    assert lines[0] == "| tasks | number | perfect sensors | 0.05°, 0.05°, 5 nT |"
    assert rows[0] == ["all", "4", *["75.0 / 65.0 / 10.0"] * 2]
    assert rows[1] == ["latitude of the start up to 30°", "1", *["100.0 / 100.0 / 8.0"] * 2]
    for group, size in (("latitude", 4), ("smallest", 3), ("weakest", 3)):
        band = [row for row in rows[1:] if row[0].startswith(group)]
        assert (len(band), sum(int(row[1]) for row in band)) == (size, 4), band
    assert rows[-3] == ["weakest change on the way below 0.05", "1", *["0.0 / 0.0 / —"] * 2]


def test_globe_flies_tasks_in_parts_and_writes_both_files(globe, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(globe, "CHUNK", 3)
    table, figure = tmp_path / "new" / "globe.md", tmp_path / "globe.png"
    globe.globe(globe.Config("geodesic", tasks=8, table=table, figure=figure))
    assert "| all | 8 | 100.0 / 100.0 /" in table.read_text()  # noise does not reach who knows positions
    assert Image.open(figure).size == (1080, 588)


def test_parts_have_headings_of_their_own(globe, field, monkeypatch) -> None:
    seen = []

    def watch(env, _) -> TensorDict:
        seen.append(env.reset()["heading"])
        raise InterruptedError

    tasks = globe.task_set(4, 0, globe.EARTH)
    monkeypatch.setattr(globe, "evaluation_rollout", watch)
    for first in (0, 2):
        monkeypatch.setattr(globe, "range", lambda *_, first=first: [first], raising=False)
        monkeypatch.setattr(globe, "CHUNK", 2)
        with pytest.raises(InterruptedError):
            globe.flown(globe.Config("secant"), field, tasks, (0.0, 0.0, 0.0), None)
    assert not torch.equal(*seen)


def test_map_shows_the_dip_poles_and_the_failures(globe, field) -> None:
    tasks = Tasks(torch.tensor([[10.0, 20.0], [50.0, -60.0]]), torch.tensor([[10.0, 24.0], [50.0, -64.0]]))
    measures = {"success": torch.tensor([True, False]), "spl": torch.tensor([0.9, 0.0])}
    axes = globe.globe_map(field, tasks, measures).axes[0]
    lines = {line.get_label(): np.degrees(np.stack(line.get_data(), -1)) for line in axes.lines}
    (south_east, south), (north_east, north) = lines["dip pole"]  # NOAA, 2025: 63.85 S 135.08 E, 85.76 N 139.30 E
    assert (south, south_east) == pytest.approx((-63.85, 135.08), abs=1)
    assert north == pytest.approx(85.76, abs=0.6)
    assert north_east == pytest.approx(139.3, abs=6)
    assert lines["not arrived"] == pytest.approx(np.array([[-60.0, 50.0]]))
    assert axes.collections[-1].get_array() == pytest.approx(np.array([90.0]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"navigator": "dowsing"}, "unknown navigator 'dowsing'"),
        ({"tasks": 0}, "num_tasks must be a whole number from 1 on, got 0"),
        ({"noise": (0.0, -1.0, 0.0)}, "noise must be .*-1"),
        ({"date": "2031-01-01"}, "outside IGRF-14"),
    ],
)
def test_wrong_settings(globe, change: dict[str, object], message: str, tmp_path: Path) -> None:
    files = {"table": tmp_path / "globe.md", "figure": tmp_path / "globe.png"}
    with pytest.raises(UsageError, match=message):
        globe.globe(globe.Config(**({"tasks": 2, "navigator": "geodesic"} | files | change)))
    assert not any(file.exists() for file in files.values())
