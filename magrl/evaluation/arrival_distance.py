"""Distance from a start to the nearest place that counts as an arrival by the objective."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from magrl.checks import check_tensor
from magrl.envs.arrival import check_zeta
from magrl.envs.regions import Regions
from magrl.field import elements_at, elements_gradient_at
from magrl.geodesy import geodesic, move
from magrl.guidance import objective


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
