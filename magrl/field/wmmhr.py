"""The World Magnetic Model High Resolution 2025: the field of the core, and from degree 16 to 133 of the crust.

The coefficients ``wmmhr2025.cof.gz`` are the file ``WMMHR.COF`` of 2024-11-13, by NOAA NCEI and the British Geological
Survey, in the public domain, from the package wmmhr 1.2.4 on PyPI; :data:`WMMHR_SHA256` is the file's digest.

Source: NOAA NCEI Geomagnetic Modeling Team and British Geological Survey, World Magnetic Model High Resolution 2025
(2024), doi:10.25921/qb1c-vn52.
"""

from __future__ import annotations

import datetime
import gzip
from functools import cache
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from magrl.field.igrf import Date, decimal_year, parse_date
from magrl.field.spherical import SphericalHarmonicField

WMMHR_SHA256 = "8851d40e57a1d948cb56d49b837612844890a941f93a73846a122b6c1182d504"
"""Checksum of the uncompressed file of coefficients."""
EPOCH, END = datetime.datetime(2025, 1, 1), datetime.datetime(2030, 1, 1)
"""First and last date of WMMHR-2025."""


@cache
def _wmmhr_tables() -> tuple[Tensor, Tensor]:
    """Return the Gauss table at the epoch [nT] and its rate [nT/year], complex ``(134, 134)`` each."""
    with gzip.open(Path(__file__).parent / "wmmhr2025.cof.gz", "rt", encoding="utf-8") as file:
        n, m, *columns = np.loadtxt(file, skiprows=1, comments="9" * 12).T
    tables = np.zeros((2, 134, 134), dtype=np.complex128)
    g, h, g_rate, h_rate = columns
    tables[:, n.astype(int), m.astype(int)] = g - 1j * h, g_rate - 1j * h_rate
    at_epoch, rate = torch.from_numpy(tables)
    return at_epoch, rate


def wmmhr_coefficients(date: Date) -> Tensor:
    """Return the Gauss coefficients of WMMHR-2025 at a date, from its epoch, 2025.0, and their rates.

    Degrees 1 to 15 are of the core and change at a constant rate; degrees 16 to 133 are of the crust and are constant.

    Args:
        date: see :data:`~magrl.field.Date`.

    Returns:
        Complex ``(134, 134)`` table ``g - i h`` [nT], Schmidt semi-normalized, degree by order.

    Raises:
        ValueError: for a date outside the model, with its valid span.

    Source:
        NOAA NCEI and British Geological Survey, doi:10.25921/qb1c-vn52; see :mod:`magrl.field.wmmhr`.

    Example:
        >>> round(float(wmmhr_coefficients("2025-01-01")[1, 0].real), 4)
        -29351.7976
    """
    when = parse_date(date)
    if not EPOCH <= when <= END:
        raise ValueError(
            f"date {when.isoformat()} is outside WMMHR-2025, which is valid from {EPOCH.date()} to {END.date()}"
        )
    at_epoch, rate = _wmmhr_tables()
    return at_epoch + (decimal_year(when) - EPOCH.year) * rate


class WMMHR(SphericalHarmonicField):
    """The World Magnetic Model High Resolution 2025 at one date: the core, and the crust to degree 133 (300 km).

    In the environment, use a :class:`~magrl.field.RegionalField` of it. On 10 by 10 degrees degree 24 leaves an error
    below 1e-4 nT; on 21 by 21 degrees, a region of that size with margin and one leg, degree 40.

    Args:
        date: ``datetime``, ISO text or decimal year, from 2025.0 to 2030.0.
        altitude_km: height above the ellipsoid [km], from -1 to 600. Another altitude in a call takes about 15 times as
            long.

    Raises:
        ValueError: for a date outside the model, with the valid span, or an altitude below the model.

    Source:
        NOAA NCEI and British Geological Survey, doi:10.25921/qb1c-vn52. Its crust is the model MF7, from data
        of the satellite CHAMP.

    Example:
        >>> field = WMMHR("2026-07-01")
        >>> field(torch.tensor(5.0), torch.tensor(18.0)).round()  # near the anomaly of Bangui
        tensor([32140.,  1112., -8271.], dtype=torch.float64)
    """

    altitude_range_km: ClassVar[tuple[float, float]] = (-1.0, 600.0)
    """Range of altitudes [km]: the sources of the field of the crust are not far below."""

    def __init__(self, date: Date, *, altitude_km: float = 0.0) -> None:
        super().__init__(wmmhr_coefficients(date), altitude_km=altitude_km)
        self.date = parse_date(date)
