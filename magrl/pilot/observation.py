"""What an agent observes that navigates by the estimates of its own track."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from magrl.sensor_std import OUTAGE_STD

OBSERVATION_SIZE = 19
"""Numbers of :func:`track_observation`."""
_STD_UNITS = (1.0, 1.0, 100.0)
_LEAST_STD = 0.002
_LEAST_PRICE = 0.01


_NOISE = math.log(_LEAST_STD) / 2 + 1.99, math.log(OUTAGE_STD) / 2 + 2.01  # with room for rounding
_OPEN = math.inf
TRACK_BOUNDS = (
    (*(-_OPEN,) * 2, -2.0, -0.5, *(-_OPEN,) * 6, -2.04, 0.0, *(_NOISE[0],) * 3, *(-_OPEN,) * 2, -1.0, -_OPEN),
    (*(_OPEN,) * 3, 5.75, *(_OPEN,) * 7, 1.0, *(_NOISE[1],) * 3, *(_OPEN,) * 4),
)
"""Lowest and highest values of :func:`track_observation`."""


def track_observation(
    *,
    aim: Tensor,
    plan: Tensor,
    covariance: Tensor,
    gradient: Tensor,
    remaining: Tensor,
    weights: Tensor,
    std: Tensor,
    time: Tensor,
    price: Tensor,
) -> Tensor:
    """Return the observation of an agent that navigates by the estimates of its own track.

    All vectors are in the vehicle's frame, so that a policy generalizes over headings. Lengths are logarithms, because
    the best leg depends on their ratios.

    Args:
        aim: ``(..., 2)`` displacement to aim at, forward and to the right [km].
        plan: ``(..., 2)`` planned displacement, forward and to the right [km].
        covariance: ``(..., 2, 2)`` of the estimated displacement to the destination [km^2].
        gradient: ``(..., E, 2)`` estimated, forward and to the right [element unit / km].
        remaining: ``(..., E)`` target elements minus estimated ones.
        weights: ``(..., E)`` of the objective F (Eq. (6)), divided by the arrival threshold.
        std: ``(..., E)`` standard deviation of the noise of D [deg], I [deg], B_H [nT].
        time: ``(..., 1)`` share of the step limit that is over.
        price: ``(..., 1)`` price of a step [% of SPL].

    Returns:
        ``(..., 19)``: direction (2) and length (2) of the displacement; logarithms of its standard deviations (2) and
        their correlation; the same three of the arrival ellipse by the estimated gradient; logarithm of F over the
        threshold; time; logarithms of the noise (3); direction (2) and logarithm of the length of the plan; logarithm
        of the price.

    Example:
        >>> three, one = torch.ones(3), torch.ones(1)
        >>> seen = {"aim": torch.tensor([30.0, 40.0]), "plan": torch.ones(2), "covariance": torch.eye(2)}
        >>> seen |= {"gradient": torch.ones(3, 2), "remaining": three, "weights": three, "std": three}
        >>> track_observation(**seen, time=one, price=one)[:2]
        tensor([0.6000, 0.8000])
    """
    length = aim.norm(dim=-1, keepdim=True)
    ellipse = (weights[..., None, None] * gradient.unsqueeze(-1) * gradient.unsqueeze(-2)).sum(-3)
    objective = (weights * remaining.square()).sum(-1, keepdim=True)
    units = torch.tensor(_STD_UNITS, dtype=aim.dtype, device=aim.device)
    spread, correlation = _axes(covariance, least=1e-6)
    axes, axes_correlation = _axes(ellipse, least=1e-12)
    planned_km = plan.norm(dim=-1, keepdim=True)
    return torch.cat(
        (
            aim / length.clamp_min(1e-3),
            torch.log1p(length / 20) - 2,
            length.clamp(max=2500) / 400 - 0.5,
            torch.log(spread / 20) / 2,
            correlation,
            torch.log(axes * 20) / 2,
            axes_correlation,
            torch.log(objective + 1e-2) / 3 - 0.5,
            time,
            torch.log((std / units).clamp(_LEAST_STD, OUTAGE_STD)) / 2 + 2,  # infinite for D without true north
            plan / planned_km.clamp_min(1e-3),
            torch.log1p(planned_km / 20) - 1,
            torch.log(price.clamp_min(_LEAST_PRICE) * 10) / 2,
        ),
        -1,
    )


def _axes(matrix: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Return the roots of the diagonal ``(..., 2)`` and the correlation ``(..., 1)`` of symmetric matrices."""
    roots = matrix.diagonal(dim1=-2, dim2=-1).clamp_min(least).sqrt()
    return roots, (matrix[..., 0, 1] / roots.prod(-1)).unsqueeze(-1)


def turned(vectors: Tensor, heading: Tensor) -> Tensor:
    """Return vectors ``(..., K, 2)`` northward and eastward as forward and to the right of a heading ``(..., 1)``.

    Example:
        >>> turned(torch.tensor([[0.0, 1.0]]), torch.tensor([0.0]))
        tensor([[0., 1.]])
    """
    (north, east), cos, sin = vectors.unbind(-1), torch.cos(heading), torch.sin(heading)
    return torch.stack((cos * north + sin * east, cos * east - sin * north), -1)
