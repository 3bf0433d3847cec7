"""Flights whose data sheet is wrong: a vehicle may be lost, but must not say that it has arrived.

The simulator shares no physics with the library: places by geographiclib, the field by ppigrf; the crust is that of
WMMHR. All errors are drawn from what the vehicle states, but for what a row breaks.
"""

from __future__ import annotations

import datetime
import math
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from geographiclib.geodesic import Geodesic
from numpy.typing import NDArray
from ppigrf import igrf
from ppigrf.ppigrf import shc_fn_igrf14

from magrl.errors import CONDITIONS, Conditions
from magrl.field import WMMHR
from magrl.onboard import Command, Onboard

FLIGHTS, CONFIDENCE, RADIUS_KM, START_KM, STORM_KM = 12, 0.9, 25.0, 5.0, 667.0
DATE = "2025-01-01"  # the only one of IGRF-13 and WMMHR
SEED = 78
SURVEY_STD = (0.1, 0.05, 30.0)
WEATHER_KM = 125.0  # length over which the weather of a flight changes
CRUST = cache(WMMHR)
Place = tuple[float, float]
Numbers = NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """What the vehicle knows, and what is false of it."""

    name: str
    start: bool = True  # whether it knows where it starts
    elements: bool = False  # whether it knows the elements of the destination alone, which are true
    model: str | None = "IGRF-14"
    date: str | None = DATE
    off_km: float = 0.0  # of the start, which it states to START_KM
    crust: float = 0.0  # size of anomalies, over those of WMMHR, which have 26 to 42 nT
    survey: bool = False  # whether the elements of the destination were measured, with the errors SURVEY_STD
    there_nt: float = 0.0  # of an anomaly at the destination alone, in each axis
    gyro_deg: float = 0.0  # drift of the heading in each leg
    storm_nt: float = 0.0  # that grows along the path, and ends after STORM_KM
    spike: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the first reading


RIGHT = Row("right, IGRF-13", model="IGRF-13")
SPIKE = Row("a spike in the first reading", spike=(0.3, 0.3, 300.0))
BROKEN = (
    Row("start 100 km off, IGRF-14", off_km=100.0),
    Row("destination by coordinates, start unknown, IGRF-13", start=False, model="IGRF-13"),
    Row("the same with a crust, IGRF-14", start=False, crust=1.0),
    Row("crust", crust=1.0),
    Row("crust, twice as large", crust=2.0),
    Row("crust, three times as large", crust=3.0),
    Row("crust, nothing known", start=False, elements=True, model=None, date=None, crust=1.0),
    Row("storm, IGRF-14", storm_nt=400.0),
    Row("the date is 2015", date="2015-01-01"),
    Row("an anomaly of 133 nT at the destination", survey=True, there_nt=77.0),
    Row("an anomaly of 266 nT at the destination", survey=True, there_nt=154.0),
    Row("a heading that drifts by 0.25 degrees a leg", gyro_deg=0.25),
)


class Flight(NamedTuple):
    """The commands of a flight, none if its start is refused, and its true distance from the destination at the end."""

    commands: list[Command]
    off_km: float

    @property
    def reached(self) -> bool:
        """Whether it stops at the destination; some places do not allow the confidence of an arrival."""
        return bool(self.commands) and self.commands[-1].stop in ("arrived", "nearest") and self.off_km <= RADIUS_KM

    @property
    def false(self) -> bool:
        """Whether it says that it has arrived where it has not."""
        return bool(self.commands) and self.commands[-1].stop == "arrived" and self.off_km > RADIUS_KM


def unit(course: float) -> Numbers:
    return np.array((np.cos(np.radians(course)), np.sin(np.radians(course))))


def at(place: Place, north_east_km: Numbers) -> Place:
    """The place that is so far northward and eastward."""
    course, distance = np.degrees(np.arctan2(*north_east_km[::-1])), np.hypot(*north_east_km)
    there = Geodesic.WGS84.Direct(*place, course, 1000 * distance)
    return there["lat2"], there["lon2"]


def field_at(place: Place, row: Row) -> Numbers:
    """North, east, down [nT]."""
    east, north, up = igrf(*place[::-1], 0.0, datetime.datetime.fromisoformat(DATE), coeff_fn=shc_fn_igrf14)
    core = np.array((north.item(), east.item(), -up.item()))
    if not row.crust:
        return core
    return core + row.crust * (CRUST(DATE)(*torch.tensor(place, dtype=torch.float64)).numpy() - core)


def elements(field: Numbers) -> Numbers:
    """D, I [deg], B_H [nT]."""
    north, east, down = field
    level = np.hypot(north, east)
    return np.array((np.degrees(np.arctan2(east, north)), np.degrees(np.arctan2(down, level)), level))


class Sensors:
    """Readings with errors as stated: noise, constant errors, iron in the vehicle's axes, and weather."""

    def __init__(self, std: Any, random: np.random.Generator) -> None:
        self.noise, bias, self.slow, iron = map(np.array, std)
        self.random, self.weather = random, random.normal(size=3)
        self.constant = np.sqrt(bias**2 - self.slow**2) * random.normal(size=3)
        self.level_nt, self.iron = iron[0], iron * random.normal(size=3)

    def read(self, field: Numbers, heading: float, distance: float) -> Numbers:
        cos, sin = unit(heading)
        turn = np.array(((cos, -sin, 0.0), (sin, cos, 0.0), (0.0, 0.0, 1.0)))
        kept = np.exp(-distance / WEATHER_KM)
        self.weather = kept * self.weather + np.sqrt(1 - kept**2) * self.random.normal(size=3)
        level, total = np.hypot(*field[:2]), np.linalg.norm(field)
        by_iron = self.level_nt * np.array((np.degrees(1 / level), np.degrees(1 / total), 1.0))
        slow = np.sqrt(np.maximum(self.slow**2 - by_iron**2, 0.0)) * self.weather
        return elements(field + turn @ self.iron) + self.constant + slow + self.noise * self.random.normal(size=3)


def started(row: Row, conditions: Conditions, target: Place, start: Place, random: np.random.Generator) -> Onboard:
    """A vehicle with the accuracy of its conditions, that knows what the row tells it."""
    share, wander_km = conditions.motion_std
    options = {"confidence": CONFIDENCE, "radius_km": RADIUS_KM, "drift": share, "wander_km": wander_km}
    vehicle = Onboard("kalman", sensor_std=conditions.std, **options)
    goal = elements(field_at(target, row)) if row.elements else target
    survey: dict[str, Any] = {"target_std": (0.0, 0.0, 0.0)} if row.elements else {}
    if row.survey:
        there = elements(field_at(target, row) + row.there_nt * random.choice((-1, 1), 3))
        survey = {"target_elements": tuple(there + SURVEY_STD * random.normal(size=3)), "target_std": SURVEY_STD}
    known = {"date": row.date, "model": row.model, "start_km": START_KM}
    vehicle.start(tuple(goal), start if row.start else None, **known, **survey)
    return vehicle


def flown(row: Row, number: int, seed: int = SEED) -> Flight:
    random, conditions = np.random.default_rng((seed, number)), CONDITIONS[("ship", "underwater")[number % 2]]
    place = (math.degrees(math.asin(random.uniform(-0.8, 0.8))), random.uniform(-180, 180))  # up to 53 degrees
    course, wrong = random.uniform(0, 360, 2)
    target = at(place, random.uniform(300, 500) * unit(course))
    start = at(at(place, START_KM / np.sqrt(2) * random.normal(size=2)), row.off_km * unit(wrong))
    (share, wander_km), sensors = conditions.motion_std, Sensors(conditions.std, random)
    vehicle, drift, commands = (
        started(row, conditions, target, start, np.random.default_rng((seed, number, 1))),
        share * random.normal(size=2),
        [],
    )
    refused, heading, distance, path = False, random.uniform(0, 360), 0.0, 0.0
    while not commands or (not commands[-1].stop and len(commands) < vehicle.options.max_steps):
        field = field_at(place, row)
        field[0] -= row.storm_nt * np.sin(np.pi * min(path / STORM_KM, 1.0)) ** 2
        spike = 0.0 if commands or refused else np.array(row.spike)
        reading = sensors.read(field, heading, distance) + spike
        try:
            commands.append(vehicle.step(*reading, heading=heading, distance=distance))
        except ValueError:
            if commands or refused:  # of a user, who reads once again
                break
            refused = True
            continue
        heading, distance = commands[-1].heading_deg, commands[-1].distance_km
        true = unit(heading + row.gyro_deg * len(commands))
        place = at(place, distance * (true + drift) + wander_km * np.sqrt(distance) * random.normal(size=2))
        path += distance
    return Flight(commands, Geodesic.WGS84.Inverse(*place, *target)["s12"] / 1000)


@cache
def flights(row: Row) -> list[Flight]:
    return [flown(row, number) for number in range(FLIGHTS)]


@pytest.mark.slow
@pytest.mark.parametrize("row", [RIGHT, SPIKE], ids=lambda row: row.name)
def test_a_right_sheet_and_a_spike_cost_no_flight(row: Row) -> None:
    assert sum(flight.reached for flight in flights(row)) >= 9
    assert sum(flight.false for flight in flights(row)) <= 2
    fits = [command.fit for flight in flights(row) for command in flight.commands]
    assert np.quantile(fits, 0.01) > 0.01


@pytest.mark.slow
def test_a_wrong_sheet_is_no_false_arrival() -> None:
    false = {row.name: sum(flight.false for flight in flights(row)) for row in BROKEN}
    assert sum(false.values()) <= (1 - CONFIDENCE) * FLIGHTS * len(BROKEN), false
