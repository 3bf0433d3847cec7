"""stable-baselines3 over a batched Gymnasium environment (extra ``sb3``).

The vector environments of stable-baselines3 step copies one after the other, or in processes. This one has one batched
step for all vehicles.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

try:
    from stable_baselines3.common.vec_env import VecEnv
    from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn
except ImportError as error:
    raise ImportError("magrl.envs.sb3 needs stable-baselines3: pip install 'magrl[sb3]'") from error


class BatchedVecEnv(VecEnv):
    """A ``VecEnv`` whose vehicles live in one Gymnasium ``VectorEnv``.

    Args:
        envs: batched environments that reset in the step in which an episode ends. Gymnasium's vector wrappers may be
            around them, for example ``TransformReward`` to scale rewards.

    Raises:
        ValueError: for environments with another autoreset mode.

    Example:
        >>> from magrl.envs.gymnasium import ENV_ID
        >>> envs = gymnasium.make_vec(ENV_ID, num_envs=4, autoreset_mode="SameStep")
        >>> BatchedVecEnv(envs).reset().shape
        (4, 13)
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any]) -> None:
        mode = envs.metadata.get("autoreset_mode")
        if mode is not AutoresetMode.SAME_STEP:
            raise ValueError(f"stable-baselines3 needs make_vec(..., autoreset_mode='SameStep'), got {mode}")
        self.envs = envs
        self._actions: np.ndarray | None = None
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> VecEnvObs:
        """Start an episode of every vehicle; after ``seed(s)``, the episodes of that seed."""
        observations, _ = self.envs.reset(seed=self._seeds[0], options=self._options[0] or None)
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for :meth:`step_wait`."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Move every vehicle."""
        observations, rewards, terminated, truncated, info = self.envs.step(self._actions)
        infos: list[dict[str, Any]] = [{"TimeLimit.truncated": bool(cut)} for cut in truncated]
        for index in np.flatnonzero(terminated | truncated):
            infos[index]["terminal_observation"] = info["final_obs"][index]
            final = info["final_info"]
            infos[index].update({key: final[key][index].item() for key in final if not key.startswith("_")})
        return observations, rewards, terminated | truncated, infos

    def close(self) -> None:
        """Close the environments."""
        self.envs.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return an image of each vehicle's episode."""
        images: Any = self.envs.render()
        return images or ()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return the same attribute for each vehicle: they share one environment."""
        return [getattr(self.envs, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the shared environment, for all vehicles together."""
        self._all_or_none(indices)
        setattr(self.envs, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any) -> list[Any]:
        """Call a method of the shared environment, once for all vehicles."""
        self._all_or_none(indices)
        return [getattr(self.envs, method_name)(*args, **kwargs)] * len(list(self._get_indices(indices)))

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Return whether the shared environment is such a wrapper, for each vehicle."""
        return [isinstance(self.envs, wrapper_class)] * len(list(self._get_indices(indices)))

    def _all_or_none(self, indices: VecEnvIndices) -> None:
        if indices is not None:
            raise ValueError(f"vehicles share one environment: it cannot be changed for {indices} alone")
