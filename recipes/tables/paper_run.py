"""Print a Markdown table of trainings by moves of the vehicle, complete or not, and draw their curves.

    python recipes/tables/paper_run.py "Gradient-Guided TD3=runs/A" "TD3=runs/B" --figure runs/paper-run.png

Success rate, SPL and steps are means over the last five evaluations on the validation tasks. "Moves to SR 90 %" is the
first evaluation with 90 %. The figure is that of the paper's Figs. 4-2 and 4-3, with SPL on the validation tasks.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from magrl.evaluation.tables import markdown_table
from magrl.training import UsageError, command

RECIPE = "paper_run.py"
HEAD = ("", "moves", "episodes", "moves to SR 90 %", "highest SR %", "SR %", "SPL %", "steps", "training s")
PANELS = {
    "return": "return, mean of\nthe last 200 episodes",
    "success_rate": "success rate over\nthe last 200 episodes [%]",
    "eval_spl": "SPL on the\nvalidation tasks [%]",
}
LAST = 5
"""Number of evaluations that a row is the mean of."""


@dataclass(frozen=True)
class Config:
    """Trainings to show."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """LABEL=RUN, in the order of the rows."""
    moves: int | None = None
    """Moves after which curves are cut, to compare trainings of different lengths."""
    figure: Path | None = None
    """File of the figure; none without it."""


def read_curves(text: str, moves: float = math.inf) -> tuple[str, dict[str, np.ndarray]]:
    """Return the label and the columns of ``train.csv``, up to some moves, of a text such as ``TD3=runs/A``.

    Raises:
        UsageError: for a text without a label, or a run without curves.
    """
    label, _, folder = text.rpartition("=")
    if not label:
        raise UsageError(f"a run must be given as LABEL=RUN, such as TD3=runs/A, got {text!r}")
    path = Path(folder) / "train.csv"
    if not path.is_file():
        raise UsageError(f"there is no {path}: has the training begun?")
    with path.open() as file:
        rows = [row for row in csv.DictReader(file) if float(row["frames"]) <= moves]
    if not rows:
        raise UsageError(f"{path} has no rows up to {moves:g} moves: the training did not reach its first evaluation")
    return label, {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}


def table_row(label: str, curves: dict[str, np.ndarray]) -> list[str | float]:
    """Return the row of a run."""
    success, frames = curves["eval_success_rate"], curves["frames"]
    reached = frames[success >= 90]
    means = [float(np.nanmean(curves[f"eval_{name}"][-LAST:])) for name in ("success_rate", "spl", "steps")]
    first = f"{reached[0]:.0f}" if len(reached) else "never"
    end = [f"{mean:.1f}" if math.isfinite(mean) else "—" for mean in means]
    sizes = [f"{frames[-1]:.0f}", f"{curves['episodes'][-1]:.0f}", first, f"{success.max():.1f}"]
    return [label, *sizes, *end, f"{curves['seconds'][-1]:.0f}"]


def curves_figure(runs: Sequence[tuple[str, dict[str, np.ndarray]]]) -> Figure:
    """Return the curves of the runs, over the moves of the vehicle."""
    figure = Figure(figsize=(8, 8.4), layout="constrained")
    panels = figure.subplots(len(PANELS), sharex=True)
    for axes, (column, title) in zip(panels, PANELS.items(), strict=True):
        for label, curves in runs:
            axes.plot(curves["frames"], curves[column], label=label, lw=1.2)
        axes.set_ylabel(title)
        axes.grid(alpha=0.3)
    panels[0].legend(fontsize=8)
    panels[-1].set_xlabel("moves of the vehicle")
    panels[-1].xaxis.set_major_formatter(EngFormatter(sep=""))
    return figure


def main() -> None:
    """Read the command line, print the table and draw the figure."""
    config = tyro.cli(Config, prog=RECIPE, description=__doc__)
    if not config.runs:
        raise UsageError("name at least one run, such as TD3=runs/A")
    runs = [read_curves(text, math.inf if config.moves is None else config.moves) for text in config.runs]
    print(markdown_table(HEAD, [table_row(*run) for run in runs]))
    if config.figure:
        curves_figure(runs).savefig(config.figure, dpi=110)


if __name__ == "__main__":
    command(RECIPE, main)
