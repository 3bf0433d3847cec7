"""Draw the figures of the documentation from flights, and from the results of the tables in tables.toml.

    python recipes/tables/figures.py section-4 noise learning     # from the runs of tables comparison, noise, learning
    python recipes/tables/figures.py conditions globe --out runs  # from new flights; five minutes and one minute

Figures: section-4 (field contours 4-1, trajectories 4-4, convergence 4-5, box plots 4-6), learning (return 4-2, success
rate 4-3, SPL), noise, conditions (the cost of each error alone), globe (a map of the Earth), prices (SPL over
steps, from table prices), paper-run (learning curves of whole trainings).
"""

from __future__ import annotations

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # spinning threads slow each other down; read when torch is imported

import csv
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import tyro
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from tqdm import tqdm

from magrl.envs import PAPER_REGION, Scenario, named_tasks
from magrl.envs.rendering import draw_tracks
from magrl.evaluation import figures as plots
from magrl.evaluation import summarize
from magrl.evaluation.navigators import label
from magrl.evaluation.runs import NO_NOISE
from magrl.field import IGRF
from magrl.field.records import WeatherRecord, weather_record
from magrl.files import check_writable
from magrl.training import UsageError, command, parse
from magrl.transforms import Conditions, VectorErrors

sys.path.insert(0, str(Path(__file__).parent))
from flights import DRIFT_KM, LEVELS, earth_env, flown
from globe import earth_tasks, globe_map, measured
from grid import RESULTS, declared_tables
from trainings import level_name, matching, read_curves

RECIPE = "figures.py"
Figures = Mapping[str, Figure]
"""Figures by file name."""
LEARNING = {
    "fig-4-2-reward": ("return", "return, mean of the last 200 episodes"),
    "fig-4-3-success": ("success_rate", "success rate over the last 200 episodes [%]"),
    "learning-spl": ("eval_spl", "SPL on the validation tasks [%]"),
}
"""Column and label of each figure of learning curves."""
PAPER_RUN = {
    "return": "return, mean of\nthe last 200 episodes",
    "success_rate": "success rate over\nthe last 200 episodes [%]",
    "eval_spl": "SPL on the\nvalidation tasks [%]",
}
SHOWN = ("gg_td3", "td3", "ga", "pso", "afsa", "secant", "parallel")
"""Navigators in the figures of Section 4."""
BOXES = ("heading_mae_deg", "heading_rmse_deg", "smoothness_deg", "navigation_error_km")
STD, SPEED_KM_H = (0.05, 0.05, 5.0), 24.0
"""Noise and speed of the vehicle in figure conditions."""


@dataclass(frozen=True)
class Config:
    """Figures to draw."""

    figures: tyro.conf.Positional[tuple[str, ...]]
    """Names of figures."""
    tasks: int | None = None
    """Number of tasks of the flights; 200 for conditions and 10 000 for globe by default."""
    out: Path = Path("docs/figures")
    """Folder of the figures; files of the same name are replaced."""


# Section 4 of the paper


def columns_by_navigator(path: Path) -> dict[str, dict[str, list[float]]]:
    """Return the columns of a file of recipes/evaluate.py for each navigator of :data:`SHOWN`, without failures."""
    found: dict[str, dict[str, list[float]]] = {}
    with path.open() as file:
        for row in csv.DictReader(file):
            name = row.pop("navigator")
            if name in SHOWN and row.pop("success", "True") == "True":
                for key, value in row.items():
                    found.setdefault(name, {}).setdefault(key, []).append(float(value or "nan"))
    return found


def section_4(_: int | None) -> Figures:
    """Return the field over the region, the example task of each navigator, and box plots."""
    contours = Figure(figsize=(7, 7.4), layout="constrained")
    field, task = Scenario().build_field(), named_tasks("figure-4-1")
    draw_tracks(contours.subplots(), field, PAPER_REGION, [task.start], task.target)
    folder = Path(declared_tables()["comparison"]["folder"])
    paths, episodes = (columns_by_navigator(folder / f"{name}.csv") for name in ("paths", "episodes"))
    tracks = {name: (columns["latitude"], columns["longitude"]) for name, columns in paths.items()}
    boxes = {name: {key: columns[key] for key in BOXES} for name, columns in episodes.items()}
    return {
        "fig-4-1-contours": contours,
        "fig-4-4-trajectories": plots.compared_trajectories(tracks, field, task),
        "fig-4-5-convergence": plots.convergence(paths, field, task),
        "fig-4-6-boxes": plots.box_plots(boxes),
    }


def learning(_: int | None, *, table: str = "learning", shown: Mapping[str, tuple[str, str]] = LEARNING) -> Figures:
    """Return the learning curves of the runs of a table: by figure, the column and label that are ``shown``."""
    runs = declared_tables()[table]["runs"]
    found = {name: [read_curves(run) for run in matching(pattern)] for name, pattern in runs.items()}
    return {
        figure: plots.learning_curves(
            {name: [(list(c["frames"]), list(c[column])) for c in curves] for name, curves in found.items()}, title
        )
        for figure, (column, title) in shown.items()
    }


def noise(_: int | None) -> Figures:
    """Return SR and SPL over the noise, from the evaluations of table noise."""
    levels = declared_tables()["noise"]["levels"]
    found = {level_name(std): Path(f"runs/noise-{std[0]:g}/summary.json").read_text() for std in levels}
    return {"noise": plots.noise_figure({name: json.loads(text) for name, text in found.items()}, "look-ahead")}


def paper_run(_: int | None) -> Figures:
    """Return the curves of the runs of table paper-run, over the moves of the vehicle."""
    figure = Figure(figsize=(8, 8.4), layout="constrained")
    panels = figure.subplots(len(PAPER_RUN), sharex=True)
    runs = {name: read_curves(run) for name, run in declared_tables()["paper-run"]["runs"].items()}
    for axes, (column, title) in zip(panels, PAPER_RUN.items(), strict=True):
        for name, curves in runs.items():
            axes.plot(curves["frames"], curves[column], label=name, lw=1.2)
        axes.set_ylabel(title)
        axes.grid(alpha=0.3)
    panels[0].legend(fontsize=8)
    panels[-1].set_xlabel("moves of the vehicle")
    panels[-1].xaxis.set_major_formatter(EngFormatter(sep=""))
    return {"paper-run": figure}


# The cost of each error


def sensors(**errors: object) -> Conditions:
    """Return conditions with errors of the sensors beside the noise."""
    return Conditions("sensors", sensors={"sensor_std": STD, **errors})


def motion(**errors: float) -> Conditions:
    """Return conditions with errors of motion."""
    return Conditions("motion", SPEED_KM_H, sensors={"sensor_std": STD}, motion=errors)


def weather(factor: float) -> Conditions:
    """Return conditions with a multiple of the weather of a month."""
    month = weather_record("boulder-2016")
    record = WeatherRecord(factor * month.variation, month.first, month.last, f"{factor:g} x {month.name}")
    return Conditions("weather", SPEED_KM_H, sensors={"sensor_std": STD}, weather={"record": record})


def north(size: float) -> Conditions:
    """Return conditions with a constant error of the north reference."""
    return Conditions("north", sensors={"sensor_std": STD}, north={"constant_deg": size, "fixed": True})


PANELS: Mapping[str, tuple[Callable[[float], Conditions], tuple[float, ...]]] = {
    "bias of D [°]": (lambda size: sensors(bias=(size, 0.0, 0.0)), (0.1, 0.3, 1.0, 3.0)),
    "north reference, constant b [°]": (north, (0.1, 0.5, 1.0, 3.0)),
    "bias of I [°]": (lambda size: sensors(bias=(0.0, size, 0.0)), (0.05, 0.1, 0.2, 0.5)),
    "hard iron [nT]": (lambda size: sensors(vector=VectorErrors((size,) * 3)), (10.0, 30.0, 60.0, 100.0)),
    "roll and pitch [°]": (lambda size: sensors(vector=VectorErrors(attitude_deg=(size,) * 2)), (0.02, 0.05, 0.1, 0.2)),
    "drift of $B_H$ over 200 km [nT]": (
        lambda size: sensors(drift=(0.0, 0.0, size), drift_length=200.0),
        (10.0, 30.0, 60.0, 100.0),
    ),
    "weather, 1 = January 2016": (weather, (0.5, 1.0, 2.0, 4.0)),
    "outages [share of readings]": (lambda size: sensors(outage_rate=size), (0.05, 0.1, 0.3, 0.5)),
    "scale of the log [share]": (lambda size: motion(log_scale=size), (0.02, 0.05, 0.1, 0.15)),
    "compass in motion [°]": (lambda size: motion(compass_deg=size), (2.0, 5.0, 10.0, 20.0)),
    "current [share of the speed]": (lambda size: motion(current_km_h=size * SPEED_KM_H), (0.05, 0.1, 0.2, 0.4)),
}
"""Conditions of each error by its size, and sizes; of normal errors the standard deviation."""


def conditions(tasks: int | None) -> Figures:
    """Return a panel for each error, SPL over its size for each navigator of table conditions.

    Everything else is as at the noise alone, which is the first point of each panel.
    """
    base = earth_env(tasks or 200, reach_km=DRIFT_KM, drift_km=DRIFT_KM)
    figure = Figure(figsize=(11, 7.5), layout="constrained")
    panels = list(figure.subplots(3, 4, sharey=True).flat)
    names = [navigator for navigator in declared_tables()["conditions"]["navigators"] if isinstance(navigator, str)]
    for index, navigator in enumerate(tqdm(names, unit="navigator")):
        alone = summarize(flown(navigator, base, sensors()))["spl"]
        look = {"color": plots.NAVIGATOR_COLORS[navigator], "ls": ("-", "--")[index % 2]}
        look["label"] = label(navigator).partition(" (")[0]
        for axes, (make, sizes) in zip(panels, PANELS.values(), strict=False):
            spl = [summarize(flown(navigator, base, make(size)))["spl"] for size in sizes]
            axes.plot([alone, *spl], marker="o", ms=3, lw=1.3, **look)
    for axes, (title, (_, sizes)) in zip(panels, PANELS.items(), strict=False):
        axes.set_xticks(range(len(sizes) + 1), [f"{size:g}" for size in (0.0, *sizes)])
        axes.set_xlabel(title, fontsize=9)
        axes.set_ylim(0, 101)
        axes.grid(alpha=0.3)
    for axes in figure.axes[::4]:
        axes.set_ylabel("SPL [%]")
    figure.axes[-1].axis("off")
    figure.axes[-1].legend(*figure.axes[0].get_legend_handles_labels(), loc="center")
    return {"conditions": figure}


# The map of the Earth


def globe(tasks: int | None) -> Figures:
    """Return the map of the tasks of table globe, with perfect sensors."""
    field, ends = IGRF("2025-01-01"), earth_tasks(tasks or 10_000)
    return {"globe": globe_map(field, ends, measured(declared_tables()["globe"]["navigator"], field, ends, NO_NOISE))}


def prices(_: int | None) -> Figures:
    """Return SPL over the steps from table prices, a panel for each level of noise, a point for each price."""
    lines = (RESULTS / "prices.md").read_text().splitlines()
    head, _, *rows = ([cell.strip() for cell in line.strip("| ").split("|")] for line in lines)
    figure = Figure(figsize=(10, 2.8), layout="constrained")
    for column, axes in enumerate(figure.subplots(1, len(LEVELS)), start=len(head) - len(LEVELS)):
        for name in ("anywhere", "kalman"):
            points = [row[column].split(" / ") for row in rows if row[0].startswith(label(name))]
            steps, spl = zip(*sorted((float(steps), float(spl)) for _, spl, steps in points), strict=True)
            axes.plot(steps, spl, "o-", ms=3, lw=1, label=label(name))
        axes.set(title=head[column], xlabel="steps")
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("SPL [%]")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    return {"prices": figure}


FIGURES: Mapping[str, Callable[[int | None], Figures]] = {
    "section-4": section_4,
    "learning": learning,
    "sequences": partial(learning, table="sequences-learning", shown={"sequences": LEARNING["learning-spl"]}),
    "noise": noise,
    "conditions": conditions,
    "globe": globe,
    "paper-run": paper_run,
    "prices": prices,
}


def draw(config: Config) -> None:
    """Draw figures.

    Raises:
        UsageError: for an unknown figure, or a missing file.
    """
    if unknown := [name for name in config.figures if name not in FIGURES] or not config.figures:
        raise UsageError(f"unknown figure {unknown}: choose from {', '.join(FIGURES)}")
    try:
        for name in config.figures:
            for file, figure in FIGURES[name](config.tasks).items():
                check_writable(config.out / f"{file}.png")
                figure.savefig(config.out / f"{file}.png", dpi=110)
                print(config.out / f"{file}.png")
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from error


if __name__ == "__main__":
    command(RECIPE, lambda: draw(parse(Config, RECIPE, __doc__)))
