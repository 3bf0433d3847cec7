"""Transforms for any TorchRL environment: scaling, gradient guidance and its reward.

A transform handles keys and specs; the mathematics is in :mod:`magrl.guidance` and :mod:`magrl.field`. Every
transform takes ``in_keys`` and ``out_keys`` (nested ones too), works in ``Compose``, and in a replay buffer or as a
module where that makes sense.
"""

from magrl.transforms.alignment import AlignmentReward as AlignmentReward
from magrl.transforms.alignment import FieldGradient as FieldGradient
from magrl.transforms.alignment import GradientHeading as GradientHeading
from magrl.transforms.areas import NoGoAreas as NoGoAreas
from magrl.transforms.areas import Shield as Shield
from magrl.transforms.currents import CurrentReading as CurrentReading
from magrl.transforms.currents import ExpectedCurrents as ExpectedCurrents
from magrl.transforms.legs import Fix as Fix
from magrl.transforms.legs import RecentLegs as RecentLegs
from magrl.transforms.rewards import DistanceCost as DistanceCost
from magrl.transforms.rewards import EpisodeSum as EpisodeSum
from magrl.transforms.rewards import HighestSPL as HighestSPL
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
