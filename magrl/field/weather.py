"""Magnetic weather: how the field varies in time, from one-minute records of magnetic observatories.

The records are from the U.S. Geological Survey (USGS) that come with its program geomag-algorithms
(https://github.com/usgs/geomag-algorithms), which is in the public domain (CC0 1.0). ``weather.npz`` holds them as
variations northward, eastward and downward, in tenths of a nanotesla. The level from which they vary is the median of
each component over the quietest day of the record, the day (UTC) on which the horizontal intensity has the least range.

============================  =====================================================  ===============================
record                        file, at the latest commit that holds it               components
============================  =====================================================  ===============================
Boulder, 1-29 January 2016    etc/adjusted/BOU201601adj.min (c8d07df)                X, Y, Z
Boulder, 1-7 November 2014    etc/iaga2002/BOU/OneMinute/bou2014110?vmin.min (28a3)  H, D, Z of the variometer
College, 1 March 2020         etc/prepfiles/CMO2020061.min (b28cf65)                 H, E, Z of the variometer
============================  =====================================================  ===============================

A variometer's own axes are turned to geographic ones so that the declination of the quiet level is IGRF's at the
station. An axis that is off by 1 degree changes a variation of 100 nT by 2 nT. No minute of these files is missing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from magrl.checks import check_choice, check_number, check_tensor, check_type

_DAY = 1440  # minutes


@dataclass(frozen=True, eq=False)
class WeatherRecord:
    """Variation of the field at one place, minute by minute.

    Args:
        variation: ``(T, 3)`` north, east, down [nT], one row a minute; NaN marks a gap.
        first: first minute at which an episode may start.
        last: last minute at which one may start; by default the record's last.
        name: name for messages.

    Raises:
        TypeError: for a variation that is not a real tensor.
        ValueError: for another shape, a record without a minute, or a first or last minute outside of it.

    Example:
        >>> hour = WeatherRecord(torch.zeros(60, 3))
        >>> hour.starts(span_h=0.9)
        tensor([0, 1, 2, 3, 4, 5])
    """

    variation: Tensor
    first: int = 0
    last: int | None = None
    name: str = "own record"

    def __post_init__(self) -> None:
        check_tensor(3, variation=self.variation)
        if self.variation.ndim != 2 or not len(self.variation):
            raise ValueError(f"variation must be of shape (T, 3) with T >= 1, got {tuple(self.variation.shape)}")
        check_type(str, name=self.name)
        end = len(self.variation) - 1
        check_number(0, end, whole=True, first=self.first)
        check_number(self.first, end, whole=True, optional=True, last=self.last)

    def starts(self, span_h: float) -> Tensor:
        """Return the minutes at which an episode can start so that no minute of it is missing, ``(S,)`` int64.

        Args:
            span_h: longest time that an episode takes [h].

        Raises:
            ValueError: if the record, or each part of it between two gaps, is too short.

        Example:
            >>> weather_record("college").starts(span_h=23.9)
            tensor([0, 1, 2, 3, 4, 5])
        """
        check_number(0, span_h=span_h)
        valid = torch.isfinite(self.variation).all(-1).cpu()
        start = torch.arange(self.first, len(valid) if self.last is None else self.last + 1)
        missing = torch.cat((torch.zeros(1, dtype=torch.int64), (~valid).long().cumsum(0)))  # before each minute
        end = torch.searchsorted(missing, missing[start], right=True) - 2  # the last minute before the next gap
        minutes = end - start
        starts = start[minutes >= math.ceil(min(60 * span_h, len(valid)))]
        if not len(starts):
            longest_h = math.floor(max(0, int(minutes.max())) / 6) / 10
            raise ValueError(
                f"an episode of up to {span_h:g} h does not fit into the magnetic weather {self.name!r}, where at most "
                f"{longest_h:g} h follow a start without a gap: take a shorter span_h, a faster vehicle or another "
                f"record ({', '.join(WEATHER)})"
            )
        return starts

    def second_moments(self, span_h: float = 0.0) -> Tensor:
        """Return the mean products of the variation northward, eastward and downward, ``(3, 3)`` [nT^2], without gaps.

        Over the minutes at which an episode may start, and the duration of an episode after them.

        Args:
            span_h: time that an episode takes [h].

        Example:
            >>> record = WeatherRecord(torch.tensor([[1.0, 0.0, 0.0], [3.0, 0.0, 0.0]]), last=0)
            >>> record.second_moments()[0, 0].item(), record.second_moments(span_h=1 / 60)[0, 0].item()
            (1.0, 5.0)
        """
        check_number(0, span_h=span_h)
        last = None if self.last is None else self.last + 1 + math.ceil(min(60 * span_h, len(self.variation)))
        variation = self.variation[self.first : last].double()
        return (variation.unsqueeze(-1) * variation.unsqueeze(-2)).nanmean(0)

    def surrogates(self, number: int, seed: int = 0) -> Tensor:
        """Return variations with the spectra and cross-spectra of the record, and random phases.

        One phase a frequency turns all three components, so that they vary together as they did.

        Args:
            number: number of variations, from 1 on.
            seed: seed of the phases.

        Returns:
            ``(number, T, 3)`` north, east, down [nT].

        Raises:
            ValueError: for a record with gaps.

        Source:
            D. Prichard and J. Theiler, Generating surrogate data for time series with several simultaneously measured
            variables, Physical Review Letters 73 (1994).

        Example:
            >>> record = weather_record("college")
            >>> drawn = record.surrogates(2)
            >>> drawn.shape, torch.allclose(drawn.square().mean(1), record.variation.square().mean(0), rtol=1e-3)
            (torch.Size([2, 1440, 3]), True)
        """
        check_number(1, whole=True, number=number)
        if not torch.isfinite(self.variation).all():
            raise ValueError(f"surrogates need a record without gaps, {self.name!r} has some")
        length, spectrum = len(self.variation), torch.fft.rfft(self.variation.double(), dim=0)
        draw = torch.Generator().manual_seed(seed)
        phase = 2 * math.pi * torch.rand(number, len(spectrum), 1, generator=draw, dtype=torch.float32)
        turned = torch.polar(torch.ones_like(phase), phase)
        real = turned.real.sign().to(turned)  # the mean and, of an even number, the highest frequency stay real
        turned[:, 0] = real[:, 0]
        if length % 2 == 0:
            turned[:, -1] = real[:, -1]
        return torch.fft.irfft(spectrum * turned, n=length, dim=1).to(self.variation)


WEATHER = {
    "quiet": ("boulder-2016-01", 18, 18),
    "disturbed": ("boulder-2016-01", 20, 20),
    "boulder-2016": ("boulder-2016-01", 1, 29),
    "boulder-2014": ("boulder-2014-11", 1, 7),
    "college": ("college-2020-03", 1, 1),
}
"""Magnetic weather that comes with the library: record, and the first and last day (UTC) on which an episode may start.

``"quiet"`` and ``"disturbed"`` are the days of January 2016 on which the horizontal intensity at Boulder (40 degrees
north) has the least and the largest range, 33 and 104 nT; an episode runs on into the next days. ``"college"`` is one
day in the auroral zone (65 degrees north), with a range of 327 nT.
"""


@cache
def weather_record(name: str) -> WeatherRecord:
    """Return magnetic weather by its name in :data:`WEATHER`.

    Raises:
        ValueError: for an unknown name, listing those known.

    Example:
        >>> horizontal = weather_record("quiet").variation[17 * 1440 : 18 * 1440, 0]
        >>> round(float(horizontal.max() - horizontal.min()))
        33
    """
    check_choice(WEATHER, record=name)
    record, first, last = WEATHER[name]
    with np.load(Path(__file__).parent / "weather.npz") as file:
        variation = torch.from_numpy(file[record].astype(np.float32) / 10)
    return WeatherRecord(variation, (first - 1) * _DAY, min(last * _DAY, len(variation)) - 1, name)
