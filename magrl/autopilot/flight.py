"""A flight through a link: the messages are recorded, so that a flight that was interrupted continues."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol, Self

from magrl.autopilot.loop import Loop, Measurement
from magrl.onboard import Command

HEADER = "time_s,mag_x_nT,mag_y_nT,mag_z_nT,roll_deg,pitch_deg,heading_{north}_deg,speed_m_s"
"""Columns of the recorded messages, which :func:`magrl.logs.read_log` reads."""


class Link(Protocol):
    """Connection to an autopilot.

    Iterating yields a :class:`~magrl.autopilot.Measurement` for each message, and None now and then where none comes.
    """

    period_s: float
    """Time after which a heading is sent again [s of the vehicle's clock]."""

    def __iter__(self) -> Iterator[Measurement | None]:
        """Iterate over the messages."""

    def steer(self, heading_deg: float) -> None:
        """Send a heading to steer, in the reference of the autopilot."""

    def report(self, command: Command, text: str) -> None:
        """Send the estimated way, and a text for the operator, empty for none."""


def fly(loop: Loop, link: Link, folder: Path | str) -> Iterator[Command]:
    """Steer through a link until the vehicle stops, and yield each new command.

    ``start.json`` in the folder holds the options of the vehicle and its start, ``loop.json`` those of the loop, and
    ``messages.csv`` all messages. If the files exist, the messages are repeated without sending anything, and the
    flight continues with the same commands. Between, the vehicle is taken to have kept its heading and its speed.

    Args:
        loop: loop that has taken no message.
        link: connection to the autopilot.
        folder: folder of the flight.

    Raises:
        ValueError: for a folder of a flight with other options.
        OSError: if a file cannot be read or written.

    Example:
        >>> import tempfile
        >>> from magrl.onboard import Onboard
        >>> vehicle = Onboard("secant")
        >>> vehicle.start((-11.6, 75.4, 13240.0))
        >>> list(fly(Loop(vehicle), [], tempfile.mkdtemp()))  # a link without messages
        []
    """
    with _Record(loop, Path(folder)) as record:
        yield from filter(None, map(loop.take, record.before))
        if not (loop.command and loop.command.stop):
            yield from _steered(loop, link, record)


def _steered(loop: Loop, link: Link, record: _Record) -> Iterator[Command]:
    """Steer by the messages of a link, and yield each new command."""
    sent = -math.inf
    for measurement in filter(None, link):
        record.write(measurement)
        command = loop.take(measurement)
        if command:
            link.report(command, command.reason or loop.note)
            yield command
            if command.stop:
                return
        if loop.steer_deg is not None and (command or abs(measurement.time - sent) >= link.period_s):
            link.steer(loop.steer_deg)
            sent = measurement.time


class _Record:
    """The files of a flight."""

    def __init__(self, loop: Loop, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        start, settings, self._path = (folder / name for name in ("start.json", "loop.json", "messages.csv"))
        calibration = loop.calibration and loop.calibration.model_dump(mode="json")
        content = json.dumps({"read_s": loop.read_s, "calibration": calibration})
        self.before: list[Measurement] = []
        if not start.exists():
            settings.write_text(content)
            self._path.write_text(HEADER.format(north=loop.vehicle.options.north) + "\n")
            loop.vehicle.save(start)
            return
        target = loop.vehicle.target
        loop.vehicle.restore(start)
        if loop.vehicle.target != target or settings.read_text() != content:
            raise ValueError(f"{folder} is of a flight with another target or other options of the loop: give another")
        self.before = self._read()

    def _read(self) -> list[Measurement]:
        """Return the messages, without a last one that was not written whole, which is cut off."""
        content = self._path.read_bytes()
        whole = content[: content.rfind(b"\n") + 1]
        if whole != content:
            self._path.write_bytes(whole)
        rows = [line.split(",") for line in whole.decode().splitlines()[1:]]
        return [Measurement(*(float(cell) if cell else None for cell in row)) for row in rows]  # type: ignore[arg-type]

    def __enter__(self) -> Self:
        self._file = self._path.open("a", buffering=1)  # a line at a time
        return self

    def __exit__(self, *_: Any) -> None:
        self._file.close()

    def write(self, measurement: Measurement) -> None:
        """Write a message."""
        self._file.write(",".join("" if value is None else repr(float(value)) for value in measurement) + "\n")
