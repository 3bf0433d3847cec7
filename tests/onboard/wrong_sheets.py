"""Fly vehicles whose data sheet is wrong, and count where they say that they have arrived.

The simulator shares no physics with the library: places are by geographiclib, the field is IGRF-14 by ppigrf, and the
crust is the gradient of a random potential of its own in each flight. All errors are drawn from what the vehicle
states, but for what a row breaks. Rows share the places and the random numbers of flights of the same number.

    OMP_NUM_THREADS=1 python tests/onboard/wrong_sheets.py --flights 120 --seed 1 --jobs 2 --out flights.csv
    python tests/onboard/wrong_sheets.py --rows failures --vehicle ship --flights 40 --seed 77
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from collections import namedtuple
from collections.abc import Iterable, Iterator, Sequence
from functools import cache, partial
from itertools import product
from pathlib import Path

import numpy as np
from geographiclib.geodesic import Geodesic
from ppigrf import igrf
from scipy.interpolate import RectBivariateSpline

from magrl.errors import CONDITIONS, Conditions
from magrl.jobs import mapped
from magrl.onboard import Onboard

CONFIDENCE, RADIUS_KM, START_KM = 0.8, 25.0, 5.0
DATE = "2025-01-01"  # the last of IGRF-13
SURVEY_STD, SPIKE = np.array((0.1, 0.05, 30.0)), np.array((0.3, 0.3, 300.0))
WEATHER_KM, CRUST_KM, WAVES = 125.0, 100.0, 128  # path over which correlations fall to 1 / e; chosen
STORM_KM, STORM_STEPS = 667.0, 24  # about twice the way to the destination; chosen
WRONG = "log drift bias survey unstated off_km crust_nt there_nt storm_nt timed_nt gyro_deg frozen climb_km spike "
WRONG += "fails since"


class Row(namedtuple("Row", f"name start date {WRONG}", defaults=(True, DATE, *3 * [1.0], *13 * [0]))):
    """What the vehicle knows, and what is false of it.

    Args:
        name: of the row.
        start: whether it knows where it starts.
        date: of the flight, as it states it; None for one that knows the elements of its destination alone, no model.
        survey: whether the elements of the destination were measured, with the errors SURVEY_STD.
        unstated: whether these errors are not stated.
        off_km: error of the start, which it states to START_KM.
        crust_nt: root mean square of the anomalies, in the mean of the three axes.
        there_nt: size in each axis of an anomaly at the destination alone.
        storm_nt: a disturbance to the south that grows and decays along a path of STORM_KM.
        timed_nt: the same in STORM_STEPS steps, wherever the vehicle is.
        log: distances that it reports, over those in which all errors are as stated.
        drift: drift, over that drawn from what is stated.
        bias: constant errors of the sensors and iron, over those drawn.
        gyro_deg: drift of the heading, and so of D, in each leg.
        frozen: whether D stays that of the first reading.
        climb_km: altitude after the first reading.
        spike: error of the first reading, over SPIKE.
        fails: what :func:`reported` makes of readings.
        since: from which step on.
    """


def reported(fails: str, reading: Sequence, held: Sequence, heading: float) -> tuple[Sequence, float]:
    """Reading and heading as the vehicle reports them, given the last reading before the failure of a row."""
    d, i, level = reading
    return {
        "frozen D": ((held[0], i, level), heading),
        "frozen": (held, heading),
        "nothing read": ((None, None, None), heading),
        "heading in radians": (reading, np.radians(heading)),
        "B_H in microtesla": ((d, i, level / 1000), heading),
        "wrong sign of I": ((d, -i, level), heading),
    }.get(fails, (reading, heading))


NOTHING = Row("nothing-exact", start=False, date=None)
GROUPS = {
    "known": (
        *(Row("right"), Row("survey", survey=True), Row("start-100-km", off_km=100.0), Row("frozen-d", frozen=True)),
        *(Row(f"crust-{size}", crust_nt=size) for size in (30, 60, 90, 150)),
        *(Row("storm-in-time", timed_nt=400.0), Row("storm-on-path", storm_nt=400.0), Row("gyro", gyro_deg=0.25)),
        *(Row(f"anomaly-{name}", survey=True, there_nt=nt) for name, nt in ((133, 77.0), (266, 154.0))),
        *(Row("log-5-percent", log=1.05), Row("current-twice", drift=2.0), Row("bias-5-times", bias=5.0)),
    ),
    "nothing": (
        *(NOTHING, NOTHING._replace(name="nothing-storm-on-path", storm_nt=400.0)),
        *(NOTHING._replace(name=f"nothing-crust-{size}", crust_nt=size) for size in (60, 150)),
        *(NOTHING._replace(name=f"nothing-survey{x}", survey=True, unstated=bool(x)) for x in ("", "-unstated")),
    ),
    "more": (
        *(Row(f"climb-{height}-km", climb_km=height) for height in (1, 3)),
        *(Row("date-2015", date="2015-01-01"), Row("spike", spike=1.0)),
        *(Row("start-unknown", start=False), Row("start-unknown-crust-30", start=False, crust_nt=30.0)),
    ),
    "failures": [
        *(Row("right-too"), Row("frozen-d-too", fails="frozen D"), Row("frozen-d-later", fails="frozen D", since=4)),
        *(Row("frozen-later", fails="frozen", since=4), Row("nothing-read", fails="nothing read", since=4)),
        *(
            Row(name.replace(" ", "-"), fails=name)
            for name in ("heading in radians", "B_H in microtesla", "wrong sign of I")
        ),
    ],
}
ROWS = {row.name: row for group in GROUPS.values() for row in group}
OUTCOMES = "arrived", "nearest, within 25 km", "false", "nearest elsewhere", "lost, refused"


class Flight(namedtuple("Flight", "row vehicle number off_km steps stop confidence fit reason")):
    """How a flight ends: the last command, or a refused reading, and the true distance from the destination."""

    @property
    def outcome(self) -> str:
        """The column of the table; some places do not allow the confidence of an arrival."""
        ended = {"arrived": 0, "nearest": 1}.get(self.stop, 4)
        return OUTCOMES[ended + 2 * (ended < 4 and self.off_km > RADIUS_KM)]


def unit(course: float) -> np.ndarray:
    return np.array((np.cos(np.radians(course)), np.sin(np.radians(course))))


def turned(vector: np.ndarray, angle: float) -> np.ndarray:
    """A vector of axes that are turned by an angle clockwise, in north, east, down."""
    cos, sin = unit(angle)
    return np.array(((cos, -sin, 0.0), (sin, cos, 0.0), (0.0, 0.0, 1.0))) @ vector


def at(place: tuple[float, float], north_east_km: np.ndarray) -> tuple[float, float]:
    """The place that is so far northward and eastward."""
    course, distance = np.degrees(np.arctan2(*north_east_km[::-1])), np.hypot(*north_east_km)
    there = Geodesic.WGS84.Direct(*place, course, 1000 * distance)
    return there["lat2"], there["lon2"]


@cache
def splines(altitude_km: float) -> list[RectBivariateSpline]:
    """North, east, down [nT] of IGRF-14 from a grid of two degrees, since ppigrf takes 20 ms a place."""
    latitudes, longitudes, when = np.arange(-89, 90, 2), np.arange(-190, 191, 2), np.datetime64(DATE)
    east, north, up = igrf(longitudes, latitudes[:, None], altitude_km, when)
    return [RectBivariateSpline(latitudes, longitudes, part[0]) for part in (north, east, -up)]


class Field:
    """The field of a flight: IGRF-14 with the crust of its row, random waves of a potential around a place."""

    def __init__(self, row: Row, origin: tuple[float, float], random: np.random.Generator) -> None:
        self.row, self.origin = row, origin
        self.waves = np.sqrt(2) / CRUST_KM * random.normal(size=(2, WAVES))  # radians / km, northward and eastward
        self.phases = random.uniform(0, 2 * np.pi, WAVES)

    def anomaly(self, place: tuple[float, float], altitude_km: float) -> np.ndarray:
        """North, east, down [nT], minus the gradient of cos(k x + phase) exp(-|k| altitude) / |k|, summed."""
        line, k = Geodesic.WGS84.Inverse(*self.origin, *place), np.hypot(*self.waves)
        phase = line["s12"] / 1000 * unit(line["azi1"]) @ self.waves + self.phases
        parts = np.exp(-k * altitude_km) * np.vstack((np.sin(phase) / k * self.waves, -np.cos(phase)))
        return turned(self.row.crust_nt * np.sqrt(3 / WAVES) * parts.sum(1), line["azi2"] - line["azi1"])

    def __call__(self, place: tuple[float, float], altitude_km: float = 0.0) -> np.ndarray:
        """North, east, down [nT]."""
        core = np.array([spline(*place).item() for spline in splines(altitude_km)])
        return core + self.anomaly(place, altitude_km) if self.row.crust_nt else core


def elements(field: np.ndarray) -> np.ndarray:
    """D, I [deg], B_H [nT]."""
    north, east, down = field
    level = np.hypot(north, east)
    return np.array((np.degrees(np.arctan2(east, north)), np.degrees(np.arctan2(down, level)), level))


class Sensors:
    """Readings with errors as stated: noise, constant errors, iron in the vehicle's axes, and weather."""

    def __init__(self, std: Iterable, random: np.random.Generator, bias: float) -> None:
        self.noise, all_but_noise, self.slow, iron = map(np.array, std)
        self.random, self.weather = random, random.normal(size=3)
        self.constant = bias * np.sqrt(all_but_noise**2 - self.slow**2) * random.normal(size=3)
        self.level_nt, self.iron = iron[0], bias * iron * random.normal(size=3)

    def read(self, field: np.ndarray, heading: float, distance: float) -> np.ndarray:
        kept = np.exp(-distance / WEATHER_KM)
        self.weather = kept * self.weather + np.sqrt(1 - kept**2) * self.random.normal(size=3)
        level, total = np.hypot(*field[:2]), np.linalg.norm(field)
        by_iron = self.level_nt * np.array((np.degrees(1 / level), np.degrees(1 / total), 1.0))
        slow = np.sqrt(np.maximum(self.slow**2 - by_iron**2, 0.0)) * self.weather
        errors = self.constant + slow + self.noise * self.random.normal(size=3)
        return elements(field + turned(self.iron, heading)) + errors


class World:
    """A flight as it is: places, field, sensors and drift, of a random stream each, and a vehicle that starts in it."""

    def __init__(self, row: Row, conditions: Conditions, seeds: Sequence[int], **options: object) -> None:
        places, survey, sensors, self.random, crust = (np.random.default_rng((*seeds, part)) for part in range(5))
        self.row, self.path, self.steps = row, 0.0, 0
        self.place = np.degrees(np.arcsin(places.uniform(-0.8, 0.8))), places.uniform(-180, 180)  # up to 53 degrees
        course, wrong, self.heading = places.uniform(0, 360, 3)
        self.target = at(self.place, places.uniform(300, 500) * unit(course))
        start = at(at(self.place, START_KM / np.sqrt(2) * places.normal(size=2)), row.off_km * unit(wrong))
        self.field, self.sensors = Field(row, self.place, crust), Sensors(conditions.std, sensors, row.bias)
        motion = dict(zip(("drift", "wander_km"), conditions.motion_std, strict=True))
        self.drift, self.wander_km = row.drift * motion["drift"] * self.random.normal(size=2), motion["wander_km"]
        options = motion | {"radius_km": RADIUS_KM, "confidence": CONFIDENCE} | options
        self.vehicle = Onboard("kalman", sensor_std=conditions.std, **options)
        there = elements(self.field(self.target) + row.there_nt * survey.choice((-1, 1), 3))
        there = tuple(there + row.survey * SURVEY_STD * survey.normal(size=3))
        known = {"target_std": tuple(SURVEY_STD * (row.survey and not row.unstated))}
        if row.date:
            known = known | {"target_elements": there} if row.survey else {}
            known |= {"date": row.date, "model": "IGRF-13", "start_km": START_KM}
        self.vehicle.start(self.target if row.date else there, start if row.start else None, **known)

    def read(self, distance: float) -> np.ndarray:
        """D, I [deg], B_H [nT] at the end of a leg."""
        row, field = self.row, self.field(self.place, self.row.climb_km if self.steps else 0.0)
        since = np.array((self.path / STORM_KM, self.steps / STORM_STEPS))
        field[0] -= np.array((row.storm_nt, row.timed_nt)) @ np.sin(np.pi * np.minimum(since, 1.0)) ** 2
        reading = self.sensors.read(field, self.heading, distance)
        self.first_d = self.first_d if self.steps else reading[0]
        reading[0] = self.first_d if row.frozen else reading[0] - row.gyro_deg * self.steps
        return reading

    def move(self, heading: float, distance: float) -> None:
        """Move by a leg as the vehicle reports it."""
        self.heading, self.path, self.steps = heading, self.path + distance / self.row.log, self.steps + 1
        course, true_km = unit(heading + self.row.gyro_deg * self.steps), distance / self.row.log
        wander = self.wander_km * np.sqrt(true_km) * self.random.normal(size=2)
        self.place = at(self.place, true_km * (course + self.drift) + wander)


def flown(row: Row, vehicle: str, number: int, seed: int, **options: object) -> Flight:
    """Fly one flight, which depends on the arguments alone."""
    world = World(row, CONDITIONS[vehicle], (seed, number), **options)
    last, refused, distance, spike, held = None, [], 0.0, row.spike * SPIKE, None
    while not (last and last.stop) and len(refused) < 2:  # of a user, who reads once again
        reading, heading = world.read(distance) + spike, world.heading
        held = reading if held is None or world.steps < row.since else held
        if world.steps >= row.since:
            reading, heading = reported(row.fails, reading, held, heading)
        try:
            last = world.vehicle.step(*reading, heading=heading, distance=distance)
        except ValueError as error:
            refused, spike = [*refused, str(error)], 0.0
            continue
        distance, spike = last.distance_km, 0.0
        world.move(last.heading_deg, distance)
    off_km = Geodesic.WGS84.Inverse(*world.place, *world.target)["s12"] / 1000
    said = (last.stop, last.confidence, last.fit, last.reason) if last and last.stop else ("refused", 0, 0, refused[-1])
    return Flight(row.name, vehicle, number, off_km, world.steps, *said)


def table(flights: Sequence[Flight]) -> Iterator[str]:
    """Lines of a Markdown table, the last of which are of all flights of a group."""
    names = "row", "vehicle", *OUTCOMES, "flights", "share of false", "median steps of arrived"
    yield from ("| " + " | ".join(names) + " |", "|---" * len(names) + "|")
    group_of = {row.name: f"all of {group}" for group, rows in GROUPS.items() for row in rows}
    cells = [(x.row, x.vehicle) for x in flights] + [(group_of[x.row], x.vehicle) for x in flights]
    for name, vehicle in dict.fromkeys(cells):
        cell = [x for x in flights if name in (x.row, group_of[x.row]) and x.vehicle == vehicle]
        counts = [sum(x.outcome == outcome for x in cell) for outcome in OUTCOMES]
        steps = np.median([x.steps for x in cell if x.outcome == OUTCOMES[0]] or [np.nan])
        values = name, vehicle, *counts, len(cell), f"{counts[2] / len(cell):.1%}", f"{steps:g}"
        yield "| " + " | ".join(map(str, values)) + " |"


def called(options: dict[str, object], call: Sequence) -> Flight:
    return flown(*call, **options)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in {"flights": 120, "seed": 1, "jobs": 1, "confidence": CONFIDENCE, "out": "flights.csv"}.items():
        parser.add_argument(f"--{name}", type=type(default), default=default)
    parser.add_argument("--rows", nargs="+", choices=[*GROUPS, *ROWS], default=["known", "nothing"], metavar="ROW")
    parser.add_argument("--vehicle", nargs="+", choices=list(CONDITIONS), default=["ship", "underwater"])
    parser.add_argument("--option", nargs="+", default=[], help="of Onboard: name=value as in JSON")
    args = parser.parse_args()
    rows = [row for name in args.rows for row in GROUPS.get(name, [ROWS.get(name)])]
    texts, flights = [f"confidence={args.confidence}", *args.option], []
    options = {name: json.loads(value) for name, value in (text.split("=") for text in texts)}
    with open(args.out, "w", newline="", encoding="utf-8", buffering=1) as file:
        csv.writer(file).writerow(Flight._fields)
        calls = list(product(rows, args.vehicle, range(args.flights), [args.seed]))
        for flight in mapped(partial(called, options), calls, args.jobs, unit="flight"):
            csv.writer(file).writerow(flight)
            flights.append(flight)
    print(*table(flights), sep="\n")


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent))
    from wrong_sheets import main  # so that other processes import these functions, with their caches

    main()
