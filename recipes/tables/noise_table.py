"""Make the table and the figure of navigators at several noise levels, from folders of recipes/evaluate.py.

    python recipes/evaluate.py secant gg_td3=runs/A --noise 0.05 0.05 5 --out runs/noise-0.05
    python recipes/tables/noise_table.py runs/noise-0 runs/noise-0.05 --table runs/noise.md --figure runs/noise.png

The folders differ only in `--noise`. A cell holds SR % / SPL %, interquartile means over the runs of a navigator.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from magrl.evaluation.figures import noise_figure
from magrl.evaluation.navigators import label, needs
from magrl.evaluation.tables import Summaries, markdown_table, mean_of_runs
from magrl.files import check_writable
from magrl.training import UsageError, command

RECIPE = "noise_table.py"
Noise = tuple[float, ...]
"""Standard deviations of D [deg], I [deg], B_H [nT]."""

MAY_DIFFER = ("noise", "navigators", "seed")
"""Settings in which evaluations may differ; they have all others in common."""


@dataclass(frozen=True)
class Config:
    """Evaluations to compare, and the files to write."""

    results: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of recipes/evaluate.py, each with settings.json and summary.json."""
    table: Path = Path("runs/noise.md")
    """File of the table."""
    figure: Path = Path("runs/noise.png")
    """File of the figure."""


def read(folder: Path) -> tuple[dict[str, Any], Summaries]:
    """Return the settings and the summaries of an evaluation.

    Raises:
        UsageError: for a missing file, or settings without a noise level.
    """
    missing = [name for name in ("settings.json", "summary.json") if not (folder / name).is_file()]
    if missing:
        raise UsageError(f"there is no {folder / missing[0]}: is the evaluation complete?")
    settings, summaries = (json.loads((folder / name).read_text()) for name in ("settings.json", "summary.json"))
    if "noise" not in settings:
        raise UsageError(f"{folder / 'settings.json'} holds no noise level: it is of another version of magrl")
    return settings, summaries


def by_level(folders: Sequence[Path]) -> tuple[str, dict[Noise, Summaries]]:
    """Return the mode of metaheuristics and the summaries by noise level, the lowest level first.

    Raises:
        UsageError: for no folder, a level that is given twice, or evaluations that differ in anything else.
    """
    if not folders:
        raise UsageError("name at least one folder of recipes/evaluate.py")
    levels: dict[Noise, Summaries] = {}
    common: dict[str, Any] = {}
    for folder in folders:
        settings, summaries = read(folder)
        noise = tuple(float(value) for value in settings["noise"] or (0, 0, 0))
        if noise in levels:
            raise UsageError(f"{folder} has the noise {list(noise)}, as a folder before it: one folder for each level")
        same = {key: value for key, value in settings.items() if key not in MAY_DIFFER}
        if differing := [key for key, value in same.items() if common.setdefault(key, value) != value]:
            key = differing[0]
            raise UsageError(f"{folder} has {key} {same[key]!r}, the folders before it {common[key]!r}")
        levels[noise] = summaries
    return common.get("mode") or "look-ahead", dict(sorted(levels.items()))


def title(noise: Noise) -> str:
    """Return a noise level as text."""
    return "no noise" if not any(noise) else "{:g}°, {:g}°, {:g} nT".format(*noise)


def cell(results: Sequence[Mapping[str, float | None]]) -> str:
    """Return SR % / SPL % of the runs of a navigator; a dash where it did not fly."""
    measures = ([run[key] for run in results] for key in ("success_rate", "spl"))
    return " / ".join(mean_of_runs(values, form=".1f", interval=False) for values in measures) if results else "—"


def table(levels: Mapping[Noise, Summaries], mode: str) -> str:
    """Return the table, one row for each navigator."""
    names = dict.fromkeys(name for summaries in levels.values() for name in summaries)
    rows = [
        [
            label(name, mode),
            needs(name, mode),
            max(len(summaries.get(name, ())) for summaries in levels.values()),
            *(cell(summaries.get(name, ())) for summaries in levels.values()),
        ]
        for name in names
    ]
    return markdown_table(["navigator", "needs", "runs", *map(title, levels)], rows) + "\n"


def make(config: Config) -> None:
    """Write table and figure.

    Raises:
        UsageError: for anything that is wrong with the folders, or a file that cannot be written.
    """
    mode, levels = by_level(config.results)
    try:
        for path in (config.table, config.figure):
            check_writable(path)
    except OSError as error:
        raise UsageError(str(error)) from error
    config.table.write_text(table(levels, mode))
    figure = noise_figure({title(noise): summaries for noise, summaries in levels.items()}, mode)
    figure.savefig(config.figure, dpi=110)
    print(config.table.read_text())


if __name__ == "__main__":
    command(RECIPE, lambda: make(tyro.cli(Config, prog=RECIPE, description=__doc__)))
