"""Evaluation rollouts: exactly one episode of each vehicle, without exploration."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from magrl.checks import check_type
from magrl.envs.geomagnetic import GeomagneticNavEnv
from magrl.transforms.errors import EpisodeErrors


def evaluation_rollout(env: EnvBase, policy: TensorDictModuleBase) -> TensorDict:
    """Return a rollout of exactly one episode of each vehicle, without exploration or gradients.

    It is the first episode of each vehicle: tasks, start headings and sensor noise are the same in every call.

    Args:
        env: navigation environment, with transforms or without.
        policy: policy or navigator that writes ``action``.

    Returns:
        ``(num_envs, T)``, as :func:`magrl.evaluation.episode_measures` takes it, until the last episode is done.
        What follows the end of an episode does not count.

    Raises:
        TypeError: for another environment, or a policy that is not callable.

    Example:
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0, max_steps=3)
        >>> evaluation_rollout(env, env.rand_action).shape
        torch.Size([2, 3])
    """
    check_type(EnvBase, env=env)
    if not callable(policy):
        raise TypeError(f"policy must be callable with a TensorDict, got {policy!r}")
    restart(env)
    with torch.no_grad():
        return env.rollout(env.max_steps, policy, break_when_any_done=False, break_when_all_done=True)


def restart(env: EnvBase) -> None:
    """Let the next reset of an environment start the first episode of each vehicle again.

    Args:
        env: navigation environment, with transforms or without.

    Raises:
        TypeError: for another environment.

    Example:
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> first = env.reset()
        >>> restart(env)
        >>> bool((env.reset()["position"] == first["position"]).all())
        True
    """
    base = getattr(env, "base_env", env)
    check_type(GeomagneticNavEnv, env=base)
    base.set_seed(base.seed)
    for part in env.modules():
        if isinstance(part, EpisodeErrors):
            part.restart()


def with_true_field(rollout: TensorDictBase) -> TensorDictBase:
    """Return a rollout whose ``field`` is the true field where its readings have noise, for figures and tables.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.transforms import SensorNoise
        >>> env = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), SensorNoise((0.05, 0.05, 5.0)))
        >>> rollout = env.rollout(2)
        >>> bool((with_true_field(rollout)["next", "field"] == rollout["next", "true_field"]).all())
        True
    """
    check_type(TensorDictBase, rollout=rollout)
    shown = rollout.copy()
    for state in (shown, shown["next"]):
        state["field"] = state.get("true_field", state["field"])
    return shown
