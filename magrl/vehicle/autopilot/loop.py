"""The loop of a vehicle: measurements in, a heading to steer out, one step of the navigator for each leg."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from pandas import DataFrame

from magrl.checks import check_number
from magrl.field.elements import NAMES
from magrl.vehicle.logs import Calibration, Log, readings_of
from magrl.vehicle.logs.samples import ATTITUDE, AXES
from magrl.vehicle.onboard import Command, Onboard
from magrl.vehicle.onboard.limits import LONGER

LOG = logging.getLogger("magrl.vehicle.autopilot")
"""What an operator must know; what is said again and again, once in :data:`SELDOM_S`."""
SELDOM_S = 600.0
"""Time after which the same is logged again [s]."""
FASTEST_M_S = 1000.0
"""A greater speed is an error of the message; chosen [m/s]."""
STALE_S = 2.0
"""A sample of the field counts if the attitude is at most as old; chosen [s]."""
SILENT_S = 15.0
"""A speed or a heading that is older is not known any more; chosen [s]."""
LATE_S, GAP_S = 60.0, 3600.0
"""A message may be as much earlier, and later, than the one before; beyond, the vehicle's clock was set; chosen [s]."""
TURN_S = 120.0
"""A turn on the spot ends at the latest after this time; chosen [s]."""
_ALIGNED_DEG = 10.0  # the turn is made
_SHORT_KM = 1.0  # a shorter path is a turn, not a leg
_LEAST_SAMPLES = 3
_ONE_READING_KM = 1e9
_QUANTITIES = (*AXES, *ATTITUDE, "speed")
_ZERO = time.time() - time.monotonic()
SAID: dict[str, float] = {}
"""What was logged, and when [s]."""
_Place = tuple[float, float]


def _is_due(record: logging.LogRecord) -> bool:
    """Return whether a kind of message was not logged for a while."""
    due = clock() - SAID.get(record.msg, -math.inf) >= SELDOM_S
    if due:
        SAID[record.msg] = clock()
    return due


LOG.addFilter(_is_due)


def clock() -> float:
    """Return the time [s], by a clock that is not set while the program runs.

    Example:
        >>> clock() <= clock()
        True
    """
    return _ZERO + time.monotonic()


@contextmanager
def tolerated(what: str, pause_s: float = 0.0) -> Iterator[None]:
    """Log an error of the system and go on, after a pause.

    Example:
        >>> with tolerated("the heading is not sent"):
        ...     raise OSError("network is unreachable")
    """
    try:
        yield
    except OSError as error:
        LOG.warning(f"{what}: %s", error)
        time.sleep(pause_s)


def patient(receive: Callable[[], Any]) -> Iterator[Any]:
    """Yield what a function receives, again and again; None after an error of the system.

    Example:
        >>> next(patient(lambda: "$HEHDT,290.0,T*24"))
        '$HEHDT,290.0,T*24'
    """
    while True:
        item = None
        with tolerated("nothing is received", pause_s=1.0):
            item = receive()
        yield item


class Measurement(NamedTuple):
    """Content of one message of an autopilot; None for what it does not have.

    ``time`` is in seconds of the vehicle's clock; ``x``, ``y``, ``z`` is the field, forward, right, down [nT];
    ``roll``, ``pitch``, ``heading`` are in degrees; ``speed`` is forward, in m/s.

    Example:
        >>> Measurement(12.5, heading=290.0, speed=None).heading
        290.0
    """

    time: float
    x: float | None = None
    y: float | None = None
    z: float | None = None
    roll: float | None = None
    pitch: float | None = None
    heading: float | None = None
    speed: float | None = None

    @property
    def possible(self) -> bool:
        """Whether all numbers can be true."""
        numbers = [value for value in self if value is not None]
        tilt, speed = self.pitch or 0.0, self.speed or 0.0
        return all(map(math.isfinite, numbers)) and abs(tilt) <= 90 and 0 <= speed <= FASTEST_M_S


class Loop:
    """Steer a vehicle by :class:`~magrl.vehicle.onboard.Onboard` from the messages of its autopilot.

    The loop integrates the legs from heading and speed. At the end of a leg it averages the field over ``read_s``
    seconds, without spikes, and reports the mean of the field at the mean of its places: one step a leg. A field that
    does not change in any digit, that is missing or that the vehicle rejects is reported as missing, and the vehicle
    continues by dead reckoning. While speed or heading is not heard, or the computer was suspended, the last one is
    taken, and the stated error of the leg grows. Messages may come late, twice or out of order. The time is from the
    vehicle's clock; where the clock was set, time goes on from the last message.

    The heading is from true north, or, where the vehicle's heading is magnetic, of any reference that turns slowly: the
    loop measures its angle from magnetic north at each reading.

    Args:
        vehicle: the navigator, after :meth:`~magrl.vehicle.onboard.Onboard.start`.
        read_s: duration of a reading [s].
        calibration: correction of the axes.

    Raises:
        ValueError: for a vehicle before its start, or a duration that is not positive.

    Example:
        >>> vehicle = Onboard("secant")
        >>> vehicle.start((-11.6, 75.4, 13240.0))
        >>> loop, rest = Loop(vehicle, read_s=4.0), (14200.0, 49000.0, 0.0, 0.0, 290.0, 50.0)
        >>> for time in range(5):
        ...     command = loop.take(Measurement(float(time), 4900.0 + time, *rest))
        >>> command.stop, loop.steer_deg
        (None, 290.0)
    """

    def __init__(self, vehicle: Onboard, *, read_s: float = 30.0, calibration: Calibration | None = None) -> None:
        check_number(0, above=True, read_s=read_s)
        if vehicle.target is None:
            raise ValueError("the vehicle has no target: call start before it is steered")
        self.vehicle, self.read_s, self.calibration = vehicle, read_s, calibration
        self.now = -math.inf
        """Time of the last message [s]."""
        self.heard: Measurement | None = None
        """The last message, at its time in the loop; None for one that does not count."""
        self.command: Command | None = None
        self.note = ""
        """What the last reading lacked, as text; empty if nothing."""
        self._latest: dict[str, tuple[float, float]] = {}  # times and values of the quantities
        self._place, self._origin, self._path = (0.0, 0.0), (0.0, 0.0), 0.0  # [km]; the origin is a reading's
        self._offset = 0.0  # of the autopilot's north from the vehicle's [deg]
        self._since = -math.inf  # time of the last command, or the start of the reading
        self._unsure, self._fastest = [0.0, 0.0], 0.0  # of the leg, along and across [km]; of the flight [m/s]
        self._samples: list[tuple[float, ...]] | None = []
        self._shift = 0.0  # of the vehicle's clock, where it was set [s]

    @property
    def steer_deg(self) -> float | None:
        """Heading to steer, in the reference of the autopilot; None before the first reading."""
        return None if self.command is None else (self.command.heading_deg + self._offset) % 360

    @property
    def missing(self) -> tuple[str, ...]:
        """Quantities that the loop has not received: nothing is commanded before they come."""
        return tuple(name for name in _QUANTITIES if name not in self._latest)

    def take(self, measurement: Measurement) -> Command | None:
        """Take a message, and return the command if a leg has ended with it.

        Raises:
            RuntimeError: after a command to stop.
        """
        if self.command and self.command.stop:
            raise RuntimeError(f"the vehicle has stopped: {self.command.reason}")
        self.heard = None
        if not measurement.possible:
            LOG.warning("a message does not count, since a value is not possible: %s", measurement)
            return None
        time = self._on_time(measurement.time)
        self.heard = measurement = measurement._replace(time=time)
        self._advance(time)
        values = [(name, value) for name in _QUANTITIES if (value := getattr(measurement, name)) is not None]
        new = {name: (time, value) for name, value in values if time > self._latest.get(name, (-math.inf, 0.0))[0]}
        self._latest |= new
        if self.missing:
            return None
        if self._samples is None and self._is_there():
            self._samples, self._since = [], time
        if self._samples is None:
            return None
        return self._sample(sampled="x" in new)

    def _on_time(self, time: float) -> float:
        """Return the time of a message: from the vehicle's clock, or the last message's where the clock was set."""
        if self.now == -math.inf:
            self.now = time
        ahead = time + self._shift - self.now
        if not -LATE_S <= ahead <= GAP_S:
            LOG.warning("the vehicle's clock was set by %.0f s: time goes on from the last message", ahead)
            self._shift -= ahead
        return time + self._shift

    def _advance(self, time: float) -> None:
        """Move on with the last heading and speed up to a time."""
        seconds, self.now = max(time - self.now, 0.0), max(time, self.now)
        if not self.missing:
            self._doubt(seconds)
            length, course = self._value("speed") * seconds / 1000, math.radians(self._value("heading") - self._offset)
            self._place = self._place[0] + length * math.cos(course), self._place[1] + length * math.sin(course)
            self._path += length

    def _doubt(self, seconds: float) -> None:
        """Let the error of the leg grow where speed or heading is not heard, as if it were any that the vehicle had."""
        self._fastest = max(self._fastest, self._value("speed"))
        for axis, name in enumerate(("speed", "heading")):
            if (age := self.now - self._latest[name][0]) > SILENT_S:
                LOG.warning(f"no {name} for %.0f s: the last one is taken, and the error of the place grows", age)
                self._unsure[axis] += self._fastest * seconds / 1000

    def _value(self, name: str) -> float:
        return self._latest[name][1]

    def _is_there(self) -> bool:
        """Return whether the leg is made, so that the reading in its middle is at its end."""
        command = self.command
        assert command is not None
        if command.distance_km == 0:
            turn = math.remainder(self._value("heading") - self._offset - command.heading_deg, 360)
            return abs(turn) <= _ALIGNED_DEG or self.now - self._since >= TURN_S
        away = math.dist(self._place, self._origin) + self._value("speed") * self.read_s / 2000
        return away >= command.distance_km or self._path >= 2 * command.distance_km

    def _sample(self, *, sampled: bool) -> Command | None:
        """Add a sample to the reading, and return the command after the last one."""
        assert self._samples is not None
        if self._since == -math.inf:  # the first reading begins
            self._since = self.now
        fresh = all(self.now - self._latest[name][0] <= STALE_S for name in ATTITUDE)
        if sampled and fresh:
            self._samples.append((self.now, *map(self._value, (*AXES, *ATTITUDE)), *self._place))
        if self.now - self._since < self.read_s:
            return None
        rows, self._samples = np.array(self._samples), None
        self.command = self._step(rows)
        self._since, self._path, self._unsure = self.now, 0.0, [0.0, 0.0]
        if self.command is None:
            self._samples = []
        return self.command

    def _step(self, rows: np.ndarray) -> Command | None:
        """Report the leg and its reading; None where the first reading is not possible."""
        reading, heading, offset, self.note = self._mean(rows)
        place: _Place = tuple(rows[:, -2:].mean(0).tolist()) if len(rows) else self._place
        north, east = (new - old for new, old in zip(place, self._origin, strict=True))
        distance = 0.0 if self.command is None else math.hypot(north, east)
        if distance < _SHORT_KM:
            distance = 0.0
        else:
            heading = math.degrees(math.atan2(east, north))
        command = None if self.command is None and self.note else self._report(reading, heading, distance)
        if not self.note:
            self._offset = offset
        if command is not None:
            self._origin = place
        return command

    def _report(self, reading: Sequence[float | None], heading: float, distance: float) -> Command | None:
        """Report a leg, in parts where it is longer than one leg, and without a reading that is refused.

        Returns None where the first reading is refused.
        """
        longest, heading = self.vehicle.options.max_move_km, heading % 360
        while distance > LONGER * longest:
            self.vehicle.step(None, None, None, heading, longest)  # the reading at the end decides
            distance -= longest
        along, across = self._unsure
        turn = min(math.degrees(across / max(distance, _SHORT_KM)), 180.0)
        unsure = {"distance_std": along, "heading_std": turn}
        declination, inclination, level = reading
        try:
            return self.vehicle.step(declination, inclination, level, heading, distance, **unsure)
        except ValueError as error:
            self.note = str(error)
        return None if self.command is None else self.vehicle.step(None, None, None, heading, distance, **unsure)

    def _mean(self, rows: np.ndarray) -> tuple[Sequence[float | None], float, float, str]:
        """Return the reading, the heading, the angle of the autopilot's north from the vehicle's, and a text that
        says what is missing."""
        offset = self._offset
        nothing = (None, None, None), self._value("heading") - offset, offset
        if len(rows) < _LEAST_SAMPLES:
            return *nothing, "no sample of the field with an attitude"
        if len(rows) > _LEAST_SAMPLES and not np.ptp(rows[:, 1:4], 0).any():
            return *nothing, "the field does not change in any digit: the magnetometer is stuck"
        samples = DataFrame(rows[:, :7], columns=["time", *AXES, *ATTITUDE]).assign(distance=0.0)
        north = self.vehicle.options.north
        if north == "magnetic":
            samples = samples.drop(columns="heading")
        log = Log(samples, "autopilot", north)
        mean = readings_of(log, every_km=_ONE_READING_KM, calibration=self.calibration).iloc[0]
        declination, inclination, level = (float(mean[name]) for name in NAMES)
        if north == "true":
            return (declination, inclination, level), self._value("heading"), offset, ""
        shown = np.radians(rows[:, 6])
        shown = math.degrees(math.atan2(np.sin(shown).mean(), np.cos(shown).mean()))
        offset = shown - float(mean["heading"])
        return (None, inclination, level), self._value("heading") - offset, offset, ""
