"""Draws the figures of the paper's Section 4 from what recipes/evaluate.py and the trainings wrote.

    python recipes/figures.py --results runs/comparison --gg-td3 runs/A runs/B --td3 runs/C runs/D --out docs/figures

Field contours (4-1), reward curves (4-2), success rate (4-3), trajectories (4-4), convergence (4-5), box plots (4-6).
"""

import csv
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import tyro
from matplotlib.figure import Figure

from magrl import plots
from magrl.env import paper_field
from magrl.tasks import PAPER_REGION, named_tasks


@dataclass(frozen=True)
class Config:
    """Where the data are and where the pictures go."""

    results: Path
    """Folder that recipes/evaluate.py wrote."""
    gg_td3: tuple[Path, ...] = ()
    """Run folders of Gradient-Guided TD3, for the learning curves."""
    td3: tuple[Path, ...] = ()
    """Run folders of TD3."""
    out: Path = Path("docs/figures")
    """Folder of the pictures; made if need be, files of the same name are replaced."""


Row = Mapping[str, str]


def read_csv(path: Path) -> list[Row]:
    """The rows of a file.

    Raises:
        SystemExit: if there is none, by name.
    """
    if not path.is_file():
        sys.exit(f"there is no {path}: has the evaluation or the training finished?")
    with path.open() as file:
        return list(csv.DictReader(file))


def grouped(rows: list[Row], key: str = "navigator") -> dict[str, list[Row]]:
    """Rows by navigator, in the order in which navigators first come, of those that figures show."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row[key], []).append(row)
    return {name: rows for name, rows in groups.items() if name in plots.NAVIGATOR_NAMES}


def column(rows: list[Row], name: str) -> list[float]:
    """A column as numbers; what is empty is NaN."""
    return [float(row[name] or "nan") for row in rows]


def contours() -> Figure:
    """Fig. 4-1: the field over the region, and the paper's example task."""
    figure = Figure(figsize=(7, 7.4), layout="constrained")
    task = named_tasks("figure-4-1")
    plots.draw_journeys(figure.subplots(), paper_field(), PAPER_REGION, [task.start], task.target)
    return figure


def main(config: Config) -> None:
    """Draws whatever there are data for."""
    paths, episodes = (grouped(read_csv(config.results / f"{name}.csv")) for name in ("paths", "episodes"))
    figures = {"fig-4-1-contours": contours()}
    runs = {"gg_td3": config.gg_td3, "td3": config.td3}
    curves = {name: [read_csv(run / "train.csv") for run in folders] for name, folders in runs.items() if folders}
    for figure, measure, label in (
        ("fig-4-2-reward", "return", "return, mean of the last 200 episodes"),
        ("fig-4-3-success", "success_rate", "success rate over the last 200 episodes [%]"),
        ("learning-spl", "eval_spl", "SPL on the validation tasks [%]"),
    ):
        lines = {
            name: [(column(run, "frames"), column(run, measure)) for run in group] for name, group in curves.items()
        }
        if lines:
            figures[figure] = plots.learning_curves(lines, label)
    tracks = {name: (column(rows, "latitude"), column(rows, "longitude")) for name, rows in paths.items()}
    figures["fig-4-4-trajectories"] = plots.compared_trajectories(tracks, paper_field(), named_tasks("figure-4-1"))
    series = {name: {key: column(rows, key) for key in ("D", "I", "B_H", "L")} for name, rows in paths.items()}
    figures["fig-4-5-convergence"] = plots.convergence(series, paper_field(), named_tasks("figure-4-1"))
    arrived = {name: [row for row in rows if row["success"] == "True"] for name, rows in episodes.items()}
    measures = ("heading_mae_deg", "heading_rmse_deg", "smoothness_deg", "navigation_error_km")
    boxes = {name: {key: column(rows, key) for key in measures} for name, rows in arrived.items() if rows}
    figures["fig-4-6-boxes"] = plots.box_plots(boxes)
    config.out.mkdir(parents=True, exist_ok=True)
    for name, figure in figures.items():
        figure.savefig(config.out / f"{name}.png", dpi=110)
        print(config.out / f"{name}.png")


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
