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

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers.vector import TransformReward as TransformRewards
from stable_baselines3 import TD3
from stable_baselines3.common.noise import NormalActionNoise

from benchmarks.sb3_vec_env import BatchedVecEnv
from benchmarks.timing import Row
from magrl.envs.gymnasium import ENV_ID
from magrl.training.run import passes_paper

RECIPES = Path(__file__).parent.parent / "recipes"
sys.path.insert(0, str(RECIPES))
recipe = importlib.import_module("td3_gradient_guided")
CONFIG = recipe.Config().replace(layer_norm=False, wandb_mode="disabled", eval_tasks=10, eval_tasks_small=10)
"""The recipe without layer normalization, which stable-baselines3's networks lack, and with next to no evaluation."""


def sb3(frames: int) -> float:
    """Return the seconds of stable-baselines3 for so many frames, with networks, batch and updates of the recipe."""
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


def seconds_to_the_paper(seed: int, limit: float = 120.0) -> float:
    """Return the seconds from the start of the process to the results of the paper; NaN where it takes longer."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = [sys.executable, str(RECIPES / "td3_gradient_guided.py"), "--seed", str(seed), "--out", str(out)]
        command += ["--wandb-mode", "disabled", "--eval-tasks-small", "1000", "--eval-every", "10"]
        began = time.perf_counter()
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            while process.poll() is None and time.perf_counter() - began < limit:
                time.sleep(0.05)
                if any(passes_paper(row) for row in rows_of(out / "train.csv")):
                    seconds = time.perf_counter() - began
                    process.send_signal(signal.SIGKILL)
                    return seconds
            process.kill()
    return float("nan")


def rows_of(path: Path) -> list[dict[str, float]]:
    """Return the rows of a file that are complete."""
    if not path.exists():
        return []
    with path.open() as file:
        return [
            {key: float(value) for key, value in row.items()}
            for row in csv.DictReader(file)
            if None not in row.values() and "" not in row.values()
        ]


def to_the_papers_figures(seeds: range = range(5)) -> list[float]:
    """Return the seconds from the start of the process to SR 97 %, SPL 88.4 % on 1000 tasks that no training sees."""
    return [seconds_to_the_paper(seed) for seed in seeds]


if __name__ == "__main__":
    torch.manual_seed(0)
    print(*rows(), to_the_papers_figures(), sep="\n")
