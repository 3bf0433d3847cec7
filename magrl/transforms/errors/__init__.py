"""Errors of sensors, north reference and motion, magnetic weather, and presets of these as conditions."""

from magrl.transforms.errors.base import TRUE_KEYS
from magrl.transforms.errors.conditions import CONDITIONS, Conditions, conditions_named, with_conditions
from magrl.transforms.errors.motion import MotionError
from magrl.transforms.errors.noise import RandomSensorNoise, SensorNoise, sensor_levels, with_sensor_noise
from magrl.transforms.errors.north import NORTH_REFERENCES, NorthReferenceError, north_reference
from magrl.transforms.errors.sensors import SensorErrors
from magrl.transforms.errors.vector import VectorErrors
from magrl.transforms.errors.weather import SPEEDS_KM_H, MagneticWeather

__all__ = [
    "CONDITIONS",
    "NORTH_REFERENCES",
    "SPEEDS_KM_H",
    "TRUE_KEYS",
    "Conditions",
    "MagneticWeather",
    "MotionError",
    "NorthReferenceError",
    "RandomSensorNoise",
    "SensorErrors",
    "SensorNoise",
    "VectorErrors",
    "conditions_named",
    "north_reference",
    "sensor_levels",
    "with_conditions",
    "with_sensor_noise",
]
