"""What hours and altitudes do to a flight, beside a simulator that shares no physics with the library: places by
geographiclib, the field by ppigrf."""

from __future__ import annotations

import json
import math
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geographiclib.geodesic import Geodesic
from ppigrf import igrf
from ppigrf.ppigrf import shc_fn_igrf14

from magrl.onboard import Command, Onboard

BERGEN, DATE, SPEED = (60.4, 5.3), "2026-06-30", 18.0
NOISE = (0.02, 0.02, 2.0)
Place = tuple[float, float]


def moved(place: Place, north_km: float, east_km: float) -> Place:
    course, distance = math.degrees(math.atan2(east_km, north_km)), math.hypot(north_km, east_km)
    there = Geodesic.WGS84.Direct(*place, course, 1000 * distance)
    return there["lat2"], there["lon2"]


def apart(place: Place, other: Place) -> np.ndarray:
    """From a place to another, northward and eastward [km]."""
    found = Geodesic.WGS84.Inverse(*place, *other)
    course = math.radians(found["azi1"])
    return found["s12"] / 1000 * np.array((math.cos(course), math.sin(course)))


def elements(place: Place, altitude_km: float = 0.0) -> tuple[float, float, float]:
    east, north, up = (
        part.item()
        for part in igrf(place[1], place[0], altitude_km, datetime.fromisoformat(DATE), coeff_fn=shc_fn_igrf14)
    )
    level = math.hypot(north, east)
    return math.degrees(math.atan2(east, north)), math.degrees(math.atan2(-up, level)), level


def begun(target: Any = (64.1, -21.9), start: Any = BERGEN, known: Any = None, **options: Any) -> Onboard:
    vehicle = Onboard("kalman", **{"sensor_std": NOISE, "confidence": 0.9, "speed_km_h": SPEED} | options)
    vehicle.start(target, start, date=DATE, **known or {})
    return vehicle


def variances(command: Command) -> list[float]:
    """Of the place, northward and eastward [km^2]."""
    assert command.place_covariance_km2
    return [row[k] for k, row in enumerate(command.place_covariance_km2)]


# Hours


@pytest.mark.parametrize("distance", [0.0, 40.0])
def test_a_leg_of_ten_hours_drifts_as_long_as_at_the_stated_speed(distance: float) -> None:
    """.03 of 180 km, and .1 km by its root, whatever its length; and none without hours at rest."""
    vehicle, other = begun(), begun()
    for each in (vehicle, other):
        each.step(*elements(BERGEN), heading=0.0)
    at_sea = vehicle.step(None, None, None, heading=0.0, distance=distance, hours=10.0)
    expected = (0.03 * 180.0) ** 2 + 0.1**2 * 180.0 + 0.1**2 / 2
    assert variances(at_sea) == pytest.approx([expected] * 2, rel=0.03)
    expected = (0.03 * distance) ** 2 + 0.1**2 * distance + 0.1**2 / 2
    before = other.step(None, None, None, heading=0.0, distance=distance)
    assert variances(before) == pytest.approx([expected] * 2, rel=0.03)


def night(seed: int, *, stated: bool) -> float:
    """Squared error of the place over its stated variance, after three legs and ten hours at rest in a current."""
    random, vehicle, place = np.random.default_rng(seed), begun(), BERGEN
    drift = 0.03 * random.normal(size=2)
    for hours, distance in ((0.0, 0.0), *[(2.0, 36.0)] * 3, *[(1.0, 0.0)] * 10):
        far_km = hours * SPEED
        off = far_km * drift + 0.1 * math.sqrt(far_km) * random.normal(size=2)
        place = moved(place, off[0], off[1] - distance)
        reading = np.array(elements(place)) + NOISE * random.normal(size=3)
        given = {"hours": hours} if stated else {}
        command = vehicle.step(*reading, heading=270.0, distance=distance, **given)
    error = apart(command.place, place)
    return float(error @ np.linalg.inv(command.place_covariance_km2) @ error)


def test_a_vehicle_that_waits_a_night_in_a_current_knows_that_it_drifts() -> None:
    """Ten hours at rest with readings: its error is within its ellipse of 99 % (chi-square of 2), and is not where the
    current stops with the log."""
    assert max(night(seed, stated=True) for seed in (3, 6, 8)) < 9.2
    assert min(night(seed, stated=False) for seed in (3, 6, 8)) > 9.2


def test_hours_before_a_fix_are_those_of_a_leg_at_rest() -> None:
    """And without them, a fix 8 km off is refused."""
    fix, there = moved(BERGEN, 8.0, 0.0), elements(moved(BERGEN, 8.0, 0.0))
    vehicle, other, third = begun(), begun(), begun()
    for each in (vehicle, other, third):
        each.step(*elements(BERGEN), heading=0.0)
    vehicle.fix(*fix, std_km=1.0, hours=10.0)
    other.step(None, None, None, heading=0.0, hours=10.0)
    other.fix(*fix, std_km=1.0)
    commands = [each.step(*there, heading=0.0, hours=1.0) for each in (vehicle, other)]
    assert variances(commands[0]) == pytest.approx(variances(commands[1]), rel=1e-3)
    assert np.abs(apart(commands[0].place, commands[1].place)).max() < 0.01
    assert commands[0].drift == pytest.approx((8 / 180, 0.0), abs=0.01)
    with pytest.raises(ValueError, match="the fix is 8 km from the estimated place, where 1 km is likely"):
        third.fix(*fix, std_km=1.0)


# Altitude


def climbed(climb_km: float, start: Any, *, stated: bool, **options: Any) -> list[Command]:
    """A flight northward by legs of 20 km, which climbs along each."""
    vehicle = begun(start=start, **options)
    commands: list[Command] = []
    for number in range(7):
        altitude = climb_km * number / 6
        d, i, h = elements(moved(BERGEN, 20.0 * number, 0.0), altitude)
        given = {"altitude_km": altitude} if stated else {}
        d = None if vehicle.options.magnetic else d
        commands.append(vehicle.step(d, i, h, heading=0.0, distance=20.0 * (number > 0), **given))
    return commands


def test_a_stated_climb_of_3_km_gives_the_flight_at_the_ground() -> None:
    """Beside a model and a place within 30 m, by a dipole within a third of what an unstated climb does."""
    place = moved(BERGEN, 120.0, 0.0)
    level, stated, unstated = (
        apart(climbed(climb, BERGEN, stated=known)[-1].place, place)
        for climb, known in ((0, False), (3, True), (3, False))
    )
    assert np.hypot(*(stated - level)) < 0.03
    assert np.hypot(*(unstated - level)) > 3.0
    known = {"known": {"target_std": (0.0, 0.0, 0.0), "model": None}, "target": elements(moved(BERGEN, 200.0, 100.0))}
    level, stated, unstated = (
        np.array(climbed(climb, None, stated=stated, **known)[-1].displacement_km)
        for climb, stated in ((0, False), (3, True), (3, False))
    )
    assert np.hypot(*(stated - level)) < np.hypot(*(unstated - level)) / 3


@pytest.mark.parametrize("altitude_km", [-5.0, 3.0, 10.0])
def test_elements_of_a_destination_are_reduced_to_the_altitude_of_the_flight(altitude_km: float) -> None:
    """At its place exactly, else but for a third of the change, at the start and for another trip."""
    place, std = moved(BERGEN, 200.0, 0.0), {"target_std": (0.0, 0.0, 0.0), "target_altitude_km": altitude_km}
    there, level = (np.array(elements(place, altitude)) for altitude in (altitude_km, 0.0))
    vehicle = begun(place, known={"target_elements": there} | std)
    assert vehicle.target == pytest.approx(level, abs=2e-3)
    vehicle.step(*elements(BERGEN), heading=0.0)
    vehicle.retarget(there, **std)
    assert abs(vehicle.target - level)[2] < abs(there - level)[2] / 3
    vehicle.retarget(place, target_elements=there, **std)
    assert vehicle.target == pytest.approx(level, abs=2e-3)
    vehicle.retarget(place, target_elements=there, target_std=(0.0, 0.0, 0.0))
    assert vehicle.target == pytest.approx(there, abs=2e-3)


# The record of a flight


def test_a_file_has_times_altitudes_and_commands(tmp_path: Path) -> None:
    """And the vehicle that is restored from it goes on bit for bit, with the same record."""
    path, vehicle, commands = tmp_path / "flight.json", begun(), []
    for number in range(3):
        given = {"hours": 2.0 * (number > 0), "altitude_km": 0.5}
        reading = elements(moved(BERGEN, 36.0 * number, 0.0), 0.5)
        commands.append(vehicle.step(*reading, heading=0.0, distance=36.0 * (number > 0), **given))
    vehicle.fix(*moved(BERGEN, 72.0, 0.0), std_km=2.0, hours=1.5)
    vehicle.save(path)
    record = json.loads(path.read_text(encoding="utf-8"))
    assert [call["hours"] for call in record["steps"]] == [0.0, 2.0, 2.0, 1.5]
    assert [call["altitude_km"] for call in record["steps"][:3]] == [0.5] * 3
    assert record["commands"] == json.loads(json.dumps([vars(command) for command in commands]))
    again = Onboard("kalman", sensor_std=NOISE, confidence=0.9, speed_km_h=SPEED)
    again.restore(path)
    reading = elements(moved(BERGEN, 108.0, 0.0))
    given = {"heading": 0.0, "distance": 36.0, "hours": 2.0}
    assert again.step(*reading, **given) == vehicle.step(*reading, **given)
    for each, name in ((vehicle, "one"), (again, "two")):
        each.save(tmp_path / name)
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()
    path.write_text(json.dumps(record | {"format": 18}), encoding="utf-8")
    with pytest.raises(ValueError, match="is not the state of a vehicle: format must be 19, got 18"):
        again.restore(path)
