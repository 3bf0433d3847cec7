"""Fly navigators under the conditions of real vehicles, in random regions all over the Earth.

    python recipes/tables/conditions_table.py > docs/results/conditions.md
    python recipes/tables/conditions_table.py anywhere=runs/A kalman --conditions ship low-cost --tasks 300
    python recipes/tables/conditions_table.py --tasks 200 --figure docs/figures/conditions.png

Regions and tasks are the same under all conditions: those of `magrl.envs.earth_scenario`, with starts at random
headings. Navigators are told the data sheets of the conditions (`Conditions.sensor_std`, `Conditions.bias_std`). Prints
a Markdown table: success rate (SR) and success weighted by path length (SPL) in percent, and steps over successes.

With `--figure`, draws in its place what each error costs: a panel for each error, SPL over its size for each navigator.
Everything else is then as at the level of noise 0.05°, 0.05°, 5 nT, which alone is the first point of each panel.
"""

from __future__ import annotations

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # spinning threads slow each other down; read when torch is imported

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro
from matplotlib.figure import Figure
from tqdm import tqdm

from magrl import paper
from magrl.envs import GeomagneticNavEnv, earth_scenario
from magrl.evaluation import episode_measures, evaluation_rollout, summarize
from magrl.evaluation.navigators import NAVIGATOR_COLORS, check_distinct, label, make_navigator, needs
from magrl.evaluation.tables import markdown_table
from magrl.field.records import WeatherRecord, weather_record
from magrl.files import check_writable
from magrl.training import UsageError, command
from magrl.transforms import CONDITIONS, Conditions, VectorErrors, conditions_named, with_conditions

RECIPE = "conditions_table.py"
NAVIGATORS = ("anywhere", "kalman", "secant", "map_matching", "parallel")
DRIFT_KM = 40.0
"""How much farther than the longest move errors may carry a vehicle [km], for one environment under all conditions."""


NOISE = (0.05, 0.05, 5.0)
SPEED_KM_H = 24.0
Curves = Mapping[str, Mapping[str, Sequence[float]]]


def readings(**errors: object) -> Conditions:
    """Return conditions with errors of the sensors beside the noise."""
    return Conditions("sensors", sensors={"std": NOISE, **errors})


def moves(**errors: float) -> Conditions:
    """Return conditions with errors of motion."""
    return Conditions("motion", SPEED_KM_H, sensors={"std": NOISE}, motion=errors)


def weather(factor: float) -> Conditions:
    """Return conditions with a multiple of the weather of a month."""
    month = weather_record("boulder-2016")
    record = WeatherRecord(factor * month.variation, month.first, month.last, f"{factor:g} x {month.name}")
    return Conditions("weather", SPEED_KM_H, sensors={"std": NOISE}, weather={"record": record})


def north(size: float) -> Conditions:
    """Return conditions with a constant error of the north reference."""
    return Conditions("north", sensors={"std": NOISE}, north={"constant_deg": size, "fixed": True})


PANELS: Mapping[str, tuple[Callable[[float], Conditions], tuple[float, ...]]] = {
    "bias of D [°]": (lambda size: readings(bias=(size, 0.0, 0.0)), (0.1, 0.3, 1.0, 3.0)),
    "north reference, constant b [°]": (north, (0.1, 0.5, 1.0, 3.0)),
    "bias of I [°]": (lambda size: readings(bias=(0.0, size, 0.0)), (0.05, 0.1, 0.2, 0.5)),
    "hard iron [nT]": (lambda size: readings(vector=VectorErrors((size,) * 3)), (10.0, 30.0, 60.0, 100.0)),
    "roll and pitch [°]": (
        lambda size: readings(vector=VectorErrors(attitude_deg=(size,) * 2)),
        (0.02, 0.05, 0.1, 0.2),
    ),
    "drift of $B_H$ over 200 km [nT]": (
        lambda size: readings(drift=(0.0, 0.0, size), drift_length=200.0),
        (10.0, 30.0, 60.0, 100.0),
    ),
    "weather, 1 = January 2016": (weather, (0.5, 1.0, 2.0, 4.0)),
    "outages [share of readings]": (lambda size: readings(outage_rate=size), (0.05, 0.1, 0.3, 0.5)),
    "scale of the log [share]": (lambda size: moves(log_scale=size), (0.02, 0.05, 0.1, 0.15)),
    "compass in motion [°]": (lambda size: moves(compass_deg=size), (2.0, 5.0, 10.0, 20.0)),
    "current [share of the speed]": (lambda size: moves(current_km_h=size * SPEED_KM_H), (0.05, 0.1, 0.2, 0.4)),
}
"""Conditions of each error by its size, and sizes; of normal errors the standard deviation."""


@dataclass
class Config:
    """Navigators and extent of the comparison."""

    navigators: tyro.conf.Positional[tuple[str, ...]] = NAVIGATORS
    """Navigators, as in recipes/evaluate.py."""
    conditions: tuple[str, ...] = tuple(CONDITIONS)
    """Presets."""
    tasks: int = 1000
    """Number of tasks."""
    regions: int = 128
    """Number of regions."""
    seed: int = 0
    """Random seed of regions, tasks, start headings and errors; no training uses it."""
    figure: Path | None = None
    """File of the figure of all errors, which is drawn in place of the table."""


def make_env(tasks: int, regions: int, seed: int) -> GeomagneticNavEnv:
    """Return an environment with one vehicle for each of some tasks of 300 to 500 km all over the Earth."""
    first = 3 * paper.FIRST_RESERVED_SEED + seed  # beyond those of trainings and of frozen sets
    scenario = earth_scenario(regions, first, "2025-01-01", max_latitude=70, max_move_km=50.0 + DRIFT_KM)
    scenario = scenario.with_tasks(scenario.random_tasks(tasks, first))
    return GeomagneticNavEnv(scenario, num_envs=tasks, start_heading="random", drift_km=DRIFT_KM, seed=seed)


def measure(text: str, base: GeomagneticNavEnv, conditions: Conditions) -> dict[str, float]:
    """Return the summary of a navigator under conditions."""
    env = with_conditions(base, conditions, base.seed)
    navigator = make_navigator(text, base, sensor_std=conditions.sensor_std, bias_std=conditions.bias_std)
    return summarize(episode_measures(evaluation_rollout(env, navigator)))


def table(config: Config) -> str:
    """Return the table.

    Raises:
        UsageError: for a navigator or conditions that are wrong.
    """
    try:
        check_distinct(config.navigators)
        presets = [conditions_named(name) for name in config.conditions]
        rows = [[label(text.partition("=")[0]), needs(text.partition("=")[0])] for text in config.navigators]
        base = make_env(config.tasks, config.regions, config.seed)
        with tqdm(total=len(presets) * len(rows), unit="rollout") as bar:
            for preset in presets:
                for row, text in zip(rows, config.navigators, strict=True):
                    row.append(cell(measure(text, base, preset)))
                    bar.update()
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from error
    return markdown_table(["navigator", "needs", *config.conditions], rows)


def cell(summary: dict[str, float]) -> str:
    """Return SR, SPL and steps as text."""
    return "{success_rate:.1f} / {spl:.1f} / {steps:.1f}".format(**summary)


def curves_of(config: Config) -> Curves:
    """Return the SPL of each navigator in each panel, at size 0 first.

    Raises:
        ValueError: for two navigators of one name.
    """
    names = [text.partition("=")[0] for text in config.navigators]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise ValueError(f"{twice} is given twice: a figure has one line for a name; name a run, as policy:LABEL=RUN")
    base = make_env(config.tasks, config.regions, config.seed)
    count = 1 + sum(len(sizes) for _, sizes in PANELS.values())
    curves: dict[str, dict[str, list[float]]] = {panel: {} for panel in PANELS}
    with tqdm(total=count * len(config.navigators), unit="rollout") as bar:
        for name, text in zip(names, config.navigators, strict=True):

            def spl(conditions: Conditions, text: str = text) -> float:
                bar.update()
                return measure(text, base, conditions)["spl"]

            first = spl(readings())
            for panel, (conditions, sizes) in PANELS.items():
                curves[panel][name] = [first, *(spl(conditions(size)) for size in sizes)]
    return curves


def conditions_figure(curves: Curves) -> Figure:
    """Return the figure."""
    figure = Figure(figsize=(11, 7.5), layout="constrained")
    panels = figure.subplots(3, 4, sharey=True).flat
    for axes, (panel, lines) in zip(panels, curves.items(), strict=False):
        for name, values in lines.items():
            color = NAVIGATOR_COLORS[name.partition(":")[0]]
            axes.plot(values, marker="o", ms=3, lw=1.3, color=color, label=label(name).partition(" (")[0])
        axes.set_xticks(range(len(PANELS[panel][1]) + 1), [f"{size:g}" for size in (0.0, *PANELS[panel][1])])
        axes.set_xlabel(panel, fontsize=9)
        axes.set_ylim(0, 101)
        axes.grid(alpha=0.3)
    for axes in figure.axes[::4]:
        axes.set_ylabel("SPL [%]")
    figure.axes[-1].axis("off")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.axes[-1].legend(handles, labels, loc="center")
    return figure


def make(config: Config) -> str:
    """Return the table, or draw the figure and return its numbers as text.

    Raises:
        UsageError: for a navigator or conditions that are wrong, or a file that cannot be written.
    """
    if config.figure is None:
        return table(config)
    try:
        check_distinct(config.navigators)
        check_writable(config.figure)
        curves = curves_of(config)
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from error
    conditions_figure(curves).savefig(config.figure, dpi=100)
    rows = [[panel, name, *values] for panel, lines in curves.items() for name, values in lines.items()]
    return "\n".join(" ".join(f"{x:.1f}" if isinstance(x, float) else x for x in row) for row in rows)


if __name__ == "__main__":
    command(RECIPE, lambda: print(make(tyro.cli(Config, prog=RECIPE, description=__doc__))))
