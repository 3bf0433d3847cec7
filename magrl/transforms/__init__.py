"""Transforms for any TorchRL environment: scaling, gradient guidance and its reward, sensor noise.

A transform handles keys and specs; the mathematics is in :mod:`magrl.guidance` and :mod:`magrl.field`. Every
transform takes ``in_keys`` and ``out_keys`` (nested ones too), works in ``Compose``, and in a replay buffer or as a
module where that makes sense.
"""

from magrl.transforms.arrival import DeclareArrival
from magrl.transforms.conditions import CONDITIONS, Conditions, conditions_named, with_conditions
from magrl.transforms.errors import TRUE_KEYS
from magrl.transforms.guidance import AlignmentReward, FieldGradient, GradientHeading
from magrl.transforms.motion import MotionError
from magrl.transforms.north import NORTH_REFERENCES, NorthReferenceError, north_reference
from magrl.transforms.observation import AngleVector, TargetDifference
from magrl.transforms.scaling import MinMaxNorm
from magrl.transforms.search import SearchAim
from magrl.transforms.sensor_errors import SensorErrors
from magrl.transforms.sensors import RandomSensorNoise, SensorNoise, sensor_levels, with_sensor_noise
from magrl.transforms.track import TrackGradient
from magrl.transforms.track_view import TrackObservation, TrackView
from magrl.transforms.vector_errors import VectorErrors
from magrl.transforms.view import ObservationView
from magrl.transforms.way import DetourReward, DistanceCost, TrueWay
from magrl.transforms.weather import SPEEDS_KM_H, MagneticWeather

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
