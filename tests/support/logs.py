"""Logs of autopilots, ROS and ships with the same axes, attitude and position, as bytes of each format."""

from __future__ import annotations

import functools
import math
import operator
import struct
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import torch

from magrl.field import IGRF, elements_at
from magrl.vehicle.logs import axes_of_elements

PLACE, UTC = (47.4, 8.55), 1_782_800_000.0  # June 2026
ELEMENTS = elements_at(IGRF("2026-06-30"), torch.tensor(PLACE, dtype=torch.float64))
ATTITUDE = torch.tensor([[3.0 * n - 10, 5.0 - n, 30.0 * n] for n in range(12)], dtype=torch.float64)
AXES = axes_of_elements(ELEMENTS.expand(12, 3), ATTITUDE)


def quaternions(attitude: torch.Tensor) -> np.ndarray:
    """w, x, y, z of roll, pitch, heading [deg]."""
    half = np.radians(attitude.numpy()) / 2
    (a, b, c), (d, e, f) = np.cos(half).T, np.sin(half).T
    parts = a * b * c + d * e * f, d * b * c - a * e * f, a * e * c + d * b * f, a * b * f - d * e * c
    return np.stack(parts, -1)


def packed(kind: str, *content: bytes) -> bytes:
    body = b"".join(content)
    return struct.pack("<HB", len(body), ord(kind)) + body


def ulog(
    magnetometers: Mapping[str, float] = MappingProxyType({"vehicle_magnetometer": 1.0}),
    heading: float = math.nan,
    flag: int | None = None,
    selected: int = 0,
    *,
    older: bool = False,
) -> bytes:
    """A ULog file: https://docs.px4.io/main/en/dev_log/ulog_file_format.html.

    Args:
        magnetometers: factor of the axes by topic and instance, such as ``sensor_mag:1``.
        heading: heading of GNSS.
        flag: whether the estimator uses it, if it tells.
        selected: instance of the magnetometer that the estimator uses.
        older: whether vehicle_magnetometer has no device, and sensor_mag half of the samples.
    """
    device = "" if older else "uint32_t device_id;"
    topics = dict.fromkeys(magnetometers, f"{device}float[3] magnetometer_ga")
    topics |= {name: "uint32_t device_id;float x;float y;float z" for name in magnetometers if "sensor_mag" in name}
    topics |= {"vehicle_attitude": "float[4] q", "sensor_selection": "uint32_t mag_device_id"}
    topics["vehicle_gps_position"] = "uint64_t time_utc_usec;int32_t lat;int32_t lon;float heading;uint8_t fix_type"
    topics |= {"estimator_status_flags": "bool cs_gnss_yaw"} if flag is not None else {}
    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + packed("B", bytes(40))]
    kinds = {name.partition(":")[0]: fields for name, fields in topics.items()}
    parts += [packed("F", f"{name}:uint64_t timestamp;{fields};".encode()) for name, fields in kinds.items()]
    for number, name in enumerate(topics):
        kind, _, instance = name.partition(":")
        parts.append(packed("A", struct.pack("<BH", int(instance or 0), number), kind.encode()))
    numbers = {name: number for number, name in enumerate(topics)}
    for row, (field, q) in enumerate(zip((AXES / 1e5).tolist(), quaternions(ATTITUDE).tolist(), strict=True)):
        place = [round(x * 1e7) for x in PLACE] if row > 1 else (0, 0)  # no fix in the first two rows
        time = 1_000_000 + 100_000 * row
        stamp, fix = (int(UTC * 1e6) + time, 3) if row > 1 else (0, 0)
        rows = {
            name: struct.pack("<I3f", int(name.partition(":")[2] or 0), *(factor * axis for axis in field))
            for name, factor in magnetometers.items()
            if not (older and row % 2 and "sensor_mag" in name)
        }
        rows |= {name: content[4:] for name, content in rows.items() if older and "sensor_mag" not in name}
        rows |= {"vehicle_attitude": struct.pack("<4f", *q), "sensor_selection": struct.pack("<I", selected)}
        rows["vehicle_gps_position"] = struct.pack("<QiifB", stamp, *place, heading, fix)
        rows |= {"estimator_status_flags": struct.pack("<B", flag)} if flag is not None else {}
        parts += [packed("D", struct.pack("<HQ", numbers[name], time), content) for name, content in rows.items()]
    return b"".join(parts)


def dataflash(use: tuple[float, float] = (1.0, 1.0), health: tuple[int, int] = (1, 1), *, older: bool = False) -> bytes:
    """A DataFlash file: messages that describe the formats, and messages of these.

    The second magnetometer has half of the field; in an older file, its messages have another name.
    """
    kinds = {"MAG": ("QBfffB", "TimeUS,I,MagX,MagY,MagZ,Health"), "ATT": ("QccC", "TimeUS,Roll,Pitch,Yaw")}
    kinds |= {"GPS": ("QBIHLL", "TimeUS,Status,GMS,GWk,Lat,Lng"), "PARM": ("QNf", "TimeUS,Name,Value")}
    kinds |= {"MAG2": kinds["MAG"]}
    sizes = {"Q": 8, "f": 4, "c": 2, "C": 2, "B": 1, "I": 4, "H": 2, "L": 4, "N": 16}
    parts = [struct.pack("<BB4s16s64s", 128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")]
    for number, (name, (form, columns)) in enumerate(kinds.items(), 1):
        length = 3 + sum(sizes[letter] for letter in form)
        parts.append(struct.pack("<BB4s16s64s", number, length, name.encode(), form.encode(), columns.encode()))
    parts = [b"\xa3\x95\x80" + part for part in parts]
    for name, value in zip((b"COMPASS_USE", b"COMPASS_USE2"), use, strict=True):
        parts.append(b"\xa3\x95\x04" + struct.pack("<Q16sf", 0, name, value))
    week, second = divmod(UTC - 315964800 + 18, 7 * 86400)
    for row, (field, angles) in enumerate(zip((AXES / 100).tolist(), ATTITUDE.tolist(), strict=True)):
        time = 1_000_000 + 100_000 * row
        fix = 3, int(second * 1000) + 100 * row, int(week), *(round(x * 1e7) for x in PLACE)
        parts.append(b"\xa3\x95\x03" + struct.pack("<QBIHii", time, *fix))
        for number, factor in enumerate((1.0, 0.5)):
            axes = (factor * axis for axis in field)
            kind, number_here = (b"\x05", 0) if older and number else (b"\x01", number)
            values = (time, number_here, *axes, health[number])
            parts.append(b"\xa3\x95" + kind + struct.pack("<QBfffB", *values))
        roll, pitch, yaw = (round(100 * angle) for angle in angles)
        parts.append(b"\xa3\x95\x02" + struct.pack("<QhhH", time, roll, pitch, yaw % 36000))
    return b"".join(parts)


def nmea(*extra: str, tag: bool = False) -> bytes:
    """Sentences of NMEA 0183 with their checksums; with TAG blocks, RMC has no date."""
    bodies = []
    for row, (field, angles) in enumerate(zip((AXES / 1000).tolist(), ATTITUDE.tolist(), strict=True)):
        lat, lon = (f"{int(x):0{n}}{60 * (x % 1):010.7f}" for x, n in zip(PLACE, (2, 3), strict=True))
        date = "" if tag else "300626"
        axes = ",".join(f"G,{value:.5f},,MAG_{name}_UT" for name, value in zip("XYZ", field, strict=True))
        turn = f"A,{angles[1]:.2f},D,PTCH,A,{angles[0]:.2f},D,ROLL"
        some = [f"GPRMC,0613{row:02}.00,A,{lat},N,{lon},E,5.000,77.52,{date},,,A", f"HEHDT,{angles[2] % 360:.1f},T"]
        some += [f"IIXDR,{turn},{axes}", f"HCHDG,{(angles[2] - 3) % 360:.1f},0.0,E,3.0,E"]
        bodies += [(f"\\c:{int(UTC) + row}*00\\" if tag else "", body) for body in some]
    bodies += [("", body) for body in extra]
    sums = [(start, body, functools.reduce(operator.xor, body.encode())) for start, body in bodies]
    return "".join(f"{start}${body}*{total:02X}\r\n" for start, body, total in sums).encode()
