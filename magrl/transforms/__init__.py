"""Transforms for any TorchRL environment: scaling, gradient guidance and its reward, sensor noise.

A transform handles keys and specs; the mathematics is in :mod:`magrl.guidance` and :mod:`magrl.field`. Every
transform takes ``in_keys`` and ``out_keys`` (nested ones too), works in ``Compose``, and in a replay buffer or as a
module where that makes sense.
"""

from magrl.transforms.alignment import AlignmentReward, FieldGradient, GradientHeading
from magrl.transforms.declaration import DeclareArrival
from magrl.transforms.errors.conditions import CONDITIONS, TRUE_KEYS, Conditions, conditions_named, with_conditions
from magrl.transforms.errors.motion import MotionError
from magrl.transforms.errors.noise import RandomSensorNoise, SensorNoise, sensor_levels, with_sensor_noise
from magrl.transforms.errors.north import NORTH_REFERENCES, NorthReferenceError, north_reference
from magrl.transforms.errors.sensors import SensorErrors
from magrl.transforms.errors.vector import VectorErrors
from magrl.transforms.errors.weather import SPEEDS_KM_H, MagneticWeather
from magrl.transforms.rewards import DetourReward, DistanceCost, TrueWay
from magrl.transforms.scaling import MinMaxNorm
from magrl.transforms.track import SearchAim, TrackGradient
from magrl.transforms.views import AngleVector, ObservationView, TargetDifference, TrackObservation, TrackView

__all__ = [
    "CONDITIONS",
    "NORTH_REFERENCES",
    "SPEEDS_KM_H",
    "TRUE_KEYS",
    "AlignmentReward",
    "AngleVector",
    "Conditions",
    "DeclareArrival",
    "DetourReward",
    "DistanceCost",
    "FieldGradient",
    "GradientHeading",
    "MagneticWeather",
    "MinMaxNorm",
    "MotionError",
    "NorthReferenceError",
    "ObservationView",
    "RandomSensorNoise",
    "SearchAim",
    "SensorErrors",
    "SensorNoise",
    "TargetDifference",
    "TrackGradient",
    "TrackObservation",
    "TrackView",
    "TrueWay",
    "VectorErrors",
    "conditions_named",
    "north_reference",
    "sensor_levels",
    "with_conditions",
    "with_sensor_noise",
]
