"""Logs of autopilots, written by the tests: the same axes, attitude and position come out of each format."""

from __future__ import annotations

import struct
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from magrl.field import IGRF, elements_at
from magrl.logs import Log, axes_of_elements, elements_of_axes, read_log

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
    assert log.tensor("latitude", "longitude")[5].tolist() == pytest.approx(PLACE, abs=1e-6)


def packed(kind: str, *content: bytes) -> bytes:
    body = b"".join(content)
    return struct.pack("<HB", len(body), ord(kind)) + body


def ulog(magnetometer: str = "vehicle_magnetometer", axes: str = "float[3] magnetometer_ga") -> Iterator[bytes]:
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
        place = round(PLACE[0] * 1e7), round(PLACE[1] * 1e7), float("nan"), 3 if row > 1 else 0
        yield packed("D", struct.pack("<HQQiifB", 2, time, int(UTC * 1e6) + time if row > 1 else 0, *place))


def test_px4(tmp_path: Path) -> None:
    path = tmp_path / "log.ulg"
    path.write_bytes(b"".join(ulog()))
    log = read_log(path)
    check(log)
    assert log.source == "PX4 ULog, vehicle_magnetometer"
    assert log.north == "true"
    assert [note for note in log.notes if "circular" in note]
    path.write_bytes(b"".join(ulog("sensor_mag", "float x;float y;float z")))
    assert any("without the calibration of the autopilot" in note for note in read_log(path).notes)


def test_px4_without_a_magnetometer_truncated_and_no_log(tmp_path: Path) -> None:
    path = tmp_path / "log.ulg"
    path.write_bytes(b"".join(ulog("vehicle_mag")))
    with pytest.raises(ValueError, match=r"none of vehicle_magnetometer, .* is among its topics, vehicle_attitude, "):
        read_log(path)
    path.write_bytes(b"".join(ulog())[:-300])
    assert len(read_log(path).samples) < 12
    path.write_bytes(b"no log" * 9)
    with pytest.raises(ValueError, match=r"cannot read .*log.ulg"):
        read_log(path)


@pytest.mark.parametrize(("module", "name"), [("pyulog", "log.ulg")])
def test_a_missing_package_is_named(tmp_path: Path, monkeypatch, module: str, name: str) -> None:
    (tmp_path / name).write_bytes(b"1")
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=rf"needs the package {module}: pip install 'magrl\[logs\]'"):
        read_log(tmp_path / name)
