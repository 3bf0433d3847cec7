"""Navigation on board one vehicle: a navigator behind plain numbers, and its limits."""

from magrl.vehicle.onboard.journal import Command as Command
from magrl.vehicle.onboard.limits import check_earth_jump as check_earth_jump
from magrl.vehicle.onboard.limits import check_earth_reading as check_earth_reading
from magrl.vehicle.onboard.vehicle import Onboard as Onboard
