"""Navigation on board one vehicle: a navigator behind plain numbers, its limits, and its step for other programs."""

from magrl.vehicle.onboard.readings import check_earth_jump as check_earth_jump
from magrl.vehicle.onboard.readings import check_earth_reading as check_earth_reading
from magrl.vehicle.onboard.step import VehicleStep as VehicleStep
from magrl.vehicle.onboard.step import first_state as first_state
from magrl.vehicle.onboard.step import write_step as write_step
from magrl.vehicle.onboard.vehicle import NAMED as NAMED
from magrl.vehicle.onboard.vehicle import Command as Command
from magrl.vehicle.onboard.vehicle import Onboard as Onboard
