"""Logs of vehicles: readers, calibration, readings of D, I, B_H from three axes and an attitude, and mistakes."""

from magrl.logs.calibration import Calibration as Calibration
from magrl.logs.calibration import calibrate as calibrate
from magrl.logs.comparison import difference_from_igrf as difference_from_igrf
from magrl.logs.comparison import mistakes as mistakes
from magrl.logs.readers import read_log as read_log
from magrl.logs.readings import joined as joined
from magrl.logs.readings import read_readings as read_readings
from magrl.logs.readings import readings_of as readings_of
from magrl.logs.samples import Log as Log
from magrl.logs.samples import samples_of as samples_of
from magrl.logs.vectors import MeasuredElements as MeasuredElements
from magrl.logs.vectors import attitude_of as attitude_of
from magrl.logs.vectors import axes_of_elements as axes_of_elements
from magrl.logs.vectors import elements_of_axes as elements_of_axes
from magrl.logs.vectors import from_enu as from_enu
from magrl.logs.vectors import rotation as rotation
