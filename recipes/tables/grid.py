"""Make the tables that recipes/tables/tables.toml declares: navigators by errors, tasks and runs.

    python recipes/tables/grid.py earth conditions --out docs/results        # writes earth.md and conditions.md
    python recipes/tables/grid.py earth --navigators policy:MINE=mine.safetensors  # the same table of other navigators
    python recipes/tables/grid.py earth --tasks 200                          # faster

Without --out, tables are printed. Navigators are given the accuracy of their sensors. Tables of trained agents read
the run folders that they name; `make tables` trains what is missing.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from magrl.evaluation.navigators import check_distinct
from magrl.evaluation.tables import ABOUT, markdown_table
from magrl.files import check_writable
from magrl.training import UsageError, command

import tyro
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parent.parent))
sys.path.insert(0, str(Path(__file__).parent))
from evaluate import Config, evaluate

import globe
from flights import MEASURES, Flights, Spec, cell, names, paired_difference, runs_of

RECIPE = "grid.py"
FILE, RUNS = Path(__file__).parent / "tables.toml", Path("runs")


def flights(
    navigators: Sequence[Spec],
    *,
    against: Sequence[Spec] = (),
    measures: Sequence[str] = MEASURES,
    **options: Any,
) -> str:
    """Return a row for each navigator, and a column for each level of noise, or each of some conditions.

    A cell has the ``measures``. The last rows are differences of SPL between the first navigator and those that it is
    compared ``against``. The other options are those of :class:`Flights`.
    """
    made, rows, spl = Flights(**options), [], {}
    for navigator in tqdm(navigators, unit="row"):
        episodes = [made.episodes(navigator, errors) for errors in made.errors.values()]
        spl[names(navigator)[0]] = [runs[0]["spl"] for runs in episodes]
        rows.append([*names(navigator), *(cell(runs, measures) for runs in episodes)])
    first, region = names(navigators[0])[0], made.scenario.tasks.region
    for other in [names(navigator)[0] for navigator in against if names(navigator)[0] in spl]:
        differences = (paired_difference(*pair, region) for pair in zip(spl[first], spl[other], strict=True))
        rows.append([f"{first} − {other}, SPL", "—", "—", *differences])
    return markdown_table([*ABOUT, *made.errors], rows)


def evaluation(navigators: Sequence[str], *, folder: Path, **options: Any) -> str:
    """Return the table of recipes/evaluate.py, whose results are in a folder, which is replaced."""
    shutil.rmtree(folder, ignore_errors=True)
    every = tuple(run for navigator in navigators for run in runs_of(navigator))
    evaluate(Config(navigators=every, out=folder, **options))
    return (folder / "table.md").read_text()


KINDS: Mapping[str, Callable[..., str]] = {"flights": flights, "globe": globe.globe, "evaluation": evaluation}
"""Function of each kind of table; its arguments are the options in the file."""


def declared(file: Path = FILE) -> dict[str, dict[str, Any]]:
    """Return the kind and the options of each table in a file."""
    return tomllib.loads(file.read_text())


def make(
    tables: tyro.conf.Positional[tuple[str, ...]] = (),
    *,
    navigators: tuple[str, ...] | None = None,
    tasks: int | None = None,
    confidence: float | None = None,
    out: Path | None = None,
) -> None:
    """Make tables.

    Args:
        tables: Names of tables in tables.toml; all by default.
        navigators: Navigators in place of those of the table, as in recipes/evaluate.py.
        tasks: Number of tasks in place of that of the table.
        confidence: Minimum probability at which vehicles declare their arrival, in place of 0.
        out: Folder of the tables, which are replaced; by default they are printed.

    Raises:
        UsageError: for a table, a navigator or an option that is wrong, or a run that is missing.
    """
    specs, changes = declared(), {"navigators": navigators, "tasks": tasks, "confidence": confidence}
    changes = {key: value for key, value in changes.items() if value is not None}
    if unknown := [name for name in tables if name not in specs]:
        raise UsageError(f"{FILE} declares no table {', '.join(unknown)}: choose from {', '.join(specs)}")
    check_distinct(navigators or ())
    for name in tables or specs:
        try:
            with tempfile.TemporaryDirectory() as folder:  # a table that is changed replaces no results
                text = table(**specs[name] | changes, folder=(Path(folder) if changes else RUNS) / name)
        except (ValueError, OSError, TypeError) as error:
            raise UsageError(f"{name}: {error}") from error
        if out is None:
            print(text)
        else:
            check_writable(out / f"{name}.md")
            (out / f"{name}.md").write_text(text.rstrip() + "\n")


def table(kind: str, *, folder: Path, **options: Any) -> str:
    """Return a table of a kind; results of an evaluation are in a folder."""
    return KINDS[kind](**options, **({"folder": folder} if kind == "evaluation" else {}))


if __name__ == "__main__":
    command(RECIPE, lambda: tyro.cli(make, prog=RECIPE, description=__doc__))
