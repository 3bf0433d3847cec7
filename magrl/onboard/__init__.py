"""Navigation on board one vehicle: a navigator behind plain numbers, its limits, and its step for other programs."""

from magrl.onboard.readings import check_earth_jump, check_earth_reading
from magrl.onboard.step import VehicleStep, first_state, write_step
from magrl.onboard.vehicle import NAMED, Command, Onboard

__all__ = [
    "NAMED",
    "Command",
    "Onboard",
    "VehicleStep",
    "check_earth_jump",
    "check_earth_reading",
    "first_state",
    "write_step",
]
