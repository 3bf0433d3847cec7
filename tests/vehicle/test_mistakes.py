"""Mistakes of users in one table: each is refused at its doors, by a message that names the value and the remedy."""

from __future__ import annotations

import gc
import itertools
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from magrl.navigators import Geodesic
from magrl.sensor_std import SensorStd
from magrl.vehicle.autopilot import Loop
from magrl.vehicle.autopilot.__main__ import main as autopilot
from magrl.vehicle.logs import axes_of_elements, calibrate, read_log, read_readings
from magrl.vehicle.logs.__main__ import main as logs
from magrl.vehicle.logs.conventions import check_intensity
from magrl.vehicle.onboard import Onboard

TARGET, HERE, NOISE = (-11.6, 75.4, 13240.0), (3.5, 73.0, 15000.0), (0.02, 0.02, 2.0)
BERGEN, THERE, DATE = (60.4, 5.3), (2.84, 73.05, 15003.0), {"date": "2026-06-30"}
UPWARD = {"target_elements": (2.84, -73.05, 15003.0), "target_std": (0.5, 0.1, 20.0)}
ATTITUDE = torch.cartesian_prod(*(torch.linspace(-40, 40, 8).double(),) * 2, torch.arange(0, 360, 20).double())
AXES = axes_of_elements(torch.tensor(HERE).double(), ATTITUDE)
CSV, ROW = "time_s,mag_x_nT,mag_y_nT,mag_z_nT,heading_true_deg", "0,15000,1000,48000,350"
READINGS = "D,I,B_H,heading,distance"


def start(target: Any = TARGET, here: Any = None, navigator: Any = "anywhere", **known: Any) -> Onboard:
    vehicle = Onboard(navigator, sensor_std=NOISE)
    vehicle.start(target, here, **known)
    return vehicle


def first(*values: Any) -> Any:
    return start().step(*values)


def later(*values: Any) -> Any:
    vehicle = start()
    vehicle.step(*HERE, 290.0)
    return vehicle.step(*values)


def swing(change: Callable[[Any], Any] = lambda axes: axes, here: Any = HERE, **options: Any) -> Any:
    axes = change(AXES)
    return calibrate(axes, here, attitude_deg=ATTITUDE[: len(axes)], **options)


def written(*lines: str) -> Path:
    Path("log.csv").write_text("\n".join(lines), encoding="utf-8")
    return Path("log.csv")


def log(*lines: str) -> Any:
    return read_log(written(*lines))


def readings(*lines: str, **columns: str) -> Any:
    return read_readings(written(*lines), {name: name for name in READINGS.split(",")} | columns, "time")


ELEMENTS = {
    (3.5, 73.0, 15.0): "looks like microtesla, and nanotesla are expected",
    (350.5, 73.0, 15000.0): r"declination \[deg\] must be from -180 up to 180, got 350.5: give -9.5",
    (0.061, 1.274, 15000.0): "the inclination looks like radians, and degrees are expected",
    (3.3, -7.7, 44600.0): "44600 at an inclination of -7.7 deg is not possible on the Earth",
    (3.5, math.nan, 15000.0): "finite number",
}
"""Elements that are not possible, at each door that takes elements."""
DOORS: dict[str, Callable[[Any], Any]] = {
    "target": start,
    "start": lambda elements: start(TARGET, elements),
    "first step": lambda elements: first(*elements, 0.0),
    "later step": lambda elements: later(*elements, 0.0, 20.0),
    "swing": lambda elements: swing(here=elements),
}


def test_elements_that_are_not_possible() -> None:
    for door, (elements, message) in itertools.product(DOORS.values(), ELEMENTS.items()):
        with pytest.raises(ValueError, match=message):
            door(elements)


MISTAKES: list[tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any], str]] = [
    (Onboard, ("dowsing",), {}, "unknown navigator 'dowsing': choose anywhere"),
    (Onboard, (Geodesic(),), {}, "Geodesic reads position, target_position, which a vehicle does not know"),
    (Onboard, (), {"radius": 5.0}, "unknown key 'radius': choose from max_move_km"),
    (Onboard, (), {"sensor_std": (0.02, 0.02, 0.002)}, r"sensor_std.noise: 0.002 nT .*: it looks like microtesla"),
    (Onboard, (), {"sensor_std": SensorStd(bias=(0.1, 0.1, 0.02))}, "sensor_std.bias: 0.02 nT .* give 0 for a perfect"),
    (Onboard, (), {"sensor_std": (1e5, 0.1, 1.0)}, "sensor_std.noise must be at most 10000, as in an outage"),
    (lambda: Loop(Onboard("secant")), (), {}, "call start before it is steered"),
    (start, ((-11.6, 75.4),), {}, "target .* is a place, which needs a model of the Earth: give the date"),
    (start, ("x",), {}, "target"),
    (start, ((-11.6, 88.5, 1500.0),), {}, "the target: B_H 1500 nT is out of the range"),
    (start, (TARGET, (60.4, 5.3)), {}, "start .* is a place, which needs a model of the Earth: give the date"),
    (start, (TARGET, (60.4, 5.3)), DATE | {"model": None}, "start .* is a place, which needs a model"),
    (start, (TARGET, (60.4,)), DATE, "start must be D, I and B_H, or latitude and longitude"),
    (start, (TARGET, (95.0, 5.3)), DATE, "latitude must be a finite number from -90 up to 90, got 95"),
    (start, (TARGET, (60.4, 5.3)), DATE | {"start_km": 200.0}, "start_km must be less than or equal to 100"),
    (start, (TARGET, (60.4, 5.3)), {"date": "2031-06-30"}, "IGRF-14 is valid to 2030, not in 2031.5: give a newer one"),
    (start, (TARGET, (60.4, 5.3)), DATE | {"model": "IGRF-13"}, "IGRF-13"),
    (start, (TARGET, (60.4, 5.3)), DATE | {"model": "WMM"}, "WMM"),
    (start, (TARGET, HERE), {"model": "IGRF-13"}, "model 'IGRF-13' needs the date of the flight"),
    (start, (TARGET, HERE), {"date": "tomorrow", "model": None}, "tomorrow"),
    (start, (TARGET, HERE), {"start_std": (0.1, -1.0, 5.0)}, "start_std must be a finite number from 0 on, got -1"),
    (start, (TARGET,), {"target_elements": TARGET}, "target_elements .* need the place of the target"),
    (start, (BERGEN,), DATE | {"target_elements": THERE}, r"target_elements need target_std, .* such as \(0\.2"),
    (start, (BERGEN,), DATE | {"target_std": NOISE}, "target_std .* needs the target_elements"),
    (start, (BERGEN,), DATE | UPWARD, "target_elements .* do not fit the target, .*: it fits with -I"),
    (
        start,
        (BERGEN,),
        DATE | {"target_elements": (9.0, 65.0, 20000.0), "target_std": NOISE},
        "check elements and place",
    ),
    (first, (*HERE, 0.0, 1.0), {}, "distance must be 0 in the first step"),
    (first, (3.3, -7.7, 40000.0, 0.0), {}, "at least 3676 km from the target, and the longest distance is 2500 km"),
    (first, (3.5, 88.5, 1500.0, 0.0), {}, "B_H 1500 nT is out of the range of the navigator, 2000 to inf nT"),
    (first, (3.5, None, 15000.0, 0.0), {}, r"inclination \[deg\] must be a finite number .*, got None"),
    (later, (*HERE, 290.0, 30000.0), {}, "distance 30000 km is longer than the longest leg of this vehicle, 50 km"),
    (later, (3.5, 73.0, 21000.0, 290.0, 40.0), {}, r"B_H changed from 15000 to 21000 nT over 40 km.*at most 44"),
    (later, (40.0, 73.0, 15000.0, 290.0, 20.0), {}, "declination changed from 3.5 to 40 deg over 20 km"),
    (log, ("",), {}, "cannot read .*log.csv: the table has no row"),
    (log, (CSV, ROW, f"-1{ROW[1:]}"), {}, "time runs backward from row 1 to 2, from 0 to -1: sort the rows"),
    (log, (CSV, f"1782813600000{ROW[1:]}"), {}, r"time 1\.78.* is not from .* s: check it and its unit, as in time_ms"),
    (log, (CSV, "0,0.15,0,0.48,0"), {}, r"intensity is 0\.50.*, which looks like gauss: name the columns mag_x_gauss"),
    (log, (CSV, "0,90,0,-4095,0"), {}, "is 4095.*, where about 48000 nT are expected: scale raw counts"),
    (check_intensity, (48e9,), {}, "the topic of the field is in microtesla, where ROS states tesla: convert it"),
    (log, (" Format                 IAGA-2002", " DATE"), {}, "log.csv is a file of IAGA-2002, .*: write a CSV"),
    (log, ("dbd_label:    DBD", "x"), {}, "log.csv is a log of a Slocum glider, which is not read: write a CSV file"),
    (log, ("H Product:Blackbox flight data recorder", "x"), {}, "is a blackbox of INAV or .*: write a CSV file"),
    (log, ("time,x,y,z,x", "0,1,1,1,1"), {}, "2 columns have the name 'x': keep one of them"),
    (readings, (f"{READINGS},D", *["1,70,15000,0,0,1"] * 2), {}, "2 columns have the name 'D': keep one of them"),
    (log, (CSV, "noon,0,0,5e4,0"), {}, "row 1, time_s: 'noon' is no time such as"),
    (log, (CSV, "0,x,0,5e4,0"), {}, "row 1, mag_x_nT: 'x' is not a number"),
    (log, ("time,x,bx,y", "0,1,1,1"), {}, "'x' and 'bx' are both the x: keep one of them"),
    (log, ("time,x,y,z,speed", "0,1,1,1,1"), {}, "column 'speed' has no unit: name it speed_m_s"),
    (log, ("clock,x,y,z", "0,0,0,5e4"), {}, "no column is the time, among 'clock, x, y, z': name it time"),
    (log, ("time,heading", "0,5"), {}, "no x of the magnetometer is among heading: log it, in CSV as mag_x_nT"),
    (log, ('{"time": 0, "x": 1}',), {}, "a log is a file of CSV, PX4, .* or a folder of ROS 2 that exists, got"),
    (read_log, ("none.csv",), {}, "a log is a file of CSV, .* that exists, got 'none.csv'"),
    (read_readings, ("none.csv", {}), {}, "cannot read none.csv: .*No such file"),
    (readings, (READINGS, "1,70,15000,0,0"), {}, "cannot read log.csv: it must hold at least two rows"),
    (readings, (READINGS, *["1,70,x,0,0"] * 2), {}, "row 1, B_H: 'x' is not a number"),
    (readings, (READINGS, *["1,70,15000,0,-1"] * 2), {}, "distance -1 is not from 0 to 40000 km"),
    (readings, (READINGS, *["1,70,15000,0,0"] * 2), {"I": "dip"}, "no column is 'dip': name the column of I, one of"),
    (swing, (lambda m: m[:50],), {}, r"at least 100 samples, got \(50, 3\)"),
    (swing, (lambda m: m.index_fill(0, torch.tensor([7]), math.nan),), {}, "sample 8 is .*leave out samples"),
    (swing, (lambda m: m / 1e5,), {}, "intensity is 0.51.*, which looks like gauss"),
    (swing, (lambda m: m / 264,), {}, "is 194.*, where about 5[0-9]* nT are expected: scale raw counts to nanotesla"),
    (swing, (lambda m: 5e4 * m / m.norm(dim=-1, keepdim=True),), {}, "the same length: log the field as measured"),
    (swing, (), {"alignment_deg": -1.0}, "alignment_deg must be a finite number above 0, got -1"),
    (swing, (), {"here": (1.0,)}, "here must be D, I and B_H, or latitude and longitude"),
    (swing, (), {"here": (60.4, 5.3)}, "here .*needs? .*date"),
]
"""Doors, arguments, and messages."""


@pytest.mark.parametrize("row", range(len(MISTAKES)))
def test_a_mistake_is_named(row: int, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    door, arguments, options, message = MISTAKES[row]
    with pytest.raises(ValueError, match=message):
        door(*arguments, **options)


BAD: tuple[Any, ...] = ("73", True, np.bool_(True), [73.0], torch.tensor([73.0]), math.nan, -math.inf, 1e9, -1e9)
"""Of no number's type, not finite, or beyond what any vehicle has."""
OPTIONS = {"max_move_km": 50.0, "max_turn_rad": 1.0, "max_steps": 9, "radius_km": 9.0, "confidence": 0.5}
OPTIONS |= {"range_km": 400.0, "north": "true", "sensor_std": NOISE}
STEP = {"declination": 3.5, "inclination": 73.0, "horizontal_intensity": 15e3, "heading": 290.0, "distance": 0.0}


def test_options_of_a_wrong_type_or_out_of_range_are_named() -> None:
    Onboard("kalman", **OPTIONS)
    for name in OPTIONS:
        for value in BAD[: -2 if name not in ("max_turn_rad", "confidence", "north", "sensor_std") else None]:
            with pytest.raises(ValueError, match=name):
                Onboard("kalman", **OPTIONS | {name: value})


def test_a_refused_step_changes_nothing() -> None:
    """Each argument of a first and of a later step."""
    vehicle, other = start(navigator="kalman"), start(navigator="kalman")
    for right in (STEP, STEP | {"distance": 0.5, "declination": 3.49}):
        for name, value in itertools.product(STEP, BAD):
            with pytest.raises(ValueError, match=name):
                vehicle.step(**right | {name: value})
        assert vehicle.step(**right) == other.step(**right)


PLACE = ["--target", "-11.6", "75.4", "13240", "--navigator", "secant", "--noise", "0.05", "0.05", "5"]
ADDRESSES = ("udp:99999", "/dev/none,4800", "udpin:0.0.0.0:99999", "/dev/none,fast", "")
COMMANDS: list[tuple[Callable[..., None], list[str], str]] = [
    *((autopilot, [address, *PLACE], "") for address in ADDRESSES),
    *((autopilot, [address, "--nmea", *PLACE], "") for address in ADDRESSES),
    (autopilot, ["udp:0", "--nmea", "--cruise", "5", *PLACE], "an option has no effect on this link"),
    (autopilot, ["udp:0", "--level", *PLACE], "an option has no effect on this link"),
    (autopilot, ["udp:0", "--altitude", "1", *PLACE], "--altitude is for the model of the Earth, which needs --date"),
    (logs, ["way.csv", "--calibration", "none.json"], "none.json is not a calibration"),
    (logs, ["none.txt"], "a log is a file of CSV"),
    (logs, ["way.csv", "--calibrate", "quay.json"], "the log has no position: state the place of the swing by --here"),
    (logs, ["way.csv"], "the log has neither distances nor speeds nor positions"),
]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # pymavlink leaves a socket open
def test_a_wrong_command_is_refused_in_one_line(capsys, tmp_path: Path, monkeypatch) -> None:
    pytest.importorskip("pymavlink")
    monkeypatch.chdir(tmp_path)
    written(CSV, ROW).rename("way.csv")
    for main, words, message in COMMANDS:
        with pytest.raises(SystemExit, match="2"):
            main([*words, "--out", "x"])
        (line,) = capsys.readouterr().err.splitlines()
        assert message in line
    gc.collect()
    assert not Path("x").exists()
