"""Compare lengths of the probing legs of `secant` at four levels of white sensor noise, on 500 tasks.

    python recipes/tables/probe_sweep.py > docs/results/probe_sweep.md      # half a minute on one core

Prints a Markdown table: success rate (SR) and success weighted by path length (SPL) in percent, and moves over
successes (TNT). The last column is the length that `magrl.navigators.secant.probe_length` chooses from the noise.
"""

from __future__ import annotations

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # spinning threads slow each other down; read when torch is imported

from dataclasses import dataclass

import tyro
from torchrl.envs import TransformedEnv
from tqdm import tqdm

from magrl import paper
from magrl.envs import GeomagneticNavEnv, Scenario, task_set
from magrl.envs.measures import check_zeta
from magrl.evaluation import episode_measures, evaluation_rollout, summarize
from magrl.evaluation.tables import markdown_table
from magrl.navigators import Secant
from magrl.training import UsageError, command
from magrl.transforms import SensorNoise

RECIPE = "probe_sweep.py"
NOISE = ((0.0, 0.0, 0.0), (0.02, 0.02, 2.0), (0.05, 0.05, 5.0), (0.1, 0.1, 10.0))
LENGTHS_KM = (0.1, 0.5, 1.0, 3.0, 5.0, 10.0, 15.0, 20.0, 30.0)


@dataclass
class Config:
    """Extent of the sweep."""

    tasks: int = 500
    """Number of tasks, other than those of training and test."""
    zeta: float = 0.01
    """Arrival threshold on the objective (Eq. 2-7)."""
    seed: int = 0
    """Random seed of the noise."""


def measure(scenario: Scenario, navigator: Secant, noise: tuple[float, float, float], config: Config) -> str:
    """Return SR, SPL and TNT of a navigator on the tasks of a scenario."""
    base = GeomagneticNavEnv(scenario, num_envs=config.tasks, zeta=config.zeta, seed=0)
    env = TransformedEnv(base, SensorNoise(noise, seed=config.seed))
    summary = summarize(episode_measures(evaluation_rollout(env, navigator)))
    return " / ".join(format(summary[key], ".1f") for key in ("success_rate", "spl", "steps"))


def sweep(config: Config) -> str:
    """Return the table.

    Raises:
        UsageError: for a setting out of its range.
    """
    try:
        scenario = Scenario(tasks=task_set(config.tasks, paper.SWEEP_SEED))
        check_zeta(config.zeta)
    except ValueError as error:
        raise UsageError(str(error)) from error
    head = ["noise: D °, I °, B_H nT", *(f"{length:g} km" for length in LENGTHS_KM), "chosen: SR / SPL / TNT"]
    rows = []
    for noise in tqdm(NOISE, unit="level"):
        swept = [measure(scenario, Secant(probe_km=length, sensor_std=noise), noise, config) for length in LENGTHS_KM]
        chosen = Secant(sensor_std=noise)
        cell = f"{chosen.probe_km:.1f} km: {measure(scenario, chosen, noise, config)}"
        rows.append([", ".join(format(x, "g") for x in noise), *swept, cell])
    return markdown_table(head, rows)


if __name__ == "__main__":
    command(RECIPE, lambda: print(sweep(tyro.cli(Config, prog=RECIPE, description=__doc__))))
