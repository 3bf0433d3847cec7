"""Logs of autopilots, written by the tests: the same axes, attitude and position come out of each format."""

from __future__ import annotations

import functools
import math
import operator
import struct
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from magrl.field import IGRF, elements_at
from magrl.logs import Log, axes_of_elements, elements_of_axes, from_enu, read_log

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


def check(log: Log, *, date: str | None = "2026-06-30") -> None:
    """The elements of a log are those that were written, at their place and date."""
    found = elements_of_axes(log.tensor("x", "y", "z"), log.tensor("roll", "pitch", "heading"), north="true").elements
    assert len(found) == 12
    assert (found - ELEMENTS).abs().amax(0).lt(torch.tensor([0.1, 0.05, 20.0])).all()
    assert log.date == date
    assert log.tensor("latitude", "longitude")[0].tolist() == pytest.approx(PLACE, abs=1e-6)


def packed(kind: str, *content: bytes) -> bytes:
    body = b"".join(content)
    return struct.pack("<HB", len(body), ord(kind)) + body


def ulog(
    magnetometer: str = "vehicle_magnetometer",
    axes: str = "float[3] magnetometer_ga",
    heading: float = math.nan,
) -> Iterator[bytes]:
    """A ULog file: https://docs.px4.io/main/en/dev_log/ulog_file_format.html."""
    yield b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0) + packed("B", bytes(40))
    topics = {magnetometer: axes, "vehicle_attitude": "float[4] q"}
    topics["vehicle_gps_position"] = "uint64_t time_utc_usec;int32_t lat;int32_t lon;float heading;uint8_t fix_type"
    for name, fields in topics.items():
        yield packed("F", f"{name}:uint64_t timestamp;{fields};".encode())
    for number, name in enumerate(topics):
        yield packed("A", struct.pack("<BH", 0, number), name.encode())
    for row, (field, q) in enumerate(zip((AXES / 1e5).tolist(), quaternions(ATTITUDE).tolist(), strict=True)):
        time = 1_000_000 + 100_000 * row
        yield packed("D", struct.pack("<HQ3f", 0, time, *field))
        yield packed("D", struct.pack("<HQ4f", 1, time, *q))
        place = [round(x * 1e7) for x in PLACE] if row > 1 else (0, 0)  # no fix in the first two rows
        stamp, fix = (int(UTC * 1e6) + time, 3) if row > 1 else (0, 0)
        yield packed("D", struct.pack("<HQQiifB", 2, time, stamp, *place, heading, fix))


def test_px4(tmp_path: Path) -> None:
    path = tmp_path / "log.ulg"
    path.write_bytes(b"".join(ulog()))
    log = read_log(path)
    check(log)
    assert "the file is damaged or truncated" not in log.notes
    assert log.source == "PX4 ULog, vehicle_magnetometer"
    assert log.north == "model"
    assert [note for note in log.notes if "D is that of the model" in note]
    path.write_bytes(b"".join(ulog(heading=0.5)))
    assert read_log(path).north == "true", "GNSS with two antennas"
    path.write_bytes(b"".join(ulog("sensor_mag", "float x;float y;float z")))
    assert any("without the calibration of the autopilot" in note for note in read_log(path).notes)


def test_px4_without_a_magnetometer_truncated_and_no_log(tmp_path: Path) -> None:
    path = tmp_path / "log.ulg"
    path.write_bytes(b"".join(ulog("vehicle_mag")))
    with pytest.raises(ValueError, match=r"none of vehicle_magnetometer, .* is among its topics, vehicle_attitude, "):
        read_log(path)
    path.write_bytes(b"".join(ulog())[:-290])
    cut = read_log(path)
    assert len(cut.samples) < 12
    assert "the file is damaged or truncated" in cut.notes
    path.write_bytes(b"no log" * 9)
    with pytest.raises(ValueError, match=r"cannot read .*log.ulg"):
        read_log(path)


def dataflash() -> Iterator[bytes]:
    """A DataFlash file: messages that describe the formats, and messages of these."""
    kinds = {"MAG": ("Qfff", "TimeUS,MagX,MagY,MagZ"), "ATT": ("QccC", "TimeUS,Roll,Pitch,Yaw")}
    kinds["GPS"] = "QBIHLL", "TimeUS,Status,GMS,GWk,Lat,Lng"
    sizes = {"Q": 8, "f": 4, "c": 2, "C": 2, "B": 1, "I": 4, "H": 2, "L": 4}
    yield b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", 128, 89, b"FMT", b"BBnNZ", b"Type,Length,Name,Format,Columns")
    for number, (name, (form, columns)) in enumerate(kinds.items(), 1):
        length = 3 + sum(sizes[letter] for letter in form)
        parts = number, length, name.encode(), form.encode(), columns.encode()
        yield b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", *parts)
    week, second = divmod(UTC - 315964800 + 18, 7 * 86400)
    for row, (field, angles) in enumerate(zip((AXES / 100).tolist(), ATTITUDE.tolist(), strict=True)):
        time = 1_000_000 + 100_000 * row
        place = round(PLACE[0] * 1e7), round(PLACE[1] * 1e7)
        yield b"\xa3\x95\x03" + struct.pack("<QBIHii", time, 3, int(second * 1000) + 100 * row, int(week), *place)
        yield b"\xa3\x95\x01" + struct.pack("<Qfff", time, *field)
        roll, pitch, yaw = (round(100 * angle) for angle in angles)
        yield b"\xa3\x95\x02" + struct.pack("<QhhH", time, roll, pitch, yaw % 36000)


def test_ardupilot(tmp_path: Path) -> None:
    path = tmp_path / "log.BIN"
    path.write_bytes(b"".join(dataflash()))
    log = read_log(path)
    check(log)
    assert log.north == "model"
    assert "D is that of the model" in log.notes[0]
    path.write_bytes(b"".join(dataflash())[:-400])
    assert len(read_log(path).samples) < 12


@pytest.mark.parametrize("version", [1, 2])
def test_ros(tmp_path: Path, version: int) -> None:
    """Axes and attitude are those of ROS: forward, left, up; east, north, up."""
    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    kind = {
        name.rpartition("/")[2]: each for name, each in store.types.items() if not name.startswith("std_msgs/msg/T")
    }
    stamp, one = kind["Time"](sec=int(UTC), nanosec=0), np.zeros(9)
    header = kind["Header"](**({"seq": 0} if version == 1 else {}), stamp=stamp, frame_id="")
    path = tmp_path / ("log.bag" if version == 1 else "log")
    with Writer1(path) if version == 1 else Writer2(path, version=9) as writer:

        def write(connection, message, time: float) -> None:
            raw = store.serialize_ros1 if version == 1 else store.serialize_cdr
            writer.write(connection, round(time * 1e9), raw(message, message.__msgtype__))

        names = ("MagneticField", "Imu", "NavSatFix")
        topics = {name: writer.add_connection(name, f"sensor_msgs/msg/{name}", typestore=store) for name in names}
        for row, q in enumerate(quaternions(from_enu(ATTITUDE)).tolist()):
            x, y, z = (AXES[row] / 1e9).tolist()
            vector, turn = kind["Vector3"](x=x, y=-y, z=-z), kind["Quaternion"](**dict(zip("wxyz", q, strict=True)))
            none, time = kind["Vector3"](x=0.0, y=0.0, z=0.0), UTC + row
            field = kind["MagneticField"](header=header, magnetic_field=vector, magnetic_field_covariance=one)
            imu = (header, turn, one, none, one, none, one)
            fix = kind["NavSatStatus"](status=0, service=1)
            write(topics["MagneticField"], field, time)
            write(topics["Imu"], kind["Imu"](*imu), time)
            write(topics["NavSatFix"], kind["NavSatFix"](header, fix, *PLACE, 0.0, one, 0), time)
    log = read_log(path)
    check(log)
    assert log.north is None
    assert "MagneticField (sensor_msgs/msg/MagneticField)" in log.source


def nmea(*extra: str) -> bytes:
    """Sentences of NMEA 0183 with their checksums."""
    bodies = []
    for row, (field, angles) in enumerate(zip((AXES / 1000).tolist(), ATTITUDE.tolist(), strict=True)):
        lat, lon = (f"{int(x):0{n}}{60 * (x % 1):010.7f}" for x, n in zip(PLACE, (2, 3), strict=True))
        bodies.append(f"GPRMC,0613{row:02}.00,A,{lat},N,{lon},E,5.000,77.52,300626,,,A")
        axes = ",".join(f"G,{value:.5f},,MAG_{name}_UT" for name, value in zip("XYZ", field, strict=True))
        bodies += [f"HEHDT,{angles[2] % 360:.1f},T", f"IIXDR,A,{angles[1]:.2f},D,PTCH,A,{angles[0]:.2f},D,ROLL,{axes}"]
        bodies += [f"HCHDG,{(angles[2] - 3) % 360:.1f},0.0,E,3.0,E"]
    sums = [(body, functools.reduce(operator.xor, body.encode())) for body in (*bodies, *extra)]
    return "".join(f"${body}*{total:02X}\r\n" for body, total in sums).encode()


def test_nmea(tmp_path: Path) -> None:
    """A heading from true north is preferred to that of the compass, a speed through the water to that over ground."""
    path = tmp_path / "log.nmea"
    path.write_bytes(nmea())
    log = read_log(path)
    check(log)
    assert log.north == "true"
    assert log.samples["speed"].tolist() == pytest.approx([5 * 1852 / 3600] * 12)
    path.write_bytes(nmea("VWVHW,,T,,M,4.0,N,7.4,K", "GPZDA,082710.00,01,07,2026,00,00"))
    assert read_log(path).samples["speed"].tolist() == pytest.approx([4 * 1852 / 3600] * 12)
    path.write_bytes(b"$GPGLL,4717.1,N,00833.9,E,092321.00,A,A*60\r\n")
    with pytest.raises(ValueError, match=r"no sentence with a time \(RMC or ZDA\)"):
        read_log(path)


@pytest.mark.parametrize(
    ("module", "name"),
    [("pyulog", "log.ulg"), ("pymavlink", "log.bin"), ("rosbags", "log.bag"), ("pynmeagps", "log.nmea")],
)
def test_a_missing_package_is_named(tmp_path: Path, monkeypatch, module: str, name: str) -> None:
    (tmp_path / name).write_bytes(b"1")
    for name_ in [module, *(each for each in sys.modules if each.startswith(f"{module}."))]:
        monkeypatch.setitem(sys.modules, name_, None)
    with pytest.raises(ImportError, match=rf"needs the package {module}: pip install 'magrl\[logs\]'"):
        read_log(tmp_path / name)
