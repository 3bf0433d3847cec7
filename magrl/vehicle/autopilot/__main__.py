"""Steer an autopilot to a destination by the magnetic field.

    python -m magrl.vehicle.autopilot udpin:0.0.0.0:14550 --target 61.5 8.1 --date 2026-06-30 --noise 0.05 0.05 5
    python -m magrl.vehicle.autopilot /dev/ttyUSB0,57600 --target 0 75.4 13240 --north magnetic --noise 0 0.1 20
    python -m magrl.vehicle.autopilot udp:10110 --nmea --target 61.5 1.2 --date 2026-06-30 --noise 0.1 0.05 20

The vehicle must move, and its operator chooses the mode in which it takes headings (docs/onboard.md).
Messages are written to the folder of the flight; the same command continues an interrupted flight.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path

from magrl.checks import command
from magrl.sensor_std import SensorStd
from magrl.tracking import NEWEST
from magrl.vehicle.autopilot.flight import Link, fly
from magrl.vehicle.autopilot.loop import LOG, Loop
from magrl.vehicle.autopilot.mavlink import MavlinkLink
from magrl.vehicle.autopilot.nmea import NmeaLink
from magrl.vehicle.logs import Calibration
from magrl.vehicle.onboard import Command, Onboard
from magrl.vehicle.onboard.doubt import LEAST_FIT


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    text = argparse.RawDescriptionHelpFormatter
    arguments = argparse.ArgumentParser("python -m magrl.vehicle.autopilot", description=__doc__, formatter_class=text)
    add = arguments.add_argument
    add("address", help="MAVLink: an address of pymavlink; NMEA: udp:PORT; or a serial port and its rate, PORT,RATE")
    place = "latitude and longitude, or D, I, B_H"
    add("--target", type=float, nargs="+", required=True, help=f"destination: {place}")
    add("--target-elements", type=float, nargs=3, help="D, I, B_H measured at a target given by its place")
    add("--target-std", type=float, nargs=3, help="errors of measured D, I, B_H there, with the crust")
    add("--start", type=float, nargs="+", help=f"start, where it is known: {place}")
    add("--start-km", type=float, default=0.1, help="error of the place of the start [km]; default 0.1")
    add("--date", help="date of the flight, such as 2026-06-30, for the model of the Earth")
    add("--model", default=NEWEST, help=f"model of the Earth: IGRF-14, IGRF-13, IGRF-2005, ...; default {NEWEST}")
    add("--drift", type=float, default=0.03, help="errors of log and current [share of the distance]; default 0.03")
    add("--altitude", type=float, default=0.0, help="altitude of the flight, for the model [km]; default 0")
    add("--navigator", default="anywhere", help="anywhere, kalman, memory, secant, or a policy file; default anywhere")
    add("--north", choices=("true", "magnetic"), default="true", help="north of the vehicle; default true")
    add("--noise", type=float, nargs=3, required=True, help="standard deviations of readings [deg deg nT]")
    add("--bias", type=float, nargs=3, help="the same of constant errors [deg deg nT]; default from --calibration")
    add("--calibration", type=Path, help="file of a calibration, of python -m magrl.vehicle.logs --calibrate")
    add("--read-s", type=float, default=30.0, help="duration of a reading [s]; default 30")
    add("--radius-km", type=float, default=25.0, help="radius of the destination [km]; default 25")
    add("--confidence", type=float, default=0.8, help="minimum probability of arrival to stop; default 0.8")
    add("--nmea", action="store_true", help="the link is NMEA 0183; default MAVLink")
    add("--level", action="store_true", help="NMEA: the magnetometer is level, without XDR of PTCH and ROLL")
    add("--speed", help="NMEA: water or ground; default water")
    add("--sources", nargs="+", help="NMEA: sentences that count, such as HEHDT IIXDR; default the first ones")
    add("--autopilot", type=int, nargs=2, metavar=("SYSTEM", "COMPONENT"), help="MAVLink: default the first one")
    add("--cruise", type=float, dest="cruise_m_s", help="MAVLink: speed to command to others than fixed wings [m/s]")
    add("--out", type=Path, default=Path("runs/autopilot"), help="folder of the flight; default runs/autopilot")
    return arguments


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line and steer until the vehicle stops."""
    command("python -m magrl.vehicle.autopilot", lambda: _main(parser().parse_args(args)), ValueError, ImportError)


def _main(options: argparse.Namespace) -> None:
    if options.altitude and not options.date:
        raise ValueError("--altitude is for the model of the Earth, which needs --date, the date of the flight")
    calibration = Calibration.load(options.calibration) if options.calibration else None
    options.bias = options.bias or (calibration.std if calibration else (0.0, 0.0, 0.0))
    loop, connection = Loop(vehicle(options), read_s=options.read_s, calibration=calibration), link(options)
    LOG.handlers = [logging.StreamHandler(sys.stdout)]
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
        raise


def vehicle(options: argparse.Namespace) -> Onboard:
    """Return the navigator at its start."""
    settings = {"radius_km": options.radius_km, "confidence": options.confidence, "north": options.north}
    settings |= {"drift": options.drift}
    board = Onboard(options.navigator, sensor_std=SensorStd(options.noise, options.bias), **settings)
    told = {"date": options.date, "model": options.model, "start_km": options.start_km}
    told |= {"target_elements": options.target_elements, "target_std": options.target_std}
    board.start(options.target, options.start, **told, altitude_km=options.altitude)
    return board


def link(options: argparse.Namespace) -> Link:
    """Return the link that the options name."""
    names = ("speed", "level", "sources", "cruise_m_s", "autopilot")
    given = {name: value for name in names if (value := getattr(options, name)) not in (None, False)}
    try:
        if options.nmea:
            return NmeaLink(options.address, north=options.north, **given)
        return MavlinkLink(options.address, **given)
    except TypeError as error:
        raise ValueError(f"an option has no effect on this link: {error}") from error
    except (OSError, OverflowError) as error:
        raise ValueError(f"cannot open {options.address}: {error}") from error


def line(number: int, order: Command, note: str) -> str:
    """Return a command as text."""
    north, east = order.way_km
    doubt = f"readings hardly fit what is stated (p = {order.fit:.1g})" if order.fit < LEAST_FIT else ""
    texts = f"stop: {order.stop}, {order.reason}" if order.stop else order.reason, doubt, note
    return (
        f"{number}: steer {order.heading_deg:.0f} deg for {order.distance_km:.1f} km; to go {north:.0f} km north, "
        f"{east:.0f} km east, within {order.error_radius_km:.0f} km" + "".join(f"; {text}" for text in texts if text)
    )


if __name__ == "__main__":
    main()
