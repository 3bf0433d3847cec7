"""A Markdown table of finished runs, a row each, then their mean and spread.

python recipes/results_table.py runs/td3_gradient_guided-fast-seed*
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

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Run folders, each with an eval.json."""


def row(name: str, results: dict[str, float | None]) -> str:
    """One line of the table; what is missing is a dash."""
    values = (results.get(key) for key, _ in COLUMNS.values())
    cells = ("—" if v is None else form.format(v) for v, (_, form) in zip(values, COLUMNS.values(), strict=True))
    return f"| {name} | " + " | ".join(cells) + " |"


def table(runs: tuple[Path, ...]) -> str:
    """The whole table.

    Raises:
        SystemExit: for a run without an ``eval.json``, by name.
    """
    missing = [str(run) for run in runs if not (run / "eval.json").is_file()]
    if missing or not runs:
        sys.exit(f"no eval.json in {', '.join(missing) or 'no run at all'}: is the training finished?")
    results = [json.loads((run / "eval.json").read_text()) for run in runs]
    lines = ["| | " + " | ".join(COLUMNS) + " |", "|---|" + "---|" * len(COLUMNS), row("paper", PAPER)]
    lines += [row(f"seed {result['seed']}", result) for result in results]
    for name, statistic in (("mean", statistics.fmean), ("min", min), ("max", max)):
        numbers = {key: [r[key] for r in results] for key, _ in COLUMNS.values()}
        lines.append(row(name, {key: statistic(v) if None not in v else None for key, v in numbers.items()}))
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(tyro.cli(Runs, description=__doc__).runs))
