"""How fast trainings learn: a Markdown table.

    python recipes/learning_table.py gg_td3=runs/A gg_td3=runs/B td3=runs/C td3=runs/D

Mean and spread over the runs of each name, on the validation tasks.
"""

import csv
import math
import statistics
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro


@dataclass
class Runs:
    """Which runs to compare."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """NAME=RUN, several of one name for its spread."""


def curve(run: Path) -> list[tuple[float, float, float]]:
    """Frames, success rate [%] and SPL [%] on the validation tasks.

    Raises:
        SystemExit: for a run without curves, by name.
    """
    path = run / "train.csv"
    if not path.is_file():
        sys.exit(f"there is no {path}: has the training finished?")
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return [(float(row["frames"]), float(row["eval_success_rate"]), float(row["eval_spl"])) for row in rows]


def first_frames(points: list[tuple[float, float, float]], success: float, spl: float) -> float:
    """Frames at which a success rate and an SPL are first passed together; NaN if never."""
    return next((frames for frames, s, p in points if s >= success and p >= spl), math.nan)


def area(points: list[tuple[float, float, float]]) -> float:
    """Mean success rate over the training [%]: the area under the curve, divided by its width."""
    total, before = 0.0, (0.0, 0.0)
    for frames, success, _ in points:
        total += (frames - before[0]) * (success + before[1]) / 2
        before = (frames, success)
    return total / before[0]


def spread(values: list[float], form: str) -> str:
    """Mean ± standard deviation of what is known; how many runs never got there."""
    known = [value for value in values if math.isfinite(value)]
    missing = f", {len(values) - len(known)} of {len(values)} never" if len(known) < len(values) else ""
    if not known:
        return "never"
    deviation = f" ± {format(statistics.stdev(known), form)}" if len(known) > 1 else ""
    return format(statistics.fmean(known), form) + deviation + missing


def table(names: dict[str, list[Path]]) -> str:
    """The whole table."""
    lines = ["| | runs | frames to SR 90 % | frames to SR 97 %, SPL 88.4 % | mean SR over training % | last SPL % |"]
    lines.append("|---" * 6 + "|")
    for name, runs in names.items():
        curves = [curve(run) for run in runs]
        columns = (
            ([first_frames(c, 90, 0) for c in curves], ".0f"),
            ([first_frames(c, 97, 88.4) for c in curves], ".0f"),
            ([area(c) for c in curves], ".1f"),
            ([c[-1][2] for c in curves], ".2f"),
        )
        lines.append(f"| {name} | {len(runs)} | " + " | ".join(spread(*column) for column in columns) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    groups: dict[str, list[Path]] = {}
    for text in tyro.cli(Runs, description=__doc__).runs:
        name, _, folder = text.partition("=")
        groups.setdefault(name, []).append(Path(folder))
    print(table(groups))
