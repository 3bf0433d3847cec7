"""Evaluate the field at the points of a table: D, I, B_H, the vector, the total intensity and the gradients.

    python -m magrl.field points.csv                                        # writes points_field.csv
    python -m magrl.field points.csv --altitude height --unit m --date 2026-07-01 --out field.csv

The table has a row for each point. Its columns are latitude and longitude [deg], altitude or depth [km], and date (ISO
text or decimal year), or lat, lon, time, alt, and with a unit altitude_m, alt_km, depth_m. Other names are given by
options; an option that is not a column is the value of all points. All columns of the table are kept, and these are
added:

    D_deg, I_deg, B_H_nT       declination, inclination, horizontal intensity
    X_nT, Y_nT, Z_nT, F_nT     north, east and down components, total intensity
    dD_north_deg_per_km, ...   horizontal gradients of D, I and B_H, northward and eastward
"""

from __future__ import annotations

import argparse
import contextlib
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from magrl.checks import command
from magrl.field.elements import NAMES, elements_gradient, seven_elements
from magrl.field.igrf import IGRF, parse_date
from magrl.files import check_writable, numbers_of, read_table, read_text

if TYPE_CHECKING:
    from pandas import DataFrame, Series

UNITS_KM = {"km": 1.0, "m": 0.001}
COLUMNS = {
    "latitude": ("latitude", "lat"),
    "longitude": ("longitude", "lon", "long", "lng"),
    "altitude": ("altitude", "alt", *(f"{name}_{unit}" for name in ("altitude", "alt") for unit in UNITS_KM)),
    "depth": ("depth", *(f"depth_{unit}" for unit in UNITS_KM)),
    "date": ("date", "time", "datetime"),
}
"""Names by which a column is found, in lower case."""
_DIGITS = {"deg": 6, "nT": 4, "km": 9}


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    arguments = argparse.ArgumentParser(
        prog="python -m magrl.field", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    arguments.add_argument("points", type=Path, help="table of the points: .csv")
    arguments.add_argument("--out", type=Path, help="result: .csv; by default beside the points, with _field")
    for name, meaning in (("latitude", "geodetic latitude [deg]"), ("longitude", "longitude [deg]")):
        arguments.add_argument(f"--{name}", help=f"column of the {meaning}, or a number; default {_usual(name)}")
    height = arguments.add_mutually_exclusive_group()
    height.add_argument(
        "--altitude", help="column of the altitude above the ellipsoid, or a number; default altitude, alt"
    )
    height.add_argument("--depth", help="column of the depth below the ellipsoid, or a number; default depth")
    arguments.add_argument("--unit", choices=UNITS_KM, help="unit of altitude or depth; default that of alt_m, or km")
    arguments.add_argument("--date", help=f"column of the date, or a date; default {_usual('date')}")
    arguments.add_argument(
        "--generation", type=int, choices=(13, 14), default=14, help="generation of IGRF; default 14"
    )
    return arguments


def _usual(name: str) -> str:
    return ", ".join(COLUMNS[name])


def field_of_points(table: DataFrame, options: argparse.Namespace) -> DataFrame:
    """Return a table with the field at each of its points.

    Args:
        table: columns of text or numbers.
        options: of :func:`parser`.

    Raises:
        ValueError: naming the column, the row and the value, or the columns that there are.

    Example:
        >>> import pandas
        >>> place = pandas.DataFrame({"latitude": [-2.0], "longitude": [162.0], "depth": [1.0], "date": ["2022-01-01"]})
        >>> field_of_points(place, parser().parse_args(["points.csv"]))[["D_deg", "B_H_nT"]].round(1).values.tolist()
        [[8.0, 35480.8]]
    """
    from pandas import DataFrame

    names = _names(table, options)
    cells = DataFrame({name: table.get(text, text) for name, text in names.items()}, table.index)
    lacking = (cells.isna() | (cells == "")).any(axis=1)
    points = cells[~lacking]
    if not len(points):
        raise ValueError("no row has a position, an altitude and a date")
    if lacking.any():
        count, first = int(lacking.sum()), int(lacking.argmax()) + 1
        _warn(f"{count} rows, first row {first}, lack a position, an altitude or a date: their field is blank")
    place = (*_place(points), _altitude_km(points, names, options.unit))
    field = IGRF(_dates(points["date"]), options.generation)
    value, gradient = field.value_and_gradient(*map(torch.from_numpy, place))
    gradient[np.abs(place[0]) == 90, :, 1] = math.nan  # at a pole of the Earth no direction is east
    columns = DataFrame(_columns(value, gradient), index=points.index)
    if taken := sorted({*columns} & {*table.columns}):
        raise ValueError(f"the table has columns {', '.join(taken)} already: rename them, or remove them")
    return table.join(columns)


def _warn(text: str) -> None:
    print(f"python -m magrl.field: {text}", file=sys.stderr)


def _columns(value: torch.Tensor, gradient: torch.Tensor) -> dict[str, NDArray[np.float64]]:
    """Return the columns of the result, from vectors ``(P, 3)`` and their gradients ``(P, 3, 2)``."""
    elements = seven_elements(value)
    names = {"D": "deg", "I": "deg", "B_H": "nT"}
    columns = {f"{name}_{unit}": getattr(elements, name) for name, unit in names.items()}
    columns |= {"X_nT": elements.B_x, "Y_nT": elements.B_y, "Z_nT": elements.B_z, "F_nT": elements.B_F}
    slopes = elements_gradient(value, gradient)
    for row, name in enumerate(NAMES):
        for column, way in enumerate(("north", "east")):
            columns[f"d{name}_{way}_{names[name]}_per_km"] = slopes[:, row, column]
    return {name: values.numpy().round(_DIGITS[name.rpartition("_")[2]]) for name, values in columns.items()}


def _name(table: DataFrame, name: str, given: str | None) -> str:
    """Return the column of a quantity: the given one, that of its name, or the one that has another usual name."""
    usual = [column for column in table.columns if column.lower() in COLUMNS[name]]
    if given is not None or name in usual or not usual:
        return given or name
    if len(usual) > 1:
        raise ValueError(f"the table has columns {' and '.join(usual)}: choose with --{name}")
    return usual[0]


def _names(table: DataFrame, options: argparse.Namespace) -> dict[str, str]:
    """Return the column of each quantity, or its value in all rows."""
    names = {name: _name(table, name, getattr(options, name)) for name in COLUMNS}
    if names["latitude"].lower() in COLUMNS["longitude"] or names["longitude"].lower() in COLUMNS["latitude"]:
        raise ValueError(f"--latitude {names['latitude']} --longitude {names['longitude']}: they are swapped")
    for name in ("latitude", "longitude", "date"):
        if names[name] not in table.columns and not getattr(options, name):
            raise ValueError(f"no column is {name!r}: choose among {_listed(table)} with --{name}")
    given = [name for name in _SIGNS if getattr(options, name) is not None]
    heights = given or [name for name in _SIGNS if names[name] in table.columns]
    if len(heights) != 1:
        which = "both columns altitude and depth" if heights else f"neither altitude nor depth among {_listed(table)}"
        raise ValueError(f"the table has {which}: choose with --altitude or --depth, such as --altitude 0")
    return {name: column for name, column in names.items() if name not in _SIGNS or name in heights}


def _place(points: DataFrame) -> list[NDArray[np.float64]]:
    """Return latitudes and longitudes [deg] ``(P,)``."""
    hint = "degrees: are latitude and longitude swapped?"
    place = [_numbers(points["latitude"], -90, 90, hint), _numbers(points["longitude"], -360, 360, "degrees")]
    if all((abs(values) <= most).all() for values, most in zip(place, (math.pi / 2, math.pi), strict=True)):
        _warn("all latitudes are within pi/2 and all longitudes within pi: are they radians? Degrees are expected")
    return place


def _altitude_km(points: DataFrame, names: Mapping[str, str], unit: str | None) -> NDArray[np.float64]:
    """Return altitudes above the ellipsoid [km] ``(P,)``."""
    name = next(name for name in _SIGNS if name in names)
    suffix = names[name].lower().rpartition("_")[2]
    unit = unit or (suffix if suffix in UNITS_KM else "km")
    low, high = sorted(_SIGNS[name] * limit / UNITS_KM[unit] for limit in IGRF.altitude_range_km)
    hint = ": is it in meters? Then add --unit m" if unit == "km" else ""
    return _SIGNS[name] * UNITS_KM[unit] * _numbers(points[name], low, high, f"{unit}{hint}")


_SIGNS = {"altitude": 1.0, "depth": -1.0}


def _numbers(column: Series, low: float, high: float, unit: str) -> NDArray[np.float64]:
    """Return the numbers of a column ``(P,)``; raise unless all are from ``low`` to ``high``."""
    wrong: list[str] = []
    values = numbers_of(column, wrong)
    outside = (values < low) | (values > high)
    if outside.any():
        row, value = column.index[outside.argmax()], values[outside.argmax()]
        wrong.append(f"row {row + 1}, {column.name}: {value:g} is not from {low:g} to {high:g} {unit}")
    if wrong:
        raise ValueError(wrong[0])
    return values


def _dates(column: Series) -> NDArray[np.datetime64]:
    """Return the dates of a column ``(P,)``, from texts that are perhaps decimal years."""
    dates: dict[Any, np.datetime64] = {}
    for row, cell in column.drop_duplicates().items():
        try:
            dates[cell] = np.datetime64(parse_date(_number_or_text(cell)), "us")
        except ValueError as error:
            raise ValueError(f"row {row + 1}, date: {error}") from None
    return column.map(dates).to_numpy("M8[us]")


def _number_or_text(cell: Any) -> Any:
    with contextlib.suppress(ValueError):
        return float(cell)
    return cell


def _listed(table: DataFrame) -> str:
    return ", ".join(table.columns)


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line, evaluate the field and write the table."""
    command("python -m magrl.field", lambda: _main(parser().parse_args(args)), ValueError)


def _main(options: argparse.Namespace) -> None:
    out = options.out or options.points.with_name(f"{options.points.stem}_field.csv")
    if out.suffix != ".csv" or out.resolve() == options.points.resolve():
        raise ValueError(f"--out must be another file that ends in .csv, got {str(out)!r}")
    try:
        points = read_table(read_text(options.points), dtype=str, keep_default_na=False)  # which stay as they were
    except (ValueError, OSError) as error:
        raise ValueError(f"{options.points} is not a table: {error}") from error
    table = field_of_points(points, options)
    check_writable(out)
    table.to_csv(out, index=False)
    print(f"The field at {len(table)} points is in {out}")


if __name__ == "__main__":
    main()
