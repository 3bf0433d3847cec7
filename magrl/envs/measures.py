"""Measures of an episode: its arrival threshold, and its path for Gymnasium and :mod:`magrl.evaluation`."""

from __future__ import annotations

import torch
from torch import Tensor

from magrl.checks import check_number, check_tensor, check_type
from magrl.geodesy import geodesic

MAX_OBJECTIVE = 3
"""Largest objective F at the start: each of the three elements adds at most 1 (Eq. 2-6)."""


def check_zeta(zeta: float) -> float:
    """Return an arrival threshold on the objective; raise unless it lies between 0 and the largest F at the start.

    Raises:
        ValueError: with the value and the reason.

    Example:
        >>> check_zeta(5)
        Traceback (most recent call last):
        ValueError: zeta must be below 3, got 5: the objective F is at most 3 at the start, so every vehicle has arrived
    """
    check_number(0, above=True, zeta=zeta)
    if zeta >= MAX_OBJECTIVE:
        known = f"the objective F is at most {MAX_OBJECTIVE} at the start, so every vehicle has arrived"
        raise ValueError(f"zeta must be below {MAX_OBJECTIVE}, got {zeta!r}: {known}")
    return zeta


def spl(success: Tensor, shortest_km: Tensor, length_km: Tensor) -> Tensor:
    """Return the success of each episode weighted by its path length.

    Args:
        success: ``(...)`` bool.
        shortest_km: ``(...)`` geodesic distance from start to destination [km].
        length_km: ``(...)`` length of the path [km].

    Returns:
        ``(...)`` in [0, 1]: 0 for a failure, 1 for a success on a path no longer than the shortest, also where both are
        0.

    Raises:
        TypeError: for ``success`` that is not a bool tensor, or lengths that are not real tensors.

    Source:
        P. Anderson et al., On evaluation of embodied navigation agents, arXiv 1807.06757 (2018).

    Example:
        >>> spl(torch.tensor([True, True, False]), torch.full((3,), 400.0), torch.tensor([500.0, 390.0, 500.0]))
        tensor([0.8000, 1.0000, 0.0000])
    """
    check_type(Tensor, success=success)
    check_tensor(shortest_km=shortest_km, length_km=length_km)
    if success.dtype != torch.bool:
        raise TypeError(f"success must be bool, got {success.dtype}")
    longer_km = torch.maximum(length_km, shortest_km)
    return success * torch.where(longer_km == 0, 1.0, shortest_km / longer_km)


def path_measures(success: Tensor, start: Tensor, end: Tensor, target: Tensor, length_km: Tensor) -> dict[str, Tensor]:
    """Return the measures of episodes that depend only on how far they led and where they ended.

    Args:
        success: ``(N,)`` bool.
        start: ``(N, 2)`` latitude, longitude [deg].
        end: ``(N, 2)`` last position [deg].
        target: ``(N, 2)`` destination [deg].
        length_km: ``(N,)`` length of the path [km].

    Returns:
        Tensors ``(N,)``: ``shortest_km``, the geodesic distance from start to destination; ``length_km``;
        ``navigation_error_km``, the distance left at the end; ``spl`` in [0, 1].

    Raises:
        ValueError: for positions of another shape.

    Example:
        >>> start, end = torch.tensor([[-2.0, 162.0]]).double(), torch.tensor([[-3.0, 162.0]]).double()
        >>> path = path_measures(torch.tensor([True]), start, end, end, torch.tensor([221.15]).double())
        >>> {name: round(value.item(), 2) for name, value in path.items()}
        {'shortest_km': 110.58, 'length_km': 221.15, 'navigation_error_km': 0.0, 'spl': 0.5}
    """
    check_tensor(2, start=start, end=end, target=target)
    shortest_km, _ = geodesic(*start.unbind(-1), *target.unbind(-1))
    error_km, _ = geodesic(*end.unbind(-1), *target.unbind(-1))
    return {
        "shortest_km": shortest_km,
        "length_km": length_km,
        "navigation_error_km": error_km,
        "spl": spl(success, shortest_km, length_km),
    }
