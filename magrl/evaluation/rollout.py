"""Evaluation rollouts: exactly one episode of each vehicle, without exploration."""

from __future__ import annotations

import warnings

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from magrl.checks import check_type
from magrl.envs import GeomagneticNavEnv
from magrl.navigators import Navigator

LARGE_KEYS = [(*root, "track", name) for root in ((), ("next",)) for name in ("state", "posterior")]
"""Keys that rollouts leave out."""


def evaluation_rollout(env: EnvBase, policy: TensorDictModuleBase) -> TensorDict:
    """Return a rollout of exactly one episode of each vehicle, without exploration or gradients.

    A stochastic policy acts by its deterministic sample. It is the first episode of each vehicle: tasks, start headings
    and sensor noise are the same in every call. From its first action that is not finite on, the actions of a vehicle
    are zeros, with a warning that names it.

    Args:
        env: navigation environment, with transforms or without.
        policy: policy or navigator that writes ``action``.

    Returns:
        ``(num_envs, T)``, as :func:`magrl.evaluation.episode_measures` takes it, until the last episode is done.
        What follows the end of an episode does not count. The state and the posterior of a
        :class:`~magrl.transforms.TrackField`, some ten kilobytes for each step, are left out.

    Raises:
        TypeError: for another environment, or a policy that is not callable.
        ValueError: for a trained policy that does not fit the environment (:meth:`magrl.FieldPolicy.check_fits`).

    Example:
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0, max_steps=3)
        >>> evaluation_rollout(env, env.rand_action).shape
        torch.Size([2, 3])
    """
    restart(env)
    return next_rollout(env, policy)


def next_rollout(env: EnvBase, policy: TensorDictModuleBase) -> TensorDict:
    """Return the next episode of each vehicle, without exploration or gradients."""
    if not callable(policy):
        raise TypeError(f"policy must be callable with a TensorDict, got {policy!r}")
    if isinstance(policy, Navigator):
        policy.check_fits(env)
    failed = torch.zeros(env.num_envs, 1, dtype=torch.bool, device=env.device)

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        action = policy(tensordict)["action"]
        failed.logical_or_(~torch.isfinite(action).all(-1, keepdim=True))
        return tensordict.set("action", torch.where(failed, 0.0, action))

    steps: list[TensorDictBase] = []
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        state = env.reset()
        while len(steps) < env.max_steps and not (steps and steps[-1]["next", "done"].all()):
            step = env.step(act(state))
            steps.append(step.exclude(*LARGE_KEYS))
            state = step_mdp(step)
    rollout = TensorDict.stack(steps, -1).refine_names(..., "time")
    if failed.any():
        lost = failed.squeeze(-1).nonzero().squeeze(-1)[:8].tolist()
        warnings.warn(f"the policy wrote actions that are not finite: vehicles {lost} stopped", stacklevel=3)
    return rollout


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


def with_true_field(rollout: TensorDictBase) -> TensorDictBase:
    """Return a rollout whose ``field`` is the true field where its readings have noise, for figures and tables.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.transforms import SensorErrors
        >>> env = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), SensorErrors((0.05, 0.05, 5.0)))
        >>> rollout = env.rollout(2)
        >>> bool((with_true_field(rollout)["next", "field"] == rollout["next", "true_field"]).all())
        True
    """
    shown = rollout.copy()
    for state in (shown, shown["next"]):
        state["field"] = state.get("true_field", state["field"])
    return shown
