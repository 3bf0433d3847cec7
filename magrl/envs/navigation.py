"""The navigation environment behind the transforms of the recipes, with options by name: with a map, and without."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from typing import Any

from torchrl.envs import Compose, Transform, TransformedEnv

from magrl.checks import check_choice, check_type
from magrl.envs.geomagnetic import GeomagneticNavEnv
from magrl.envs.random_regions import planet_scenario
from magrl.envs.scenario import Scenario
from magrl.tracking import STEP_PRICE
from magrl.transforms import (
    AlignmentReward,
    DeclareArrival,
    FieldGradient,
    GradientHeading,
    HighestSPL,
    ObservationView,
    RandomSensorNoise,
    RandomStepPrice,
    SensorNoise,
    SPLReward,
    TrackView,
    TrueWay,
)
from magrl.transforms.errors.base import ReadingErrors

OBSERVATIONS = ("flat", "track", "dict")
REWARDS = ("guided", "base", "spl")
PLANET_REGIONS = 1024
"""Regions of random planets of :func:`anywhere_env`."""


def navigation_env(
    num_envs: int = 1,
    *,
    observation: str | Sequence[str] = "flat",
    reward: str = "guided",
    transforms: Sequence[Transform] = (),
    scale_actions: bool = True,
    alignment_weight: float = 3.0,
    alignment_offset: float = math.pi / 4,
    **options: Any,
) -> TransformedEnv:
    """Return the navigation environment behind the transforms of the recipes.

    Args:
        num_envs: vehicles in the batch.
        observation: ``"flat"`` adds ``observation``, ``(N, 13)``, scaled to the region: the input of the recipes'
            networks. ``"track"`` adds ``observation``, ``(N, 19)``, the estimates of the own track
            (:class:`~magrl.transforms.TrackView`), in any number of regions. ``"dict"`` leaves the public keys in
            physical units, and so does a list of keys, which the Gymnasium interface observes.
        transforms: added after the guidance: errors of sensors, estimates, rewards. They are cloned.
        reward: ``"guided"`` adds the alignment term to the paper's base reward, by the true field and heading; over
            several regions by the pair of elements that crosses best. ``"base"`` is that reward alone. ``"spl"`` is
            :class:`~magrl.transforms.SPLReward`, in which each step costs 0.5 % of SPL.
        scale_actions: whether actions are in [-1, 1] instead of in km and rad.
        alignment_weight: zeta_3 of Eq. 3-6 [1/rad], of the guided reward.
        alignment_offset: heading deviation at which the alignment term turns into a penalty [rad].
        **options: of :class:`magrl.envs.GeomagneticNavEnv`.

    Raises:
        TypeError: for an unknown option, ``scale_actions`` that is not a bool, or an object among the transforms
            that is not a transform.
        ValueError: for any option out of its range, naming it and its value, or ``"flat"`` over several regions.

    Example:
        >>> navigation_env(4, seed=0).reset()["observation"].shape
        torch.Size([4, 13])
    """
    if isinstance(observation, str):
        check_choice(OBSERVATIONS, observation=observation)
    check_choice(REWARDS, reward=reward)
    check_type(bool, scale_actions=scale_actions)
    check_type(Transform, **{f"transforms[{number}]": transform for number, transform in enumerate(transforms)})
    base = GeomagneticNavEnv(num_envs=num_envs, **options)
    view, added = _view(base, observation), [transform.clone() for transform in _parts(transforms)]
    steps: list[Transform] = []
    if reward == "guided":  # before errors of the sensors
        alignment = AlignmentReward(weight=alignment_weight, offset=alignment_offset)
        heading = GradientHeading() if len(base.region) == 1 else GradientHeading(pair="auto")
        steps += [FieldGradient(base.field), heading, alignment]
    elif reward == "spl":
        steps += [TrueWay(), HighestSPL(), RandomStepPrice((STEP_PRICE, STEP_PRICE)), SPLReward()]
    steps += added
    if observation == "track" and not any(isinstance(transform, ReadingErrors) for transform in added):
        steps.append(SensorNoise((0.0, 0.0, 0.0)))  # the view reads standard deviations
    if observation in ("flat", "track"):
        steps += view.observation_transforms()
    if scale_actions:
        declared = base.arrival.declared and not any(isinstance(transform, DeclareArrival) for transform in added)
        steps.append(view.action_transform(declared=declared))
    return TransformedEnv(base, Compose(*steps))


def anywhere_env(num_envs: int = 1, *, scenario: Scenario | None = None, **options: Any) -> TransformedEnv:
    """Return the environment of an agent without a map: random planets, sensors and headings.

    Args:
        num_envs: vehicles in the batch.
        scenario: scenario of any number of regions; by default :data:`PLANET_REGIONS` of random planets, with
            destinations 300 to 500 km away.
        **options: of :func:`navigation_env`, with other defaults: ``observation="track"``, ``reward="spl"``,
            ``start_heading="random"`` unless the scenario states one, and ``transforms=[RandomSensorNoise()]``.

    Raises:
        TypeError, ValueError: as :func:`navigation_env`.

    Example:
        >>> anywhere_env(4, seed=0).rollout(3)["observation"].shape
        torch.Size([4, 3, 19])
    """
    scenario = _planets() if scenario is None else scenario
    heading = scenario.given("start_heading") or "random"
    defaults: dict[str, Any] = {"observation": "track", "reward": "spl", "start_heading": heading}
    defaults["transforms"] = [RandomSensorNoise()]
    return navigation_env(num_envs, scenario=scenario, **defaults | options)


@cache
def _planets() -> Scenario:
    return planet_scenario(PLANET_REGIONS, seed=0, max_latitude=70.0, distance_range_km=(300.0, 500.0))


def _view(base: GeomagneticNavEnv, observation: str | Sequence[str]) -> ObservationView | TrackView:
    """Return what is observed, and how actions are scaled."""
    if observation == "flat":
        if len(base.region) > 1:
            message = f"observation='flat' is scaled to one region, the scenario has {len(base.region)}"
            raise ValueError(f"{message}: take observation='track', or 'dict' for raw readings")
        return base.observation_view()
    limits = {name: getattr(base, name) for name in ("zeta", "max_steps", "max_move_km", "max_turn_rad")}
    return TrackView(**limits, search=base.arrival.rule == "objective")


def _parts(transforms: Iterable[Transform]) -> Iterator[Transform]:
    """Yield transforms, those of a ``Compose`` one by one."""
    for transform in transforms:
        yield from _parts(transform) if isinstance(transform, Compose) else (transform,)
