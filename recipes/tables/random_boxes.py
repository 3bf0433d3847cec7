"""Fly navigators without training in random boxes all over the Earth.

    python recipes/tables/random_boxes.py > docs/results/random_boxes.md      # one minute on one core

The boxes are 10 degrees wide and high, with latitudes up to 60 degrees. Boxes that a scenario refuses (a weak
horizontal field, a declination that jumps) are drawn again. The last row is the box 10S-0,
175E-185E, east of the paper's.
Prints a Markdown table: success rate (SR) and success weighted by path length (SPL) in percent.
"""

from __future__ import annotations

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # spinning threads slow each other down; read when torch is imported

from dataclasses import dataclass

import torch
import tyro
from tqdm import tqdm

from magrl.checks import check_number
from magrl.envs import GeomagneticNavEnv, Region, Scenario
from magrl.evaluation import episode_measures, evaluation_rollout, summarize
from magrl.evaluation.tables import markdown_table
from magrl.navigators import Geodesic, Navigator, ParallelApproach, Secant
from magrl.training import UsageError, command

RECIPE = "random_boxes.py"
SIZE_DEG, HIGHEST_LATITUDE = 10, 60
EAST_OF_THE_PAPER = Region((-10, 0), (175, 185))
NAMES = ("parallel", "secant", "geodesic", "parallel, D and I", "secant, D and I")


@dataclass
class Config:
    """Extent of the comparison."""

    boxes: int = 24
    """Number of random boxes."""
    tasks: int = 500
    """Number of tasks in each box."""
    zeta: float = 0.01
    """Arrival threshold on the objective (Eq. 2-7)."""
    seed: int = 1
    """Random seed of boxes and tasks."""


def random_boxes(count: int, seed: int) -> list[Scenario]:
    """Return scenarios in random boxes, uniform over the sphere and rounded to a degree, that a vehicle can use.

    Raises:
        ValueError: for a count below 1, or a seed that is not a whole number from 0 on.
    """
    check_number(1, whole=True, count=count)
    check_number(0, whole=True, seed=seed)
    draw = torch.Generator().manual_seed(seed)
    highest = torch.sin(torch.deg2rad(torch.tensor(HIGHEST_LATITUDE - SIZE_DEG / 2, dtype=torch.float64)))
    found: list[Scenario] = []
    while len(found) < count:
        height, turn = torch.rand(2, generator=draw, dtype=torch.float64).tolist()
        middle = torch.rad2deg(torch.asin((2 * height - 1) * highest)).item()
        south, west = round(middle - SIZE_DEG / 2), round(360 * turn) - 180
        scenario = Scenario(region=Region((south, south + SIZE_DEG), (west, west + SIZE_DEG)), objective_floors=None)
        try:
            scenario.build_field()
        except ValueError:  # a weak horizontal field, or a declination that jumps: draw again
            continue
        found.append(scenario)
    return found


def place(scenario: Scenario) -> str:
    """Return a box as text, such as ``10°S to 0°, 175°E to 185°E``."""
    (south, north), (west, _) = scenario.region[0].latitude, scenario.region[0].longitude
    west = (west + 180) % 360 - 180
    edges = [f"{abs(x):g}°" + ("S" if x < 0 else "N" if x > 0 else "") for x in (south, north)]
    edges += [f"{abs(x):g}°" + ("W" if x < 0 else "E" if x > 0 else "") for x in (west, west + SIZE_DEG)]
    return "{} to {}, {} to {}".format(*edges)


def navigators(env: GeomagneticNavEnv) -> tuple[Navigator, ...]:
    """Return the navigators of :data:`NAMES` for an environment."""
    pair = ("D", "I")
    return (
        ParallelApproach(env.field),
        Secant(),
        Geodesic(),
        ParallelApproach(env.field, pair=pair),
        Secant(elements=pair),
    )


def measure(scenario: Scenario, config: Config) -> list[tuple[float, float]]:
    """Return SR and SPL [%] of each navigator on random tasks of a scenario."""
    scenario = scenario.with_tasks(scenario.random_tasks(config.tasks, config.seed))
    env = GeomagneticNavEnv(scenario, num_envs=config.tasks, zeta=config.zeta, seed=0)
    results = []
    for navigator in navigators(env):
        env.set_seed(0)  # back to each vehicle's first task
        summary = summarize(episode_measures(evaluation_rollout(env, navigator)))
        results.append((summary["success_rate"], summary["spl"]))
    return results


def table(config: Config) -> str:
    """Return the table: a row for each box, their mean, the lowest values, and the box east of the paper's.

    Raises:
        UsageError: for a setting out of its range.
    """
    try:
        scenarios = random_boxes(config.boxes, config.seed)
        east = Scenario(region=EAST_OF_THE_PAPER, objective_floors=None)
        measured = [measure(scenario, config) for scenario in tqdm([*scenarios, east], unit="box")]
    except ValueError as error:
        raise UsageError(str(error)) from error
    rates, spls = torch.tensor(measured[:-1], dtype=torch.float64).unbind(-1)  # (boxes, navigators)
    means = list(zip(rates.mean(0).tolist(), spls.mean(0).tolist(), strict=True))
    worst = list(zip(rates.amin(0).tolist(), spls.amin(0).tolist(), strict=True))
    names = [*(place(scenario) for scenario in scenarios), "**mean**", "**lowest**", place(east)]
    values = [*measured[:-1], means, worst, measured[-1]]
    rows = [[name, *(f"{rate:.1f} / {spl:.1f}" for rate, spl in row)] for name, row in zip(names, values, strict=True)]
    return markdown_table(["box", *(f"{name}, SR / SPL" for name in NAMES)], rows)


if __name__ == "__main__":
    command(RECIPE, lambda: print(table(tyro.cli(Config, prog=RECIPE, description=__doc__))))
