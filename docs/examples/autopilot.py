"""Steer by commands: read, step, steer, over and over; an interrupted flight goes on from its file."""

from pathlib import Path

from magrl.field import IGRF, elements_at
from magrl.geodesy import move_place
from magrl.onboard import Onboard

import torch

place, field = torch.tensor([60.4, 5.3]).double(), IGRF("2026-06-30")
leg = (290.0, 0.0)  # heading [deg] and length [km]


def read():
    """Return D, I, B_H, and heading and length of the leg since the last call; here, of a simulated vehicle."""
    return *elements_at(field, place).tolist(), *leg


def steer(heading, distance):
    """Return at the end of the leg."""
    global place, leg
    leg = heading, distance
    place = move_place(place, torch.tensor(heading).deg2rad(), torch.tensor(distance))


path = Path("flight.json")
vehicle = Onboard("kalman", sensor_std=(0.02, 0.02, 2.0))
if path.exists():
    vehicle.restore(path)
else:
    vehicle.start((62.0, 0.0), (60.4, 5.3), date="2026-06-30")  # to, from: latitude, longitude
command = vehicle.step(*read())
while not command.stop:
    vehicle.save(path)
    steer(command.heading_deg, command.distance_km)
    command = vehicle.step(*read())
path.unlink()
print(command.stop, *(round(degrees, 1) for degrees in place.tolist()))
