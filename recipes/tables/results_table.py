"""Print a Markdown table of finished runs, one row each, below the paper's row.

    python recipes/tables/results_table.py runs/td3_gradient_guided-fast-seed*
    python recipes/tables/results_table.py "low gamma=runs/A" "high gamma=runs/B"

Runs without names are followed by their mean, minimum and maximum.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from magrl import paper
from magrl.evaluation.tables import markdown_table
from magrl.training import UsageError, command

RECIPE = "results_table.py"
COLUMNS = {
    "SR %": ("success_rate", ".1f"),
    "SPL %": ("spl", ".2f"),
    "TL m": ("trajectory_length_m", ".0f"),
    "TNT steps": ("steps", ".2f"),
    "NE km": ("navigation_error_km", ".1f"),
    "within 10 km %": ("success_rate_within_10km", ".1f"),
    "within 25 km %": ("success_rate_within_25km", ".1f"),
    "training s": ("training_seconds", ".0f"),
    "to 97 / 88.4 s": ("seconds_to_97_sr_88_spl", ".0f"),
}


@dataclass
class Runs:
    """Runs to show."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Run folders, each with an eval.json; as NAME=RUN they are shown by name, without statistics."""


def cells(name: str, results: Mapping[str, float | None]) -> list[str]:
    """Return a row of the table; missing values become dashes."""
    values = (results.get(key) for key, _ in COLUMNS.values())
    return [
        name,
        *("—" if v is None else format(v, form) for v, (_, form) in zip(values, COLUMNS.values(), strict=True)),
    ]


def table(runs: Sequence[str]) -> str:
    """Return the table.

    Raises:
        UsageError: for no run, or a run without ``eval.json``.
    """
    named = [text.rpartition("=")[::2] for text in runs]
    missing = [folder for _, folder in named if not (Path(folder) / "eval.json").is_file()]
    if missing or not runs:
        raise UsageError(f"no eval.json in {', '.join(missing) or 'no run at all'}: is the training complete?")
    results = [json.loads((Path(folder) / "eval.json").read_text()) for _, folder in named]
    rows = [cells("paper", paper.TABLE_2["gg_td3"]._asdict())]
    rows += [cells(name or f"seed {r['seed']}", r) for (name, _), r in zip(named, results, strict=True)]
    averages = (("mean", statistics.fmean), ("min", min), ("max", max)) if not named[0][0] else ()
    for name, statistic in averages:
        numbers = {key: [r[key] for r in results] for key, _ in COLUMNS.values()}
        rows.append(cells(name, {key: statistic(v) if None not in v else None for key, v in numbers.items()}))
    return markdown_table(["", *COLUMNS], rows)


if __name__ == "__main__":
    command(RECIPE, lambda: print(table(tyro.cli(Runs, prog=RECIPE, description=__doc__).runs)))
