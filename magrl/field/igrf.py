"""The International Geomagnetic Reference Field and the dates at which it is evaluated."""

from __future__ import annotations

import datetime
from bisect import bisect_left
from functools import cache
from importlib.util import find_spec
from numbers import Real
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from magrl.checks import short
from magrl.field.spherical import SphericalHarmonicField

Date = datetime.datetime | datetime.date | np.datetime64 | str | float
"""A ``datetime``, ``date`` or ``numpy.datetime64``, ISO text such as ``"2022-01-01"``, or a decimal year such as
``2022.0``."""


def parse_date(date: Date) -> datetime.datetime:
    """Return a date in any of the accepted forms as a naive UTC ``datetime``.

    Args:
        date: ``datetime`` (aware ones are converted to UTC), ``date`` (its midnight), ``numpy.datetime64``, ISO 8601
            text, or decimal year.

    Raises:
        ValueError: for text that is not an ISO date, a number that is not a year between 1 and 9999, a missing date
            (NaT), or another type.

    Example:
        >>> parse_date(2022.5)
        datetime.datetime(2022, 7, 2, 12, 0)
    """
    if isinstance(date, bool) or not isinstance(date, Real):
        try:
            moment = datetime.datetime.fromisoformat(str(date))  # all dates of Python and NumPy are ISO as text
        except ValueError as error:
            raise ValueError(f"date {date!r} is not an ISO date such as '2022-01-01', nor a decimal year") from error
        return moment.astimezone(datetime.UTC).replace(tzinfo=None) if moment.tzinfo else moment
    if not 1 <= date < 9999:
        raise ValueError(f"date {short(date)} is not a year between 1 and 9999")
    year = int(date)
    start, end = datetime.datetime(year, 1, 1), datetime.datetime(year + 1, 1, 1)
    return start + datetime.timedelta(seconds=float(date - year) * (end - start).total_seconds())


def decimal_year(when: datetime.datetime) -> float:
    """Return a naive UTC ``datetime`` as a decimal year, the unit of time in which models of the field are linear.

    Example:
        >>> decimal_year(datetime.datetime(2022, 7, 2, 12))
        2022.5
    """
    start, end = datetime.datetime(when.year, 1, 1), datetime.datetime(when.year + 1, 1, 1)
    return when.year + (when - start) / (end - start)


GENERATIONS = 13, 14
"""Generations of IGRF."""


@cache
def _igrf_tables(generation: int) -> tuple[list[float], Tensor]:
    """Return epochs ``(E,)`` [decimal year] and complex Gauss tables ``(E, N + 1, N + 1)`` of one IGRF generation."""
    if not isinstance(generation, int) or generation not in GENERATIONS:
        raise ValueError(f"IGRF generation {generation!r} is not available: choose from {list(GENERATIONS)}")
    path = Path(__file__).with_name("igrf13.shc")  # in the file of ppigrf 73 coefficients are off, by up to 0.3 nT
    if generation != 13:
        path = Path(find_spec("ppigrf").origin).with_name(f"IGRF{generation}.shc")  # type: ignore[union-attr, arg-type]
    text = path.read_text(encoding="utf-8")  # by hand, as ppigrf imports pandas
    _, years, *rows = (line for line in text.splitlines() if not line.startswith("#"))
    numbers = np.loadtxt(rows)
    (n, m), table = numbers[:, :2].astype(int).T, np.zeros((numbers.shape[1] - 2, 14, 14), dtype=np.complex128)
    for sign, unit in ((m >= 0, 1), (m < 0, -1j)):
        table[:, n[sign], abs(m[sign])] += unit * numbers[sign, 2:].T
    return list(map(float, years.split())), torch.from_numpy(table)


def igrf_coefficients(date: Date, generation: int = 14) -> Tensor:
    """Return the Gauss coefficients at a date, linear in decimal years between the model's epochs.

    Args:
        date: see :data:`Date`.
        generation: 13 or 14.

    Returns:
        Complex ``(14, 14)`` table ``g - i h`` [nT], Schmidt semi-normalized, degree by order.

    Raises:
        ValueError: for another generation, or a date outside the model, with its valid span.

    Source:
        ``igrf13.shc``, the file of IAGA and the British Geological Survey; IGRF-14 as distributed with ppigrf.

    Example:
        >>> round(float(igrf_coefficients("2020-01-01")[1, 0].real), 2)
        -29403.41
    """
    when, (epochs, tables) = parse_date(date), _igrf_tables(generation)
    year = decimal_year(when)
    if not epochs[0] <= year <= epochs[-1]:
        newest = GENERATIONS[-1]
        hint = f": generation={newest} is valid then" if epochs[0] <= year <= _igrf_tables(newest)[0][-1] else ""
        raise ValueError(
            f"date {when.isoformat()} is outside IGRF-{generation}, which is valid from {epochs[0]:.0f}-01-01 to "
            f"{epochs[-1]:.0f}-01-01{hint}"
        )
    right = max(bisect_left(epochs, year), 1)
    share = (year - epochs[right - 1]) / (epochs[right] - epochs[right - 1])
    return (1 - share) * tables[right - 1] + share * tables[right]


class IGRF(SphericalHarmonicField):
    """The International Geomagnetic Reference Field at one date.

    Args:
        date: ``datetime``, ``date``, ``numpy.datetime64``, ISO text or decimal year, from 1900.0 to the end of the
            generation.
        generation: 13 (to 2025) or 14 (to 2030). The paper's figures have generation 13 at 2022-01-01.
        altitude_km: default height above the ellipsoid [km], from -15 (15 km deep) to 1000.

    Raises:
        ValueError: for an unknown generation, a date outside the model, with the valid span, or an altitude beyond
            its range, which is probably not in kilometers.

    Source:
        Alken et al., International Geomagnetic Reference Field: the thirteenth generation, EPS 73 (2021);
        coefficients of :func:`igrf_coefficients`.

    Example:
        >>> igrf = IGRF("2022-01-01", generation=13)
        >>> igrf(torch.tensor(-2.0), torch.tensor(162.0)).round()
        tensor([ 35121.,   4948., -10271.], dtype=torch.float64)
    """

    def __init__(self, date: Date, generation: int = 14, *, altitude_km: float = 0.0) -> None:
        super().__init__(igrf_coefficients(date, generation), altitude_km=altitude_km)
        self.date, self.generation = parse_date(date), generation
