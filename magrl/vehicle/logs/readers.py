"""Read the log of a vehicle: CSV files, and the formats of autopilots, ROS, ships and observatories."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from pandas import DataFrame

from magrl.checks import UsageError, check_choice, short
from magrl.geodesy import wrap_longitude
from magrl.vehicle.logs.autopilots import read_ardupilot, read_bag, read_nmea, read_ulg
from magrl.vehicle.logs.samples import ATTITUDE, AXES, Log, Recording, samples_of, total_intensity
from magrl.vehicle.logs.tables import read_csv, read_iaga
from magrl.vehicle.logs.units import intensity_mistake, out_of_range
from magrl.vehicle.logs.vectors import FRAMES, rotation

_ENOUGH = 20000  # samples that show the unit of an angle


def read_log(*paths: Path | str, frame: str = "FRD", sensor: str | None = None, wrong: list[str] | None = None) -> Log:
    """Read the log of a vehicle, which may be in several files, such as one of the magnetometer and one of the heading.

    Args:
        paths: files, recognized by their content: CSV, PX4 (ULog), ArduPilot (DataFlash), MAVLink (telemetry), ROS,
            NMEA 0183, observatories (IAGA-2002); or a folder of ROS 2. Columns of later ones replace those of earlier
            ones; all have one clock.
        frame: axes of CSV files, one of :data:`~magrl.vehicle.logs.vectors.FRAMES`; the attitude is that of FRD and NED.
        sensor: magnetometer of those that a log of PX4, ArduPilot or ROS has; by default one that is calibrated, works
            and was used.
        wrong: list to which is added what is wrong with the columns; without it, that raises an error.

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
    check_choice(FRAMES, frame=frame)
    recordings, remedies = zip(*(_recording(Path(path), frame, sensor) for path in paths), strict=True)
    streams = {name: pair for recording in recordings for name, pair in recording.streams.items()}
    found = [text for recording in recordings for text in recording.wrong]
    found += filter(None, (out_of_range(name, values) for name, (_, values) in streams.items()))
    try:
        samples, notes = samples_of(streams, "; or ".join(dict.fromkeys(remedies)))
        found += filter(None, (_radians(samples), intensity_mistake(float(total_intensity(samples).median()))))
        if found and wrong is None:
            raise ValueError(*found)
    except ValueError as error:
        texts = dict.fromkeys([*found, *map(str, error.args)])
        raise ValueError(f"cannot read {', '.join(map(str, paths))}: {'; '.join(texts)}") from error
    if wrong is not None:
        wrong += found
    norths = [recording.north for recording in recordings if "heading" in recording.streams]
    more = [note for recording in recordings for note in recording.notes]
    source = "; ".join(recording.source for recording in recordings)
    return Log(samples, source, norths[-1] if norths else None, (*more, *notes))


def _recording(path: Path, frame: str, sensor: str | None) -> tuple[Recording, str]:
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
            "a log is a file of CSV, PX4, ArduPilot, MAVLink, ROS, NMEA 0183 or IAGA-2002, or a folder of ROS 2 that "
            f"exists, got {str(path)!r}{f', which begins with {short(start[:20])}' if start else ''}"
        )
    _, reader, remedy = forms[0]
    options: dict[str, Any] = {read_csv: {"frame": frame}, read_iaga: {}, read_nmea: {}}.get(reader, {"sensor": sensor})
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


_FORMATS: Sequence[tuple[bytes, Callable[..., Recording], str]] = (
    (rb"ULog", read_ulg, "log the topic vehicle_magnetometer or sensor_mag"),
    (rb"\xa3\x95|([^\n]*\n)*?FMT, ?\d+,", read_ardupilot, "log MAG, by the compass in LOG_BITMASK"),
    (rb"\0.{7}[\xfd\xfe]", read_ardupilot, "request RAW_IMU, SCALED_IMU2, SCALED_IMU3 or HIGHRES_IMU"),
    (rb"#ROSBAG|SQLite format 3|\x89MCAP", read_bag, "record a topic of sensor_msgs/MagneticField"),
    (rb"\s*Format +IAGA-2002", read_iaga, "take a record of X, Y, Z or of H, D, Z"),
    (rb"([^\n]*\n)*?[^\n,]*[$!][A-Z]{2}[A-Z\d]{3},", read_nmea, "send XDR with MAG_X_NT, MAG_Y_NT and MAG_Z_NT"),
    (rb"(?!\s*[<\[{])[^\0]*\Z", read_csv, "name its columns mag_x_nT, mag_y_nT, mag_z_nT"),
)
"""How the content of a file begins (a regular expression), its reader, and how such a log gets a magnetometer."""
