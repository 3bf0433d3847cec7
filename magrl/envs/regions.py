"""Many latitude-longitude boxes, indexed: the regions of a scenario over a bank of fields."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from torch import Tensor
from typing_extensions import Self

from magrl.checks import check_number
from magrl.envs.region import Region, in_box, longest_km
from magrl.field.bank import check_index, checked_boxes
from magrl.field.model import Float64Module


class Regions(Float64Module):
    """K latitude-longitude boxes; each vehicle is in the box that its index names.

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
    longest_km: Tensor
    """Upper bound of the distances in each box, ``(K,)`` [km], see :meth:`Region.longest_km`."""

    def __init__(self, latitude: Tensor, longitude: Tensor) -> None:
        super().__init__()
        latitude, longitude = checked_boxes(latitude, longitude)
        self.register_buffer("latitude", latitude, persistent=False)
        self.register_buffer("longitude", longitude, persistent=False)
        self.register_buffer("longest_km", longest_km(latitude, longitude), persistent=False)

    @classmethod
    def of(cls, boxes: Iterable[Region]) -> Self:
        """Return the boxes of some regions.

        Raises:
            ValueError: for no region.

        Example:
            >>> Regions.of([Region((-10, 0), (160, 170))]).longitude
            tensor([[160., 170.]], dtype=torch.float64)
        """
        edges = torch.tensor([(*box.latitude, *box.longitude) for box in boxes], dtype=torch.float64).reshape(-1, 4)
        return cls(edges[:, :2], edges[:, 2:])

    def __len__(self) -> int:
        """Return the number of regions."""
        return len(self.latitude)

    def __getitem__(self, index: int) -> Region:
        """Return one region."""
        (south, north), (west, east) = self.latitude[index].tolist(), self.longitude[index].tolist()
        return Region((south, north), (west, east))

    def contains(self, position: Tensor, index: Tensor) -> Tensor:
        """Return whether positions lie in the box of their index.

        Args:
            position: ``(..., 2)`` latitude, longitude [deg].
            index: ``(...)`` int64, the box of each position; broadcast.

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
        check_index(index, len(self))
        (south, north), (west, east) = self.latitude[index].unbind(-1), self.longitude[index].unbind(-1)
        return in_box(position, (south, north), (west, east))

    def expanded(self, margin_deg: float) -> Regions:
        """Return the boxes with a margin on each side [deg], see :meth:`Region.expanded`."""
        return self._each(lambda box: box.expanded(margin_deg))

    def reachable(self, max_move_km: float) -> Regions:
        """Return every place that one move from inside its box can lead to, see :meth:`Region.reachable`."""
        return self._each(lambda box: box.reachable(max_move_km))

    def grid(self, points: int) -> Tensor:
        """Return an even grid of positions in each box, edges included: ``(K, points, points, 2)`` [deg]."""
        check_number(2, whole=True, points=points)
        unit = torch.linspace(0, 1, points, dtype=torch.float64, device=self.latitude.device)
        (south, north), (west, east) = self.latitude.unsqueeze(-1).unbind(1), self.longitude.unsqueeze(-1).unbind(1)
        rows, columns = torch.lerp(south, north, unit).unsqueeze(2), torch.lerp(west, east, unit).unsqueeze(1)
        return torch.stack(torch.broadcast_tensors(rows, columns), -1)

    def extra_repr(self) -> str:
        """Return the number of regions as text."""
        return f"regions={len(self)}"

    def _each(self, change: Callable[[Region], Region]) -> Regions:
        return Regions.of(change(self[index]) for index in range(len(self))).to(self.latitude.device)
