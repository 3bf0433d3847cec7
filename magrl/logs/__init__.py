"""Logs of vehicles: from three axes and an attitude to D, I, B_H."""

from magrl.logs.calibration import Calibration as Calibration
from magrl.logs.calibration import calibrate as calibrate
from magrl.logs.vectors import MeasuredElements as MeasuredElements
from magrl.logs.vectors import attitude_of as attitude_of
from magrl.logs.vectors import axes_of_elements as axes_of_elements
from magrl.logs.vectors import elements_of_axes as elements_of_axes
from magrl.logs.vectors import from_enu as from_enu
from magrl.logs.vectors import rotation as rotation
