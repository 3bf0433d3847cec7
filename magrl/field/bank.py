"""Many regional expansions evaluated together: each vehicle flies in a region of its own."""

from __future__ import annotations

from typing import Self

import numpy as np
import torch
from torch import Tensor, nn

from magrl.checks import check_number, check_tensor, require
from magrl.field import synthesis
from magrl.field.model import Float64Module, in_chunks
from magrl.field.regional import box_scaling, check_expansion, in_half_spans, inside_box
from magrl.field.synthesis import chebyshev, chebyshev_nodes, checked_gauss
from magrl.geodesy import check_box, curvature_radii, to_ecef


class FieldBank(Float64Module):
    """Chebyshev expansions of many fields, each on a latitude-longitude box, at sea level of the WGS84 ellipsoid.

    Each position comes with the index of its expansion, so a batch of vehicles can be spread over many planets. An
    evaluation sums the coefficients of each vehicle over the polynomials of its latitude, without a copy of them, then
    over polynomials of its longitude. :meth:`build` makes a bank from Gauss coefficients. A bank of one box is a
    :class:`~magrl.field.RegionalField`.

    Args:
        expansion: ``(K, 3, n, n)`` Chebyshev coefficients of north, east, down [nT], by the order in latitude, then in
            longitude.
        latitude: ``(K, 2)`` southern and northern edges [deg], within [-90, 90].
        longitude: ``(K, 2)`` western and eastern edges [deg], rising; may cross the antimeridian (170 to 190).

    Raises:
        TypeError: for an argument that is not a tensor of real numbers.
        ValueError: for another shape, or an empty or reversed box, with its edges.

    Example:
        >>> from magrl.field import random_planets
        >>> south, west = torch.tensor([-10.0, 40.0, 45.0]), torch.tensor([160.0, 170.0, -20.0])
        >>> boxes = torch.stack((south, south + 20), -1), torch.stack((west, west + 20), -1)
        >>> bank = FieldBank.build(random_planets(2, seed=0), torch.tensor([0, 0, 1]), *boxes)
        >>> bank(torch.tensor([0.0, 50.0]), torch.tensor([170.0, -10.0]), torch.tensor([0, 2])).shape
        torch.Size([2, 3])
    """

    indexed = True
    """Whether an evaluation takes an index."""
    CHUNK = 10240
    """Positions evaluated at a time; temporary memory is about 3 kB per position."""
    error_nt: Tensor
    """Largest difference from the exact field at the check points of each expansion, ``(K,)`` [nT]; NaN if unknown."""

    def __init__(self, expansion: Tensor, latitude: Tensor, longitude: Tensor) -> None:
        super().__init__()
        check_tensor(expansion=expansion)
        if expansion.ndim != 4 or expansion.shape[1:] != (3, *expansion.shape[-1:] * 2) or expansion.shape[-1] < 2:
            raise ValueError(f"expansion must have the shape (K, 3, n, n) with n >= 2, got {tuple(expansion.shape)}")
        terms = expansion.shape[-1]
        edges = torch.stack(checked_boxes(latitude, longitude), 1)
        if len(edges) != len(expansion):
            raise ValueError(f"latitude must hold {len(expansion)} boxes, as expansion, got {len(edges)}")
        self.degree = terms - 1
        # The latitude order, then, as in RegionalField, the longitude order and within it the component.
        self.coefficients = nn.Buffer(expansion.double().permute(0, 2, 3, 1).flatten(2).contiguous())
        self.scaling = nn.Buffer(box_scaling(edges).to(expansion.device))
        self.slopes = nn.Buffer(_slopes(terms).to(expansion.device), persistent=False)
        self.register_buffer("error_nt", torch.full_like(self.scaling[:, 0, 0], torch.nan))

    @classmethod
    def build(
        cls,
        gauss: Tensor,
        planet_index: Tensor,
        latitude: Tensor,
        longitude: Tensor,
        *,
        degree: int = 12,
        tolerance_nt: float | None = 1e-3,
    ) -> Self:
        """Expand the fields of planets on boxes, and measure the error of each expansion.

        Args:
            gauss: complex ``(P, N + 1, N + 1)`` tables ``g - i h`` [nT], for example
                :func:`~magrl.field.random_planets`.
            planet_index: ``(K,)`` int64, the planet of each box.
            latitude: ``(K, 2)`` southern and northern edges [deg], within [-90, 90].
            longitude: ``(K, 2)`` western and eastern edges [deg], rising; may cross the antimeridian (170 to 190).
            degree: degree of the expansions in each direction.
            tolerance_nt: largest error allowed [nT], at points four times as dense as the nodes, corners included; None
                to leave the error unknown.

        Returns:
            The bank, with the error of each expansion in ``error_nt``.

        Raises:
            TypeError: for tables that are not complex, or indices that are not int64.
            ValueError: for another shape, coefficients that are not finite, an index without a planet, an empty or
                reversed box, or an error above the tolerance, naming the worst box.
        """
        check_number(1, whole=True, degree=degree)
        check_number(0, above=True, optional=True, tolerance_nt=tolerance_nt)
        edges = torch.stack(checked_boxes(latitude, longitude), 1).cpu()
        gauss = checked_gauss(gauss, batch=True).cpu()
        check_index(planet_index, len(gauss), "planet_index")
        if planet_index.shape != edges.shape[:1]:
            raise ValueError(f"planet_index must have the shape ({len(edges)},), got {tuple(planet_index.shape)}")
        used, planet_index = planet_index.cpu().unique(return_inverse=True)
        weights = _surface_weights(gauss[used])
        boxes = list(zip(planet_index.split(_BOXES), edges.split(_BOXES), strict=True))
        angles, from_nodes = chebyshev_nodes(degree + 1)
        samples = (_synthesis(weights[k], *inside_box(angles.cos(), box)) for k, box in boxes)
        bank = cls(torch.cat([from_nodes @ x @ from_nodes.T for x in samples]), latitude, longitude)
        if tolerance_nt is None:
            return bank
        unit = torch.linspace(-1, 1, 4 * degree + 1, dtype=torch.float64)
        polynomials = chebyshev(unit, degree + 1)
        errors = []
        for (k, box), table in zip(boxes, bank.coefficients.cpu().split(_BOXES), strict=True):
            expanded = polynomials.T @ table.unflatten(2, (-1, 3)).permute(0, 3, 1, 2) @ polynomials
            errors.append((expanded - _synthesis(weights[k], *inside_box(unit, box))).abs().amax((1, 2, 3)))
        bank.error_nt.copy_(torch.cat(errors))
        worst = int(bank.error_nt.nan_to_num(torch.inf).argmax())
        place = f"box {worst}, of planet {used[planet_index[worst]]}"
        check_expansion(degree, bank.error_nt[worst].item(), tolerance_nt, edges[worst].tolist(), place)
        return bank

    def __len__(self) -> int:
        """Return the number of expansions."""
        return len(self.coefficients)

    def forward(self, latitude: Tensor, longitude: Tensor, index: Tensor) -> Tensor:
        """Return the field vector.

        Args:
            latitude: ``(...)`` [deg].
            longitude: ``(...)`` [deg], any turn.
            index: ``(...)`` int64, the expansion of each position.

        Returns:
            ``(..., 3)`` float64: north, east, down [nT]; NaN outside the box (there is no extrapolation).

        Raises:
            TypeError: for an index of another dtype.
            ValueError: for an index outside [0, K).
        """
        shape, points = self._points(latitude, longitude, index)
        return in_chunks(self._value, points, 3, self.CHUNK).reshape(3, *shape).movedim(0, -1)

    def value_and_gradient(self, latitude: Tensor, longitude: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
        """Return the field vector and the exact horizontal gradient of its expansion.

        Args:
            latitude: ``(...)`` [deg].
            longitude: ``(...)`` [deg], any turn.
            index: ``(...)`` int64, the expansion of each position.

        Returns:
            ``(..., 3)`` [nT] and ``(..., 3, 2)`` [nT/km] northward and eastward at sea level; NaN outside the box.

        Raises:
            TypeError: for an index of another dtype.
            ValueError: for an index outside [0, K).
        """
        shape, points = self._points(latitude, longitude, index)
        rows = in_chunks(self._value_and_gradient, points, 9, self.CHUNK).reshape(9, *shape)
        return rows[:3].movedim(0, -1), rows[3:].unflatten(0, (2, 3)).movedim((1, 0), (-2, -1))

    def on_grids(self, grids: Tensor) -> tuple[Tensor, Tensor]:
        """Return the field vector and its gradient on a grid of each box, faster than :meth:`value_and_gradient`.

        Args:
            grids: ``(K, U, U, 2)`` latitude, longitude [deg], as of :meth:`magrl.envs.Regions.grid`.

        Returns:
            ``(K, U, U, 3)`` [nT] and ``(K, U, U, 3, 2)`` [nT/km] northward and eastward at sea level.
        """
        latitude = grids[:, :, 0, 0]
        scaling = self.scaling.movedim(0, -1).unsqueeze(-1)
        polynomials = chebyshev(in_half_spans(torch.stack((latitude, grids[:, 0, :, 1])), scaling), self.degree + 1)
        slopes = torch.einsum("ij,jaku->iaku", self.slopes, polynomials) * scaling[:, 1]
        (along, across), (north, east) = polynomials.unbind(1), slopes.unbind(1)
        table = self.coefficients.unflatten(2, (-1, 3))
        pairs = (along, across), (north, across), (along, east)
        rows = [torch.einsum("knmc,nku,mkv->kuvc", table, *pair) for pair in pairs]
        return rows[0], torch.stack(rows[1:], -1) * _degrees_per_km(latitude).movedim(0, -1)[:, :, None, None]

    def _points(self, latitude: Tensor, longitude: Tensor, index: Tensor) -> tuple[torch.Size, list[Tensor]]:
        """Return the shape of the positions, positions ``(2, P)`` and indices ``(P,)``."""
        check_tensor(latitude=latitude, longitude=longitude)
        check_index(index, len(self.coefficients))
        latitude, longitude, index = torch.broadcast_tensors(latitude.double(), longitude.double(), index)
        return index.shape, [torch.stack((latitude, longitude)).reshape(2, -1), index.reshape(-1)]

    def _value(self, position: Tensor, index: Tensor) -> Tensor:
        """Return north, east, down: ``(3, P)`` [nT]."""
        unit = in_half_spans(position, self.scaling.index_select(0, index).movedim(0, -1))
        latitude, longitude = chebyshev(unit, self.degree + 1).unbind(1)
        return self._sum_latitude(index, latitude).mul_(longitude.unsqueeze(1)).sum(0)

    def _value_and_gradient(self, position: Tensor, index: Tensor) -> Tensor:
        """Return the vector [nT], then the derivative of each component northward and eastward [nT/km]: ``(9, P)``."""
        scaling = self.scaling.index_select(0, index).movedim(0, -1)
        polynomials = chebyshev(in_half_spans(position, scaling), self.degree + 1)
        slopes = (self.slopes @ polynomials.flatten(1)).reshape(polynomials.shape)
        latitude = torch.cat((polynomials[:, 0], slopes[:, 0]), -1)
        terms = self._sum_latitude(index.repeat(2), latitude).unflatten(-1, (2, -1))
        east = (terms[:, :, 0] * slopes[:, 1:]).sum(0)
        value, north = (terms * polynomials[:, 1:].unsqueeze(1)).sum(0).unbind(1)
        per_km = scaling[:, 1] * _degrees_per_km(position[0])
        return torch.cat((value, north * per_km[0], east * per_km[1]))

    def _sum_latitude(self, index: Tensor, polynomials: Tensor) -> Tensor:
        """Return the sums over the latitude order: ``(n, P)`` to ``(n, 3, P)``, by longitude order and component."""
        terms = len(polynomials)
        rows = index.unsqueeze(-1) * terms + torch.arange(terms, device=index.device)
        bags = nn.functional.embedding_bag(
            rows, self.coefficients.flatten(0, 1), per_sample_weights=polynomials.T, mode="sum"
        )
        return bags.T.contiguous().unflatten(0, (terms, 3))


_BOXES = 64
"""Boxes expanded at a time: at degree 13, about 30 MB of temporary memory."""


def check_index(index: Tensor, count: int, name: str = "index") -> None:
    """Raise unless indices are int64 in [0, count); on an accelerator, without synchronization.

    Example:
        >>> check_index(torch.tensor([0, 3]), 2)
        Traceback (most recent call last):
        ValueError: index 3 is not in [0, 2)
    """
    check_tensor(**{name: index})
    if index.dtype != torch.int64:
        raise TypeError(f"{name} must be int64, got {index.dtype}")
    require((index >= 0) & (index < count), index, f"{name} {{}} is not in [0, {count})")


def checked_boxes(latitude: Tensor, longitude: Tensor) -> tuple[Tensor, Tensor]:
    """Return the edges of boxes ``(K, 2)`` as float64; raise unless there is one and all are sound.

    Example:
        >>> checked_boxes(torch.tensor([[-10.0, 0.0]]), torch.tensor([[170.0, 190.0]]))[1]
        tensor([[170., 190.]], dtype=torch.float64)
    """
    check_tensor(2, latitude=latitude, longitude=longitude)
    if latitude.ndim != 2 or latitude.shape != longitude.shape or not len(latitude):
        shapes = f"{tuple(latitude.shape)} and {tuple(longitude.shape)}"
        raise ValueError(f"latitude and longitude must have the shape (K, 2) with K >= 1, got {shapes}")
    latitude, longitude = latitude.double(), longitude.double()
    (south, north), (west, east) = latitude.T, longitude.T
    sound = (south >= -90) & (south < north) & (north <= 90) & (west < east) & (east <= west + 360)
    for k in (~sound).nonzero().flatten().tolist():
        check_box(tuple(latitude[k].tolist()), tuple(longitude[k].tolist()), f" of box {k}")
    return latitude, longitude


def _degrees_per_km(latitude: Tensor) -> Tensor:
    """Return degrees of latitude and of longitude per kilometer at sea level: ``(2, ...)``."""
    meridian, prime_vertical = curvature_radii(latitude)
    return torch.rad2deg(1 / torch.stack((meridian, prime_vertical * torch.cos(torch.deg2rad(latitude)))))


def _slopes(terms: int) -> Tensor:
    """Return the matrix from Chebyshev polynomials to their derivatives: ``(terms, terms)``."""
    return nn.functional.pad(torch.from_numpy(np.polynomial.chebyshev.chebder(np.eye(terms)).T.copy()), (0, 1))


def _surface_weights(gauss: Tensor) -> Tensor:
    """Return weights of Bx, By, Bz on the ellipsoid: ``(P, 3, M, F)`` [nT], over :func:`harmonics.waves` and T_f.

    As in :class:`~magrl.field.SphericalHarmonicField`: 12 polynomials of the sine of the latitude more than the degree
    leave an error of 1e-9 nT.
    """
    degree = gauss.shape[-1]
    angles, _ = chebyshev_nodes(degree + 12)
    axis, _, z = to_ecef(90 - torch.rad2deg(angles), torch.zeros_like(angles)).unbind(-1)
    tables = synthesis.field_table(gauss).flatten(0, 1)
    return synthesis.on_surface(tables, axis, z, degree).unflatten(0, (-1, 3))


def _synthesis(weights: Tensor, latitude: Tensor, longitude: Tensor) -> Tensor:
    """Return the exact field of planets on grids.

    Args:
        weights: ``(B, 3, M, F)`` of :func:`_surface_weights`.
        latitude: ``(B, U)`` [deg].
        longitude: ``(B, V)`` [deg].

    Returns:
        ``(B, 3, U, V)`` north, east, down [nT].
    """
    degree = weights.shape[2] // 2
    (sp, cp), (sl, cl) = ((torch.sin(x), torch.cos(x)) for x in (torch.deg2rad(latitude), torch.deg2rad(longitude)))
    features = chebyshev(sp, weights.shape[3]).movedim(1, 0)
    orders = (weights.flatten(1, 2) @ features).unflatten(1, (3, -1))
    odd = torch.cat((torch.arange(1, degree + 1), torch.arange(degree + 1))) % 2 == 1
    orders[:, :, odd] *= cp[:, None, None]
    turns = synthesis.waves(cl.flatten(), sl.flatten(), torch.ones_like(cl.flatten()), degree)
    x, y, z = (orders.mT @ turns.unflatten(1, cl.shape).movedim(1, 0).unsqueeze(1)).unbind(1)
    sp, cp, sl, cl = sp.unsqueeze(-1), cp.unsqueeze(-1), sl.unsqueeze(-2), cl.unsqueeze(-2)
    outward, east = cl * x + sl * y, cl * y - sl * x
    return torch.stack((cp * z - sp * outward, east, -cp * outward - sp * z), 1)
