"""Errors of sensors, north reference and motion, magnetic weather, and presets of these as conditions."""

from magrl.errors.base import true_keys as true_keys
from magrl.errors.conditions import CONDITIONS as CONDITIONS
from magrl.errors.conditions import ERRORS as ERRORS
from magrl.errors.conditions import Conditions as Conditions
from magrl.errors.conditions import conditions_named as conditions_named
from magrl.errors.conditions import load_conditions as load_conditions
from magrl.errors.conditions import with_conditions as with_conditions
from magrl.errors.magnetic_north import MagneticNorth as MagneticNorth
from magrl.errors.magnetic_weather import MagneticWeather as MagneticWeather
from magrl.errors.motion import MotionError as MotionError
from magrl.errors.north import NORTH_REFERENCES as NORTH_REFERENCES
from magrl.errors.north import NorthReferenceError as NorthReferenceError
from magrl.errors.north import north_reference as north_reference
from magrl.errors.sensors import SensorErrors as SensorErrors
from magrl.errors.sensors import sensor_levels as sensor_levels
from magrl.errors.spikes import Spikes as Spikes
from magrl.errors.trip import KnownPlace as KnownPlace
from magrl.errors.trip import TargetErrors as TargetErrors
from magrl.errors.vector import VectorErrors as VectorErrors

TRUE_KEYS = true_keys()
"""Default keys of the errors of this package that a policy may not read."""
