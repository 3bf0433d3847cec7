"""Transforms for any TorchRL environment: scaling, gradient guidance and its reward.

A transform handles keys and specs; the mathematics is in :mod:`magrl.guidance` and :mod:`magrl.fields`. Every
transform takes ``in_keys`` and ``out_keys`` (nested ones too), works in ``Compose``, and in a replay buffer or as a
module where that makes sense.
"""

from magrl.transforms.observation import AngleVector, FieldGradient, GradientHeading, TargetDifference
from magrl.transforms.reward import AlignmentReward
from magrl.transforms.scaling import MinMaxNorm

__all__ = ["AlignmentReward", "AngleVector", "FieldGradient", "GradientHeading", "MinMaxNorm", "TargetDifference"]
