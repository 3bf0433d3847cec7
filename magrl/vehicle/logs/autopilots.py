"""Readers of the logs of autopilots, ROS and ships, with packages of the extra ``logs``."""

from __future__ import annotations

import datetime
import io
import re
from collections import defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import closing, suppress
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch

from magrl.checks import UsageError
from magrl.field.elements import FIELD_NT
from magrl.vehicle.logs.conventions import UNITS, attitude_of, column_of, from_enu
from magrl.vehicle.logs.samples import ATTITUDE, AXES, Array, Recording

MODEL_NORTH = (
    "the heading is a compass plus the declination of a model, so D is the model's and is not used "
    "(state the north as true if the heading had another source, such as two GNSS antennas)"
)
NOT_CALIBRATED = "the magnetometer is as it was measured, without the calibration of the autopilot"
_Rows = dict[tuple[str, ...], dict[str, list[tuple[float, ...]]]]
_Tables = dict[tuple[str, ...], dict[str, Array]]
_QUATERNION, _PLACE = ("w", "x", "y", "z"), ("latitude", "longitude")


def package(module: str, package: str) -> Any:
    """Return a module of the extra ``logs``.

    Raises:
        ImportError: if the package is not installed, with the command that installs it.

    Example:
        >>> package("wave_reader", "wave-reader")
        Traceback (most recent call last):
        ImportError: this needs the package wave-reader: pip install 'magrl[logs]'
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(f"this needs the package {package}: pip install 'magrl[logs]'") from error


def _recording(
    kind: str,
    tables: Mapping[tuple[str, ...], Mapping[str, Array]],
    sensor: str | None,
    used: Collection[str] = (),
    convert: Callable[[torch.Tensor], torch.Tensor] = lambda attitude: attitude,
) -> Recording:
    """Return the columns of the best sensor of each kind, and of the stated magnetometer.

    A sensor is better if it works, if it is calibrated, if the estimator used it, and if it has more samples.

    Args:
        kind: name of the format.
        tables: rows of a time and values, by the names of the columns and the name of the sensor.
        sensor: name of a magnetometer.
        used: names of those that the estimator used.
        convert: conversion of an attitude to FRD and NED.
    """
    names: list[str] = []
    notes: list[str] = []
    streams: dict[str, tuple[Array, Array]] = {}
    for columns, sensors in tables.items():
        name = min(sensors, key=lambda name: _rank(name, sensors[name], used))
        if columns == AXES and sensor is not None:
            if sensor not in sensors:
                raise UsageError(f"sensor must be one of {', '.join(map(repr, sensors))}, got {sensor!r}")
            name = sensor
        if columns == AXES and len(sensors) > 1:
            others = ", ".join(other for other in sensors if other != name)
            notes.append(f"the magnetometer is {name}; state sensor for another one: {others}")
        names.append(name)
        time, values = sensors[name][:, 0], sensors[name][:, 1:]
        if columns == _QUATERNION:
            columns, values = ATTITUDE, convert(attitude_of(torch.from_numpy(values.copy()))).numpy()
        streams |= {column: (time, series) for column, series in zip(columns, values.T, strict=True)}
    notes += [f"{name}: {NOT_CALIBRATED}" for name in names if name.startswith(_RAW_TOPIC)]
    return Recording(streams, f"{kind}: {', '.join(names)}", None, notes)


def _rank(name: str, rows: Array, used: Collection[str]) -> tuple[bool, bool, bool, int]:
    """Return the place of a sensor among others of its kind: the least is the best."""
    works = np.isfinite(rows).all() and np.ptp(rows[:, 1:], 0).any()
    return not works, name.startswith(_RAW_TOPIC), name not in used, -len(rows)


# PX4

_RAW_TOPIC = "sensor_mag"
_GAUSS = AXES, [f"magnetometer_ga[{index}]" for index in range(3)], FIELD_NT["gauss"]
_TOPICS: Sequence[tuple[str, tuple[tuple[str, ...], Sequence[str], float]]] = (
    ("vehicle_magnetometer", _GAUSS),
    ("sensor_combined", _GAUSS),
    (_RAW_TOPIC, (AXES, AXES, FIELD_NT["gauss"])),
    ("vehicle_attitude", (_QUATERNION, [f"q[{index}]" for index in range(4)], 1.0)),
    ("vehicle_gps_position", (_PLACE, ("latitude_deg", "longitude_deg"), 1.0)),
    ("vehicle_gps_position", (_PLACE, ("lat", "lon"), 1e-7)),  # of older logs
)
"""Topics: columns, their fields, and their unit."""


def read_ulg(path: Path, sensor: str | None = None) -> Recording:
    """Read a log of PX4 (ULog) with pyulog. Times are UTC where GNSS gives it."""
    with path.open("rb") as file:
        log = package("pyulog", "pyulog").ULog(file)
    instances = sorted(log.data_list, key=lambda item: item.multi_id)
    topics = {item.name: item.data for item in reversed(instances)}  # the first instance of each
    selected = topics.get("sensor_selection", {}).get("mag_device_id", [None])[-1]
    tables: _Tables = defaultdict(dict)
    used: list[str] = []
    for (topic, (columns, fields, unit)), item in product(_TOPICS, instances):
        if item.name == topic and {*fields} <= item.data.keys():
            rows = np.column_stack((item.data["timestamp"] / 1e6, *(unit * item.data[field] for field in fields)))
            fixed = np.broadcast_to(item.data.get("fix_type", 3), len(rows)) >= 3
            name = f"{topic}:{item.multi_id}" if item.multi_id else topic
            tables[columns] |= {name: rows[fixed]} if fixed.any() else {}
            used += [name] if item.data.get("device_id", [0])[-1] == selected else []
    recording = _recording("PX4 ULog", {columns: some for columns, some in tables.items() if some}, sensor, used)
    position = topics.get("vehicle_gps_position", {})
    fixed = np.asarray(position.get("fix_type", ())) >= 3
    offset = np.median((position["time_utc_usec"] - position["timestamp"].astype(float))[fixed]) if fixed.any() else 0.0
    flags = topics.get("estimator_status_flags", {})
    gnss = np.mean(flags.get("cs_gnss_yaw", flags.get("cs_gps_yaw", 0))) > 0.5  # the heading of two antennas is used
    notes = [] if gnss else [MODEL_NORTH]
    notes += ["the file is damaged or truncated"] if log.file_corruption or _is_cut(path.read_bytes()) else []
    streams = {column: (time + offset / 1e6, values) for column, (time, values) in recording.streams.items()}
    return Recording(streams, recording.source, "true" if gnss else "model", [*notes, *recording.notes])


def _is_cut(content: bytes) -> bool:
    """Return whether the last message of a ULog file ends beyond the file: each follows a header with its size."""
    place = 16
    while place + 3 <= len(content):
        place += 3 + int.from_bytes(content[place : place + 2], "little")
    return place != len(content)


# ArduPilot and MAVLink

_SPEEDS = ("airspeed", "groundspeed")
_MESSAGES: dict[str, tuple[tuple[str, ...], Sequence[str], float]] = {
    "ATT": (ATTITUDE, ("Roll", "Pitch", "Yaw"), 1.0),
    "ATTITUDE": (ATTITUDE, ("roll", "pitch", "yaw"), UNITS["angle"]["rad"]),
    "GPS": (_PLACE, ("Lat", "Lng"), 1.0),
    "GPS_RAW_INT": (_PLACE, ("lat", "lon"), 1e-7),
    "VFR_HUD": (_SPEEDS, _SPEEDS, 1.0),
    "HIGHRES_IMU": (AXES, ("xmag", "ymag", "zmag"), FIELD_NT["gauss"]),
}
"""Messages of DataFlash and of telemetry: columns, their fields, and their unit."""
_RAW = dict.fromkeys(("RAW_IMU", "SCALED_IMU2", "SCALED_IMU3"), ("xmag", "ymag", "zmag"))
_MAGS = dict.fromkeys(("MAG", "MAG2", "MAG3"), ("MagX", "MagY", "MagZ")) | _RAW  # with numbers before version 4.1
_MESSAGES |= {name: (AXES, fields, FIELD_NT["milligauss"]) for name, fields in _MAGS.items()}
_USE = {"MAG": "COMPASS_USE", "MAG:1": "COMPASS_USE2", "MAG:2": "COMPASS_USE3"}
_USE |= {"MAG2": "COMPASS_USE2", "MAG3": "COMPASS_USE3"}
"""Magnetometers, and the parameter by which the vehicle uses them."""
_KINDS = {
    b"\xa3": ("ArduPilot DataFlash", "DFReader", "DFReader_binary"),
    b"F": ("ArduPilot DataFlash, text", "DFReader", "DFReader_text"),
    b"\0": ("MAVLink telemetry", "mavutil", "mavlogfile"),
}
"""Name of the format, module and reader of pymavlink, by the first byte; a text may have other lines before FMT."""


def read_ardupilot(path: Path, sensor: str | None = None) -> Recording:
    """Read a log of ArduPilot (DataFlash, binary or text) or telemetry of MAVLink (also of PX4) with pymavlink.

    The magnetometer, with its offsets, is the first that COMPASS_USE lets the vehicle use and whose messages are
    healthy. The speed is that through the air where it is measured, else that over ground.
    """
    with path.open("rb") as file:
        kind, module, name = _KINDS.get(file.read(1), _KINDS[b"F"])
    reader = getattr(package(f"pymavlink.{module}", "pymavlink"), name)
    rows: _Rows = defaultdict(lambda: defaultdict(list))
    with closing(reader(str(path))) as log:
        while message := log.recv_match(type=[*_MESSAGES, "PARM"]):
            name = message.get_type()
            number = getattr(message, "id" if "id" in message.get_fieldnames() else "I", 0)
            fixed = min(getattr(message, "Status", 3), getattr(message, "fix_type", 3)) >= 3
            if name in _MESSAGES and fixed and getattr(message, "Health", 1):
                columns, fields, unit = _MESSAGES[name]
                values = (unit * getattr(message, field) for field in fields)
                rows[columns][f"{name}:{number}" if number else name].append((message._timestamp, *values))
    used = [name for name, parameter in _USE.items() if log.params.get(parameter, 1)]
    recording = _recording(kind, _with_one_speed(_tables(rows)), sensor, used)
    return recording._replace(north="model", notes=[MODEL_NORTH, *recording.notes])


def _with_one_speed(tables: _Tables) -> _Tables:
    """Return tables with one speed, through the air where it is measured."""
    speeds = tables.pop(_SPEEDS, {})
    for name, rows in speeds.items():
        column = 1 if np.median(rows[:, 1]) > 0 else 2  # zero or NaN without an airspeed sensor
        tables[("speed",)] = {f"{name}.{_SPEEDS[column - 1]}": rows[np.isfinite(rows[:, column])][:, [0, column]]}
    return tables


def _tables(rows: _Rows) -> _Tables:
    """Return rows of each sensor as an array, in the order of their times, and sensors in the order of their names."""
    return {columns: {name: np.array(sorted(some[name])) for name in sorted(some)} for columns, some in rows.items()}


# ROS


def read_bag(path: Path, sensor: str | None = None) -> Recording:
    """Read a bag of ROS 1 (.bag) or 2 with rosbags: a topic of each type that is needed.

    A bag of ROS 2 is its folder, a file in it, or a single file (.mcap, .db3) without the folder's metadata.yaml.

    Times are from the headers. The axes and the attitude of ROS, forward, left, up and east, north, up (REP 103),
    become FRD and NED. The bag does not state the north of the heading, which is the Imu's.
    """
    highlevel, store = package("rosbags.highlevel", "rosbags"), package("rosbags.typesys", "rosbags")
    rows: _Rows = defaultdict(lambda: defaultdict(list))
    lone = path.suffix == ".bag" or not (path.parent / "metadata.yaml").is_file()
    whole = path if path.is_dir() or lone else path.parent
    with highlevel.AnyReader([whole], default_typestore=store.get_typestore(store.Stores.LATEST)) as bag:
        for connection, recorded, raw in bag.messages([topic for topic in bag.connections if topic.msgtype in _ROS]):
            columns, values_of = _ROS[connection.msgtype]
            message = bag.deserialize(raw, connection.msgtype)
            stamp = message.header.stamp
            if values := values_of(message):
                time = stamp.sec + 1e-9 * stamp.nanosec or 1e-9 * recorded
                rows[columns][connection.topic].append((time, *values))
    return _recording("ROS bag", _tables(rows), sensor, convert=from_enu)


def _ros_field(message: Any) -> Sequence[float]:
    axes = message.magnetic_field  # forward, left, up
    return [FIELD_NT["tesla"] * value for value in (axes.x, -axes.y, -axes.z)]


def _ros_attitude(message: Any) -> Sequence[float]:
    """Return a quaternion; empty if the covariance marks it as missing, or its length is zero."""
    values = [getattr(message.orientation, name) for name in _QUATERNION]
    return values if message.orientation_covariance[0] != -1 and sum(value**2 for value in values) > 0 else ()


_ROS: Mapping[str, tuple[tuple[str, ...], Callable[[Any], Sequence[float]]]] = {
    "sensor_msgs/msg/MagneticField": (AXES, _ros_field),
    "sensor_msgs/msg/Imu": (_QUATERNION, _ros_attitude),
    "sensor_msgs/msg/NavSatFix": (_PLACE, lambda m: (m.latitude, m.longitude) if m.status.status >= 0 else ()),
    "nav_msgs/msg/Odometry": (("speed",), lambda m: (m.twist.twist.linear.x,)),
}
"""Columns of each type, and the function that returns their values, empty for a message without any."""


# NMEA 0183

_KNOT, _KM_H = UNITS["speed"]["kn"], UNITS["speed"]["km_h"]
_FIX = ("latitude", "lat", 1.0), ("longitude", "lon", 1.0)
_SENTENCES: Mapping[str, Sequence[tuple[str, str, float]]] = {
    "HDT": [("heading_true", "headingT", 1.0)],
    "THS": [("heading_true", "headt", 1.0)],
    "HDG": [("heading_magnetic", "headingM", 1.0)],
    "HDM": [("heading_magnetic", "headingM", 1.0)],
    "VHW": [("speed_water", "spdK", _KM_H), ("speed_water", "spdN", _KNOT)],
    "VBW": [("speed_water", "longwaterspd", _KNOT), ("speed_ground", "longgroundspd", _KNOT)],
    "VTG": [("speed_ground", "sogk", _KM_H), ("speed_ground", "sogn", _KNOT)],
    "RMC": [*_FIX, ("speed_ground", "spd", _KNOT)],
    "GGA": _FIX,
    "GLL": _FIX,
}
"""Columns of each sentence: names, their fields, and units, of which the last one goes first."""
_TRANSDUCER = ("tdrtype", "dataunit", "tdrid", "data")
_TILT = re.compile(r"(?i)(ROLL)(?![a-z])|PI?TCH(?![a-z])")
"""Names of transducers that are roll, or else pitch, also with the name of a device: ``PTCH-BOX``."""
_CHOICES = {"heading": ("heading_true", "heading_magnetic"), "speed": ("speed_water", "speed_ground")}
INVALID = {"status": ("V",), "mi": ("V", "S", "M"), "posMode": ("N", "S", "M"), "quality": (0, 7, 8)}
"""Fields of a sentence whose values are not valid, or simulated, or entered by hand."""


def read_nmea(path: Path) -> Recording:
    """Read sentences of NMEA 0183 with pynmeagps: heading, speed, position, and transducers (XDR) by their names.

    Sentences have the time of their TAG block, or of the last RMC or ZDA. A heading from true north and a speed through
    the water go first. Transducers are axes of the magnetometer, such as ``MAG_X_UT``, and the angles ``PTCH`` and
    ``ROLL``; others do not count.
    """
    rows: dict[str, list[tuple[float, float]]] = defaultdict(list)
    reader, now = package("pynmeagps", "pynmeagps").NMEAReader, None
    for line in path.read_bytes().splitlines(keepends=True):
        tag = re.match(rb"\\[^\\]*\bc:(\d+)", line)
        for _, message in reader(io.BytesIO(line), quitonerror=0):
            if message is None or any(getattr(message, field, None) in values for field, values in INVALID.items()):
                continue
            now = int(tag[1]) / (1000 if len(tag[1]) > 11 else 1) if tag else _nmea_time(message) or now
            for name, value in nmea_values(message).items():
                if now:
                    rows[name].append((now, value))
    if not rows:
        raise ValueError(
            "no sentence with a time (TAG, RMC, ZDA) is followed by one of heading, speed, position or XDR"
        )
    north = "true" if "heading_true" in rows else "magnetic"
    for name, choices in _CHOICES.items():
        candidates = [pairs for choice in choices if (pairs := rows.pop(choice, None))]
        rows |= {name: candidates[0]} if candidates else {}
    return Recording({name: tuple(np.array(pairs, float).T) for name, pairs in rows.items()}, "NMEA 0183", north)


def _nmea_time(message: Any) -> float | None:
    """Return the time of a sentence that has time and date [s since 1970]."""
    if message.msgID not in ("RMC", "ZDA"):
        return None
    with suppress(TypeError, ValueError):  # blank fields, or no date
        date = message.date if message.msgID == "RMC" else datetime.date(message.year, message.month, message.day)
        return datetime.datetime.combine(date, message.time, datetime.UTC).timestamp()
    return None


def nmea_values(message: Any) -> dict[str, float]:
    """Return the columns of a sentence and their values.

    Args:
        message: sentence of pynmeagps.

    Example:
        >>> from pynmeagps import NMEAReader
        >>> nmea_values(NMEAReader.parse("$HEHDT,290.0,T*24"))
        {'heading_true': 290.0}
    """
    values = {}
    for name, field, factor in _SENTENCES.get(message.msgID, ()):
        value, status = getattr(message, field, ""), getattr(message, f"{field.removeprefix('long')}status", "A")  # VBW
        if isinstance(value, (int, float)) and status != "V" and ("heading" not in name or 0 <= value <= 360):
            values[name] = factor * value + _deviation(message)
    for number in range(1, 100 if message.msgID == "XDR" else 1):
        kind, unit, title, value = (getattr(message, f"{field}_{number:02}", "") for field in _TRANSDUCER)
        tilt = _TILT.match(title) if (kind, unit) == ("A", "D") else None
        column = ("roll" if tilt[1] else "pitch", 1.0) if tilt else None
        column = column_of(title) if re.match("(?i)MAG_?[XYZ]", title) else column
        if column and isinstance(value, (int, float)):
            values[column[0]] = column[1] * value
    return values


def _deviation(message: Any) -> float:
    """Return the deviation of a compass [deg, east] (HDG)."""
    return (getattr(message, "deviation", 0) or 0) * (-1 if getattr(message, "deviationEW", "") == "W" else 1)
