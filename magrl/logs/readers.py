"""Read the log of a vehicle: CSV files, and the formats of autopilots, ROS, ships and observatories."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas
from pandas import DataFrame, Series

from magrl.checks import check_choice, short
from magrl.logs.autopilots import read_ardupilot, read_bag, read_nmea, read_ulg
from magrl.logs.samples import ATTITUDE, AXES, Array, Log, Recording, samples_of, times_of
from magrl.logs.units import column_of, intensity_mistake
from magrl.logs.vectors import FRAMES

_NUMBER = r"[-+]?[\d.]+(?:[eE][-+]?\d+)?"


def read_log(*paths: Path | str, frame: str = "FRD", sensor: str | None = None) -> Log:
    """Read the log of a vehicle, which may be in several files, such as one of the magnetometer and one of the heading.

    Args:
        paths: files, recognized by their content: CSV, PX4 (ULog), ArduPilot (DataFlash), MAVLink (telemetry), ROS,
            NMEA 0183, observatories (IAGA-2002); or a folder of ROS 2. Columns of later ones replace those of earlier
            ones; all have one clock.
        frame: axes of CSV files, one of :data:`~magrl.logs.vectors.FRAMES`; the attitude is that of FRD and NED.
        sensor: magnetometer of those that a log of PX4, ArduPilot or ROS has; by default a healthy one that was used.

    Raises:
        ValueError: naming the file and what is wrong with it, or its unknown format.
        ImportError: for a package that is not installed, naming the extra.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "log.csv"
        >>> _ = path.write_text("time_s,mag_x_uT,mag_y_uT,mag_z_uT,heading_true_deg" + chr(10) + "0,15,0,48,350")
        >>> read_log(path).samples.values.tolist()
        [[0.0, 15000.0, 0.0, 48000.0, 350.0]]
    """
    check_choice(FRAMES, frame=frame)
    recordings = []
    for path in map(Path, paths):
        reader = _reader(path)
        options = {"frame": frame} if reader is read_csv else {"sensor": sensor}
        if reader in (read_nmea, read_iaga):
            options = {}
        try:
            recordings.append(reader(path, **options))
        except ImportError:
            raise
        except Exception as error:  # whatever the packages raise for a foreign or damaged file
            raise ValueError(f"cannot read {path}: {error}") from error
    samples, notes = samples_of({name: pair for recording in recordings for name, pair in recording.streams.items()})
    if mistake := intensity_mistake(float(np.sqrt(np.square(samples[list(AXES)]).sum(axis=1)).median())):
        notes.append(mistake)
    norths = [recording.north for recording in recordings if "heading" in recording.streams]
    more = [note for recording in recordings for note in recording.notes]
    source = "; ".join(recording.source for recording in recordings)
    return Log(samples, source, norths[-1] if norths else None, (*more, *notes))


def _reader(path: Path) -> Callable[..., Recording]:
    """Return the reader of a file or a folder."""
    if path.is_dir():
        return read_bag
    if path.exists():
        with path.open("rb") as file:
            start = file.read(4096)
        for pattern, reader in _FORMATS:
            if re.match(pattern, start, re.DOTALL):
                return reader
    raise ValueError(
        f"a log is a file of CSV, PX4, ArduPilot, MAVLink, ROS, NMEA 0183 or IAGA-2002, or a folder of ROS 2 that "
        f"exists, got {str(path)!r}"
    )


def read_csv(path: Path, frame: str = "FRD") -> Recording:
    """Read a CSV file with a header: see :data:`~magrl.logs.units.COLUMNS` for names and units.

    Three columns without a header are three axes, and their times row numbers. Times are numbers or
    ISO 8601 texts. Blank cells do not count; other columns are ignored.
    """
    lines = path.read_text().rstrip().splitlines() or [""]
    if re.fullmatch(rf"\s*{_NUMBER}(\s*[,;\s]\s*{_NUMBER}){{2}}\s*", lines[0]):
        rows = (re.sub(r"[\s,;]+", ",", line.strip()) for line in lines)
        lines = ["time,x,y,z", *(f"{number},{row}" for number, row in enumerate(rows))]
    comma = max(",;\t", key=lines[0].count)
    raw = pandas.read_csv(io.StringIO("\n".join(lines)), sep=comma, skipinitialspace=True)
    if not len(raw):
        raise ValueError("the table has no row")
    cut = lines[-1].count(comma) < lines[0].count(comma)
    raw = raw[:-1] if cut else raw
    headers = _headers(raw)
    time, notes = times_of(raw[headers["time"][0]], headers["time"][1])
    values = {name: factor * _numbers(raw[header]) for name, (header, factor) in headers.items() if name != "time"}
    valid = {name: np.isfinite(time) & np.isfinite(series) for name, series in values.items()}
    notes += ["the last row is not complete, and is left out: the log may be truncated"] if cut else []
    axes = [valid[name] for name in AXES if name in valid]
    for name, sign in zip(AXES, FRAMES[frame], strict=True):
        if name in valid:
            values[name], valid[name] = sign * values[name], np.all(axes, axis=0)
    heading = headers.get("heading", ("", 1))[0].lower()
    north = "true" if "true" in heading else "magnetic" if "mag" in heading else None
    streams = {name: (time[valid[name]], series[valid[name]]) for name, series in values.items()}
    return Recording(streams, f"CSV, {len(raw)} rows", north, notes)


def _headers(raw: DataFrame) -> dict[str, tuple[str, float]]:
    """Return the header and the unit of each column that is known; raise an error that names all that are wrong."""
    headers: dict[str, tuple[str, float]] = {}
    wrong = []
    for header in raw:
        try:
            column = column_of(header)
        except ValueError as error:
            wrong.append(str(error))
            continue
        if column and column[0] in headers:
            wrong.append(f"{headers[column[0]][0]!r} and {header!r} are both the {column[0]}: keep one of them")
        elif column:
            headers[column[0]] = header, column[1]
    if "time" not in headers:
        wrong.append(f"no column is the time, among {', '.join(raw)}: name it time, or time_ms")
    if wrong:
        raise ValueError("; ".join(wrong))
    return headers


def _numbers(column: Series) -> Array:
    """Return the numbers of a column, NaN for blank cells."""
    numbers = pandas.to_numeric(column, errors="coerce")
    bad = numbers.isna() & column.notna()
    if bad.any():
        row = int(bad.idxmax())
        raise ValueError(f"row {row + 1}, {column.name}: {short(column[row])} is not a number")
    return numbers.to_numpy(float)


def read_iaga(path: Path) -> Recording:
    """Read the record of an observatory (IAGA-2002) as that of a fixed vehicle with axes north, east, down.

    Rows without X, Y, Z or H, D, Z are left out. The attitude is zero; the header has the position and the altitude.
    """
    head, _, body = path.read_text(errors="replace").partition("\nDATE ")
    station = dict(re.findall(r"^ *(\w[\w ]*?) {2,}(\S.*?) *\|", head, re.MULTILINE))
    header, _, rows = body.partition("\n")
    letters = [name[-1] for name in header.strip("| \r").split()[2:]]
    table = pandas.read_csv(io.StringIO(rows), sep=r"\s+", names=["date", "time", "day", *letters], index_col=False)
    table[letters] = table[letters].where(table[letters] < _IAGA_MISSING)
    if {*"HDZ"} <= {*letters}:
        angle = np.radians(table["D"] / 60)
        table = table.assign(X=table["H"] * np.cos(angle), Y=table["H"] * np.sin(angle))
    elif not {*"XYZ"} <= {*letters}:
        raise ValueError(f"its components are {', '.join(letters)}: a record of X, Y, Z or of H, D, Z is needed")
    table = table.dropna(subset=[*"XYZ"]).reset_index(drop=True)
    time, notes = times_of((table["date"] + "T" + table["time"] + "Z").rename("time"))
    columns = dict(zip(AXES, (table[name] for name in "XYZ"), strict=True)) | dict.fromkeys(ATTITUDE, 0.0)
    columns |= {name: unit * float(station[key]) for key, (name, unit) in _STATION.items() if key in station}
    if "variation" in station.get("Data Type", "").lower():
        notes.append("the data are variations without the baselines of the observatory: they are not the whole field")
    streams = {name: (time, np.zeros(len(time)) + values) for name, values in columns.items()}
    return Recording(streams, f"IAGA-2002: {station.get('Station Name', path.stem)}", "true", notes)


_IAGA_MISSING = 88888.0  # not recorded; 99999 is missing
_STATION = {
    "Geodetic Latitude": ("latitude", 1.0),
    "Geodetic Longitude": ("longitude", 1.0),
    "Elevation": ("altitude", 1e-3),
}
"""Fields of the header of IAGA-2002: column, and its unit."""
_FORMATS: Sequence[tuple[bytes, Callable[..., Recording]]] = (
    (rb"ULog", read_ulg),
    (rb"\xa3\x95|\0.{7}[\xfd\xfe]|([^\n]*\n)*?FMT, ?\d+,", read_ardupilot),
    (rb"#ROSBAG|SQLite format 3|\x89MCAP", read_bag),
    (rb"\s*Format +IAGA-2002", read_iaga),
    (rb"([^\n]*\n)*?[^\n,]*[$!][A-Z]{2}[A-Z\d]{3},", read_nmea),
    (rb"[^\0]*\Z", read_csv),
)
"""How the content of a file begins (a regular expression), and its reader."""
