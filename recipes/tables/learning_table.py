"""Print a Markdown table of how fast trainings learn.

    python recipes/tables/learning_table.py gg_td3=runs/A gg_td3=runs/B td3=runs/C td3=runs/D

Interquartile mean over the runs of each name on the validation tasks; in parentheses its 95 % interval over ten or more
runs, in brackets the smallest and the largest of fewer.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from magrl import paper
from magrl.evaluation.tables import markdown_table, mean_of_runs
from magrl.training import UsageError, command

RECIPE = "learning_table.py"
PUBLISHED = paper.TABLE_2["gg_td3"]
HEAD = (
    "",
    "runs",
    "frames to SR 90 %",
    f"frames to SR {PUBLISHED.success_rate:.0f} %, SPL {PUBLISHED.spl:.1f} %",
    "mean SR over training %",
    "last SPL %",
)


@dataclass
class Runs:
    """Runs to compare."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """NAME=RUN; several runs of one name are one row."""


def curve(run: Path) -> list[tuple[float, float, float]]:
    """Return frames, success rate [%] and SPL [%] on the validation tasks.

    Raises:
        UsageError: for a run without curves.
    """
    path = run / "train.csv"
    if not path.is_file():
        raise UsageError(f"there is no {path}: is the training complete?")
    with path.open() as file:
        rows = list(csv.DictReader(file))
    if not rows:
        raise UsageError(f"{path} has no rows: the training ended before its first evaluation")
    return [(float(row["frames"]), float(row["eval_success_rate"]), float(row["eval_spl"])) for row in rows]


def first_frames(points: Sequence[tuple[float, float, float]], success: float, spl: float) -> float:
    """Return the frames at which a success rate and an SPL are first reached together; NaN if never."""
    return next((frames for frames, s, p in points if s >= success and p >= spl), math.nan)


def area(points: Sequence[tuple[float, float, float]]) -> float:
    """Return the mean success rate over the training [%]: the area under the curve divided by its width."""
    total, before = 0.0, (0.0, 0.0)
    for frames, success, _ in points:
        total += (frames - before[0]) * (success + before[1]) / 2
        before = (frames, success)
    return total / before[0]


def reached(values: Sequence[float], form: str) -> str:
    """Return the average of the finite values over runs, and how many runs never reached the threshold."""
    never = sum(not math.isfinite(value) for value in values)
    if never == len(values):
        return "never"
    return mean_of_runs(values, form=form) + (f", {never} of {len(values)} never" if never else "")


def table(names: Mapping[str, Sequence[Path]]) -> str:
    """Return the table of runs by name."""
    rows = []
    for name, runs in names.items():
        curves = [curve(run) for run in runs]
        columns = (
            ([first_frames(c, 90, 0) for c in curves], ".0f"),
            ([first_frames(c, PUBLISHED.success_rate, round(PUBLISHED.spl, 1)) for c in curves], ".0f"),
            ([area(c) for c in curves], ".1f"),
            ([c[-1][2] for c in curves], ".2f"),
        )
        rows.append([name, len(runs), *(reached(*values) for values in columns)])
    return markdown_table(HEAD, rows)


def by_name(texts: Sequence[str]) -> dict[str, list[Path]]:
    """Return run folders by name.

    Raises:
        UsageError: for no run, or a run without a name.
    """
    groups: dict[str, list[Path]] = {}
    for text in texts:
        name, _, folder = text.partition("=")
        if not name or not folder:
            raise UsageError(f"a run must be given as NAME=RUN, such as gg_td3={folder or name}, got {text!r}")
        groups.setdefault(name, []).append(Path(folder))
    if not groups:
        raise UsageError("name at least one run, such as gg_td3=runs/A")
    return groups


def main() -> None:
    """Read the command line and print the table."""
    print(table(by_name(tyro.cli(Runs, prog=RECIPE, description=__doc__).runs)))


if __name__ == "__main__":
    command(RECIPE, main)
