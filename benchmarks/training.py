"""Whole trainings, beside stable-baselines3 and from the start of the process."""

from __future__ import annotations

import csv
import importlib
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers import TransformReward
from gymnasium.wrappers.vector import TransformReward as TransformRewards
from stable_baselines3 import TD3
from stable_baselines3.common.noise import NormalActionNoise

from benchmarks.sb3_vec_env import BatchedVecEnv
from benchmarks.timing import Row
from magrl import paper
from magrl.envs.gymnasium import ENV_ID
from magrl.training.run import passes_paper

RECIPES = Path(__file__).parent.parent / "recipes"
sys.path.insert(0, str(RECIPES))
recipe = importlib.import_module("td3_gradient_guided")
CONFIG = recipe.Config().replace(layer_norm=False, wandb_mode="disabled", eval_tasks=10, eval_tasks_small=10)
"""The recipe without layer normalization, which stable-baselines3's networks lack, and with next to no evaluation."""


def sb3(frames: int) -> float:
    """Seconds that stable-baselines3 trains for so many frames: the recipe's networks, batch, updates and vehicles."""
    c = CONFIG
    envs = gymnasium.make_vec(ENV_ID, num_envs=c.num_envs, vectorization_mode="vector_entry_point", seed=0)
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
    began = time.perf_counter()
    model.learn(frames)
    return time.perf_counter() - began


def ours(frames: int) -> float:
    """Seconds that the recipe trains for so many frames."""
    with tempfile.TemporaryDirectory() as folder:
        config = CONFIG.replace(total_frames=frames, eval_every=10**6, out=Path(folder) / "run")
        return recipe.train(config)["training_seconds"]


def whole_training(frames: int = 20_480, repeats: int = 3) -> Row:
    """Return the comparison of whole trainings of equal frames and updates, in pairs."""
    pairs = [(ours(frames), sb3(frames)) for _ in range(repeats)]
    ratios = [theirs / mine for mine, theirs in pairs]
    mine, theirs = (statistics.median(times) * 1000 for times in zip(*pairs, strict=True))
    what = f"training of {frames} frames: stable-baselines3, same networks and updates"
    return Row(what, mine, theirs, statistics.median(ratios), min(ratios), max(ratios), "≥ 1.15")


def seconds_until(passes: Any, seed: int, limit: float = 120.0, *options: str) -> float:
    """Seconds from the start of the process to the first row of curves that passes; NaN where none does in time."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = [sys.executable, str(RECIPES / "td3_gradient_guided.py"), "--seed", str(seed), "--out", str(out)]
        command += ["--wandb-mode", "disabled", "--eval-tasks-small", "1000", "--eval-every", "10", *options]
        began = time.perf_counter()
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            while process.poll() is None and time.perf_counter() - began < limit:
                time.sleep(0.05)
                if any(passes(row) for row in rows_of(out / "train.csv")):
                    seconds = time.perf_counter() - began
                    process.send_signal(signal.SIGKILL)
                    return seconds
            process.kill()
    return float("nan")


def rows_of(path: Path) -> list[dict[str, float]]:
    """The rows that are complete."""
    if not path.exists():
        return []
    with path.open() as file:
        return [
            {key: float(value) for key, value in row.items()}
            for row in csv.DictReader(file)
            if None not in row.values() and "" not in row.values()
        ]


def to_the_papers_figures(seeds: range = range(5)) -> list[float]:
    """Seconds from the start of the process to SR 97 % and SPL 88.4 % on 1000 tasks that training never sees."""
    return [seconds_until(passes_paper, seed) for seed in seeds]


def first_attempt(times: float = 10.0) -> Row:
    """Seconds to SR 90 % of the recipe, and of stable-baselines3's TD3 with its defaults on one vehicle.

    The latter is stopped at ten times the former, whatever it has learned; its time is then a lower bound.
    """
    mine = seconds_until(lambda row: row["eval_success_rate"] >= 90, 0)
    began = time.perf_counter()
    model = TD3("MlpPolicy", TransformReward(gymnasium.make(ENV_ID), float), seed=0, device="cpu")
    rate = 0.0
    while time.perf_counter() - began < times * mine and rate < 90:
        model.learn(500, reset_num_timesteps=False)
        rate = success_rate(model) if model.num_timesteps % 1000 == 0 else rate
    theirs = time.perf_counter() - began
    what = f"to SR 90 %: stable-baselines3's defaults, one vehicle (SR {rate:.0f} % when stopped)"
    return Row(what, 1000 * mine, 1000 * theirs, theirs / mine, theirs / mine, theirs / mine, "≥ 10")


def success_rate(model: TD3, tasks: int = 50) -> float:
    """Share of tasks that a model of stable-baselines3 flies to their destination [%]."""
    envs = gymnasium.make_vec(ENV_ID, num_envs=tasks, vectorization_mode="vector_entry_point")
    seen, _ = envs.reset(seed=paper.VALIDATION_SEED)
    arrived, open_ = np.zeros(tasks, bool), np.ones(tasks, bool)
    while open_.any():
        seen, _, terminated, truncated, info = envs.step(model.predict(seen, deterministic=True)[0])
        ended = (terminated | truncated) & open_
        if ended.any():
            arrived[ended] = info["final_info"]["success"][ended]
        open_ &= ~ended
    return 100 * arrived.mean()


if __name__ == "__main__":
    torch.manual_seed(0)
    print(whole_training())
    print(to_the_papers_figures())
    print(first_attempt())
