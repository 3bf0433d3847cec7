"""The command, and the story of docs/logs.md from a raw log to a replay: its commands run as they are written."""

from __future__ import annotations

import re
import runpy
import shlex
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from support.logs import ELEMENTS, ulog

from magrl.vehicle.logs import Calibration
from magrl.vehicle.logs.__main__ import main

ROOT = Path(__file__).parent.parent.parent
PAGE = (ROOT / "docs" / "logs.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"```sh\n(.*?)```", PAGE[PAGE.index("## From a raw log to a replay") :], re.DOTALL)[0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Folder with the logs of the example."""
    made = tmp_path_factory.mktemp("raw")
    runpy.run_path(str(ROOT / "docs" / "examples" / "make_raw_log.py"))["write"](made / "raw")
    return made


def test_the_story_of_the_page(folder: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(folder)
    first, *commands = COMMANDS.splitlines()
    assert first == "python docs/examples/make_raw_log.py raw"
    for line in commands:
        _, *words = shlex.split(line, comments=True)
        name = words.pop(0)
        name, run = (words.pop(0), runpy.run_module) if name == "-m" else (str(ROOT / name), runpy.run_path)
        monkeypatch.setattr(sys, "argv", [name, *words])
        monkeypatch.delitem(sys.modules, f"{name}.__main__", raising=False)
        run(name, run_name="__main__")
    said = capsys.readouterr().out
    assert "15 readings, legs of 19.8 km" in said
    assert "warning" not in said
    assert f"replay: {commands[-1]}" in said, "the page has the command that is printed"
    table = pd.read_csv(folder / "runs" / "replay_log" / "log.csv")
    assert table["miss_km"].iloc[-1] < 30


def test_a_log_of_px4_agrees_with_igrf(tmp_path: Path, capsys) -> None:
    (tmp_path / "log.ulg").write_bytes(ulog({"vehicle_magnetometer:0": 1.0, "sensor_mag:0": 0.5}))
    main([str(tmp_path / "log.ulg"), "--sensor", "vehicle_magnetometer"])
    said = capsys.readouterr().out
    assert "first reading: D {:.2f} deg, I {:.2f} deg, B_H {:.0f} nT".format(*ELEMENTS) in said
    assert "state sensor for another one: sensor_mag" in said
    assert "warning" not in said


def test_a_calibration_is_needed_and_is_used(folder: Path, capsys) -> None:
    """On the first five hours."""
    rows = (folder / "raw" / "way.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    way, swing, quay = folder / "way.csv", str(folder / "raw" / "swing.csv"), folder / "new" / "quay.json"
    way.write_text("".join(rows[: 5 * 3600 + 1]), encoding="utf-8")
    for north in (), ("--north", "magnetic"):
        main([str(way), *north, "--out", str(folder / "raw.csv")])
    said = capsys.readouterr().out
    assert re.search(r"warning: 5 of 5 readings do not fit IGRF.*: no calibration, iron near the sensor, or a", said)
    assert "--north magnetic --noise 0 0.00" in said
    main([swing, "--calibrate", str(quay), "--here", "62.47", "6.15", "--date", "2026-07-01"])
    assert Calibration.load(quay).date == "2026-07-01"
    main([str(way), "--calibration", str(quay), "--every-km", "10", "--out", str(folder / "half.csv")])
    assert "warning" not in capsys.readouterr().out
    table = pd.read_csv(folder / "half.csv")
    assert len(table) == 10
    assert np.allclose(table["distance"][1:5], 10, atol=0.1)
    way.write_text("".join(rows[:200]), encoding="utf-8")
    main([str(way)])
    assert "one reading: no file is written" in capsys.readouterr().out


def test_a_compass_calibrates_by_the_length_alone(folder: Path, capsys) -> None:
    """A heading that the magnetometer made would hide its iron."""
    swing = str(folder / "raw" / "swing.csv")
    with pytest.raises(SystemExit, match="2"):
        main([swing, "--calibrate", str(folder / "no.json"), "--north", "model"])
    assert "too few directions for a fit without attitude" in capsys.readouterr().err
