"""The navigation environment, its scenarios and tasks, and its Gymnasium interface (:mod:`magrl.envs.gymnasium`)."""

from magrl.envs.geomagnetic import PRIVILEGED_KEYS, PUBLIC_KEYS, GeomagneticNavEnv
from magrl.envs.region import PAPER_REGION, Region
from magrl.envs.scenario import Scenario, load_scenario
from magrl.envs.tasks import TASK_SETS, Tasks, named_tasks, task_set

__all__ = [
    "PAPER_REGION",
    "PRIVILEGED_KEYS",
    "PUBLIC_KEYS",
    "TASK_SETS",
    "GeomagneticNavEnv",
    "Region",
    "Scenario",
    "Tasks",
    "load_scenario",
    "named_tasks",
    "task_set",
]
