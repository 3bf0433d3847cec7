"""A fast surrogate of any field model on a latitude-longitude box."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from magrl.fields import FieldModel, Float64Module, check_box
from magrl.geodesy import curvature_radii, wrap_longitude


class RegionalField(Float64Module):
    """A field model on a latitude-longitude box, as a two-dimensional Chebyshev expansion.

    Value and gradient are two small contractions, which is what makes a simulation step cheap. The expansion is
    compared with the model on points between its nodes when it is built, and refused if it misses the tolerance.

    Args:
        model: the field to expand.
        latitude: lowest and highest latitude [deg], inside [-90, 90].
        longitude: westernmost and easternmost longitude [deg], the second greater; may cross the antimeridian
            (for example 170 to 190).
        degree: of the expansion in each direction.
        tolerance_nt: largest error allowed [nT].

    Raises:
        ValueError: for an empty or reversed box, or an error above the tolerance.

    Example:
        >>> from magrl.fields import IGRF
        >>> region = RegionalField(IGRF("2022-01-01", 13), (-10.0, 0.0), (160.0, 170.0))
        >>> region.error_nt < 1e-5
        True
    """

    coefficients: Tensor

    def __init__(
        self,
        model: FieldModel,
        latitude: tuple[float, float],
        longitude: tuple[float, float],
        *,
        degree: int = 12,
        tolerance_nt: float = 1e-3,
    ) -> None:
        super().__init__()
        check_box(latitude, longitude)
        if degree < 1:
            raise ValueError(f"degree must be at least 1, got {degree}")
        if not tolerance_nt > 0:
            raise ValueError(f"tolerance_nt must be positive, got {tolerance_nt}")
        self.latitude, self.longitude, self.degree = tuple(latitude), tuple(longitude), int(degree)
        self.tolerance_nt = float(tolerance_nt)
        nodes, from_nodes = _chebyshev_nodes(degree)
        samples = model(*self._grid(nodes)).to("cpu", torch.float64)
        expansion = torch.einsum("ia,jb,abc->cij", from_nodes, from_nodes, samples)
        self.register_buffer("coefficients", _with_derivatives(expansion, self._half_spans()))
        self.error_nt = self._worst_error(model)
        """The largest difference from the model that was found on the check points [nT]."""
        if not self.error_nt <= tolerance_nt:
            raise ValueError(
                f"the expansion of degree {degree} misses the model by {self.error_nt:.3g} nT on latitudes {latitude}, "
                f"longitudes {longitude}; the tolerance is {tolerance_nt:.3g} nT: raise the degree or shrink the box"
            )

    def forward(self, latitude: Tensor, longitude: Tensor) -> Tensor:
        """The field vector.

        Args:
            latitude: ``(...)`` [deg].
            longitude: ``(...)`` [deg], any turn.

        Returns:
            ``(..., 3)`` float64: north, east, down [nT]; NaN outside the box, never an extrapolation.
        """
        across, along = self._chebyshev(latitude, longitude)
        return (self._contract(along, 3) @ across.unsqueeze(-1)).squeeze(-1)

    def value_and_gradient(self, latitude: Tensor, longitude: Tensor) -> tuple[Tensor, Tensor]:
        """The field vector and its exact horizontal gradient.

        Args:
            latitude: ``(...)`` [deg].
            longitude: ``(...)`` [deg], any turn.

        Returns:
            ``(..., 3)`` [nT] and ``(..., 3, 2)`` [nT/km] northward and eastward at sea level; NaN outside the box.
        """
        across, along = self._chebyshev(latitude, longitude)
        parts = (self._contract(along, 9) @ across.unsqueeze(-1)).squeeze(-1)
        value, gradient = parts[..., :3], parts[..., 3:].unflatten(-1, (3, 2))
        latitude = latitude.to(parts.dtype)
        meridian, prime_vertical = curvature_radii(latitude)
        parallel = prime_vertical * torch.cos(torch.deg2rad(latitude))
        degrees_per_km = torch.rad2deg(torch.stack((1 / meridian, 1 / parallel), -1))
        return value, gradient * degrees_per_km.unsqueeze(-2)

    def _chebyshev(self, latitude: Tensor, longitude: Tensor) -> tuple[Tensor, Tensor]:
        """T_k at the scaled longitude and latitude, each ``(..., degree + 1)``; NaN beyond [-1, 1]."""
        half_lat, half_lon = self._half_spans()
        y = (latitude.double() - sum(self.latitude) / 2) / half_lat
        x = wrap_longitude(longitude.double() - sum(self.longitude) / 2) / half_lon
        unit = torch.stack(torch.broadcast_tensors(x, y))
        # The edges belong to the box, though scaling may round them out of it.
        unit = torch.where(unit.abs() <= 1 + 1e-12, unit.clamp(-1, 1), float("nan"))
        polynomials = [torch.ones_like(unit), unit]
        for _ in range(self.degree - 1):
            polynomials.append(2 * unit * polynomials[-1] - polynomials[-2])
        across, along = torch.stack(polynomials, -1)
        return across, along

    def _contract(self, along: Tensor, channels: int) -> Tensor:
        table = self.coefficients[:, :channels].flatten(1)
        return (along @ table).unflatten(-1, (channels, -1))

    def _half_spans(self) -> tuple[float, float]:
        return (self.latitude[1] - self.latitude[0]) / 2, (self.longitude[1] - self.longitude[0]) / 2

    def _grid(self, unit: Tensor) -> tuple[Tensor, Tensor]:
        half_lat, half_lon = self._half_spans()
        lat, lon = unit * half_lat + sum(self.latitude) / 2, unit * half_lon + sum(self.longitude) / 2
        grid = torch.meshgrid(lat, lon, indexing="ij")
        return grid[0], grid[1]

    def _worst_error(self, model: FieldModel) -> float:
        """Largest difference on a grid four times as fine as the nodes, corners included."""
        points = self._grid(torch.linspace(-1, 1, 4 * self.degree + 1, dtype=torch.float64))
        return float((self(*points) - model(*points).to("cpu", torch.float64)).abs().max())

    def extra_repr(self) -> str:
        return (
            f"latitude={self.latitude}, longitude={self.longitude}, degree={self.degree}, error_nt={self.error_nt:.1e}"
        )


def _chebyshev_nodes(degree: int) -> tuple[Tensor, Tensor]:
    """The K = degree + 1 Chebyshev nodes and the matrix from values there to coefficients, ``(K, K)``."""
    k = torch.arange(degree + 1, dtype=torch.float64)
    angles = (k + 0.5) * math.pi / (degree + 1)
    matrix = torch.cos(k.unsqueeze(-1) * angles) * (2 / (degree + 1))
    matrix[0] /= 2
    return torch.cos(angles), matrix


def _with_derivatives(expansion: Tensor, half_spans: tuple[float, float]) -> Tensor:
    """Value and derivative coefficients laid out for one matrix product.

    Args:
        expansion: ``(3, K, K)`` coefficients over latitude and longitude.
        half_spans: half the box's height and width [deg].

    Returns:
        ``(K, 9, K)``: per latitude order the three components, then (component, north or east) per degree of arc.
    """
    table = expansion.numpy()
    cheb = np.polynomial.chebyshev.chebder
    pad = [np.zeros_like(table), np.zeros_like(table)]
    pad[0][:, :-1] = cheb(table, axis=1) / half_spans[0]
    pad[1][:, :, :-1] = cheb(table, axis=2) / half_spans[1]
    derivative = np.stack(pad, 1).reshape(6, *table.shape[1:])
    return torch.from_numpy(np.concatenate((table, derivative))).transpose(0, 1).contiguous()
