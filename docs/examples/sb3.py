"""stable-baselines3 on the navigation environment: SAC or TD3, many vehicles in one batch.

    pip install -c constraints.txt ".[bench]"
    python docs/examples/sb3.py --algorithm sac

Prints the success rate and SPL on 100 tasks that the agent never saw, after a minute or two.
"""

from __future__ import annotations

import os

# A busy neighbour on the machine makes libgomp's spinning threads many times slower; this has to come before torch.
os.environ.setdefault("GOMP_SPINCOUNT", "3000")

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
import tyro
from gymnasium.wrappers.vector import TransformReward
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecMonitor

from magrl.gymnasium_env import ENV_ID
from magrl.tasks import TEST_SEED, task_set

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
from sb3_vec_env import BatchedVecEnv


@dataclass(frozen=True)
class Config:
    """Settings of a training."""

    algorithm: Literal["sac", "td3"] = "sac"
    """Which of stable-baselines3's algorithms."""
    num_envs: int = 64
    """Vehicles that fly at the same time."""
    total_timesteps: int = 51_200
    """Moves of all vehicles to train for."""
    learning_starts: int = 1_024
    """Moves made at random first."""
    gradient_steps: int = 8
    """Updates after each step of all vehicles."""
    learning_rate: float = 1e-3
    """Of all networks."""
    eval_tasks: int = 100
    """Tasks of the final evaluation, which no training meets."""
    seed: int = 0
    """Of networks, exploration and tasks."""


def make_model(config: Config) -> OffPolicyAlgorithm:
    """An agent with the networks, the discount and the scale of rewards of the preset `fast` of the recipes."""
    envs = TransformReward(gymnasium.make_vec(ENV_ID, num_envs=config.num_envs), lambda reward: 0.05 * reward)
    settings: dict[str, Any] = {
        "learning_starts": config.learning_starts,
        "learning_rate": config.learning_rate,
        "train_freq": 1,
        "gradient_steps": config.gradient_steps,
        "batch_size": 256,
        "buffer_size": 200_000,
        "gamma": 0.9,
        "tau": 0.01,
        "policy_kwargs": {"net_arch": [128, 128, 128]},
        "seed": config.seed,
        "device": "cpu",
    }
    if config.algorithm == "td3":
        settings["action_noise"] = NormalActionNoise(np.zeros(2), 0.2 * np.ones(2))
    algorithm = {"sac": SAC, "td3": TD3}[config.algorithm]
    return algorithm("MlpPolicy", VecMonitor(BatchedVecEnv(envs)), **settings)


def evaluate(model: OffPolicyAlgorithm, num_tasks: int) -> dict[str, float]:
    """Flies each of a frozen set of tasks once, all in one batch: the means of their measures."""
    envs = gymnasium.make_vec(ENV_ID, num_envs=num_tasks, tasks=task_set(num_tasks, TEST_SEED))
    observations, _ = envs.reset(seed=0)
    first = {name: np.full(num_tasks, np.nan) for name in ("success", "spl", "steps")}
    while np.isnan(first["success"]).any():
        actions, _ = model.predict(observations, deterministic=True)
        observations, *_, info = envs.step(actions)
        if info:
            new = info["_final_info"] & np.isnan(first["success"])
            for name, values in first.items():
                values[new] = info["final_info"][name][new]
    return {name: float(values.mean()) for name, values in first.items()}


def main(config: Config) -> dict[str, float]:
    """Trains and evaluates."""
    model = make_model(config)
    model.learn(config.total_timesteps)
    result = evaluate(model, config.eval_tasks)
    print(", ".join(f"{name} {value:.3f}" for name, value in result.items()))
    return result


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
