"""Models of the geomagnetic field, as modules that map positions to field vectors.

Every model is called as ``model(latitude, longitude)`` in degrees and answers with the vector north, east, down in
nanotesla, ``(..., 3)``; ``model.value_and_gradient`` adds the exact derivative northward and eastward in nT/km,
``(..., 3, 2)``. Both are in float64 inside and out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from functools import cache
from typing import Protocol

import numpy as np
import torch
from torch import Tensor, nn
from typing_extensions import Self

from magrl import harmonics
from magrl.elements import elements_gradient, measured_elements
from magrl.geodesy import curvature_radii, local_frame, to_ecef

Date = datetime | str | float
"""A ``datetime``, ISO text such as ``"2022-01-01"``, or a decimal year such as ``2022.0``."""


class FieldModel(Protocol):
    """What an environment asks of a field: the two calls of this module's models."""

    def __call__(self, latitude: Tensor, longitude: Tensor, /) -> Tensor:
        """Field vector north, east, down, ``(..., 3)`` [nT]."""

    def value_and_gradient(self, latitude: Tensor, longitude: Tensor, /) -> tuple[Tensor, Tensor]:
        """The vector and its derivative northward and eastward, ``(..., 3, 2)`` [nT/km]."""


def parse_date(date: Date) -> datetime:
    """A date in any of the accepted forms as a naive UTC ``datetime``.

    Args:
        date: ``datetime`` (aware ones are converted to UTC), ISO 8601 text, or decimal year.

    Raises:
        ValueError: for text that is no ISO date, a number that is no year, or NaN.

    Example:
        >>> parse_date(2022.5)
        datetime.datetime(2022, 7, 2, 12, 0)
    """
    if isinstance(date, str):
        try:
            date = datetime.fromisoformat(date)
        except ValueError as error:
            raise ValueError(f"date {date!r} is not an ISO date such as '2022-01-01'") from error
    if isinstance(date, datetime):
        return date.astimezone(timezone.utc).replace(tzinfo=None) if date.tzinfo else date
    if isinstance(date, bool) or not isinstance(date, (int, float)):
        raise ValueError(f"date {date!r} is neither a datetime, nor ISO text, nor a decimal year")
    if not math.isfinite(date) or not 1 <= date < 9999:
        raise ValueError(f"date {date!r} is not a year between 1 and 9999")
    year = int(date)
    start, end = datetime(year, 1, 1), datetime(year + 1, 1, 1)
    return start + timedelta(seconds=(date - year) * (end - start).total_seconds())


@cache
def _igrf_tables(generation: int) -> tuple[list[datetime], np.ndarray]:
    """Epochs and complex Gauss tables ``(epochs, N + 1, N + 1)`` of one IGRF generation, through ppigrf."""
    from ppigrf import ppigrf  # heavy (pandas), and only ever needed here

    files = {13: ppigrf.shc_fn_igrf13, 14: ppigrf.shc_fn_igrf14}
    if generation not in files:
        raise ValueError(f"IGRF generation {generation!r} is not available: choose from {sorted(files)}")
    g, h = ppigrf.read_shc(files[generation])
    n, m = np.array(list(g.columns)).T
    table = np.zeros((len(g), n.max() + 1, n.max() + 1), dtype=np.complex128)
    table[:, n, m] = g.to_numpy() - 1j * h.to_numpy()
    return [epoch.to_pydatetime() for epoch in g.index], table


def igrf_coefficients(date: Date, generation: int = 14) -> Tensor:
    """Gauss coefficients at a date, linear in time between the model's epochs.

    Args:
        date: see :data:`Date`.
        generation: 13 or 14.

    Returns:
        Complex ``(14, 14)`` table ``g - i h`` [nT], Schmidt semi-normalised, degree by order.

    Raises:
        ValueError: for another generation, or a date outside the model, with the span that is valid.

    Source:
        The coefficient files that ppigrf ships (IAGA IGRF-13 and IGRF-14).

    Example:
        >>> round(float(igrf_coefficients("2020-01-01")[1, 0].real), 2)
        -29403.41
    """
    epochs, table = _igrf_tables(generation)
    when = parse_date(date)
    if not epochs[0] <= when <= epochs[-1]:
        raise ValueError(
            f"date {date!r} is outside IGRF-{generation}, which is valid from {epochs[0].date()} to {epochs[-1].date()}"
        )
    right = next(k for k in range(1, len(epochs)) if when <= epochs[k])
    weight = (when - epochs[right - 1]) / (epochs[right] - epochs[right - 1])
    return torch.from_numpy((1 - weight) * table[right - 1] + weight * table[right])


class Float64Module(nn.Module):
    """A module that follows device moves but keeps its dtype: float32 coefficients would cost metres."""

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        return super()._apply(lambda tensor: tensor.to(fn(tensor).device), recurse)


class SphericalHarmonicField(Float64Module):
    """The field of a Schmidt semi-normalised spherical harmonic expansion, on the WGS84 ellipsoid.

    Args:
        gauss: complex ``(N + 1, N + 1)`` table ``g - i h`` [nT].
        altitude_km: default height over the ellipsoid [km].
        chunk: points evaluated at a time: bounds the memory at about 7 kB a point for degree 13.

    Raises:
        ValueError: for a table of another shape, or that is not finite.
    """

    value_table: Tensor
    gradient_table: Tensor

    def __init__(self, gauss: Tensor, *, altitude_km: float = 0.0, chunk: int = 4096) -> None:
        super().__init__()
        if gauss.ndim != 2 or gauss.shape[0] != gauss.shape[1] or gauss.shape[0] < 2:
            raise ValueError(f"gauss must be a square (N + 1, N + 1) table with N >= 1, got shape {tuple(gauss.shape)}")
        if not torch.isfinite(torch.view_as_real(gauss.to(torch.complex128))).all():
            raise ValueError("gauss holds coefficients that are not finite")
        if chunk < 1:
            raise ValueError(f"chunk must be at least one point, got {chunk}")
        self.degree = gauss.shape[0] - 1
        self.altitude_km = _checked_altitude(altitude_km)
        self.chunk = int(chunk)
        gauss = gauss.to(torch.complex128)
        self.register_buffer("value_table", harmonics.field_table(gauss))
        self.register_buffer("gradient_table", harmonics.gradient_table(gauss))

    def forward(self, latitude: Tensor, longitude: Tensor, altitude_km: Tensor | float | None = None) -> Tensor:
        """The field vector.

        Args:
            latitude: ``(...)`` geodetic [deg].
            longitude: ``(...)`` [deg], any turn.
            altitude_km: ``(...)`` or a number; by default the model's.

        Returns:
            ``(..., 3)`` float64: north, east, down [nT]. At a pole, north is along the given meridian.

        Raises:
            ValueError: for a latitude beyond 90 degrees, or a position that is not finite.
        """
        shape, points = self._points(latitude, longitude, altitude_km)
        parts = [self._value(*chunk) for chunk in zip(*(p.split(self.chunk) for p in points), strict=True)]
        return torch.cat(parts).reshape(*shape, 3)

    def value_and_gradient(
        self, latitude: Tensor, longitude: Tensor, altitude_km: Tensor | float | None = None
    ) -> tuple[Tensor, Tensor]:
        """The field vector and its exact horizontal gradient.

        The gradient is that of the local components, so it contains the turning of the local axes. Its east column
        grows without bound at a geographic pole, where "north" itself turns.

        Args:
            latitude: ``(...)`` geodetic [deg].
            longitude: ``(...)`` [deg], any turn.
            altitude_km: ``(...)`` or a number; by default the model's.

        Returns:
            The vector ``(..., 3)`` [nT] and the derivative of each component northward and eastward at constant
            altitude, ``(..., 3, 2)`` [nT/km].

        Raises:
            ValueError: for a latitude beyond 90 degrees, or a position that is not finite.
        """
        shape, points = self._points(latitude, longitude, altitude_km)
        parts = [self._value_and_gradient(*c) for c in zip(*(p.split(self.chunk) for p in points), strict=True)]
        value, gradient = (torch.cat(column) for column in zip(*parts, strict=True))
        return value.reshape(*shape, 3), gradient.reshape(*shape, 3, 2)

    def _points(
        self, latitude: Tensor, longitude: Tensor, altitude_km: Tensor | float | None
    ) -> tuple[torch.Size, list[Tensor]]:
        inputs = (latitude, longitude, self.altitude_km if altitude_km is None else altitude_km)
        tensors = [torch.as_tensor(x, dtype=torch.float64, device=self.value_table.device) for x in inputs]
        tensors = list(torch.broadcast_tensors(*tensors))
        check_positions(tensors[0], tensors[1])
        if not torch.isfinite(tensors[2]).all():
            raise ValueError("altitude_km holds values that are not finite")
        return tensors[0].shape, [x.reshape(-1) for x in tensors]

    def _value(self, latitude: Tensor, longitude: Tensor, altitude_km: Tensor) -> Tensor:
        terms = harmonics.basis(to_ecef(latitude, longitude, altitude_km), self.degree + 1)
        b_ecef = (self.value_table @ terms).T
        return (local_frame(latitude, longitude) * b_ecef.unsqueeze(-2)).sum(-1)

    def _value_and_gradient(self, latitude: Tensor, longitude: Tensor, altitude_km: Tensor) -> tuple[Tensor, Tensor]:
        terms = harmonics.basis(to_ecef(latitude, longitude, altitude_km), self.degree + 2)
        frame = local_frame(latitude, longitude)
        b_ecef = (self.value_table @ terms[: self.value_table.shape[1]]).T
        b_ned = (frame * b_ecef.unsqueeze(-2)).sum(-1)
        tensor_ecef = (self.gradient_table @ terms).T.unflatten(-1, (3, 3))
        gradient = frame @ tensor_ecef @ frame[:, :2].mT
        return b_ned, gradient + _frame_turning(b_ned, latitude, altitude_km)


def _frame_turning(b_ned: Tensor, latitude: Tensor, altitude_km: Tensor) -> Tensor:
    """What the turning of north, east, down adds to the gradient of the components: ``(P, 3, 2)`` [nT/km]."""
    meridian, prime_vertical = curvature_radii(latitude)
    north, east, down = b_ned.unbind(-1)
    per_north, per_east = 1 / (meridian + altitude_km), 1 / (prime_vertical + altitude_km)
    tan = torch.tan(torch.deg2rad(latitude))
    along = torch.stack((down * per_north, torch.zeros_like(down), -north * per_north), -1)
    across = torch.stack((-tan * east, down + tan * north, -east), -1) * per_east.unsqueeze(-1)
    return torch.stack((along, across), -1)


class IGRF(SphericalHarmonicField):
    """The International Geomagnetic Reference Field at one date.

    Args:
        date: ``datetime``, ISO text or decimal year, from 1900.0 to the end of the generation.
        generation: 13 (to 2025) or 14 (to 2030). The paper's figures are those of 13 at 2022-01-01.
        altitude_km: default height over the ellipsoid [km].
        chunk: points evaluated at a time.

    Raises:
        ValueError: for an unknown generation, or a date outside the model, with the valid span.

    Source:
        Alken et al., International Geomagnetic Reference Field: the thirteenth generation, EPS 73 (2021);
        coefficients as shipped by ppigrf.

    Example:
        >>> igrf = IGRF("2022-01-01", generation=13)
        >>> igrf(torch.tensor(-2.0), torch.tensor(162.0)).round()
        tensor([ 35120.,   4947., -10270.], dtype=torch.float64)
    """

    def __init__(self, date: Date, generation: int = 14, *, altitude_km: float = 0.0, chunk: int = 4096) -> None:
        super().__init__(igrf_coefficients(date, generation), altitude_km=altitude_km, chunk=chunk)
        self.date = parse_date(date)
        self.generation = generation

    def extra_repr(self) -> str:
        return f"date={self.date.isoformat()}, generation={self.generation}, altitude_km={self.altitude_km}"


def elements_at(field: FieldModel, position: Tensor) -> Tensor:
    """D, I, B_H at positions.

    Args:
        field: any model of this module.
        position: ``(..., 2)`` latitude, longitude [deg].

    Returns:
        ``(..., 3)``: D [deg], I [deg], B_H [nT].
    """
    return measured_elements(field(position[..., 0], position[..., 1]))


def elements_range(field: FieldModel, position: Tensor) -> tuple[Tensor, Tensor]:
    """Least and greatest D, I, B_H over positions.

    Args:
        field: any model of this module.
        position: ``(..., 2)`` latitude, longitude [deg], for example :meth:`magrl.tasks.Region.grid`.

    Returns:
        Two ``(3,)``: D [deg], I [deg], B_H [nT].
    """
    values = elements_at(field, position).reshape(-1, 3)
    return values.amin(0), values.amax(0)


def elements_gradient_at(field: FieldModel, position: Tensor) -> Tensor:
    """Horizontal gradient of D, I, B_H at positions.

    Args:
        field: any model of this module.
        position: ``(..., 2)`` latitude, longitude [deg].

    Returns:
        ``(..., 3, 2)``: element unit per km, northward and eastward.
    """
    return elements_gradient(*field.value_and_gradient(position[..., 0], position[..., 1]))


def check_positions(latitude: Tensor, longitude: Tensor) -> None:
    """Refuses positions that are not on Earth.

    Raises:
        ValueError: naming the first latitude beyond 90 degrees or value that is not finite.
    """
    bad = ~(latitude.abs() <= 90)
    if bad.any():
        raise ValueError(f"latitude {latitude[bad].flatten()[0].item()} is not between -90 and 90 degrees")
    bad = ~torch.isfinite(longitude)
    if bad.any():
        raise ValueError(f"longitude {longitude[bad].flatten()[0].item()} is not a finite number of degrees")


def check_box(latitude: tuple[float, float], longitude: tuple[float, float]) -> None:
    """Refuses an empty, reversed or impossible latitude-longitude box.

    Raises:
        ValueError: with the values.
    """
    south, north = latitude
    west, east = longitude
    if not (-90 <= south < north <= 90):
        raise ValueError(f"latitudes {latitude} must rise from south to north within [-90, 90] degrees")
    if not (math.isfinite(west) and math.isfinite(east) and west < east <= west + 360):
        raise ValueError(
            f"longitudes {longitude} must rise from west to east by at most 360 degrees "
            "(write a box across the antimeridian as, for example, (170, 190))"
        )


def _checked_altitude(altitude_km: float) -> float:
    if not math.isfinite(altitude_km):
        raise ValueError(f"altitude_km {altitude_km} is not a finite number")
    if altitude_km < -100:
        raise ValueError(f"altitude_km {altitude_km} is below the Earth's crust: sources lie outside the model there")
    return float(altitude_km)
