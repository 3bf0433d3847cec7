"""Readers of the logs of autopilots, with packages of the extra ``logs``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from magrl.logs.samples import ATTITUDE, AXES, Array, Log, read_csv, samples_of
from magrl.logs.units import FIELD_NT
from magrl.logs.vectors import attitude_of

MODEL_NORTH = (
    "the heading is of an estimator that adds the declination of a model to a compass: D is that of the model, and "
    "circular (a heading from two GNSS antennas or a gyrocompass is not)"
)
NOT_CALIBRATED = "the magnetometer is as it was measured, without the calibration of the autopilot"


def read_log(path: Path | str, frame: str = "FRD") -> Log:
    """Read the log of a vehicle: CSV, or the log of an autopilot by its suffix.

    Args:
        path: ``.csv``; ``.ulg`` (PX4).
        frame: axes of a CSV file, one of :data:`~magrl.logs.vectors.FRAMES`.

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
    path = Path(path)
    readers: Mapping[str, Callable[[Path], Log]] = {".csv": lambda path: read_csv(path, frame), ".ulg": read_ulg}
    if path.suffix.lower() not in readers:
        raise ValueError(f"the log of a vehicle must end in {', '.join(readers)}, got {str(path)!r}")
    if path.is_file() and not path.stat().st_size:
        raise ValueError(f"{path} is empty")
    try:
        return readers[path.suffix.lower()](path)
    except ImportError:
        raise
    except Exception as error:  # whatever the packages raise for a foreign or damaged file
        raise ValueError(f"cannot read {path}: {error}") from error


def _package(module: str, package: str) -> Any:
    """Return a module of the extra ``logs``."""
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(f"this format needs the package {package}: pip install 'magrl[logs]'") from error


def _attitudes(time: Array, quaternion: Array) -> dict[str, tuple[Array, Array]]:
    """Return roll, pitch, heading [deg] of quaternions w, x, y, z ``(N, 4)``."""
    angles = attitude_of(torch.from_numpy(np.ascontiguousarray(quaternion, float))).numpy()
    return {name: (time, angles[:, column]) for column, name in enumerate(ATTITUDE)}


# PX4

_MAGNETOMETERS = {
    "vehicle_magnetometer": [f"magnetometer_ga[{index}]" for index in range(3)],
    "sensor_combined": [f"magnetometer_ga[{index}]" for index in range(3)],
    "sensor_mag": list(AXES),
}
"""Topics with a magnetometer [gauss], the calibrated one first."""


def read_ulg(path: Path) -> Log:
    """Read a log of PX4 (ULog) with pyulog: see :func:`read_log`. Times are UTC where GNSS gives it."""
    log = _package("pyulog", "pyulog").ULog(str(path))
    topics = {item.name: item.data for item in reversed(log.data_list)}  # the first instance of each
    held = [name for name, columns in _MAGNETOMETERS.items() if columns[0] in topics.get(name, ())]
    if not held:
        raise ValueError(f"none of {', '.join(_MAGNETOMETERS)} is among its topics, {', '.join(sorted(topics))}")
    name, notes = held[0], ["the file is damaged or truncated"] if log.file_corruption else []
    if name == "sensor_mag":
        notes.append(f"{name}: {NOT_CALIBRATED}")
    field, attitude, position = (topics.get(topic, {}) for topic in (name, "vehicle_attitude", "vehicle_gps_position"))
    streams = {
        axis: (_seconds(field), FIELD_NT["G"] * field[key])
        for axis, key in zip(AXES, _MAGNETOMETERS[name], strict=True)
    }
    if attitude:
        streams |= _attitudes(_seconds(attitude), np.stack([attitude[f"q[{index}]"] for index in range(4)], -1))
    fixed = np.asarray(position.get("fix_type", ())) >= 3
    offset = 0.0
    if fixed.any():
        streams |= _px4_position(position, fixed)
        offset = float(np.median(position["time_utc_usec"][fixed] / 1e6 - _seconds(position)[fixed]))
    if not np.isfinite(position.get("heading", np.nan)).any():
        notes.append(MODEL_NORTH)
    samples, more = samples_of({column: (time + offset, values) for column, (time, values) in streams.items()})
    return Log(samples, f"PX4 ULog, {name}", "true", (*notes, *more))


def _seconds(topic: Mapping[str, Array]) -> Array:
    return np.asarray(topic["timestamp"]) / 1e6


def _px4_position(topic: Mapping[str, Array], fixed: NDArray[np.bool_]) -> dict[str, tuple[Array, Array]]:
    """Return latitude and longitude [deg] where GNSS has a fix; older logs have 1e-7 degrees as integers."""
    names = {"latitude": ("latitude_deg", "lat"), "longitude": ("longitude_deg", "lon")}
    degrees = {name: topic[new] if new in topic else topic[old] * 1e-7 for name, (new, old) in names.items()}
    return {name: (_seconds(topic)[fixed], np.asarray(values)[fixed]) for name, values in degrees.items()}
