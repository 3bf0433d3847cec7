"""The environment for Gymnasium: one vehicle as an ``Env``, a batch of them as a ``VectorEnv``.

``import magrl`` registers the named tasks (:data:`magrl.named_tasks.NAMED_TASKS`). The classes run their TorchRL
environments, and only convert tensors to arrays: the same seed and the same actions give the same bits.
"""

from __future__ import annotations

import math
import os
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, TensorSpec
from torchrl.envs import CatTensors, TransformedEnv

from magrl.envs.measures import Episode, measured
from magrl.envs.specs import PUBLIC_KEYS
from magrl.named_tasks import NAMED_TASKS, task_name
from magrl.transforms.areas import outlines

ENV_ID, ANYWHERE_ID = (NAMED_TASKS[name].id for name in ("box", "anywhere"))
Observation = NDArray[np.float32] | dict[str, NDArray[np.float32]]
VectorStep = tuple[Observation, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]
# A forked process lacks the threads of its parent, and would wait for them.
os.register_at_fork(after_in_child=lambda: torch.set_num_threads(1))


def _box(*specs: TensorSpec) -> spaces.Space[Any]:
    """Return the space of one vehicle, from the specs that are concatenated in an array."""
    low, high = (torch.cat([_bound(spec, end).cpu() for spec in specs]).numpy() for end in ("low", "high"))
    return spaces.Box(low, high, dtype=np.float32)


def _bound(spec: TensorSpec, end: str) -> Tensor:
    """Return the lowest or highest values of one vehicle; infinite where the spec has none."""
    if isinstance(spec, Bounded):
        return getattr(spec.space, end)[0].float()
    return torch.full(spec.shape[1:], -math.inf if end == "low" else math.inf)


def _observation_space(env: TransformedEnv, keys: tuple[str, ...], *, flat: bool) -> spaces.Space[Any]:
    """Return the space of one vehicle's observation; its bounds are the specs' bounds."""
    spec = env.observation_spec
    if missing := [key for key in keys if key not in spec.keys()]:  # noqa: SIM118 - a Composite is no mapping
        raise ValueError(f"observation names {missing[0]!r}, which is not among the keys {sorted(spec.keys())}")
    if not flat:
        return spaces.Dict({key: _box(spec[key]) for key in keys})
    # CatTensors drops the bounds of what it joins.
    joined = [step for step in env.transform if isinstance(step, CatTensors) and step.out_keys == ["observation"]]
    bounds = [step.bounds for step in env.transform if hasattr(step, "bounds") and keys[0] in step.out_keys]
    if bounds and not joined:
        low, high = (np.array(end, np.float32) for end in bounds[-1])
        return spaces.Box(low, high, dtype=np.float32)
    return _box(*(spec[key] for key in (joined[-1].in_keys if joined else keys)))


def _array(tensor: Tensor) -> NDArray[Any]:
    """Return a copy as an array: writing into it does not change the environment."""
    return np.array(tensor.detach().cpu().numpy())


def _keep_spec(env: Any, spec: EnvSpec) -> None:
    """Keep Gymnasium's ``spec`` of an environment, with its step limit."""
    env.limited_spec = replace(spec, max_episode_steps=env.torchrl_env.base_env.max_steps)


_SPEC: Any = property(lambda env: getattr(env, "limited_spec", None), _keep_spec, doc="Gymnasium's record of it.")


class GeomagneticNavVectorEnv(VectorEnv[Observation, NDArray[np.float32], NDArray[Any]]):
    """A batch of vehicles: ``gymnasium.make_vec("magrl/GeomagneticNavigation-v1", num_envs=N, **options)``.

    All move in one batched step. The autoreset modes are Gymnasium's. With ``NEXT_STEP``, the step after the end
    of an episode starts the next, whatever the action; with ``DISABLED``, ``reset(options={"reset_mask": ended})``.
    In both, ``info`` has the measures and their masks. With ``SAME_STEP``, the next episode starts in the step in which
    one ends: the observation returned is the first of the new episode, ``info["final_obs"]`` the last of the old one
    and ``info["final_info"]`` its measures, each with its mask ``_final_obs``, ``_final_info``.

    ``reset(seed=s)`` is the first reset of the TorchRL environment of ``N`` vehicles and seed ``s``: each row has
    its own episodes; row 0 has the episodes of the single environment.

    Args:
        num_envs: vehicles in the batch.
        render_mode: None, or ``"rgb_array"``: an image of each vehicle.
        autoreset_mode: mode, or its value: ``"NextStep"``, ``"SameStep"`` or ``"Disabled"``.
        max_episode_steps: Gymnasium's name of ``max_steps``.
        task: name or id of the task, which ``gymnasium.make`` sets.
        **options: of its function in :mod:`magrl.named_tasks`; all take the options of
            :func:`magrl.envs.navigation.navigation_env`.

    Raises:
        TypeError, ValueError: for a bad option, as that function.

    Example:
        >>> envs = gymnasium.make_vec(ENV_ID, num_envs=4, vectorization_mode="vector_entry_point")
        >>> observations, info = envs.reset(seed=0)
        >>> observations, rewards, terminations, truncations, info = envs.step(envs.action_space.sample())
        >>> observations.shape, rewards.shape
        ((4, 13), (4,))
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 4}
    spec = _SPEC

    def __init__(
        self,
        num_envs: int = 1,
        *,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        max_episode_steps: int | None = None,
        task: str = "box",
        **options: Any,
    ) -> None:
        if max_episode_steps is not None:
            options.setdefault("max_steps", max_episode_steps)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.autoreset_mode = AutoresetMode(autoreset_mode)  # where TorchRL's GymWrapper reads it
        self.metadata = self.metadata | {"autoreset_mode": self.autoreset_mode}
        self.torchrl_env = NAMED_TASKS[task_name(task)].make(num_envs, render_mode=render_mode, **options)
        observation = options.get("observation", "flat")  # or another array, by default of the task
        self._flat = isinstance(observation, str) and observation != "dict"
        areas = [key for key in ("areas",) if key in self.torchrl_env.observation_spec.keys()]  # noqa: SIM118
        keys = (*PUBLIC_KEYS, *areas) if observation == "dict" else observation
        self._keys = ("observation",) if self._flat else tuple(keys)
        self.single_observation_space = _observation_space(self.torchrl_env, self._keys, flat=self._flat)
        self.single_action_space = _box(self.torchrl_env.action_spec)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._length_km = torch.zeros(num_envs, dtype=torch.float64, device=self.torchrl_env.device)
        self._state: TensorDictBase = TensorDict(batch_size=num_envs, device=self.torchrl_env.device)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start the next episode of every vehicle, or with a seed the first.

        Args:
            seed: seed, from 0 on.
            options: ``reset_mask``, ``(N,)`` bool: the vehicles that start, all at the first reset. Others are ignored.
        """
        super().reset(seed=seed)
        if seed is not None:
            self.torchrl_env.set_seed(seed)
        everyone = torch.ones_like(self._length_km, dtype=torch.bool)
        mask = (options or {}).get("reset_mask", everyone) if "done" in self._state else everyone
        self._start(torch.as_tensor(mask).to(everyone))
        return self._observe(self._state), {}

    def _start(self, mask: Tensor) -> None:
        """Start the next episodes of some vehicles, ``(N,)`` bool."""
        if mask.any():
            self._state = self.torchrl_env.reset(self._state.set("_reset", mask.unsqueeze(-1)), set_state=False)
            self._length_km = self._length_km.masked_fill(mask, 0.0)

    def step(self, actions: NDArray[np.float32]) -> VectorStep:
        """Move every vehicle.

        Args:
            actions: ``(N, 2)`` distance and turn, in [-1, 1] or in km and rad.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset; without autoreset, also after the end of an episode.
            ValueError: for actions of another shape, not real numbers, not finite, or out of their bounds.
        """
        disabled = self.autoreset_mode is AutoresetMode.DISABLED
        if "done" not in self._state or (disabled and self._state["done"].any()):
            raise gymnasium.error.ResetNeeded("call reset() before step(): a vehicle has no running episode")
        idle = self._state["done"].squeeze(-1)  # with NEXT_STEP, those whose next episode starts now
        state = self.torchrl_env.step(self._state.set("action", self._action(actions)))
        self._state, after = self.torchrl_env.step_mdp(state), state["next"]
        self._length_km = self._length_km + after["leg"][:, 0].double()
        results = [after[key].squeeze(-1).masked_fill(idle, 0) for key in ("reward", "terminated", "truncated")]
        ended = results[1] | results[2]
        info = self._info(after, ended) if ended.any() else {}
        self._start(ended if self.autoreset_mode is AutoresetMode.SAME_STEP else idle)
        return self._observe(self._state), *map(_array, results), info  # type: ignore[return-value]

    def _info(self, after: TensorDictBase, ended: Tensor) -> dict[str, Any]:
        """Return Gymnasium's ``info`` of a step in which episodes ended: values, each with its mask."""
        info, mask = dict[str, Any](), _array(ended)
        for name, values in _measures(after[ended], self._length_km[ended]).items():
            info[name], info[f"_{name}"] = np.zeros(self.num_envs, dtype=values.dtype), mask.copy()
            info[name][mask] = values
        if self.autoreset_mode is not AutoresetMode.SAME_STEP:
            return info
        last, final_obs = self._observe(after), np.full(self.num_envs, None, dtype=object)
        for vehicle in np.flatnonzero(mask):
            final_obs[vehicle] = _row(last, int(vehicle))
        return {"final_obs": final_obs, "_final_obs": mask, "final_info": info, "_final_info": mask.copy()}

    def _observe(self, state: TensorDictBase) -> Observation:
        """Return the observations of all vehicles, ``(N, ...)``."""
        arrays = {key: _array(state[key]).astype(np.float32, copy=False) for key in self._keys}
        return arrays["observation"] if self._flat else arrays

    def _action(self, actions: Any) -> Tensor:
        array, wanted = np.asarray(actions), self.action_space.shape
        if array.shape != wanted or array.dtype.kind not in "fiu":
            shape = f"shape {wanted}, a vehicle per row"
            raise ValueError(f"actions must be real numbers of {shape}, got {array.dtype} of shape {array.shape}")
        return torch.from_numpy(array.astype(np.float32)).to(self.torchrl_env.device)

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Return an image of each vehicle's episode, ``(H, W, 3)``, or None without a ``render_mode``."""
        if self.render_mode is None:
            gymnasium.logger.warn(f"render() needs gymnasium.make({ENV_ID!r}, render_mode='rgb_array')")
            return None
        areas = self._state.get("no_go_areas", None)
        rings = None if areas is None else outlines(areas, self._state["target_position"])
        return tuple(
            self.torchrl_env.base_env.render([vehicle], outlines=() if rings is None else rings[vehicle])
            for vehicle in range(self.num_envs)
        )


class GeomagneticNavGymEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """One vehicle: ``gymnasium.make("magrl/GeomagneticNavigation-v1", **options)``.

    ``reset(seed=s)`` starts the first episode of vehicle 0 of the TorchRL environment of seed ``s``; each ``reset()``
    after it starts the next. The ``info`` of an episode's last step holds its measures (``success``, ``is_success``,
    ``steps``, ``shortest_km``, ``length_km``, ``navigation_error_km``, ``path_efficiency``, ``spl``); otherwise it is
    empty.

    Args:
        render_mode: None, or ``"rgb_array"``: the track over the field's contours, ``(700, 700, 3)`` uint8.
        **options: of :class:`GeomagneticNavVectorEnv`; with ``task``, options of the task.

    Raises:
        TypeError, ValueError: for a bad option, as there.

    Example:
        >>> env = gymnasium.make(ENV_ID, zeta=0.001)
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> observation.shape, env.action_space
        ((13,), Box(-1.0, 1.0, (2,), float32))
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 4}
    spec = _SPEC

    def __init__(self, *, render_mode: str | None = None, **options: Any) -> None:
        if batched := sorted({"num_envs", "autoreset_mode"} & options.keys()):
            raise TypeError(f"gymnasium.make makes one vehicle, without {batched[0]!r}: use gymnasium.make_vec")
        self._envs = GeomagneticNavVectorEnv(1, render_mode=render_mode, autoreset_mode="Disabled", **options)
        self.torchrl_env, self.render_mode = self._envs.torchrl_env, render_mode
        self.observation_space = self._envs.single_observation_space
        self.action_space = self._envs.single_action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode; the class describes the meaning of a seed. There are no options."""
        super().reset(seed=seed)
        observation, info = self._envs.reset(seed=seed, options=options)
        return _row(observation, 0), info

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move the vehicle.

        Args:
            action: ``(2,)`` distance and turn, in [-1, 1] or in km and rad.

        Raises:
            gymnasium.error.ResetNeeded: if no episode is running.
            ValueError: for an action of another shape, not real numbers, not finite, or out of its bounds.
        """
        observation, *results, info = self._envs.step(np.asarray(action)[None])
        reward, terminated, truncated = (value.item() for value in results)
        measures = {name: values.item() for name, values in info.items() if not name.startswith("_")}
        return _row(observation, 0), reward, terminated, truncated, measures

    def render(self) -> NDArray[np.uint8] | None:
        """Return the running episode over the field's contours, or None without a ``render_mode``."""
        images = self._envs.render()
        return images[0] if images else None


def _measures(end: TensorDictBase, length_km: Tensor) -> dict[str, NDArray[Any]]:
    """Return the measures of episodes from their last states."""
    flags = {key: end[key].squeeze(-1) for key in ("success", "declared", "truncated") if key in end.keys()}  # noqa: SIM118
    places = {key: end[f"{key}_position"] for key in ("start", "target")} | {"end": end["position"]}
    measures = measured(Episode(steps=end["elapsed_steps"].squeeze(-1), length_km=length_km, **places, **flags))
    measures["is_success"] = measures["success"]  # the name that stable-baselines3 and Gymnasium-Robotics read
    return {name: _array(value) for name, value in measures.items()}


def _row(observation: Observation, index: int) -> Observation:
    if isinstance(observation, dict):
        return {key: value[index] for key, value in observation.items()}
    return observation[index]
