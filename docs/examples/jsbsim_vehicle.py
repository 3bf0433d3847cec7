"""Fly a Cessna 172 of JSBSim by the magnetic field: the flight model behind MAVLink.

    python docs/examples/jsbsim_vehicle.py --flights 20                  # both ends in one process, as fast as it goes
    python docs/examples/jsbsim_vehicle.py --link udpout:127.0.0.1:14550 --speedup 30  # beside magrl.vehicle.autopilot

The aircraft has the heading and altitude hold of its model c172x. Its magnetometer reads the field of ppigrf, with
noise of .05 degrees and 5 nT on D, I and B_H of a reading; or, with --tilt, with errors of roll, pitch and heading,
whose effect on a reading is stated to the navigator. The airspeed is true. The wind is constant, and the vehicle does
not know it.
With --link, it prints the command that steers it to its destination.
"""

from __future__ import annotations

import argparse
import datetime
import math
import os
import random
import statistics
import tempfile
import time
from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

from magrl.vehicle.autopilot import Loop, fly
from magrl.vehicle.autopilot.mavlink import MavlinkLink
from magrl.vehicle.onboard import Onboard

import jsbsim
import numpy as np
import ppigrf
from geographiclib.geodesic import Geodesic
from pymavlink import mavutil
from pymavlink.dialects.v20 import ardupilotmega as mavlink

DATE = datetime.datetime(2026, 1, 1)
ALTITUDE_KM, AIRSPEED_KN, STEP_S = 1.5, 100.0, 0.1
NOISE = (0.05, 0.05, 5.0)
"""Noise of D [deg], I [deg], B_H [nT] of a reading of 30 s."""
AXIS_NT = 10.0
"""Noise of a sample of an axis [nT], which a reading averages."""
EARTH = Geodesic.WGS84
Place = tuple[float, float]


def vector(place: Place) -> np.ndarray:
    """Return the field, north, east, down [nT]."""
    east, north, up = (float(np.squeeze(part)) for part in ppigrf.igrf(place[1], place[0], ALTITUDE_KM, DATE))
    return np.array([north, east, -up])


def elements(place: Place) -> tuple[float, float, float]:
    """Return D [deg], I [deg], B_H [nT]."""
    return elements_of(vector(place))


def elements_of(field: np.ndarray) -> tuple[float, float, float]:
    """Return D [deg], I [deg], B_H [nT] of a field, north, east, down [nT]."""
    north, east, down = field
    level = math.hypot(north, east)
    return math.degrees(math.atan2(east, north)), math.degrees(math.atan2(down, level)), level


class Cessna:
    """The aircraft: it advances in steps, and speaks MAVLink.

    Args:
        place: latitude and longitude [deg].
        heading_deg: at the start.
        wind: northward and eastward [m/s].
        rng: random numbers of the sensors.
        tilt_deg: error of roll, pitch and heading; 0 for :data:`NOISE`.
    """

    def __init__(
        self, place: Place, heading_deg: float, wind: Place, rng: random.Random, tilt_deg: float = 0.0
    ) -> None:
        self._model = model = jsbsim.FGFDMExec(None)
        model.set_debug_level(0)
        model.load_model("c172x")
        model.set_output_filename(0, os.devnull)
        start = {"lat-geod-deg": place[0], "long-gc-deg": place[1], "psi-true-deg": heading_deg}
        start |= {"h-sl-ft": ALTITUDE_KM / 0.3048e-3, "vc-kts": AIRSPEED_KN}
        for name, value in start.items():
            model[f"ic/{name}"] = value
        model["atmosphere/wind-north-fps"], model["atmosphere/wind-east-fps"] = (value / 0.3048 for value in wind)
        model.run_ic()
        model["propulsion/set-running"] = -1
        model["fcs/throttle-cmd-norm"], model["fcs/mixture-cmd-norm"] = 0.8, 0.9
        model["ap/altitude_setpoint"], model["ap/altitude_hold"] = ALTITUDE_KM / 0.3048e-3, 1
        model["ap/heading_setpoint"], model["ap/heading_hold"] = heading_deg, 1
        self._rng, self._tilt_deg, self.path_km, self.stuck = rng, tilt_deg, 0.0, False
        self._errors: list[float] = []
        self._field, self._axes = vector(place), np.zeros(3)

    @property
    def time(self) -> float:
        """Time since the start [s]."""
        return self._model.get_sim_time()

    @property
    def place(self) -> Place:
        """Latitude and longitude [deg]."""
        return self._model["position/lat-geod-deg"], self._model["position/long-gc-deg"]

    def steer(self, heading_deg: float) -> None:
        """Hold another heading."""
        self._model["ap/heading_setpoint"] = heading_deg

    def messages(self) -> Iterator[Any]:
        """Advance by a step, and yield the messages at its end."""
        until = self.time + STEP_S - 1e-6
        while self.time < until:
            self._model.run()
        self._model["propulsion/tank/contents-lbs"] = 130.0  # the tanks stay full
        self.path_km += STEP_S * self._model["velocities/vg-fps"] * 0.3048e-3
        step = round(self.time / STEP_S)
        if step % 50 == 0:  # over 5 s, the field changes by 1 to 3 nT
            self._field = vector(self.place)
        if step % 300 == 1:
            self._errors = [self._rng.gauss(0, math.sqrt(1.5)) for _ in range(3)]  # a reading averages two
        true = [self._model[f"attitude/{name}-rad"] for name in ("phi", "theta", "psi")]
        ms = int(1000 * self.time)
        shown = (t + math.radians(self._tilt_deg * e) for t, e in zip(true, self._errors, strict=True))
        yield mavlink.MAVLink_attitude_message(ms, *shown, 0, 0, 0)
        if not self.stuck:
            self._axes = self._rotation(true).T @ self._noisy(self._field)
            self._axes += [self._rng.gauss(0, AXIS_NT) for _ in range(3)]
        yield mavlink.MAVLink_highres_imu_message(1000 * ms, *[0] * 6, *(self._axes / 1e5), *[0] * 4, 0x1C0)
        airspeed, ground = (self._model[f"velocities/{name}-fps"] * 0.3048 for name in ("vt", "vg"))
        yield mavlink.MAVLink_vfr_hud_message(airspeed, ground, round(math.degrees(true[2])) % 360, 80, 1500, 0)

    def _noisy(self, field: np.ndarray) -> np.ndarray:
        """Return the field with the errors of D, I, B_H."""
        if self._tilt_deg:
            return field
        elements = elements_of(field)
        declination, inclination, level = (x + s * e for x, s, e in zip(elements, NOISE, self._errors, strict=True))
        east, down = math.radians(declination), math.radians(inclination)
        return level * np.array([math.cos(east), math.sin(east), math.tan(down)])

    @staticmethod
    def _rotation(attitude: Sequence[float] | np.ndarray) -> np.ndarray:
        """Return the rotation from the axes of the aircraft to north, east, down."""
        (sr, sp, sh), (cr, cp, ch) = np.sin(attitude), np.cos(attitude)
        roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        return np.array([[ch, -sh, 0], [sh, ch, 0], [0, 0, 1]]) @ pitch @ roll


class Loopback:
    """The connection of an aircraft in the same process, of the form of pymavlink's."""

    def __init__(self, aircraft: Cessna) -> None:
        self._aircraft = aircraft
        self._vehicle = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._answers = mavlink.MAVLink(None)
        self._queue: deque[Any] = deque([mavlink.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3)])
        self._parser = mavlink.MAVLink(None)
        self.mav = mavlink.MAVLink(self, srcSystem=1, srcComponent=191)

    def write(self, content: bytes) -> None:
        """Receive what the link sends."""
        for message in self._answers.parse_buffer(content) or ():
            if message.get_type() == "COMMAND_INT" and message.command == 43002:
                self._aircraft.steer(message.param2)

    def recv_match(self, **_: Any) -> Any:
        """Return the next message, as it comes over a line."""
        while not self._queue:
            self._queue.extend(self._aircraft.messages())
        return self._parser.parse_buffer(self._queue.popleft().pack(self._vehicle))[0]


def task(rng: random.Random, distance_km: float, most_wind: float) -> tuple[Place, Place, float, Place]:
    """Return start, destination, heading at the start and wind."""
    edge = math.sin(math.radians(60))
    here = math.degrees(math.asin(rng.uniform(-edge, edge))), rng.uniform(-180, 180)
    there = EARTH.Direct(*here, rng.uniform(0, 360), 1000 * distance_km)
    speed, bearing = rng.uniform(0, most_wind), rng.uniform(0, 2 * math.pi)
    wind = speed * math.cos(bearing), speed * math.sin(bearing)
    return here, (there["lat2"], there["lon2"]), rng.uniform(0, 360), wind


def stated(place: Place, tilt_deg: float) -> tuple[float, ...]:
    """Return the standard deviations of a reading near a place: D [deg], I [deg], B_H [nT]."""
    if not tilt_deg:
        return NOISE
    field, tilts = vector(place), np.random.default_rng(0).normal(0, math.radians(tilt_deg), (4000, 3))
    return tuple(np.std([elements_of(Cessna._rotation(tilt) @ field) for tilt in tilts], 0).tolist())


def flight(number: int, options: argparse.Namespace) -> tuple[str, float, float]:
    """Fly in one process, and return how it stopped, the distance left [km], and the path over the shortest one."""
    rng = random.Random(1000 * options.seed + number)
    here, there, heading, wind = task(rng, options.distance, options.wind)
    aircraft = Cessna(here, heading, wind, rng, options.tilt)
    board = Onboard(options.navigator, sensor_std=stated(there, options.tilt))
    board.start(elements(there))
    loop, moves, stop = Loop(board), 0, "out of time"
    with tempfile.TemporaryDirectory() as folder:
        for command in fly(loop, MavlinkLink(Loopback(aircraft)), folder):
            moves, stop = moves + 1, command.stop or stop
    left = EARTH.Inverse(*aircraft.place, *there)["s12"] / 1000
    ratio = aircraft.path_km / options.distance
    print(
        f"{number}: wind {math.hypot(*wind):.0f} m/s, {stop} after {aircraft.time / 60:.0f} min and {moves} readings, "
        f"{left:.1f} km left, path {ratio:.2f} times the shortest",
        flush=True,
    )
    return stop, left, ratio


def serve(options: argparse.Namespace) -> None:
    """Fly behind a link until it is interrupted."""
    rng = random.Random(options.seed)
    here, there, heading, wind = task(rng, options.distance, options.wind)
    aircraft = Cessna(here, heading, wind, rng, options.tilt)
    line = mavutil.mavlink_connection(options.link, source_system=1, source_component=1, dialect="ardupilotmega")
    noise = " ".join(f"{value:.3g}" for value in stated(there, options.tilt))
    place = f"{there[0]:.4f} {there[1]:.4f} --date {DATE:%Y-%m-%d} --altitude {ALTITUDE_KM}"
    print(f"python -m magrl.vehicle.autopilot udpin:127.0.0.1:14550 --target {place} --noise {noise}", flush=True)
    due, begun = 0.0, time.monotonic()
    while True:
        for message in aircraft.messages():
            line.mav.send(message)
        while answer := line.recv_match(type="COMMAND_INT"):
            if answer.command == mavlink.MAV_CMD_GUIDED_CHANGE_HEADING:
                aircraft.steer(answer.param2)
        if aircraft.time >= due:
            due += 10.0
            line.mav.heartbeat_send(1, 3, 0, 0, 4)
            left = EARTH.Inverse(*aircraft.place, *there)["s12"] / 1000
            if round(due) % 600 == 0:
                print(f"{aircraft.time / 60:.0f} min: {left:.1f} km from the destination", flush=True)
        time.sleep(max(0.0, aircraft.time / options.speedup - (time.monotonic() - begun)))


def main() -> None:
    """Fly one vehicle behind a link, or several in one process."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--link", help="address of pymavlink, such as udpout:127.0.0.1:14550")
    parser.add_argument("--speedup", type=float, default=30.0, help="times real time, with --link; default 30")
    parser.add_argument("--flights", type=int, default=20)
    parser.add_argument("--navigator", default="anywhere", help="anywhere, kalman or secant")
    parser.add_argument("--distance", type=float, default=200.0, help="of the destination [km]; default 200")
    parser.add_argument("--wind", type=float, default=12.0, help="strongest wind [m/s]; default 12")
    parser.add_argument("--tilt", type=float, default=0.0, help="error of roll, pitch, heading [deg]; default NOISE")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if options.link:
        serve(options)
        return
    ends = [flight(number, options) for number in range(options.flights)]
    near = sum(left <= 25 for _, left, _ in ends)
    right = sum(left <= 25 and stop == "arrived" for stop, left, _ in ends)
    paths = [ratio for *_, ratio in ends]
    print(f"{near} of {len(ends)} within 25 km, {right} of them declared; path over the shortest one:", end=" ")
    print(f"median {statistics.median(paths):.2f}, longest {max(paths):.2f}")


if __name__ == "__main__":
    main()
