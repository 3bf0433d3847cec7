"""Measures of an episode: its arrival threshold, and its path for Gymnasium and :mod:`magrl.evaluation`."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from magrl.checks import check_number, check_tensor
from magrl.envs.regions import Regions
from magrl.field import elements_at, elements_gradient_at
from magrl.geodesy import geodesic, move
from magrl.guidance import objective

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
        reason = f"the objective F is at most {MAX_OBJECTIVE} at the start, so every vehicle has arrived"
        raise ValueError(f"zeta must be below {MAX_OBJECTIVE}, got {zeta!r}: {reason}")
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
        TypeError: for lengths that are not real tensors.

    Source:
        P. Anderson et al., On evaluation of embodied navigation agents, arXiv 1807.06757 (2018).

    Example:
        >>> spl(torch.tensor([True, True, False]), torch.full((3,), 400.0), torch.tensor([500.0, 390.0, 500.0]))
        tensor([0.8000, 1.0000, 0.0000])
    """
    check_tensor(shortest_km=shortest_km, length_km=length_km)
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
    check_tensor(straight_km=straight_km, length_km=length_km)
    efficiency = straight_km / torch.maximum(straight_km, length_km)  # moves are geodesics only within millimeters
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

    Raises:
        ValueError: for positions of another shape.

    Example:
        >>> start, end = torch.tensor([[-2.0, 162.0]]).double(), torch.tensor([[-3.0, 162.0]]).double()
        >>> path = path_measures(torch.tensor([True]), start, end, end, torch.tensor([221.15]).double())
        >>> {name: round(value.item(), 2) for name, value in path.items()}
        {'shortest_km': 110.58, 'length_km': 221.15, 'navigation_error_km': 0.0, 'spl': 0.5, 'path_efficiency': 0.5}
    """
    check_tensor(2, start=start, end=end, target=target)
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


def distance_to_arrival(
    start: Tensor, target: Tensor, weights: Tensor, field: Any, zeta: float, boxes: Regions, region: Tensor
) -> Tensor:
    """Return the distance from each start to the nearest place that counts as an arrival.

    The places around a destination where F is below ``zeta`` are nearly an ellipse, which the gradients at the
    destination give. On lines from the destination, even in angle on that ellipse, the edge is found by bisection of
    the true F; the lines around the nearest edge are then refined three times. Every edge point is inside, so that the
    result is never too short. Searches on fine grids find places up to 5 m nearer for ``zeta`` up to 0.1, and up to
    10 km nearer at 0.3, where the places extend over hundreds of kilometers and no longer form an ellipse.

    Args:
        start: ``(N, 2)`` latitude, longitude [deg].
        target: ``(N, 2)`` destination [deg].
        weights: ``(N, 3)`` of the objective, from :func:`magrl.guidance.objective_weights` at the start.
        field: field model, or a bank of them.
        zeta: arrival threshold on the objective.
        boxes: places where a vehicle is not lost, in each region.
        region: ``(N,)`` int64, the region of each task.

    Returns:
        ``(N,)`` [km]: 0 where the start itself is such a place, or is the destination.

    Raises:
        ValueError: for positions of another shape, or a threshold out of its range.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> state = env.reset()
        >>> start, target, weights = (state[key] for key in ("start_position", "target_position", "objective_weights"))
        >>> near_km = distance_to_arrival(start, target, weights, env.field, env.zeta, env.edge, state["region"][:, 0])
        >>> far_km, _ = geodesic(*start.unbind(-1), *target.unbind(-1))
        >>> (far_km - near_km).round()
        tensor([23., 32.], dtype=torch.float64)
    """
    check_tensor(2, start=start, target=target)
    check_tensor(3, weights=weights)
    arrival = _ArrivalSet(target, weights, field, check_zeta(zeta), boxes, region)
    farthest_km, _ = geodesic(*start.unbind(1), *target.unbind(1))
    ellipse = arrival.ellipse(farthest_km)
    best_km, best, width = farthest_km, torch.zeros_like(farthest_km), math.pi
    for lines in (32, 8, 8, 8):
        angle = best.unsqueeze(1) + width * torch.linspace(-1, 1, lines + 1).to(best)
        edge = arrival.edge(ellipse, angle)
        distance_km, _ = geodesic(*start.unsqueeze(1).unbind(2), *edge.unbind(2))
        best_km, index = distance_km.min(1)
        best, width = angle.gather(1, index.unsqueeze(1)).squeeze(1), width * 2 / lines
    return torch.where(arrival.holds(start.unsqueeze(1)).squeeze(1), 0.0, best_km)


class _ArrivalSet:
    """The places where the vehicles of ``N`` tasks have arrived."""

    def __init__(
        self, target: Tensor, weights: Tensor, field: Any, zeta: float, boxes: Regions, region: Tensor
    ) -> None:
        self.target, self.weights, self.field, self.zeta = target.double(), weights.double(), field, zeta
        self.boxes, self.region = boxes, region.unsqueeze(1)
        self.target_field = elements_at(field, self.target.unsqueeze(-2), self.region)

    def holds(self, position: Tensor) -> Tensor:
        """Return whether positions ``(N, K, 2)`` belong to the set: ``(N, K)``; False where there is no field."""
        values = elements_at(self.field, position, self.region)
        arrived = objective(values, self.target_field, self.weights.unsqueeze(-2)) < self.zeta
        return arrived.logical_and(self.boxes.contains(position, self.region)).squeeze(2)

    def ellipse(self, longest_km: Tensor) -> Tensor:
        """Return ``(N, 2, 2)`` [km]: maps the unit circle to the edge where the field is linear, north and east.

        Axes along which the field hardly changes are cut at ``longest_km``, ``(N,)``.
        """
        gradient = elements_gradient_at(self.field, self.target.unsqueeze(-2), self.region).squeeze(-3)
        curvature, axes = torch.linalg.eigh(gradient.mT @ (self.weights.unsqueeze(-1) * gradient))
        return axes * (self.zeta / curvature.clamp_min(1e-300)).sqrt().minimum(longest_km.unsqueeze(1)).unsqueeze(1)

    def edge(self, ellipse: Tensor, angle: Tensor, bisections: int = 18) -> Tensor:
        """Return the last places of the set on lines from the destinations, ``(N, K, 2)``, by angles ``(N, K)``."""
        circle = torch.stack((torch.cos(angle), torch.sin(angle)), -1)
        north, east = (circle @ ellipse.mT).unbind(-1)
        reach_km, bearing = torch.hypot(north, east), torch.atan2(east, north)
        latitude, longitude = self.target.unsqueeze(-2).unbind(-1)
        inside, step = torch.zeros_like(angle), 1.0
        for _ in range(bisections):  # of the first two lengths of the ellipse's radius
            place = torch.stack(move(latitude, longitude, bearing, (inside + step) * reach_km), -1)
            inside = torch.where(self.holds(place), inside + step, inside)
            step /= 2
        return torch.stack(move(latitude, longitude, bearing, inside * reach_km), -1)
