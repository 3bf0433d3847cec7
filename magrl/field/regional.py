"""A fast approximation of any field model on a latitude-longitude box."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from magrl.checks import check_number, check_tensor
from magrl.field.model import FieldModel, Float64Module, in_chunks
from magrl.field.synthesis import chebyshev, chebyshev_nodes
from magrl.geodesy import check_box, curvature_radii


class RegionalField(Float64Module):
    """A field model on a latitude-longitude box, as a two-dimensional Chebyshev expansion.

    Value and gradient take one small matrix product over the polynomials of the latitude and one sum over polynomials
    of the longitude. The constructor compares the expansion with the model at points between the nodes and raises if
    the error is above the tolerance.

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
        edges = torch.tensor((self.latitude, self.longitude), dtype=torch.float64)
        angles, from_nodes = chebyshev_nodes(degree + 1)
        samples = model(*torch.meshgrid(*inside_box(angles.cos(), edges), indexing="ij")).to("cpu", torch.float64)
        expansion = torch.einsum("ia,jb,abc->cij", from_nodes, from_nodes, samples)
        self.coefficients = nn.Buffer(_with_derivatives(expansion, (edges[:, 1] - edges[:, 0]) / 2))
        self.scaling = nn.Buffer(box_scaling(edges).unsqueeze(-1), persistent=False)
        check_points = torch.linspace(-1, 1, 4 * degree + 1, dtype=torch.float64)
        grid = torch.meshgrid(*inside_box(check_points, edges), indexing="ij")
        self.error_nt = float((self(*grid) - model(*grid).to("cpu", torch.float64)).abs().max())
        """Largest difference from the model on a grid four times as fine as the nodes, corners included [nT]."""
        check_expansion(degree, self.error_nt, tolerance_nt, (latitude, longitude))

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
        polynomials = chebyshev(in_half_spans(position, self.scaling), self.degree + 1)
        terms = (coefficients @ polynomials[:, 0]).unflatten(0, (-1, self.degree + 1, 3))
        return terms.mul_(polynomials[:, 1:]).sum(1).flatten(0, 1)


def check_expansion(
    degree: int, error_nt: float, tolerance_nt: float, edges: Sequence[Sequence[float]], place: str = "the box"
) -> None:
    """Raise unless an error is within the tolerance; NaN is not."""
    if not error_nt <= tolerance_nt:
        latitude, longitude = map(tuple, edges)
        raise ValueError(
            f"the expansion of degree {degree} misses the field by {error_nt:.3g} nT in {place}, latitudes {latitude}, "
            f"longitudes {longitude}; the tolerance is {tolerance_nt:.3g} nT: raise the degree or shrink the box"
        )


def box_scaling(edges: Tensor) -> Tensor:
    """Return what :func:`in_half_spans` needs of boxes.

    Args:
        edges: ``(..., 2, 2)`` latitude and longitude, of each the lower and the upper edge [deg].

    Returns:
        ``(..., 2, 2)``: of latitude and longitude, the center [deg] and half spans per degree.

    Example:
        >>> box_scaling(torch.tensor([[-10.0, 0.0], [160.0, 180.0]]))
        tensor([[-5.0000e+00,  2.0000e-01],
                [ 1.7000e+02,  1.0000e-01]])
    """
    low, high = edges.unbind(-1)
    return torch.stack(((low + high) / 2, 2 / (high - low)), -1)


def in_half_spans(position: Tensor, scaling: Tensor) -> Tensor:
    """Return positions as fractions of the half spans of boxes.

    Args:
        position: ``(2, P)`` latitude and longitude [deg], any turn.
        scaling: ``(2, 2, P)`` or ``(2, 2, 1)``, from :func:`box_scaling`.

    Returns:
        ``(2, P)`` from the centers, in [-1, 1]; NaN outside the box.

    Example:
        >>> scaling = box_scaling(torch.tensor([[-10.0, 0.0], [160.0, 180.0]])).unsqueeze(-1)
        >>> in_half_spans(torch.tensor([[-10.0, -5.0], [-180.0, 150.0]]), scaling)
        tensor([[-1.,  0.],
                [ 1., nan]])
    """
    center, per_degree = scaling.unbind(1)
    offset = position - center
    offset[1] -= 360 * torch.round(offset[1] / 360)
    unit = offset * per_degree
    # The edges belong to the box, even if scaling rounds them out of it.
    return unit.masked_fill_(unit.abs() > 1 + 1e-12, float("nan"))


def inside_box(unit: Tensor, edges: Tensor) -> tuple[Tensor, Tensor]:
    """Return latitudes and longitudes at fractions of the half spans of boxes.

    Args:
        unit: ``(U,)`` from the center, in [-1, 1].
        edges: ``(..., 2, 2)`` latitude and longitude, of each the lower and the upper edge [deg].

    Returns:
        ``(..., U)`` each [deg].

    Example:
        >>> inside_box(torch.tensor([-1.0, 0.0]), torch.tensor([[-10.0, 0.0], [160.0, 180.0]]))
        (tensor([-10.,  -5.]), tensor([160., 170.]))
    """
    low, high = edges.unsqueeze(-1).unbind(-2)
    latitude, longitude = ((high - low) / 2 * unit + (low + high) / 2).unbind(-2)
    return latitude, longitude


def _with_derivatives(expansion: Tensor, half_spans: Tensor) -> Tensor:
    """Return value and derivative coefficients in the layout of one matrix product.

    Args:
        expansion: ``(3, K, K)`` coefficients over latitude and longitude.
        half_spans: ``(2,)`` half of the height and width of the box [deg].

    Returns:
        ``(9 K, K)``: the components, their derivatives northward, then eastward, per degree of arc; within each the
        longitude order, then the component. The second dimension is the latitude order.
    """
    table = expansion.numpy()
    north, east = np.zeros_like(table), np.zeros_like(table)
    north[:, :-1] = np.polynomial.chebyshev.chebder(table, axis=1) / float(half_spans[0])
    east[:, :, :-1] = np.polynomial.chebyshev.chebder(table, axis=2) / float(half_spans[1])
    return torch.from_numpy(np.stack((table, north, east))).permute(0, 3, 1, 2).flatten(0, 2)
