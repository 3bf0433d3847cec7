"""Evaluation rollouts: exactly one episode of each vehicle or of each task, without exploration."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from magrl.agents.exported import TrainedPolicy
from magrl.checks import check_type
from magrl.envs import GeomagneticNavEnv, Scenario, Tasks, named_tasks
from magrl.evaluation.metrics import episode_measures
from magrl.evaluation.navigators import make_navigator
from magrl.evaluation.runs import NO_NOISE, Noise
from magrl.evaluation.scenarios import with_declaration, with_errors
from magrl.navigators import Navigator
from magrl.transforms import conditions_named


def evaluate(
    policy: TensorDictModuleBase | str,
    tasks: Scenario | Tasks | str,
    *,
    num_envs: int | None = None,
    noise: Noise = NO_NOISE,
    conditions: str | None = None,
    known_start: Sequence[float] | None = None,
    confidence: float = 0.0,
    seed: int = 0,
    device: torch.device | str = "cpu",
    **options: Any,
) -> TensorDict:
    """Fly each task exactly once, without exploration, and return the measures of the episodes.

    Args:
        policy: policy or navigator of the plain environment, or the text that names one, as
            :func:`magrl.evaluation.navigators.make_navigator` takes it: ``"secant"``, ``"policy=sac.safetensors"``. A
            trained policy is flown within the limits of the environment (:meth:`magrl.FieldPolicy.for_env`).
        tasks: scenario with tasks; or tasks, or the name of a frozen set such as ``"test-1000"``, in the paper's
            region.
        num_envs: number of vehicles that fly at a time, each several tasks where there are more; by default one for
            each task. Sensor noise, other errors and random start headings depend on it, the tasks do not.
        noise: standard deviations of the noise on D [deg], I [deg], B_H [nT].
        conditions: errors of a real vehicle instead of noise: a name of :data:`magrl.transforms.CONDITIONS`, or a file
            (:func:`magrl.transforms.load_conditions`).
        known_start: where the vehicles know the elements at their start, the standard deviations of these: they then
            calibrate their sensors (:class:`magrl.transforms.KnownStart`). With ``conditions``.
        confidence: least probability at which navigators declare an arrival.
        seed: random seed of the errors, random start headings and metaheuristics.
        device: device of the environment.
        options: further options of :class:`~magrl.envs.GeomagneticNavEnv`, such as ``max_steps`` or ``zeta``. With
            ``arrival="declared"``, navigators and trained agents declare by their own estimate
            (:func:`magrl.evaluation.scenarios.with_declaration`); another policy writes the third action itself.

    Returns:
        ``(M,)``, one row for each task in its order, with the measures of
        :func:`magrl.evaluation.episode_measures`. :func:`magrl.evaluation.summarize` takes it, and
        ``pandas.DataFrame(episodes.to_dict(convert_tensors="numpy"))`` is its data frame.

    Raises:
        TypeError: for a policy that is not callable, or tasks of another type.
        ValueError: for a scenario without tasks, noise with conditions, a policy of another field or of longer moves,
            or another value out of its range.

    Example:
        >>> episodes = evaluate("secant", "paper-100", num_envs=30)
        >>> episodes.shape, episodes["success"].double().mean()
        (torch.Size([100]), tensor(1., dtype=torch.float64))
    """
    scenario = _with_tasks(tasks)
    count = len(scenario.tasks.start)  # type: ignore[union-attr]
    num_envs = count if num_envs is None else num_envs
    if conditions is not None and any(noise):
        raise ValueError(f"conditions {conditions!r} hold the noise of the sensors: omit the noise {noise}")
    flown = conditions_named(conditions or "laboratory")
    drift = {"drift_km": flown.drift_km(options.get("max_move_km", scenario.max_move_km))}
    base = GeomagneticNavEnv(scenario, num_envs=num_envs, seed=seed, device=device, **(drift | options))
    env, sensor_std = with_errors(base, flown if conditions else noise, seed, known_start)
    if isinstance(policy, str):
        policy = make_navigator(policy, base, seed=seed, sensor_std=sensor_std)
    elif isinstance(policy, TrainedPolicy):
        policy = policy.for_env(base)
    if isinstance(policy, TrainedPolicy | Navigator):
        env = with_declaration(env, confidence, policy)
    restart(env)
    episodes = [_next_episodes(env, policy) for _ in range(math.ceil(count / num_envs))]
    return torch.cat(episodes)[:count]  # a last batch that is not full has flown the first tasks again


def _with_tasks(tasks: Scenario | Tasks | str) -> Scenario:
    """Return a scenario with tasks; raise if it has none."""
    tasks = named_tasks(tasks) if isinstance(tasks, str) else tasks
    scenario = tasks if isinstance(tasks, Scenario) else Scenario().with_tasks(tasks)
    if scenario.tasks is None:
        raise ValueError("the scenario has no tasks to fly: scenario.with_tasks(scenario.random_tasks(300, seed=0))")
    return scenario


def _next_episodes(env: EnvBase, policy: TensorDictModuleBase) -> TensorDict:
    """Return the measures of the next episode of each vehicle, ``(num_envs,)``, and count exactly this episode."""
    base = getattr(env, "base_env", env)
    before = base.episode
    measures = episode_measures(_rollout(env, policy), env)
    base.episode = before
    env.reset()
    return TensorDict(measures, [env.num_envs])


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
        What follows the end of an episode does not count.

    Raises:
        TypeError: for another environment, or a policy that is not callable.
        ValueError: for a trained policy that does not fit the environment (:meth:`magrl.FieldPolicy.check_fits`).

    Example:
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0, max_steps=3)
        >>> evaluation_rollout(env, env.rand_action).shape
        torch.Size([2, 3])
    """
    restart(env)
    return _rollout(env, policy)


def _rollout(env: EnvBase, policy: TensorDictModuleBase) -> TensorDict:
    """Return the next episode of each vehicle, without exploration or gradients."""
    if not callable(policy):
        raise TypeError(f"policy must be callable with a TensorDict, got {policy!r}")
    if isinstance(policy, TrainedPolicy):
        policy.check_fits(env)
    failed = torch.zeros(env.num_envs, 1, dtype=torch.bool, device=env.device)

    def act(tensordict: TensorDictBase) -> TensorDictBase:
        action = policy(tensordict)["action"]
        failed.logical_or_(~torch.isfinite(action).all(-1, keepdim=True))
        return tensordict.set("action", torch.where(failed, 0.0, action))

    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        rollout = env.rollout(env.max_steps, act, break_when_any_done=False, break_when_all_done=True)
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
        >>> from magrl.transforms import SensorNoise
        >>> env = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), SensorNoise((0.05, 0.05, 5.0)))
        >>> rollout = env.rollout(2)
        >>> bool((with_true_field(rollout)["next", "field"] == rollout["next", "true_field"]).all())
        True
    """
    shown = rollout.copy()
    for state in (shown, shown["next"]):
        state["field"] = state.get("true_field", state["field"])
    return shown
