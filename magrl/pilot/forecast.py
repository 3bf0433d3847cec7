"""What readings after a leg will teach of the displacement to the destination, before they are made."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from magrl.field.elements import elements_jacobian
from magrl.pilot.belief import ANOMALY_KM, DRIFT, MODEL_NT, PLACE
from magrl.pilot.destination import _DIFFERENCE_KM, _ENTRIES, Destination, _carried, _inverse, _with_latitude
from magrl.pilot.displacement import Displacement
from magrl.pilot.harmonics import UNIT_KM, powers, turning
from magrl.pilot.local import COEFFICIENTS, TERMS, inverse2, inverse3, levers, monomial_rows, slopes, unturned
from magrl.pilot.prior import DEGREE, closure, lasting_covariances
from magrl.sensor_std import SensorStd


def covariance_after(
    goal: Destination, place: Tensor, legs: Tensor, errors: SensorStd, readings: Tensor | float = 1.0
) -> Tensor:
    """Return the expected covariance ``(..., M, 2, 2)`` of the displacement [km^2] after legs with readings at the end.

    The covariance of the predicted field at a place, after a reading, does not depend on what will be read. Its slopes
    there, which divide a difference of the field, do: their mean square is the present estimate's plus what the
    reading will take from their covariance.

    Args:
        goal: the destination.
        place: ``(..., 2)`` estimated displacement to the destination [km], where the field is linearized.
        legs: ``(..., M, 2)`` displacements to the places of the readings [km].
        errors: accuracy of the readings, tensors ``(..., 3)``.
        readings: number of readings at each place, whose noise is averaged: a number or ``(M,)``.

    Example:
        >>> from magrl.pilot.belief import start
        >>> from magrl.pilot.destination import destination
        >>> here, errors = torch.tensor([3.0, 65.0, 18000.0]), SensorStd(torch.tensor([0.05, 0.05, 5.0]))
        >>> goal = destination(start(here, errors), torch.tensor([3.0, 66.0, 17500.0]), 300.0)
        >>> legs = torch.tensor([[50.0, 0.0], [0.0, 50.0]])
        >>> covariance_after(goal, torch.tensor([90.0, 0.0]), legs, errors).shape
        torch.Size([2, 2, 2])
    """
    if goal.between is not None:
        return _between_after(goal, goal.between, legs.to(goal.field) / UNIT_KM, errors, readings)
    belief, place, legs = goal.belief, place.to(goal.field) / UNIT_KM, legs.to(goal.field) / UNIT_KM
    eye, apart = torch.eye(3).to(place), _DIFFERENCE_KM / UNIT_KM
    corners = place.unsqueeze(-2) + torch.cat((torch.zeros(1, 2), torch.eye(2))).to(place) * apart
    target, slope = _carried(goal, corners)
    at_place = _with_latitude(levers(corners), target.mT, slope)  # (..., 3, 3, K + 1)
    residual = target.mT - (at_place @ belief.mean[..., None, : COEFFICIENTS + 1, None]).squeeze(-1)
    at_place, residual = _comparable(goal, at_place, residual)
    value, derivatives = at_place[..., 0, :, :], (at_place[..., 1:, :, :] - at_place[..., :1, :, :]) / apart
    at_place = torch.cat((value, derivatives.flatten(-3, -2)), -2)  # (..., 9, K + 1)
    slopes = (residual[..., :1, :] - residual[..., 1:, :]).flatten(-2) / apart  # of the prediction: 3 north, 3 east
    reading, noise = _readings(goal, legs.float(), errors, readings)
    covariance, state = belief.covariance, COEFFICIENTS + 1
    spread = reading.flatten(-3, -2) @ covariance.float()  # (..., 3 M, S)
    shared = (at_place.float() @ spread[..., :state].mT).unflatten(-1, (-1, 3))  # (..., 9, M, 3)
    shared = _entries_first(shared.movedim(-3, -2))  # (9, 3, ..., M)
    spread = spread.unflatten(-2, (-1, 3))
    total = [(reading[..., i, :] * spread[..., j, :]).sum(-1) + noise[..., i, j] for i, j in _ENTRIES]
    gain = _product(shared, _inverse_entries(total))
    now = value @ covariance[..., :state, :state] @ value.mT
    square = (place.unsqueeze(-2) - legs).square().sum(-1)
    left = square**DEGREE * closure().left_out_nt ** 2 + goal.noise_at(square)
    after = _entries_first(now.unsqueeze(-3) + left[..., None, None] * eye) - _product(gain[:3], shared[:3])
    weight = _inverse_entries([after[i, j] for i, j in _ENTRIES])
    slopes = slopes.movedim(-1, 0).float().unsqueeze(-1)  # (6, ..., 1)
    squares = _product(gain[3:], shared[3:]) + slopes.unsqueeze(0) * slopes.unsqueeze(1)
    blocks = squares[:3, :3], squares[:3, 3:], squares[3:, 3:]
    (nn, ne, ee), ridge = ((weight * block).sum((0, 1)) for block in blocks), goal.range**-2
    return inverse2(torch.stack((nn + ridge, ne, ne, ee + ridge), -1).unflatten(-1, (2, 2)).to(place)) * UNIT_KM**2


def _between_after(
    goal: Destination, between: Displacement, legs: Tensor, errors: SensorStd, readings: Tensor | float
) -> Tensor:
    """Return :func:`covariance_after` between two known places, whose displacement has the place's covariance."""
    reading, noise = _readings(goal, legs, errors, readings)
    covariance = goal.belief.covariance.unsqueeze(-3)
    far = legs.norm(dim=-1)[..., None, None] * UNIT_KM
    cross = covariance[..., PLACE, :] + far * covariance[..., DRIFT, :]  # of the place after the leg, (..., M, 2, S)
    now = cross[..., PLACE] + far * cross[..., DRIFT]
    target = between.covariance - goal.belief.covariance[..., PLACE, PLACE]
    shared = cross @ reading.mT
    total = reading @ covariance @ reading.mT + noise
    return now - shared @ inverse3(total) @ shared.mT + target.unsqueeze(-3)


def _comparable(goal: Destination, rows: Tensor, residual: Tensor) -> tuple[Tensor, Tensor]:
    """Return rows ``(..., M, 3, K)`` of the field at places and residuals ``(..., M, 3)`` along the predicted magnetic
    north and downward, where the belief's axes are from magnetic north: D there is not comparable."""
    field = (rows @ goal.belief.mean[..., None, : rows.shape[-1], None]).squeeze(-1)
    north, east, _ = field.unbind(-1)
    level = torch.hypot(north, east)
    along = torch.hypot(*goal.field[..., :2].unbind(-1)).unsqueeze(-1) - level
    magnetic, none = goal.belief.magnetic[..., None, None], torch.zeros_like(level)
    ahead = (torch.stack((north, east), -1) / level.unsqueeze(-1)).unsqueeze(-2) @ rows[..., :2, :]
    turned = torch.cat((ahead, 0 * ahead, rows[..., 2:, :]), -2)
    residual = torch.where(magnetic, torch.stack((along, none, residual[..., 2]), -1), residual)
    return torch.where(magnetic.unsqueeze(-1), turned, rows), residual


def _readings(goal: Destination, legs: Tensor, errors: SensorStd, readings: Tensor | float) -> tuple[Tensor, Tensor]:
    """Return the rows ``(..., M, 3, S)`` of readings of D, I, B_H after legs [unit], and their noise
    ``(..., M, 3, 3)``, both in the dtype of the legs."""
    belief, mean = goal.belief, goal.belief.mean[..., None, :COEFFICIENTS, None].to(legs)
    noise = torch.as_tensor(errors.noise).to(legs)
    present = (noise < math.inf) & belief.measured
    jacobian = torch.where(present.unsqueeze(-1), elements_jacobian(belief.field), 0.0).unsqueeze(-3).to(legs)
    terms, monomials = monomial_rows(TERMS).to(legs), powers(legs, TERMS)
    field = monomials @ (terms @ mean).squeeze(-1)  # (..., M, 3)
    rows = (monomials @ (jacobian @ terms).flatten(-2)).unflatten(-1, (3, COEFFICIENTS))  # on the elements
    x, y, slope = (
        field[..., 0],
        field[..., 1],
        unturned(torch.zeros(3).to(legs), belief.latitude, legs)[1].unsqueeze(-1),
    )
    turned = (torch.stack((-y, x), -1) @ jacobian[..., 0, :, :2].mT) * slope  # by the offset of the latitude
    distance, count = legs.norm(dim=-1), torch.as_tensor(readings).to(legs)
    slope = slopes(belief.mean[..., :COEFFICIENTS], belief.place)[..., :3, :].to(legs).unsqueeze(-3)
    drift = (jacobian @ slope) * (distance * UNIT_KM)[..., None, None]
    kept = torch.exp(-distance * (UNIT_KM / ANOMALY_KM))[..., None, None]
    anomaly = kept * jacobian
    anomaly = anomaly - rows[..., :3] @ goal.share.to(legs).unsqueeze(-3)  # is part of the field
    own = torch.diag_embed(present.to(rows)).unsqueeze(-3).expand(*rows.shape[:-1], 3)
    ahead = legs / (distance * count).clamp_min(1e-9).unsqueeze(-1)  # readings turn with the vehicle between them
    iron = jacobian @ turning(ahead[..., 0], ahead[..., 1], 1)
    white = torch.where(present, noise, 1.0).square().unsqueeze(-2) / count.unsqueeze(-1)
    new = lasting_covariances(belief.field, errors, goal.crust)[1].to(legs).unsqueeze(-3)
    fresh = (1 - kept.square()) * (jacobian @ new @ jacobian.mT)  # a missing element has none
    noise = torch.diag_embed(white) + fresh + MODEL_NT**2 * jacobian @ jacobian.mT
    place = torch.stack((turned, torch.zeros_like(turned)), -1)
    return torch.cat((rows, place, drift, own, anomaly, iron), -1), noise


def _entries_first(matrix: Tensor) -> Tensor:
    """Return matrices ``(..., M, I, J)`` as ``(I, J, ..., M)`` in single precision: many small matrices are slow."""
    return matrix.float().movedim((-2, -1), (0, 1)).contiguous()


def _product(left: Tensor, right: Tensor) -> Tensor:
    """Return the products of matrices ``(I, K, ...)`` with the transposes of ``(J, K, ...)``."""
    return (left.unsqueeze(1) * right.unsqueeze(0)).sum(2)


def _inverse_entries(entries: Sequence[Tensor]) -> Tensor:
    """Return the inverses ``(3, 3, ...)`` of symmetric matrices of six entries ``(...)``."""
    (a, b, c, d, e, f), _ = _inverse(entries)
    return torch.stack((a, b, c, b, d, e, c, e, f)).unflatten(0, (3, 3))
