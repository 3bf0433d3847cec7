"""Print a Markdown table of finished runs: one row for each group of runs, below the paper's row.

    python recipes/tables/results_table.py runs/td3_gradient_guided-fast-seed*
    python recipes/tables/results_table.py "one thread=runs/a-*" "two threads=runs/b-*" --pooled --each
    python recipes/tables/results_table.py "low gamma=runs/A" "high gamma=runs/B"

A folder may be a quoted pattern. A row of ten or more runs shows interquartile means and, where a measure has one, the
95 % stratified bootstrap interval; of two to nine runs [smallest–largest]; of one run its values.
"""

from __future__ import annotations

import glob
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from magrl import paper
from magrl.evaluation.tables import INTERVALS, Summary, known_values, markdown_table, mean_of_runs
from magrl.training import UsageError, command

RECIPE = "results_table.py"
COLUMNS = {
    "SR %": ("success_rate", ".1f"),
    "SPL %": ("spl", ".2f"),
    "SPL, smallest–largest %": ("range", ".2f"),
    "TL m": ("trajectory_length_m", ".0f"),
    "TNT steps": ("steps", ".2f"),
    "path efficiency %": ("path_efficiency", ".2f"),
    "NE km": ("navigation_error_km", ".1f"),
    "within 10 km %": ("success_rate_within_10km", ".1f"),
    "training s": ("training_seconds", ".0f"),
    "to 97 / 88.4 s": ("seconds_to_97_sr_88_spl", ".0f"),
}
MAY_DIFFER = {"seed", "out", "device", "logger", "wandb_mode", "checkpoint_every", "collector_backend"}
"""Settings that may differ between the runs of one row."""
Groups = Mapping[str, Sequence[Summary]]


@dataclass(frozen=True)
class Config:
    """Runs to show."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Run folders or quoted patterns of them, each with an eval.json; NAME=RUN puts runs of one name into one row."""
    each: bool = False
    """Whether each run has a row of its own as well."""
    pooled: bool = False
    """Whether a last row takes all runs together, resampled within each group."""


def folders(text: str) -> list[Path]:
    """Return the run folders that a path or a pattern names, in natural order.

    Raises:
        UsageError: for a folder without ``eval.json``, or a pattern without a match.
    """
    found = [Path(text)] if Path(text).exists() else [Path(path) for path in glob.glob(text)]
    missing = [str(folder) for folder in found if not (folder / "eval.json").is_file()]
    if missing or not found:
        raise UsageError(f"no eval.json in {', '.join(missing) or text}: is the training complete?")
    return sorted(found, key=lambda folder: (len(folder.name), str(folder)))


def grouped(texts: Sequence[str]) -> dict[str, list[Summary]]:
    """Return the results of runs by the name of their group; runs without a name are one group.

    Raises:
        UsageError: for no run, one that is not complete or given twice, or runs of different settings in one group.
    """
    if not texts:
        raise UsageError("name at least one run, for example: runs/td3_gradient_guided-fast-seed0")
    groups: dict[str, list[Summary]] = {}
    members: dict[str, Path] = {}
    seen: set[Path] = set()
    for text in texts:
        name, _, pattern = text.rpartition("=")
        for folder in folders(pattern):
            if folder.resolve() in seen:
                raise UsageError(f"{folder} is given twice: the same run again is no spread over runs")
            seen.add(folder.resolve())
            _check_same_settings(members.setdefault(name, folder), folder)
            groups.setdefault(name, []).append(json.loads((folder / "eval.json").read_text()) | _place(folder))
    return groups


def _check_same_settings(folder: Path, other: Path) -> None:
    first, second = _settings(folder), _settings(other)
    differ = [key for key in first if key in second and key not in MAY_DIFFER and first[key] != second[key]]
    if differ:
        key = differ[0]
        said = "their scenarios differ" if key == "scenario" else f"{key} is {first[key]!r} and {second[key]!r}"
        raise UsageError(
            f"{folder} and {other} are not seeds of one training: {said}; give each a name, as in NAME={other}"
        )


def _settings(folder: Path) -> dict[str, Any]:
    path = folder / "config.json"
    settings = json.loads(path.read_text()) if path.is_file() else {}
    if settings.get("scenario") and (file := folder / Path(settings["scenario"]).name).is_file():
        settings["scenario"] = file.read_text()  # all files have the same name in their folders
    return settings


def _place(folder: Path) -> dict[str, Any]:
    """Return the scenario file of a run, if it had one."""
    scenario = _settings(folder).get("scenario")
    return {"scenario": scenario} if scenario else {}


def cells(*strata: Sequence[Summary]) -> list[str]:
    """Return the cells of the runs of one or several groups; missing values become dashes."""
    return [str(sum(map(len, strata))), *(_cell(strata, key, form) for key, form in COLUMNS.values())]


def _cell(strata: Sequence[Sequence[Summary]], key: str, form: str) -> str:
    if key == "range":
        spl = known_values(run.get("spl") for runs in strata for run in runs)
        return f"{min(spl):{form}}–{max(spl):{form}}" if len(spl) > 1 else "—"
    values = ([run.get(key) for run in runs] for runs in strata)
    return mean_of_runs(*values, form=form, interval=key in INTERVALS)


def table(groups: Groups, each: bool = False, pooled: bool = False) -> str:
    """Return the table of groups of runs, below the paper's row unless a run was in another scenario."""
    elsewhere = any("scenario" in run for runs in groups.values() for run in runs)
    rows = [] if elsewhere else [["paper", *cells([paper.TABLE_2["gg_td3"]._asdict()])]]
    for name, runs in groups.items():
        if each and len(runs) > 1:
            rows += [[f"{name}, seed {run['seed']}" if name else f"seed {run['seed']}", *cells([run])] for run in runs]
        rows.append([name or (f"seed {runs[0]['seed']}" if len(runs) == 1 else "all runs"), *cells(runs)])
    if pooled:
        rows.append(["together", *cells(*groups.values())])
    return markdown_table(["", "runs", *COLUMNS], rows)


def main() -> None:
    """Read the command line and print the table."""
    config = tyro.cli(Config, prog=RECIPE, description=__doc__)
    print(table(grouped(config.runs), config.each, config.pooled))


if __name__ == "__main__":
    command(RECIPE, main)
