"""Fly navigators in random regions all over the Earth, at several levels of sensor noise.

    python recipes/tables/earth_table.py anywhere kalman secant parallel > docs/results/earth.md
    python recipes/tables/earth_table.py anywhere=runs/A anywhere=runs/B --distance-km 700 1000 --max-steps 120
    python recipes/tables/earth_table.py map_matching --map-date 2015-01-01
    python recipes/tables/earth_table.py anywhere --date 1900-01-01 1950-01-01 2000-01-01 > docs/results/epochs.md

The regions are those of `magrl.envs.earth_scenario`: seeded, with latitudes of their middles up to 60 degrees and a
horizontal intensity of at least 8000 nT (IGRF-14). Episodes start at random headings. Navigators without
training are told the noise of the sensors. Prints a Markdown table: success rate (SR) and success weighted by path
length (SPL) in percent, and steps over successes; means over several runs of one name, with the lowest SPL in brackets.
Beyond 500 km, the share of episodes that end within 25 km of the destination [%] comes first: the ellipse of arrival
grows with the distance.
"""

from __future__ import annotations

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # spinning threads slow each other down; read when torch is imported

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

import tyro
from tqdm import tqdm

from magrl import paper
from magrl.envs import GeomagneticNavEnv, Scenario, earth_scenario
from magrl.evaluation import episode_measures, evaluation_rollout, summarize
from magrl.evaluation.navigators import check_distinct, check_map_date, label, make_navigator, needs
from magrl.evaluation.tables import markdown_table
from magrl.training import UsageError, command
from magrl.transforms import with_sensor_noise

RECIPE = "earth_table.py"
Noise = tuple[float, float, float]
Result = tuple[float, ...]  # MEASURES, after NEAR on long ways
MEASURES, NEAR = ("success_rate", "spl", "steps"), "success_rate_within_25km"
LEVELS: tuple[Noise, ...] = (
    (0.0, 0.0, 0.0),
    (0.02, 0.02, 2.0),
    (0.05, 0.05, 5.0),
    (0.1, 0.1, 10.0),
    (0.5, 0.1, 20.0),
)
"""Standard deviations of the noise on D [deg], I [deg], B_H [nT]."""
FAR_KM = 500.0
"""Longest distance of the paper's tasks; beyond, regions are larger and the table begins with kilometers."""


@dataclass
class Config:
    """Navigators and extent of the comparison."""

    navigators: tyro.conf.Positional[tuple[str, ...]]
    """Navigators, as in recipes/evaluate.py."""
    tasks: int = 4000
    """Number of tasks."""
    regions: int = 128
    """Number of regions."""
    distance_km: tuple[float, float] = (300.0, 500.0)
    """Shortest and longest distance of a task [km]."""
    max_steps: int = 50
    """Moves after which an episode ends."""
    zeta: float = 0.01
    """Arrival threshold on the objective (Eq. 2-7)."""
    seed: int = 0
    """Random seed of regions, tasks, start headings and noise; no training uses it."""
    date: tuple[str, ...] = ("2025-01-01",)
    """Dates of the field, 1900 to 2030 (IGRF-14); of several, the first column of the table has the date."""
    crust: bool = False
    """Whether the field is that of WMMHR-2025 (degree 133), with the crust, in place of IGRF; up to 500 km."""
    map_date: str | None = None
    """Date of the map of map_matching, as 2015-01-01; by default its map is the field itself."""


def earth(config: Config, date: str) -> Scenario:
    """Return frozen tasks in random regions of the Earth at a date, large enough for the longest distance."""
    far = config.distance_km[1] > FAR_KM
    size = {"half_size_deg": 20, "degree": 16, "max_latitude": 75} if far else {"half_size_deg": 10, "max_latitude": 70}
    if config.crust and far:
        raise UsageError(f"with the crust, distances reach up to 500 km, got {config.distance_km[1]:g}")
    seed = 3 * paper.FIRST_RESERVED_SEED + config.seed  # beyond those of trainings and of frozen sets
    options = {"distance_range_km": config.distance_km, "crust": config.crust, **size}
    scenario = earth_scenario(config.regions, seed, date, **options)
    return scenario.with_tasks(scenario.random_tasks(config.tasks, seed))


def measure(text: str, base: GeomagneticNavEnv, noise: Noise, map_date: str | None = None) -> Result:
    """Return the measures of a navigator at a level of noise."""
    env = with_sensor_noise(base, noise, base.seed)
    navigator = make_navigator(text, base, sensor_std=noise, map_date=map_date)
    summary = summarize(episode_measures(evaluation_rollout(env, navigator)))
    far = base.scenario.distance_range_km[1] > FAR_KM
    return tuple(summary[name] for name in ([NEAR] * far + [*MEASURES]))


def table(config: Config) -> str:
    """Return the table.

    Raises:
        UsageError: for a navigator or a setting that is wrong.
    """
    if not config.navigators:
        raise UsageError("name at least one navigator, for example: anywhere")
    if not config.date:
        raise UsageError("--date must name at least one date, for example: 2025-01-01")
    try:
        check_distinct(config.navigators)
        check_map_date(config.navigators, config.map_date)
        with tqdm(total=len(config.date) * len(config.navigators), unit="navigator") as bar:
            measured = {date: measure_all(config, date, bar) for date in config.date}
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from error
    several, own_map = len(config.date) > 1, config.map_date
    heads = [", ".join(f"{level:g}" for level in noise) for noise in LEVELS]
    rows = [
        [*[date] * several, row_label(name, own_map), needs(name), len(runs), *map(cell, zip(*runs, strict=True))]
        for date, results in measured.items()
        for name, runs in results.items()
    ]
    return markdown_table([*["date"] * several, "navigator", "needs", "runs", *heads], rows)


def row_label(name: str, map_date: str | None) -> str:
    """Return the label of a navigator, for map matching with the date of an own map."""
    return f"{label(name)}, map of {map_date}" if map_date and name == "map_matching" else label(name)


def measure_all(config: Config, date: str, bar: tqdm) -> dict[str, list[list[Result]]]:
    """Return the results of each navigator at a date: of each of its runs, at each level of noise."""
    base = GeomagneticNavEnv(
        earth(config, date),
        num_envs=config.tasks,
        max_steps=config.max_steps,
        zeta=config.zeta,
        start_heading="random",
        seed=config.seed,
    )
    results: dict[str, list[list[Result]]] = {}
    for text in config.navigators:
        measured = [measure(text, base, noise, config.map_date) for noise in LEVELS]
        results.setdefault(text.partition("=")[0], []).append(measured)
        bar.update()
    return results


def cell(runs: Sequence[Result]) -> str:
    """Return the mean measures of runs, and the lowest SPL of several."""
    *rates, spl, steps = (fmean(values) for values in zip(*runs, strict=True))
    lowest = f" [{min(run[-2] for run in runs):.1f}]" if len(runs) > 1 else ""
    return " / ".join([*(f"{rate:.1f}" for rate in rates), f"{spl:.1f}{lowest}", f"{steps:.1f}"])


if __name__ == "__main__":
    command(RECIPE, lambda: print(table(tyro.cli(Config, prog=RECIPE, description=__doc__))))
