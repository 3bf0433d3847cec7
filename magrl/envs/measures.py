"""Measures of a path, for Gymnasium's ``info`` and :mod:`magrl.evaluation`."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from magrl.geodesy import geodesic


def spl(success: Tensor, shortest_km: Tensor, length_km: Tensor) -> Tensor:
    """Return the success of each episode weighted by its path length.

    Args:
        success: ``(...)`` bool.
        shortest_km: ``(...)`` geodesic distance from start to destination [km].
        length_km: ``(...)`` length of the path, as commanded: through the water or the air, where there are currents
            [km].

    Returns:
        ``(...)`` in [0, 1]: 0 for a failure, 1 for a success on a path no longer than the shortest, also where both are
        0.

    Source:
        P. Anderson et al., On evaluation of embodied navigation agents, arXiv 1807.06757 (2018).

    Example:
        >>> spl(torch.tensor([True, True, False]), torch.full((3,), 400.0), torch.tensor([500.0, 390.0, 500.0]))
        tensor([0.8000, 1.0000, 0.0000])
    """
    longer_km = torch.maximum(length_km, shortest_km)
    return success * torch.where(longer_km == 0, 1.0, shortest_km / longer_km)


def path_efficiency(straight_km: Tensor, length_km: Tensor) -> Tensor:
    """Return how straight each path is: the distance from its start to its end over its length.

    Unlike :func:`spl` it does not depend on the destination: it is defined for failures, and an arrival set that is
    large in comparison with the distance hides no detour.

    Args:
        straight_km: ``(...)`` geodesic distance from the start to where the episode ended [km].
        length_km: ``(...)`` length of the path [km].

    Returns:
        ``(...)`` in [0, 1]; NaN where the path has no length.

    Example:
        >>> path_efficiency(torch.tensor([300.0, 0.0]), torch.tensor([400.0, 0.0]))
        tensor([0.7500,    nan])
    """
    efficiency = straight_km / torch.maximum(straight_km, length_km)  # legs are geodesics only within millimeters
    return torch.where(length_km == 0, math.nan, efficiency)


def path_measures(success: Tensor, start: Tensor, end: Tensor, target: Tensor, length_km: Tensor) -> dict[str, Tensor]:
    """Return the measures of episodes that depend only on how far they led and where they ended.

    Args:
        success: ``(...)`` bool.
        start: ``(..., 2)`` latitude, longitude [deg].
        end: ``(..., 2)`` last position [deg].
        target: ``(..., 2)`` destination [deg].
        length_km: ``(...)`` length of the path [km].

    Returns:
        Tensors ``(...)``: ``shortest_km``, the geodesic distance from start to destination; ``length_km``;
        ``navigation_error_km``, the distance left at the end; ``spl`` and ``path_efficiency`` in [0, 1].

    Example:
        >>> start, end = torch.tensor([[-2.0, 162.0]]).double(), torch.tensor([[-3.0, 162.0]]).double()
        >>> path = path_measures(torch.tensor([True]), start, end, end, torch.tensor([221.15]).double())
        >>> {name: round(value.item(), 2) for name, value in path.items()}
        {'shortest_km': 110.58, 'length_km': 221.15, 'navigation_error_km': 0.0, 'spl': 0.5, 'path_efficiency': 0.5}
    """
    shortest_km, _ = geodesic(*start.unbind(-1), *target.unbind(-1))
    error_km, _ = geodesic(*end.unbind(-1), *target.unbind(-1))
    straight_km, _ = geodesic(*start.unbind(-1), *end.unbind(-1))
    return {
        "shortest_km": shortest_km,
        "length_km": length_km,
        "navigation_error_km": error_km,
        "spl": spl(success, shortest_km, length_km),
        "path_efficiency": path_efficiency(straight_km, length_km),
    }
