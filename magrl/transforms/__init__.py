"""Transforms for any TorchRL environment: scaling, gradient guidance and its reward.

A transform handles keys and specs; the mathematics is in :mod:`magrl.guidance` and :mod:`magrl.field`. Every
transform takes ``in_keys`` and ``out_keys`` (nested ones too), works in ``Compose``, and in a replay buffer or as a
module where that makes sense.
"""

from magrl.transforms.guidance import AlignmentReward, FieldGradient, GradientHeading
from magrl.transforms.observation import AngleVector, TargetDifference
from magrl.transforms.scaling import MinMaxNorm
from magrl.transforms.view import ObservationView

__all__ = [
    "AlignmentReward",
    "AngleVector",
    "FieldGradient",
    "GradientHeading",
    "MinMaxNorm",
    "ObservationView",
    "TargetDifference",
]
