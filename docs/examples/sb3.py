"""stable-baselines3 on the named tasks: PPO, SAC or TD3, with many vehicles in one batch.

    pip install -c constraints.txt -e '.[recipes,onnx,sb3]'
    python docs/examples/sb3.py                       # PPO on Box, 330 000 steps: one to two minutes
    python docs/examples/sb3.py --algorithm sac --task eddies --num-envs 64 --total-timesteps 50000
    python recipes/sweep.py --command PPO='python docs/examples/sb3.py' -- --task box    # five seeds

Prints the score (magrl.score) of the best policy by the score on other episodes, and writes it, policy.onnx, and its
learning curve, train.csv.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from magrl import score
from magrl.envs.gymnasium import GeomagneticNavVectorEnv
from magrl.envs.sb3 import BatchedVecEnv
from magrl.evaluation.scores import SEED
from magrl.navigators.networks import Geometry
from magrl.training.curves import BestPolicy
from magrl.transforms.views import ObservationView

import numpy as np
import torch
import tyro
from pandas import DataFrame
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

POINTS, VALIDATION_SEED = 20, SEED + 1
"""Points of the learning curve, and seed of its episodes, by which the policy is selected."""


@dataclass(frozen=True)
class Config:
    """Settings of a training."""

    algorithm: Literal["ppo", "sac", "td3"] = "ppo"
    """Algorithm of stable-baselines3."""
    task: str = "box"
    """Named task (docs/tasks.md)."""
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
    gamma: float = 0.97
    """Discount."""
    width: int = 128
    """Width of hidden layers: two of PPO, three of SAC and TD3."""
    batch_size: int = 256
    """Transitions per gradient step, of SAC and TD3."""
    geometry: bool = True
    """Whether the fixed layer of the recipes' networks, if any (magrl.navigators.networks.Geometry), is the first."""
    episodes: int = 200
    """Episodes of each score."""
    seed: int = 0
    """Random seed of weights, exploration and trips."""
    out: Path = Path("runs/sb3")
    """Folder of agent and learning curve."""


class Features(BaseFeaturesExtractor):
    """Observations behind the fixed layer of the recipes' networks."""

    def __init__(self, space: Any, view: ObservationView) -> None:
        super().__init__(space, Geometry(view)(torch.zeros(view.size)).shape[-1])
        self.geometry = Geometry(view)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the observation with its features."""
        return self.geometry(observation)


def make_model(config: Config) -> BaseAlgorithm:
    """Return an agent."""
    vehicles = GeomagneticNavVectorEnv(config.num_envs, task=config.task, autoreset_mode="SameStep")
    envs, first = BatchedVecEnv(vehicles), dict[str, Any]()
    view = getattr(vehicles.torchrl_env, "view", None)
    if config.geometry and view is not None and view.geometry is not None:
        first["features_extractor_class"] = Features
        first["features_extractor_kwargs"] = {"view": view}
    settings: dict[str, Any] = {name: getattr(config, name) for name in ("learning_rate", "gamma", "seed")}
    settings["device"] = "cpu"
    if config.algorithm == "ppo":
        network = {"net_arch": 2 * [config.width], "log_std_init": -0.5, **first}
        return PPO("MlpPolicy", envs, n_steps=32, batch_size=2048, n_epochs=5, policy_kwargs=network, **settings)
    settings |= {
        "learning_starts": config.learning_starts,
        "train_freq": 1,
        "gradient_steps": config.gradient_steps,
        "batch_size": config.batch_size,
        "buffer_size": 200_000,
        "tau": 0.01,
        "policy_kwargs": {"net_arch": 3 * [config.width], **first},
    }
    if config.algorithm == "td3":
        settings["action_noise"] = NormalActionNoise(np.zeros(2), 0.2 * np.ones(2))
    return {"sac": SAC, "td3": TD3}[config.algorithm]("MlpPolicy", envs, **settings)


class Curve(BaseCallback):
    """Score the agent at :data:`POINTS` numbers of steps, write the curve, and keep the best policy."""

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.config, self.rows, self.best = config, list[dict[str, float]](), BestPolicy()

    def point(self) -> None:
        """Add a point."""
        scores = score(self.model, self.config.task, episodes=self.config.episodes, seed=VALIDATION_SEED)
        self.best.offer(scores["score"], self.model.policy)
        names = {"score": "eval_score", "SR": "eval_success_rate", "SPL": "eval_spl"}
        self.rows.append({"frames": self.num_timesteps, **{name: scores[key] for key, name in names.items()}})
        DataFrame(self.rows).to_csv(self.config.out / "train.csv", index=False)

    def _on_step(self) -> bool:
        if self.num_timesteps >= len(self.rows) * self.config.total_timesteps / POINTS:
            self.point()
        return True


class Acting(nn.Module):
    """What a policy of stable-baselines3 does without exploration."""

    def __init__(self, policy: Any) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, observation: Tensor) -> Tensor:
        """Return the action."""
        return self.policy._predict(observation, deterministic=True)


def save_agent(path: Path, policy: Any) -> None:
    """Write a policy of stable-baselines3 with vectors as observations as ONNX, for :func:`magrl.score`."""
    names = {"input_names": ["observation"], "output_names": ["action"]}
    observations, size = torch.zeros(2, *policy.observation_space.shape), {0: torch.export.Dim("N")}
    shapes = {"dynamic_shapes": {"observation": size}, "external_data": False}
    torch.onnx.export(Acting(policy).eval(), (observations,), path, dynamo=True, verbose=False, **names, **shapes)


def main(config: Config) -> dict[str, float]:
    """Train, score and save."""
    config.out.mkdir(parents=True, exist_ok=True)
    model, curve = make_model(config), Curve(config)
    model.learn(config.total_timesteps, callback=curve)
    curve.point()  # after the last update
    model.policy.load_state_dict(curve.best.weights)
    scores = score(model, config.task, episodes=config.episodes)
    save_agent(config.out / "policy.onnx", model.policy)
    print(", ".join(f"{name} {value:.2f}" for name, value in scores.items()))
    return scores


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
