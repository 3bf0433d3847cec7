"""Print a Markdown table of a sweep: one row for each setting, over its seeds.

    python recipes/tables/sweep_table.py "runs/sweep/*"

The columns are the settings in which the runs differ, read from their folders, and the results on the test tasks. A run
without results is left out with a warning. A row of ten or more seeds shows interquartile means and the 95 % stratified
bootstrap interval, of two to nine seeds [smallest–largest], of one seed its values.
"""

from __future__ import annotations

import glob
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from magrl.evaluation.runs import run_config
from magrl.evaluation.tables import INTERVALS, Summary, markdown_table, mean_of_runs
from magrl.training import UsageError, command

RECIPE = "sweep_table.py"
COLUMNS = {
    "SR %": ("success_rate", ".1f"),
    "SPL %": ("spl", ".2f"),
    "TNT steps": ("steps", ".2f"),
    "NE km": ("navigation_error_km", ".1f"),
    "training s": ("training_seconds", ".0f"),
}
NOT_SWEPT = ("recipe", "seed", "out", "resume", "logger", "wandb_mode", "checkpoint_every")
"""Settings that do not tell one row from another."""


@dataclass(frozen=True)
class Config:
    """Runs to show."""

    runs: tyro.conf.Positional[tuple[str, ...]]
    """Run folders, or quoted patterns of them, all of one recipe."""


@dataclass(frozen=True)
class Finished:
    """Settings and results of a run that is complete."""

    folder: Path
    settings: Mapping[str, Any]
    result: Summary


def run_folders(texts: Sequence[str]) -> list[Path]:
    """Return the folders that paths and patterns name and that hold a run, each once.

    Raises:
        UsageError: for no path, or one without a run.
    """
    if not texts:
        raise UsageError('name at least one run or a pattern, for example: "runs/sweep/*"')
    folders: dict[Path, Path] = {}
    for text in texts:
        found = [Path(text)] if Path(text).exists() else sorted(map(Path, glob.glob(text)))
        runs = [folder for folder in found if (folder / "config.json").is_file()]
        if not runs:
            raise UsageError(f"there is no run at {text}: a run folder holds config.json")
        folders |= {folder.resolve(): folder for folder in runs}
    return list(folders.values())


def finished(folders: Sequence[Path]) -> list[Finished]:
    """Return settings and results of the runs that are complete, and warn of the others.

    Raises:
        UsageError: for files that cannot be read, or if no run is complete.
    """
    runs = []
    scenarios: dict[str, str] = {}  # the first file of each content: all have the same name in their folders
    for folder in folders:
        if not (folder / "eval.json").is_file():
            print(f"Warning: {folder} is left out: it holds no eval.json, the run is not complete", file=sys.stderr)
            continue
        try:
            settings = run_config(folder)
            if settings.get("scenario"):
                file = folder / Path(settings["scenario"]).name
                settings["scenario"] = scenarios.setdefault(file.read_text(), str(file))
            runs.append(Finished(folder, settings, json.loads((folder / "eval.json").read_text())))
        except (ValueError, OSError) as error:
            raise UsageError(f"{folder} cannot be read: {error}") from error
    if not runs:
        raise UsageError(f"none of {len(folders)} runs is complete")
    return runs


def swept(runs: Sequence[Finished]) -> list[str]:
    """Return the names of the settings in which runs differ, in the order of their files.

    Raises:
        UsageError: for runs of several recipes, whose settings cannot be compared.
    """
    recipes = sorted({str(run.settings.get("recipe")) for run in runs})
    if len(recipes) > 1:
        raise UsageError(f"the runs are of several recipes, {', '.join(recipes)}: compare them with results_table.py")
    names = [name for name in dict.fromkeys(key for run in runs for key in run.settings) if name not in NOT_SWEPT]
    return [name for name in names if len({json.dumps(run.settings.get(name)) for run in runs}) > 1]


def grouped(runs: Sequence[Finished], names: Sequence[str]) -> dict[tuple[str, ...], list[Finished]]:
    """Return the runs by their values of some settings, in natural order of the values.

    Raises:
        UsageError: for two runs of the same setting and seed: the same run again is no spread over seeds.
    """
    groups: dict[tuple[str, ...], dict[Any, Finished]] = {}
    for run in sorted(runs, key=lambda run: [_order(run.settings.get(name)) for name in names]):
        group = groups.setdefault(tuple(_said(run.settings.get(name)) for name in names), {})
        seed = run.settings.get("seed")
        if seed in group:
            raise UsageError(f"{group[seed].folder} and {run.folder} have the same settings and seed {seed}: name one")
        group[seed] = run
    return {values: list(group.values()) for values, group in groups.items()}


def _order(value: Any) -> tuple[bool, float, str]:
    """Return a key that sorts numbers by value, then texts."""
    number = isinstance(value, (int, float))
    return not number, float(value) if number else 0.0, json.dumps(value)


def _said(value: Any) -> str:
    return " ".join(map(str, value)) if isinstance(value, list) else "—" if value is None else str(value)


def table(runs: Sequence[Finished]) -> str:
    """Return the table of the runs of a sweep."""
    names = swept(runs)
    rows = []
    for values, group in grouped(runs, names).items():
        results = [run.result for run in group]
        cells = [
            mean_of_runs([result.get(key) for result in results], form=form, interval=key in INTERVALS)
            for key, form in COLUMNS.values()
        ]
        rows.append([*values, len(group), *cells])
    return markdown_table([*names, "seeds", *COLUMNS], rows)


def main() -> None:
    """Read the command line and print the table."""
    print(table(finished(run_folders(tyro.cli(Config, prog=RECIPE, description=__doc__).runs))))


if __name__ == "__main__":
    command(RECIPE, main)
