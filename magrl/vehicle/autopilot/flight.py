"""A flight through a link: the messages are recorded, so that a flight that was interrupted continues."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

from magrl.checks import short
from magrl.files import append, locked, write_atomically
from magrl.vehicle.autopilot.loop import LOG, Loop, Measurement, clock, tolerated
from magrl.vehicle.onboard import Command

HEADER = "time_s,mag_x_nT,mag_y_nT,mag_z_nT,roll_deg,pitch_deg,heading_{north}_deg,speed_m_s\n"
"""Columns of the recorded messages, which :func:`magrl.vehicle.logs.read_log` reads."""


class Link(Protocol):
    """Connection to an autopilot.

    Iterating yields a :class:`~magrl.vehicle.autopilot.Measurement` for each message, now and then None.
    """

    period_s: float
    """Time after which a heading is sent again [s]."""

    def __iter__(self) -> Iterator[Measurement | None]:
        """Iterate over the messages."""

    def steer(self, heading_deg: float) -> None:
        """Send a heading to steer, in the reference of the autopilot."""

    def report(self, command: Command) -> None:
        """Send the estimated displacement."""


def fly(loop: Loop, link: Link, folder: Path | str) -> Iterator[Command]:
    """Steer through a link until the vehicle stops, and yield each new command.

    ``messages.csv`` in the folder holds the messages that count, and ``flight.json`` the options of the flight. If the
    files exist, the messages are repeated without sending anything, and the flight continues with the same commands, of
    which the last one is yielded again. Between, the vehicle is taken to have kept its heading and its speed.

    Lines that are no messages are skipped, and their number is logged. An error of the system in sending or in writing
    is logged, and the steering goes on.

    Args:
        loop: loop that has taken no message.
        link: connection to the autopilot.
        folder: folder of the flight.

    Raises:
        ValueError: for a folder of a flight with other options or another start, or in which another process writes.
        OSError: if the files cannot be read or created.

    Example:
        >>> import tempfile
        >>> from magrl.vehicle.onboard import Onboard
        >>> vehicle = Onboard("secant")
        >>> vehicle.start((-11.6, 75.4, 13240.0))
        >>> list(fly(Loop(vehicle), [], tempfile.mkdtemp()))  # a link without messages
        []
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        record = _Record(loop, folder)
        if loop.command:
            yield loop.command
        if not (loop.command and loop.command.stop):
            yield from _steered(loop, link, record)


def _steered(loop: Loop, link: Link, record: _Record) -> Iterator[Command]:
    """Steer by the messages of a link, and yield each new command."""
    sent = -math.inf
    for measurement in link:
        command = measurement and loop.take(measurement)
        if measurement and loop.heard:
            record.write(loop.heard)
        if command:
            with tolerated("the command is not reported"):
                link.report(command)
            yield command
            if command.stop:
                return
        if loop.steer_deg is not None and (command or clock() - sent >= link.period_s):
            with tolerated("the heading is not sent"):
                link.steer(loop.steer_deg)
            sent = clock()
        elif loop.command is None and loop.note:
            LOG.warning(f"the first reading is refused: {loop.note}")
        elif measurement is None and loop.missing:
            LOG.info(f"waiting for {', '.join(loop.missing)}")


class _Record:
    """The files of a flight: its options, and its messages, which are repeated and to which new ones are added."""

    def __init__(self, loop: Loop, folder: Path) -> None:
        self._loop, self._path = loop, folder / "messages.csv"
        self._check_options(folder / "flight.json")
        if not self._path.exists():
            write_atomically(self._path, HEADER.format(north=loop.vehicle.options.north).encode())
        self._repeat()

    def _check_options(self, path: Path) -> None:
        """Write the options of a flight; raise where others are written already."""
        journal = json.loads(self._loop.vehicle._journal.model_dump_json(exclude={"steps"}))
        calibration = self._loop.calibration and self._loop.calibration.model_dump(mode="json")
        options = journal.pop("options") | journal | {"read_s": self._loop.read_s, "calibration": calibration}
        written = json.loads(path.read_bytes()) if path.exists() else options
        if texts := [f"{name} {short(written.get(name))}" for name, own in options.items() if written.get(name) != own]:
            raise ValueError(f"{path} is of a flight with {', '.join(texts)}: give these, or another folder")
        write_atomically(path, json.dumps(options).encode())

    def _repeat(self) -> None:
        """Repeat the messages; skip and count lines that are none."""
        *lines, cut = self._path.read_bytes().split(b"\n")
        os.truncate(self._path, self._path.stat().st_size - len(cut))  # it was not written whole
        skipped = 1 if cut else 0
        for line in lines[1:]:
            try:
                time, *rest = line.decode().split(",")
                cells = (float(cell) if cell else None for cell in rest)
                self._loop.take(Measurement._make([float(time), *cells]))
            except (TypeError, ValueError):
                skipped += 1
        if skipped:
            LOG.warning("%d lines of %s are no messages and are skipped", skipped, self._path)

    def write(self, measurement: Measurement) -> None:
        """Write a message."""
        cells = ("" if value is None else repr(float(value)) for value in measurement)
        with tolerated("a message is not recorded"):
            append(self._path, ",".join(cells).encode() + b"\n")
