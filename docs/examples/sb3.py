"""stable-baselines3 on the navigation environment: SAC or TD3, with many vehicles in one batch.

    pip install -c constraints.txt -e '.[recipes,sb3]'
    python docs/examples/sb3.py --algorithm sac

Prints success rate, SPL (success weighted by path length) and steps on 100 test tasks. Takes one to two minutes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from magrl import Scenario, paper
from magrl.envs.gymnasium import ENV_ID
from magrl.envs.sb3 import BatchedVecEnv

import gymnasium
import numpy as np
import tyro
from gymnasium.wrappers.vector import TransformReward
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecMonitor


@dataclass(frozen=True)
class Config:
    """Settings of a training."""

    algorithm: Literal["sac", "td3"] = "sac"
    """Algorithm of stable-baselines3."""
    num_envs: int = 64
    """Number of vehicles."""
    total_timesteps: int = 51_200
    """Steps of all vehicles together."""
    learning_starts: int = 1_024
    """Steps with random actions before the policy acts."""
    gradient_steps: int = 8
    """Gradient steps after each step of all vehicles."""
    learning_rate: float = 1e-3
    """Learning rate of Adam."""
    eval_tasks: int = 100
    """Number of test tasks of the final evaluation."""
    seed: int = 0
    """Random seed of weights, exploration and tasks."""


def make_model(config: Config) -> OffPolicyAlgorithm:
    """Return an agent with the networks, the discount and the reward scale of the recipes' preset `fast`."""
    envs = gymnasium.make_vec(ENV_ID, num_envs=config.num_envs, autoreset_mode="SameStep")
    envs = TransformReward(envs, lambda reward: 0.05 * reward)
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
    """Evaluate an agent on frozen test tasks, all in one batch; return the means of their measures."""
    scenario = Scenario()
    scenario = scenario.with_tasks(scenario.random_tasks(num_tasks, paper.TEST_SEED))
    envs = gymnasium.make_vec(ENV_ID, num_envs=num_tasks, scenario=scenario)
    observations, _ = envs.reset(seed=0)
    first = {name: np.full(num_tasks, np.nan) for name in ("success", "spl", "steps")}
    while np.isnan(first["success"]).any():
        actions, _ = model.predict(observations, deterministic=True)
        observations, *_, info = envs.step(actions)
        if info:
            new = info["_success"] & np.isnan(first["success"])
            for name, values in first.items():
                values[new] = info[name][new]
    return {name: float(values.mean()) for name, values in first.items()}


def main(config: Config) -> dict[str, float]:
    """Train and evaluate."""
    model = make_model(config)
    model.learn(config.total_timesteps)
    result = evaluate(model, config.eval_tasks)
    print(", ".join(f"{name} {value:.3f}" for name, value in result.items()))
    return result


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
