"""The samples of a log as one table: time, three axes, attitude, speed and position."""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas
import torch
from numpy.typing import NDArray
from pandas import DataFrame, Series

from magrl.checks import short
from magrl.files import numbers
from magrl.vehicle.logs.conventions import COLUMNS, Array, check_range

AXES, ATTITUDE = ("x", "y", "z"), ("roll", "pitch", "heading")
_ANGLES = ("roll", "heading", "longitude")  # which jump by 360 degrees
_EPOCH = 1e8  # seconds: a time beyond is since 1970, one before since the log began
Streams = Mapping[str, tuple[Array, Array]]
"""Times [s] and values of each column, in the units of :data:`~magrl.vehicle.logs.conventions.COLUMNS`."""


class Recording(NamedTuple):
    """Content of one file: columns, format and sensors, the north of its heading where it is stated, and notes."""

    streams: Streams
    source: str
    north: str | None = None
    notes: Sequence[str] = ()


@dataclass(frozen=True)
class Log:
    """Samples of a vehicle.

    Args:
        samples: columns ``time`` [s, UTC since 1970 where it is known], ``x``, ``y``, ``z`` [nT, forward, right, down],
            and those that the log has of ``roll``, ``pitch``, ``heading`` [deg], ``speed`` [m/s], ``distance`` since
            the sample before [km], ``latitude``, ``longitude`` [deg], ``altitude`` [km].
        source: format and sensors.
        north: north of the heading, one of :data:`~magrl.vehicle.logs.conventions.NORTHS`, where the log states it.
        notes: what a reader of the log must know.

    Example:
        >>> import pandas
        >>> log = Log(pandas.DataFrame({"time": [1.8e9], "x": [1.0], "y": [2.0], "z": [3.0]}), "by hand")
        >>> log.date, log.tensor("x", "z"), log.tensor("roll")  # no roll: level
        ('2027-01-15', tensor([[1., 3.]], dtype=torch.float64), tensor([[0.]], dtype=torch.float64))
    """

    samples: DataFrame
    source: str
    north: str | None = None
    notes: Sequence[str] = ()

    @property
    def date(self) -> str | None:
        """Date of the first sample, where the time is known."""
        return date_of(float(self.samples["time"].iloc[0]))

    def tensor(self, *names: str) -> torch.Tensor:
        """Return columns ``(N, K)`` in float64; roll and pitch that the log lacks are zeros.

        Raises:
            ValueError: for another column that the log lacks.
        """
        samples = self.samples
        if missing := [name for name in names if name not in samples and name not in ATTITUDE[:2]]:
            raise ValueError(
                f"the log has no {missing[0]}, only {', '.join(samples)}: name its column so, or choose another log"
            )
        columns = [samples[name].to_numpy(float) if name in samples else np.zeros(len(samples)) for name in names]
        return torch.from_numpy(np.stack(columns, -1))


def total_intensity(samples: DataFrame) -> Series:
    """Return the total intensity of each sample [nT].

    Example:
        >>> total_intensity(DataFrame({"x": [3.0], "y": [0.0], "z": [4.0]})).tolist()
        [5.0]
    """
    return samples[list(AXES)].pow(2).sum(axis=1).pow(0.5)


def date_of(time: float) -> str | None:
    """Return the date of a time in seconds since 1970; None for one since the log began.

    Example:
        >>> date_of(1.8e9), date_of(3600.0)
        ('2027-01-15', None)
    """
    return datetime.datetime.fromtimestamp(time, datetime.UTC).date().isoformat() if _EPOCH < time < 4.1e9 else None


def new_times(time: Array) -> NDArray[np.bool_]:
    """Return which rows have another time than the row before.

    Args:
        time: ``(N,)``.

    Raises:
        ValueError: for times that are not finite or run backward, with the row.

    Example:
        >>> new_times(np.array([0.0, 1.0, 1.0, 2.0]))
        array([ True, True, False, True])
    """
    if not np.isfinite(time).all():
        raise ValueError(f"row {int(np.argmin(np.isfinite(time))) + 1} has no time")
    step = np.diff(time)
    if (step < 0).any():
        row = int((step < 0).argmax())
        raise ValueError(
            f"time runs backward from row {row + 1} to {row + 2}, from {time[row]:.10g} to {time[row + 1]:.10g}: "
            "sort the rows, or split the log where its clock was set"
        )
    return np.concatenate(([True], step > 0))


def samples_of(streams: Streams) -> tuple[DataFrame, list[str]]:
    """Return the samples at the times of the magnetometer, with notes; other columns are interpolated.

    Samples before the first and after the last attitude are left out; the first and last position and speed hold there.

    Raises:
        ValueError: for a log without a magnetometer, or times that run backward.

    Example:
        >>> time = np.array([0.0, 1.0, 2.0])
        >>> axes = {name: (time, np.ones(3)) for name in "xyz"}
        >>> samples_of({**axes, "heading": (time[:2], np.array([350.0, 370.0]))})[0]["heading"].tolist()
        [350.0, 10.0]
    """
    logged = [name for name, (time, _) in streams.items() if len(time)]
    if missing := [name for name in AXES if name not in logged]:
        raise ValueError(
            f"no {missing[0]} of the magnetometer is among {', '.join(logged) or 'no columns'}: log it, in CSV as "
            "mag_x_nT, and in other formats as in docs/logs.md"
        )
    time = streams["x"][0]
    check_range("time", time)
    new = new_times(time)
    table = {"time": time[new]} | {
        name: _at(time[new], name, *streams[name]) for name in COLUMNS if name in streams and name != "time"
    }
    samples = pandas.DataFrame(table)
    whole = np.isfinite(samples[[name for name in (*AXES, *ATTITUDE) if name in samples]]).all(axis=1)
    whole &= (samples[list(AXES)] != 0).any(axis=1)  # three zeros: the magnetometer did not answer
    if not whole.any():
        raise ValueError("no sample has a field and an attitude at the same time: check both times, and the sensor")
    left = len(time) - int(whole.sum())
    notes = [f"{left} of {len(time)} samples left out: without a new time, axes or attitude"] if left else []
    samples = samples[whole].reset_index(drop=True)
    if "distance" in samples:
        samples["distance"] = samples["distance"].diff().fillna(0.0)
    return samples, notes


def _at(time: Array, name: str, times: Array, values: Array) -> Array:
    """Interpolate the values of a column at other times: angles along the shorter arc, distances as running sums."""
    if not len(times):
        return np.full(len(time), np.nan)
    if name == "distance":  # the running sum, without rows that repeat a time
        return np.interp(time, times, np.cumsum(values * (np.diff(times, prepend=-np.inf) > 0)))
    turning = name in _ANGLES
    ends = {} if name in ("latitude", "longitude", "altitude", "speed") else {"left": np.nan, "right": np.nan}
    column = np.interp(time, times, np.unwrap(values, period=360) if turning else values, **ends)
    return (column + 180) % 360 - 180 if name in ("roll", "longitude") else column % 360 if turning else column


def times_of(column: Series, factor: float = 1.0) -> Array:
    """Return times of numbers, or of texts in seconds since 1970, in UTC where they have no time zone.

    Args:
        column: numbers, or ISO 8601 texts; NaN for blank cells.
        factor: unit of the numbers [s].

    Raises:
        ValueError: for a text that is neither, with its row.

    Example:
        >>> times_of(Series(["2026-06-30T12:00:00"], name="time"))
        array([1.7828208e+09])
    """
    if pandas.to_numeric(column, errors="coerce").notna().any() or column.isna().all():
        return factor * numbers(column)
    parsed = pandas.to_datetime(column, utc=True, errors="coerce", format="ISO8601")
    bad = parsed.isna() & column.notna()
    if bad.any():
        row = int(bad.argmax())
        text = f"{short(column.iloc[row])} is no time such as 2026-06-30T12:00:00Z"
        raise ValueError(f"row {row + 1}, {column.name}: {text}")
    return (parsed - pandas.Timestamp(0, tz="UTC")).dt.total_seconds().to_numpy(float)
