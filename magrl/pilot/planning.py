"""The next leg of a vehicle that navigates by its own readings, chosen for its progress and for what it will teach."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from magrl.pilot.destination import Destination
from magrl.pilot.displacement import DestinationPosterior
from magrl.pilot.forecast import covariance_after
from magrl.sensor_std import SensorStd

CAUTION = 0.3
"""Weight of the uncertainty after a reading; this and :data:`LENGTHS` are from scans on random planets."""
STEP_PRICE = 0.5
"""Default price of a step [% of SPL]."""
CHEAP_KM = 2.0
"""Price up to which a step is cheap [km]."""
RESERVE_KM = 5.0
"""Accuracy [km] of the mean of the readings for which steps are kept in reserve; this and :data:`RESERVE_SHARE` are
chosen on random planets."""
RESERVE_SHARE = 0.2
"""Largest share of the limit that is kept in reserve."""
MISSING_KM = 1000.0
"""Accuracy [km] of a reading beyond which it is a missing one, which says nothing about the sensors."""
NEAR_KM = 30.0
"""Distance at which the uncertainty along the displacement starts to matter beside that across it [km]."""
SLOPES = (0.004, 0.015, 4.0)
"""Typical gradient of D, I [deg/km], B_H [nT/km]: what a quasi-Newton navigator without a map expects, in size."""
LENGTHS = (0.1, 0.3, 0.6, 1.0)
"""Lengths of the legs that are compared, as fractions of the longest; the whole displacement, if it is shorter, is
another."""
SHORTEST = 1 / 40
"""The least length of a leg that is compared, as a share of the displacement."""
ANGLES_DEG = (-90, -60, -45, -30, -20, -10, 0, 10, 20, 30, 45, 60, 90)
"""Their directions, from the direction of the displacement [deg]."""
KEPT = 40
"""Number of the legs, with the least path and price, of which it is forecast what a reading teaches. On random
planets, all 65 do no better (docs/results/performance.md)."""
CORRECTION = 0.5
"""Unit of the corrections of a plan: of the logarithm of the length, and of the direction [rad]."""


def sensor_length(std: Tensor) -> Tensor:
    """Return the distance over which the elements typically change as much as the errors of a reading ``(...)`` [km].

    A position takes two elements, so that the second smallest distance of the three counts.

    Args:
        std: ``(..., 3)`` standard deviations of D [deg], I [deg], B_H [nT].

    Example:
        >>> sensor_length(torch.tensor([0.04, 0.03, 0.4]))
        tensor(2.)
    """
    return (std / std.new_tensor(SLOPES)).sort(-1).values[..., 1]


def step_price(
    percent: Tensor | float,
    range_km: float,
    displacement: Tensor,
    step: Tensor,
    sensor_std: Tensor | Sequence[float],
    max_steps: int,
    max_leg_km: float,
) -> Tensor:
    """Return the price of a step ``(...)`` [km]: it rises as the steps beyond the path's run out.

    The search at the end takes more readings where one is less accurate: as many steps are kept in reserve as readings
    whose mean is accurate to :data:`RESERVE_KM`, at most :data:`RESERVE_SHARE` of the limit. With a price p [km]
    while many are left, and r steps of the limit for each that is left beyond the reserve, it is the larger of
    ``p r^2`` and ``min(p, 2 km) r^4``: where a step is cheap, a vehicle that has used half of the limit is in search of
    the destination, and small legs teach little.

    Args:
        percent: price while many are left [% of SPL]: p is this share of ``range_km``.
        range_km: distance that counts as 100 % [km].
        displacement: ``(..., 2)`` [km].
        step: ``(...)`` number of the step.
        sensor_std: standard deviations of a reading, ``(..., 3)`` or 3 numbers.
        max_steps: step limit of the episode.
        max_leg_km: longest leg.

    Example:
        >>> displacement = torch.tensor([100.0, 0.0])
        >>> step_price(0.5, 200.0, displacement, torch.tensor(22), (0.0, 0.0, 0.0), 50, 50.0)
        tensor(16.)
        >>> step_price(0.5, 200.0, displacement, torch.tensor(18), (0.1, 0.15, 20.0), 50, 50.0)  # accurate to 10 km
        tensor(16.)
    """
    length = sensor_length(torch.as_tensor(sensor_std, dtype=displacement.dtype, device=displacement.device))
    reserve = (length / RESERVE_KM).square().clamp_max(RESERVE_SHARE * max_steps)
    reserve = torch.where(length < MISSING_KM, reserve, 0.0)
    spare = max_steps - step - 1.5 * displacement.norm(dim=-1) / max_leg_km - reserve
    rise, price = (max_steps / spare.clamp_min(1.0)).square(), torch.as_tensor(percent) * range_km / 100
    return torch.maximum(price, price.clamp_max(CHEAP_KM) * rise) * rise


def planned_leg(
    goal: Destination,
    posterior: DestinationPosterior,
    aim: Tensor,
    errors: SensorStd,
    step_km: Tensor,
    max_leg_km: float,
    caution: float = CAUTION,
) -> Tensor:
    """Return the displacement ``(..., 2)`` [km] of the next leg, northward and eastward.

    It compares legs of several lengths and directions (:data:`ANGLES_DEG`) and takes the least sum of three costs
    [km]:

    - the path: the length of the leg plus the mean distance that then remains, over the posterior of the displacement;
    - the detour that the uncertainty of the displacement may then cost, times ``caution``: what a reading at the end of
      the leg will teach does not depend on what will be read (:func:`~magrl.pilot.forecast.covariance_after`);
    - the price of the steps that remain.

    Args:
        goal: the destination as seen from the belief.
        posterior: its posterior.
        aim: ``(..., 2)`` northward and eastward [km]; the posterior is shifted to have its mean there.
        errors: accuracy of the next reading, tensors ``(..., 3)``.
        step_km: ``(...)`` price of a step [km], see :func:`step_price`.
        max_leg_km: longest leg.
        caution: weight of the uncertainty.

    Source:
        A. A. Feldbaum, Dual control theory, Automation and Remote Control 21 (1960): an action both steers and probes.

    Example:
        >>> from magrl.pilot.belief import start
        >>> from magrl.pilot.destination import destination, posterior
        >>> here, errors = torch.tensor([8.0, -16.0, 35000.0]), SensorStd(torch.tensor([0.02, 0.02, 2.0]))
        >>> goal = destination(start(here, errors), torch.tensor([9.0, -20.0, 34500.0]), range_km=300.0)
        >>> there = posterior(goal)
        >>> planned_leg(goal, there, there.displacement().mean, errors, torch.tensor(1.0), max_leg_km=50.0).shape
        torch.Size([2])
    """
    aim = aim.to(goal.field)
    legs = _legs(aim, max_leg_km)
    left = aim.unsqueeze(-2) - legs
    shift = aim - (posterior.points * posterior.weights.unsqueeze(-1)).sum(-2)
    distance = posterior.mean_distance(legs - shift.unsqueeze(-2)).to(aim.dtype)  # now it is the same for all
    cost = legs.norm(dim=-1) + distance * (1 + step_km / max_leg_km).unsqueeze(-1)
    kept = cost.topk(min(KEPT, cost.shape[-1]), -1, largest=False).indices
    legs, left = (x.gather(-2, kept.unsqueeze(-1).expand(*kept.shape, 2)) for x in (legs, left))
    after = covariance_after(goal, aim, legs, errors)
    best = (cost.gather(-1, kept) + caution * _detour(left, after)).argmin(-1)[..., None, None]
    return legs.gather(-2, best.expand(*best.shape[:-1], 2)).squeeze(-2)


def corrected(displacement: Tensor, correction: Tensor) -> Tensor:
    """Return a planned displacement with a correction that does not depend on its length.

    Args:
        displacement: ``(..., 2)`` planned displacement [km].
        correction: ``(..., 2)`` of the logarithm of its length, and of its direction, in units of
            :data:`CORRECTION`.

    Example:
        >>> corrected(torch.tensor([20.0, 0.0]), torch.zeros(2))
        tensor([20.,  0.])
        >>> corrected(torch.tensor([20.0, 0.0]), torch.tensor([2.0, 3.0])).round()  # e times as far, to the right
        tensor([ 4., 54.])
    """
    stretch, angle = (CORRECTION * correction).unbind(-1)
    (x, y), cos, sin = displacement.unbind(-1), torch.cos(angle), torch.sin(angle)
    return torch.exp(stretch).unsqueeze(-1) * torch.stack((cos * x - sin * y, sin * x + cos * y), -1)


def _legs(displacement: Tensor, max_leg_km: float) -> Tensor:
    """Return the displacements ``(..., M, 2)`` [km] that are compared, given the displacement ``(..., 2)``."""
    distance = displacement.norm(dim=-1, keepdim=True)
    whole, least = (x.clamp_max(max_leg_km) for x in (distance, SHORTEST * distance))
    fixed = torch.maximum(displacement.new_tensor(LENGTHS) * max_leg_km, least)
    angles = torch.deg2rad(displacement.new_tensor(ANGLES_DEG))
    bearing = torch.atan2(displacement[..., 1:], displacement[..., :1]) + angles
    directions = torch.stack((torch.cos(bearing), torch.sin(bearing)), -1)
    return (torch.cat((fixed, whole), -1)[..., None, None] * directions.unsqueeze(-3)).flatten(-3, -2)


def _detour(left: Tensor, covariance: Tensor) -> Tensor:
    """Return the detour ``(..., M)`` [km] for remaining displacements ``(..., M, 2)``, covariance ``(..., M, 2, 2)``.

    It is the hypotenuse over the distance and the standard deviation across it, minus the distance. Near the
    destination, the standard deviation along it counts as well.
    """
    distance = left.norm(dim=-1)
    ahead = (left / distance.clamp_min(1e-9).unsqueeze(-1)).unsqueeze(-1)
    along = (covariance * ahead * ahead.mT).sum((-2, -1))
    across = covariance.diagonal(dim1=-2, dim2=-1).sum(-1) - along
    return torch.sqrt(distance.square() + across + along / (1 + (distance / NEAR_KM).square())) - distance
