"""What a vehicle is told, as declared models: its options, its start and its steps, which together are its saved state.

A number may be one of Python, NumPy or torch; it becomes a finite Python float.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, ValidationError

from magrl.checks import CheckedModel
from magrl.onboard.limits import Reading
from magrl.transforms.errors.known_start import EXACT
from magrl.transforms.errors.sensors import OUTAGE_STD

LEAST_STD_NT = 0.2
"""Least standard deviation of B_H of a sensor that is not perfect, in any vehicle; chosen [nT]."""


def _plain(value: Any) -> Any:
    """Return scalars and arrays of NumPy and torch as plain numbers and lists."""
    return value.tolist() if hasattr(value, "tolist") else value


def _in_nanotesla(std: tuple[float, float, float]) -> tuple[float, float, float]:
    """Raise for a standard deviation of B_H that looks like microtesla."""
    if 0 < std[2] < LEAST_STD_NT:
        raise ValueError(
            f"{std[2]:g} nT of B_H is less than the {LEAST_STD_NT:g} nT of the best sensors in a vehicle: it looks "
            "like microtesla, and nanotesla are expected; give 0 for a perfect sensor"
        )
    return std


_PLAIN, _LAX = BeforeValidator(_plain), Field(strict=False)  # a tuple may be given as a list
Number = Annotated[float, _PLAIN]
Numbers = Annotated[tuple[Number, ...], _PLAIN, _LAX]
Triple = Annotated[tuple[Number, Number, Number], _PLAIN, _LAX]
_Std = Annotated[float, _PLAIN, Field(ge=0, le=OUTAGE_STD)]
Std = Annotated[tuple[_Std, _Std, _Std], _PLAIN, _LAX, AfterValidator(_in_nanotesla)]


class Options(CheckedModel):
    """Hold the options of :class:`~magrl.onboard.Onboard`, the class of its navigator, and the digest of its weights.

    Example:
        >>> Options(sensor_std=(0.02, 0.02, 0.002))
        Traceback (most recent call last):
        ValueError: sensor_std: 0.002 nT of B_H is less than the 0.2 nT of the best sensors in a vehicle: it looks \
like microtesla, and nanotesla are expected; give 0 for a perfect sensor
    """

    navigator: str = ""
    weights: str = ""
    sensor_std: Std = EXACT
    bias_std: Std = EXACT
    drift_std: Std = EXACT
    max_move_km: Number | None = Field(None, gt=0, le=1000)
    max_turn_deg: Number | None = Field(None, gt=0, le=180)
    max_steps: Annotated[int, _PLAIN] = Field(120, ge=1)
    arrival_km: Number = Field(25.0, gt=0)
    confidence: Number = Field(0.8, ge=0, le=1)


class Start(CheckedModel):
    """Hold the arguments of :meth:`~magrl.onboard.Onboard.start`.

    Example:
        >>> import torch
        >>> Start(target=torch.tensor([-11.5, 75.5, 13240.0])).target
        (-11.5, 75.5, 13240.0)
    """

    target: Triple
    here: Numbers | None = None
    here_std: Numbers | None = None
    near: Numbers | None = None
    date: str | None = None


class Step(CheckedModel):
    """Hold the arguments of :meth:`~magrl.onboard.Onboard.step`.

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

    def reading_after(self, before: Triple | None) -> Triple:
        """Return the reading, with those of the reading before in place of missing elements.

        Raises:
            ValueError: for a first reading that is not complete.

        Example:
            >>> step = Step(declination=None, inclination=73, horizontal_intensity=15000, heading=0)
            >>> step.reading_after((3.5, 72.0, 15010.0))
            (3.5, 73.0, 15000.0)
        """
        filled = zip(self.reading, before or (None, None, None), strict=True)
        d, i, b_h = (old if new is None else new for new, old in filled)
        if d is None or i is None or b_h is None:
            raise ValueError(f"the first step takes a reading of all three elements, got {self.reading}")
        return d, i, b_h

    def accuracy(self, sensor_std: Triple) -> list[float]:
        """Return the standard deviations of the reading: that of an outage for a missing element.

        Example:
            >>> step = Step(declination=None, inclination=73, horizontal_intensity=15000, heading=0)
            >>> step.accuracy((0.02, 0.02, 2.0))
            [10000.0, 0.02, 2.0]
        """
        return [OUTAGE_STD if new is None else std for new, std in zip(self.reading, sensor_std, strict=True)]

    def repeats(self, before: Step) -> bool:
        """Return whether this is the message of the step before once more, by its time.

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
    """Hold all that a vehicle was told since its start, which gives its state, whatever its navigator keeps.

    Example:
        >>> Journal(format=8, options=Options(), start=Start(target=(3.5, 73.0, 15000.0)), steps=[]).steps
        ()
    """

    format: Literal[8] = 8
    options: Annotated[Options, _LAX]
    start: Annotated[Start, _LAX]
    steps: Annotated[tuple[Annotated[Step, _LAX], ...], _LAX]

    def write(self, path: Path) -> None:
        """Write JSON and its SHA-256 atomically.

        Raises:
            OSError: if the file cannot be written; an existing one stays unchanged.
        """
        body, aside = self.model_dump_json().encode(), path.with_name(f"{path.name}.aside")
        with aside.open("wb") as file:
            file.write(body + b"\n" + hashlib.sha256(body).hexdigest().encode())
            file.flush()
            os.fsync(file.fileno())
        os.replace(aside, path)

    @classmethod
    def read(cls, path: Path) -> Journal:
        """Read a file of :meth:`write`.

        Raises:
            ValueError: for a damaged file, and for content that is not that of a journal, naming what is wrong.
            OSError: if it cannot be read.
        """
        body, _, digest = path.read_bytes().rpartition(b"\n")
        try:
            if hashlib.sha256(body).hexdigest().encode() != digest:
                raise ValueError("it is damaged, or of an earlier format")
            journal = cls.model_validate_json(body)
            if journal.model_dump_json().encode() != body:
                raise ValueError("parts of it are missing")
            return journal
        except ValueError as error:
            text = (
                error.errors()[0]["msg"].removeprefix("Value error, ") if isinstance(error, ValidationError) else error
            )
            raise ValueError(f"{path} is not the state of a vehicle: {text}") from error
