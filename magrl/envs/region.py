"""Latitude-longitude boxes on the WGS84 ellipsoid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from magrl import paper
from magrl.checks import check_number, check_numbers, check_tensor
from magrl.geodesy import MEAN_RADIUS_KM, check_box, geodesic, wrap_longitude

_SHORTEST_DEGREE_KM = 110.5  # a degree of arc is nowhere shorter on the ellipsoid


@dataclass(frozen=True)
class Region:
    """A latitude-longitude box.

    Args:
        latitude: southern and northern edge [deg].
        longitude: western and eastern edge [deg], rising; (170, 190) crosses the antimeridian.

    Raises:
        ValueError: for an empty, reversed or impossible box.

    Example:
        >>> Region((-10, 0), (160, 170)).expanded(5)
        Region(latitude=(-15.0, 5.0), longitude=(155.0, 175.0))
    """

    latitude: tuple[float, float]
    longitude: tuple[float, float]

    def __post_init__(self) -> None:
        check_numbers(2, latitudes=self.latitude, longitudes=self.longitude)
        check_box(self.latitude, self.longitude)
        object.__setattr__(self, "latitude", tuple(float(x) for x in self.latitude))
        object.__setattr__(self, "longitude", tuple(float(x) for x in self.longitude))

    def contains(self, position: Tensor) -> Tensor:
        """Return whether positions lie in the box.

        Args:
            position: ``(..., 2)`` latitude, longitude [deg].

        Returns:
            ``(..., 1)`` bool, edges included; False for NaN.
        """
        return in_box(position, self.latitude, self.longitude)

    def expanded(self, margin_deg: float) -> Region:
        """Return the box with a margin on each side [deg], cut at the poles and at a full turn."""
        check_number(0, margin_deg=margin_deg)
        (south, north), (west, east) = self.latitude, self.longitude
        west -= min(margin_deg, (360 - (east - west)) / 2)
        east = min(east + margin_deg, west + 360)
        return Region((max(south - margin_deg, -90), min(north + margin_deg, 90)), (west, east))

    def reachable(self, max_move_km: float) -> Region:
        """Return every place that one move from inside the box can lead to, rounded up to half a degree.

        Raises:
            ValueError: for a move that is negative or not finite.

        Example:
            >>> Region((-10, 0), (160, 170)).reachable(50)
            Region(latitude=(-10.5, 0.5), longitude=(159.5, 170.5))
        """
        check_number(0, max_move_km=max_move_km)
        reach = math.radians(max_move_km / _SHORTEST_DEGREE_KM)
        nearest_pole = math.radians(90 - max(abs(x) for x in self.latitude))
        # The farthest that a great circle of this length leads from its meridian; past a pole it leads anywhere.
        aside = math.degrees(math.asin(math.sin(reach) / math.sin(nearest_pole))) if reach < nearest_pole else 180.0
        south_north, west_east = (math.ceil(2 * x) / 2 for x in (math.degrees(reach), aside))
        return Region(self.expanded(south_north).latitude, self.expanded(west_east).longitude)

    def grid(self, points: int) -> Tensor:
        """Return an even grid of positions, edges included: ``(points, points, 2)`` latitude, longitude [deg]."""
        check_number(1, whole=True, points=points)
        latitude = torch.linspace(*self.latitude, points, dtype=torch.float64)
        longitude = torch.linspace(*self.longitude, points, dtype=torch.float64)
        return torch.stack(torch.meshgrid(latitude, longitude, indexing="ij"), -1)

    def unwrapped(self, position: Tensor) -> Tensor:
        """Return positions with longitudes near the middle of the box, so that no path breaks at the antimeridian.

        Args:
            position: ``(..., 2)`` latitude, longitude [deg].

        Returns:
            ``(..., 2)``, longitudes within half a turn of the middle of the box.

        Example:
            >>> Region((-10, 0), (170, 190)).unwrapped(torch.tensor([-5.0, -175.0]))
            tensor([ -5., 185.])
        """
        check_tensor(2, position=position)
        middle = sum(self.longitude) / 2
        latitude, longitude = position.unbind(-1)
        return torch.stack((latitude, middle + wrap_longitude(longitude - middle)), -1)

    def holding(self, position: Tensor) -> Region:
        """Return the box, grown to contain some positions.

        Args:
            position: ``(..., 2)`` latitude, longitude [deg], unwrapped.

        Raises:
            ValueError: for an empty tensor, or a non-finite position.

        Example:
            >>> Region((-10, 0), (160, 170)).holding(torch.tensor([[-12.0, 165.0]]))
            Region(latitude=(-12.0, 0.0), longitude=(160.0, 170.0))
        """
        check_tensor(2, position=position)
        if not position.numel() or not position.isfinite().all():
            raise ValueError(f"position must hold finite numbers, got {position!r}")
        low, high = (end(position.reshape(-1, 2), 0).tolist() for end in (torch.amin, torch.amax))
        (south, north), (west, east) = self.latitude, self.longitude
        return Region((min(south, low[0]), max(north, high[0])), (min(west, low[1]), max(east, high[1])))

    def longest_km(self) -> float:
        """Return an upper bound of the distances in the box [km], tight for boxes up to a quarter of the globe."""
        return _longest_km(self)


@cache
def _longest_km(region: Region) -> float:
    return float(
        longest_km(*(torch.tensor([edges], dtype=torch.float64) for edges in (region.latitude, region.longitude)))
    )


def longest_km(latitude: Tensor, longitude: Tensor) -> Tensor:
    """Return an upper bound of the distances in boxes, tight for boxes up to a quarter of the globe.

    Args:
        latitude: ``(K, 2)`` southern and northern edges [deg].
        longitude: ``(K, 2)`` western and eastern edges [deg].

    Returns:
        ``(K,)`` [km].

    Example:
        >>> longest_km(torch.tensor([[-10.0, 0.0]]).double(), torch.tensor([[160.0, 170.0]]).double()).round()
        tensor([1565.], dtype=torch.float64)
    """
    (south, north), (west, east) = latitude.T, longitude.T
    starts = torch.stack((south, torch.zeros_like(south).clamp(south, north), north))
    distance = geodesic(starts.unsqueeze(1), west, starts, east)[0].amax((0, 1))
    beyond = ((longitude.diff() > 90) | (latitude.diff() > 90)).squeeze(-1)
    return distance.masked_fill(beyond, math.pi * MEAN_RADIUS_KM)


def in_box(
    position: Tensor, latitude: tuple[float | Tensor, float | Tensor], longitude: tuple[float | Tensor, float | Tensor]
) -> Tensor:
    """Return whether positions lie in a box, or each in a box of its own.

    Args:
        position: ``(..., 2)`` latitude, longitude [deg].
        latitude: southern and northern edge [deg], numbers or ``(...)``.
        longitude: western and eastern edge [deg], numbers or ``(...)``.

    Returns:
        ``(..., 1)`` bool, edges included; False for NaN.

    Example:
        >>> in_box(torch.tensor([[0.0, -175.0], [0.0, 165.0]]), (-5, 5), (170, 190))
        tensor([[ True],
                [False]])
    """
    check_tensor(2, position=position)
    north, east = position.unbind(-1)
    half = (longitude[1] - longitude[0]) / 2
    offset = wrap_longitude(east - (longitude[0] + half))
    half = half + 1e-9  # a tenth of a millimeter: the center is rounded, and the edges belong to the box
    return ((north >= latitude[0]) & (north <= latitude[1]) & (offset.abs() <= half)).unsqueeze(-1)


PAPER_REGION = Region(paper.LATITUDE, paper.LONGITUDE)
"""The paper's box: 10 S to 0, 160 E to 170 E, north-east of Australia."""
