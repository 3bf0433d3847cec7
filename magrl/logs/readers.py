"""Read the log of a vehicle: CSV files, and the formats of autopilots, ROS, ships and observatories."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from pandas import DataFrame

from magrl.checks import UsageError, check_choice, short
from magrl.geodesy import wrap_longitude
from magrl.logs.autopilots import read_ardupilot, read_bag, read_nmea, read_ulg
from magrl.logs.samples import ATTITUDE, AXES, Log, Recording, samples_of
from magrl.logs.tables import read_csv, read_iaga
from magrl.logs.units import intensity_mistake, out_of_range
from magrl.logs.vectors import FRAMES, rotation

_ENOUGH = 20000  # samples that show the unit of an angle


def read_log(*paths: Path | str, frame: str = "FRD", sensor: str | None = None) -> Log:
    """Read the log of a vehicle, which may be in several files, such as one of the magnetometer and one of the heading.

    Args:
        paths: files, recognized by their content: CSV, PX4 (ULog), ArduPilot (DataFlash), MAVLink (telemetry), ROS,
            NMEA 0183, observatories (IAGA-2002); or a folder of ROS 2. Columns of later ones replace those of earlier
            ones; all have one clock.
        frame: axes of CSV files, one of :data:`~magrl.logs.vectors.FRAMES`; the attitude is that of FRD and NED.
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
    log, wrong = examine(*paths, frame=frame, sensor=sensor)
    if wrong:
        raise ValueError(f"cannot read {', '.join(map(str, paths))}: {'; '.join(wrong)}")
    return log


def examine(*paths: Path | str, frame: str = "FRD", sensor: str | None = None) -> tuple[Log, list[str]]:
    """Return the samples of a log, and what is wrong with its columns; see :func:`read_log`.

    Raises:
        ValueError: for files without samples, with all that is wrong.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "log.csv"
        >>> _ = path.write_text("time_s,mag_x_uT,mag_y_uT,mag_z_uT,pitch" + chr(10) + "0,15,0,48,200")
        >>> examine(path)[1]
        ['pitch 200 is not from -90 to 90 deg: check it and its unit']
    """
    check_choice(FRAMES, frame=frame)
    formats = [_format(path) for path in map(Path, paths)]
    recordings = [_recording(Path(path), form, frame, sensor) for path, form in zip(paths, formats, strict=True)]
    streams = {name: pair for recording in recordings for name, pair in recording.streams.items()}
    wrong = [text for recording in recordings for text in recording.wrong]
    wrong += filter(None, (out_of_range(name, values) for name, (_, values) in streams.items()))
    times = {text for time, _ in streams.values() if (text := out_of_range("time", time))}
    try:
        if times:
            raise ValueError(*times)
        samples, notes = samples_of(streams, "; or ".join(dict.fromkeys(form.remedy for form in formats)))
    except ValueError as error:
        text = "; ".join([*wrong, *map(str, error.args)])
        raise ValueError(f"cannot read {', '.join(map(str, paths))}: {text}") from error
    if mistake := intensity_mistake(float(np.sqrt(np.square(samples[list(AXES)]).sum(axis=1)).median())):
        notes.append(mistake)
    norths = [recording.north for recording in recordings if "heading" in recording.streams]
    more = [note for recording in recordings for note in recording.notes]
    source = "; ".join(recording.source for recording in recordings)
    return Log(samples, source, norths[-1] if norths else None, (*more, *notes)), wrong + _radians(samples)


class _Format(NamedTuple):
    """How a file begins (a regular expression), its reader, options of this, and how it gets a magnetometer."""

    start: bytes
    read: Callable[..., Recording]
    option: str
    remedy: str


def _format(path: Path) -> _Format:
    """Return the format of a file or a folder."""
    start = b""
    if path.is_file():
        with path.open("rb") as file:
            start = file.read(4096)
    for form in _FORMATS:
        if (path.is_dir() and form.read is read_bag) or (path.is_file() and re.match(form.start, start, re.DOTALL)):
            return form
    raise ValueError(
        "a log is a file of CSV, PX4, ArduPilot, MAVLink, ROS, NMEA 0183 or IAGA-2002, or a folder of ROS 2 that "
        f"exists, got {str(path)!r}{f', which begins with {short(start[:20])}' if start else ''}"
    )


def _recording(path: Path, form: _Format, frame: str, sensor: str | None) -> Recording:
    """Return the content of a file.

    Raises:
        ValueError: naming the file and what is wrong with it, whatever the packages raise.
    """
    options = {"frame": frame, "sensor": sensor}
    try:
        return form.read(path, **{name: options[name] for name in filter(None, [form.option])})
    except ImportError:
        raise
    except Exception as error:
        ours = UsageError if form.option == "sensor" else (ValueError, OSError)
        foreign = f"it is damaged, or of an unknown version ({type(error).__name__}: {short(str(error))})"
        raise ValueError(f"cannot read {path}: {error if isinstance(error, ours) else foreign}") from error


def _radians(samples: DataFrame) -> list[str]:
    """Return which angles look like radians: as such, they leave much less variance of the field."""
    some = samples.iloc[:: len(samples) // _ENOUGH + 1].reindex(columns=[*AXES, *ATTITUDE], fill_value=0.0)
    axes, attitude = torch.tensor(some.to_numpy(float)).unflatten(-1, (2, 3)).unbind(1)
    seen = slice(0 if "heading" in samples else 2, None)  # without a heading, the vertical component alone

    def variance(names: Sequence[str]) -> float:
        radians = torch.tensor([name in names for name in ATTITUDE])
        turn = rotation(torch.where(radians, wrap_longitude(attitude).rad2deg(), attitude))
        return (turn @ axes.unsqueeze(-1))[:, seen].var(0, correction=0).sum().item()

    best = min((ATTITUDE[:2], ATTITUDE[2:], ATTITUDE), key=variance)
    if 4 * variance(best) >= variance(()):
        return []
    names = [name for name in best if name in samples]
    return [f"{' and '.join(names)} look like radians: name the columns {', '.join(f'{name}_rad' for name in names)}"]


_FORMATS = (
    _Format(rb"ULog", read_ulg, "sensor", "log the topic vehicle_magnetometer or sensor_mag"),
    _Format(rb"\xa3\x95|([^\n]*\n)*?FMT, ?\d+,", read_ardupilot, "sensor", "log MAG, by the compass in LOG_BITMASK"),
    _Format(rb"\0.{7}[\xfd\xfe]", read_ardupilot, "sensor", "request RAW_IMU, SCALED_IMU2, SCALED_IMU3 or HIGHRES_IMU"),
    _Format(rb"#ROSBAG|SQLite format 3|\x89MCAP", read_bag, "sensor", "record a topic of sensor_msgs/MagneticField"),
    _Format(rb"\s*Format +IAGA-2002", read_iaga, "", "take a record of X, Y, Z or of H, D, Z"),
    _Format(
        rb"([^\n]*\n)*?[^\n,]*[$!][A-Z]{2}[A-Z\d]{3},", read_nmea, "", "send XDR with MAG_X_NT, MAG_Y_NT and MAG_Z_NT"
    ),
    _Format(rb"(?!\s*[<\[{])[^\0]*\Z", read_csv, "frame", "name its columns mag_x_nT, mag_y_nT, mag_z_nT"),
)
