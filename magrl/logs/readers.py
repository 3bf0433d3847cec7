"""Read the log of a vehicle: CSV files, and the formats of autopilots, ROS and ships."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np
import pandas
from pandas import Series

from magrl.checks import check_choice, short
from magrl.logs.autopilots import read_bag, read_bin, read_nmea, read_ulg
from magrl.logs.samples import AXES, Array, Log, Recording, samples_of, times_of
from magrl.logs.units import EARTH_NT, column_of, guess_unit
from magrl.logs.vectors import FRAMES


def read_log(*paths: Path | str, frame: str = "FRD") -> Log:
    """Read the log of a vehicle, which may be in several files, such as one of the magnetometer and one of the heading.

    Args:
        paths: files: ``.csv``; ``.ulg`` (PX4); ``.bin`` (ArduPilot); ``.bag`` (ROS 1), or a folder (ROS 2); ``.nmea``.
            Columns of later ones replace those of earlier ones; all have one clock.
        frame: axes of CSV files, one of :data:`~magrl.logs.vectors.FRAMES`; the attitude is that of FRD and NED.

    Raises:
        ValueError: naming the file and what is wrong with it, or a suffix that is not known.
        ImportError: for a package that is not installed, naming the extra.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "log.csv"
        >>> _ = path.write_text("time_s,mag_x_uT,mag_y_uT,mag_z_uT,heading_true_deg" + chr(10) + "0,15,0,48,350")
        >>> read_log(path).samples.values.tolist()
        [[0.0, 15000.0, 0.0, 48000.0, 350.0]]
    """
    check_choice(FRAMES, frame=frame)
    readers: Mapping[str, Callable[[Path], Recording]] = {
        ".csv": partial(read_csv, frame=frame),
        ".ulg": read_ulg,
        ".bin": read_bin,
        ".bag": read_bag,
        "": read_bag,
        ".nmea": read_nmea,
    }
    found = []
    for path in map(Path, paths):
        kind = "" if path.is_dir() else path.suffix.lower()
        if kind not in readers or not path.exists():
            known = ", ".join(filter(None, readers))
            raise ValueError(f"a log is a file {known} or a folder of ROS 2 that exists, got {str(path)!r}")
        try:
            found.append(readers[kind](path))
        except ImportError:
            raise
        except Exception as error:  # whatever the packages raise for a foreign or damaged file
            raise ValueError(f"cannot read {path}: {error}") from error
    samples, notes = samples_of({name: stream for each in found for name, stream in each.streams.items()})
    length = float(np.sqrt(np.square(samples[list(AXES)]).sum(axis=1)).median())
    if unit := guess_unit(length, EARTH_NT):
        notes.append(f"the total intensity is {length:g}, which looks like {unit}: name the columns mag_x_{unit}, ...")
    norths = [each.north for each in found if "heading" in each.streams]
    more = [note for each in found for note in each.notes]
    return Log(samples, "; ".join(each.source for each in found), norths[-1] if norths else None, (*more, *notes))


def read_csv(path: Path, frame: str = "FRD") -> Recording:
    """Read a CSV file with a header: see :data:`~magrl.logs.units.COLUMNS` for names and units.

    Times are numbers or ISO 8601 texts. Blank cells do not count; other columns are ignored.
    """
    raw = pandas.read_csv(path, skipinitialspace=True)
    if not len(raw):
        raise ValueError("the table has no row")
    lines = path.read_bytes().rstrip().splitlines()
    cut = lines[-1].count(b",") < lines[0].count(b",")
    raw = raw[:-1] if cut else raw
    found: dict[str, tuple[str, float]] = {}
    for header in raw:
        if named := column_of(header):
            if named[0] in found:
                raise ValueError(f"{found[named[0]][0]!r} and {header!r} are both the {named[0]}: keep one of them")
            found[named[0]] = header, named[1]
    if "time" not in found:
        raise ValueError(f"no column is the time, among {', '.join(raw)}: name it time, or time_ms")
    time, notes = times_of(raw[found["time"][0]], found["time"][1])
    values = {name: factor * _numbers(raw[header]) for name, (header, factor) in found.items() if name != "time"}
    held = {name: np.isfinite(time) & np.isfinite(each) for name, each in values.items()}
    notes += ["the last row is not complete, and is left out: the log may be truncated"] if cut else []
    axes = [held[name] for name in AXES if name in held]
    for name, sign in zip(AXES, FRAMES[frame], strict=True):
        if name in held:
            values[name], held[name] = sign * values[name], np.all(axes, axis=0)
    heading = found.get("heading", ("", 1))[0].lower()
    north = "true" if "true" in heading else "magnetic" if "mag" in heading else None
    streams = {name: (time[held[name]], each[held[name]]) for name, each in values.items()}
    return Recording(streams, f"CSV, {len(raw)} rows", north, notes)


def _numbers(column: Series) -> Array:
    """Return the numbers of a column, NaN for blank cells."""
    numbers = pandas.to_numeric(column, errors="coerce")
    bad = numbers.isna() & column.notna()
    if bad.any():
        row = int(bad.idxmax())
        raise ValueError(f"row {row + 1}, {column.name}: {short(column[row])} is not a number")
    return numbers.to_numpy(float)
