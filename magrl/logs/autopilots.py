"""Readers of the logs of autopilots, ROS and ships, with packages of the extra ``logs``."""

from __future__ import annotations

import datetime
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from magrl.field.elements import FIELD_NT
from magrl.logs.samples import ATTITUDE, AXES, Array, Recording
from magrl.logs.units import UNITS, column_of
from magrl.logs.vectors import FRAMES, attitude_of, from_enu

MODEL_NORTH = (
    "the heading is of an estimator that adds the declination of a model to a compass: D is that of the model, and is "
    "not used (state the north as true if the estimator had another heading, such as that of two GNSS antennas)"
)
NOT_CALIBRATED = "the magnetometer is as it was measured, without the calibration of the autopilot"


def _package(module: str, package: str) -> Any:
    """Return a module of the extra ``logs``."""
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(f"this format needs the package {package}: pip install 'magrl[logs]'") from error


def _streams(rows: Mapping[str, list[tuple[float, float]]]) -> dict[str, tuple[Array, Array]]:
    """Return times and values of each column, from pairs of both."""
    arrays = {name: np.array(pairs, float) for name, pairs in rows.items()}
    return {name: (pairs[:, 0], pairs[:, 1]) for name, pairs in arrays.items()}


def _attitudes(
    time: Array, quaternion: Array, convert: Callable[[torch.Tensor], torch.Tensor] | None = None
) -> dict[str, tuple[Array, Array]]:
    """Return roll, pitch, heading [deg] of quaternions w, x, y, z ``(N, 4)``, converted to FRD and NED."""
    angles = attitude_of(torch.from_numpy(np.ascontiguousarray(quaternion, float)))
    columns = (convert(angles) if convert else angles).unbind(-1)
    return {name: (time, column.numpy()) for name, column in zip(ATTITUDE, columns, strict=True)}


# PX4

_MAGNETOMETERS = {
    "vehicle_magnetometer": [f"magnetometer_ga[{index}]" for index in range(3)],
    "sensor_combined": [f"magnetometer_ga[{index}]" for index in range(3)],
    "sensor_mag": list(AXES),
}
"""Topics with a magnetometer [gauss], the calibrated one first."""


def read_ulg(path: Path) -> Recording:
    """Read a log of PX4 (ULog) with pyulog: see :func:`~magrl.logs.read_log`. Times are UTC where GNSS gives it."""
    with path.open("rb") as file:
        log = _package("pyulog", "pyulog").ULog(file)
    topics = {item.name: item.data for item in reversed(log.data_list)}  # the first instance of each
    held = [name for name, columns in _MAGNETOMETERS.items() if columns[0] in topics.get(name, ())]
    if not held:
        raise ValueError(f"none of {', '.join(_MAGNETOMETERS)} is among its topics, {', '.join(sorted(topics))}")
    name = held[0]
    notes = ["the file is damaged or truncated"] if log.file_corruption or _ends_in_a_message(path) else []
    if name == "sensor_mag":
        notes.append(f"{name}: {NOT_CALIBRATED}")
    field, attitude, position = (topics.get(topic, {}) for topic in (name, "vehicle_attitude", "vehicle_gps_position"))
    streams = {
        axis: (_seconds(field), FIELD_NT["gauss"] * field[key])
        for axis, key in zip(AXES, _MAGNETOMETERS[name], strict=True)
    }
    if attitude:
        streams |= _attitudes(_seconds(attitude), np.stack([attitude[f"q[{index}]"] for index in range(4)], -1))
    fixed = np.asarray(position.get("fix_type", ())) >= 3
    offset = 0.0
    if fixed.any():
        streams |= _px4_position(position, fixed)
        offset = float(np.median(position["time_utc_usec"][fixed] / 1e6 - _seconds(position)[fixed]))
    north = "true" if np.isfinite(position.get("heading", np.nan)).any() else "model"
    notes += [] if north == "true" else [MODEL_NORTH]
    streams = {column: (time + offset, values) for column, (time, values) in streams.items()}
    return Recording(streams, f"PX4 ULog, {name}", north, notes)


def _ends_in_a_message(path: Path) -> bool:
    """Return whether a ULog file ends before its last message does."""
    content, position = path.read_bytes(), 16
    while position + 3 <= len(content):
        position += 3 + int.from_bytes(content[position : position + 2], "little")
    return position != len(content)


def _seconds(topic: Mapping[str, Array]) -> Array:
    return np.asarray(topic["timestamp"]) / 1e6


def _px4_position(topic: Mapping[str, Array], fixed: NDArray[np.bool_]) -> dict[str, tuple[Array, Array]]:
    """Return latitude and longitude [deg] where GNSS has a fix; older logs have 1e-7 degrees as integers."""
    names = {"latitude": ("latitude_deg", "lat"), "longitude": ("longitude_deg", "lon")}
    degrees = {name: topic[new] if new in topic else topic[old] * 1e-7 for name, (new, old) in names.items()}
    return {name: (_seconds(topic)[fixed], np.asarray(values)[fixed]) for name, values in degrees.items()}


# ArduPilot

_MESSAGES = {
    "MAG": (dict(zip(AXES, ("MagX", "MagY", "MagZ"), strict=True)), FIELD_NT["milligauss"]),
    "ATT": ({"roll": "Roll", "pitch": "Pitch", "heading": "Yaw"}, 1.0),
    "GPS": ({"latitude": "Lat", "longitude": "Lng"}, 1.0),
}
"""Messages of a log: fields of the columns, and their unit."""


def read_bin(path: Path) -> Recording:
    """Read a DataFlash log of ArduPilot with pymavlink: the first magnetometer with its offsets, attitude and GNSS."""
    package = _package("pymavlink.DFReader", "pymavlink")
    rows: dict[str, list[tuple[float, float]]] = defaultdict(list)
    with closing(package.DFReader_binary(str(path))) as log:
        while message := log.recv_match(type=list(_MESSAGES)):
            if getattr(message, "I", 0) or getattr(message, "Status", 3) < 3:  # another sensor, or no fix
                continue
            fields, unit = _MESSAGES[message.get_type()]
            for name, field in fields.items():
                rows[name].append((message._timestamp, unit * getattr(message, field)))
    return Recording(_streams(rows), "ArduPilot DataFlash, MAG", "model", [MODEL_NORTH])


# ROS


def read_bag(path: Path) -> Recording:
    """Read a bag of ROS 1 (.bag) or 2 (its folder) with rosbags: the first topic of each type that is needed.

    The axes and the attitude of ROS, forward, left, up and east, north, up (REP 103), become FRD and NED. The north of
    the heading is that of the Imu, which the bag does not tell.
    """
    package = _package("rosbags.highlevel", "rosbags")
    store = _package("rosbags.typesys", "rosbags")
    rows: dict[str, list[tuple[float, float]]] = defaultdict(list)
    with package.AnyReader([path], default_typestore=store.get_typestore(store.Stores.LATEST)) as bag:
        topics = {each.msgtype: each for each in reversed(bag.connections) if each.msgtype in _ROS_COLUMNS}
        for connection, stamp, raw in bag.messages(connections=list(topics.values())):
            message = bag.deserialize(raw, connection.msgtype)
            for name, value in _ROS_COLUMNS[connection.msgtype](message).items():
                rows[name].append((stamp / 1e9, value))
    streams = _streams(rows)
    quaternion = [streams.pop(f"q{index}") for index in range(4) if f"q{index}" in streams]
    if quaternion:
        streams |= _attitudes(quaternion[0][0], np.stack([values for _, values in quaternion], -1), from_enu)
    names = ", ".join(f"{each.topic} ({kind})" for kind, each in topics.items())
    return Recording(streams, f"ROS bag, {names}")


def _ros_field(message: Any) -> dict[str, float]:
    field = message.magnetic_field
    values = zip(AXES, FRAMES["FLU"], (field.x, field.y, field.z), strict=True)
    return {name: sign * FIELD_NT["tesla"] * value for name, sign, value in values}


def _ros_position(message: Any) -> dict[str, float]:
    return {"latitude": message.latitude, "longitude": message.longitude} if message.status.status >= 0 else {}


_ROS_COLUMNS: Mapping[str, Callable[[Any], dict[str, float]]] = {
    "sensor_msgs/msg/MagneticField": _ros_field,
    "sensor_msgs/msg/Imu": lambda m: {f"q{index}": getattr(m.orientation, name) for index, name in enumerate("wxyz")},
    "sensor_msgs/msg/NavSatFix": _ros_position,
    "nav_msgs/msg/Odometry": lambda m: {"speed": m.twist.twist.linear.x},
}


# NMEA 0183

_KNOT = UNITS["speed"]["kn"]
_SENTENCES: Mapping[str, Mapping[str, tuple[str, float]]] = {
    "HDT": {"heading_true": ("headingT", 1.0)},
    "THS": {"heading_true": ("headt", 1.0)},
    "HDG": {"heading_magnetic": ("headingM", 1.0)},
    "HDM": {"heading_magnetic": ("headingM", 1.0)},
    "VHW": {"speed_water": ("spdN", _KNOT)},
    "VTG": {"speed_ground": ("sogn", _KNOT)},
    "RMC": {"latitude": ("lat", 1.0), "longitude": ("lon", 1.0), "speed_ground": ("spd", _KNOT)},
    "GGA": {"latitude": ("lat", 1.0), "longitude": ("lon", 1.0)},
    "GLL": {"latitude": ("lat", 1.0), "longitude": ("lon", 1.0)},
}
"""Columns of each sentence: name of the field, and its unit."""
_CHOICES = {"heading": ("heading_true", "heading_magnetic"), "speed": ("speed_water", "speed_ground")}


def read_nmea(path: Path) -> Recording:
    """Read sentences of NMEA 0183 with pynmeagps: heading, speed, position, and transducers (XDR) by their names.

    Sentences have the time of the last RMC or ZDA. A heading from true north and a speed through the water go first.
    Names of transducers are those of columns, such as ``MAG_X_UT``, or ``PTCH`` and ``ROLL``.
    """
    rows: dict[str, list[tuple[float, float]]] = defaultdict(list)
    now = None
    with path.open("rb") as file:
        for _, message in _package("pynmeagps", "pynmeagps").NMEAReader(file, quitonerror=0):
            now = _nmea_time(message) or now
            if now:
                for name, value in _nmea_values(message):
                    rows[name].append((now, value))
    if not rows:
        raise ValueError("no sentence with a time (RMC or ZDA) is followed by one of heading, speed, position or XDR")
    north = "true" if "heading_true" in rows else "magnetic"
    for name, choices in _CHOICES.items():
        held = [pairs for choice in choices if (pairs := rows.pop(choice, None))]
        rows |= {name: held[0]} if held else {}
    return Recording(_streams(rows), "NMEA 0183", north)


def _nmea_time(message: Any) -> float | None:
    """Return the time of a sentence that has time and date [s since 1970]."""
    date = getattr(message, "date", None)
    if message.msgID == "ZDA":
        date = datetime.date(message.year, message.month, message.day)
    if message.msgID not in ("RMC", "ZDA") or not date or not message.time:
        return None
    return datetime.datetime.combine(date, message.time, datetime.timezone.utc).timestamp()


def _nmea_values(message: Any) -> Iterator[tuple[str, float]]:
    """Yield the columns of a sentence and their values."""
    for name, (field, unit) in _SENTENCES.get(message.msgID, {}).items():
        value = getattr(message, field, "")
        if isinstance(value, (int, float)):
            yield name, unit * value
    for number in range(1, 10) if message.msgID == "XDR" else ():
        name, value = (getattr(message, f"{field}_{number:02}", "") for field in ("tdrid", "data"))
        found = column_of({"PTCH": "PITCH"}.get(name, name))
        if found and isinstance(value, (int, float)):
            yield found[0], found[1] * value
