"""Settings of the genetic algorithm, the particle swarm and the fish swarm, compared on 200 tasks.

    python recipes/sweep_metaheuristics.py                    # all three in both modes, about two minutes on two cores
    python recipes/sweep_metaheuristics.py --mode flown       # one mode only

Prints a Markdown table, highest SPL first. SR and SPL are in percent, TNT in moves over successes, and readings are
those of the field where the vehicle was not, for each move. `magrl.metaheuristics.SETTINGS` follows it.
"""

from __future__ import annotations

import os

# A busy neighbour on the machine makes libgomp's spinning threads many times slower; this has to come before torch.
os.environ.setdefault("GOMP_SPINCOUNT", "3000")

from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

import tyro
from tqdm import tqdm

from magrl.env import GeomagneticNavEnv
from magrl.metaheuristics import ALGORITHMS, MODES, build
from magrl.metrics import episode_measures, summarise
from magrl.tasks import task_set
from magrl.td3 import evaluation_rollout

SWEEP_TASKS_SEED = 2_000_000_013
"""Neither trained on, nor those of the final figures."""
SEARCHES = ({"population_size": 8, "generations": 6}, {"population_size": 16, "generations": 10})
"""Look-ahead: a small search for each move and a larger one."""
POPULATIONS = ({"population_size": 2}, {"population_size": 4}, {"population_size": 8})
"""Flown: moves of one generation."""
GRID: dict[str, tuple[dict[str, Any], ...]] = {
    "ga": tuple(
        {"mutation_rate": rate, "mutation_scale": scale} for rate, scale in product((0.3, 1.0), (0.1, 0.2, 0.4))
    ),
    "pso": tuple(
        {"inertia": inertia, "cognitive": pull, "social": pull} for inertia, pull in product((0.4, 0.7), (1, 1.5, 2))
    ),
    "afsa": tuple({"visual": visual, "step": step} for visual, step in product((0.5, 1.0, 2.0), (0.4, 1.0))),
}
SPREADS = (0.2, 1.0)
"""Flown: the radius of the first population, in longest moves: cheap probes, or any move."""


@dataclass
class Config:
    """What is swept."""

    algorithm: Literal["all", "ga", "pso", "afsa"] = "all"
    """One of them, or all."""
    mode: Literal["both", "look-ahead", "flown"] = "both"
    """How candidates are evaluated."""
    tasks: int = 200
    """Number of tasks."""
    zeta: float = 0.01
    """Arrival threshold on the objective (Eq. 2-7)."""
    seed: int = 0
    """Of the random numbers of every algorithm."""


def settings(name: str, mode: str) -> list[dict[str, Any]]:
    """The grid of one algorithm in one mode."""
    if mode == "look-ahead":
        return [search | options for search, options in product(SEARCHES, GRID[name])]
    spreads = ({"spread": spread} for spread in SPREADS)
    return [a | b | c for a, b, c in product(POPULATIONS, spreads, GRID[name])]


def fly(env: GeomagneticNavEnv, name: str, mode: str, seed: int, options: dict[str, Any]) -> tuple[float, ...]:
    """SR [%], SPL [%], TNT and readings per move on the tasks of an environment."""
    navigator = build(name, env, mode, seed, **options)
    env.set_seed(0)  # back to each vehicle's first task
    episodes = episode_measures(evaluation_rollout(env, navigator))
    summary = summarise(episodes)
    readings = navigator.field_readings.sum().item() / episodes["steps"].sum().item()
    return summary["success_rate"], summary["spl"], summary["steps"], readings


def sweep(config: Config) -> str:
    """The table."""
    tasks = task_set(config.tasks, SWEEP_TASKS_SEED)
    env = GeomagneticNavEnv(num_envs=config.tasks, tasks=tasks, zeta=config.zeta, seed=0)
    names = list(ALGORITHMS) if config.algorithm == "all" else [config.algorithm]
    modes = MODES if config.mode == "both" else (config.mode,)
    runs = [(name, mode, options) for name, mode in product(names, modes) for options in settings(name, mode)]
    rows = [(fly(env, *run[:2], config.seed, run[2]), run) for run in tqdm(runs, unit="flight")]
    lines = ["| algorithm | mode | settings | SR % | SPL % | TNT | readings / move |", "|---|---|---|---|---|---|---|"]
    for (rate, spl, steps, readings), (name, mode, options) in sorted(rows, key=lambda row: row[0][1], reverse=True):
        text = ", ".join(f"{key} {value}" for key, value in options.items())
        lines.append(f"| {name} | {mode} | {text} | {rate:.1f} | {spl:.1f} | {steps:.1f} | {readings:.0f} |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(sweep(tyro.cli(Config, description=__doc__)))
