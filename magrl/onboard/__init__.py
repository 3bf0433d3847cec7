"""Navigation on board one vehicle: a navigator behind plain numbers, and its limits."""

from magrl.onboard.journal import Command as Command
from magrl.onboard.limits import check_earth_jump as check_earth_jump
from magrl.onboard.limits import check_earth_reading as check_earth_reading
from magrl.onboard.vehicle import Onboard as Onboard
