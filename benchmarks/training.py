"""Whole trainings, beside stable-baselines3 and from the start of the process."""

from __future__ import annotations

import importlib
import statistics
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.timing import Row
from magrl.envs.gymnasium import ENV_ID
from magrl.envs.sb3 import BatchedVecEnv

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers.vector import TransformReward as TransformRewards
from stable_baselines3 import TD3
from stable_baselines3.common.noise import NormalActionNoise

RECIPES = Path(__file__).parent.parent / "recipes"
sys.path.insert(0, str(RECIPES))
recipe = importlib.import_module("td3_gradient_guided")
CONFIG = recipe.Config().replace(layer_norm=False, wandb_mode="disabled", eval_trips=10, eval_trips_small=10)
"""The recipe without layer normalization, which stable-baselines3's networks lack, and with next to no evaluation."""


def sb3(frames: int) -> float:
    """Return the seconds of stable-baselines3 for so many frames, with networks, batch and updates of the recipe."""
    began, c = time.perf_counter(), CONFIG
    envs = gymnasium.make_vec(ENV_ID, num_envs=c.num_envs, autoreset_mode="SameStep", seed=0)
    model = TD3(
        "MlpPolicy",
        BatchedVecEnv(TransformRewards(envs, lambda reward: c.reward_scale * reward)),
        learning_rate=c.learning_rate,
        buffer_size=c.buffer_size,
        learning_starts=c.init_random_frames,
        batch_size=c.batch_size,
        tau=c.tau,
        gamma=c.gamma,
        train_freq=(1, "step"),
        gradient_steps=c.updates_per_batch,
        action_noise=NormalActionNoise(np.zeros(2), c.exploration_noise * np.ones(2)),
        policy_delay=c.policy_delay,
        target_policy_noise=c.policy_noise,
        target_noise_clip=c.noise_clip,
        policy_kwargs={"net_arch": list(c.num_cells)},
        seed=0,
        device="cpu",
    )
    model.learn(frames)
    return time.perf_counter() - began


def ours(frames: int) -> float:
    """Return the seconds that the recipe trains for so many frames."""
    with tempfile.TemporaryDirectory() as folder:
        config = CONFIG.replace(total_frames=frames, eval_every=10**6, out=Path(folder) / "run")
        return recipe.train(config)["training_seconds"]


def rows(frames: int = 20_480, repeats: int = 3) -> list[Row]:
    """Return the comparison of whole trainings of equal frames and updates, in pairs."""
    pairs = [(ours(frames), sb3(frames)) for _ in range(repeats)]
    ratios = [theirs / mine for mine, theirs in pairs]
    mine, theirs = (statistics.median(times) * 1000 for times in zip(*pairs, strict=True))
    what = f"training of {frames} frames: stable-baselines3, same networks and updates"
    return [Row(what, mine, theirs, statistics.median(ratios), min(ratios), max(ratios), "≥ 1.15")]


if __name__ == "__main__":
    torch.manual_seed(0)
    print(*rows())
