"""The environment for Gymnasium: one vehicle as an ``Env``, a batch of them as a ``VectorEnv``.

Importing this module registers ``magrl/GeomagneticNavigation-v0``. Both faces drive :func:`navigation_env`, the TorchRL
environment behind the transforms of the recipes, and only turn tensors into arrays: nothing is computed anew, so
that the same seed and the same actions give the same bits.
"""

from __future__ import annotations

import inspect
import math
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded
from torchrl.envs import CatTensors, Compose, Transform, TransformedEnv

from magrl import td3
from magrl.checks import check_type
from magrl.env import GeomagneticNavEnv
from magrl.geodesy import geodesic

ENV_ID = "magrl/GeomagneticNavigation-v0"
OBSERVATIONS = ("flat", "dict")
REWARDS = ("guided", "base")
Observation = NDArray[np.float32] | dict[str, NDArray[np.float32]]


def register() -> None:
    """Registers :data:`ENV_ID` with Gymnasium, once; importing this module does it.

    Example:
        >>> register()
        >>> gymnasium.spec(ENV_ID).vector_entry_point
        'magrl.gymnasium_env:GeomagneticNavVectorEnv'
    """
    if ENV_ID not in gymnasium.registry:
        gymnasium.register(
            ENV_ID,
            entry_point="magrl.gymnasium_env:GeomagneticNavGymEnv",
            vector_entry_point="magrl.gymnasium_env:GeomagneticNavVectorEnv",
        )


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
    """The TorchRL environment that both faces drive: the recipes' transforms on a :class:`magrl.env.GeomagneticNavEnv`.

    Args:
        num_envs: vehicles in the batch.
        observation: ``"flat"`` adds ``observation``, ``(N, 13)``, what the recipes' networks read; ``"dict"`` leaves
            the public keys as they are, in physical units.
        reward: ``"guided"`` adds the alignment term to the paper's base reward; ``"base"`` is that reward alone.
        scale_actions: whether an action is in [-1, 1], or in km and rad.
        alignment_weight: zeta_3 of Eq. 3-6 [1/rad], of the guided reward.
        alignment_offset: heading deviation at which the alignment term turns into a penalty [rad].
        **options: of :class:`magrl.env.GeomagneticNavEnv`.

    Raises:
        TypeError: for an option that the environment does not have, or ``scale_actions`` that is no bool.
        ValueError: for any option out of its range, naming it and its value.

    Example:
        >>> navigation_env(4, seed=0).reset()["observation"].shape
        torch.Size([4, 13])
    """
    _check_choice("observation", observation, OBSERVATIONS)
    _check_choice("reward", reward, REWARDS)
    check_type(bool, scale_actions=scale_actions)
    known = inspect.signature(GeomagneticNavEnv.__init__).parameters.keys() - {"self", "num_envs"}
    if unknown := sorted(options.keys() - known):
        # In Python's own words: TorchRL's GymEnv looks for them to find out what it can pass.
        raise TypeError(f"got an unexpected keyword argument {unknown[0]!r}; the environment has {sorted(known)}")
    base = GeomagneticNavEnv(num_envs=num_envs, **options)
    view = td3.policy_config(base, (1,), layer_norm=False)  # for its scaling; the network is the user's own
    transforms: list[Transform] = []
    if reward == "guided":
        transforms += td3.guidance_transforms(base, alignment_weight, alignment_offset)
    if observation == "flat":
        transforms += td3.observation_transforms(view)
    if scale_actions:
        transforms.append(td3.action_transform(view))
    return TransformedEnv(base, Compose(*transforms))


def _check_choice(name: str, value: object, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, choices))}, got {value!r}")


# Spaces


def _box(*specs: Bounded) -> spaces.Space[Any]:
    """The space of one vehicle, of the entries that are concatenated in an array."""
    low, high = (
        torch.cat([getattr(spec.space, end)[0] for spec in specs]).cpu().numpy().astype(np.float32)
        for end in ("low", "high")
    )
    return spaces.Box(low, high, dtype=np.float32)


def _observation_space(env: TransformedEnv, keys: tuple[str, ...]) -> spaces.Space[Any]:
    """The space of one vehicle's observation; its bounds are those of the specs."""
    spec = env.observation_spec
    if keys != ("observation",):
        return spaces.Dict({key: _box(spec[key]) for key in keys})
    # CatTensors drops the bounds of what it joins.
    (joined,) = (transform for transform in env.transform if isinstance(transform, CatTensors))
    return _box(*(spec[key] for key in joined.in_keys))


def _array(tensor: Tensor) -> NDArray[Any]:
    """An array of its own, so that a user who writes into it does not write into the environment."""
    return np.array(tensor.detach().cpu().numpy())


# What both faces share


class _Fleet:
    """Vehicles under way, arrays in and arrays out.

    Args:
        num_envs: vehicles in the batch.
        render_mode: None or ``"rgb_array"``.
        **options: of :func:`navigation_env`.
    """

    def __init__(self, num_envs: int, render_mode: str | None, options: dict[str, Any]) -> None:
        if render_mode is not None:
            _check_choice("render_mode", render_mode, ("rgb_array",))
        self.render_mode = render_mode
        if "num_envs" in options:
            raise TypeError(f"one vehicle has no num_envs, got {options['num_envs']}: use gymnasium.make_vec")
        self.env = navigation_env(num_envs, **options)
        self.keys = ("observation",) if options.get("observation", "flat") == "flat" else td3.PUBLIC_KEYS
        self.observation_space = _observation_space(self.env, self.keys)
        self.action_space = _box(self.env.action_spec)
        self._state: TensorDictBase | None = None
        self._length_km = torch.zeros(num_envs, dtype=torch.float64, device=self.env.device)

    def reset(self, seed: int | None, options: dict[str, Any] | None) -> Observation:
        """Starts the next journey of every vehicle, or with a seed the first."""
        if options:
            raise ValueError(f"{ENV_ID} has no options of reset, got {options}")
        if seed is not None:
            self.env.set_seed(seed)
        self._state = self.env.reset()
        self._length_km = torch.zeros_like(self._length_km)
        return self.observe(self._state)

    def observe(self, state: TensorDictBase) -> Observation:
        """Observations of all vehicles, ``(N, ...)``."""
        arrays = {key: _array(state[key]) for key in self.keys}
        return arrays if len(arrays) > 1 else arrays["observation"]

    def step(self, actions: Any, *, autoreset: bool) -> tuple[TensorDictBase, dict[str, NDArray[Any]]]:
        """Moves every vehicle.

        Returns:
            What ``next`` holds after a step of TorchRL, and the measures of the ``P`` journeys that ended.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset() before step(): no journey is under way")
        state = self._state.set("action", self._action(actions))
        if autoreset:
            state, self._state = self.env.step_and_maybe_reset(state)
        else:
            state = self.env.step(state)
            self._state = None if state["next", "done"].all() else self.env.step_mdp(state)
        after = state["next"]
        done = after["done"].squeeze(-1)
        self._length_km = self._length_km + after["move"][:, 0].double()
        measures = _measures(after[done], self._length_km[done]) if done.any() else {}
        self._length_km = self._length_km.masked_fill(done, 0.0)
        return after, measures

    def _action(self, actions: Any) -> Tensor:
        array = np.array(actions, dtype=np.float32)
        shape = tuple(self.env.action_spec.shape)
        if array.shape != shape:
            raise ValueError(f"actions must have shape {shape}: distance and turn; got shape {array.shape}")
        return torch.from_numpy(array).to(self.env.device)

    def current(self) -> Observation:
        """Observations of the journeys under way."""
        assert self._state is not None
        return self.observe(self._state)

    def pictures(self) -> tuple[NDArray[np.uint8], ...] | None:
        """The journey of each vehicle, ``(H, W, 3)``, or None without a render mode."""
        if self.render_mode is None:
            gymnasium.logger.warn(f"nothing is drawn without gymnasium.make({ENV_ID!r}, render_mode='rgb_array')")
            return None
        return tuple(self.env.base_env.render([vehicle]) for vehicle in range(self.env.base_env.num_envs))


def _measures(end: TensorDictBase, length_km: Tensor) -> dict[str, NDArray[Any]]:
    """The measures of journeys, from their last states, as :func:`magrl.metrics.episode_measures` names them."""
    start, position, target = (end[key].unbind(-1) for key in ("start_position", "position", "target_position"))
    success, shortest_km = end["success"].squeeze(-1), geodesic(*start, *target)[0]
    measures = {
        "success": success,
        "is_success": success,  # the name that stable-baselines3 and Gymnasium-Robotics look for
        "steps": end["step_count"].squeeze(-1),
        "shortest_km": shortest_km,
        "length_km": length_km,
        "navigation_error_km": geodesic(*position, *target)[0],
        "spl": success * shortest_km / torch.maximum(length_km, shortest_km),
    }
    return {name: _array(value) for name, value in measures.items()}


# The two faces


class GeomagneticNavGymEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """One vehicle: ``gymnasium.make("magrl/GeomagneticNavigation-v0", **options)``.

    ``reset(seed=s)`` starts the first journey of vehicle 0 of the TorchRL environment of seed ``s``; each ``reset()``
    after it starts the next. The ``info`` of a journey's last step holds its measures (``success``, ``is_success``,
    ``steps``, ``shortest_km``, ``length_km``, ``navigation_error_km``, ``spl``); otherwise it is empty.

    Args:
        render_mode: None, or ``"rgb_array"``: the track over the field's contours, ``(700, 700, 3)`` uint8.
        **options: of :func:`navigation_env`, which holds those of :class:`magrl.env.GeomagneticNavEnv`.

    Raises:
        TypeError, ValueError: for a bad option, as :func:`navigation_env`.

    Example:
        >>> env = gymnasium.make(ENV_ID, zeta=0.001)
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> observation.shape, env.action_space
        ((13,), Box(-1.0, 1.0, (2,), float32))
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012 as Gymnasium declares it

    def __init__(self, *, render_mode: str | None = None, **options: Any) -> None:
        self._fleet = _Fleet(1, render_mode, options)
        self.render_mode = render_mode
        self.observation_space = self._fleet.observation_space
        self.action_space = self._fleet.action_space

    @property
    def torchrl_env(self) -> TransformedEnv:
        """The TorchRL environment, a batch of one."""
        return self._fleet.env

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts a journey; see the class for what a seed means."""
        super().reset(seed=seed)
        return _row(self._fleet.reset(seed, options), 0), {}

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Moves the vehicle.

        Args:
            action: ``(2,)`` distance and turn, in [-1, 1] or in km and rad.

        Raises:
            gymnasium.error.ResetNeeded: where no journey is under way.
            ValueError: for an action of another shape, not finite, or out of its bounds.
        """
        after, measures = self._fleet.step(np.asarray(action)[None], autoreset=False)
        reward, terminated, truncated = (after[key].item() for key in ("reward", "terminated", "truncated"))
        info = {name: value.item() for name, value in measures.items()}
        return _row(self._fleet.observe(after), 0), reward, terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """The journey so far over the field's contours, or None without a ``render_mode``."""
        pictures = self._fleet.pictures()
        return pictures[0] if pictures else None


class GeomagneticNavVectorEnv(VectorEnv[Observation, NDArray[np.float32], NDArray[Any]]):
    """A batch of vehicles: ``gymnasium.make_vec("magrl/GeomagneticNavigation-v0", num_envs=N, **options)``.

    All move in one batched step. A vehicle whose journey ends starts the next in the same step
    (``AutoresetMode.SAME_STEP``): the observation returned is the first of the new journey, ``info["final_obs"]`` the
    last of the old one and ``info["final_info"]`` its measures, each with its mask ``_final_obs``, ``_final_info``.
    ``reset(seed=s)`` is the first reset of the TorchRL environment of ``N`` vehicles and seed ``s``: each row has
    journeys of its own, those of row 0 are the single environment's.

    Args:
        num_envs: vehicles in the batch.
        render_mode: None, or ``"rgb_array"``: a picture of each vehicle.
        **options: of :func:`navigation_env`.

    Raises:
        TypeError, ValueError: for a bad option, as :func:`navigation_env`.

    Example:
        >>> envs = gymnasium.make_vec(ENV_ID, num_envs=4, vectorization_mode="vector_entry_point")
        >>> observations, info = envs.reset(seed=0)
        >>> observations, rewards, terminations, truncations, info = envs.step(envs.action_space.sample())
        >>> observations.shape, rewards.shape
        ((4, 13), (4,))
    """

    metadata: dict[str, Any] = {**GeomagneticNavGymEnv.metadata, "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, num_envs: int = 1, *, render_mode: str | None = None, **options: Any) -> None:
        self._fleet = _Fleet(num_envs, render_mode, options)
        self.num_envs, self.render_mode = num_envs, render_mode
        self.single_observation_space = self._fleet.observation_space
        self.single_action_space = self._fleet.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    @property
    def torchrl_env(self) -> TransformedEnv:
        """The TorchRL environment of the whole batch."""
        return self._fleet.env

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts a journey of every vehicle; see the class for what a seed means."""
        super().reset(seed=seed)
        return self._fleet.reset(seed, options), {}

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[Observation, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Moves every vehicle.

        Args:
            actions: ``(N, 2)`` distance and turn, in [-1, 1] or in km and rad.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
            ValueError: for actions of another shape, not finite, or out of their bounds.
        """
        after, measures = self._fleet.step(actions, autoreset=True)
        reward, terminated, truncated = (_array(after[k].squeeze(-1)) for k in ("reward", "terminated", "truncated"))
        ended = terminated | truncated
        info = _final(self._fleet.observe(after), measures, ended) if measures else {}
        return self._fleet.current(), reward, terminated, truncated, info

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A picture of each vehicle's journey, or None without a ``render_mode``."""
        return self._fleet.pictures()


def _row(observation: Observation, index: int) -> Observation:
    if isinstance(observation, dict):
        return {key: value[index] for key, value in observation.items()}
    return observation[index]


def _final(observation: Observation, measures: dict[str, NDArray[Any]], ended: NDArray[np.bool_]) -> dict[str, Any]:
    """What Gymnasium's vector environments say of journeys that ended in a step: values, each with its mask."""
    final_obs = np.full(len(ended), None, dtype=object)
    for index in np.flatnonzero(ended):
        final_obs[index] = _row(observation, int(index))
    final_info: dict[str, Any] = {}
    for name, values in measures.items():
        final_info[name] = np.zeros(len(ended), dtype=values.dtype)
        final_info[name][ended] = values
        final_info[f"_{name}"] = ended.copy()
    return {
        "final_obs": final_obs,
        "_final_obs": ended.copy(),
        "final_info": final_info,
        "_final_info": ended.copy(),
    }


register()
