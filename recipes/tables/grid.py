"""Make the tables that recipes/tables/tables.toml declares: navigators by errors, tasks, dates and seeds.

    python recipes/tables/grid.py earth conditions --out docs/results        # writes earth.md and conditions.md
    python recipes/tables/grid.py earth --navigators policy:MINE=mine.safetensors  # the same table of other navigators
    python recipes/tables/grid.py earth --tasks 200                          # faster

Without --out, tables are printed. Navigators are given the data sheets of their sensors. A cell holds the success rate
(SR) and the success weighted by path length (SPL) in percent, and the mean number of steps of successful episodes;
beyond 500 km, the share of episodes that end within 25 km of the destination comes first. Tables of trained agents read
the run folders that they name; `make tables` trains what is missing.
"""

from __future__ import annotations

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # spinning threads slow each other down; read when torch is imported

import contextlib
import inspect
import itertools
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomli
import torch
import tyro
from tqdm import tqdm

from magrl import paper
from magrl.envs import GeomagneticNavEnv, Region, Scenario
from magrl.evaluation import summarize
from magrl.evaluation.navigators import check_distinct
from magrl.evaluation.runs import NO_NOISE
from magrl.evaluation.tables import markdown_table
from magrl.files import check_writable
from magrl.training import UsageError, command, parse

sys.path.insert(0, str(Path(__file__).parent))
import declarations
import globe
import trainings
from flights import (
    DRIFT_KM,
    FAR_KM,
    Spec,
    columns_of,
    earth_env,
    estimate_within,
    flown,
    names,
    number,
    paired_difference,
)

RECIPE = "grid.py"
DISTANCES = ("final_distance_km_median", "final_distance_km_p90")
BOUND = ("best estimate at the destination, by the data sheet", "the gradient")
FILE, RESULTS = Path(__file__).parent / "tables.toml", Path("docs/results")
EAST_OF_THE_PAPER = Region((-10, 0), (175, 185))


@dataclass(frozen=True)
class Config:
    """Tables to make."""

    tables: tyro.conf.Positional[tuple[str, ...]] = ()
    """Names of tables in the file; all by default."""
    navigators: tuple[str, ...] | None = None
    """Navigators in place of those of the table, as in recipes/evaluate.py."""
    tasks: int | None = None
    """Number of tasks in place of that of the table."""
    file: Path = FILE
    """File that declares the tables."""
    out: Path | None = None
    """Folder of the tables, which are replaced; by default they are printed."""


def earth(
    navigators: Sequence[Spec],
    *,
    conditions: Sequence[str] = (),
    tasks: int = 4000,
    dates: Sequence[str] = ("2025-01-01",),
    distance_km: Sequence[float] = paper.DISTANCE_KM,
    max_steps: int = 50,
    crust: bool = False,
    planets: bool = False,
    within_km: float | None = None,
    arrivals: Sequence[str | float] = ("objective",),
    known_start: Sequence[float] | None = None,
    differences: Sequence[tuple[Spec, Spec]] = (),
) -> str:
    """Return a row for each date, navigator and arrival; a column for each level of noise, or each of some conditions.

    An arrival is a rule of the environment, or the least confidence at which vehicles declare that they are
    ``within_km`` of the destination. A table of declared arrivals ends with the bound of :func:`estimate_within`. With
    ``known_start``, the vehicles know the elements at their start. Each of the ``differences`` of two
    navigators, by the last of the arrivals, is another row.
    """
    columns = columns_of(conditions)
    options: dict[str, Any] = {"reach_km": DRIFT_KM, "drift_km": DRIFT_KM} if conditions else {}
    options |= {"arrival_radius_km": within_km} if within_km else {}
    options |= {"crust": crust, "planets": planets}
    measures = ["success_rate_within_25km"] * (distance_km[1] > FAR_KM) + ["success_rate", "spl", "steps"]
    measures = ["success_rate", "spl", "false_arrival_rate", *DISTANCES] if within_km else measures
    one_run = not conditions and not within_km
    rows, spl = [], {}
    for date, navigator, arrival in tqdm(list(itertools.product(dates, navigators, arrivals)), unit="row"):
        rule, least = (arrival, 0.0) if isinstance(arrival, str) else ("declared", arrival)
        base = earth_env(tasks, distance_km, date, max_steps=max_steps, arrival=rule, **options)
        episodes = [flown(navigator, base, errors, least, known_start) for errors in columns.values()]
        spl[names(navigator)[0]] = [found["spl"] for found in episodes]
        summaries = [summarize(found) for found in episodes]
        cells = [" / ".join(number(summary.get(name, 0.0)) for name in measures) for summary in summaries]
        first = [*[date] * (len(dates) > 1), *names(navigator), *[arrival_name(arrival)] * (len(arrivals) > 1)]
        rows.append([*first, *[1] * one_run, *cells])
    if within_km:
        shares = (estimate_within(within_km, base, errors, known_start) for errors in columns.values())
        rows.append([*BOUND, *["—"] * (len(arrivals) > 1), *(f"{share:.1f}" for share in shares)])
    for two in ([names(navigator)[0] for navigator in pair] for pair in differences):
        if set(two) <= spl.keys():
            pairs = zip(*(spl[name] for name in two), strict=True)
            cells = [paired_difference(*pair, base.scenario.tasks.region) for pair in pairs]
            rule = [arrival_name(arrivals[-1])] * (len(arrivals) > 1)
            rows.append([f"{' − '.join(two)}, SPL", "—", *rule, *["—"] * one_run, *cells])
    head = [*["date"] * (len(dates) > 1), "navigator", "needs", *["arrival"] * (len(arrivals) > 1), *["runs"] * one_run]
    return markdown_table([*head, *columns], rows)


def arrival_name(arrival: str | float) -> str:
    """Return a rule of arrival, or the least confidence of declared ones, as text."""
    if isinstance(arrival, str):
        return "told"
    return f"declared at {arrival:g}" if arrival else "declared"


def random_boxes(count: int, seed: int) -> list[Scenario]:
    """Return scenarios in random boxes, uniform over the sphere and rounded to a degree, that a vehicle can use.

    The boxes are 10 degrees wide and high, with latitudes up to 60 degrees. A box that a scenario refuses (a weak
    horizontal field, a declination that jumps) is drawn again.
    """
    draw = torch.Generator().manual_seed(seed)
    highest = torch.sin(torch.deg2rad(torch.tensor(55.0, dtype=torch.float64)))
    found: list[Scenario] = []
    while len(found) < count:
        height, turn = torch.rand(2, generator=draw, dtype=torch.float64).tolist()
        middle = torch.rad2deg(torch.asin((2 * height - 1) * highest)).item()
        south, west = round(middle - 5), round(360 * turn) - 180
        scenario = Scenario(region=Region((south, south + 10), (west, west + 10)), objective_floors=None)
        with contextlib.suppress(ValueError):
            scenario.build_field()
            found.append(scenario)
    return found


def place(scenario: Scenario) -> str:
    """Return a box as text, such as ``10°S to 0°, 175°E to 185°E``."""
    (south, _), (west, _) = scenario.region[0].latitude, scenario.region[0].longitude
    west = (west + 180) % 360 - 180
    edges = [f"{abs(x):g}°" + ("S" if x < 0 else "N" if x > 0 else "") for x in (south, south + 10)]
    edges += [f"{abs(x):g}°" + ("W" if x < 0 else "E" if x > 0 else "") for x in (west, west + 10)]
    return "{} to {}, {} to {}".format(*edges)


def boxes(navigators: Sequence[Spec], *, boxes: int = 24, tasks: int = 500, seed: int = 1) -> str:
    """Return SR and SPL of navigators in random boxes, and in the box east of the paper's, without floors of Eq. 2-6.

    One with options estimates its way from two elements alone.
    """
    scenarios = [*random_boxes(boxes, seed), Scenario(region=EAST_OF_THE_PAPER, objective_floors=None)]
    measured = []
    for scenario in tqdm(scenarios, unit="box"):
        base = GeomagneticNavEnv(scenario.with_tasks(scenario.random_tasks(tasks, seed)), num_envs=tasks, seed=0)
        summaries = [summarize(flown(navigator, base, NO_NOISE)) for navigator in navigators]
        measured.append([(summary["success_rate"], summary["spl"]) for summary in summaries])
    random = torch.tensor(measured[:-1], dtype=torch.float64)  # (boxes, navigators, measures)
    values = [*measured[:-1], random.mean(0).tolist(), random.amin(0).tolist(), measured[-1]]
    first = [*map(place, scenarios[:-1]), "**mean**", "**lowest**", place(scenarios[-1])]
    rows = [[name, *(f"{rate:.1f} / {spl:.1f}" for rate, spl in row)] for name, row in zip(first, values, strict=True)]
    heads = [navigator if isinstance(navigator, str) else f"{navigator['name']}, D and I" for navigator in navigators]
    return markdown_table(["box", *(f"{head}, SR / SPL" for head in heads)], rows)


def rows_of(of: Sequence[str], navigators: Sequence[Spec], *, numbers: int | None = None) -> str:
    """Return the last rows of some navigators in other tables in docs/results, with the first numbers of each cell."""
    lines = [line for name in of for line in (RESULTS / f"{name}.md").read_text().splitlines()]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    by_label = {row[0]: [" / ".join(cell.split(" / ")[:numbers]) for cell in row] for row in cells}
    return markdown_table(by_label["navigator"], [by_label[names(navigator)[0]] for navigator in navigators])


KINDS: Mapping[str, Callable[..., str]] = {
    "earth": earth,
    "boxes": boxes,
    "rows": rows_of,
    "globe": globe.globe,
    "reliability": declarations.reliability,
    "decisions": declarations.decisions,
    "data_sheets": declarations.data_sheets,
    "evaluation": trainings.evaluation,
    "short": trainings.short,
    "noise_levels": trainings.noise_levels,
    "results": trainings.results,
    "learning": trainings.learning,
    "curves": trainings.curves,
}
"""Function of each kind of table; its arguments are the options in the file."""


def declared_tables(file: Path = FILE) -> dict[str, dict[str, Any]]:
    """Return the kind and the options of each table in a file."""
    return tomli.loads(file.read_text())


def make(config: Config) -> None:
    """Make the tables.

    Raises:
        UsageError: for a table, a navigator or an option that is wrong, or a run that is missing.
    """
    known = declared_tables(config.file)
    changes = {"navigators": config.navigators, "tasks": config.tasks}
    given = {key: value for key, value in changes.items() if value is not None}
    if unknown := [name for name in config.tables if name not in known]:
        raise UsageError(f"{config.file} declares no table {', '.join(unknown)}: choose from {', '.join(known)}")
    for name in config.tables or known:
        try:
            with tempfile.TemporaryDirectory() as folder:  # a table that is changed replaces no results
                own = {"folder": f"{folder}/{name}"} if given and "folder" in known[name] else {}
                text = table(**known[name] | given | own)
        except (ValueError, OSError, TypeError) as error:
            raise UsageError(f"{name}: {error}") from error
        if config.out is None:
            print(text)
        else:
            check_writable(config.out / f"{name}.md")
            (config.out / f"{name}.md").write_text(text.rstrip() + "\n")


def table(kind: str, **options: Any) -> str:
    """Return a table of a kind.

    Raises:
        TypeError: for an option that the kind does not have.
        ValueError: for an unknown kind, or a navigator that is given twice.
    """
    if kind not in KINDS:
        raise ValueError(f"unknown kind {kind!r}: choose from {', '.join(KINDS)}")
    inspect.signature(KINDS[kind]).bind(**options)
    check_distinct([text for text in options.get("navigators", ()) if isinstance(text, str)])
    return KINDS[kind](**options)


if __name__ == "__main__":
    command(RECIPE, lambda: make(parse(Config, RECIPE, __doc__)))
