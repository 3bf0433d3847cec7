"""The inputs of a vehicle as declared models: options, start and steps, which together are its saved state.

A number may be one of Python, NumPy or torch; it becomes a finite Python float.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field
from pydantic_core import from_json

from magrl.checks import CheckedModel
from magrl.files import write_atomically
from magrl.sensor_std import PERFECT, SensorStd
from magrl.transforms.errors.sensors import OUTAGE_STD
from magrl.vehicle.onboard.limits import Reading

LEAST_STD_NT = 0.2
"""Least standard deviation of B_H of a sensor that is not perfect, in any vehicle; chosen [nT]."""


def _plain(value: Any) -> Any:
    """Return scalars and arrays of NumPy and torch as plain numbers and lists."""
    return value.tolist() if hasattr(value, "tolist") else value


_PLAIN, _LAX = BeforeValidator(_plain), Field(strict=False)  # a tuple may be given as a list
Number = Annotated[float, _PLAIN]
Numbers = Annotated[tuple[Number, ...], _PLAIN, _LAX]
Triple = Annotated[tuple[Number, Number, Number], _PLAIN, _LAX]


def _accuracy(value: Any) -> SensorStd:
    """Return the accuracy given by an argument (three numbers are white noise) or a file.

    Raises:
        ValueError: for a standard deviation that is out of its range, or one of B_H that looks like microtesla.
    """
    value = _plain(value)
    whole = isinstance(value, SensorStd) or (isinstance(value, list) and isinstance(value[0], list))
    sensor_std = SensorStd.of(SensorStd(*map(_plain, value)) if whole else value)
    for name, std in sensor_std._asdict().items():
        if max(std[1:] if name == "bias" and sensor_std.magnetic else std) > OUTAGE_STD:
            raise ValueError(f"sensor_std.{name} must be at most {OUTAGE_STD:g}, that of an outage, got {max(std):g}")
        if 0 < std[2] < LEAST_STD_NT:
            raise ValueError(
                f"sensor_std.{name}: {std[2]:g} nT of B_H is less than the {LEAST_STD_NT:g} nT of the best sensors in "
                "a vehicle: it looks like microtesla, and nanotesla are expected; give 0 for a perfect sensor"
            )
    return sensor_std


class Options(CheckedModel):
    """Hold the options of :class:`~magrl.vehicle.onboard.Onboard`.

    Args:
        north: ``"true"``: headings are from true north, and D is measured; or ``"magnetic"``: they are from magnetic
            north, those of a compass, and D is not measured.
        sensor_std: accuracy of the sensors, a :class:`~magrl.sensor_std.SensorStd`; three numbers are white noise of
            D [deg], I [deg], B_H [nT]. A noise that is not 0 is corrected by what the readings show
            (:class:`~magrl.transforms.TrackField`). The drift is what a known start does not show, and what readings
            average in part.
        max_move_km: longest move; 50 km, or for a trained policy that of its training.
        max_turn_deg: largest turn to either side; 90°, or for a trained policy that of its training.
        max_steps: steps of a way, the last of which stops.
        arrival_km: distance from the destination that counts as arrived.
        confidence: least estimated probability of arrival at which the command is to stop as arrived.
        navigator: class of the navigator; the vehicle writes it.
        weights: digest of its weights; the vehicle writes it.

    Example:
        >>> Options(sensor_std=(0.02, 0.02, 0.002))
        Traceback (most recent call last):
        ValueError: sensor_std.noise: 0.002 nT of B_H is less than the 0.2 nT of the best sensors in a vehicle: it \
looks like microtesla, and nanotesla are expected; give 0 for a perfect sensor
    """

    north: Literal["true", "magnetic"] = "true"
    sensor_std: Annotated[SensorStd, BeforeValidator(_accuracy)] = PERFECT
    max_move_km: Number | None = Field(None, gt=0, le=1000)
    max_turn_deg: Number | None = Field(None, gt=0, le=180)
    max_steps: Annotated[int, _PLAIN] = Field(120, ge=1)
    arrival_km: Number = Field(25.0, gt=0)
    confidence: Number = Field(0.8, ge=0, le=1)
    navigator: str = ""
    weights: str = ""

    @property
    def magnetic(self) -> bool:
        """Whether the vehicle has no true north."""
        return self.north == "magnetic"

    @property
    def accuracy(self) -> SensorStd:
        """Accuracy of the sensors; where D is not measured, its error has no limit."""
        if not self.magnetic:
            return self.sensor_std
        return self.sensor_std._replace(bias=(math.inf, *self.sensor_std.bias[1:]))


class Step(CheckedModel):
    """Hold the arguments of :meth:`~magrl.vehicle.onboard.Onboard.step`.

    Example:
        >>> Step(declination=3.5, inclination=None, horizontal_intensity=15000, heading=float("nan"))
        Traceback (most recent call last):
        ValueError: heading must be a finite number, got nan
    """

    declination: Number | None
    inclination: Number | None
    horizontal_intensity: Number | None
    heading: Number = Field(ge=-360, le=360)
    distance: Number = Field(0.0, ge=0)
    time: Number | None = None

    @property
    def reading(self) -> Reading:
        """D [deg], I [deg], B_H [nT]; None for an element that is missing."""
        return self.declination, self.inclination, self.horizontal_intensity

    def in_radians(self, before: Sequence[float], steer_deg: float) -> tuple[float, ...]:
        """Return the commanded headings that were reported in radians, by the moves before and by this one in a row.

        A heading may equal the commanded one in radians by chance; two that differ do not.

        Args:
            before: those before this move.
            steer_deg: commanded heading of this move.

        Example:
            >>> step = Step(declination=3, inclination=73, horizontal_intensity=15000, heading=1.9199)
            >>> step.in_radians((60.0,), 110.0), step.in_radians((60.0,), 120.0)
            ((60.0, 110.0), ())
        """

        def apart(heading_deg: float) -> float:
            return abs(math.remainder(heading_deg - steer_deg, 360))

        if abs(self.heading) > 2 * math.pi or apart(math.degrees(self.heading)) > 0.5:
            return ()
        known = min(map(apart, (self.heading, *before))) < 10  # the move shows nothing new
        return tuple(before) if known else (*before, steer_deg)

    def repeats(self, before: Step) -> bool:
        """Return whether this repeats the message of the step before, by its time.

        Raises:
            ValueError: for an earlier time, or another message of the same time.

        Example:
            >>> step = Step(declination=3, inclination=73, horizontal_intensity=15000, heading=0, time=5)
            >>> step.repeats(step)
            True
        """
        if self.time is None or before.time is None or self.time > before.time:
            return False
        if self != before:
            raise ValueError(f"time must be later than {before.time!r}, that of the last step, got {self.time!r}")
        return True


class Journal(CheckedModel):
    """Hold all inputs of a vehicle since its start, which determine its state with any navigator.

    Example:
        >>> import torch
        >>> Journal(options=Options(), target=torch.tensor([-11.5, 75.5, 13240.0])).target
        (-11.5, 75.5, 13240.0)
    """

    format: Literal[10] = 10
    options: Annotated[Options, _LAX]
    target: Triple
    here: Numbers | None = None
    here_std: Numbers | None = None
    near: Annotated[tuple[Number, Number], _PLAIN, _LAX] | None = None
    date: str | None = None
    steps: Annotated[tuple[Annotated[Step, _LAX], ...], _LAX] = ()

    def content(self) -> bytes:
        """Return the content of its file: JSON and its SHA-256."""
        body = self.model_dump_json().encode()
        return body + b"\n" + hashlib.sha256(body).hexdigest().encode()

    def write(self, path: Path) -> None:
        """Write a file atomically.

        Raises:
            OSError: if it cannot be written; an existing one stays unchanged.
        """
        write_atomically(path, self.content())

    @classmethod
    def read(cls, path: Path) -> Journal:
        """Read a file of :meth:`write`.

        Raises:
            ValueError: for anything else, naming what is wrong.
            OSError: if it cannot be read.
        """
        content = path.read_bytes()
        try:
            journal = cls(**from_json(content.partition(b"\n")[0]))
            if journal.content() != content:
                raise ValueError("it is damaged")
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path} is not the state of a vehicle: {error}") from error
        return journal
