"""Mistakes of users in one table: each is refused at its doors, by a message that names the value and the remedy."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from magrl.navigators import Geodesic
from magrl.onboard import Onboard
from magrl.sensor_std import SensorStd

TARGET, HERE, NOISE = (-11.6, 75.4, 13240.0), (3.5, 73.0, 15000.0), (0.02, 0.02, 2.0)
BERGEN, THERE, DATE = (60.4, 5.3), (2.84, 73.05, 15003.0), {"date": "2026-06-30"}
UPWARD = {"target_elements": (2.84, -73.05, 15003.0), "target_std": (0.5, 0.1, 20.0)}


def start(target: Any = TARGET, here: Any = None, navigator: Any = "anywhere", **known: Any) -> Onboard:
    vehicle = Onboard(navigator, sensor_std=NOISE)
    known = {"target_std": (0.0, 0.0, 0.0)} | known if len(target) == 3 else known
    vehicle.start(target, here, **known)
    return vehicle


def first(*values: Any) -> Any:
    return start().step(*values)


def later(*values: Any, **errors: float) -> Any:
    vehicle = start()
    vehicle.step(*HERE, 290.0)
    return vehicle.step(*values, **errors)


def fix(*values: float) -> None:
    start(BERGEN, BERGEN, "kalman", **DATE).fix(*values)


def timed(hours: float, distance: float) -> Any:
    vehicle = Onboard("kalman", sensor_std=NOISE, speed_km_h=18.0)
    vehicle.start(BERGEN, BERGEN, **DATE)
    vehicle.step(*THERE, 290.0)
    return vehicle.step(*THERE, 290.0, distance, hours=hours)


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
}


def test_elements_that_are_not_possible() -> None:
    for door, (elements, message) in itertools.product(DOORS.values(), ELEMENTS.items()):
        with pytest.raises(ValueError, match=message):
            door(elements)


UNSTATED = r"elements of a target need target_std, .* such as \(0\.1, 0\.05, 30\), or \(0, 0, 0\)"
MISTAKES: list[tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any], str]] = [
    (Onboard, ("dowsing",), {}, "unknown navigator 'dowsing': choose anywhere"),
    (Onboard, (Geodesic(),), {}, "Geodesic reads position, target_position, which a vehicle does not know"),
    (Onboard, (), {"radius": 5.0}, "unknown key 'radius': choose from max_steps"),
    (Onboard, (), {"sensor_std": (0.02, 0.02, 0.002)}, r"sensor_std.noise: 0.002 nT .*: it looks like microtesla"),
    (Onboard, (), {"sensor_std": SensorStd(bias=(0.1, 0.1, 0.02))}, "sensor_std.bias: 0.02 nT .* give 0 for a perfect"),
    (Onboard, (), {"sensor_std": (1e5, 0.1, 1.0)}, "sensor_std.noise must be at most 10000, as in an outage"),
    (start, ((-11.6, 75.4),), {}, "target .* is a place, which needs a model of the Earth: give the date"),
    (start, ("x",), {}, "target"),
    (start, ((-11.6, 88.5, 1500.0),), {}, "the target: B_H 1500 nT is out of the range"),
    (start, (TARGET, (60.4, 5.3)), {}, "start .* is a place, which needs a model of the Earth: give the date"),
    (start, (TARGET, (60.4, 5.3)), DATE | {"model": None}, "start .* is a place, which needs a model"),
    (start, (TARGET, (60.4,)), DATE, "start must be D, I and B_H, or latitude and longitude"),
    (start, (TARGET, (95.0, 5.3)), DATE, "latitude must be a finite number from -90 up to 90, got 95"),
    (start, (TARGET, (60.4, 5.3)), DATE | {"start_km": 101.0}, "start_km must be less than or equal to 100"),
    (start, (BERGEN, BERGEN), DATE | {"target_km": 1e18}, "target_km must be less than or equal to 100"),
    (start, (TARGET, (60.4, 5.3)), {"date": "2031-06-30"}, "IGRF-14 is valid to 2030, not in 2031.5: give a newer one"),
    (start, (TARGET, (60.4, 5.3)), DATE | {"model": "IGRF-13"}, "IGRF-13 is valid to 2025, not in 2026.5"),
    (start, (TARGET, (60.4, 5.3)), DATE | {"model": "WMM"}, "model 'WMM' must be IGRF-13, IGRF-14"),
    (start, (TARGET, (60.4, 5.3)), DATE | {"model": "IGRF-2030"}, "a year from 1900 to 2026"),
    (start, (TARGET, HERE), {"model": "IGRF-13"}, "model 'IGRF-13' needs the date of the flight"),
    (start, (TARGET, HERE), {"date": "tomorrow", "model": None}, "tomorrow"),
    (start, (TARGET, HERE), {"start_std": (0.1, -1.0, 5.0)}, "start_std must be a finite number from 0 on, got -1"),
    (start, (TARGET,), {"target_elements": TARGET}, "target_elements .* need the place of the target"),
    *((start, (TARGET, here), {**DATE, "target_std": None}, UNSTATED) for here in (None, HERE, BERGEN)),
    (start, (BERGEN,), DATE | {"target_elements": THERE}, UNSTATED),
    *(
        (door, (5,), {}, "target.* must be")
        for door in (Onboard("kalman").start, Onboard("kalman", north="magnetic").start)
    ),
    (start, (BERGEN,), DATE | {"target_std": NOISE}, "target_std .* needs the target_elements"),
    (start, (BERGEN,), DATE | UPWARD, "target_elements .* do not fit the target, .*: it fits with -I"),
    (
        start,
        (BERGEN,),
        DATE | {"target_elements": (9.0, 65.0, 20000.0), "target_std": NOISE},
        "check elements and place",
    ),
    (first, (*HERE, 0.0, 1.0), {}, "distance and hours must be 0 in the first step, got 1 and None"),
    (first, (3.3, -7.7, 40000.0, 0.0), {}, "at least 3676 km from the target, and the longest distance is 2500 km"),
    (first, (3.5, 88.5, 1500.0, 0.0), {}, "B_H 1500 nT is out of the range of the navigator, 2000 to inf nT"),
    (first, (3.5, None, 15000.0, 0.0), {}, r"inclination \[deg\] must be a finite number .*, got None"),
    (later, (*HERE, 290.0, 30000.0), {}, "distance 30000 km is longer than the longest leg of this vehicle, 50 km"),
    (later, (3.5, 73.0, 21000.0, 290.0, 40.0), {}, r"B_H changed from 15000 to 21000 nT over 40 km.*at most 44"),
    (later, (40.0, 73.0, 15000.0, 290.0, 20.0), {}, "declination changed from 3.5 to 40 deg over 20 km"),
    (later, (*HERE, 290.0, 20.0), {"distance_std": 1e5}, "distance_std must be less than or equal to 100, got 100000"),
    (later, (*HERE, 290.0, 40.0), {"distance_std": 60.0}, "distance_std 60 km is more than a leg of 40 km allows, 41"),
    (
        later,
        (*HERE, 290.0),
        {"hours": 2.0},
        "hours 2 need the option speed_km_h, at which drift and wander_km are stated",
    ),
    (
        timed,
        (7200.0, 0.0),
        {},
        "hours 7200 do not fit .* drift of 3888 km, of at most 100 km: give hours since the last",
    ),
    (timed, (0.0, 40.0), {}, "hours 0 do not fit a leg of 40 km"),
    (timed, (-1.0, 0.0), {}, "hours must be greater than or equal to 0, got -1"),
    (later, (*HERE, 290.0), {"altitude_km": 3000.0}, "altitude_km must be less than or equal to 1000, got 3000"),
    (fix, (60.4, 4.6, 1e18), {}, "std_km must be less than or equal to 100, got 1e[+]18"),
]
"""Doors, arguments, and messages."""


@pytest.mark.parametrize("row", range(len(MISTAKES)))
def test_a_mistake_is_named(row: int) -> None:
    door, arguments, options, message = MISTAKES[row]
    with pytest.raises(ValueError, match=message):
        door(*arguments, **options)


BAD: tuple[Any, ...] = ("73", True, np.bool_(True), [73.0], torch.tensor([73.0]), math.nan, -math.inf, 1e9, -1e9)
"""Of no number's type, not finite, or beyond what any vehicle has."""
OPTIONS = {"max_leg_km": 50.0, "max_turn_deg": 60.0, "max_steps": 9, "radius_km": 9.0, "confidence": 0.5}
OPTIONS |= {"range_km": 400.0, "north": "true", "sensor_std": NOISE}
STEP = {"declination": 3.5, "inclination": 73.0, "horizontal_intensity": 15e3, "heading": 290.0, "distance": 0.0}


def test_options_of_a_wrong_type_or_out_of_range_are_named() -> None:
    Onboard("kalman", **OPTIONS)
    for name in OPTIONS:
        for value in BAD[: -2 if name not in ("max_turn_deg", "confidence", "north", "sensor_std") else None]:
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
