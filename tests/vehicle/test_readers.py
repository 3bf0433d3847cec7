"""Logs of autopilots, written by the tests: the same axes, attitude and position come out of each format."""

from __future__ import annotations

import math
import struct
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pandas
import pytest
import torch
from pymavlink.DFReader import DFReader_binary
from pymavlink.dialects.v20.ardupilotmega import (
    MAVLink,
    MAVLink_attitude_message,
    MAVLink_gps_raw_int_message,
    MAVLink_highres_imu_message,
    MAVLink_raw_imu_message,
    MAVLink_vfr_hud_message,
)
from pynmeagps import NMEAReader, calc_checksum
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from support.logs import ATTITUDE, AXES, ELEMENTS, PLACE, UTC, dataflash, nmea, quaternions, ulog

from magrl.vehicle.logs import Log, elements_of_axes, from_enu, read_log
from magrl.vehicle.logs.autopilots import nmea_values


def check(log: Log, *, date: str | None = "2026-06-30") -> None:
    """The elements of a log are those that were written, at their place and date."""
    found = elements_of_axes(log.tensor("x", "y", "z"), log.tensor("roll", "pitch", "heading"))
    assert len(found) == 12
    assert (found - ELEMENTS).abs().amax(0).lt(torch.tensor([0.1, 0.05, 20.0])).all()
    assert log.date == date
    assert log.tensor("latitude", "longitude")[0].tolist() == pytest.approx(PLACE, abs=1e-6)


def written(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def test_px4(tmp_path: Path) -> None:
    path = written(tmp_path / "log.ulg", ulog())
    log = read_log(path)
    check(log)
    assert "the file is damaged or truncated" not in log.notes
    assert log.source == "PX4 ULog: vehicle_magnetometer, vehicle_attitude, vehicle_gps_position"
    assert [note for note in log.notes if "D is the model's" in note]
    notes = read_log(written(path, ulog({"sensor_mag": 1.0}))).notes
    assert any("without the calibration of the autopilot" in note for note in notes)


@pytest.mark.parametrize(
    ("heading", "flag", "north"),
    [(math.nan, None, "model"), (0.5, None, "model"), (0.5, 0, "model"), (0.5, 1, "true"), (math.nan, 1, "true")],
)
def test_px4_has_true_north_if_the_estimator_uses_gnss(tmp_path: Path, heading: float, flag, north: str) -> None:
    assert read_log(written(tmp_path / "log.ulg", ulog(heading=heading, flag=flag))).north == north


@pytest.mark.parametrize(("second", "selected"), [(0.0, 0), (0.5, 0), (0.5, 1), (0.0, 1)])
def test_px4_has_the_selected_healthy_magnetometer(tmp_path: Path, second: float, selected: int) -> None:
    names = {"vehicle_magnetometer:0": 1.0, "vehicle_magnetometer:1": second, "sensor_mag:0": 0.25}
    path = written(tmp_path / "log.ulg", ulog(names, selected=selected))
    factor = second if second and selected else 1.0
    assert torch.allclose(read_log(path).tensor("x", "y", "z"), factor * AXES, atol=1)
    assert torch.allclose(read_log(path, sensor="sensor_mag").tensor("x", "y", "z"), 0.25 * AXES, atol=1)
    with pytest.raises(ValueError, match=r"sensor must be one of 'vehicle_magnetometer', .*, got 'mag'"):
        read_log(path, sensor="mag")


def test_px4_truncated_and_no_log(tmp_path: Path) -> None:
    path = tmp_path / "log.ulg"
    cut = read_log(written(path, ulog()[: len(ulog()) * 6 // 10]))
    assert len(cut.samples) < 12
    assert "the file is damaged or truncated" in cut.notes
    with pytest.raises(ValueError, match=r"cannot read .*log.ulg"):
        read_log(written(path, b"ULog" * 9))


def test_ardupilot(tmp_path: Path) -> None:
    path = written(tmp_path / "log.BIN", dataflash())
    log = read_log(path)
    check(log)
    assert log.north == "model"
    assert "D is the model's" in log.notes[0]
    assert len(read_log(written(path, dataflash()[:-400])).samples) < 12


@pytest.mark.parametrize("older", [False, True])
@pytest.mark.parametrize("options", [{"use": (0.0, 1.0)}, {"health": (0, 1)}, {"sensor": ("MAG:1", "MAG2")}])
def test_ardupilot_has_the_magnetometer_that_is_used_and_healthy(tmp_path: Path, options, older: bool) -> None:
    options = {"older": older, **options}
    sensor = options.pop("sensor", (None, None))[older]
    log = read_log(written(tmp_path / "log.bin", dataflash(**options)), sensor=sensor)
    assert torch.allclose(log.tensor("x", "y", "z"), 0.5 * AXES, atol=1)


def test_ardupilot_as_text(tmp_path: Path) -> None:
    """The same messages as lines, after a line of another program."""
    path, text = written(tmp_path / "log.bin", dataflash()), "ArduCopter V4.5.7\n"
    with closing(DFReader_binary(str(path))) as reader:
        while message := reader.recv_msg():
            values = (str(getattr(message, name)) for name in message.get_fieldnames())
            text += ", ".join([message.get_type(), *values]) + "\n"
    log, same = read_log(written(tmp_path / "log.log", text.encode())), read_log(path)
    check(log)
    pandas.testing.assert_frame_equal(log.samples, same.samples)
    assert log.source == "ArduPilot DataFlash, text: GPS, MAG, ATT"


def telemetry(path: Path, kind: str, air: float) -> Path:
    """Telemetry of ArduPilot or PX4; positions without a fix do not count."""
    link, parts = MAVLink(None), []
    for row, (axes, angles) in enumerate(zip(AXES.tolist(), ATTITUDE.tolist(), strict=True)):
        place = [round(x * 1e7) for x in PLACE] if row else [0, 0]
        zeros = (0,) * 6
        imu = MAVLink_raw_imu_message(0, *zeros, *(round(axis / 100) for axis in axes))
        attitude = MAVLink_attitude_message(0, *map(math.radians, angles), 0, 0, 0)
        if kind == "PX4":
            imu = MAVLink_highres_imu_message(0, *zeros, *(axis / 1e5 for axis in axes), 0, 0, 0, 0, 0, 1)
        fix = MAVLink_gps_raw_int_message(0, 3 if row else 1, *place, *zeros)
        messages = imu, attitude, fix, MAVLink_vfr_hud_message(air, 20.0, 0, 0, 0.0, 0.0)
        stamp = struct.pack(">Q", int((UTC + row) * 1e6))
        parts += [stamp + message.pack(link) for message in messages]
    return written(path, b"".join(parts))


@pytest.mark.parametrize(("kind", "air"), [("ArduPilot", 25.0), ("PX4", math.nan), ("PX4", 0.0)])
def test_telemetry(tmp_path: Path, kind: str, air: float) -> None:
    """Milligauss or gauss; airspeed, or groundspeed without an airspeed sensor."""
    log = read_log(telemetry(tmp_path / "log.tlog", kind, air))
    found = elements_of_axes(log.tensor("x", "y", "z"), log.tensor("roll", "pitch", "heading"))
    limits = torch.tensor([0.3, 0.2, 100.0]) if kind == "ArduPilot" else torch.tensor([0.001, 0.001, 1.0])
    assert (found - ELEMENTS).abs().amax(0).lt(limits).all(), "whole milligauss, or float32"
    assert log.tensor("latitude", "longitude")[0].tolist() == pytest.approx(PLACE, abs=1e-6)
    assert log.samples["speed"].tolist() == [air if air > 0 else 20.0] * 12
    speed = "airspeed" if air > 0 else "groundspeed"
    names = {"ArduPilot": ["RAW_IMU", "ATTITUDE"], "PX4": ["HIGHRES_IMU:1", "ATTITUDE"]}[kind]
    assert log.source == f"MAVLink telemetry: {', '.join([*names, 'GPS_RAW_INT', f'VFR_HUD.{speed}'])}"


def bag(path: Path, version: int, storage: str) -> Path:
    """A bag of ROS, recorded late and in another order, with an Imu without attitude and a magnetometer of zeros."""
    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    names = (name for name in store.types if not name.startswith("std_msgs/msg/T"))
    kind = {name.rpartition("/")[2]: store.types[name] for name in names}
    zeros, unknown, place = np.zeros(9), np.array([-1.0, *[0.0] * 8]), (*PLACE, 0.0)
    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    with Writer1(path) if version == 1 else Writer2(path, version=9, storage_plugin=plugin) as writer:
        types = dict.fromkeys(("/dead", "/mag"), "MagneticField") | dict.fromkeys(("/accelerometer", "/imu"), "Imu")
        types |= {"/fix": "NavSatFix"}
        topics = {
            topic: writer.add_connection(topic, f"sensor_msgs/msg/{name}", typestore=store)
            for topic, name in types.items()
        }
        raw = store.serialize_ros1 if version == 1 else store.serialize_cdr
        for row, q in enumerate(quaternions(from_enu(ATTITUDE)).tolist()):
            stamp = kind["Time"](sec=int(UTC) + row, nanosec=0)
            header = kind["Header"](**({"seq": 0} if version == 1 else {}), stamp=stamp, frame_id="")
            none, turn = kind["Vector3"](x=0.0, y=0.0, z=0.0), dict(zip("wxyz", q, strict=True))
            turns = turn, {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}, dict.fromkeys("wxyz", 0.0)
            still, north, nothing = (kind["Quaternion"](**values) for values in turns)
            x, y, z = (AXES[row] / 1e9).tolist()
            messages = {
                "/dead": kind["MagneticField"](header, none, zeros),
                "/mag": kind["MagneticField"](header, kind["Vector3"](x=x, y=-y, z=-z), zeros),
                "/accelerometer": kind["Imu"](header, north, unknown, none, zeros, none, zeros),
                "/imu": kind["Imu"](header, nothing if row == 6 else still, zeros, none, zeros, none, zeros),
                "/fix": kind["NavSatFix"](header, kind["NavSatStatus"](status=0, service=1), *place, zeros, 0),
            }
            for topic, message in messages.items():
                time = UTC + row + 0.5 + 2 * (topic == "/mag")
                writer.write(topics[topic], round(time * 1e9), raw(message, message.__msgtype__))
    return path


@pytest.mark.parametrize(("version", "storage"), [(1, "bag"), (2, "db3"), (2, "mcap")])
def test_ros(tmp_path: Path, version: int, storage: str) -> None:
    """Axes and attitude are those of ROS: forward, left, up; east, north, up.

    A file of a folder is read with the metadata of the folder and without, by its suffix.
    """
    path = bag(tmp_path / ("log.bag" if version == 1 else "log"), version, storage)
    log = read_log(path)
    check(log)
    assert log.north is None
    assert log.source.startswith("ROS bag: ")
    assert "/mag" in log.source
    with pytest.raises(ValueError, match="no sample has a field"):
        read_log(path, sensor="/dead")
    file = path if version == 1 else next(path.glob(f"*.{storage}"))
    check(read_log(file))
    if version == 2:
        (path / "metadata.yaml").unlink()
        check(read_log(file))


def test_nmea(tmp_path: Path) -> None:
    """A heading from true north is preferred to that of the compass, a speed through the water to that over ground."""
    path = written(tmp_path / "log.txt", nmea())
    log = read_log(path)
    check(log)
    assert log.north == "true"
    assert log.samples["speed"].tolist() == pytest.approx([5 * 1852 / 3600] * 12)
    path = written(path, nmea("VWVHW,,T,,M,4.0,N,7.4,K", "GPZDA,082710.00,01,07,2026,00,00"))
    assert read_log(path).samples["speed"].tolist() == pytest.approx([4 * 1852 / 3600] * 12)
    with pytest.raises(ValueError, match=r"no sentence with a time \(TAG, RMC, ZDA\)"):
        read_log(written(path, b"$GPGLL,4717.1,N,00833.9,E,092321.00,A,A*60\r\n"))
    tagged = read_log(written(path, nmea(tag=True)))
    check(tagged)
    assert tagged.samples["time"].tolist() == pytest.approx(UTC + np.arange(12))


@pytest.mark.parametrize(
    ("body", "values"),
    [
        ("IIVBW,3.6,-0.4,A,-1.8,0.2,A", {"speed_water": 1.852, "speed_ground": -0.926}),
        ("IIVBW,3.6,-0.4,V,-1.8,0.2,A,,V,,V", {"speed_ground": -0.926}),
        ("IIXDR,A,2.5,D,PTCH-BOX,A,-1.0,D,Roll#2,A,9.0,D,ROLLER", {"pitch": 2.5, "roll": -1.0}),
        ("IIXDR,A,2.5,D,PITCH_1,C,9.0,C,ROLL,A,3.0,D,RUDDER", {"pitch": 2.5}),
    ],
)
def test_values_of_a_sentence(body: str, values: dict[str, float]) -> None:
    """Transducers may have the name of a device after their own."""
    message = NMEAReader.parse(f"${body}*{calc_checksum(body)}\r\n")
    assert nmea_values(message) == pytest.approx(values)


def test_sentences_that_say_nothing(tmp_path: Path) -> None:
    """Also without a checksum."""
    same = read_log(written(tmp_path / "log.log", nmea())).samples
    silent = "GPZDA,095559,,,,00", "GPRMC,061312.00,V,0000.0,N,00000.0,E,,,060180,,,N", "HETHS,90.0,V"
    silent += "GPGGA,061312,0000.0,N,00000.0,E,0,00,,,,,,,", "GPGLL,0000.0,N,00000.0,E,061312.00,V,N"
    for sentence in silent:
        for content in nmea(sentence), nmea() + f"${sentence}\r\n".encode():
            assert read_log(written(tmp_path / "log.log", content)).samples.equals(same)


def test_the_deviation_of_a_compass_counts(tmp_path: Path) -> None:
    content = nmea("HCHDG,180.0,5.0,W,10.0,W")
    lines = [line for line in content.splitlines(keepends=True) if b"HDT" not in line and b"E,3.0,E" not in line]
    log = read_log(written(tmp_path / "log.nmea", b"".join([lines[0], lines[-1], *lines[1:], lines[-1]])))
    assert log.samples["heading"].tolist() == pytest.approx([175.0] * len(log.samples))


def test_a_missing_package_is_named(tmp_path: Path, monkeypatch) -> None:
    starts = {"pyulog": b"ULog", "rosbags": b"#ROSBAG", "pynmeagps": b"junk$GPRMC,"}
    for module, start in starts.items():
        for name in [module, *(each for each in sys.modules if each.startswith(f"{module}."))]:
            monkeypatch.setitem(sys.modules, name, None)
        with pytest.raises(ImportError, match=rf"needs the package {module}: pip install 'magrl\[logs\]'"):
            read_log(written(tmp_path / "log", start))
