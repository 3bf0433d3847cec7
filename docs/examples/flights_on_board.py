"""Fly vehicles with a compass on board alone: plain numbers in, commands out, the world by other libraries.

    python docs/examples/flights_on_board.py --flights 100 --seed 2026

The field is from ppigrf, positions follow geographiclib's geodesics, readings have white noise of .05 degrees and
5 nT, and the vehicle measures no D. Starts are between 60 degrees south and north, destinations at 300 to 500 km.
"""

from __future__ import annotations

import argparse
import datetime
import math
import random
from collections import Counter

from magrl.vehicle.onboard import Onboard

import numpy as np
import ppigrf
from geographiclib.geodesic import Geodesic

DATE = datetime.datetime(2026, 1, 1)
STD = (0.0, 0.05, 5.0)
EARTH = Geodesic.WGS84


def elements(latitude: float, longitude: float) -> tuple[float, float, float]:
    """Return D [deg], I [deg], B_H [nT]."""
    east, north, up = (float(np.squeeze(part)) for part in ppigrf.igrf(longitude, latitude, 0, DATE))
    level = math.hypot(east, north)
    return math.degrees(math.atan2(east, north)), math.degrees(math.atan2(-up, level)), level


def fly(navigator: str, rng: random.Random) -> tuple[str, float, float]:
    """Return how a flight stopped, the distance left [km], and the path over the shortest one."""
    edge = math.sin(math.radians(60))
    here = math.degrees(math.asin(rng.uniform(-edge, edge))), rng.uniform(-180, 180)
    bearing, way_km = rng.uniform(0, 360), rng.uniform(300, 500)
    there = EARTH.Direct(*here, bearing, 1000 * way_km)
    there = there["lat2"], there["lon2"]
    vehicle = Onboard(navigator, north="magnetic", sensor_std=STD, max_steps=120)
    vehicle.start((None, *elements(*there)[1:]))
    heading, distance, path = rng.uniform(0, 360), 0.0, 0.0
    while True:
        declination, *field = elements(*here)
        reading = (value + rng.gauss(0, std) for value, std in zip(field, STD[1:], strict=True))
        command = vehicle.step(None, *reading, heading=heading, distance=distance)
        if command.stop:
            return command.stop, EARTH.Inverse(*here, *there)["s12"] / 1000, path / way_km
        heading, distance = command.heading_deg, command.distance_km
        moved = EARTH.Direct(*here, heading + declination, 1000 * distance)  # the compass steers from magnetic north
        here, path = (moved["lat2"], moved["lon2"]), path + distance


def main() -> None:
    """Fly and print how the flights ended."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--navigator", default="anywhere", help="anywhere, kalman or secant")
    parser.add_argument("--flights", type=int, default=100)
    parser.add_argument("--seed", type=int, default=2026)
    options = parser.parse_args()
    rng, ends = random.Random(options.seed), []
    for number in range(options.flights):
        ends.append(fly(options.navigator, rng))
        print("{}: {}, {:.1f} km left, path {:.2f} times the shortest".format(number, *ends[-1]), flush=True)
    false = sum(stop == "arrived" and left > 25 for stop, left, _ in ends)
    print(f"{sum(left <= 25 for _, left, _ in ends)} of {len(ends)} end within 25 km; {false} arrived falsely")
    print(*(f"{count} {stop}" for stop, count in Counter(stop for stop, *_ in ends).items()), sep=", ")


if __name__ == "__main__":
    main()
