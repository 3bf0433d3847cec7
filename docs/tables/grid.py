"""Make the tables that docs/tables/tables.toml declares: navigators by errors, trips and runs.

    python docs/tables/grid.py earth known --out docs/results  # writes earth.md, earth.csv.gz, ...
    python docs/tables/grid.py earth --navigators mine.onnx    # the same table of other navigators
    python docs/tables/grid.py earth --trips 200               # faster

Without --out, tables are printed. Navigators are given the accuracy of their sensors. Tables of trained agents read
the run folders that they name; `make tables` trains what is missing.
"""

from __future__ import annotations

import itertools
import shutil
import sys
import tempfile
import tomllib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from magrl.evaluation import Sheet
from magrl.evaluation.tables import markdown_table
from magrl.evaluation.tracks import COLUMNS, episode_table, write_episodes
from magrl.files import check_writable, read_document, read_text, write_text
from magrl.jobs import Backend, mapped
from magrl.navigators.names import check_distinct
from magrl.training import UsageError, command

import tyro
from pandas import read_csv

sys.path.insert(0, str(Path(__file__).parents[2] / "recipes"))
from flights import ABOUT, MEASURES, Flights, Measures, Spec, Table, cell, names, paired_difference, runs_of, titles_of

from evaluate import Config, evaluate

RECIPE = "grid.py"
FILE, RUNS = Path(__file__).parent / "tables.toml", Path("runs")


def flights(
    navigators: Sequence[Spec],
    *,
    against: Sequence[Sequence[int]] = (),
    measures: Sequence[str] = MEASURES,
    jobs: int = 1,
    backend: Backend = "loky",
    address: str | None = None,
    device: str = "cpu",
    **options: Any,
) -> Table:
    """Return a row for each navigator, and a column for each level of noise, or each of some conditions.

    A cell has the ``measures``; arrivals of vehicles that declare have intervals, clustered by region. The last rows
    are differences between two navigators, whose numbers from 0 on are a pair of ``against``: of SPL where cells have
    it, of correct arrivals otherwise. The other options are those of :meth:`Flights.of`.
    """
    made, rows, shares, tables = Flights.of(**options), [], {}, []
    share, measure = ("spl", "SPL") if "spl" in measures else ("success", "correct arrivals")
    region = made.scenario.trips.region
    known = [names(navigator, made.sheet) for navigator in navigators]
    titles = titles_of(ABOUT, known)
    pairs = list(itertools.product(navigators, made.errors))
    cells = iter(list(mapped(partial(episodes_of, options, device), pairs, jobs, backend, address)))
    for name, about_it in zip(titles, known, strict=True):
        episodes = {level: next(cells) for level in made.errors}
        shares[name] = [runs[0][share].double() for runs in episodes.values()]
        clusters = region if "false_arrival_rate" in measures else None
        rows.append([*about_it, *(cell(runs, measures, clusters) for runs in episodes.values())])
        for level, runs in episodes.items():
            about = {"navigator": name, "level": level, "seed": made.seed}
            tables += [episode_table(run, region, run=number, **about) for number, run in enumerate(runs)]
    for first, other in ([titles[row] for row in pair] for pair in against if max(pair) < len(titles)):
        differences = (paired_difference(*pair, region) for pair in zip(shares[first], shares[other], strict=True))
        rows.append([f"{first} − {other}, {measure}", *["—"] * (len(ABOUT) - 1), *differences])
    return Table(markdown_table([*ABOUT, *made.errors], rows), tables)


def episodes_of(options: Mapping[str, Any], device: str, chosen: tuple[Spec, str]) -> list[Measures]:
    """Return the episodes of a navigator at one level of errors, once for each run."""
    (navigator, level), made = chosen, Flights.of(**options)
    return made.episodes(navigator, made.errors[level], device)


def evaluation(navigators: Sequence[str], *, folder: Path, **options: Any) -> Table:
    """Return the table of recipes/evaluate.py, whose results are in a folder, which is replaced."""
    shutil.rmtree(folder, ignore_errors=True)
    every = tuple(run for navigator in navigators for run in runs_of(navigator))
    evaluate(Config(navigators=every, out=folder, sheet=Config.sheet.taking(options), **options))
    level = ", ".join(f"{std:g}" for std in read_document(folder / "settings.json")["errors"])
    episodes = read_csv(folder / "episodes.csv").rename(columns={"navigation_error_km": "final_distance_km"})
    added = {"track": "", "level": level, "region": 0, "seed": 0, "false_arrival": False}
    return Table(read_text(folder / "table.md"), [episodes.assign(**added)[list(COLUMNS)]])


KINDS: Mapping[str, Callable[..., Table]] = {"flights": flights, "evaluation": evaluation}
"""Function of each kind of table; its arguments are the options in the file."""


def declared(file: Path = FILE) -> dict[str, dict[str, Any]]:
    """Return the kind and the options of each table in a file."""
    return tomllib.loads(read_text(file))


def make(
    tables: tyro.conf.Positional[tuple[str, ...]] = (),
    *,
    navigators: tuple[str, ...] | None = None,
    trips: int | None = None,
    confidence: float | None = None,
    jobs: int | None = None,
    backend: Backend | None = None,
    address: str | None = None,
    device: str | None = None,
    out: Path | None = None,
) -> None:
    """Make tables.

    Args:
        tables: Names of tables in tables.toml; all by default.
        navigators: Navigators, as in recipes/evaluate.py; by default from tables.toml.
        trips: Number of trips; by default from tables.toml.
        confidence: Minimum probability at which vehicles declare their arrival; by default from tables.toml.
        jobs: Processes that fly, with one thread each; of tables of the kind flights.
        backend: Where they are: loky on this machine, ray on a cluster.
        address: Cluster of Ray, auto or HOST:PORT; by default one is started on this machine.
        device: Device of the flights: cpu, cuda, cuda:0, ...
        out: Folder of the tables and their episodes, which are replaced; by default tables are printed.

    Raises:
        UsageError: for a table, a navigator or an option that is wrong, or a run that is missing.
    """
    specs, changes = declared(), {"navigators": navigators, "trips": trips, "confidence": confidence}
    changes |= {"jobs": jobs, "backend": backend, "address": address, "device": device}
    changes = {key: value for key, value in changes.items() if value is not None}
    if unknown := [name for name in tables if name not in specs]:
        raise UsageError(f"{FILE} declares no table {', '.join(unknown)}: choose from {', '.join(specs)}")
    for name in tables or specs:
        try:
            check_distinct([run for navigator in navigators or () for run in runs_of(navigator)])
            with tempfile.TemporaryDirectory() as folder:  # a table that is changed replaces no results
                made = table(**specs[name] | changes, folder=(Path(folder) if changes else RUNS) / name)
        except (ValueError, OSError, TypeError) as error:
            raise UsageError(f"{name}: {error}") from error
        if out is None:
            print(made.text)
            continue
        check_writable(out / f"{name}.md")
        write_text(out / f"{name}.md", made.text.rstrip() + "\n")
        track = name if Sheet.model_fields.keys() & specs[name] else specs[name].get("track", name)
        write_episodes(out / f"{name}.csv.gz", [episodes.assign(track=track) for episodes in made.episodes])


def table(kind: str, *, folder: Path, **options: Any) -> Table:
    """Return a table of a kind; results of an evaluation are in a folder."""
    return KINDS[kind](**options, **({"folder": folder} if kind == "evaluation" else {}))


if __name__ == "__main__":
    command(RECIPE, lambda: tyro.cli(make, prog=RECIPE, description=__doc__))
