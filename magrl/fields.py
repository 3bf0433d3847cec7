"""Models of the geomagnetic field, as modules that map positions to field vectors.

Every model is called as ``model(latitude, longitude)`` in degrees and answers with the vector north, east, down in
nanotesla, ``(..., 3)``; ``model.value_and_gradient`` adds the exact derivative northward and eastward in nT/km,
``(..., 3, 2)``. Both are in float64 inside and out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from datetime import datetime, timedelta, timezone
from functools import cache, partial
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor, nn
from typing_extensions import Self

from magrl import harmonics
from magrl.checks import check_number, check_numbers, check_tensor, check_type
from magrl.elements import elements_gradient, measured_elements
from magrl.geodesy import WGS84_A_KM, WGS84_E2

LEAST_ALTITUDE_KM = -100.0
"""Below that there are sources, and no expansion of this kind holds."""

Date = datetime | str | float
"""A ``datetime``, ISO text such as ``"2022-01-01"``, or a decimal year such as ``2022.0``."""


class FieldModel(Protocol):
    """What an environment asks of a field: the two calls of this module's models.

    Example:
        >>> class UniformField:
        ...     def __call__(self, latitude, longitude):
        ...         return torch.tensor([30000.0, 0.0, 30000.0]).expand(*latitude.shape, 3)
        ...
        ...     def value_and_gradient(self, latitude, longitude):
        ...         return self(latitude, longitude), torch.zeros(*latitude.shape, 3, 2)
        >>> model: FieldModel = UniformField()
        >>> elements_at(model, torch.zeros(2))
        tensor([    0.,    45., 30000.])
    """

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
    if not isinstance(generation, int) or generation not in files:
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
    """A module that follows device moves but keeps its dtype: float32 coefficients would cost metres.

    Example:
        >>> field = IGRF("2022-01-01").half()
        >>> isinstance(field, Float64Module), field.value_weights.dtype
        (True, torch.float64)
    """

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        return super()._apply(lambda tensor: tensor.to(fn(tensor).device), recurse)


class SphericalHarmonicField(Float64Module):
    """The field of a Schmidt semi-normalised spherical harmonic expansion, on the WGS84 ellipsoid.

    Args:
        gauss: complex ``(N + 1, N + 1)`` table ``g - i h`` [nT].
        altitude_km: default height over the ellipsoid [km].
        chunk: points evaluated at a time: bounds the memory, beyond that of the answer, at about 1 kB a point on a CPU
            and 6 kB on an accelerator.

    Raises:
        ValueError: for a table of another shape, or that is not finite.

    Example:
        >>> dipole = torch.zeros(2, 2, dtype=torch.complex128)
        >>> dipole[1, 0] = -30000.0  # g of degree 1, order 0
        >>> field = SphericalHarmonicField(dipole)
        >>> field(torch.tensor([0.0, 90.0]), torch.tensor(0.0)).round().abs()  # north; at the pole twice that, down
        tensor([[29902.,     0.,     0.],
                [    0.,     0., 60410.]], dtype=torch.float64)
    """

    value_weights: Tensor
    gradient_weights: Tensor
    level_value_weights: Tensor
    level_gradient_weights: Tensor

    def __init__(self, gauss: Tensor, *, altitude_km: float = 0.0, chunk: int = 16384) -> None:
        super().__init__()
        check_type(Tensor, gauss=gauss)
        check_number(1, whole=True, chunk=chunk)
        if gauss.ndim != 2 or gauss.shape[0] != gauss.shape[1] or gauss.shape[0] < 2:
            raise ValueError(f"gauss must be a square (N + 1, N + 1) table with N >= 1, got shape {tuple(gauss.shape)}")
        if not torch.isfinite(torch.view_as_real(gauss.to(torch.complex128))).all():
            raise ValueError("gauss holds coefficients that are not finite")
        self.degree = gauss.shape[0] - 1
        self.altitude_km = _checked_altitude(altitude_km)
        self.chunk = int(chunk)
        gauss = gauss.to(torch.complex128)
        value, gradient = harmonics.field_table(gauss), harmonics.gradient_table(gauss)
        padding = (0, gradient.shape[1] - value.shape[1])
        both = torch.cat((nn.functional.pad(value, padding), gradient[list(_INDEPENDENT)]))
        for name, table, degree in (("value", value, self.degree + 1), ("gradient", both, self.degree + 2)):
            weights = harmonics.separate(table, degree)
            self.register_buffer(f"{name}_weights", weights)
            self.register_buffer(f"level_{name}_weights", _at_altitude(weights, self.altitude_km))

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
        return (
            in_chunks(partial(self._value, altitude_km is None), points, 3, self.chunk)
            .reshape(3, *shape)
            .movedim(0, -1)
        )

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
        rows = in_chunks(partial(self._value_and_gradient, altitude_km is None), points, 9, self.chunk)
        return rows[:3].reshape(3, *shape).movedim(0, -1), rows[3:].reshape(3, 2, *shape).movedim((0, 1), (-2, -1))

    def _points(
        self, latitude: Tensor, longitude: Tensor, altitude_km: Tensor | float | None
    ) -> tuple[torch.Size, list[Tensor]]:
        inputs = (latitude, longitude, self.altitude_km if altitude_km is None else altitude_km)
        check_tensor(**{f"input {i}": x for i, x in enumerate(inputs) if isinstance(x, Tensor)})
        tensors = [torch.as_tensor(x, dtype=torch.float64, device=self.value_weights.device) for x in inputs]
        check_positions(tensors[0], tensors[1])
        sound = (tensors[2] >= LEAST_ALTITUDE_KM) & (tensors[2] < math.inf)
        _require(sound, tensors[2], f"altitude_km {{}} is not a finite number from {LEAST_ALTITUDE_KM} km on")
        tensors = list(torch.broadcast_tensors(*tensors))
        return tensors[0].shape, [x.reshape(-1) for x in tensors]

    def _value(self, level: bool, latitude: Tensor, longitude: Tensor, altitude_km: Tensor) -> Tensor:
        """North, east, down: ``(3, P)`` [nT]; ``level`` if the altitude is the model's."""
        place = _place(latitude, longitude, altitude_km)
        sums = _level_sums(self.level_value_weights, place) if level else _sums(self.value_weights, place)
        return (place.frame * sums).sum(1)

    def _value_and_gradient(self, level: bool, latitude: Tensor, longitude: Tensor, altitude_km: Tensor) -> Tensor:
        """The vector [nT], then the derivative of each component northward and eastward [nT/km]: ``(9, P)``."""
        place = _place(latitude, longitude, altitude_km)
        sums = _level_sums(self.level_gradient_weights, place) if level else _sums(self.gradient_weights, place)
        value = (place.frame * sums[:3]).sum(1)
        xx, xy, xz, yy, yz = sums[3:]
        tensor = torch.stack((xx, xy, xz, xy, yy, yz, xz, yz, -xx - yy)).unflatten(0, (3, 3))
        half = (place.frame.unsqueeze(2) * tensor).sum(1)
        gradient = (half.unsqueeze(1) * place.frame[:2]).sum(2).flatten(0, 1)
        return torch.cat((value, gradient + _frame_turning(value, place)))


def in_chunks(function: Callable[..., Tensor], points: Sequence[Tensor], rows: int, chunk: int) -> Tensor:
    """Evaluates a function of many points some at a time, so that its arrays stay small and in the cache.

    Args:
        function: from tensors ``(..., P)`` to ``(rows, P)``.
        points: its arguments, each ``(..., P)``.
        rows: of the answer.
        chunk: largest P to hand it.

    Returns:
        ``(rows, P)``.

    Example:
        >>> in_chunks(lambda x: torch.stack((x, x * x)), [torch.arange(5.0)], rows=2, chunk=2)
        tensor([[ 0.,  1.,  2.,  3.,  4.],
                [ 0.,  1.,  4.,  9., 16.]])
    """
    check_number(1, whole=True, chunk=chunk)
    count = points[0].shape[-1]
    if count <= chunk:
        return function(*points)
    out = points[0].new_empty(rows, count)
    for start in range(0, count, chunk):
        out[:, start : start + chunk] = function(*(x[..., start : start + chunk] for x in points))
    return out


_INDEPENDENT = (0, 1, 2, 4, 5)
"""Rows xx, xy, xz, yy, yz of the gradient: it is symmetric, the field having no curl, and without trace."""


class _Place(NamedTuple):
    """What the synthesis needs to know of P points, each sine and cosine taken once."""

    sines: tuple[Tensor, Tensor]  # of latitude and longitude
    cosines: tuple[Tensor, Tensor]
    frame: Tensor  # (3, 3, P), rows north, east, down, as geodesy.local_frame
    meridian_km: Tensor  # radius of curvature at the altitude, along the meridian
    across_km: Tensor  # and across it
    z_km: Tensor  # height over the plane of the equator


def _place(latitude: Tensor, longitude: Tensor, altitude_km: Tensor) -> _Place:
    angles = torch.deg2rad(torch.stack((latitude, longitude)))
    (sp, sl), (cp, cl) = torch.sin(angles), torch.cos(angles)
    root = torch.rsqrt(1 - WGS84_E2 * sp * sp)
    prime_vertical = WGS84_A_KM * root
    meridian = (1 - WGS84_E2) * prime_vertical * root * root + altitude_km
    z = ((1 - WGS84_E2) * prime_vertical + altitude_km) * sp
    frame = torch.stack((-sp * cl, -sp * sl, cp, -sl, cl, torch.zeros_like(sl), -cp * cl, -cp * sl, -sp))
    return _Place((sp, sl), (cp, cl), frame.unflatten(0, (3, 3)), meridian, prime_vertical + altitude_km, z)


def _sums(weights: Tensor, place: _Place) -> Tensor:
    """Rows of an expansion at points of any altitude: ``(R, P)``."""

    def some(axis_km: Tensor, z_km: Tensor, cos_lon: Tensor, sin_lon: Tensor) -> Tensor:
        features, lift = harmonics.products(axis_km, z_km, weights.shape[1] // 2)
        return harmonics.contract(weights, features, harmonics.waves(cos_lon, sin_lon, lift, weights.shape[1] // 2))

    points = (place.across_km * place.cosines[0], place.z_km, place.cosines[1], place.sines[1])
    return in_chunks(some, points, len(weights), _points_in_cache(weights))


def _level_sums(weights: Tensor, place: _Place) -> Tensor:
    """The same at the altitude that the weights were made for."""

    def some(sin_lat: Tensor, cos_lat: Tensor, cos_lon: Tensor, sin_lon: Tensor) -> Tensor:
        features = harmonics.chebyshev(sin_lat, weights.shape[2])
        return harmonics.contract(weights, features, harmonics.waves(cos_lon, sin_lon, cos_lat, weights.shape[1] // 2))

    points = (place.sines[0], place.cosines[0], place.cosines[1], place.sines[1])
    return in_chunks(some, points, len(weights), _points_in_cache(weights))


def _points_in_cache(weights: Tensor) -> int:
    """For how many points the largest array of a synthesis stays in the cache of a CPU; others have no use for it."""
    return max(1, 180_000 // weights[..., 0].numel()) if weights.device.type == "cpu" else 2**62


def _at_altitude(weights: Tensor, altitude_km: float) -> Tensor:
    """Weights over Chebyshev polynomials of the sine of the latitude, for points of one altitude.

    The ellipsoid is so nearly a sphere that few more than the degree suffice: on IGRF 12 more leave 1e-9 nT.
    """
    angles, _ = harmonics.chebyshev_nodes(weights.shape[1] // 2 + 12, weights.device)
    latitude = 90 - torch.rad2deg(angles)
    place = _place(latitude, torch.zeros_like(latitude), torch.full_like(latitude, altitude_km))
    return harmonics.on_surface(weights, place.across_km * place.cosines[0], place.z_km)


def _frame_turning(b_ned: Tensor, place: _Place) -> Tensor:
    """What the turning of north, east, down adds to the gradient of the components: ``(6, P)`` [nT/km]."""
    north, east, down = b_ned
    along, across = place.meridian_km, place.across_km
    turned = place.sines[0] / place.cosines[0] * b_ned[:2]
    return torch.stack(
        (
            down / along,
            -turned[1] / across,
            torch.zeros_like(down),
            (down + turned[0]) / across,
            -north / along,
            -east / across,
        )
    )


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

    def __init__(self, date: Date, generation: int = 14, *, altitude_km: float = 0.0, chunk: int = 16384) -> None:
        super().__init__(igrf_coefficients(date, generation), altitude_km=altitude_km, chunk=chunk)
        self.date = parse_date(date)
        self.generation = generation

    def extra_repr(self) -> str:
        """The date, the generation and the default height."""
        return f"date={self.date.isoformat()}, generation={self.generation}, altitude_km={self.altitude_km}"


def elements_at(field: FieldModel, position: Tensor) -> Tensor:
    """D, I, B_H at positions.

    Args:
        field: any model of this module.
        position: ``(..., 2)`` latitude, longitude [deg].

    Returns:
        ``(..., 3)``: D [deg], I [deg], B_H [nT].

    Example:
        >>> paper = IGRF("2022-01-01", generation=13)
        >>> [round(x, 2) for x in elements_at(paper, torch.tensor([-2.0, 162.0])).tolist()]
        [8.02, -16.15, 35466.61]
    """
    check_tensor(2, position=position)
    return measured_elements(field(position[..., 0], position[..., 1]))


def elements_range(field: FieldModel, position: Tensor) -> tuple[Tensor, Tensor]:
    """Least and greatest D, I, B_H over positions.

    Args:
        field: any model of this module.
        position: ``(..., 2)`` latitude, longitude [deg], for example :meth:`magrl.tasks.Region.grid`.

    Returns:
        Two ``(3,)``: D [deg], I [deg], B_H [nT].

    Raises:
        ValueError: for no position at all.

    Example:
        >>> corners = torch.tensor([[-10.0, 160.0], [-10.0, 170.0], [0.0, 160.0], [0.0, 170.0]])
        >>> low, high = elements_range(IGRF("2022-01-01"), corners)
        >>> (high - low).round(decimals=1)
        tensor([  3.1000,  22.4000, 783.4000], dtype=torch.float64)
    """
    if not position.numel():
        raise ValueError(f"position must hold at least one place, got shape {tuple(position.shape)}")
    values = elements_at(field, position).reshape(-1, 3)
    return values.amin(0), values.amax(0)


def elements_gradient_at(field: FieldModel, position: Tensor) -> Tensor:
    """Horizontal gradient of D, I, B_H at positions.

    Args:
        field: any model of this module.
        position: ``(..., 2)`` latitude, longitude [deg].

    Returns:
        ``(..., 3, 2)``: element unit per km, northward and eastward.

    Example:
        >>> elements_gradient_at(IGRF("2022-01-01"), torch.tensor([-5.0, 165.0])).round(decimals=4)
        tensor([[-0.0012,  0.0015],
                [ 0.0173,  0.0030],
                [ 0.1423, -0.4990]], dtype=torch.float64)
    """
    check_tensor(2, position=position)
    return elements_gradient(*field.value_and_gradient(position[..., 0], position[..., 1]))


def check_positions(latitude: Tensor, longitude: Tensor) -> None:
    """Refuses positions that are not on Earth.

    Raises:
        ValueError: naming the first latitude beyond 90 degrees or value that is not finite.

    Example:
        >>> check_positions(torch.tensor([0.0, 95.0]), torch.zeros(2))
        Traceback (most recent call last):
            ...
        ValueError: latitude 95.0 is not between -90 and 90 degrees
    """
    check_tensor(latitude=latitude, longitude=longitude)
    _require(latitude.abs() <= 90, latitude, "latitude {} is not between -90 and 90 degrees")
    _require(longitude.abs() < math.inf, longitude, "longitude {} is not a finite number of degrees")


def _require(good: Tensor, values: Tensor, message: str) -> None:
    """Raises a ValueError that names the first value that is not good; compiled code cannot name it."""
    if torch.compiler.is_compiling():
        torch._assert_async(good.all(), message)
    elif not good.all():
        raise ValueError(message.format(values[~good].flatten()[0].item()))


def check_box(latitude: tuple[float, float], longitude: tuple[float, float]) -> None:
    """Refuses an empty, reversed or impossible latitude-longitude box.

    Raises:
        ValueError: with the values.

    Example:
        >>> check_box((-10, 0), (170, 190))
        >>> check_box((0, -10), (170, 190))
        Traceback (most recent call last):
            ...
        ValueError: latitudes (0, -10) must rise from south to north within [-90, 90] degrees
    """
    check_numbers(2, latitudes=latitude, longitudes=longitude)
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
    check_number(LEAST_ALTITUDE_KM, altitude_km=altitude_km)
    return float(altitude_km)
