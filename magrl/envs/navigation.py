"""The navigation environment behind the transforms of the recipes, with options by name."""

from __future__ import annotations

import inspect
import math
from typing import Any

from torchrl.envs import Compose, Transform, TransformedEnv

from magrl.checks import check_type
from magrl.envs.geomagnetic import GeomagneticNavEnv
from magrl.transforms import AlignmentReward, FieldGradient, GradientHeading

OBSERVATIONS = ("flat", "dict")
REWARDS = ("guided", "base")


def navigation_env(
    num_envs: int = 1,
    *,
    observation: str = "flat",
    reward: str = "guided",
    scale_actions: bool = True,
    alignment_weight: float = 3.0,
    alignment_offset: float = math.pi / 4,
    **options: Any,
) -> TransformedEnv:
    """Return the navigation environment behind the transforms of the recipes.

    Args:
        num_envs: vehicles in the batch.
        observation: ``"flat"`` adds ``observation``, ``(N, 13)``, the input of the recipes' networks; ``"dict"`` leaves
            the public keys in physical units.
        reward: ``"guided"`` adds the alignment term to the paper's base reward; ``"base"`` is that reward alone.
        scale_actions: whether actions are in [-1, 1] instead of in km and rad.
        alignment_weight: zeta_3 of Eq. 3-6 [1/rad], of the guided reward.
        alignment_offset: heading deviation at which the alignment term turns into a penalty [rad].
        **options: of :class:`magrl.envs.GeomagneticNavEnv`.

    Raises:
        TypeError: for an unknown option, or ``scale_actions`` that is not a bool.
        ValueError: for any option out of its range, naming it and its value.

    Example:
        >>> navigation_env(4, seed=0).reset()["observation"].shape
        torch.Size([4, 13])
    """
    check_choice("observation", observation, OBSERVATIONS)
    check_choice("reward", reward, REWARDS)
    check_type(bool, scale_actions=scale_actions)
    known = inspect.signature(GeomagneticNavEnv.__init__).parameters.keys() - {"self", "num_envs"}
    if unknown := sorted(options.keys() - known):
        # Python's wording: TorchRL's GymEnv looks for it to find out which arguments it can pass.
        raise TypeError(f"got an unexpected keyword argument {unknown[0]!r}; the environment has {sorted(known)}")
    base = GeomagneticNavEnv(num_envs=num_envs, **options)
    view = base.observation_view()
    transforms: list[Transform] = []
    if reward == "guided":
        alignment = AlignmentReward(weight=alignment_weight, offset=alignment_offset)
        transforms += [FieldGradient(base.field), GradientHeading(), alignment]
    if observation == "flat":
        transforms += view.observation_transforms()
    if scale_actions:
        transforms.append(view.action_transform())
    return TransformedEnv(base, Compose(*transforms))


def check_choice(name: str, value: object, choices: tuple[str, ...]) -> None:
    """Raise unless a value is one of some choices.

    Raises:
        ValueError: naming the choices.

    Example:
        >>> check_choice("reward", "base", REWARDS)
    """
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, choices))}, got {value!r}")
