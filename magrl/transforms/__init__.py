"""Transforms for any TorchRL environment: scaling, gradient guidance and its reward, sensor noise.

A transform handles keys and specs; the mathematics is in :mod:`magrl.guidance` and :mod:`magrl.field`. Every
transform takes ``in_keys`` and ``out_keys`` (nested ones too), works in ``Compose``, and in a replay buffer or as a
module where that makes sense.
"""

from magrl.transforms.alignment import AlignmentReward as AlignmentReward
from magrl.transforms.alignment import FieldGradient as FieldGradient
from magrl.transforms.alignment import GradientHeading as GradientHeading
from magrl.transforms.areas import NoGoAreas as NoGoAreas
from magrl.transforms.errors.base import true_keys as true_keys
from magrl.transforms.errors.conditions import CONDITIONS as CONDITIONS
from magrl.transforms.errors.conditions import ERRORS as ERRORS
from magrl.transforms.errors.conditions import Conditions as Conditions
from magrl.transforms.errors.conditions import conditions_named as conditions_named
from magrl.transforms.errors.conditions import load_conditions as load_conditions
from magrl.transforms.errors.conditions import with_conditions as with_conditions
from magrl.transforms.errors.known import KnownPlace as KnownPlace
from magrl.transforms.errors.magnetic_north import MagneticNorth as MagneticNorth
from magrl.transforms.errors.motion import MotionError as MotionError
from magrl.transforms.errors.north import NORTH_REFERENCES as NORTH_REFERENCES
from magrl.transforms.errors.north import NorthReferenceError as NorthReferenceError
from magrl.transforms.errors.north import north_reference as north_reference
from magrl.transforms.errors.sensors import SensorErrors as SensorErrors
from magrl.transforms.errors.sensors import sensor_levels as sensor_levels
from magrl.transforms.errors.spikes import Spikes as Spikes
from magrl.transforms.errors.target import TargetErrors as TargetErrors
from magrl.transforms.errors.vector import VectorErrors as VectorErrors
from magrl.transforms.errors.weather import MagneticWeather as MagneticWeather
from magrl.transforms.legs import Fix as Fix
from magrl.transforms.legs import RecentLegs as RecentLegs
from magrl.transforms.rewards import DistanceCost as DistanceCost
from magrl.transforms.rewards import EpisodeSum as EpisodeSum
from magrl.transforms.rewards import HighestSPL as HighestSPL
from magrl.transforms.rewards import ProgressReward as ProgressReward
from magrl.transforms.rewards import RandomStepPrice as RandomStepPrice
from magrl.transforms.rewards import SPLReward as SPLReward
from magrl.transforms.rewards import TrueDisplacement as TrueDisplacement
from magrl.transforms.scaling import MinMaxNorm as MinMaxNorm
from magrl.transforms.sequences import ReadingObservation as ReadingObservation
from magrl.transforms.track import DeclareArrival as DeclareArrival
from magrl.transforms.track import TrackField as TrackField
from magrl.transforms.views import AngleVector as AngleVector
from magrl.transforms.views import LegsView as LegsView
from magrl.transforms.views import ObservationView as ObservationView
from magrl.transforms.views import ReadingView as ReadingView
from magrl.transforms.views import TargetDifference as TargetDifference

TRUE_KEYS = true_keys()
"""Default keys of the errors of this package that a policy may not read."""
