"""The search for a destination: it is not where the vehicle has been without arriving."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from magrl import guidance
from magrl.pilot.displacement import Displacement
from magrl.pilot.local import cholesky2

VISITED = 24
"""Number of past places that a search remembers."""
SEARCH_KM = 500.0
"""Difference of distance that outweighs a factor e of probability [km]."""
_SOBOL = torch.quasirandom.SobolEngine(2).fast_forward(1)  # its first point is a corner, the second the center
_SAMPLES = math.sqrt(2) * torch.erfinv(2 * _SOBOL.draw(32, dtype=torch.float64) - 1)  # standard normal, the mean first
_UNNOTICED = 0.02  # probability of having been at the destination: visited places stay possible
_STAYED_KM = 1.0  # longest leg after which the vehicle is where it was
_FAR_KM = 1e5  # of places that are not there yet
_LEAST_KM2 = 1e-12
_LEAST_ELLIPSE = 1e-12  # [1/km^2]


def unvisited(displacement: Displacement, visited: Tensor, ellipse: Tensor) -> Tensor:
    """Return the displacement to the most probable destination, given where the vehicle did not arrive.

    The density of the destination is the density of the estimate, times the probability of not arriving at the nearest
    visited place: near 0 at that place, half on the border of the arrival ellipse around it, 1 far from it. The
    displacement is the best of 32 quasi-random samples of the estimate, one of which is its mean: the largest
    logarithm of the density minus the distance over :data:`SEARCH_KM`. Without visited places near it, it is the mean.

    Args:
        displacement: estimated displacement and its covariance.
        visited: ``(..., K, 2)`` displacements to the visited places, northward and eastward [km].
        ellipse: ``(..., 2, 2)`` arrival ellipse, where ``d^T E d = 1`` for displacements d [km].

    Returns:
        ``(..., 2)`` [km].

    Source:
        L. D. Stone, Theory of Optimal Search, Academic Press (1975): the posterior of a target after unsuccessful
        search.

    Example:
        >>> covariance = torch.diag(torch.tensor([1.0, 2500.0]))  # known northward, but not eastward
        >>> displacement = Displacement(torch.zeros(2), covariance)
        >>> ellipse = torch.eye(2) / 400  # 20 km around
        >>> unvisited(displacement, torch.full((1, 2), 1e5), ellipse)
        tensor([0., 0.])
        >>> bool(unvisited(displacement, torch.zeros(1, 2), ellipse)[1].abs() > 20)
        True
    """
    samples = _SAMPLES.to(displacement.mean)
    candidates = displacement.mean.unsqueeze(-2) + samples @ _root(displacement.covariance).mT
    axes = _root(ellipse, _LEAST_ELLIPSE)  # in these axes, the ellipse is a circle of radius 1
    (north, east), (seen_n, seen_e) = ((places @ axes).unbind(-1) for places in (candidates, visited))
    from_n, from_e = (
        north.unsqueeze(-1) - seen_n.unsqueeze(-2),
        east.unsqueeze(-1) - seen_e.unsqueeze(-2),
    )  # (..., S, K)
    nearest = (from_n.square() + from_e.square()).amin(-1)
    missed = torch.log1p((_UNNOTICED - 1) * torch.exp2(-nearest))
    score = missed - samples.square().sum(-1) / 2 - candidates.norm(dim=-1) / SEARCH_KM
    best = torch.where(nearest[..., 0] < 1, score.argmax(-1), 0)[..., None, None]
    return candidates.gather(-2, best.expand(*best.shape[:-1], 2)).squeeze(-2)


def unvisited_yet(like: Tensor) -> Tensor:
    """Return the visited places ``(..., K, 2)`` at the start of an episode, for vehicles ``(..., E)``: none.

    Example:
        >>> unvisited_yet(torch.zeros(5, 3)).shape
        torch.Size([5, 24, 2])
    """
    return like.new_full((*like.shape[:-1], VISITED, 2), _FAR_KM)


def visit(visited: Tensor, leg: Tensor) -> Tensor:
    """Return the visited places after a leg: all displacements change by the leg, and its end is the latest place.

    After a leg below 1 km, the end takes the place of the one before.

    Args:
        visited: ``(..., K, 2)`` displacements to the visited places before the leg [km].
        leg: ``(..., 2)`` northward and eastward [km].

    Example:
        >>> visit(torch.tensor([[1.0, 0.0], [2.0, 0.0]]), torch.tensor([0.0, 3.0]))
        tensor([[ 0.,  0.],
                [ 1., -3.]])
    """
    stayed = (leg.norm(dim=-1) < _STAYED_KM)[..., None, None]
    before = torch.where(stayed, visited[..., 1:, :], visited[..., :-1, :]) - leg.unsqueeze(-2)
    return torch.cat((torch.zeros_like(leg).unsqueeze(-2), before), -2)


def arrival_weights(field: Tensor, target_field: Tensor, zeta: float) -> Tensor:
    """Return the weights of the objective F (Eq. (6)) over its threshold: their sum of squares is 1 at arrival.

    They have the paper's floors (:data:`magrl.guidance.OBJECTIVE_FLOORS`) in every region: a vehicle without a map does
    not know what the field of its region changes on the mean, from which the environment has its floors.

    Args:
        field: ``(..., 3)`` D [deg], I [deg], B_H [nT] where the episode starts.
        target_field: ``(..., 3)`` the same at the destination.
        zeta: arrival threshold on F.

    Returns:
        ``(..., 3)``, per squared unit.

    Example:
        >>> arrival_weights(torch.tensor([0.0, 60.0, 20000.0]), torch.tensor([2.0, 60.0, 20100.0]), 0.25)
        tensor([1.0000e+00, 2.5000e+01, 4.0000e-04])
    """
    return guidance.objective_weights(field, target_field, field.new_tensor(guidance.OBJECTIVE_FLOORS)) / zeta


def arrival_ellipse(gradient: Tensor, covariance: Tensor, weights: Tensor, radius_km: float | None = None) -> Tensor:
    """Return the matrix ``(..., 2, 2)`` [1/km^2] of the ellipse in which an episode ends: d^T E d = 1 on its border.

    Where the objective F ends it, it is the expected one: the less is known of the gradient, the smaller the ellipse.

    Args:
        gradient: ``(..., E, 2)`` expected gradient of each element, northward and eastward [per km].
        covariance: ``(..., E, 2, 2)`` its covariance.
        weights: ``(..., E)`` from :func:`arrival_weights`.
        radius_km: distance from the destination at which the episode ends [km]; None where the objective ends it.

    Example:
        >>> arrival_ellipse(torch.tensor([[0.02, 0.0]]), torch.zeros(1, 2, 2), torch.tensor([100.0]))
        tensor([[0.0400, 0.0000],
                [0.0000, 0.0000]])
    """
    squares = gradient.unsqueeze(-1) * gradient.unsqueeze(-2) + covariance
    if radius_km is not None:
        return (torch.eye(2) / radius_km**2).to(squares).expand(*squares.shape[:-3], 2, 2)
    return (weights[..., None, None] * squares).sum(-3)


def _root(matrix: Tensor, least: float = _LEAST_KM2) -> Tensor:
    """Return the Cholesky factor of matrices ``(..., 2, 2)``."""
    first, below, second = cholesky2(matrix, least)
    return torch.stack((first, torch.zeros_like(first), below, second), -1).unflatten(-1, (2, 2))
