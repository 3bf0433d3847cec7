"""Evaluation rollouts: exactly one episode of each vehicle, without exploration."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from magrl.checks import check_type
from magrl.envs.geomagnetic import GeomagneticNavEnv


def evaluation_rollout(env: GeomagneticNavEnv, policy: TensorDictModuleBase) -> TensorDict:
    """Return a rollout of exactly one episode of each vehicle, without exploration or gradients.

    Args:
        env: environment.
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
    with torch.no_grad():
        return env.rollout(env.max_steps, policy, break_when_any_done=False, break_when_all_done=True)
