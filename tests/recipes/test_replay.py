"""The example that replays a table: what it says of right ones and of wrong ones."""

import re
from itertools import pairwise
from pathlib import Path

import pandas as pd
import pytest
from support.recipes import ROOT, load

LOG = ROOT / "docs/examples/log.csv"
PLACES = {"latitude": "longitude", "longitude": "latitude"}


@pytest.fixture
def replayed(tmp_path: Path, monkeypatch, capsys):
    """Return a function that replays a changed table, and returns what is printed."""
    monkeypatch.chdir(tmp_path)

    def run(change, **options) -> str:
        change(pd.read_csv(LOG)).to_csv("table.csv", index=False)
        load("docs/examples/replay").replay("table.csv", "2025-01-01", **options)
        return capsys.readouterr().out

    return run


def test_the_ship_arrives_and_its_picture_is_drawn(replayed, tmp_path: Path) -> None:
    lines = replayed(lambda table: table).splitlines()
    assert [line.partition(":")[0] for line in lines[:-1]] == [f"row {number}" for number in range(25)]
    assert lines[-2].endswith("stop arrived")
    assert re.match(r"fit 0\.[1-9].*within 25 km", lines[-1])
    assert (tmp_path / "replay.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda table: table.assign(I=-table.I), "25 of 25 readings do not fit IGRF: it fits with -I"),
        (lambda table: table.assign(B_H=table.B_H / 1000), "B_H looks like microtesla"),
        (lambda table: table.rename(columns=PLACES), "latitude and longitude are swapped"),
        (lambda table: table.assign(distance=1000 * table.distance), "distance in row 1 must be at most 100, got 2"),
        (lambda table: table.replace({"D": {table.D[3]: 99999}}), "D in row 3 must be at most 180, got 99999"),
        (lambda table: table.replace({"heading": {290.0: None}}), "heading in row 0 must be at most 360, got nan"),
        (lambda table: table.rename(columns={"distance": "dist_miles"}), "heading, dist_miles"),
        (lambda table: table.replace({"D": {table.D[3]: "east"}}), "D in row 3 must be at most 180, got east"),
        (lambda table: table.replace({"D": {table.D[0]: None}}), "declination .* must be"),
        (lambda table: table.assign(D=60 * table.D), "D fits in minutes of arc"),
        (lambda table: table.head(1), "2 to 10000 rows"),
        (lambda table: table.loc[[0] * 20_000], "2 to 10000 rows of .*, got 10001"),
    ],
)
def test_a_wrong_table_is_refused(replayed, change, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replayed(change)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda table: table.assign(distance=table.distance / 1.852), "row 1: a distance of 10.8 km, and 20 km"),
        (lambda table: table.drop(index=5), "row 5: a distance of 20 km, and 40 km"),
        (
            lambda table: table.replace({"B_H": {table.B_H[3]: 900 + table.B_H[3]}}),
            "one reading does not fit IGRF",
        ),
    ],
)
def test_a_doubtful_row_is_named(replayed, change, line: str) -> None:
    assert line in replayed(change)


def test_further_columns_are_ignored_and_empty_cells_are_missing(replayed) -> None:
    """The vehicle goes on by dead reckoning where readings are missed."""
    whole, timed, gaps = (
        replayed(change).splitlines()
        for change in (
            lambda table: table,
            lambda table: table.assign(time="12:00"),
            lambda table: table.assign(**{name: table[name].drop([5, 6]) for name in ("D", "I")}),
        )
    )
    assert timed == whole
    assert [here == there for here, there in zip(gaps, whole, strict=True)][:6] == [True] * 5 + [False]
    assert gaps[-2].endswith("stop arrived")


def test_what_is_stated_is_taken(replayed) -> None:
    """Each error that is added makes the estimated ones larger, in the sum over the rows [km]."""
    stated, sums = {}, []
    for option in ({}, {"drift": 0.1}, {"start_km": 5.0}, {"bias": (0.3, 0.05, 20.0)}):
        stated |= option
        lines = replayed(lambda table: table, **stated)
        sums.append(sum(float(number) for number in re.findall(r"error_km ([\d.]+)", lines)))
    assert all(after > before + 5 for before, after in pairwise(sums)), sums
