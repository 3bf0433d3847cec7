"""Estimation of the field around a vehicle, of the displacement to its destination, and of its next leg."""

from magrl.pilot.earth import earth_model as earth_model
from magrl.pilot.records import Reading as Reading
from magrl.pilot.records import Rules as Rules
from magrl.pilot.records import Track as Track
from magrl.pilot.step import act as act
from magrl.pilot.step import advance as advance
from magrl.pilot.step import advanced as advanced
from magrl.pilot.step import begin as begin
from magrl.pilot.step import declaring as declaring
from magrl.pilot.step import estimated as estimated
from magrl.pilot.step import goal_of as goal_of
from magrl.pilot.step import retargeted as retargeted
from magrl.pilot.step import started as started
