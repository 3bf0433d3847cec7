"""Navigation by the Earth's magnetic field: a TorchRL environment, transforms and what trains on them.

The names below are loaded when first used, so that importing the package costs no more than Python itself.
"""

from importlib import import_module
from typing import Any

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


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'magrl' has no attribute {name!r}")
    return getattr(import_module(f"magrl.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
