"""The International Geomagnetic Reference Field and the dates at which it is evaluated."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from functools import cache
from numbers import Real
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

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
    if isinstance(date, str):
        try:
            date = datetime.datetime.fromisoformat(date)
        except ValueError as error:
            raise ValueError(f"date {date!r} is not an ISO date such as '2022-01-01'") from error
    if isinstance(date, (np.datetime64, datetime.date)) and date != date:
        raise ValueError(f"date {date!r} is missing: give a date for each place")
    if isinstance(date, np.datetime64):
        moment = date.astype("M8[us]").item()
        if not isinstance(moment, datetime.datetime):
            raise ValueError(f"date {date!r} is not in a year between 1 and 9999")
        return moment
    if isinstance(date, datetime.datetime):
        return date.astimezone(datetime.UTC).replace(tzinfo=None) if date.tzinfo else date
    if isinstance(date, datetime.date):
        return datetime.datetime(date.year, date.month, date.day)
    if isinstance(date, bool) or not isinstance(date, Real):
        raise ValueError(f"date {date!r} is neither a datetime, nor ISO text, nor a decimal year")
    if not 1 <= date < 9999:
        raise ValueError(f"date {short(date)} is not a year between 1 and 9999")
    year = int(date)
    start, end = datetime.datetime(year, 1, 1), datetime.datetime(year + 1, 1, 1)
    return start + datetime.timedelta(seconds=float(date - year) * (end - start).total_seconds())


def parse_dates(dates: Sequence[Date] | NDArray[Any]) -> NDArray[np.datetime64]:
    """Return an array of dates in any of the accepted forms as naive UTC ``datetime64[us]``.

    Args:
        dates: list, array or pandas column ``(...)`` of dates as :func:`parse_date` takes them.

    Returns:
        ``(...)``.

    Raises:
        ValueError: for no date, or as :func:`parse_date`.

    Example:
        >>> parse_dates([2022.5, "2023-01-01"])
        array(['2022-07-02T12:00:00.000000', '2023-01-01T00:00:00.000000'], dtype='datetime64[us]')
    """
    array = np.asarray(dates, dtype=object if isinstance(dates, (list, tuple)) else None)
    if not array.size:
        raise ValueError(f"dates must hold at least one date, got {dates!r}")
    if array.dtype.kind == "M" and not np.isnat(array).any():
        return array.astype("M8[us]")
    rows = list(array.flat) if array.dtype.kind == "M" else array.ravel().tolist()
    parsed = {date: parse_date(date) for date in dict.fromkeys(rows)}
    return np.array([parsed[date] for date in rows], dtype="M8[us]").reshape(array.shape)


@cache
def _igrf_tables(generation: int) -> tuple[NDArray[np.datetime64], NDArray[np.complex128]]:
    """Return epochs ``(E,)`` and complex Gauss tables ``(E, N + 1, N + 1)`` of one IGRF generation, from ppigrf."""
    from ppigrf import ppigrf  # imports pandas, so only where it is needed

    files = {13: ppigrf.shc_fn_igrf13, 14: ppigrf.shc_fn_igrf14}
    if not isinstance(generation, int) or generation not in files:
        raise ValueError(f"IGRF generation {generation!r} is not available: choose from {sorted(files)}")
    g, h = ppigrf.read_shc(files[generation])
    n, m = np.array(list(g.columns)).T
    table = np.zeros((len(g), n.max() + 1, n.max() + 1), dtype=np.complex128)
    table[:, n, m] = g.to_numpy() - 1j * h.to_numpy()
    return g.index.to_numpy("M8[us]"), table


def igrf_coefficients(date: Date, generation: int = 14) -> Tensor:
    """Return the Gauss coefficients at a date, linear in time between the model's epochs.

    Args:
        date: see :data:`Date`.
        generation: 13 or 14.

    Returns:
        Complex ``(14, 14)`` table ``g - i h`` [nT], Schmidt semi-normalized, degree by order.

    Raises:
        ValueError: for another generation, or a date outside the model, with its valid span.

    Source:
        Coefficient files distributed with ppigrf (IAGA IGRF-13 and IGRF-14).

    Example:
        >>> round(float(igrf_coefficients("2020-01-01")[1, 0].real), 2)
        -29403.41
    """
    tables, shares = _epochs_and_shares(np.array(parse_date(date), dtype="M8[us]"), generation)
    return (shares.reshape(-1, 1, 1) * tables).sum(0)


def _epochs_and_shares(dates: NDArray[np.datetime64], generation: int) -> tuple[Tensor, Tensor]:
    """Return Gauss tables of the epochs around some dates, and the share of each epoch in the field of each date.

    Returns:
        Complex ``(E, 14, 14)`` and ``(E, ...)`` float64; the shares of a date are those of linear interpolation.
    """
    epochs, table = _igrf_tables(generation)
    outside = dates[(dates < epochs[0]) | (dates > epochs[-1])]
    if outside.size:
        first, last = epochs[[0, -1]].astype("M8[D]")
        raise ValueError(
            f"date {outside[0].item().isoformat()} is outside IGRF-{generation}, which is valid from {first} to {last}"
        )
    right = np.searchsorted(epochs, dates.ravel()).clip(1)
    weight = (dates.ravel() - epochs[right - 1]) / (epochs[right] - epochs[right - 1])
    share, column = np.zeros((len(epochs), dates.size)), np.arange(dates.size)
    share[right - 1, column], share[right, column] = 1 - weight, weight
    used = share.any(1)
    return torch.from_numpy(table[used]), torch.from_numpy(share[used].reshape(-1, *dates.shape))


class IGRF(SphericalHarmonicField):
    """The International Geomagnetic Reference Field at one date, or at a date for each place.

    With an array of dates, latitudes and longitudes broadcast with it: ``IGRF(dates)(latitude, longitude)`` of three
    arrays ``(P,)`` is the field at P places, each at its date; dates ``(T, 1)`` give T fields at each place.
    A field of many dates is for tables of positions; environments and expansions take one date.

    Args:
        date: ``datetime``, ``date``, ``numpy.datetime64``, ISO text or decimal year, from 1900.0 to the end of the
            generation; or a list, an array or a pandas column of them.
        generation: 13 (to 2025) or 14 (to 2030). The paper's figures are those of 13 at 2022-01-01.
        altitude_km: default height above the ellipsoid [km], from -15 (15 km deep) to 1000.

    Raises:
        ValueError: for an unknown generation, a date outside the model, with the valid span, or an altitude beyond
            its range, which is probably not in kilometers.

    Source:
        Alken et al., International Geomagnetic Reference Field: the thirteenth generation, EPS 73 (2021);
        coefficients as distributed with ppigrf.

    Example:
        >>> igrf = IGRF("2022-01-01", generation=13)
        >>> igrf(torch.tensor(-2.0), torch.tensor(162.0)).round()
        tensor([ 35120.,   4947., -10270.], dtype=torch.float64)
    """

    altitude_range_km: ClassVar[tuple[float, float]] = (-15.0, 1000.0)
    """Range of altitudes: from below the deepest trench to the height of satellites that measure the field [km]."""
    shown = ("date", "generation", "altitude_km")
    share: Tensor | None

    def __init__(
        self, date: Date | Sequence[Date] | NDArray[Any], generation: int = 14, *, altitude_km: float = 0.0
    ) -> None:
        self.date: datetime.datetime | NDArray[np.datetime64]
        if np.ndim(date):  # type: ignore[arg-type]
            self.date = parse_dates(date)  # type: ignore[arg-type]
            gauss, share = _epochs_and_shares(self.date, generation)
        else:
            self.date = parse_date(date)  # type: ignore[arg-type]
            gauss, share = igrf_coefficients(self.date, generation).unsqueeze(0), None
        super().__init__(gauss[0], altitude_km=altitude_km)
        self.generation = generation
        # Of many dates, this is the field of their first epoch; those of the others follow it.
        self.others = nn.ModuleList(SphericalHarmonicField(table, altitude_km=altitude_km) for table in gauss[1:])
        self.register_buffer("share", share, persistent=False)

    def _evaluate(
        self, rows: int, latitude: Tensor, longitude: Tensor, altitude_km: Tensor | float | None = None
    ) -> Tensor:
        """Return rows of the field as the parent class; for many dates, the sum over epochs weighted by share."""
        if self.share is None:
            return super()._evaluate(rows, latitude, longitude, altitude_km)
        points = self._points(latitude, longitude, altitude_km)
        try:
            shape = torch.broadcast_shapes(points[0].shape, self.share.shape[1:])
        except RuntimeError:
            raise ValueError(
                f"positions of shape {tuple(points[0].shape)} do not broadcast with dates of shape "
                f"{tuple(self.share.shape[1:])}: give a date for each position"
            ) from None
        points = tuple(x.expand(shape).flatten() for x in points[: 2 if altitude_km is None else 3])
        total = points[0].new_zeros(rows, points[0].numel())
        for field, share in zip((self, *self.others), self.share, strict=True):
            share = share.expand(shape).flatten()
            used = share.nonzero().squeeze(-1)
            total[:, used] += share[used] * SphericalHarmonicField._evaluate(field, rows, *(x[used] for x in points))
        return total.reshape(rows, *shape)
