"""Draw the figures of the paper's Section 4 from the files of recipes/evaluate.py and of trainings.

    python recipes/tables/figures.py --results runs/comparison --gg-td3 runs/A runs/B --td3 runs/C --out docs/figures

Field contours (4-1), return (4-2), success rate (4-3), trajectories (4-4), convergence (4-5), box plots (4-6).
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro
from matplotlib.figure import Figure

from magrl.envs import PAPER_REGION, Scenario, named_tasks
from magrl.envs.rendering import draw_tracks
from magrl.evaluation import figures as plots
from magrl.training import UsageError, command

RECIPE = "figures.py"
CURVES = {
    "fig-4-2-reward": ("return", "return, mean of the last 200 episodes"),
    "fig-4-3-success": ("success_rate", "success rate over the last 200 episodes [%]"),
    "learning-spl": ("eval_spl", "SPL on the validation tasks [%]"),
}
"""Column and label of each figure of learning curves."""
SHOWN = ("gg_td3", "td3", "recurrent", "ga", "pso", "afsa", "secant", "parallel")
"""Navigators in the figures of evaluations."""
BOXES = ("heading_mae_deg", "heading_rmse_deg", "smoothness_deg", "navigation_error_km")

Row = Mapping[str, str]


@dataclass(frozen=True)
class Config:
    """Sources and destination of the figures."""

    results: Path
    """Folder that recipes/evaluate.py wrote."""
    gg_td3: tuple[Path, ...] = ()
    """Run folders of Gradient-Guided TD3, for the learning curves."""
    td3: tuple[Path, ...] = ()
    """Run folders of TD3, for the learning curves."""
    out: Path = Path("docs/figures")
    """Folder of the figures; files of the same name are replaced."""


def read_csv(path: Path) -> list[Row]:
    """Return the rows of a file.

    Raises:
        UsageError: for a missing file.
    """
    if not path.is_file():
        raise UsageError(f"there is no {path}: is the evaluation or the training complete?")
    with path.open() as file:
        return list(csv.DictReader(file))


def grouped(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Return rows by navigator, in order of appearance, without navigators that figures do not show."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row["navigator"], []).append(row)
    return {name: rows for name, rows in groups.items() if name in SHOWN}


def column(rows: Sequence[Row], name: str) -> list[float]:
    """Return a column as numbers; empty cells become NaN.

    Raises:
        UsageError: for a missing column.
    """
    if rows and name not in rows[0]:
        raise UsageError(f"there is no column {name!r}: the file is of another version of magrl")
    return [float(row[name] or "nan") for row in rows]


def contours() -> Figure:
    """Return Fig. 4-1: the field over the region, and the paper's example task."""
    figure = Figure(figsize=(7, 7.4), layout="constrained")
    task = named_tasks("figure-4-1")
    draw_tracks(figure.subplots(), Scenario().build_field(), PAPER_REGION, [task.start], task.target)
    return figure


def learning_figures(config: Config) -> dict[str, Figure]:
    """Return the learning curves by file name."""
    runs = {"gg_td3": config.gg_td3, "td3": config.td3}
    curves = {name: [read_csv(run / "train.csv") for run in folders] for name, folders in runs.items() if folders}
    if not curves:
        return {}
    return {
        figure: plots.learning_curves(
            {name: [(column(run, "frames"), column(run, measure)) for run in group] for name, group in curves.items()},
            label,
        )
        for figure, (measure, label) in CURVES.items()
    }


def comparison_figures(results: Path) -> dict[str, Figure]:
    """Return the figures of the example task and the box plots, by file name."""
    paths, episodes = (grouped(read_csv(results / f"{name}.csv")) for name in ("paths", "episodes"))
    field, task = Scenario().build_field(), named_tasks("figure-4-1")
    tracks = {name: (column(rows, "latitude"), column(rows, "longitude")) for name, rows in paths.items()}
    series = {name: {key: column(rows, key) for key in ("D", "I", "B_H", "L")} for name, rows in paths.items()}
    successes = {name: [row for row in rows if row["success"] == "True"] for name, rows in episodes.items()}
    boxes = {name: {key: column(rows, key) for key in BOXES} for name, rows in successes.items() if rows}
    return {
        "fig-4-4-trajectories": plots.compared_trajectories(tracks, field, task),
        "fig-4-5-convergence": plots.convergence(series, field, task),
        "fig-4-6-boxes": plots.box_plots(boxes),
    }


def draw(config: Config) -> None:
    """Draw every figure that there are data for.

    Raises:
        UsageError: for a missing file or column.
    """
    figures = {"fig-4-1-contours": contours(), **learning_figures(config), **comparison_figures(config.results)}
    config.out.mkdir(parents=True, exist_ok=True)
    for name, figure in figures.items():
        figure.savefig(config.out / f"{name}.png", dpi=110)
        print(config.out / f"{name}.png")


if __name__ == "__main__":
    command(RECIPE, lambda: draw(tyro.cli(Config, prog=RECIPE, description=__doc__)))
