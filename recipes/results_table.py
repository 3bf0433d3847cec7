"""A Markdown table of finished runs, a row each, then their mean and spread; or runs by names of your own.

    python recipes/results_table.py runs/td3_gradient_guided-fast-seed*
    python recipes/results_table.py "low gamma=runs/A" "high gamma=runs/B"

With names, nothing is averaged.
"""

import json
import statistics
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

COLUMNS = {
    "SR %": ("success_rate", "{:.1f}"),
    "SPL %": ("spl", "{:.2f}"),
    "TL m": ("trajectory_length_m", "{:.0f}"),
    "TNT steps": ("steps", "{:.2f}"),
    "NE km": ("navigation_error_km", "{:.1f}"),
    "within 10 km %": ("success_rate_within_10km", "{:.1f}"),
    "within 25 km %": ("success_rate_within_25km", "{:.1f}"),
    "training s": ("training_seconds", "{:.0f}"),
    "to 97 / 88.4 s": ("seconds_to_97_sr_88_spl", "{:.0f}"),
}
PAPER = {"success_rate": 97.0, "spl": 88.4119, "trajectory_length_m": 445564.313, "steps": 21.757}
"""Gradient-Guided TD3 in the paper's Table 2, on 100 tasks."""


@dataclass
class Runs:
    """Which runs to show."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Run folders, each with an eval.json; as NAME=RUN they are named, and not averaged."""


def row(name: str, results: dict[str, float | None]) -> str:
    """One line of the table; what is missing is a dash."""
    values = (results.get(key) for key, _ in COLUMNS.values())
    cells = ("—" if v is None else form.format(v) for v, (_, form) in zip(values, COLUMNS.values(), strict=True))
    return f"| {name} | " + " | ".join(cells) + " |"


def table(runs: tuple[str, ...]) -> str:
    """The whole table.

    Raises:
        SystemExit: for a run without an ``eval.json``, by name.
    """
    named = [text.rpartition("=")[::2] for text in runs]
    missing = [folder for _, folder in named if not (Path(folder) / "eval.json").is_file()]
    if missing or not runs:
        sys.exit(f"no eval.json in {', '.join(missing) or 'no run at all'}: is the training finished?")
    results = [json.loads((Path(folder) / "eval.json").read_text()) for _, folder in named]
    lines = ["| | " + " | ".join(COLUMNS) + " |", "|---|" + "---|" * len(COLUMNS), row("paper", PAPER)]
    lines += [row(name or f"seed {r['seed']}", r) for (name, _), r in zip(named, results, strict=True)]
    averages = (("mean", statistics.fmean), ("min", min), ("max", max)) if not named[0][0] else ()
    for name, statistic in averages:
        numbers = {key: [r[key] for r in results] for key, _ in COLUMNS.values()}
        lines.append(row(name, {key: statistic(v) if None not in v else None for key, v in numbers.items()}))
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(tyro.cli(Runs, description=__doc__).runs))
