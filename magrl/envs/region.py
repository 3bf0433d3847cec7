"""Latitude-longitude boxes on the WGS84 ellipsoid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from magrl import paper
from magrl.checks import check_number, check_numbers, check_tensor
from magrl.geodesy import check_box, geodesic, wrap_longitude

MEAN_RADIUS_KM = 6371.0


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
        check_tensor(2, position=position)
        latitude, longitude = position.unbind(-1)
        south, north = self.latitude
        half = (self.longitude[1] - self.longitude[0]) / 2
        offset = wrap_longitude(longitude - (self.longitude[0] + half))
        half += 1e-9  # a tenth of a millimeter: the center is rounded, and the edges belong to the box
        return ((latitude >= south) & (latitude <= north) & (offset.abs() <= half)).unsqueeze(-1)

    def expanded(self, margin_deg: float) -> Region:
        """Return the box with a margin on each side [deg], cut at the poles and at a full turn."""
        check_number(0, margin_deg=margin_deg)
        (south, north), (west, east) = self.latitude, self.longitude
        west -= min(margin_deg, (360 - (east - west)) / 2)
        east = min(east + margin_deg, west + 360)
        return Region((max(south - margin_deg, -90), min(north + margin_deg, 90)), (west, east))

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
    (south, north), (west, east) = region.latitude, region.longitude
    if east - west > 90 or north - south > 90:
        return math.pi * MEAN_RADIUS_KM
    latitude = torch.tensor((south, min(max(0.0, south), north), north), dtype=torch.float64)
    corners = torch.tensor((west, east), dtype=torch.float64)
    return float(geodesic(latitude.unsqueeze(-1), corners[0], latitude, corners[1])[0].max())


PAPER_REGION = Region(paper.LATITUDE, paper.LONGITUDE)
"""The paper's box: 10 S to 0, 160 E to 170 E, north-east of Australia."""
