"""The navigation environment behind the transforms of the recipes, with options by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from torchrl.envs import Compose, Transform, TransformedEnv

from magrl.checks import check_choice, check_type
from magrl.envs.geomagnetic import GeomagneticNavEnv
from magrl.envs.regions import PAPER_REGION
from magrl.pilot import Rules
from magrl.transforms import (
    AlignmentReward,
    FieldGradient,
    GradientHeading,
    HighestSPL,
    LegsView,
    MinMaxNorm,
    ReadingObservation,
    SPLReward,
    TrackField,
    TrueDisplacement,
)
from magrl.transforms.sequences import ACCURACY_KEYS
from magrl.transforms.track import known_keys

OBSERVATIONS = ("flat", "legs", "track", "readings", "dict")
REWARDS = ("spl", "paper", "base")
Reward = Callable[[GeomagneticNavEnv], Sequence[Transform]]


def navigation_env(
    num_envs: int = 1,
    *,
    observation: str | Sequence[str] = "flat",
    reward: str | Reward = "spl",
    transforms: Sequence[Transform] = (),
    scale_actions: bool = True,
    observe_heading: bool = True,
    observe_difference: bool = True,
    **options: Any,
) -> TransformedEnv:
    """Return the navigation environment behind the transforms of the recipes.

    Args:
        num_envs: vehicles in the batch.
        observation: ``"flat"`` adds ``observation``, ``(N, 13)``, scaled to the region: the input of the recipes'
            networks. ``"legs"`` adds ``observation``, ``(N, 111)``, what a map of the region says of the last eight
            legs (:class:`~magrl.transforms.RecentLegs`) and of the currents around
            (:class:`~magrl.transforms.ExpectedCurrents`). ``"track"`` adds ``observation``, ``(N, 19)``, estimates of
            the own track (:class:`~magrl.transforms.TrackField`), and ``"readings"``, ``(N, 26)``, readings without
            estimates (:class:`~magrl.transforms.ReadingObservation`), in any number of regions. ``"dict"`` leaves the
            public keys in physical units, and so does a list of keys, which the Gymnasium interface observes. The view
            of ``"flat"`` and of ``"legs"`` is the ``view`` of the environment, for :func:`magrl.save_policy`.
        transforms: added after the guidance: errors of sensors, estimates, rewards. They are cloned.
        reward: ``"spl"``, the default, is :class:`~magrl.transforms.SPLReward`: an episode that arrives earns 10 times
            its SPL, a failure less than 5. ``"paper"`` is the paper's: decrease of the objective, 200 at the arrival,
            and alignment with the theoretical heading by the true field, outside the paper's region by the pair of
            elements that crosses best. It has a trap: to stand still and turn to that heading earns 117 in 50 steps.
            ``"base"`` is that without the alignment. A function of the plain environment returns the transforms of
            another reward.
        scale_actions: whether actions are in [-1, 1] instead of in km and rad.
        observe_heading: switch of the view of ``"flat"`` (:class:`~magrl.transforms.ObservationView`).
        observe_difference: another one.
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
    if not callable(reward):
        check_choice(REWARDS, reward=reward)
    check_type(bool, scale_actions=scale_actions)
    check_type(Transform, **{f"transforms[{number}]": transform for number, transform in enumerate(transforms)})
    base = GeomagneticNavEnv(num_envs=num_envs, **options)
    steps = reward(base) if callable(reward) else _named_reward(base, reward)
    env = TransformedEnv(base, Compose(*steps, *(transform.clone() for transform in _parts(transforms))))
    switches = {"observe_heading": observe_heading, "observe_difference": observe_difference}
    for transform in _observation(env, observation, **switches):
        env.append_transform(transform)
    if scale_actions:
        own = all(type(step).__module__.startswith(("magrl.transforms", "magrl.errors")) for step in _parts(transforms))
        changed = not own or any("action" in step.in_keys_inv for step in env.transform)
        space = base.action_spec.space
        bounds = {} if changed else {"action": (space.low[0], space.high[0])}  # else TorchRL computes all specs for it
        env.append_transform(MinMaxNorm(in_keys_inv=["action"], bounds=bounds))
    return env


def _named_reward(base: GeomagneticNavEnv, reward: str) -> list[Transform]:
    if reward == "spl":
        return spl_reward()
    return guidance(base) if reward == "paper" else []


def spl_reward() -> list[Transform]:
    """Return the transforms of the default reward; they come before errors of sensors.

    Example:
        >>> [type(step).__name__ for step in spl_reward()]
        ['TrueDisplacement', 'HighestSPL', 'SPLReward']
    """
    return [TrueDisplacement(), HighestSPL(), SPLReward()]


def guidance(base: GeomagneticNavEnv, **alignment: Any) -> list[Transform]:
    """Return the transforms of the guidance by the field: they add to the reward, and come before errors of sensors.

    The paper's pair of elements guides in its region, elsewhere the pair that crosses best.

    Args:
        base: plain environment.
        **alignment: options of :class:`~magrl.transforms.AlignmentReward`.

    Example:
        >>> [type(step).__name__ for step in guidance(GeomagneticNavEnv(seed=0), weight=2.0)]
        ['FieldGradient', 'GradientHeading', 'AlignmentReward']
    """
    pair = ("D", "I") if list(base.region) == [PAPER_REGION] else "auto"
    return [FieldGradient(base.field), GradientHeading(pair=pair), AlignmentReward(**alignment)]


def _observation(env: TransformedEnv, observation: str | Sequence[str], **switches: bool) -> list[Transform]:
    """Return the transforms of an observation; raise where it does not fit."""
    base = env.base_env
    if observation in ("flat", "legs"):
        if len(base.region) > 1:
            message = f"observation={observation!r} is of one region, the scenario has {len(base.region)}"
            raise ValueError(f"{message}: take observation='track', or 'dict' for raw readings")
        limits = {"max_leg_km": base.max_leg_km, "max_turn_rad": base.max_turn_rad}
        legs = LegsView(max_steps=base.max_steps, **limits) if observation == "legs" else None
        base.view = legs or base.observation_view(**switches)  # TorchRL forwards attributes of the plain environment
        return [*base.view.needed(env), *base.view.observation_transforms()]
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
