"""Steer an autopilot to a destination by the magnetic field.

    python -m magrl.vehicle.autopilot udpin:0.0.0.0:14550 --to 61.5 8.1 --date 2026-06-30 --noise 0.05 0.05 5
    python -m magrl.vehicle.autopilot /dev/ttyUSB0,57600 --target 0 75.4 13240 --north magnetic --noise 0 0.1 20
    python -m magrl.vehicle.autopilot udp:10110 --nmea --to 61.5 1.2 --date 2026-06-30 --noise 0.1 0.05 20 --read-s 120

The vehicle must move, and its operator chooses the mode in which it takes headings (docs/onboard.md). The messages are
written to the folder of the flight; the same command continues a flight that was interrupted.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import torch

from magrl.agents import load_policy
from magrl.checks import command
from magrl.field import IGRF, elements_at
from magrl.sensor_std import SensorStd
from magrl.vehicle.autopilot.flight import Link, fly
from magrl.vehicle.autopilot.loop import LOG, Loop
from magrl.vehicle.autopilot.mavlink import SENSORS, STEERING, MavlinkLink
from magrl.vehicle.autopilot.nmea import NmeaLink
from magrl.vehicle.logs import Calibration
from magrl.vehicle.onboard import Command, Onboard
from magrl.vehicle.onboard.start import known_elements

_MAVLINK = ("speed", "sensor", "steering", "cruise_m_s", "autopilot")
_NMEA = ("speed", "level", "sources")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    arguments = argparse.ArgumentParser(
        prog="python -m magrl.vehicle.autopilot",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = arguments.add_argument
    add("address", help="MAVLink: an address of pymavlink; NMEA: udp:PORT; or a serial port and its rate, PORT,RATE")
    place = arguments.add_mutually_exclusive_group(required=True)
    place.add_argument("--target", type=float, nargs=3, metavar=("D", "I", "BH"), help="elements at the destination")
    place.add_argument("--to", type=float, nargs=2, metavar=("LAT", "LON"), help="destination, looked up in IGRF")
    add("--date", help="date for IGRF, such as 2026-06-30")
    add("--altitude", type=float, default=0.0, help="altitude of the flight, for IGRF [km]; default 0")
    add("--here", type=float, nargs=2, metavar=("LAT", "LON"), help="start, where it is known")
    add("--navigator", default="anywhere", help="anywhere, kalman, secant, or a policy file; default anywhere")
    add("--north", choices=("true", "magnetic"), default="true", help="north of the vehicle; default true")
    add("--noise", type=float, nargs=3, required=True, help="standard deviations of readings [deg deg nT]")
    add("--bias", type=float, nargs=3, help="those of constant errors [deg deg nT]; default those of --calibration")
    add("--calibration", type=Path, help="file of a calibration, of python -m magrl.vehicle.logs --calibrate")
    add("--read-s", type=float, default=30.0, help="duration of a reading [s]; default 30")
    add("--arrival-km", type=float, default=25.0, help="radius of the destination [km]; default 25")
    add("--confidence", type=float, default=0.8, help="least probability of arrival to stop; default 0.8")
    add("--nmea", action="store_true", help="the link is NMEA 0183; default MAVLink")
    add("--level", action="store_true", help="NMEA: the magnetometer is level, without XDR of PTCH and ROLL")
    add("--speed", help="airspeed or groundspeed (MAVLink), water or ground (NMEA); default by the vehicle")
    add("--sources", nargs="+", help="NMEA: sentences that count, such as HEHDT IIXDR; default the first ones")
    add("--autopilot", type=int, nargs=2, metavar=("SYSTEM", "COMPONENT"), help="MAVLink: default the first one")
    add("--sensor", choices=SENSORS, help="MAVLink: message of the magnetometer; default HIGHRES_IMU if it comes")
    add("--steering", choices=STEERING, help="MAVLink: how to steer; default by the type of the vehicle")
    add("--cruise", type=float, dest="cruise_m_s", help="MAVLink: speed to command with --steering velocity [m/s]")
    add("--out", type=Path, default=Path("runs/autopilot"), help="folder of the flight; default runs/autopilot")
    return arguments


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line and steer until the vehicle stops."""
    command("python -m magrl.vehicle.autopilot", lambda: _main(parser().parse_args(args)), ValueError, ImportError)


def _main(options: argparse.Namespace) -> None:
    if bool(options.to or options.here) != bool(options.date) or (options.altitude and not options.date):
        raise ValueError("--to and --here need --date, that of the flight, for IGRF; --date and --altitude need them")
    calibration = Calibration.load(options.calibration) if options.calibration else None
    options.bias = options.bias or (calibration.std if calibration else (0.0, 0.0, 0.0))
    loop, connection = Loop(vehicle(options), read_s=options.read_s, calibration=calibration), link(options)
    LOG.handlers, logging.raiseExceptions = [logging.StreamHandler(sys.stdout), _Radio(connection)], False
    LOG.setLevel(logging.INFO)
    say = LOG.getChild("commands").info  # each one, however often
    if (options.out / "messages.csv").exists():
        say(f"continues the flight in {options.out} with its last command; for a new one, give another --out")
    say(f"target: D, I, B_H = {', '.join(f'{x:.2f}' for x in loop.vehicle.target)}; flight: {options.out}")
    try:
        for number, order in enumerate(fly(loop, connection, options.out)):
            say(line(number, order, loop.note))
    except KeyboardInterrupt:
        say(f"interrupted; the same command continues the flight in {options.out}")


def vehicle(options: argparse.Namespace) -> Onboard:
    """Return the navigator at its start."""
    policy = load_policy(options.navigator) if options.navigator.endswith(".safetensors") else options.navigator
    target, here = options.target, options.here
    field = IGRF(options.date, altitude_km=options.altitude) if options.date else None
    places = [place and elements_at(field, torch.tensor(place)).tolist() for place in (options.to, here)]
    settings = {"arrival_km": options.arrival_km, "confidence": options.confidence, "north": options.north}
    board = Onboard(policy, sensor_std=SensorStd(options.noise, options.bias), **settings)
    board.start(target or places[0], places[1], here_std=known_elements(here, date=options.date)[1] if here else None)
    return board


def link(options: argparse.Namespace) -> Link:
    """Return the link that the options name."""
    kind, names = (NmeaLink, _NMEA) if options.nmea else (MavlinkLink, _MAVLINK)
    given = {name: value for name in (*_NMEA, *_MAVLINK) if (value := getattr(options, name)) not in (None, False)}
    if unused := ", ".join(f"--{name.removesuffix('_m_s')}" for name in given if name not in names):
        raise ValueError(f"{unused} has no effect {'with' if options.nmea else 'without'} --nmea: leave it out")
    given |= {"north": options.north} if options.nmea else {}
    try:
        return kind(options.address, **given)
    except (OSError, OverflowError) as error:
        raise ValueError(f"cannot open {options.address}: {error}") from error


def line(number: int, order: Command, note: str) -> str:
    """Return a command as text."""
    north, east = order.way_km
    texts = f"stop: {order.stop}, {order.reason}" if order.stop else order.reason, note
    return (
        f"{number}: steer {order.heading_deg:.0f} deg for {order.distance_km:.1f} km; to go {north:.0f} km north, "
        f"{east:.0f} km east, within {order.radius_km:.0f} km" + "".join(f"; {text}" for text in texts if text)
    )


class _Radio(logging.Handler):
    """Send what is logged to the operator."""

    def __init__(self, link: Link) -> None:
        super().__init__(logging.WARNING)
        self._link = link

    def emit(self, record: logging.LogRecord) -> None:
        with suppress(OSError):
            self._link.report(None, record.getMessage())


if __name__ == "__main__":
    main()
