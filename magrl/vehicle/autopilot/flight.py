"""A flight through a link: the messages are recorded, so that a flight that was interrupted continues."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Protocol

from magrl.checks import short
from magrl.files import write_atomically
from magrl.training.checkpoints import locked
from magrl.vehicle.autopilot.loop import LOG, NO_STATE, Loop, Measurement, clock, tolerated
from magrl.vehicle.onboard import Command

HEADER = "time_s,mag_x_nT,mag_y_nT,mag_z_nT,roll_deg,pitch_deg,heading_{north}_deg,speed_m_s,received_s\n"
"""Columns of the recorded messages, which :func:`magrl.vehicle.logs.read_log` reads."""
STATE_LINES = 2000
"""Messages after which the state is saved: as many are repeated at most."""


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
        """Send the estimated way."""


def fly(loop: Loop, link: Link, folder: Path | str) -> Iterator[Command]:
    """Steer through a link until the vehicle stops, and yield each new command.

    ``messages.csv`` in the folder holds the messages that count, and ``flight.json`` the options of the vehicle and of
    the loop, its start, its moves, and the state of the loop after some of the messages. If the files exist, the
    messages after that are repeated without sending anything, and the flight continues with the same commands, of which
    the last one is yielded again. Between, the vehicle is taken to have kept its heading and its speed.

    An error of the system in sending and in writing is logged, and the steering goes on. What was not written is
    written later.

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
    with locked(folder), closing(_Record(loop, folder)) as record:
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
    """The files of a flight: what they hold is repeated, and what counts is added."""

    def __init__(self, loop: Loop, folder: Path) -> None:
        self._loop, self._state, self._path = loop, folder / "flight.json", folder / "messages.csv"
        if not self._path.exists():
            write_atomically(self._path, HEADER.format(north=loop.vehicle.options.north).encode())
        journal = json.loads(loop.vehicle._journal.model_dump_json(exclude={"steps"}))
        calibration = loop.calibration and loop.calibration.model_dump(mode="json")
        self._options = journal.pop("options") | journal | {"read_s": loop.read_s, "calibration": calibration}
        self._lines, self._waiting = 0, bytearray()
        self._repeat(self._restored() if self._state.exists() else 1)
        self._file = self._path.open("ab", buffering=0)
        self._save()

    def _restored(self) -> int:
        """Restore the state, and return how many lines of the record it includes."""
        try:
            saved = json.loads(self._state.read_bytes())
            options, steps, state, lines = (saved[name] for name in ("options", "steps", "loop", "lines"))
        except (ValueError, KeyError, TypeError) as error:
            LOG.warning("%s is damaged, and all messages are repeated: %r", self._state, error)
            return 1
        texts = [
            f"{name} {short(options.get(name))}" for name, own in self._options.items() if options.get(name) != own
        ]
        if texts:
            raise ValueError(f"{self._state} is of a flight with {', '.join(texts)}: give these, or another folder")
        for step in steps:
            self._loop.command = self._loop.vehicle.step(**step)
        vars(self._loop).update(state)
        return lines

    def _repeat(self, done: float) -> None:
        """Repeat the messages after some lines, up to the first line that is no message."""
        with self._path.open("rb") as file:
            for line in file:
                if not line.endswith(b"\n"):  # it was not written whole
                    os.truncate(self._path, file.tell() - len(line))
                    return
                self._lines += 1
                if self._lines <= done:
                    continue
                try:
                    time, *rest = line.decode().rstrip("\n").split(",")
                    self._loop.take(Measurement._make([float(time), *(float(cell) if cell else None for cell in rest)]))
                except (TypeError, ValueError, RuntimeError) as error:
                    LOG.error("line %d of %s is no message, those before it count: %s", self._lines, self._path, error)
                    done = math.inf

    def close(self) -> None:
        """Close the record."""
        self._file.close()

    def write(self, measurement: Measurement) -> None:
        """Write a message, and now and then the state after it; what cannot be written waits for the next message."""
        self._lines += 1
        cells = ("" if value is None else repr(float(value)) for value in measurement)
        self._waiting += ",".join(cells).encode() + b"\n"
        with tolerated("messages wait in memory, since they cannot be written"):
            while self._waiting:
                del self._waiting[: self._file.write(self._waiting)]
            if self._lines % STATE_LINES == 0:
                self._save()

    def _save(self) -> None:
        """Save the state."""
        steps = [dict(step) for step in self._loop.vehicle._steps]
        state = {name: value for name, value in vars(self._loop).items() if name not in NO_STATE}
        content = {"options": self._options, "steps": steps, "loop": state, "lines": self._lines}
        with tolerated("the state of the flight is not saved"):
            write_atomically(self._state, json.dumps(content, default=float).encode())
