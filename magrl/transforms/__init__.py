"""Transforms for any TorchRL environment: scaling, gradient guidance and its reward, sensor noise.

A transform handles keys and specs; the mathematics is in :mod:`magrl.guidance` and :mod:`magrl.field`. Every
transform takes ``in_keys`` and ``out_keys`` (nested ones too), works in ``Compose``, and in a replay buffer or as a
module where that makes sense.
"""

from magrl.transforms.guidance import AlignmentReward, FieldGradient, GradientHeading
from magrl.transforms.observation import AngleVector, TargetDifference
from magrl.transforms.scaling import MinMaxNorm
from magrl.transforms.sensors import RandomSensorNoise, SensorNoise, sensor_levels, with_sensor_noise
from magrl.transforms.track import TrackGradient
from magrl.transforms.track_view import TrackObservation, TrackView
from magrl.transforms.view import ObservationView
from magrl.transforms.way import DetourReward, DistanceCost, TrueWay

__all__ = [
    "AlignmentReward",
    "AngleVector",
    "DetourReward",
    "DistanceCost",
    "FieldGradient",
    "GradientHeading",
    "MinMaxNorm",
    "ObservationView",
    "RandomSensorNoise",
    "SensorNoise",
    "TargetDifference",
    "TrackGradient",
    "TrackObservation",
    "TrackView",
    "TrueWay",
    "sensor_levels",
    "with_sensor_noise",
]
