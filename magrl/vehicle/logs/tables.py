"""Logs that are tables of text: CSV files and the records of observatories."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from pandas import DataFrame, Series

from magrl.checks import short
from magrl.files import numbers_of, read_table, read_text
from magrl.vehicle.logs.samples import ATTITUDE, AXES, Recording, times_of
from magrl.vehicle.logs.units import column_of
from magrl.vehicle.logs.vectors import FRAMES

_NUMBER = re.compile(r"[-+]?[\d.]+(?:[eE][-+]?\d+)?")


def read_csv(path: Path, frame: str = "FRD") -> Recording:
    """Read a CSV file with a header: see :data:`~magrl.vehicle.logs.units.COLUMNS` for names and units.

    Three columns without a header are three axes, and their times row numbers. Times are numbers or
    ISO 8601 texts. Blank cells do not count; other columns are ignored.
    """
    lines = read_text(path).strip("\n").split("\n")
    if len(cells := re.split(r"[\s,;]+", lines[0].strip())) == 3 and all(map(_NUMBER.fullmatch, cells)):
        rows = (re.sub(r"[\s,;]+", ",", line.strip()) for line in lines)
        lines = ["time,x,y,z", *(f"{number},{row}" for number, row in enumerate(rows))]
    comma = max(",;\t", key=lines[0].count)
    raw = read_table("\n".join(lines), comma)
    cut = lines[-1].count(comma) < lines[0].count(comma)
    raw = raw[:-1] if cut else raw
    headers, wrong, others = _headers(raw)
    try:
        header, unit = headers.pop("time")
        time, notes = times_of(raw[header], unit)
    except (KeyError, ValueError) as error:
        missing = f"no column is the time, among {_listed(raw)}: name it time, or time_ms"
        raise ValueError("; ".join([*wrong, missing if isinstance(error, KeyError) else str(error)])) from error
    notes += ["the last row is not complete, and is left out: the log may be truncated"] if cut else []
    notes += [f"columns that are not read: {_listed(others)}"] if others else []
    values = {name: unit * numbers_of(raw[header], wrong) for name, (header, unit) in headers.items()}
    valid = {name: np.isfinite(time) & np.isfinite(series) for name, series in values.items()}
    axes = [valid[name] for name in AXES if name in valid]
    for name, sign in zip(AXES, FRAMES[frame], strict=True):
        if name in valid:
            values[name], valid[name] = sign * values[name], np.all(axes, axis=0)
    heading = headers.get("heading", ("", 1))[0].lower()
    north = "true" if "true" in heading else "magnetic" if "mag" in heading else None
    streams = {name: (time[valid[name]], series[valid[name]]) for name, series in values.items()}
    return Recording(streams, f"CSV, {len(raw)} rows", north, notes, wrong)


def _headers(raw: DataFrame) -> tuple[dict[str, tuple[str, float]], list[str], list[str]]:
    """Return header and unit of each column that is known, what is wrong with headers, and those that are not known."""
    headers: dict[str, tuple[str, float]] = {}
    wrong, others = list[str](), list[str]()
    for header in filter(None, raw):
        try:
            column = column_of(header)
        except ValueError as error:
            wrong.append(str(error))
            continue
        if column is None:
            others.append(header)
        elif column[0] in headers:
            both = f"{short(headers[column[0]][0])} and {short(header)}"
            wrong.append(f"{both} are both the {column[0]}: keep one of them")
        else:
            headers[column[0]] = header, column[1]
    return headers, wrong, others


def _listed(names: Iterable[str]) -> str:
    return short(", ".join(names), 300).strip("'")


def read_iaga(path: Path) -> Recording:
    """Read the record of an observatory (IAGA-2002) as that of a fixed vehicle with axes north, east, down.

    Rows without X, Y, Z or H, D, Z are left out. The attitude is zero; the header has the position and the altitude.
    """
    head, _, body = path.read_text(errors="replace").partition("\nDATE ")
    pairs = [line.strip(" |").partition("  ") for line in head.splitlines()]
    station = {name: value.strip() for name, _, value in pairs}
    header, _, rows = body.partition("\n")
    letters = [name[-1] for name in header.strip("| ").split()[2:]]
    if not ({*"XYZ"} <= {*letters} or {*"HDZ"} <= {*letters}):
        raise ValueError(f"its components are {_listed(letters)}: a record of X, Y, Z or of H, D, Z is needed")
    table = read_table("\n".join([" ".join(["date", "time", "day", *letters]), rows]), " ")
    wrong: list[str] = []
    known = {name: numbers_of(table[name], wrong) for name in letters}
    components = DataFrame(known).where(lambda values: values < _IAGA_MISSING)
    if "X" not in components:
        angle = np.radians(components["D"] / 60)
        components = components.assign(X=components["H"] * np.cos(angle), Y=components["H"] * np.sin(angle))
    whole = components[[*"XYZ"]].notna().all(axis=1)
    time, notes = times_of((table["date"].astype(str) + "T" + table["time"].astype(str) + "Z").rename("time"))
    columns = dict(zip(AXES, components.loc[whole, [*"XYZ"]].to_numpy().T, strict=True))
    for key, (name, unit) in _STATION.items():
        if key in station:
            columns[name] = unit * numbers_of(Series(station[key], name=key), wrong)
    if "variation" in station.get("Data Type", "").lower():
        notes.append("the data are variations without the baselines of the observatory: they are not the whole field")
    columns |= dict.fromkeys(ATTITUDE, np.zeros(1))
    streams = {name: (time[whole], np.zeros(whole.sum()) + values) for name, values in columns.items()}
    return Recording(streams, f"IAGA-2002: {station.get('Station Name', path.stem)}", "true", notes, wrong)


_IAGA_MISSING = 88888.0  # not recorded; 99999 is missing
_STATION = {
    "Geodetic Latitude": ("latitude", 1.0),
    "Geodetic Longitude": ("longitude", 1.0),
    "Elevation": ("altitude", 1e-3),
}
"""Fields of the header of IAGA-2002: column, and its unit."""
