"""The navigation environment behind the transforms of the recipes, with options by name, and the named tasks."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

from torchrl.envs import CatTensors, Compose, RenameTransform, Transform, TransformedEnv

from magrl import transforms as every_transform
from magrl.checks import check_choice, check_type
from magrl.envs.geomagnetic import GeomagneticNavEnv
from magrl.envs.random_regions import planet_scenario
from magrl.envs.regions import PAPER_REGION
from magrl.envs.scenario import Scenario
from magrl.field import WeatherRecord
from magrl.registry import NAMED_TASKS
from magrl.tracking import Rules
from magrl.tracking.planning import STEP_PRICE
from magrl.transforms import (
    AlignmentReward,
    FieldGradient,
    GradientHeading,
    HighestSPL,
    LegsView,
    MinMaxNorm,
    ObservationView,
    ProgressReward,
    RandomStepPrice,
    ReadingObservation,
    SensorErrors,
    SPLReward,
    TrackField,
    TrueDisplacement,
    load_conditions,
    sensor_levels,
)
from magrl.transforms.errors import conditions
from magrl.transforms.sequences import ACCURACY_KEYS
from magrl.transforms.track import known_keys

OBSERVATIONS = ("flat", "legs", "track", "readings", "dict")
REWARDS = ("progress", "paper", "base", "spl")
STORM = Path(conditions.__file__).with_name("storm.toml")
"""File of the errors of the task *Storm*."""
PLANET_REGIONS = 1024
"""Regions of random planets of :func:`anywhere_env`."""


def navigation_env(
    num_envs: int = 1,
    *,
    observation: str | Sequence[str] = "flat",
    reward: str = "progress",
    step_price: float = STEP_PRICE,
    transforms: Sequence[Transform] = (),
    scale_actions: bool = True,
    **options: Any,
) -> TransformedEnv:
    """Return the navigation environment behind the transforms of the recipes.

    Args:
        num_envs: vehicles in the batch.
        observation: ``"flat"`` adds ``observation``, ``(N, 13)``, scaled to the region: the input of the recipes'
            networks. ``"legs"`` adds ``observation``, ``(N, 45)``, what a map of the region says of the last eight legs
            (:class:`~magrl.transforms.RecentLegs`). ``"track"`` adds ``observation``, ``(N, 19)``, estimates of the own
            track (:class:`~magrl.transforms.TrackField`), and ``"readings"``, ``(N, 26)``, readings without estimates
            (:class:`~magrl.transforms.ReadingObservation`), in any number of regions. ``"dict"`` leaves the public
            keys in physical units, and so does a list of keys, which the Gymnasium interface observes. The view of
            ``"flat"`` and of ``"legs"`` is the ``view`` of the environment, for :func:`magrl.save_policy`.
        transforms: added after the guidance: errors of sensors, estimates, rewards. They are cloned.
        reward: ``"progress"``, the default, is :class:`~magrl.transforms.ProgressReward`: kilometers nearer to the
            destination over 50, plus 10 at the arrival, minus 0.1 a step. ``"paper"`` is the paper's: decrease of the
            objective, 200 at the arrival, and alignment with the theoretical heading by the true field, outside
            the paper's region by the pair of elements that crosses best. It has a trap: to stand still and turn to that
            heading earns 117 in 50 steps. ``"base"`` is that without the alignment. ``"spl"`` is
            :class:`~magrl.transforms.SPLReward`, in which each step costs ``step_price``.
        step_price: price of a step of that reward [% of SPL].
        scale_actions: whether actions are in [-1, 1] instead of in km and rad.
        **options: of :class:`magrl.envs.GeomagneticNavEnv`.

    Raises:
        TypeError: for an unknown option, ``scale_actions`` that is not a bool, or an object among the transforms
            that is not a transform.
        ValueError: for any option out of its range, naming it and its value, or ``"flat"`` over several regions.

    Example:
        >>> navigation_env(4, seed=0).reset()["observation"].shape
        torch.Size([4, 13])
    """
    check_type(Sequence, observation=observation)
    if isinstance(observation, str):
        check_choice(OBSERVATIONS, observation=observation)
    check_choice(REWARDS, reward=reward)
    check_type(bool, scale_actions=scale_actions)
    check_type(Transform, **{f"transforms[{number}]": transform for number, transform in enumerate(transforms)})
    base = GeomagneticNavEnv(num_envs=num_envs, **options)
    steps: list[Transform] = []
    if reward == "progress":
        steps += [TrueDisplacement(), ProgressReward()]
    elif reward == "paper":  # before errors of the sensors
        steps += [FieldGradient(base.field), GradientHeading(pair=guidance_pair(base)), AlignmentReward()]
    elif reward == "spl":
        steps += [TrueDisplacement(), HighestSPL(), RandomStepPrice((step_price, step_price)), SPLReward()]
    env = TransformedEnv(base, Compose(*steps, *(transform.clone() for transform in _parts(transforms))))
    for transform in _observation(env, observation):
        env.append_transform(transform)
    if scale_actions:
        own = all(type(step).__module__.startswith("magrl.transforms") for step in _parts(transforms))
        changed = not own or any("action" in step.in_keys_inv for step in env.transform)
        space = base.action_spec.space
        bounds = {} if changed else {"action": (space.low[0], space.high[0])}  # else TorchRL computes all specs for it
        env.append_transform(MinMaxNorm(in_keys_inv=["action"], bounds=bounds))
    return env


def guidance_pair(env: GeomagneticNavEnv) -> tuple[str, str] | str:
    """Return the pair of elements that guides: the paper's in its region, elsewhere the one that crosses best.

    Example:
        >>> guidance_pair(GeomagneticNavEnv(seed=0)), guidance_pair(GeomagneticNavEnv(planet_scenario(1, seed=0)))
        (('D', 'I'), 'auto')
    """
    return ("D", "I") if list(env.region) == [PAPER_REGION] else "auto"


def anywhere_env(num_envs: int = 1, *, scenario: Scenario | None = None, **options: Any) -> TransformedEnv:
    """Return the environment of an agent without a map: random planets, sensors and headings.

    Args:
        num_envs: vehicles in the batch.
        scenario: scenario of any number of regions; by default :data:`PLANET_REGIONS` of random planets, with
            destinations 300 to 500 km away.
        **options: of :func:`navigation_env`, with other defaults: ``observation="track"``, ``start_heading="random"``
            and ``arrival="distance"`` unless the scenario states them, and errors of its sensors of random size
            (:func:`magrl.transforms.sensor_levels`).

    Raises:
        TypeError, ValueError: as :func:`navigation_env`.

    Example:
        >>> anywhere_env(4, seed=0).rollout(3)["observation"].shape
        torch.Size([4, 3, 19])
    """
    scenario = _planets() if scenario is None else scenario
    defaults: dict[str, Any] = {"observation": "track"}
    for name, value in {"start_heading": "random", "arrival": "distance"}.items():
        defaults[name] = scenario.given(name) or value
    defaults["transforms"] = [SensorErrors(levels=sensor_levels)]
    return navigation_env(num_envs, scenario=scenario, **defaults | options)


@cache
def _planets() -> Scenario:
    return planet_scenario(PLANET_REGIONS, seed=0, max_latitude=70.0, distance_range_km=(300.0, 500.0))


def _observation(env: TransformedEnv, observation: str | Sequence[str]) -> list[Transform]:
    """Return the transforms of an observation; raise where it does not fit."""
    base = env.base_env
    if observation in ("flat", "legs"):
        if len(base.region) > 1:
            message = f"observation={observation!r} is of one region, the scenario has {len(base.region)}"
            raise ValueError(f"{message}: take observation='track', or 'dict' for raw readings")
        env.view = legs_view(base) if observation == "legs" else base.observation_view()
        return [*env.view.needed(env), *env.view.observation_transforms()]
    if observation == "track":
        return [TrackField(Rules(**base.limits), known_keys(env.observation_spec))]
    if observation == "readings":
        keys = list(env.observation_spec.keys())
        known = [key for key in ACCURACY_KEYS if key in keys]
        return [ReadingObservation([*ReadingObservation.default_in_keys, *known])]
    return []


def _parts(transforms: Iterable[Transform]) -> Iterator[Transform]:
    """Yield transforms, the parts of a ``Compose`` one by one."""
    for transform in transforms:
        yield from _parts(transform) if isinstance(transform, Compose) else (transform,)


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


def storm_env(num_envs: int = 1, **options: Any) -> TransformedEnv:
    """Return the environment *Readings* with errors that no data sheet states, in an aircraft (:func:`storm_errors`).

    With a seed below :data:`magrl.paper.FIRST_RESERVED_SEED`, an episode has one of 256 storms with the
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

    The file ``magrl/transforms/errors/storm.toml`` states their sizes, which are chosen.

    Args:
        record: another record of the weather.
        stated: whether the vehicle knows the size of each error, beside the white noise.

    Example:
        >>> [type(error).__name__ for error in storm_errors()]
        ['MagneticWeather', 'SensorErrors', 'Spikes']
    """
    storm = load_conditions(STORM)
    errors = {error: dict(options) for error, options in storm.errors.items()}
    errors["weather"]["record"] = record
    for options in errors.values() if stated else ():
        options.pop("stated", None)
    return storm.replace_errors(**errors).transforms()


def no_go_env(num_envs: int = 1, *, discs: int = 4, **options: Any) -> TransformedEnv:
    """Return the environment *Box* with no-go areas between start and destination, and a deadline of 20 steps.

    The straight path is blocked in most episodes, and areas are seen only from nearby: a greedy policy fails.

    Args:
        num_envs: vehicles in the batch.
        discs: areas of an episode, of which the three nearest are seen.
        **options: of :func:`navigation_env`, with ``max_steps=20`` by default. Every ``observation`` ends with the
            areas in sight (:class:`~magrl.transforms.NoGoAreas`); ``"dict"`` has them as a key.

    Raises:
        ValueError: for a reward other than ``"progress"`` and ``"spl"``: it would pay for an arrival through an area.

    Example:
        >>> no_go_env(4, seed=0).rollout(3)["observation"].shape
        torch.Size([4, 3, 22])
    """
    check_choice(("progress", "spl"), reward=options.setdefault("reward", "progress"))
    env = navigation_env(num_envs, **{**NAMED_TASKS["nogo"].options, **options})
    env.insert_transform(
        0, Compose(*task_transforms("nogo", NoGoAreas={"number": discs}))
    )  # the reward reads the success that areas leave
    for last in [step for step in env.transform if "observation" in step.out_keys][-1:]:
        parts = last.in_keys if isinstance(last, CatTensors) else ["observation_without_areas"]
        if not isinstance(last, CatTensors):
            env.append_transform(RenameTransform(["observation"], parts))
        env.append_transform(CatTensors([*parts, "areas"], "observation", del_keys=False, sort=False))
    if options.get("observation", "flat") == "flat":
        env.view = replace(env.view, observe_areas=True)
    return env


def eddies_env(
    num_envs: int = 1, *, eddies_km_h: float = 0.9, noise: Sequence[float] = (0.0, 0.0, 0.0), **options: Any
) -> TransformedEnv:
    """Return the environment *Box* of an underwater glider at 1 km/h, in eddies that are about as fast.

    The currents are unknown, and other ones in each episode: a vehicle that steers for its destination is carried
    around. It has a map of the field, so that each reading is a fix of its position, and shows the last set.

    Args:
        num_envs: vehicles in the batch.
        eddies_km_h: root-mean-square speed of the eddies [km/h].
        noise: standard deviations of the noise of D [deg], I [deg], B_H [nT].
        **options: of :func:`navigation_env`, with other defaults: ``observation="legs"``, legs of at most 25 km, 60
            steps, arrival within 25 km, and random start headings. A list of keys, or ``"dict"``, has no map.

    Example:
        >>> eddies_env(4, seed=0).rollout(3)["observation"].shape
        torch.Size([4, 3, 45])
    """
    motion, _ = task_transforms("eddies", MotionError={"eddies_km_h": eddies_km_h})
    sensors = [SensorErrors(noise)] if any(noise) else []
    defaults = {"observation": "legs", **NAMED_TASKS["eddies"].options}
    leg_km = options.get("max_leg_km", defaults["max_leg_km"])
    defaults["drift_km"] = math.ceil(motion.farthest_km(leg_km) - leg_km)
    transforms = [motion, *sensors, *options.pop("transforms", ())]
    return navigation_env(num_envs, transforms=transforms, **{**defaults, **options})


def legs_view(base: GeomagneticNavEnv) -> LegsView:
    """Return the view of the last legs in an environment.

    Example:
        >>> legs_view(GeomagneticNavEnv(seed=0)).max_steps
        50
    """
    return LegsView(max_steps=base.max_steps, max_leg_km=base.max_leg_km, max_turn_rad=base.scenario.max_turn_rad)


def task_view(base: GeomagneticNavEnv, task: str, **switches: bool) -> LegsView | ObservationView:
    """Return what an agent observes on a named task.

    Args:
        base: its environment.
        task: its name.
        **switches: of :meth:`magrl.envs.GeomagneticNavEnv.observation_view`.

    Example:
        >>> task_view(GeomagneticNavEnv(seed=0), "nogo").size
        22
    """
    row = NAMED_TASKS[task]
    return (
        legs_view(base) if row.legs else base.observation_view(**switches, observe_areas="NoGoAreas" in row.transforms)
    )


NAMED_ENVS: dict[str, Callable[..., TransformedEnv]] = {
    name: globals()[task.make] for name, task in NAMED_TASKS.items()
}
"""Functions that make the environments of :data:`magrl.registry.NAMED_TASKS`."""


def task_name(task: str) -> str:
    """Return the name of a named task, given its name or its id with Gymnasium.

    Raises:
        ValueError: for another text, listing the names.

    Example:
        >>> task_name("nogo"), task_name("magrl/GeomagneticNavigationNoGo-v0")
        ('nogo', 'nogo')
    """
    names = {row.id: name for name, row in NAMED_TASKS.items()}
    name = names.get(task, task) if isinstance(task, str) else task
    check_choice(list(NAMED_TASKS), task=name)
    return name


def task_transforms(task: str, **options: Mapping[str, Any]) -> list[Any]:
    """Return the transforms of a named task that change its episodes, before any reward.

    Args:
        task: its name.
        **options: other options of a transform, by the name of its class.

    Example:
        >>> [type(part).__name__ for part in task_transforms("nogo")], task_transforms("box")
        (['TrueDisplacement', 'NoGoAreas'], [])
    """
    return [
        getattr(every_transform, name)(**{**own, **options.get(name, {})})
        for name, own in NAMED_TASKS[task].transforms.items()
    ]
