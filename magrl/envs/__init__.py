"""The navigation environment, its scenarios and tasks, and its Gymnasium interface (:mod:`magrl.envs.gymnasium`)."""

from magrl.envs.geomagnetic import PRIVILEGED_KEYS, PUBLIC_KEYS, GeomagneticNavEnv
from magrl.envs.random_regions import earth_scenario, planet_scenario
from magrl.envs.regions import PAPER_REGION, Region, Regions
from magrl.envs.scenario import Scenario
from magrl.envs.scenario_files import load_scenario
from magrl.envs.tasks import TASK_SETS, Tasks, named_tasks, task_set

__all__ = [
    "PAPER_REGION",
    "PRIVILEGED_KEYS",
    "PUBLIC_KEYS",
    "TASK_SETS",
    "GeomagneticNavEnv",
    "Region",
    "Regions",
    "Scenario",
    "Tasks",
    "earth_scenario",
    "load_scenario",
    "named_tasks",
    "planet_scenario",
    "task_set",
]
