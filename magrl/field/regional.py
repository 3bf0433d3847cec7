"""A fast approximation of any field model on a latitude-longitude box."""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
from torch import Tensor

from magrl.checks import check_number, check_tensor
from magrl.field.harmonics import chebyshev, chebyshev_nodes
from magrl.field.model import FieldModel, Float64Module, in_chunks
from magrl.geodesy import check_box, curvature_radii


class RegionalField(Float64Module):
    """A field model on a latitude-longitude box, as a two-dimensional Chebyshev expansion.

    Value and gradient take one small matrix product over the polynomials of the latitude and one sum over those of the
    longitude. The constructor compares the expansion with the model at points between the nodes and raises if the error
    is above the tolerance.

    Args:
        model: field model to expand.
        latitude: southern and northern edge [deg], within [-90, 90].
        longitude: western and eastern edge [deg], rising; may cross the antimeridian (for example 170 to 190).
        degree: degree of the expansion in each direction.
        tolerance_nt: largest error allowed [nT].

    Raises:
        ValueError: for an empty or reversed box, or an error above the tolerance.

    Example:
        >>> from magrl.field.igrf import IGRF
        >>> region = RegionalField(IGRF("2022-01-01", 13), (-10.0, 0.0), (160.0, 170.0))
        >>> region.error_nt < 1e-5
        True
    """

    CHUNK = 10240
    """Points evaluated at a time; temporary memory is about 2 kB per point."""
    coefficients: Tensor
    scaling: Tensor

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
        check_number(1, whole=True, degree=degree)
        check_number(0, above=True, tolerance_nt=tolerance_nt)
        self.latitude, self.longitude, self.degree = tuple(latitude), tuple(longitude), int(degree)
        self.tolerance_nt = float(tolerance_nt)
        angles, from_nodes = chebyshev_nodes(degree + 1)
        samples = model(*self._grid(angles.cos())).to("cpu", torch.float64)
        expansion = torch.einsum("ia,jb,abc->cij", from_nodes, from_nodes, samples)
        self.register_buffer("coefficients", _with_derivatives(expansion, self._half_spans()))
        self.register_buffer("scaling", self._scaling(), persistent=False)
        self.error_nt = self._worst_error(model)
        """Largest difference from the model at the check points [nT]."""
        if not self.error_nt <= tolerance_nt:
            raise ValueError(
                f"the expansion of degree {degree} misses the model by {self.error_nt:.3g} nT on latitudes {latitude}, "
                f"longitudes {longitude}; the tolerance is {tolerance_nt:.3g} nT: raise the degree or shrink the box"
            )

    def forward(self, latitude: Tensor, longitude: Tensor) -> Tensor:
        """Return the field vector.

        Args:
            latitude: ``(...)`` [deg].
            longitude: ``(...)`` [deg], any turn.

        Returns:
            ``(..., 3)`` float64: north, east, down [nT]; NaN outside the box (there is no extrapolation).
        """
        return self._evaluate(latitude, longitude, 3).movedim(0, -1)

    def value_and_gradient(self, latitude: Tensor, longitude: Tensor) -> tuple[Tensor, Tensor]:
        """Return the field vector and its exact horizontal gradient.

        Args:
            latitude: ``(...)`` [deg].
            longitude: ``(...)`` [deg], any turn.

        Returns:
            ``(..., 3)`` [nT] and ``(..., 3, 2)`` [nT/km] northward and eastward at sea level; NaN outside the box.
        """
        rows = self._evaluate(latitude, longitude, 9)
        meridian, prime_vertical = curvature_radii(latitude.double())
        parallel = prime_vertical * torch.cos(torch.deg2rad(latitude.double()))
        degrees_per_km = torch.rad2deg(torch.stack(torch.broadcast_tensors(1 / meridian, 1 / parallel)))
        gradient = rows[3:].unflatten(0, (2, 3)) * degrees_per_km.unsqueeze(1)
        return rows[:3].movedim(0, -1), gradient.movedim((1, 0), (-2, -1))

    def _evaluate(self, latitude: Tensor, longitude: Tensor, rows: int) -> Tensor:
        """Return the first 3 or all 9 rows of the expansion: ``(rows, ...)``."""
        check_tensor(latitude=latitude, longitude=longitude)
        position = torch.stack(torch.broadcast_tensors(latitude.double(), longitude.double()))
        sums = partial(self._sums, self.coefficients[: rows * (self.degree + 1)])
        return in_chunks(sums, [position.reshape(2, -1)], rows, self.CHUNK).reshape(rows, *position.shape[1:])

    def _sums(self, coefficients: Tensor, position: Tensor) -> Tensor:
        polynomials = chebyshev(self._unit(position), self.degree + 1)
        terms = (coefficients @ polynomials[:, 0]).unflatten(0, (-1, self.degree + 1, 3))
        return terms.mul_(polynomials[:, 1:]).sum(1).flatten(0, 1)

    def _unit(self, position: Tensor) -> Tensor:
        """Return latitude and longitude ``(2, P)`` in half spans from the center of the box; NaN beyond [-1, 1]."""
        center, turns, per_degree = self.scaling
        offset = position - center
        unit = torch.sub(offset, torch.round(offset * turns), alpha=360) * per_degree
        # The edges belong to the box, even if scaling rounds them out of it.
        return unit.masked_fill_(unit.abs() > 1 + 1e-12, float("nan"))

    def _scaling(self) -> Tensor:
        """Return center [deg], turns per degree and half spans per degree, of latitude and longitude: ``(3, 2, 1)``."""
        centers = sum(self.latitude) / 2, sum(self.longitude) / 2
        rows = (centers, (0.0, 1 / 360), tuple(1 / half for half in self._half_spans()))
        return torch.tensor(rows, dtype=torch.float64).unsqueeze(-1)

    def _half_spans(self) -> tuple[float, float]:
        return (self.latitude[1] - self.latitude[0]) / 2, (self.longitude[1] - self.longitude[0]) / 2

    def _grid(self, unit: Tensor) -> tuple[Tensor, Tensor]:
        half_lat, half_lon = self._half_spans()
        lat, lon = unit * half_lat + sum(self.latitude) / 2, unit * half_lon + sum(self.longitude) / 2
        grid = torch.meshgrid(lat, lon, indexing="ij")
        return grid[0], grid[1]

    def _worst_error(self, model: FieldModel) -> float:
        """Return the largest difference on a grid four times as fine as the nodes, corners included."""
        points = self._grid(torch.linspace(-1, 1, 4 * self.degree + 1, dtype=torch.float64))
        return float((self(*points) - model(*points).to("cpu", torch.float64)).abs().max())

    def extra_repr(self) -> str:
        """Return the box, the degree and the measured error as text."""
        return (
            f"latitude={self.latitude}, longitude={self.longitude}, degree={self.degree}, error_nt={self.error_nt:.1e}"
        )


def _with_derivatives(expansion: Tensor, half_spans: tuple[float, float]) -> Tensor:
    """Return value and derivative coefficients in the layout of one matrix product.

    Args:
        expansion: ``(3, K, K)`` coefficients over latitude and longitude.
        half_spans: half of the height and width of the box [deg].

    Returns:
        ``(9 K, K)``: the components, their derivatives northward, then eastward, per degree of arc; within each the
        longitude order, then the component. The second dimension is the latitude order.
    """
    table = expansion.numpy()
    north, east = np.zeros_like(table), np.zeros_like(table)
    north[:, :-1] = np.polynomial.chebyshev.chebder(table, axis=1) / half_spans[0]
    east[:, :, :-1] = np.polynomial.chebyshev.chebder(table, axis=2) / half_spans[1]
    return torch.from_numpy(np.stack((table, north, east))).permute(0, 3, 1, 2).flatten(0, 2)
