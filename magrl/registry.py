"""The named tasks: a row each, from which Gymnasium's ids, scores, commands and tables follow.

Commands and ``import magrl`` read the rows before they load torch, so that a row names functions and classes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple


class NamedTask(NamedTuple):
    """A named task. To add one, write its function, its row in :data:`NAMED_TASKS`, and its section in docs/tasks.md.

    Args:
        title: title of its section, and part of its id.
        version: version of its id; a changed task gets the next one.
        make: function in :mod:`magrl.envs.navigation` that makes its environment.
        threshold: return at which Gymnasium counts it as solved: the reference's, less the half-width of its interval.
        budget: training of each algorithm of docs/tables/sweep.py [thousands of steps]; 0 for a recipe's own.
        reference: navigator of docs/tables/bars.py that README names.
        bars: navigators there besides ``secant``, ``kalman`` and ``anywhere``, the oracle last.
        picture: navigator and episode of its picture.
        transforms: classes in :mod:`magrl.transforms` that change the episode, with their options, before the reward;
            with them, ``"base"`` is no reward.
        options: options of the environment that it changes.
        legs: whether an agent observes its last legs, by a map, instead of the readings.

    Example:
        >>> NAMED_TASKS["nogo"].id, NAMED_TASKS["box"].id
        ('magrl/GeomagneticNavigationNoGo-v0', 'magrl/GeomagneticNavigation-v0')
    """

    title: str
    version: int
    make: str
    threshold: float
    budget: Mapping[str, int] = {"PPO": 500}
    reference: str = "kalman"
    bars: tuple[str, ...] = ("geodesic",)
    picture: tuple[str, int] = ("kalman", 0)
    transforms: Mapping[str, Mapping[str, Any]] = {}
    options: Mapping[str, Any] = {}
    legs: bool = False

    @property
    def id(self) -> str:
        """Id with Gymnasium; *Box* has no title in it."""
        return f"magrl/GeomagneticNavigation{self.title.removeprefix('Box')}-v{self.version}"


_ROWS = (
    NamedTask(
        "Box",
        0,
        "navigation_env",
        16.7,
        budget={"PPO": 1000, "SAC": 50, "TD3": 50, "GG-TD3": 0},
        picture=("kalman", 3),
    ),
    NamedTask(
        "Anywhere",
        1,
        "anywhere_env",
        16.1,
        budget={"PPO": 200, "ppo_anywhere": 0},
        bars=("memory", "geodesic"),
        picture=("kalman", 2),
    ),
    NamedTask(
        "Readings",
        1,
        "readings_env",
        16.1,
        budget={"PPO": 500, "ppo_memory": 0},
        bars=("memory", "geodesic"),
        picture=("kalman", 5),
    ),
    NamedTask(
        "Storm",
        1,
        "storm_env",
        15.2,
        budget={"PPO": 500, "ppo_memory": 0},
        bars=("memory", "told", "geodesic"),
        picture=("kalman", 4),
    ),
    NamedTask(
        "NoGo",
        0,
        "no_go_env",
        16.5,
        budget={"PPO": 1000, "SAC": 50, "TD3": 50, "TD3-magrl": 0},
        reference="around",
        bars=("around", "sighted", "detour"),
        picture=("detour", 7),
        transforms={"TrueDisplacement": {}, "NoGoAreas": {}},
        options={"max_steps": 20},
    ),
    NamedTask(
        "Eddies",
        0,
        "eddies_env",
        15.4,
        budget={"PPO": 1000, "SAC": 50, "TD3": 50, "TD3-magrl": 0},
        reference="estimated",
        bars=("parallel", "offset", "estimated", "geodesic", "mapped"),
        picture=("eddies", 0),
        transforms={"MotionError": {"eddies_km_h": 0.9, "eddy_km": 250.0, "speed_km_h": 1.0}, "TrueDisplacement": {}},
        options={
            "max_leg_km": 25.0,
            "max_steps": 60,
            "arrival": "distance",
            "start_heading": "random",
            "drift_km": 111.0,  # as far as the strongest current sets a vehicle in a leg
        },
        legs=True,
    ),
)
NAMED_TASKS = {row.title.lower(): row for row in _ROWS}
"""Named tasks by name."""
