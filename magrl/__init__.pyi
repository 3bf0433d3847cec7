"""Public names and their packages. ``magrl/__init__.py`` loads them when they are first used."""

from .envs import GeomagneticNavEnv as GeomagneticNavEnv
from .envs import Region as Region
from .envs import Scenario as Scenario
from .envs import Trips as Trips
from .envs import earth_scenario as earth_scenario
from .envs import load_scenario as load_scenario
from .envs import planet_scenario as planet_scenario
from .envs import trip_set as trip_set
from .evaluation import Flight as Flight
from .evaluation import episode_measures as episode_measures
from .evaluation import evaluate as evaluate
from .evaluation import evaluation_rollout as evaluation_rollout
from .evaluation import score as score
from .evaluation import summarize as summarize
from .field import IGRF as IGRF
from .field import RegionalField as RegionalField
from .field import SphericalHarmonicField as SphericalHarmonicField
from .navigators import Anywhere as Anywhere
from .navigators import FieldPolicy as FieldPolicy
from .navigators import Kalman as Kalman
from .navigators import export_policy as export_policy
from .navigators import load_policy as load_policy
from .navigators import save_policy as save_policy
from .transforms import AlignmentReward as AlignmentReward
from .transforms import AngleVector as AngleVector
from .transforms import FieldGradient as FieldGradient
from .transforms import GradientHeading as GradientHeading
from .transforms import MinMaxNorm as MinMaxNorm
from .transforms import ObservationView as ObservationView
from .transforms import TargetDifference as TargetDifference

__version__: str
__all__: list[str]
