"""Named tasks, from easy to hard: what each gives to an agent, and what it asks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torchrl.envs import CatTensors, Compose, TransformedEnv

from magrl.checks import check_choice
from magrl.envs.navigation import anywhere_env, navigation_env
from magrl.sensor_std import PERFECT, SensorStd
from magrl.transforms import SPEEDS_KM_H, MagneticWeather, NoGoAreas, SensorErrors, Spikes, TrueWay

STORM_NOISE = (0.05, 0.05, 5.0)
"""White noise of the task *Storm*, which the data sheet states: D [deg], I [deg], B_H [nT]."""


def readings_env(num_envs: int = 1, **options: Any) -> TransformedEnv:
    """Return the environment *Anywhere* without estimates: the agent observes raw readings and needs a memory.

    Args:
        num_envs: vehicles in the batch.
        **options: of :func:`~magrl.envs.navigation.anywhere_env`, with ``observation="readings"`` by default.

    Example:
        >>> readings_env(4, seed=0).rollout(3)["observation"].shape
        torch.Size([4, 3, 20])
    """
    return anywhere_env(num_envs, **{"observation": "readings"} | options)


def storm_env(num_envs: int = 1, **options: Any) -> TransformedEnv:
    """Return the environment *Readings* with errors that no data sheet states, in an aircraft.

    They are magnetic weather of the auroral zone, a drift, and spikes in 5 % of the readings. The sizes are chosen.

    Args:
        num_envs: vehicles in the batch.
        **options: of :func:`readings_env`, with other ``transforms`` by default.

    Example:
        >>> storm_env(4, seed=0).reset()["sensor_std"][0]
        tensor([0.0500, 0.0500, 5.0000])
    """
    drift: dict[str, Any] = {"drift": (0.1, 0.05, 20.0), "drift_length": 200.0}
    errors = (
        MagneticWeather("college", speed_km_h=SPEEDS_KM_H["aircraft"], stated=PERFECT),
        SensorErrors(STORM_NOISE, **drift, stated=SensorStd(STORM_NOISE)),
        Spikes((2.0, 1.0, 200.0), rate=0.05),
    )
    return readings_env(num_envs, **{"transforms": errors} | options)


def no_go_env(num_envs: int = 1, **options: Any) -> TransformedEnv:
    """Return the environment *Box* with no-go areas between start and destination, and a deadline of 20 steps.

    The straight path is blocked in most episodes, and areas are seen only from nearby: a greedy policy fails.

    Args:
        num_envs: vehicles in the batch.
        **options: of :func:`~magrl.envs.navigation.navigation_env`, with ``max_steps=20`` by default. The observation
            ``"flat"`` ends with the areas in sight (:class:`~magrl.transforms.NoGoAreas`).

    Raises:
        ValueError: for a reward other than ``"progress"`` and ``"spl"``: it would pay for an arrival through an area.

    Example:
        >>> no_go_env(4, seed=0).rollout(3)["observation"].shape
        torch.Size([4, 3, 22])
    """
    check_choice(("progress", "spl"), reward=options.setdefault("reward", "progress"))
    env = navigation_env(num_envs, **{"max_steps": 20} | options)
    env.insert_transform(0, Compose(TrueWay(), NoGoAreas()))  # the reward reads the success that areas leave
    for joined in [s for s in env.transform if isinstance(s, CatTensors) and s.out_keys == ["observation"]][-1:]:
        env.append_transform(CatTensors([*joined.in_keys, "areas"], "observation", del_keys=False, sort=False))
    return env


NAMED_ENVS: dict[str, Callable[..., TransformedEnv]] = {
    "box": navigation_env,
    "anywhere": anywhere_env,
    "readings": readings_env,
    "storm": storm_env,
    "nogo": no_go_env,
}
"""Functions that make the environments of the named tasks."""
