"""Navigation by the Earth's magnetic field: a TorchRL environment, transforms and what trains on them.

Importing the package registers ``magrl/GeomagneticNavigation-v0`` and ``magrl/GeomagneticNavigationAnywhere-v0`` with
Gymnasium. The names in ``magrl.__all__`` are
loaded when first used, so that the import does not load torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import gymnasium as _gymnasium

__version__ = "0.2.0"

_PACKAGES = {
    "field": ("IGRF", "RegionalField", "SphericalHarmonicField"),
    "transforms": (
        "AlignmentReward",
        "AngleVector",
        "FieldGradient",
        "GradientHeading",
        "MinMaxNorm",
        "ObservationView",
        "TargetDifference",
    ),
    "envs": (
        "GeomagneticNavEnv",
        "Region",
        "Scenario",
        "Tasks",
        "earth_scenario",
        "load_scenario",
        "planet_scenario",
        "task_set",
    ),
    "agents": ("FieldPolicy", "export_policy", "load_policy", "load_pretrained", "save_policy"),
    "evaluation": ("episode_measures", "evaluate", "evaluation_rollout", "summarize"),
}
_HOMES = {name: package for package, names in _PACKAGES.items() for name in names}
__all__ = ["__version__", *_HOMES]

if TYPE_CHECKING:  # the same names for type checkers and editors
    from magrl.agents import FieldPolicy as FieldPolicy
    from magrl.agents import export_policy as export_policy
    from magrl.agents import load_policy as load_policy
    from magrl.agents import load_pretrained as load_pretrained
    from magrl.agents import save_policy as save_policy
    from magrl.envs import GeomagneticNavEnv as GeomagneticNavEnv
    from magrl.envs import Region as Region
    from magrl.envs import Scenario as Scenario
    from magrl.envs import Tasks as Tasks
    from magrl.envs import earth_scenario as earth_scenario
    from magrl.envs import load_scenario as load_scenario
    from magrl.envs import planet_scenario as planet_scenario
    from magrl.envs import task_set as task_set
    from magrl.evaluation import episode_measures as episode_measures
    from magrl.evaluation import evaluate as evaluate
    from magrl.evaluation import evaluation_rollout as evaluation_rollout
    from magrl.evaluation import summarize as summarize
    from magrl.field import IGRF as IGRF
    from magrl.field import RegionalField as RegionalField
    from magrl.field import SphericalHarmonicField as SphericalHarmonicField
    from magrl.transforms import AlignmentReward as AlignmentReward
    from magrl.transforms import AngleVector as AngleVector
    from magrl.transforms import FieldGradient as FieldGradient
    from magrl.transforms import GradientHeading as GradientHeading
    from magrl.transforms import MinMaxNorm as MinMaxNorm
    from magrl.transforms import ObservationView as ObservationView
    from magrl.transforms import TargetDifference as TargetDifference


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'magrl' has no attribute {name!r}")
    return getattr(import_module(f"magrl.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])


for _name, _kind in (("GeomagneticNavigation", "GeomagneticNav"), ("GeomagneticNavigationAnywhere", "Anywhere")):
    if f"magrl/{_name}-v0" not in _gymnasium.registry:
        _gymnasium.register(
            f"magrl/{_name}-v0",
            entry_point=f"magrl.envs.gymnasium:{_kind}GymEnv",
            vector_entry_point=f"magrl.envs.gymnasium:{_kind}VectorEnv",
        )
