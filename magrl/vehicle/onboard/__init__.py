"""Navigation on board one vehicle: a navigator behind plain numbers, its limits, and its step for other programs."""

from magrl.vehicle.onboard.command import Command as Command
from magrl.vehicle.onboard.export import PilotStep as PilotStep
from magrl.vehicle.onboard.export import write_step as write_step
from magrl.vehicle.onboard.limits import check_earth_jump as check_earth_jump
from magrl.vehicle.onboard.limits import check_earth_reading as check_earth_reading
from magrl.vehicle.onboard.vehicle import Onboard as Onboard
