"""The tables of navigators in random boxes, and of the length of the probing legs."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from magrl.envs import Region
from magrl.training import UsageError

TABLES = Path(__file__).parent.parent.parent / "recipes" / "tables"


def loaded(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, TABLES / f"{name}.py")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)  # dataclasses look there
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def boxes() -> ModuleType:
    return loaded("random_boxes")


@pytest.fixture(scope="module")
def probe_sweep() -> ModuleType:
    return loaded("probe_sweep")


def test_boxes_follow_the_seed_and_lie_where_they_should(boxes) -> None:
    regions = [scenario.region for scenario in boxes.random_boxes(4, seed=1)]
    assert regions == [scenario.region for scenario in boxes.random_boxes(5, seed=1)][:4]
    assert regions != [scenario.region for scenario in boxes.random_boxes(4, seed=2)]
    assert regions[0][0] == Region((-51, -41), (-99, -89))
    for region, *_ in regions:
        (south, north), (west, east) = region.latitude, region.longitude
        assert (north - south, east - west) == (10, 10)
        assert max(abs(south), abs(north)) <= 60


def test_a_box_that_cannot_be_used_is_drawn_again(boxes, monkeypatch) -> None:
    usable = boxes.Scenario.build_field
    refused = []

    def build_field(scenario, *args):
        if not refused:
            refused.append(scenario.region)
            raise ValueError("a declination that jumps")
        return usable(scenario, *args)

    expected = [scenario.region for scenario in boxes.random_boxes(3, seed=1)]
    monkeypatch.setattr(boxes.Scenario, "build_field", build_field)
    assert [scenario.region for scenario in boxes.random_boxes(2, seed=1)] == expected[1:]
    assert refused == expected[:1]


def test_table_has_a_row_for_each_box(boxes, monkeypatch) -> None:
    measured = iter([[(100.0, 99.0)] * 5, [(90.0, 80.0)] * 5, [(70.0, 60.0)] * 5])
    monkeypatch.setattr(boxes, "measure", lambda *_: next(measured))
    lines = boxes.table(boxes.Config(boxes=2, tasks=10)).splitlines()
    assert lines[0].startswith("| box | parallel, SR / SPL | secant, SR / SPL | geodesic, SR / SPL |")
    assert lines[2].startswith("| 51°S to 41°S, 99°W to 89°W | 100.0 / 99.0 |")
    assert lines[4].startswith("| **mean** | 95.0 / 89.5 |")
    assert lines[5].startswith("| **lowest** | 90.0 / 80.0 |")
    assert lines[6].startswith("| 10°S to 0°, 175°E to 185°E | 70.0 / 60.0 |")


def test_navigators_are_flown_on_the_same_tasks(boxes) -> None:
    scenario, config = boxes.random_boxes(1, seed=1)[0], boxes.Config(tasks=5)
    results = boxes.measure(scenario, config)
    assert len(results) == len(boxes.NAMES)
    geodesic = results[boxes.NAMES.index("geodesic")]
    assert geodesic == pytest.approx((100.0, 100.0), abs=1e-6)
    assert results == boxes.measure(scenario, config)


def test_sweep_of_the_probes_has_the_chosen_length_last(probe_sweep, monkeypatch) -> None:
    monkeypatch.setattr(probe_sweep, "LENGTHS_KM", (1.0, 30.0))
    lines = probe_sweep.sweep(probe_sweep.Config(tasks=4)).splitlines()
    assert lines[0].startswith("| noise: D °, I °, B_H nT | 1 km | 30 km | chosen")
    chosen = [line.split("|")[-2].split(":")[0].strip() for line in lines[2:]]
    assert chosen == ["0.5 km", "6.1 km", "11.2 km", "17.7 km"]
    success, spl, steps = (float(x) for x in lines[2].split("|")[-2].partition("km: ")[2].split("/"))
    assert (success, spl > 98, steps < 12) == (100.0, True, True)


@pytest.mark.parametrize(("option", "value"), [("boxes", 0), ("tasks", 0), ("seed", -1), ("zeta", 5.0)])
def test_bad_settings_of_the_boxes_are_refused(boxes, option: str, value: float) -> None:
    with pytest.raises(UsageError, match=str(value)):
        boxes.table(boxes.Config(**({"boxes": 1, "tasks": 2} | {option: value})))


@pytest.mark.parametrize(("option", "value"), [("tasks", 0), ("zeta", 5.0)])
def test_bad_settings_of_the_sweep_are_refused(probe_sweep, option: str, value: float) -> None:
    with pytest.raises(UsageError, match=str(value)):
        probe_sweep.sweep(probe_sweep.Config(**({"tasks": 2} | {option: value})))
