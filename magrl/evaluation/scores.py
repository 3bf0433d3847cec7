"""Scores of any agent on the named tasks: navigators, files, and policies of any library, in the same episodes."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import nn
from torch.utils._pytree import tree_map

from magrl.checks import check_float32, check_number, short
from magrl.envs.measures import bootstrap_interval, summarize
from magrl.evaluation.arrays import ArrayPolicy
from magrl.evaluation.episodes import episode_measures, episode_scores, evaluation_rollout
from magrl.named_tasks import NAMED_TASKS, task_name
from magrl.navigators import Navigator
from magrl.navigators.names import make_navigator, named
from magrl.navigators.onnx import OnnxNetwork, has_view
from magrl.policy_files import reading
from magrl.random_numbers import FIRST_RESERVED_SEED

SEED = FIRST_RESERVED_SEED + 69
"""Reserved seed of the episodes: ``envs.reset(seed=SEED)`` of as many vehicles starts the same ones."""
FAR_KM = 50
"""Distance from the destination beyond which the end of a success is far [km]: the longest leg of the paper."""


def score(agent: Any, task: str, *, episodes: int = 1000, seed: int = SEED, **options: Any) -> dict[str, float]:
    """Return the score of an agent on a named task: the first episode of each vehicle, without exploration.

    Args:
        agent: one of

            - a name or a file, as :func:`magrl.navigators.names.make_navigator` takes it, or the folder of a run:
              ``"kalman"``, ``"policy.onnx"``, ``"runs/gg_td3"``; also an ONNX file without a view, as of
              :class:`magrl.navigators.onnx.OnnxNetwork`;
            - a TensorDict module that reads ``observation`` and writes ``action`` in [-1, 1], also with recurrent
              modules of TorchRL, or another module of PyTorch from the one to the other;
            - any other TensorDict module, such as a navigator: it reads raw keys, and writes ``action`` in km and rad;
            - a model of stable-baselines3, or what else has their ``predict``;
            - a function of arrays: ``act(observations)`` returns actions in [-1, 1], ``(N, K)`` to ``(N, 2)``; or
              ``act(observations, state)`` returns actions and the next state, which is None at the start: arrays with
              the vehicles on their first axis, or a tuple, list or dict of them. It gets no other key.
        task: name or id of a task in :data:`magrl.named_tasks.NAMED_TASKS`: ``"nogo"``, or
            ``"magrl/GeomagneticNavigationNoGo-v1"``.
        episodes: vehicles, each with one episode.
        seed: seed of the episodes; the default is reserved for evaluations.
        options: of its function in :mod:`magrl.named_tasks`. The score is then not the task's.

    Returns:
        ``score``, 10 times the mean return [%]: 100 SPL for each arrival, below 50 for a failure; ``SR``, success rate
        [%]; ``SPL`` [%]; ``score_low``, ``score_high``, ``SPL_low`` and ``SPL_high``, bootstrap 95 % intervals over
        episodes; ``steps``, their mean; ``beyond_50km``, share of successes that end more than 50 km from the
        destination [%], NaN without a success.

    Raises:
        TypeError: for an agent of another kind.
        ValueError: for an unknown task or navigator, or actions of another shape or that are not finite in
            float32, naming vehicles and step.

    Example:
        >>> def straight(observations):
        ...     return 0 * observations[:, :2]
        >>> [score(agent, "box", episodes=8)["SR"] for agent in ("secant", straight)]
        [100.0, 0.0]
    """
    check_number(1, whole=True, episodes=episodes)
    check_number(0, whole=True, seed=seed)
    return scored(flown(agent, task_name(task), episodes=episodes, seed=seed, **options))


def flown(agent: Any, task: str, *, episodes: int = 1000, seed: int = SEED, **options: Any) -> TensorDict:
    """Return the rollout of :func:`score`, as :func:`magrl.evaluation.episode_measures` takes it."""
    policy, make = _policy(agent), partial(NAMED_TASKS[task_name(task)].make, episodes, seed=seed, **options)
    if isinstance(policy, str) or "observation" not in policy.in_keys:
        env = make(observation="dict", scale_actions=False)
        policy = make_navigator(policy, env.base_env) if isinstance(policy, str) else policy
        policy = policy.fitted(env.base_env, {}) if isinstance(policy, Navigator) else policy
        return evaluation_rollout(env, policy, strict=True)
    env = make()
    if "observation" not in env.observation_spec.keys():  # noqa: SIM118 - a Composite is no mapping
        raise ValueError(f"the agent reads 'observation', which observation={options['observation']!r} leaves out")
    return evaluation_rollout(env, policy, strict=True)


def scored(rollout: TensorDictBase) -> dict[str, float]:
    """Return the score of a rollout of :func:`flown`."""
    measures, scores = episode_measures(rollout), episode_scores(rollout)
    low, high = bootstrap_interval(scores)
    summary, far = summarize(measures), measures["navigation_error_km"][measures["success"]] > FAR_KM
    return {
        "score": scores.mean().item(),
        "score_low": low,
        "score_high": high,
        "SR": summary["success_rate"],
        **{f"SPL{end}": summary[f"spl{end}"] for end in ("", "_low", "_high")},
        "steps": measures["steps"].double().mean().item(),
        f"beyond_{FAR_KM}km": 100 * far.double().mean().item() if len(far) else math.nan,
    }


def _policy(agent: Any) -> TensorDictModuleBase | str:
    """Return an agent as a policy, or the text of a navigator, which is made for an environment."""
    if isinstance(agent, str | Path):
        return _of_text(str(agent))
    if isinstance(agent, type):
        raise TypeError(f"agent must be an object, got the class {agent.__name__}: make one")
    if isinstance(agent, TensorDictModuleBase):
        return agent
    if hasattr(agent, "predict"):
        return ArrayPolicy(partial(_predicted, agent))
    if isinstance(agent, nn.Module):
        check_float32(agent, "agent")
        return TensorDictModule(agent, ["observation"], ["action"])
    if not callable(agent):
        wanted = "the name or file of a navigator, a module, a model with predict, or a function of observations"
        raise TypeError(f"agent must be {wanted}, got {short(agent)}")
    if _takes_state(agent):
        return ArrayPolicy(lambda seen, state, _: agent(seen, state))
    return ArrayPolicy(lambda seen, *_: (agent(seen), None))


def _predicted(model: Any, seen: Any, state: Any, first: Any) -> tuple[Any, Any]:
    """Return actions and next state of a model of stable-baselines3, whose states are ``(layers, N, ...)``."""
    turned = partial(tree_map, lambda array: None if array is None else array.swapaxes(0, 1))
    actions, state = model.predict(seen, turned(state), first, deterministic=True)
    return actions, turned(state)


def _takes_state(act: Callable[..., Any]) -> bool:
    """Return whether a function has two arguments, of which the second is ``state`` or has no default."""
    given = list(inspect.signature(act).parameters.values())
    if any(x.kind is x.VAR_POSITIONAL for x in given):
        wanted = "act(observations) or act(observations, state)"
        raise TypeError(f"agent must be {wanted}, got {short(act)} of any number of arguments: name its arguments")
    placed = [x for x in given if x.kind in (x.POSITIONAL_ONLY, x.POSITIONAL_OR_KEYWORD)]
    return len(placed) > 1 and (placed[1].default is inspect.Parameter.empty or placed[1].name == "state")


def _of_text(text: str) -> TensorDictModuleBase | str:
    """Return the network of an ONNX file without a view as a policy; otherwise the text of a navigator."""
    path = named(text).file
    if path is None or path.suffix != ".onnx":
        return text
    with reading(path):
        if has_view(content := path.read_bytes()):
            return text

    network = lru_cache(partial(OnnxNetwork, content))

    def act(seen: Any, *_: Any) -> tuple[Any, None]:
        with reading(path):
            return network(seen.shape[-1])(torch.from_numpy(seen)), None

    return ArrayPolicy(act)
