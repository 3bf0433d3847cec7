"""Read the log of a vehicle: CSV files, and the formats of autopilots, ROS and ships."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from pandas import DataFrame

from magrl.checks import UsageError, short
from magrl.files import numbers, read_table, read_text
from magrl.vehicle.logs.autopilots import read_ardupilot, read_bag, read_nmea, read_ulg
from magrl.vehicle.logs.conventions import check_intensity, check_range, column_of
from magrl.vehicle.logs.samples import AXES, Log, Recording, samples_of, times_of, total_intensity


def read_log(*paths: Path | str, sensor: str | None = None) -> Log:
    """Read the log of a vehicle, which may be in several files, such as one of the magnetometer and one of the heading.

    Args:
        paths: files, recognized by their content: CSV, PX4 (ULog), ArduPilot (DataFlash), MAVLink (telemetry), ROS,
            NMEA 0183; or a folder of ROS 2. Columns of later ones replace columns of earlier ones; all have one clock.
        sensor: magnetometer of those that a log of PX4, ArduPilot or ROS has; by default one that is calibrated, works
            and was used.

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
    recordings = [_recording(Path(path), sensor) for path in paths]
    streams = {name: pair for recording in recordings for name, pair in recording.streams.items()}
    try:
        for name, (_, values) in streams.items():
            check_range(name, values)
        samples, notes = samples_of(streams)
        check_intensity(float(total_intensity(samples).median()))
    except ValueError as error:
        raise ValueError(f"cannot read {', '.join(map(str, paths))}: {error}") from error
    norths = [recording.north for recording in recordings if "heading" in recording.streams]
    more = [note for recording in recordings for note in recording.notes]
    source = "; ".join(recording.source for recording in recordings)
    return Log(samples, source, norths[-1] if norths else None, (*more, *notes))


def _recording(path: Path, sensor: str | None) -> Recording:
    """Return the content of a file or a folder.

    Raises:
        ValueError: naming the file and what is wrong with it, whatever the packages raise.
    """
    start = b"#ROSBAG" * path.is_dir()
    if path.is_file():
        with path.open("rb") as file:
            start = file.read(4096)
    if others := [name for form, name in _OTHERS.items() if re.match(form, start)]:
        columns = "time, mag_x_nT, mag_y_nT, mag_z_nT, heading_true_deg"
        raise ValueError(f"{path} is {others[0]}, which is not read: write a CSV file with the columns {columns}, ...")
    found = [reader for form, reader in _FORMATS if path.exists() and re.match(form, start, re.DOTALL)]
    if not found:
        raise ValueError(
            "a log is a file of CSV, PX4, ArduPilot, MAVLink, ROS or NMEA 0183, or a folder of ROS 2 that "
            f"exists, got {str(path)!r}{f', which begins with {short(start[:20])}' if start else ''}"
        )
    options = {} if found[0] in (read_csv, read_nmea) else {"sensor": sensor}
    try:
        return found[0](path, **options)
    except ImportError:
        raise
    except Exception as error:
        ours = UsageError if "sensor" in options else (ValueError, OSError)
        foreign = f"it is damaged, or of an unknown version ({type(error).__name__}: {short(str(error))})"
        raise ValueError(f"cannot read {path}: {error if isinstance(error, ours) else foreign}") from error


def read_csv(path: Path) -> Recording:
    """Read a CSV file with a header: see :data:`~magrl.vehicle.logs.conventions.COLUMNS` for names and units.

    Times are numbers or ISO 8601 texts. Blank cells do not count; other columns are ignored.
    """
    lines = read_text(path).strip("\n").split("\n")
    comma = max(",;\t", key=lines[0].count)
    cut = lines[-1].count(comma) < lines[0].count(comma)
    raw = read_table("\n".join(lines[:-1] if cut else lines), comma)
    headers = _headers(raw)
    others = ", ".join(name for name in raw if name and name not in [header for header, _ in headers.values()])
    notes = ["the last row is not complete, and is left out: the log may be truncated"] if cut else []
    notes += [f"columns that are not read: {short(others, 300)}"] if others else []
    header, unit = headers.pop("time")
    time = times_of(raw[header], unit)
    values = {name: unit * numbers(raw[header]) for name, (header, unit) in headers.items()}
    valid = {name: np.isfinite(time) & np.isfinite(series) for name, series in values.items()}
    axes = [valid[name] for name in AXES if name in valid]
    for name in AXES:
        if name in valid:
            valid[name] = np.all(axes, axis=0)
    heading = headers.get("heading", ("", 1))[0].lower()
    north = "true" if "true" in heading else "magnetic" if "mag" in heading else None
    streams = {name: (time[valid[name]], series[valid[name]]) for name, series in values.items()}
    return Recording(streams, f"CSV, {len(raw)} rows", north, notes)


def _headers(raw: DataFrame) -> dict[str, tuple[str, float]]:
    """Return header and unit of each column that is known."""
    headers: dict[str, tuple[str, float]] = {}
    for header in filter(None, raw):
        if column := column_of(header):
            name, unit = column
            if name in headers:
                raise ValueError(f"{short(headers[name][0])} and {short(header)} are both the {name}: keep one of them")
            headers[name] = header, unit
    if "time" not in headers:
        raise ValueError(f"no column is the time, among {short(', '.join(raw), 300)}: name it time, or time_ms")
    return headers


_FORMATS: Sequence[tuple[bytes, Callable[..., Recording]]] = (
    (rb"ULog", read_ulg),
    (rb"\xa3\x95|([^\n]*\n)*?FMT, ?\d+,", read_ardupilot),
    (rb"\0.{7}[\xfd\xfe]", read_ardupilot),
    (rb"#ROSBAG|SQLite format 3|\x89MCAP", read_bag),
    (rb"([^\n]*\n)*?[^\n,]*[$!][A-Z]{2}[A-Z\d]{3},", read_nmea),
    (rb"(?!\s*[<\[{])[^\0]*\Z", read_csv),
)
"""How the content of a file begins (a regular expression), and its reader."""
_OTHERS = {
    rb" ?Format +IAGA": "a file of IAGA-2002, of an observatory",
    rb"dbd_label:": "a log of a Slocum glider",
    rb"H Product: ?Blackbox": "a blackbox of INAV or Betaflight",
}
"""How logs begin that are not read."""
