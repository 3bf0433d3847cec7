"""stable-baselines3 on the navigation environment: PPO, SAC or TD3, with many vehicles in one batch.

    pip install -c constraints.txt -e '.[recipes,sb3]'
    python docs/examples/sb3.py                       # PPO, 330 000 steps
    python docs/examples/sb3.py --algorithm sac --num-envs 64 --total-timesteps 51200

Prints success rate, SPL (success weighted by path length) and steps on 100 test trips. Takes one to two minutes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from magrl import Scenario
from magrl.envs.gymnasium import ENV_ID
from magrl.envs.sb3 import BatchedVecEnv
from magrl.random_numbers import TEST_SEED

import gymnasium
import numpy as np
import tyro
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecMonitor


@dataclass(frozen=True)
class Config:
    """Settings of a training."""

    algorithm: Literal["ppo", "sac", "td3"] = "ppo"
    """Algorithm of stable-baselines3."""
    num_envs: int = 256
    """Number of vehicles."""
    total_timesteps: int = 327_680
    """Steps of all vehicles together."""
    learning_starts: int = 1_024
    """Steps with random actions before the policy acts, of SAC and TD3."""
    gradient_steps: int = 8
    """Gradient steps after each step of all vehicles, of SAC and TD3."""
    learning_rate: float = 1e-3
    """Learning rate of Adam."""
    eval_trips: int = 100
    """Number of test trips of the final evaluation."""
    seed: int = 0
    """Random seed of weights, exploration and trips."""


def make_model(config: Config) -> BaseAlgorithm:
    """Return an agent, with the networks and discount of the recipes' preset `fast` for SAC and TD3."""
    envs = VecMonitor(BatchedVecEnv(gymnasium.make_vec(ENV_ID, num_envs=config.num_envs, autoreset_mode="SameStep")))
    settings: dict[str, Any] = {"learning_rate": config.learning_rate, "seed": config.seed, "device": "cpu"}
    if config.algorithm == "ppo":
        network = {"net_arch": [64, 64], "log_std_init": -0.5}
        return PPO("MlpPolicy", envs, n_steps=32, batch_size=2048, n_epochs=5, policy_kwargs=network, **settings)
    settings |= {
        "learning_starts": config.learning_starts,
        "train_freq": 1,
        "gradient_steps": config.gradient_steps,
        "batch_size": 256,
        "buffer_size": 200_000,
        "gamma": 0.9,
        "tau": 0.01,
        "policy_kwargs": {"net_arch": [128, 128, 128]},
    }
    if config.algorithm == "td3":
        settings["action_noise"] = NormalActionNoise(np.zeros(2), 0.2 * np.ones(2))
    return {"sac": SAC, "td3": TD3}[config.algorithm]("MlpPolicy", envs, **settings)


def evaluate(model: BaseAlgorithm, num_trips: int) -> dict[str, float]:
    """Evaluate an agent on frozen test trips, all in one batch; return the means of their measures."""
    scenario = Scenario()
    scenario = scenario.with_trips(scenario.random_trips(num_trips, TEST_SEED))
    envs = gymnasium.make_vec(ENV_ID, num_envs=num_trips, scenario=scenario)
    observations, _ = envs.reset(seed=0)
    first = {name: np.full(num_trips, np.nan) for name in ("success", "spl", "steps")}
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
    result = evaluate(model, config.eval_trips)
    print(", ".join(f"{name} {value:.3f}" for name, value in result.items()))
    return result


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
