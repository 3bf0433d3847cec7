"""Logs of vehicles: readers, calibration, readings of D, I, B_H from three axes and an attitude, and mistakes."""

from magrl.vehicle.logs.calibration import Calibration as Calibration
from magrl.vehicle.logs.calibration import calibrate as calibrate
from magrl.vehicle.logs.conventions import attitude_of as attitude_of
from magrl.vehicle.logs.conventions import axes_of_elements as axes_of_elements
from magrl.vehicle.logs.conventions import elements_of_axes as elements_of_axes
from magrl.vehicle.logs.conventions import from_enu as from_enu
from magrl.vehicle.logs.conventions import rotation as rotation
from magrl.vehicle.logs.readers import read_log as read_log
from magrl.vehicle.logs.readings import difference_from_igrf as difference_from_igrf
from magrl.vehicle.logs.readings import joined as joined
from magrl.vehicle.logs.readings import mistakes as mistakes
from magrl.vehicle.logs.readings import read_readings as read_readings
from magrl.vehicle.logs.readings import readings_of as readings_of
from magrl.vehicle.logs.samples import Log as Log
