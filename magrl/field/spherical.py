"""Field of a spherical harmonic expansion on the WGS84 ellipsoid, with its exact horizontal gradient."""

from __future__ import annotations

from functools import partial
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from magrl.checks import check_number, check_tensor, require
from magrl.field import synthesis
from magrl.field.model import Float64Module, in_chunks
from magrl.geodesy import WGS84_A_KM, WGS84_E2, check_positions


class SphericalHarmonicField(Float64Module):
    """Field of a Schmidt semi-normalized spherical harmonic expansion, on the WGS84 ellipsoid.

    Args:
        gauss: complex ``(N + 1, N + 1)`` table ``g - i h`` [nT].
        altitude_km: default height above the ellipsoid [km].

    Raises:
        TypeError: if ``gauss`` is not a complex tensor.
        ValueError: for a table of another shape or with non-finite values, or an altitude beyond its range, which is
            probably not in kilometers.

    Example:
        >>> dipole = torch.zeros(2, 2, dtype=torch.complex128)
        >>> dipole[1, 0] = -30000.0  # g of degree 1, order 0
        >>> field = SphericalHarmonicField(dipole)
        >>> field(torch.tensor([0.0, 90.0]), torch.tensor(0.0)).round().abs()  # north; at the pole twice that, down
        tensor([[29902.,     0.,     0.],
                [    0.,     0., 60410.]], dtype=torch.float64)
    """

    altitude_range_km: ClassVar[tuple[float, float]] = (-15.0, 1000.0)
    """Range of altitudes: from below the deepest trench to the height of satellites that measure the field [km]."""
    CHUNK = 16384
    """Points evaluated at a time; temporary memory is about 1 kB per point on a CPU and 6 kB on an accelerator."""
    value_weights: Tensor
    gradient_weights: Tensor
    level_value_weights: Tensor
    level_gradient_weights: Tensor

    def __init__(self, gauss: Tensor, *, altitude_km: float = 0.0) -> None:
        super().__init__()
        check_number(altitude_km=altitude_km)
        gauss = synthesis.checked_gauss(gauss)
        self._check_altitude(torch.tensor(altitude_km, dtype=torch.float64))
        self.degree, self.altitude_km = len(gauss) - 1, float(altitude_km)
        value, gradient = synthesis.field_table(gauss), synthesis.gradient_table(gauss)
        padding = (0, gradient.shape[1] - value.shape[1])
        all_rows = torch.cat((nn.functional.pad(value, padding), gradient[list(_INDEPENDENT)]))
        for name, table, degree in (("value", value, self.degree + 1), ("gradient", all_rows, self.degree + 2)):
            self.register_buffer(f"{name}_weights", synthesis.separate(table, degree))
            self.register_buffer(f"level_{name}_weights", _at_altitude(table, degree, self.altitude_km))

    def forward(self, latitude: Tensor, longitude: Tensor, altitude_km: Tensor | float | None = None) -> Tensor:
        """Return the field vector.

        Args:
            latitude: ``(...)`` geodetic [deg].
            longitude: ``(...)`` [deg], any turn.
            altitude_km: ``(...)`` or a number [km]; by default the model's.

        Returns:
            ``(..., 3)`` float64: north, east, down [nT]. At a pole, north is along the given meridian.

        Raises:
            ValueError: for a latitude beyond 90 degrees, or a non-finite position.
        """
        return self._evaluate(3, latitude, longitude, altitude_km).movedim(0, -1)

    def value_and_gradient(
        self, latitude: Tensor, longitude: Tensor, altitude_km: Tensor | float | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return the field vector and its exact horizontal gradient.

        The gradient is of the local components, so it contains the rotation of the local axes. Its east column
        grows without bound at a geographic pole, where the direction of north rotates.

        Args:
            latitude: ``(...)`` geodetic [deg].
            longitude: ``(...)`` [deg], any turn.
            altitude_km: ``(...)`` or a number [km]; by default the model's.

        Returns:
            The vector ``(..., 3)`` [nT] and the derivative of each component northward and eastward at constant
            altitude, ``(..., 3, 2)`` [nT/km].

        Raises:
            ValueError: for a latitude beyond 90 degrees, or a non-finite position.
        """
        rows = self._evaluate(9, latitude, longitude, altitude_km)
        return rows[:3].movedim(0, -1), rows[3:].unflatten(0, (3, 2)).movedim((0, 1), (-2, -1))

    def _evaluate(
        self, rows: int, latitude: Tensor, longitude: Tensor, altitude_km: Tensor | float | None = None
    ) -> Tensor:
        """Return the first 3 or all 9 rows of :meth:`_value_and_gradient`: ``(rows, ...)``."""
        points = self._points(latitude, longitude, altitude_km)
        function = partial(self._value if rows == 3 else self._value_and_gradient, altitude_km is None)
        values = in_chunks(function, [x.reshape(-1) for x in points], rows, self.CHUNK)
        return values.reshape(rows, *points[0].shape)

    def _points(self, latitude: Tensor, longitude: Tensor, altitude_km: Tensor | float | None) -> tuple[Tensor, ...]:
        """Return latitude, longitude and altitude in float64, broadcast and checked."""
        altitude_km = self.altitude_km if altitude_km is None else altitude_km
        if not isinstance(altitude_km, Tensor):
            altitude_km = torch.tensor(altitude_km, dtype=torch.float64)
        check_tensor(latitude=latitude, longitude=longitude, altitude_km=altitude_km)
        tensors = [x.to(self.value_weights.device, torch.float64) for x in (latitude, longitude, altitude_km)]
        check_positions(tensors[0], tensors[1])
        self._check_altitude(tensors[2])
        return torch.broadcast_tensors(*tensors)

    def _check_altitude(self, altitude_km: Tensor) -> None:
        lowest, highest = self.altitude_range_km
        allowed = f"from {lowest:g} to {highest:g} km (a depth is negative): is it in meters? Divide by 1000"
        sound = (altitude_km >= lowest) & (altitude_km <= highest)
        require(sound, altitude_km, f"altitude_km {{}} is not {allowed}")

    def _value(self, level: bool, latitude: Tensor, longitude: Tensor, altitude_km: Tensor) -> Tensor:
        """Return north, east, down, ``(3, P)`` [nT]; ``level`` if the altitude is the model's."""
        place = _place(latitude, longitude, altitude_km)
        sums = _sums(self.level_value_weights if level else self.value_weights, place, level)
        return (place.frame * sums).sum(1)

    def _value_and_gradient(self, level: bool, latitude: Tensor, longitude: Tensor, altitude_km: Tensor) -> Tensor:
        """Return the vector [nT], then the derivative of each component northward and eastward [nT/km]: ``(9, P)``."""
        place = _place(latitude, longitude, altitude_km)
        sums = _sums(self.level_gradient_weights if level else self.gradient_weights, place, level)
        value = (place.frame * sums[:3]).sum(1)
        xx, xy, xz, yy, yz = sums[3:]
        tensor = torch.stack((xx, xy, xz, xy, yy, yz, xz, yz, -xx - yy)).unflatten(0, (3, 3))
        half = (place.frame.unsqueeze(2) * tensor).sum(1)
        gradient = (half.unsqueeze(1) * place.frame[:2]).sum(2).flatten(0, 1)
        return torch.cat((value, gradient + _frame_turning(value, place)))


_INDEPENDENT = (0, 1, 2, 4, 5)
"""Rows xx, xy, xz, yy, yz of the gradient: it is symmetric (no curl) and has no trace (no divergence)."""


class _Place(NamedTuple):
    """Quantities of P points that the synthesis uses, with each sine and cosine computed once."""

    sines: tuple[Tensor, Tensor]  # of latitude and longitude
    cosines: tuple[Tensor, Tensor]
    frame: Tensor  # (3, 3, P), rows north, east, down, as geodesy.local_frame
    meridian_km: Tensor  # radius of curvature along the meridian, plus the altitude
    across_km: Tensor  # radius of curvature across the meridian, plus the altitude
    z_km: Tensor  # height above the equatorial plane


def _place(latitude: Tensor, longitude: Tensor, altitude_km: Tensor) -> _Place:
    angles = torch.deg2rad(torch.stack((latitude, longitude)))
    (sp, sl), (cp, cl) = torch.sin(angles), torch.cos(angles)
    root = torch.rsqrt(1 - WGS84_E2 * sp * sp)
    prime_vertical = WGS84_A_KM * root
    meridian = (1 - WGS84_E2) * prime_vertical * root * root + altitude_km
    z = ((1 - WGS84_E2) * prime_vertical + altitude_km) * sp
    frame = torch.stack((-sp * cl, -sp * sl, cp, -sl, cl, torch.zeros_like(sl), -cp * cl, -cp * sl, -sp))
    return _Place((sp, sl), (cp, cl), frame.unflatten(0, (3, 3)), meridian, prime_vertical + altitude_km, z)


def _sums(weights: Tensor, place: _Place, level: bool) -> Tensor:
    """Return rows of an expansion ``(R, P)``; ``level`` if the weights were made for the altitude of the points."""
    degree, features = weights.shape[1] // 2, weights.shape[2]

    def some(out: Tensor, up: Tensor, cos_lon: Tensor, sin_lon: Tensor) -> Tensor:
        terms, lift = (synthesis.chebyshev(up, features), out) if level else synthesis.products(out, up, degree)
        return synthesis.contract(weights, terms, synthesis.waves(cos_lon, sin_lon, lift, degree))

    meridian = place.cosines[0], place.sines[0]
    if not level:
        meridian = place.across_km * place.cosines[0], place.z_km
    return in_chunks(some, (*meridian, place.cosines[1], place.sines[1]), len(weights), _points_in_cache(weights))


def _points_in_cache(weights: Tensor) -> int:
    """Return the number of points for which the largest array of a synthesis stays in a CPU cache."""
    return max(1, 180_000 // weights[..., 0].numel()) if weights.device.type == "cpu" else 2**62


def _at_altitude(table: Tensor, degree: int, altitude_km: float) -> Tensor:
    """Return weights over Chebyshev polynomials of the sine of the latitude, for points of one altitude.

    The ellipsoid is close to a sphere, so 12 polynomials more than the degree leave an error of 1e-9 nT on IGRF.
    """
    angles, _ = synthesis.chebyshev_nodes(degree + 12, table.device)
    latitude = 90 - torch.rad2deg(angles)
    place = _place(latitude, torch.zeros_like(latitude), torch.full_like(latitude, altitude_km))
    return synthesis.on_surface(table, place.across_km * place.cosines[0], place.z_km, degree)


def _frame_turning(b_ned: Tensor, place: _Place) -> Tensor:
    """Return the part of the gradient that comes from the rotation of the axes: ``(6, P)`` [nT/km]."""
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
