"""Steer by commands: read, step, save, steer, over and over; an interrupted flight goes on from its files."""

from pathlib import Path

from magrl.field import IGRF, elements_at
from magrl.files import read_document, write_json
from magrl.geodesy import move_place
from magrl.onboard import Onboard

import torch

state, log = Path("flight.json"), Path("ship.json")  # of the navigator; of the simulated ship, as it would go on
field, reported_km = IGRF("2026-06-30"), 0.0
ship = {"place": [60.4, 5.3], "heading": 290.0, "odometer_km": 0.0}


def read():
    """Return D, I, B_H, and heading and distance since the last step that was saved."""
    elements = elements_at(field, torch.tensor(ship["place"]).double()).tolist()
    return *elements, ship["heading"], max(ship["odometer_km"] - reported_km, 0.0)


def steer(heading, distance):
    """Return at the end of the leg."""
    leg, course = torch.tensor((distance, heading)).double()
    place = move_place(torch.tensor(ship["place"]).double(), course.deg2rad(), leg).tolist()
    ship.update(place=place, heading=heading, odometer_km=ship["odometer_km"] + distance)
    write_json(log, ship)


vehicle = Onboard("kalman", sensor_std=(0.02, 0.02, 2.0))
if state.exists():
    vehicle.restore(state)
    reported_km = sum(step["distance"] for step in read_document(state)["steps"])
    ship = read_document(log) if log.exists() else ship
else:
    log.unlink(missing_ok=True)
    vehicle.start((62.0, 0.0), (60.4, 5.3), date="2026-06-30")  # to, from: latitude, longitude
command = vehicle.step(*read())
while not command.stop:
    vehicle.save(state)
    reported_km = ship["odometer_km"]
    steer(command.heading_deg, command.distance_km)
    command = vehicle.step(*read())
print(command.stop, *(round(degrees, 1) for degrees in ship["place"]))
if command.stop != "arrived":
    raise SystemExit(command.reason)
state.unlink()
log.unlink()
