"""Compare settings of the genetic algorithm, the particle swarm and the fish swarm on 200 tasks.

    python recipes/tables/sweep_metaheuristics.py                 # all three in both modes, two minutes on two cores
    python recipes/tables/sweep_metaheuristics.py --mode flown    # one mode only

Prints a Markdown table, highest SPL first: success rate (SR) and SPL in percent, moves over successes (TNT), and
readings of the field away from the vehicle per move. `magrl.navigators.metaheuristics.SETTINGS` is chosen from it.
"""

from __future__ import annotations

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # spinning threads slow each other down; read when torch is imported

from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

import tyro
from tqdm import tqdm

from magrl import paper
from magrl.envs import GeomagneticNavEnv, Scenario, task_set
from magrl.evaluation import episode_measures, evaluation_rollout, summarize
from magrl.evaluation.tables import markdown_table
from magrl.navigators import NAVIGATORS
from magrl.navigators.metaheuristics import MODES
from magrl.training import UsageError, command

RECIPE = "sweep_metaheuristics.py"
FORMS = (".1f", ".1f", ".1f", ".0f")
SEARCHES = ({"population_size": 8, "generations": 6}, {"population_size": 16, "generations": 10})
"""Look-ahead: a small and a larger search for each move."""
POPULATIONS = ({"population_size": 2}, {"population_size": 4}, {"population_size": 8})
"""Flown: number of moves in a generation."""
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
"""Flown: radius of the first population, in longest moves."""


@dataclass
class Config:
    """Extent of the sweep."""

    algorithm: Literal["all", "ga", "pso", "afsa"] = "all"
    """Algorithm to sweep, or all."""
    mode: Literal["both", "look-ahead", "flown"] = "both"
    """How candidate moves are evaluated, or both."""
    tasks: int = 200
    """Number of tasks, other than those of training and test."""
    zeta: float = 0.01
    """Arrival threshold on the objective (Eq. 2-7)."""
    seed: int = 0
    """Random seed of every algorithm."""


def settings(name: str, mode: str) -> list[dict[str, Any]]:
    """Return the grid of one algorithm in one mode."""
    if mode == "look-ahead":
        return [search | options for search, options in product(SEARCHES, GRID[name])]
    spreads = ({"spread": spread} for spread in SPREADS)
    return [a | b | c for a, b, c in product(POPULATIONS, spreads, GRID[name])]


def measure(env: GeomagneticNavEnv, name: str, mode: str, seed: int, options: dict[str, Any]) -> tuple[float, ...]:
    """Return SR [%], SPL [%], TNT and readings per move on the tasks of an environment."""
    navigator = NAVIGATORS[name].for_env(env, mode=mode, seed=seed, **options)
    env.set_seed(0)  # back to each vehicle's first task
    episodes = episode_measures(evaluation_rollout(env, navigator))
    summary = summarize(episodes)
    readings = navigator.field_readings.sum().item() / episodes["steps"].sum().item()
    return summary["success_rate"], summary["spl"], summary["steps"], readings


def sweep(config: Config) -> str:
    """Return the table.

    Raises:
        UsageError: for a setting out of its range.
    """
    try:
        tasks = task_set(config.tasks, paper.SWEEP_SEED)
        env = GeomagneticNavEnv(Scenario(tasks=tasks), num_envs=config.tasks, zeta=config.zeta, seed=0)
    except ValueError as error:
        raise UsageError(str(error)) from error
    names = ["ga", "pso", "afsa"] if config.algorithm == "all" else [config.algorithm]
    modes = MODES if config.mode == "both" else (config.mode,)
    runs = [(name, mode, options) for name, mode in product(names, modes) for options in settings(name, mode)]
    rows = [(measure(env, *run[:2], config.seed, run[2]), run) for run in tqdm(runs, unit="setting")]
    head = ("algorithm", "mode", "settings", "SR %", "SPL %", "TNT", "readings / move")
    cells = [
        [*run[:2], ", ".join(f"{key} {value}" for key, value in run[2].items()), *map(format, measured, FORMS)]
        for measured, run in sorted(rows, key=lambda row: row[0][1], reverse=True)
    ]
    return markdown_table(head, cells)


if __name__ == "__main__":
    command(RECIPE, lambda: print(sweep(tyro.cli(Config, prog=RECIPE, description=__doc__))))
