"""What the measured elements of the destination say of the field, where its place is known, too.

They show how far a model of the Earth is off there: a reading at a distance. It is a reading of the *difference* from
the model, which varies more slowly than the field itself.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from magrl.field.elements import element_difference, elements_jacobian, measured_elements
from magrl.pilot.anomalies import crust_correlation, crust_share
from magrl.pilot.belief import ANOMALY, MODEL_NT, PLACE, Belief, Innovation, settled, updated
from magrl.pilot.displacement import displacement_between
from magrl.pilot.earth import EarthModel
from magrl.pilot.harmonics import UNIT_KM
from magrl.pilot.local import COEFFICIENTS, levers, slopes, unturned
from magrl.pilot.prior import DEGREE, closure
from magrl.sensor_std import SensorStd

THERE_NT, THERE_PRIOR = (0.0, 30.0, 100.0, 300.0), (0.6, 0.25, 0.1, 0.05)
"""Sizes of an anomaly at the destination alone [nT in each axis], and their probabilities; chosen."""


def surveyed(
    belief: Belief,
    elements: Tensor,
    std: Tensor,
    place: Tensor,
    model: EarthModel,
    crust_nt: Tensor,
    errors: SensorStd,
    there_nt: Tensor | float = 0.0,
) -> Belief:
    """Return the belief given the measured elements of the destination.

    With the model's coefficients m at the estimated place, their slopes J, the error d of that place, the field H c at
    the destination and the correlation rho of the anomaly, their difference from the model's is expected as
    ``H (c - m - J d) + rho a``. By a compass, D does not count.

    Args:
        belief: of a vehicle that knows its place.
        elements: ``(..., 3)``: D [deg], I [deg], B_H [nT] as measured; NaN for an element that is missing.
        std: ``(3,)`` their standard deviations.
        place: ``(..., 2)`` latitude, longitude [deg] of the destination.
        model: of the belief.
        crust_nt: ``(...)`` standard deviation of the crust's field in each axis [nT].
        errors: accuracy of the readings, tensors ``(..., 3)``.
        there_nt: ``(...)`` standard deviation in each axis of an anomaly at the destination alone [nT].
    """
    new, axis = _innovation(belief, elements, std, place, model, crust_nt, errors)
    there = torch.as_tensor(there_nt).to(axis).square()[..., None, None] * axis
    return settled(updated(belief, new._replace(covariance=new.covariance + there)))


def anomaly_there(
    belief: Belief, elements: Tensor, std: Tensor, place: Tensor, model: EarthModel, crust_nt: Tensor, errors: SensorStd
) -> Tensor:
    """Return the expected size ``(...)`` of an anomaly at the destination alone [nT], the root of the mean of the
    squares, given the belief at a known start, where the model's error is known best. Arguments as of
    :func:`surveyed`."""
    new, axis = _innovation(belief, elements, std, place, model, crust_nt, errors)
    square = torch.tensor(THERE_NT).to(axis).square()
    covariance = new.covariance.unsqueeze(-3) + square[:, None, None] * axis.unsqueeze(-3)
    each = Innovation(new.residual.unsqueeze(-2), new.rows.unsqueeze(-3), covariance)
    weight = torch.tensor(THERE_PRIOR).to(axis).log() - (each.square() + torch.logdet(covariance)) / 2
    return (torch.softmax(weight, -1) * square).sum(-1).sqrt()


def _innovation(
    belief: Belief, elements: Tensor, std: Tensor, place: Tensor, model: EarthModel, crust_nt: Tensor, errors: SensorStd
) -> tuple[Innovation, Tensor]:
    """Return the survey minus its prediction, and the covariance ``(..., 3, 3)`` of 1 nT in each axis there."""
    there = model.field(*place.unbind(-1)).to(belief.mean)
    rows, variance = _rows(belief, place, model, crust_nt, errors)
    jacobian, expected = elements_jacobian(there), torch.zeros_like(belief.mean)
    expected[..., :COEFFICIENTS] = model.coefficients(belief.place)
    difference = element_difference(elements.double(), measured_elements(there))
    present = ~difference.isnan()
    present[..., 0] &= torch.as_tensor(errors.bias)[..., 0] < math.inf
    rows = torch.where(present.unsqueeze(-1), jacobian @ rows, 0.0)
    residual = torch.where(present, difference, 0.0) - (rows @ (belief.mean - expected).unsqueeze(-1)).squeeze(-1)
    noise = variance[..., None, None] * jacobian @ jacobian.mT + torch.diag(std.to(there).square())
    both = present.unsqueeze(-1) & present.unsqueeze(-2)
    noise = torch.where(both, noise, torch.eye(3).to(noise))
    axis = torch.where(both, jacobian @ jacobian.mT, 0.0)
    return Innovation(residual, rows, rows @ belief.covariance @ rows.mT + noise), axis


def _rows(
    belief: Belief, place: Tensor, model: EarthModel, crust_nt: Tensor, errors: SensorStd
) -> tuple[Tensor, Tensor]:
    """Return the derivatives ``(..., 3, S)`` of the field's difference from the model at the destination with respect
    to the state, in the axes there, and the variance ``(...)`` in each axis of what the state does not hold."""
    apart = displacement_between(belief.place, place) / UNIT_KM
    square, axes = apart.square().sum(-1), torch.eye(3).to(apart).expand(*apart.shape[:-1], 3, 3)
    carried = torch.stack(unturned(axes, belief.latitude, apart.unsqueeze(-2).expand(*axes.shape[:-1], 2))[0], -1)
    rows, rho = torch.zeros_like(belief.covariance[..., :3, :]), crust_correlation(square)
    rows[..., :COEFFICIENTS] = carried @ levers(apart.unsqueeze(-2)).squeeze(-3)
    rows[..., PLACE] = -rows[..., :COEFFICIENTS] @ slopes(model.coefficients(belief.place), belief.place)
    rows[..., ANOMALY] = rho[..., None, None] * crust_share(belief.field, errors, crust_nt)
    left_out = square**DEGREE * closure().left_out_nt ** 2 * model.share
    return rows, left_out + MODEL_NT**2 + crust_nt.square() * (1 - rho.square())
