"""The navigation environment behind the transforms of the recipes, with options by name."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from torchrl.envs import Compose, Transform, TransformedEnv

from magrl.checks import check_choice, check_type
from magrl.envs.geomagnetic import GeomagneticNavEnv
from magrl.transforms import AlignmentReward, DeclareArrival, FieldGradient, GradientHeading

OBSERVATIONS = ("flat", "dict")
REWARDS = ("guided", "base")


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
        observation: ``"flat"`` adds ``observation``, ``(N, 13)``, the input of the recipes' networks; ``"dict"`` leaves
            the public keys in physical units, and so does a list of keys, which the Gymnasium interface observes.
        transforms: own transforms: errors of sensors, estimates, rewards. They are cloned, and act after the guidance.
        reward: ``"guided"`` adds the alignment term to the paper's base reward, by the true field and heading;
            ``"base"`` is that reward alone.
        scale_actions: whether actions are in [-1, 1] instead of in km and rad.
        alignment_weight: zeta_3 of Eq. 3-6 [1/rad], of the guided reward.
        alignment_offset: heading deviation at which the alignment term turns into a penalty [rad].
        **options: of :class:`magrl.envs.GeomagneticNavEnv`.

    Raises:
        TypeError: for an unknown option, ``scale_actions`` that is not a bool, or an object among the transforms
            that is not a transform.
        ValueError: for any option out of its range, naming it and its value.

    Example:
        >>> navigation_env(4, seed=0).reset()["observation"].shape
        torch.Size([4, 13])
    """
    if isinstance(observation, str):
        check_choice(OBSERVATIONS, observation=observation)
    check_choice(REWARDS, reward=reward)
    check_type(bool, scale_actions=scale_actions)
    check_type(Transform, **{f"transforms[{number}]": each for number, each in enumerate(transforms)})
    base = GeomagneticNavEnv(num_envs=num_envs, **options)
    view, own = base.observation_view(), [each.clone() for each in _parts(transforms)]
    steps: list[Transform] = []
    if reward == "guided":  # before errors of the sensors
        alignment = AlignmentReward(weight=alignment_weight, offset=alignment_offset)
        steps += [FieldGradient(base.field), GradientHeading(), alignment]
    steps += own
    if observation == "flat":
        steps += view.observation_transforms()
    if scale_actions:
        declared = base.arrival.declared and not any(isinstance(each, DeclareArrival) for each in own)
        steps.append(view.action_transform(declared=declared))
    return TransformedEnv(base, Compose(*steps))


def _parts(transforms: Iterable[Transform]) -> Iterator[Transform]:
    """Yield transforms, those of a ``Compose`` one by one."""
    for each in transforms:
        yield from _parts(each) if isinstance(each, Compose) else (each,)
