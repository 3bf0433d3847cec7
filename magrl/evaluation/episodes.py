"""Episodes of an evaluation: rollouts, and the measures of each episode."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.envs import (
    CatTensors,
    Compose,
    EnvBase,
    RenameTransform,
    RewardScaling,
    RewardSum,
    StepCounter,
    TensorDictPrimer,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from magrl.checks import check_type
from magrl.envs import GeomagneticNavEnv
from magrl.envs.measures import Episode, measured
from magrl.evaluation.arrays import ArrayPolicy
from magrl.geodesy import geodesic
from magrl.navigators import Navigator, policy_env
from magrl.navigators.base import MEMORY

_LARGE = (("track", "state"), ("track", "posterior"), (MEMORY,))
LARGE_KEYS = [(*root, *key) for root in ((), ("next",)) for key in _LARGE]
"""Keys that rollouts leave out."""
BY_ROW = (CatTensors, Compose, RenameTransform, RewardScaling, RewardSum, StepCounter, TensorDictPrimer)
"""Transforms of TorchRL that step some rows of a batch as they step them all; others may be of its size."""


def evaluation_rollout(env: EnvBase, policy: TensorDictModuleBase, *, strict: bool = False) -> TensorDict:
    """Return a rollout of exactly one episode of each vehicle, without exploration or gradients.

    A stochastic policy acts by its deterministic sample, and modules are in their mode ``eval()``. It is the first
    episode of each vehicle: trips, start headings and sensor noise are the same in every call. From its first action
    on that is not finite in float32, a vehicle stands still, with a warning that names it.

    Args:
        env: navigation environment, with transforms or without; :func:`~magrl.navigators.policy_env` adds what the
            policy needs.
        policy: policy or navigator that writes ``action``.
        strict: whether to raise at the first action that is not finite.

    Returns:
        ``(num_envs, T)``, as :func:`magrl.evaluation.episode_measures` takes it, until the last episode is done.
        What follows the end of an episode does not count; a navigator flies the running episodes alone, if all
        transforms are of magrl or among :data:`BY_ROW`. Memories, and the state and the posterior of a
        :class:`~magrl.transforms.TrackField`, some ten kilobytes for each step, are left out.

    Raises:
        TypeError: for another environment, or a policy that is not callable.
        ValueError: for a trained policy that does not fit the environment (:meth:`magrl.FieldPolicy.check_fits`), or
            ``strict``, naming vehicles and step.

    Example:
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0, max_steps=3)
        >>> evaluation_rollout(env, env.rand_action).shape
        torch.Size([2, 3])
    """
    restart(env)
    if not callable(policy):
        raise TypeError(f"policy must be callable with a TensorDict, got {policy!r}")
    if isinstance(policy, Navigator):
        policy.check_fits(env)
    env = policy_env(env, policy)
    alone = isinstance(policy, Navigator) and not isinstance(policy, ArrayPolicy) and _steps_rows(env)
    failed, still = torch.zeros(env.num_envs, 1, dtype=torch.bool, device=env.device), _still(env)
    steps: list[TensorDictBase] = []
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC), _evaluating(policy):
        state, rows = env.reset(), torch.arange(env.num_envs, device=env.device)
        while len(steps) < env.max_steps and len(rows):
            step, whole = _acted(policy, state, failed, still, rows), len(rows) == env.num_envs
            if strict and failed.any():
                where = f"step {len(steps)} (the first is step 0)"
                raise ValueError(f"the agent's action is not finite: vehicles {_first(failed)} at {where}")
            step = env.step(step) if whole else step.set("next", _following(env, step))
            state, flies = step_mdp(step), ~step["next", "done"].squeeze(-1)
            step = step.exclude(*LARGE_KEYS)
            steps.append(step if whole else _completed(steps[-1], rows, step))
            if alone or not flies.any():  # others may expect all vehicles
                state, rows = state[flies], rows[flies]
    rollout = TensorDict.stack(steps, -1).refine_names(..., "time")
    if failed.any():
        lost = _first(failed)
        warnings.warn(f"the policy wrote actions that are not finite: vehicles {lost} stopped", stacklevel=2)
    return rollout


def _acted(
    policy: TensorDictModuleBase, state: TensorDictBase, failed: Tensor, still: Tensor, rows: Tensor
) -> TensorDictBase:
    """Return a state of the vehicles in some rows with their actions; those with one that is not finite have failed."""
    action, stop = policy(state)["action"], still[rows]
    if action.shape != stop.shape:
        raise ValueError(f"the agent's action must be {tuple(stop.shape)}, got {tuple(action.shape)}")
    failed[rows] |= ~torch.isfinite(action.float()).all(-1, keepdim=True)
    return state.set("action", torch.where(failed[rows], stop, action))


def _steps_rows(env: EnvBase) -> bool:
    """Return whether an environment steps some of its vehicles as it steps them among all, and keeps no tracks."""
    if not isinstance(env, TransformedEnv):
        return env.render_mode is None
    parts = [part for part in env.transform.modules() if isinstance(part, Transform)]
    own = all(isinstance(part, BY_ROW) or type(part).__module__.startswith("magrl.") for part in parts)
    return own and _steps_rows(env.base_env)


def _following(env: EnvBase, state: TensorDictBase) -> TensorDictBase:
    """Return what follows a state with actions of some vehicles alone, for which TorchRL's ``step`` has no room."""
    if not isinstance(env, TransformedEnv):
        return env._step(state)
    memory, given = state.get("next", None), env.transform.inv(state)
    following = _following(env.base_env, given)
    if memory is not None:
        following.update(memory)
    return env.transform._step(given, following)


def _completed(last: TensorDictBase, rows: Tensor, step: TensorDictBase) -> TensorDictBase:
    """Return a step of all vehicles, of which those in other rows repeat the last one."""
    whole = last.clone()
    whole[rows] = step
    return whole


@contextmanager
def _evaluating(policy: Any) -> Iterator[None]:
    """Keep the modules of a policy in their mode ``eval()``, and give each its own mode back."""
    modes = [(part, part.training) for part in policy.modules()] if isinstance(policy, nn.Module) else []
    for part, _ in modes:
        part.training = False
    try:
        yield
    finally:
        for part, mode in modes:
            part.training = mode


def _still(env: EnvBase) -> Tensor:
    """Return the action of vehicles that stand still and do not declare: the least distance, scaled or not."""
    spec = env.action_spec
    action = spec.zero()
    if isinstance(spec, Bounded):
        action[..., 0] = spec.space.low[..., 0]
    return action


def _first(mask: Tensor) -> list[int]:
    """Return the first eight vehicles of a mask ``(N, 1)``."""
    return mask.squeeze(-1).nonzero().squeeze(-1)[:8].tolist()


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
        >>> from magrl.errors import SensorErrors
        >>> env = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), SensorErrors((0.05, 0.05, 5.0)))
        >>> rollout = env.rollout(2)
        >>> bool((with_true_field(rollout)["next", "field"] == rollout["next", "true_field"]).all())
        True
    """
    shown = rollout.copy()
    for state in (shown, shown["next"]):
        state["field"] = state.get("true_field", state["field"])
    return shown


def first_episode_mask(done: Tensor) -> Tensor:
    """Return the mask of the steps that belong to the first episode of each vehicle.

    Args:
        done: ``(M, T)`` or ``(M, T, 1)`` bool.

    Returns:
        ``(M, T)`` bool: True up to and including the first done.

    Example:
        >>> first_episode_mask(torch.tensor([[False, True, True]]))
        tensor([[ True,  True, False]])
    """
    done = done.reshape(done.shape[:2])
    return done.long().cumsum(1) - done.long() == 0


def episode_scores(rollout: TensorDictBase) -> Tensor:
    """Return the score ``(M,)`` of the first episode of each vehicle, of a rollout ``(M, T)``: 10 times its return [%].

    With the default reward it is 100 SPL for an arrival, and below 50 for a failure.

    Example:
        >>> after = TensorDict(reward=torch.ones(1, 3, 1), done=torch.tensor([[[False], [True], [True]]]))
        >>> episode_scores(TensorDict(next=after, batch_size=[1, 3]))
        tensor([20.], dtype=torch.float64)
    """
    after = rollout["next"]
    return 10 * (after["reward"].squeeze(-1).double() * first_episode_mask(after["done"])).sum(1)


def episode_measures(rollout: TensorDictBase) -> dict[str, Tensor]:
    """Return the measures of the first episode of each vehicle.

    Args:
        rollout: ``(M, T)`` from ``env.rollout``, with the keys of :class:`magrl.envs.GeomagneticNavEnv`.

    Returns:
        The measures of :class:`magrl.envs.measures.Episode` by name, ``(M,)`` each.

    Raises:
        TypeError: for a rollout of another type.
        ValueError: for a rollout of other dimensions, or without a vehicle or a step.
        KeyError: for a missing key.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from magrl.navigators import Secant
        >>> rollout = evaluation_rollout(GeomagneticNavEnv(num_envs=2, seed=0), Secant())
        >>> episodes = episode_measures(rollout)
        >>> episodes["success"], episodes["steps"]
        (tensor([True, True]), tensor([12, 12]))
    """
    check_type(TensorDictBase, rollout=rollout)
    if rollout.ndim != 2 or 0 in rollout.shape:
        raise ValueError(f"a rollout must be of shape (M, T), each at least 1, got {tuple(rollout.shape)}")
    after = rollout["next"]
    valid = first_episode_mask(after["done"])
    steps = valid.sum(1)
    rows, last = torch.arange(len(steps), device=steps.device), steps - 1
    distance, course = moved(after)
    _, bearing = geodesic(*rollout["position"].unbind(-1), *rollout["target_position"].unbind(-1))
    ends = {key: after[key][rows, last, 0] for key in ("success", "declared", "truncated") if key in after.keys()}  # noqa: SIM118
    places = {"start": rollout["start_position"][:, 0], "end": after["position"][rows, last]}
    length_km, course = (distance * valid).sum(1), torch.where(valid & (distance > 1e-6), course, math.nan)
    places["target"] = rollout["target_position"][:, 0]
    return measured(Episode(steps=steps, **ends, **places, length_km=length_km, course=course, bearing=bearing))


def moved(steps: TensorDictBase) -> tuple[Tensor, Tensor]:
    """Return distance [km] and direction [rad] of legs, ``(...)`` each, in float64.

    The distance is the commanded one, through the water or the air, which is what energy and time cost. The direction
    is over the ground, where errors of motion or of the north reference keep it.

    Args:
        steps: what follows the legs, usually ``rollout["next"]``.

    Example:
        >>> from tensordict import TensorDict
        >>> leg, heading = torch.tensor([[30.0, 0.1]]), torch.tensor([[0.1]])
        >>> moved(TensorDict(leg=leg, heading=heading, true_course=2 * heading))
        (tensor([30.], dtype=torch.float64), tensor([0.2000], dtype=torch.float64))
    """
    course = steps.get("true_course", steps.get("true_heading", steps["heading"]))
    return steps["leg"][..., 0].double(), course.squeeze(-1).double()
