"""Latitude-longitude boxes on the WGS84 ellipsoid: one box as a value, and a batch of boxes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from magrl import paper
from magrl.checks import check_number
from magrl.field.bank import FieldBank, check_index, checked_boxes
from magrl.field.model import Float64Module
from magrl.geodesy import MEAN_RADIUS_KM, check_box, geodesic, wrap_longitude

_SHORTEST_DEGREE_KM = 110.5  # a degree of arc is nowhere shorter on the ellipsoid


@dataclass(frozen=True)
class Region:
    """One latitude-longitude box, as a value; :class:`Regions` computes with boxes.

    Args:
        latitude: southern and northern edge [deg].
        longitude: western and eastern edge [deg], rising; (170, 190) crosses the antimeridian.

    Raises:
        ValueError: for an empty, reversed or impossible box.

    Example:
        >>> Region((-10, 0), (160, 170))
        Region(latitude=(-10.0, 0.0), longitude=(160.0, 170.0))
    """

    latitude: tuple[float, float]
    longitude: tuple[float, float]

    def __post_init__(self) -> None:
        check_box(self.latitude, self.longitude)
        object.__setattr__(self, "latitude", tuple(float(x) for x in self.latitude))
        object.__setattr__(self, "longitude", tuple(float(x) for x in self.longitude))

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
        middle = sum(self.longitude) / 2
        latitude, longitude = position.unbind(-1)
        return torch.stack((latitude, middle + wrap_longitude(longitude - middle)), -1)

    def holding(self, position: Tensor) -> Region:
        """Return the box, grown to contain some positions.

        Args:
            position: ``(..., 2)`` latitude, longitude [deg], unwrapped.

        Raises:
            ValueError: for a non-finite position.

        Example:
            >>> Region((-10, 0), (160, 170)).holding(torch.tensor([[-12.0, 165.0]]))
            Region(latitude=(-12.0, 0.0), longitude=(160.0, 170.0))
        """
        low, high = (end(position.reshape(-1, 2), 0).tolist() for end in (torch.amin, torch.amax))
        (south, north), (west, east) = self.latitude, self.longitude
        return Region((min(south, low[0]), max(north, high[0])), (min(west, low[1]), max(east, high[1])))


PAPER_REGION = Region(paper.LATITUDE, paper.LONGITUDE)
"""The paper's box: 10 S to 0, 160 E to 170 E, north-east of Australia."""


class Regions(Float64Module):
    """K latitude-longitude boxes, K >= 1; each vehicle is in the box that its index names.

    Args:
        latitude: ``(K, 2)`` southern and northern edges [deg], within [-90, 90].
        longitude: ``(K, 2)`` western and eastern edges [deg], rising; (170, 190) crosses the antimeridian.

    Raises:
        TypeError: for edges that are not real tensors.
        ValueError: for another shape, no box, or an empty or reversed one, with its number and its edges.

    Example:
        >>> regions = Regions(torch.tensor([[-10.0, 0.0], [40.0, 50.0]]), torch.tensor([[160.0, 170.0], [0.0, 10.0]]))
        >>> len(regions), regions[1]
        (2, Region(latitude=(40.0, 50.0), longitude=(0.0, 10.0)))
    """

    latitude: Tensor
    longitude: Tensor
    _longest_km: Tensor | None

    def __init__(self, latitude: Tensor, longitude: Tensor) -> None:
        super().__init__()
        latitude, longitude = checked_boxes(latitude, longitude)
        self.register_buffer("latitude", latitude, persistent=False)
        self.register_buffer("longitude", longitude, persistent=False)
        self.register_buffer("_longest_km", None, persistent=False)

    @classmethod
    def of(cls, boxes: Region | Regions | Iterable[Region]) -> Regions:
        """Return boxes as a batch: of one region, of several, or a batch itself.

        Raises:
            ValueError: for no region.

        Example:
            >>> Regions.of(Region((-10, 0), (160, 170)))
            Regions(Region(latitude=(-10.0, 0.0), longitude=(160.0, 170.0)))
        """
        if isinstance(boxes, Regions):
            return boxes
        boxes = [boxes] if isinstance(boxes, Region) else boxes
        edges = torch.tensor([(*box.latitude, *box.longitude) for box in boxes], dtype=torch.float64).reshape(-1, 4)
        return cls(edges[:, :2], edges[:, 2:])

    @property
    def longest_km(self) -> Tensor:
        """Upper bound of the distances in each box, ``(K,)`` [km], tight for boxes up to a quarter of the globe."""
        if self._longest_km is None:
            self._longest_km = _longest_km(self.latitude, self.longitude)
        return self._longest_km

    def __len__(self) -> int:
        """Return the number of regions."""
        return len(self.latitude)

    def __getitem__(self, index: int) -> Region:
        """Return one region."""
        (south, north), (west, east) = self.latitude[index].tolist(), self.longitude[index].tolist()
        return Region((south, north), (west, east))

    def __iter__(self) -> Iterator[Region]:
        """Return the regions one by one."""
        return (self[index] for index in range(len(self)))

    def __eq__(self, other: object) -> bool:
        """Return whether all boxes are the same."""
        return isinstance(other, Regions) and list(self) == list(other)

    __hash__ = Float64Module.__hash__

    def __repr__(self) -> str:
        """Return the first region as text, and the number of the others."""
        return f"Regions({self[0]}{f', and {len(self) - 1} more' if len(self) > 1 else ''})"

    def contains(self, position: Tensor, index: Tensor | int = 0) -> Tensor:
        """Return whether positions lie in the box of their index.

        Args:
            position: ``(..., 2)`` latitude, longitude [deg].
            index: ``(...)`` int64, the box of each position, broadcast; or one number for all of them.

        Returns:
            ``(..., 1)`` bool, edges included; False for NaN.

        Raises:
            TypeError: for an index that is not int64.
            ValueError: for an index outside [0, K), or positions of another shape.

        Example:
            >>> regions = Regions.of([Region((-10, 0), (160, 170)), Region((40, 50), (0, 10))])
            >>> regions.contains(torch.tensor([45.0, 5.0]).expand(2, 2), torch.tensor([0, 1]))
            tensor([[False],
                    [ True]])
        """
        check_index(torch.as_tensor(index), len(self))
        (south, north), (west, east) = self.latitude[index].unbind(-1), self.longitude[index].unbind(-1)
        latitude, longitude = position.unbind(-1)
        half = (east - west) / 2
        offset = wrap_longitude(longitude - (west + half))
        half = half + 1e-9  # a tenth of a millimeter: the center is rounded, and the edges belong to the box
        return ((latitude >= south) & (latitude <= north) & (offset.abs() <= half)).unsqueeze(-1)

    def expanded(self, margin_deg: float) -> Regions:
        """Return the boxes with a margin on each side [deg], cut at the poles and at a full turn.

        Example:
            >>> Regions.of(Region((-10, 0), (160, 170))).expanded(5)
            Regions(Region(latitude=(-15.0, 5.0), longitude=(155.0, 175.0)))
        """
        check_number(0, margin_deg=margin_deg)
        margin = torch.full_like(self.latitude[:, 0], margin_deg)
        return self._grown(margin, margin)

    def reachable(self, max_leg_km: float) -> Regions:
        """Return every place that one leg from inside its box can lead to, rounded up to half a degree.

        Raises:
            ValueError: for a leg that is negative or not finite.

        Example:
            >>> Regions.of(Region((-10, 0), (160, 170))).reachable(50)
            Regions(Region(latitude=(-10.5, 0.5), longitude=(159.5, 170.5)))
        """
        check_number(0, max_leg_km=max_leg_km)
        reach = torch.full_like(self.latitude[:, 0], math.radians(max_leg_km / _SHORTEST_DEGREE_KM))
        nearest_pole = torch.deg2rad(90 - self.latitude.abs().amax(-1))
        # The farthest that a great circle of this length leads from its meridian; past a pole it leads anywhere.
        aside = torch.asin(torch.sin(reach) / torch.sin(nearest_pole)).where(reach < nearest_pole, math.pi)
        return self._grown(*(torch.ceil(2 * torch.rad2deg(x)) / 2 for x in (reach, aside)))

    def _grown(self, north_south: Tensor, east_west: Tensor) -> Regions:
        """Return the boxes with margins ``(K,)`` [deg], cut at the poles and at a full turn."""
        (south, north), (west, east) = self.latitude.T, self.longitude.T
        latitude = torch.stack(((south - north_south).clamp_min(-90), (north + north_south).clamp_max(90)), -1)
        west = west - east_west.minimum((360 - (east - west)) / 2)
        return Regions(latitude, torch.stack((west, (east + east_west).minimum(west + 360)), -1))

    def grid(self, points: int) -> Tensor:
        """Return an even grid of positions in each box, edges included: ``(K, points, points, 2)`` [deg]."""
        check_number(1, whole=True, points=points)
        unit = torch.linspace(0, 1, points, dtype=torch.float64, device=self.latitude.device)
        (south, north), (west, east) = self.latitude.unsqueeze(-1).unbind(1), self.longitude.unsqueeze(-1).unbind(1)
        rows, columns = torch.lerp(south, north, unit).unsqueeze(2), torch.lerp(west, east, unit).unsqueeze(1)
        return torch.stack(torch.broadcast_tensors(rows, columns), -1)


def one_region(region: Region | Regions) -> Region:
    """Return the only region of a scenario, for uses that support one region, such as a map.

    Raises:
        ValueError: for several regions.

    Example:
        >>> one_region(Regions.of(PAPER_REGION))
        Region(latitude=(-10.0, 0.0), longitude=(160.0, 170.0))
    """
    regions = Regions.of(region)
    if len(regions) > 1:
        raise ValueError(
            f"this is made for one region, got {len(regions)}: take one of them, as region[0], or one vehicle"
        )
    return regions[0]


def check_expansions(field: object, regions: Regions) -> None:
    """Raise unless a bank has an expansion for each region, and a single field model one region.

    Raises:
        ValueError: with both numbers.

    Example:
        >>> check_expansions(None, Regions.of([PAPER_REGION, PAPER_REGION]))
        Traceback (most recent call last):
        ValueError: region holds 2 boxes, and field 1 expansions: give several regions a FieldBank with one for each, \
and a single Region a field model or None
    """
    expansions = len(field) if isinstance(field, FieldBank) else 1
    if len(regions) != expansions:
        raise ValueError(
            f"region holds {len(regions)} boxes, and field {expansions} expansions: give several regions a FieldBank "
            "with one for each, and a single Region a field model or None"
        )


def _longest_km(latitude: Tensor, longitude: Tensor) -> Tensor:
    """Return upper bounds of the distances in boxes ``(K, 2)``: ``(K,)`` [km]."""
    (south, north), (west, east) = latitude.T, longitude.T
    starts = torch.stack((south, torch.zeros_like(south).clamp(south, north), north))
    distance = geodesic(starts.unsqueeze(1), west, starts, east)[0].amax((0, 1))
    beyond = ((longitude.diff() > 90) | (latitude.diff() > 90)).squeeze(-1)
    return distance.masked_fill(beyond, math.pi * MEAN_RADIUS_KM)
