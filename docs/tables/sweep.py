"""Learning curves on the named tasks: algorithms of stable-baselines3, and the recipes of this library.

    pip install -c constraints.txt -e '.[bench]'
    python docs/tables/sweep.py                                     # everything: about six hours on two cores
    python docs/tables/sweep.py --tasks box --algorithms PPO --seeds 0
    python docs/tables/sweep.py --no-train                          # table and figure of the runs that exist

A run that has ended is not repeated, so that the same command resumes a sweep; a folder has one sweep at a time. Scores
are those of :func:`magrl.score`. The settings of an algorithm are the same for all tasks. The agent of the run with the
median SPL is kept in docs/results/agents, for agents.py.
"""

from __future__ import annotations

import csv
import itertools
import math
import os
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from agents import keep_agents, save_agent
from bars import BARS, TASKS, VEHICLES, bar, bars_of
from flights import write_picture
from magrl import score
from magrl.checks import check_choice
from magrl.envs.gymnasium import GeomagneticNavVectorEnv
from magrl.envs.measures import interquartile_mean, stratified_bootstrap
from magrl.envs.sb3 import BatchedVecEnv
from magrl.evaluation.tables import markdown_table
from magrl.files import check_writable, locked, read_text, write_text, write_with
from magrl.jobs import Backend, mapped
from magrl.named_tasks import NAMED_TASKS, task_name
from magrl.training import UsageError, command

import numpy as np
import torch
import tyro
from matplotlib.figure import Figure
from pandas import DataFrame, Series, concat, read_csv
from stable_baselines3 import PPO, SAC, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise

POINTS, FEW = 10, 200
"""Points of a learning curve, and their episodes."""
SCORES = ("SR", "SPL", "return")
"""Columns of scores."""
Row = dict[str, Any]


class Algorithm(NamedTuple):
    """An algorithm: how to make it, vehicles, and its settings."""

    make: Callable[..., Any]
    num_envs: int
    settings: dict[str, Any]


ON_POLICY = {"n_steps": 32, "batch_size": 2048, "n_epochs": 5, "learning_rate": 1e-3}
OFF_POLICY = {"learning_rate": 1e-3, "learning_starts": 1024, "train_freq": 1, "gradient_steps": 8, "batch_size": 256}
OFF_POLICY |= {"gamma": 0.9, "tau": 0.01, "buffer_size": 200_000, "policy_kwargs": {"net_arch": [128, 128, 128]}}
EXPLORED = {"action_noise": NormalActionNoise(np.zeros(2), 0.2 * np.ones(2))}
WIDE = {"policy_kwargs": {"net_arch": [64, 64], "log_std_init": -0.5}}
ALGORITHMS = {
    "PPO": Algorithm(partial(PPO, "MlpPolicy"), 256, ON_POLICY | WIDE),
    "SAC": Algorithm(partial(SAC, "MlpPolicy"), 64, OFF_POLICY),
    "TD3": Algorithm(partial(TD3, "MlpPolicy"), 64, OFF_POLICY | EXPLORED),
}
RECIPES: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("GG-TD3", "TD3-magrl"), ("td3_gradient_guided.py", "--task", "TASK")),
    "ppo_anywhere": ("ppo_anywhere.py", "--preset", "fast"),
    "ppo_memory": ("ppo_memory.py", "--task", "TASK"),
}
"""Recipes: file and options."""
OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
COLORS = dict(zip((*ALGORITHMS, *RECIPES), OKABE_ITO, strict=False))
"""Colors of algorithms."""
STYLES = {"secant": ":", "kalman": "--", "anywhere": "-.", "memory": (0, (1, 4)), "geodesic": "-", "told": (0, (8, 2))}
STYLES |= {"around": (0, (5, 5)), "sighted": (0, (8, 2)), "detour": "-", "parallel": (0, (1, 4))}
STYLES |= {"offset": (0, (5, 5)), "estimated": (0, (8, 2)), "mapped": (0, (3, 1, 1, 1, 1, 1))}
"""Lines of references, each with one style in all panels."""


@dataclass(frozen=True)
class Config:
    """What to train, and where."""

    tasks: tuple[str, ...] = tuple(NAMED_TASKS)
    """Named tasks."""
    algorithms: tuple[str, ...] = (*ALGORITHMS, *RECIPES)
    """Algorithms; each is trained on its own tasks among these."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds of weights, exploration and training tasks."""
    jobs: int = 2
    """Runs at a time, with one thread each."""
    backend: Backend = "loky"
    """Where they run: loky on this machine, ray on a cluster with a common folder."""
    address: str | None = None
    """Cluster of Ray, auto or HOST:PORT; by default one is started on this machine."""
    train: bool = True
    """Whether to train what is missing."""
    out: Path = Path("runs/sweep")
    """Folder of the runs."""
    results: Path = Path("docs/results")
    """Folder of table, data and figure."""


def scores_of(agent: Any, task: str, episodes: int = VEHICLES) -> Row:
    """Return the scores of an agent that a table or a curve shows."""
    scores = score(agent, task, episodes=episodes)
    return {key: scores[key] for key in SCORES}


class Curve(BaseCallback):
    """Score the policy at :data:`POINTS` numbers of steps, off the clock."""

    def __init__(self, task: str, steps: int) -> None:
        super().__init__()
        self.task, self.steps, self.rows, self.began = task, steps, list[Row](), time.process_time()

    def point(self, episodes: int = FEW) -> None:
        """Add a point."""
        paused = time.process_time()
        row = {"steps": self.num_timesteps, "cpu_s": paused - self.began}
        self.rows.append(row | scores_of(self.model, self.task, episodes))
        self.began += time.process_time() - paused

    def _on_step(self) -> bool:
        if self.num_timesteps >= len(self.rows) * self.steps / POINTS:
            self.point()
        return True


def trained(task: str, name: str, seed: int, agent: Path) -> list[Row]:
    """Train an algorithm of another library, and write its agent; return its learning curve."""
    chosen = ALGORITHMS[name]
    envs = GeomagneticNavVectorEnv(chosen.num_envs, task=task, autoreset_mode="SameStep")
    model = chosen.make(BatchedVecEnv(envs), seed=seed, device="cpu", **deepcopy(chosen.settings))
    curve = Curve(task, 1000 * TASKS[task].budget[name])
    model.learn(curve.steps, callback=curve)
    curve.point(VEHICLES)  # after the last update
    save_agent(agent, model.policy, task)
    return curve.rows


def recipe(task: str, name: str, seed: int, folder: Path) -> list[Row]:
    """Train by a recipe; return its learning curve on the validation trips, and its score as the last point.

    Raises:
        UsageError: with the last line that the recipe wrote, where it failed.
    """
    script, *options = (part.replace("TASK", task) for part in RECIPES[name])
    began = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    options += ["--seed", str(seed), "--out", str(folder), "--wandb-mode", "disabled"]
    line = [sys.executable, Path(__file__).parents[2] / "recipes" / script, *options]
    done = subprocess.run(line, capture_output=True, encoding="utf-8", check=False)
    if done.returncode:
        raise UsageError(f"{script} ended with status {done.returncode}: {done.stderr.strip().rpartition(chr(10))[2]}")
    points = [row for row in csv.DictReader(read_text(folder / "train.csv").splitlines()) if row["eval_spl"]]
    names = {"steps": "frames", "SR": "eval_success_rate", "SPL": "eval_spl"}
    rows = [{key: float(point[column]) for key, column in names.items()} for point in points]
    final = scores_of(next(folder.glob("policy.*")), task)
    cpu_s = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - began
    return [*rows, rows[-1] | {"cpu_s": cpu_s} | final]


def run(config: Config, job: tuple[str, str, int]) -> Path:
    """Train one run, unless its file exists; return the file."""
    task, name, seed = job
    path = config.out / f"{task}-{name}-seed{seed}.csv"
    if not path.exists():
        shutil.rmtree(path.with_suffix(""), ignore_errors=True)  # of a recipe that was interrupted
        folder, agent = path.with_suffix(""), path.with_suffix(".onnx")
        rows = recipe(task, name, seed, folder) if name in RECIPES else trained(task, name, seed, agent)
        about = {"task": task, "algorithm": name, "seed": seed}
        write_with(path, DataFrame([about | row for row in rows]).round(2).to_csv, index=False)
    return path


def planned(config: Config) -> Iterator[tuple[str, str, int]]:
    """Yield task, algorithm and seed of all runs, in the order of their seeds."""
    for seed, name in itertools.product(config.seeds, config.algorithms):
        yield from ((task, name, seed) for task in config.tasks if name in TASKS[task].budget)


def ends(curves: DataFrame) -> Iterator[tuple[tuple[str, str], DataFrame]]:
    """Yield task and algorithm, and the last points of their runs."""
    last = curves.groupby(["task", "algorithm", "seed"], sort=False).last().reset_index()
    yield from last.groupby(["task", "algorithm"], sort=False)


def table(curves: DataFrame) -> str:
    """Return the Markdown table of final scores and of the bars: interquartile means, with intervals over seeds."""
    rows = []
    for (task, name), runs in ends(curves):
        low, high = stratified_bootstrap([torch.tensor(runs["SPL"].to_numpy())])
        rate, spl = (interquartile_mean(torch.tensor(runs[key].to_numpy())).item() for key in ("SR", "SPL"))
        about = f"{len(runs)} × {runs['steps'].max() / 1000:.0f} k", f"{runs['cpu_s'].median() / 60:.1f} min"
        earned = f"{runs['return'].median():.1f}".replace("nan", "—")  # old runs have none
        interval = f" ({low:.1f}–{high:.1f})" * (len(runs) > 1)
        rows.append([task, name, *about, earned, f"{rate:.1f}", f"{spl:.1f}{interval}"])
    for task in curves["task"].unique():
        for name in bars_of(task):
            scores = bar(task, name)
            rows.append([task, BARS[name], "—", "—", *(f"{scores[key]:.1f}" for key in ("return", "SR", "SPL"))])
    rows.sort(key=lambda row: list(NAMED_TASKS).index(row[0]))
    return markdown_table(["task", "agent", "seeds × steps", "CPU", "return", "SR %", "SPL %"], rows)


def figure(curves: DataFrame) -> Figure:
    """Return SPL over steps and over CPU time: medians over seeds, bands from the least to the highest, and the bars.

    The last point of a run, which is of the score's episodes and not of the validation trips, is left out for recipes.
    """
    tasks = [task for task in NAMED_TASKS if task in set(curves["task"])]
    drawn = Figure(figsize=(12, 3.6 * math.ceil(len(tasks) / 2)), layout="constrained")
    for part, task in zip(drawn.subfigures(math.ceil(len(tasks) / 2), 2, squeeze=False).flat, tasks, strict=False):
        both = part.subplots(1, 2, sharey=True)
        for name, runs in curves[curves["task"] == task].groupby("algorithm", sort=False):
            points = runs.assign(point=runs.groupby("seed").cumcount(), cpu=cpu_minutes(runs)).groupby("point")
            kept = slice(None, -1 if name in RECIPES else None)
            spl = points["SPL"]
            for axes, along in zip(both, (points["steps"], points["cpu"]), strict=True):
                axes.plot(along.median()[kept], spl.median()[kept], color=COLORS[name], label=name)
                band = along.median()[kept], spl.min()[kept], spl.max()[kept]
                axes.fill_between(*band, color=COLORS[name], alpha=0.2, lw=0)
        for name in bars_of(task)[::-1]:  # oracle first
            look = {"color": "gray", "ls": STYLES[name], "lw": 1, "label": BARS[name].partition(" (")[0]}
            for axes in both:
                axes.axhline(bar(task, name)["SPL"], **look)
        for axes, text in zip(both, ("steps", "CPU time [min]"), strict=True):
            axes.set(xscale="log", xlabel=text, ylim=(0, 102))
        both[0].set_ylabel("SPL [%]")
        part.suptitle(task)
        part.legend(*both[0].get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=3)
    return drawn


def cpu_minutes(runs: DataFrame) -> Series:
    """Return the CPU time of each point [min]; of a recipe, which states the whole, in proportion to its steps."""
    last = runs.groupby("seed")[["steps", "cpu_s"]].transform("last")
    return (runs["cpu_s"].fillna(last["cpu_s"] * runs["steps"] / last["steps"]) / 60).clip(lower=0.01)


def main(args: Sequence[str] | None = None) -> None:
    """Train what is missing, and write table, data and figure."""
    config = tyro.cli(Config, description=__doc__, args=args)
    try:
        config = replace(config, tasks=tuple(map(task_name, config.tasks)))
        for name in config.algorithms:
            check_choice((*ALGORITHMS, *RECIPES), algorithm=name)
    except ValueError as error:
        raise UsageError(str(error)) from error
    config.out.mkdir(parents=True, exist_ok=True)
    check_writable(config.results / "scores.csv")
    jobs = list(planned(config))
    if config.train:
        os.environ["OMP_NUM_THREADS"] = "1"
        with locked(config.out):
            list(mapped(partial(run, config), jobs, config.jobs, config.backend, config.address, "run"))
    paths = [path for job in jobs if (path := config.out / "{}-{}-seed{}.csv".format(*job)).exists()]
    if not paths:
        raise UsageError(f"none of the algorithms {config.algorithms} is trained on {config.tasks}")
    curves = concat([read_csv(path) for path in paths])
    write_with(config.results / "scores.csv", curves.to_csv, index=False)
    write_text(config.results / "scores.md", table(curves))
    keep_agents(ends(curves), config.out, config.results / "agents")
    write_picture(config.results / "scores.png", figure(curves), config.results / "scores.csv", dpi=130)


if __name__ == "__main__":
    command("sweep.py", main)
