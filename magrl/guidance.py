"""The paper's equations as pure functions of tensors: objective, rewards and the parallel approach.

Shapes broadcast over leading dimensions; angles are in radians clockwise from true north unless a name says
otherwise; the last dimension of a ``field`` is the element (D [deg], I [deg], B_H [nT]), and differences in D, the
first, are taken the shorter way around, but in :func:`parallel_approach`, whose two elements may be any.

Types and shapes are checked. Values are not, because the functions run in every step: NaN in gives NaN out, except in
:func:`parallel_approach`, whose mask is False there.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from magrl.checks import check_number
from magrl.field.elements import element_difference
from magrl.geodesy import wrap_angle

OBJECTIVE_FLOORS = (0.05, 0.4, 15.0)
"""Smallest ``|B_T - B_0|`` of D [deg], I [deg], B_H [nT] that Eq. (6) divides by: about 18 to 25 km of travel."""


def objective_weights(field: Tensor, target_field: Tensor, floors: Tensor) -> Tensor:
    """Return the weights 1 / (B_T - B_0)^2 of Eq. (6), with a floor under each difference so that none is infinite.

    Args:
        field: ``(..., E)`` elements where the episode starts.
        target_field: ``(..., E)`` elements at the destination.
        floors: ``(E,)`` smallest absolute difference, in the element's unit.

    Returns:
        ``(..., E)`` weights, per squared unit.

    Example:
        >>> objective_weights(torch.tensor([8.0, -16.0]), torch.tensor([10.0, -16.0]), torch.tensor([0.05, 0.5]))
        tensor([0.2500, 4.0000])
    """
    return element_difference(target_field, field).abs().maximum(floors).square().reciprocal()


def objective(field: Tensor, target_field: Tensor, weights: Tensor) -> Tensor:
    """Return the normalized distance to the destination in field space, F of Eq. (6).

    Args:
        field: ``(..., E)`` elements at the vehicle.
        target_field: ``(..., E)`` elements at the destination.
        weights: ``(..., E)`` from :func:`objective_weights` at the start.

    Returns:
        ``(..., 1)``, dimensionless: at most E at the start, 0 at the destination.

    Example:
        >>> objective(torch.tensor([9.0, -16.0]), torch.tensor([10.0, -16.0]), torch.tensor([0.25, 4.0]))
        tensor([0.2500])
    """
    return (weights * element_difference(target_field, field).square()).sum(-1, keepdim=True)


def destination_reward(arrived: Tensor, weight: float) -> Tensor:
    """Return the first term of Eq. (10): ``weight`` at arrival, 0 elsewhere.

    Args:
        arrived: ``(...)`` bool.
        weight: zeta_1.

    Returns:
        ``(...)``.

    Example:
        >>> destination_reward(torch.tensor([True, False]), 200.0)
        tensor([200.,   0.])
    """
    return weight * arrived


def proximity_reward(
    objective_before: Tensor, objective_after: Tensor, weight: float, limit: float | None = None
) -> Tensor:
    """Return the reward of Eq. (11): ``weight`` times the decrease of the objective in a step.

    F has no upper bound: far from the destination, the reward of one leg exceeds the arrival's many times.

    Args:
        objective_before: ``(...)`` F before the leg.
        objective_after: ``(...)`` F after the leg.
        weight: zeta_2.
        limit: where F is greater, it counts as this; None for the paper's equation.

    Returns:
        ``(...)``: positive for an approach.

    Example:
        >>> proximity_reward(torch.tensor(2.0), torch.tensor(1.5), 10.0)
        tensor(5.)
        >>> proximity_reward(torch.tensor(200.0), torch.tensor(7.0), 10.0, limit=8.0)
        tensor(10.)
    """
    if limit is not None:
        objective_before, objective_after = objective_before.clamp(max=limit), objective_after.clamp(max=limit)
    return -weight * (objective_after - objective_before)


def late_decay(proximity: Tensor, step: Tensor, max_steps: int) -> Tensor:
    """Return late proximity rewards after their decay, which the paper describes without a formula.

    After half of the step limit, ``(n / n_max) |R|`` is subtracted: gains shrink and losses grow.

    Args:
        proximity: ``(...)`` from :func:`proximity_reward`.
        step: ``(...)`` number of the leg, counted from 1.
        max_steps: step limit n_max.

    Returns:
        ``(...)``.

    Example:
        >>> late_decay(torch.tensor([4.0, 4.0, -4.0]), torch.tensor([25, 40, 40]), 50)
        tensor([ 4.0000,  0.8000, -7.2000])
    """
    late = step > max_steps / 2
    return proximity - late * (step.to(proximity.dtype) / max_steps) * proximity.abs()


def alignment_reward(angle: Tensor, reference: Tensor, weight: float, offset: float = math.pi / 4) -> Tensor:
    """Return the alignment reward of Eq. (12): high where an angle is close to a reference.

    Args:
        angle: ``(...)`` heading of the leg just made [rad].
        reference: ``(...)`` theoretical heading before the leg [rad].
        weight: zeta_3 [1/rad].
        offset: deviation at which the term changes sign [rad]. With the paper's pi/4 an aligned vehicle is rewarded for
            every step; with 0 the term is never positive.

    Returns:
        ``(...)``: from ``weight * offset`` down to ``weight * (offset - pi)``.

    Example:
        >>> alignment_reward(torch.tensor(math.pi), torch.tensor(-math.pi), 3.0) / 3.0 / math.pi  # the same heading
        tensor(0.2500)
    """
    return weight * (offset - wrap_angle(angle - reference).abs())


def parallel_approach(
    field: Tensor, target_field: Tensor, gradient: Tensor, min_crossing: float = math.radians(2.0)
) -> tuple[Tensor, Tensor]:
    """Return the heading at which two elements approach their targets in proportion (Eq. (21), unambiguous).

    The paper's arctan of a quotient leaves two opposite headings. The intended one is the direction of
    ``J^-1 (B_T - B)``; with the adjugate instead of the inverse it needs the sign of the determinant but no division.

    Args:
        field: ``(..., 2)`` two elements at the vehicle.
        target_field: ``(..., 2)`` the same at the destination.
        gradient: ``(..., 2, 2)`` their derivatives northward and eastward [element unit / km].
        min_crossing: smallest angle at which the two gradients must cross [rad].

    Returns:
        The heading ``(..., 1)`` [rad, (-pi, pi]] and a mask ``(..., 1)``: False, with heading 0, where the gradients
        are nearer to parallel than ``min_crossing``, where one vanishes, where both elements are on target, or where an
        input is NaN.

    Raises:
        ValueError: for a crossing angle outside [0, pi/2].

    Source:
        Eqs. (18) to (21), after the bionic navigation of Wang et al. (2018).

    Example:
        >>> gradient = torch.tensor([[0.0, 2.0], [1.0, 0.0]])  # the first element grows eastward, the second northward
        >>> heading, valid = parallel_approach(torch.zeros(2), torch.tensor([2.0, 1.0]), gradient)
        >>> round(float(torch.rad2deg(heading)), 3), bool(valid)
        (45.0, True)
    """
    check_number(0, math.pi / 2, min_crossing=min_crossing)
    (g1n, g1e), (g2n, g2e) = (row.unbind(-1) for row in gradient.unbind(-2))
    e1, e2 = (target_field - field).unbind(-1)
    determinant = g1n * g2e - g1e * g2n
    north, east = g2e * e1 - g1e * e2, g1n * e2 - g2n * e1
    lengths = torch.hypot(g1n, g1e) * torch.hypot(g2n, g2e)
    crosses = determinant.abs() > lengths * math.sin(min_crossing)
    valid = crosses & (north.abs() + east.abs() > 0)
    sign = torch.sign(determinant)
    heading = torch.atan2(torch.where(valid, sign * east, 0.0), torch.where(valid, sign * north, 1.0))
    return wrap_angle(heading).unsqueeze(-1), valid.unsqueeze(-1)


def best_pair(gradient: Tensor) -> Tensor:
    """Return the two elements whose gradients cross at the largest angle, that is nearest to a right angle.

    The crossing does not depend on the units of the elements. A gradient that is zero or NaN crosses no other.

    Args:
        gradient: ``(..., E, 2)`` derivatives of E elements along two axes [element unit / km], E at least 2.

    Returns:
        ``(..., 2)`` int64: numbers of the two elements, rising; the first pair where several are equal.

    Example:
        >>> best_pair(torch.tensor([[0.0, 2.0], [0.1, 2.0], [300.0, 0.0]]))  # eastward, nearly eastward, northward
        tensor([0, 2])
    """
    count = gradient.shape[-2]
    pairs = torch.triu_indices(count, count, 1, device=gradient.device)
    first, second = (gradient[..., index, :] for index in pairs)
    cross = (first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]).abs()
    sine = (cross / (first.norm(dim=-1) * second.norm(dim=-1))).nan_to_num(0.0)
    # Compared in steps of 1e-6, so that rounding does not decide between equal crossings.
    return pairs.T[(sine * 1e6).round().argmax(-1)]


def displacement_to(error: Tensor, jacobian: Tensor) -> Tensor:
    """Return the displacement that closes an error in the elements, by least squares.

    Args:
        error: ``(..., E)`` target elements minus measured elements, in comparable units.
        jacobian: ``(..., E, 2)`` change of the elements, in the same units per km north and east.

    Returns:
        ``(..., 2)`` north, east [km]; finite for singular equations. NaN in gives NaN out.

    Example:
        >>> displacement_to(torch.tensor([2.0, 1.0]), torch.tensor([[0.0, 0.1], [0.5, 0.0]]))
        tensor([ 2., 20.])
    """
    wide, sides = jacobian.double(), error.double().unsqueeze(-1)  # the normal equations halve the digits
    normal, right = wide.mT @ wide, (wide.mT @ sides).squeeze(-1)
    ridge = 1e-12 * normal.diagonal(dim1=-2, dim2=-1).sum(-1) + 1e-30
    a, b, c = normal[..., 0, 0] + ridge, normal[..., 0, 1], normal[..., 1, 1] + ridge
    north, east = right.unbind(-1)
    solved = torch.stack((c * north - b * east, a * east - b * north), -1) / (a * c - b * b).unsqueeze(-1)
    return solved.to(error.dtype)
