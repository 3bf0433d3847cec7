"""The named tasks: a function each, which makes its environment, with its title, version and threshold.

Training, scores, Gymnasium's ids and tables of the documentation follow from these functions. They load torch when they
are called, since ``import magrl`` reads the table before.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

if TYPE_CHECKING:
    from torchrl.envs import Transform, TransformedEnv

    from magrl.envs import Scenario
    from magrl.field import WeatherRecord

PLANET_REGIONS = 1024
"""Regions of random planets of :func:`anywhere_env`."""
STORM = Path(__file__).parent / "errors" / "storm.toml"
"""File of the errors of the task *Storm*."""
EDDY_MOTION: dict[str, Any] = {"eddies_km_h": 0.9, "eddy_km": 250.0, "speed_km_h": 1.0}
"""Options of :class:`~magrl.errors.MotionError` in the task *Eddies*."""


class NamedTask(NamedTuple):
    """A named task.

    Args:
        title: title of its section in docs/tasks.md, and part of its id.
        version: version of its id; a changed task gets the next one.
        threshold: return at which Gymnasium counts it as solved: the reference's, less the half-width of its interval.
        make: function that makes its environment, with all options of :func:`magrl.envs.navigation.navigation_env`.

    Example:
        >>> NAMED_TASKS["nogo"].id, NAMED_TASKS["box"].id
        ('magrl/GeomagneticNavigationNoGo-v1', 'magrl/GeomagneticNavigation-v1')
        >>> NAMED_TASKS["nogo"].make(4, seed=0).max_steps
        20
    """

    title: str
    version: int
    threshold: float
    make: Callable[..., TransformedEnv]

    @property
    def id(self) -> str:
        """Id with Gymnasium; *Box* has no title in it."""
        return f"magrl/GeomagneticNavigation{self.title.removeprefix('Box')}-v{self.version}"


NAMED_TASKS: dict[str, NamedTask] = {}
"""Named tasks by name, which is the title in lower case."""
Make = TypeVar("Make", bound="Callable[..., TransformedEnv]")


def named_task(title: str, *, version: int, threshold: float) -> Callable[[Make], Make]:
    """Return a decorator that adds a function to :data:`NAMED_TASKS`; other arguments are as of :class:`NamedTask`."""

    def add(make: Make) -> Make:
        NAMED_TASKS[title.lower()] = NamedTask(title, version, threshold, make)
        return make

    return add


def task_name(task: str) -> str:
    """Return the name of a named task, given its name or its id with Gymnasium.

    Raises:
        ValueError: for another text, listing the names.

    Example:
        >>> task_name("nogo"), task_name("magrl/GeomagneticNavigationNoGo-v1")
        ('nogo', 'nogo')
    """
    from magrl.checks import check_choice

    names = {row.id: name for name, row in NAMED_TASKS.items()}
    name = names.get(task, task) if isinstance(task, str) else task
    check_choice(list(NAMED_TASKS), task=name)
    return name


@named_task("Box", version=1, threshold=9.98)
def box_env(num_envs: int = 1, **options: Any) -> TransformedEnv:
    """Return the environment of the paper's task.

    Args:
        num_envs: vehicles in the batch.
        **options: of :func:`magrl.envs.navigation.navigation_env`.

    Example:
        >>> box_env(4, seed=0).rollout(3)["observation"].shape
        torch.Size([4, 3, 13])
    """
    from magrl.envs.navigation import navigation_env

    return navigation_env(num_envs, **options)


@named_task("Anywhere", version=2, threshold=9.52)
def anywhere_env(num_envs: int = 1, *, scenario: Scenario | None = None, **options: Any) -> TransformedEnv:
    """Return the environment of an agent without a map: random planets, sensors and headings.

    Args:
        num_envs: vehicles in the batch.
        scenario: scenario of any number of regions; by default :data:`PLANET_REGIONS` of random planets, with
            destinations 300 to 500 km away.
        **options: of :func:`magrl.envs.navigation.navigation_env`, with other defaults: ``observation="track"``,
            ``start_heading="random"`` and ``arrival="distance"`` unless the scenario states them, and errors of its
            sensors of random size (:func:`magrl.errors.sensor_levels`).

    Raises:
        TypeError, ValueError: as :func:`magrl.envs.navigation.navigation_env`.

    Example:
        >>> anywhere_env(4, seed=0).rollout(3)["observation"].shape
        torch.Size([4, 3, 19])
    """
    from magrl.envs.navigation import navigation_env
    from magrl.errors import SensorErrors, sensor_levels

    scenario = _planets() if scenario is None else scenario
    defaults: dict[str, Any] = {"observation": "track"}
    for name, value in {"start_heading": "random", "arrival": "distance"}.items():
        defaults[name] = scenario.given(name) or value
    defaults["transforms"] = [SensorErrors(levels=sensor_levels)]
    return navigation_env(num_envs, scenario=scenario, **defaults | options)


@cache
def _planets() -> Scenario:
    from magrl.envs import planet_scenario

    return planet_scenario(PLANET_REGIONS, seed=0, max_latitude=70.0, distance_range_km=(300.0, 500.0))


@named_task("Readings", version=2, threshold=9.52)
def readings_env(num_envs: int = 1, **options: Any) -> TransformedEnv:
    """Return the environment *Anywhere* without estimates: the agent observes raw readings and needs a memory.

    Args:
        num_envs: vehicles in the batch.
        **options: of :func:`anywhere_env`, with ``observation="readings"`` by default.

    Example:
        >>> readings_env(4, seed=0).rollout(3)["observation"].shape
        torch.Size([4, 3, 26])
    """
    return anywhere_env(num_envs, **{"observation": "readings"} | options)


@named_task("Storm", version=2, threshold=8.61)
def storm_env(num_envs: int = 1, **options: Any) -> TransformedEnv:
    """Return the environment *Readings* with errors that no data sheet states, in an aircraft (:func:`storm_errors`).

    With a seed below :data:`magrl.random_numbers.FIRST_RESERVED_SEED`, an episode has one of 256 storms with the
    spectrum of the record and random phases; with the seeds from there on, it is in the record.

    Args:
        num_envs: vehicles in the batch.
        **options: of :func:`readings_env`, with other ``transforms`` by default.

    Example:
        >>> storm_env(4, seed=0).reset()["sensor_std"][0]
        tensor([0.0500, 0.0500, 5.0000])
    """
    return readings_env(num_envs, **{"transforms": storm_errors()} | options)


def storm_errors(record: str | WeatherRecord = "college", *, stated: bool = False) -> Sequence[Transform]:
    """Return the errors of *Storm*: magnetic weather of the auroral zone, a drift, and spikes in 5 % of the readings.

    The file ``magrl/errors/storm.toml`` states their sizes, which are chosen.

    Args:
        record: another record of the weather.
        stated: whether the vehicle knows the size of each error, beside the white noise.

    Example:
        >>> [type(error).__name__ for error in storm_errors()]
        ['MagneticWeather', 'SensorErrors', 'Spikes']
    """
    from magrl.errors import load_conditions

    storm = load_conditions(STORM)
    errors = {error: dict(options) for error, options in storm.errors.items()}
    errors["weather"]["record"] = record
    for options in errors.values() if stated else ():
        options.pop("stated", None)
    return storm.replace_errors(**errors).transforms()


@named_task("NoGo", version=1, threshold=9.82)
def no_go_env(num_envs: int = 1, *, discs: int = 4, **options: Any) -> TransformedEnv:
    """Return the environment *Box* with no-go areas between start and destination, and a deadline of 20 steps.

    The straight path is blocked in most episodes, and areas are seen only from nearby: a greedy policy fails.

    Args:
        num_envs: vehicles in the batch.
        discs: areas of an episode, of which the four nearest are seen.
        **options: of :func:`magrl.envs.navigation.navigation_env`, with ``max_steps=20`` by default. Every
            ``observation`` ends with the areas in sight (:class:`~magrl.transforms.NoGoAreas`); ``"dict"`` has them as
            a key.

    Raises:
        ValueError: for a reward without :class:`~magrl.transforms.SPLReward`: it would pay for an arrival through an
            area.

    Example:
        >>> no_go_env(4, seed=0).rollout(3)["observation"].shape
        torch.Size([4, 3, 25])
    """
    from torchrl.envs import CatTensors, Compose, RenameTransform

    from magrl.commands import UsageError
    from magrl.envs.navigation import navigation_env
    from magrl.transforms import NoGoAreas, SPLReward, TrueDisplacement

    env = navigation_env(num_envs, **{"max_steps": 20} | options)
    if not any(isinstance(step, SPLReward) for step in env.transform):
        given = options["reward"] if isinstance(options["reward"], str) else "another function"
        raise UsageError(f"reward must be 'spl', got {given}: others pay for an arrival through an area")
    env.insert_transform(0, Compose(TrueDisplacement(), NoGoAreas(discs)))  # before the reward reads success
    for last in [step for step in env.transform if "observation" in step.out_keys][-1:]:
        parts = last.in_keys if isinstance(last, CatTensors) else ["observation_without_areas"]
        if not isinstance(last, CatTensors):
            env.append_transform(RenameTransform(["observation"], parts))
        env.append_transform(CatTensors([*parts, "areas"], "observation", del_keys=False, sort=False))
    if options.get("observation", "flat") == "flat":
        env.base_env.view = replace(env.view, observe_areas=True)
    return env


@named_task("Eddies", version=2, threshold=9.72)
def eddies_env(num_envs: int = 1, *, eddies_km_h: float = EDDY_MOTION["eddies_km_h"], **options: Any) -> TransformedEnv:
    """Return the environment *Box* of an underwater glider at 1 km/h, in eddies that are about as fast.

    The currents are unknown, and other ones in each episode: a vehicle that steers for its destination drifts off. It
    has a map of the field, so that each reading is a fix of its position, and shows the last set. As it knows the
    wavelength of the eddies, it also observes the currents to expect around it.

    Args:
        num_envs: vehicles in the batch.
        eddies_km_h: root-mean-square speed of the eddies [km/h].
        **options: of :func:`magrl.envs.navigation.navigation_env`, with other defaults: ``observation="legs"``, legs of
            at most 25 km, 60 steps, arrival within 25 km, and random start headings. A list of keys, or ``"dict"``, has
            no map.

    Example:
        >>> eddies_env(4, seed=0).rollout(3)["observation"].shape
        torch.Size([4, 3, 111])
    """
    from magrl.envs.navigation import navigation_env
    from magrl.errors import MotionError

    motion = MotionError(**EDDY_MOTION | {"eddies_km_h": eddies_km_h})
    rules = {"max_leg_km": 25.0, "max_steps": 60, "arrival": "distance", "start_heading": "random"}
    options = {"observation": "legs", **rules, **options, "transforms": [motion, *options.get("transforms", ())]}
    drift_km = math.ceil(motion.farthest_km(options["max_leg_km"]) - options["max_leg_km"])
    return navigation_env(num_envs, **{"drift_km": drift_km} | options)
