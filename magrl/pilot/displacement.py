"""The displacement to the destination: a normal distribution of the displacement, or weighted points."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from magrl.geodesy import geodesic

_AT_ONCE = 13  # legs whose distances to all points are held at once
_CANDIDATES = 16  # points among which that with most mass around it is chosen
ELSEWHERE_KM = 10_000.0  # distance of a destination that is not within reach, half of the farthest


class Displacement(NamedTuple):
    """Displacement ``(..., 2)`` northward and eastward [km] and its covariance ``(..., 2, 2)`` [km^2].

    Example:
        >>> Displacement(torch.zeros(2), torch.eye(2)).mean
        tensor([0., 0.])
    """

    mean: Tensor
    covariance: Tensor

    def axes(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return the standard deviations [km] along the long axis of the ellipse and across it, and the direction of
        the long axis [deg, clockwise from north, 0 to 180], each ``(...)``.

        Where two elements do not determine a place, the displacement is known across a line, and not along it.

        Example:
            >>> Displacement(torch.zeros(2), torch.tensor([[100.0, 0.0], [0.0, 900.0]])).axes()
            (tensor(30.), tensor(10.), tensor(90.))
        """
        (nn, ne), (_, ee) = (row.unbind(-1) for row in self.covariance.unbind(-2))
        middle, half = (nn + ee) / 2, torch.hypot((nn - ee) / 2, ne)
        bearing = torch.rad2deg(torch.atan2(2 * ne, nn - ee)) / 2
        return (middle + half).sqrt(), (middle - half).clamp_min(0).sqrt(), bearing.remainder(180)

    def ellipse(self) -> str:
        """Return the axes of one displacement as text.

        Example:
            >>> Displacement(torch.zeros(2), torch.tensor([[100.0, 0.0], [0.0, 900.0]])).ellipse()
            '± 10 km across, ± 30 km along 090°'
        """
        along, across, bearing = (axis.item() for axis in self.axes())
        return f"± {across:.0f} km across, ± {along:.0f} km along {bearing:03.0f}°"


class DestinationPosterior(NamedTuple):
    """Displacements ``(..., M, 2)`` northward and eastward [km], their probabilities ``(..., M)``, and the probability
    ``(...)`` that the destination is within the reach of the points at all; a number for all by default.

    Example:
        >>> posterior = DestinationPosterior(torch.tensor([[0.0, 10.0], [0.0, 30.0]]), torch.tensor([0.25, 0.75]))
        >>> posterior.displacement().mean, posterior.within(25.0)
        (tensor([ 0., 25.]), tensor(0.2500))
    """

    points: Tensor
    weights: Tensor
    reached: Tensor | float = 1.0

    def displacement(self) -> Displacement:
        """Return the mean and the covariance; with what is not within reach, at thousands of kilometers, around it."""
        mean = (self.points * self.weights.unsqueeze(-1)).sum(-2)
        apart = self.points - mean.unsqueeze(-2)
        covariance = (apart * self.weights.unsqueeze(-1)).mT @ apart
        reached = torch.as_tensor(self.reached).to(covariance)[..., None, None]
        return Displacement(mean, reached * covariance + (1 - reached) * ELSEWHERE_KM**2 * torch.eye(2).to(covariance))

    def aim(self, radius_km: float) -> Tensor:
        """Return the displacement to aim at ``(..., 2)`` [km]: the mean, or, where that is within a radius of the
        vehicle, the point that holds most probability within the radius.

        Between two maxima the mean may be where the vehicle is, and no leg makes progress.

        Example:
            >>> points = torch.tensor([[0.0, 40.0], [0.0, -40.0], [0.0, -42.0]])
            >>> DestinationPosterior(points, torch.tensor([0.5, 0.25, 0.25])).aim(25.0)
            tensor([ 0., 40.])
        """
        mean = (self.points * self.weights.unsqueeze(-1)).sum(-2)
        likely = self.weights.topk(min(_CANDIDATES, self.weights.shape[-1]), -1).indices
        centers = self.points.gather(-2, likely.unsqueeze(-1).expand(*likely.shape, 2))
        mass = ((self._squares(centers) <= radius_km**2).to(self.weights) @ self.weights.unsqueeze(-1)).squeeze(-1)
        best = mass.argmax(-1, keepdim=True).unsqueeze(-1)
        center = centers.gather(-2, best.expand(*best.shape[:-1], 2)).squeeze(-2)
        return torch.where(mean.norm(dim=-1, keepdim=True) > radius_km, mean, center)

    def mean_distance(self, legs: Tensor) -> Tensor:
        """Return the mean distances ``(..., K)`` [km] of the place after legs ``(..., K, 2)`` [km], as float32.

        Example:
            >>> posterior = DestinationPosterior(torch.tensor([[30.0, 0.0], [0.0, 40.0]]), torch.tensor([0.5, 0.5]))
            >>> posterior.mean_distance(torch.tensor([[0.0, 0.0], [30.0, 0.0]])).round()
            tensor([35., 25.])
        """
        weights = self.weights.float().unsqueeze(-1)
        parts = [(self._squares(some).sqrt_() @ weights).squeeze(-1) for some in legs.split(_AT_ONCE, -2)]
        return torch.cat(parts, -1)

    def _squares(self, legs: Tensor) -> Tensor:
        """Return the squared distances ``(..., K, M)`` of the points after legs, as one matrix product [km^2]."""
        points, legs = self.points.float(), legs.float()
        # 0.01 km^2 is for the rounding
        left = torch.cat((legs, legs.square().sum(-1, keepdim=True) + 0.01, torch.ones_like(legs[..., :1])), -1)
        right = torch.cat((-2 * points, torch.ones_like(points[..., :1]), points.square().sum(-1, keepdim=True)), -1)
        return left @ right.mT

    def within(self, radius_km: float) -> Tensor:
        """Return the probability ``(...)`` that the place is within a radius [km] of the vehicle."""
        return (self.weights * (self.points.norm(dim=-1) <= radius_km)).sum(-1) * self.reached

    def radius(self, probability: float) -> Tensor:
        """Return the least radius ``(...)`` [km] around the vehicle that holds the place with a probability.

        Where the points do not reach so far, it is half of the Earth's circumference.

        Example:
            >>> points = torch.tensor([[0.0, 30.0], [0.0, 10.0]])
            >>> DestinationPosterior(points, torch.tensor([0.25, 0.75])).radius(0.7)
            tensor(10.)
        """
        distance, order = self.points.norm(dim=-1).sort(-1)
        wanted = probability / torch.as_tensor(self.reached).to(distance).unsqueeze(-1)
        held = self.weights.gather(-1, order).cumsum(-1)
        first = (held < wanted).sum(-1, keepdim=True).clamp_max(held.shape[-1] - 1)
        return torch.where(wanted > 1, ELSEWHERE_KM, distance.gather(-1, first)).squeeze(-1)


def displacement_between(start: Tensor, end: Tensor) -> Tensor:
    """Return the displacement ``(..., 2)`` northward and eastward [km] along the geodesic between places ``(..., 2)``,
    latitude and longitude [deg], in float64.

    Example:
        >>> displacement_between(torch.tensor([0.0, 160.0]), torch.tensor([0.0, 161.0])).round()
        tensor([  0., 111.], dtype=torch.float64)
    """
    distance, bearing = geodesic(*start.double().unbind(-1), *end.to(start.device).double().unbind(-1))
    return distance.unsqueeze(-1) * torch.stack((torch.cos(bearing), torch.sin(bearing)), -1)
