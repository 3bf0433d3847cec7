"""Navigation by the Earth's magnetic field: a TorchRL environment, transforms and what trains on them.

The names in ``magrl.__all__`` are loaded when first used, so that importing the package costs no more than Python
itself.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_HOMES = {
    "IGRF": "fields",
    "RegionalField": "regional",
    "SphericalHarmonicField": "fields",
    "GeomagneticNavEnv": "env",
    "Region": "tasks",
    "Tasks": "tasks",
    "task_set": "tasks",
    "World": "worlds",
    "load_world": "worlds",
    "AlignmentReward": "transforms",
    "AngleVector": "transforms",
    "FieldGradient": "transforms",
    "GradientHeading": "transforms",
    "MinMaxNorm": "transforms",
    "TargetDifference": "transforms",
    "FieldPolicy": "td3",
    "load_policy": "td3",
    "save_policy": "td3",
    "episode_measures": "metrics",
    "summarise": "metrics",
}
__all__ = ["__version__", *_HOMES]

if TYPE_CHECKING:  # the same names for type checkers and editors
    from magrl.env import GeomagneticNavEnv as GeomagneticNavEnv
    from magrl.fields import IGRF as IGRF
    from magrl.fields import SphericalHarmonicField as SphericalHarmonicField
    from magrl.metrics import episode_measures as episode_measures
    from magrl.metrics import summarise as summarise
    from magrl.regional import RegionalField as RegionalField
    from magrl.tasks import Region as Region
    from magrl.tasks import Tasks as Tasks
    from magrl.tasks import task_set as task_set
    from magrl.td3 import FieldPolicy as FieldPolicy
    from magrl.td3 import load_policy as load_policy
    from magrl.td3 import save_policy as save_policy
    from magrl.transforms import AlignmentReward as AlignmentReward
    from magrl.transforms import AngleVector as AngleVector
    from magrl.transforms import FieldGradient as FieldGradient
    from magrl.transforms import GradientHeading as GradientHeading
    from magrl.transforms import MinMaxNorm as MinMaxNorm
    from magrl.transforms import TargetDifference as TargetDifference
    from magrl.worlds import World as World
    from magrl.worlds import load_world as load_world


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'magrl' has no attribute {name!r}")
    return getattr(import_module(f"magrl.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
