"""Read the log of a vehicle: CSV files, and the formats of autopilots, ROS and ships."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np
import torch
from pandas import DataFrame

from magrl.checks import UsageError, short
from magrl.files import numbers_of, read_table, read_text
from magrl.geodesy import wrap_longitude
from magrl.vehicle.logs.autopilots import read_ardupilot, read_bag, read_nmea, read_ulg
from magrl.vehicle.logs.samples import ATTITUDE, AXES, Log, Recording, samples_of, times_of, total_intensity
from magrl.vehicle.logs.units import column_of, intensity_mistake, out_of_range
from magrl.vehicle.logs.vectors import rotation

_ENOUGH = 20000  # samples that show the unit of an angle


def read_log(*paths: Path | str, sensor: str | None = None) -> Log:
    """Read the log of a vehicle, which may be in several files, such as one of the magnetometer and one of the heading.

    Args:
        paths: files, recognized by their content: CSV, PX4 (ULog), ArduPilot (DataFlash), MAVLink (telemetry), ROS,
            NMEA 0183; or a folder of ROS 2. Columns of later ones replace those of earlier ones; all have one clock.
        sensor: magnetometer of those that a log of PX4, ArduPilot or ROS has; by default one that is calibrated, works
            and was used.

    Raises:
        ValueError: naming the file and all that is wrong with it, or its unknown format.
        ImportError: for a package that is not installed, naming the extra.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "log.csv"
        >>> _ = path.write_text("time_s,mag_x_uT,mag_y_uT,mag_z_uT,heading_true_deg" + chr(10) + "0,15,0,48,350")
        >>> read_log(path).samples.values.tolist()
        [[0.0, 15000.0, 0.0, 48000.0, 350.0]]
    """
    recordings, remedies = zip(*(_recording(Path(path), sensor) for path in paths), strict=True)
    streams = {name: pair for recording in recordings for name, pair in recording.streams.items()}
    found = [text for recording in recordings for text in recording.wrong]
    found += filter(None, (out_of_range(name, values) for name, (_, values) in streams.items()))
    try:
        samples, notes = samples_of(streams, "; or ".join(dict.fromkeys(remedies)))
        found += filter(None, (_radians(samples), intensity_mistake(float(total_intensity(samples).median()))))
    except ValueError as error:
        found.append(str(error))
    if found:
        raise ValueError(f"cannot read {', '.join(map(str, paths))}: {'; '.join(dict.fromkeys(found))}")
    norths = [recording.north for recording in recordings if "heading" in recording.streams]
    more = [note for recording in recordings for note in recording.notes]
    source = "; ".join(recording.source for recording in recordings)
    return Log(samples, source, norths[-1] if norths else None, (*more, *notes))


def _recording(path: Path, sensor: str | None) -> tuple[Recording, str]:
    """Return the content of a file or a folder, and how such a log gets a magnetometer.

    Raises:
        ValueError: naming the file and what is wrong with it, whatever the packages raise.
    """
    start = b"#ROSBAG" * path.is_dir()
    if path.is_file():
        with path.open("rb") as file:
            start = file.read(4096)
    forms = [form for form in _FORMATS if path.exists() and re.match(form[0], start, re.DOTALL)]
    if not forms:
        raise ValueError(
            "a log is a file of CSV, PX4, ArduPilot, MAVLink, ROS or NMEA 0183, or a folder of ROS 2 that "
            f"exists, got {str(path)!r}{f', which begins with {short(start[:20])}' if start else ''}"
        )
    _, reader, remedy = forms[0]
    options = {} if reader in (read_csv, read_nmea) else {"sensor": sensor}
    try:
        return reader(path, **options), remedy
    except ImportError:
        raise
    except Exception as error:
        ours = UsageError if "sensor" in options else (ValueError, OSError)
        foreign = f"it is damaged, or of an unknown version ({type(error).__name__}: {short(str(error))})"
        raise ValueError(f"cannot read {path}: {error if isinstance(error, ours) else foreign}") from error


def _radians(samples: DataFrame) -> str | None:
    """Return which angles look like radians, as text: as such, they leave much less variance of the field."""
    some = samples.iloc[:: len(samples) // _ENOUGH + 1].reindex(columns=[*AXES, *ATTITUDE], fill_value=0.0)
    axes, attitude = torch.tensor(some.to_numpy(float)).unflatten(-1, (2, 3)).unbind(1)
    seen = slice(0 if "heading" in samples else 2, None)  # without a heading, the vertical component alone

    def variance(names: Sequence[str]) -> float:
        radians = torch.tensor([name in names for name in ATTITUDE])
        turn = rotation(torch.where(radians, wrap_longitude(attitude).rad2deg(), attitude))
        return (turn @ axes.unsqueeze(-1))[:, seen].var(0, correction=0).sum().item()

    best = min((ATTITUDE[:2], ATTITUDE[2:], ATTITUDE), key=variance)
    names = [name for name in best if name in samples]
    text = f"{' and '.join(names)} look like radians: name the columns {', '.join(f'{name}_rad' for name in names)}"
    return text if 4 * variance(best) < variance(()) else None


def read_csv(path: Path) -> Recording:
    """Read a CSV file with a header: see :data:`~magrl.vehicle.logs.units.COLUMNS` for names and units.

    Times are numbers or ISO 8601 texts. Blank cells do not count; other columns are ignored.
    """
    lines = read_text(path).strip("\n").split("\n")
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
    for name in AXES:
        if name in valid:
            valid[name] = np.all(axes, axis=0)
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


_FORMATS: Sequence[tuple[bytes, Callable[..., Recording], str]] = (
    (rb"ULog", read_ulg, "log the topic vehicle_magnetometer or sensor_mag"),
    (rb"\xa3\x95|([^\n]*\n)*?FMT, ?\d+,", read_ardupilot, "log MAG, by the compass in LOG_BITMASK"),
    (rb"\0.{7}[\xfd\xfe]", read_ardupilot, "request RAW_IMU, SCALED_IMU2, SCALED_IMU3 or HIGHRES_IMU"),
    (rb"#ROSBAG|SQLite format 3|\x89MCAP", read_bag, "record a topic of sensor_msgs/MagneticField"),
    (rb"([^\n]*\n)*?[^\n,]*[$!][A-Z]{2}[A-Z\d]{3},", read_nmea, "send XDR with MAG_X_NT, MAG_Y_NT and MAG_Z_NT"),
    (rb"(?!\s*[<\[{])[^\0]*\Z", read_csv, "name its columns mag_x_nT, mag_y_nT, mag_z_nT"),
)
"""How the content of a file begins (a regular expression), its reader, and how such a log gets a magnetometer."""
