"""Estimation of the field around a vehicle, of the displacement to its destination, and of its next leg."""

from magrl.tracking.earth import earth_model as earth_model
from magrl.tracking.pilot import act as act
from magrl.tracking.pilot import advance as advance
from magrl.tracking.pilot import begin as begin
from magrl.tracking.pilot import declaring as declaring
from magrl.tracking.pilot import retargeted as retargeted
from magrl.tracking.records import Reading as Reading
from magrl.tracking.records import Rules as Rules
from magrl.tracking.records import Track as Track
