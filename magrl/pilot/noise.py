"""What the innovations of readings say of their noise."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from magrl.pilot.belief import Innovation
from magrl.pilot.planning import MISSING_KM, SLOPES

# Chosen on random planets.
SHEET_READINGS = 4.0
"""Number of readings that count as much as the stated noise, where it is estimated."""
SHARED = 0.5
"""Weight of an element's readings in the estimates of the other elements."""
DEAD_BAND = 0.4
"""Deviation of the logarithm of the variance up to which the stated noise is kept; beyond, it is subtracted."""
LARGEST_SCORE = 8.0
"""Largest evidence of one element in a reading, three standard deviations: a spike counts no more."""
LARGEST_RATIO = 64.0
"""Largest ratio of the variances: with the dead band, the standard deviation is scaled by at most 6.5."""


SPIKES = 0.015
"""Share of elements of readings that are spikes, in advance."""
SPIKE_FACTOR = 10.0
"""Noise of a spike over the stated one."""


class NoiseEstimate(NamedTuple):
    """Logarithm ``(..., 3)`` of the variance of the noise over the stated one, and the effective number ``(..., 3)`` of
    readings from which it is known.

    Example:
        >>> NoiseEstimate(torch.tensor([0.3, 1.8]), torch.tensor([9.0, 9.0])).factor.round(decimals=2)
        tensor([1.0000, 2.0100])
    """

    log_ratio: Tensor
    readings: Tensor

    @property
    def factor(self) -> Tensor:
        """Factor ``(..., 3)`` of the stated standard deviation; 1 within :data:`DEAD_BAND`."""
        beyond = (self.log_ratio.abs() - DEAD_BAND).clamp_min(0)
        return (self.log_ratio.sign() * beyond / 2).exp()


def noise_estimate(before: NoiseEstimate, new: Innovation, sensor_std: Tensor) -> NoiseEstimate:
    """Return the estimate of the noise of D, I, B_H after another reading.

    With the variance S of the innovation ν, ``ν^2 / S - 1`` is 0 on average where the variance R of the noise is right.
    The logarithm of R moves by it with the weight ``(R / S)^2``, over the sum of these weights and of
    :data:`SHEET_READINGS`: an innovation that comes from an unknown field says little of the noise. Elements share a
    part of the evidence (:data:`SHARED`), as stated values are often wrong for all of them. An element without noise,
    or with so much that its reading is missing (:data:`~magrl.pilot.planning.MISSING_KM`), gives no evidence.

    Args:
        before: estimate before the reading; zeros at the start.
        new: innovation of the reading, with the noise as estimated before it.
        sensor_std: ``(..., 3)`` stated standard deviations of the noise.

    Source:
        R. K. Mehra, On the identification of variances and adaptive Kalman filtering, IEEE Transactions on Automatic
        Control 15 (1970): noise from innovations, here recursively and for one track.

    Example:
        >>> none, std = torch.zeros(3), torch.tensor([0.3, 1.5, 100.0])
        >>> new = Innovation(torch.tensor([0.6, 1.5, 100.0]), torch.zeros(3, 25), torch.diag(std.square()))
        >>> noise_estimate(NoiseEstimate(none, none), new, std)  # D deviates by two standard deviations
        NoiseEstimate(log_ratio=tensor([0.5000, 0.2500, 0.2500]), readings=tensor([2., 2., 2.]))
    """
    total = new.covariance.diagonal(dim1=-2, dim2=-1)
    noise = sensor_std.to(total).square() * before.log_ratio.to(total).exp()
    present = (sensor_std > 0) & (sensor_std / sensor_std.new_tensor(SLOPES) < MISSING_KM)
    weight = torch.where(present, noise / total, 0.0).square()
    score = (weight * (new.residual.square() / total - 1)).clamp_max(LARGEST_SCORE)
    score, weight = (SHARED * x.sum(-1, keepdim=True) + (1 - SHARED) * x for x in (score, weight))
    readings = before.readings + weight
    limit = math.log(LARGEST_RATIO)
    log_ratio = before.log_ratio + score / (SHEET_READINGS + readings)
    return NoiseEstimate(log_ratio.clamp(-limit, limit), readings)


def spike_factor(new: Innovation, sensor_std: Tensor) -> Tensor:
    """Return by which factor ``(..., 3)`` of the noise an element of a reading counts, 1 to :data:`SPIKE_FACTOR`.

    A reading is normal, or with the probability :data:`SPIKES` a spike; its precision is the mean of both given its
    innovation, as of a likelihood with tails.

    Args:
        new: innovation of the reading with its noise.
        sensor_std: ``(..., 3)`` that noise.

    Example:
        >>> std = torch.tensor([0.1, 0.1, 10.0])
        >>> new = Innovation(torch.tensor([0.1, 0.3, 100.0]), torch.zeros(3, 28), torch.diag(std.square()))
        >>> spike_factor(new, std).round(decimals=1)
        tensor([ 1.0000,  1.1000, 10.0000])
    """
    total = new.covariance.diagonal(dim1=-2, dim2=-1)
    noise = sensor_std.to(total).square()
    noise = torch.where(noise < math.inf, noise, 0.0)
    wide = total + (SPIKE_FACTOR**2 - 1) * noise
    square = new.residual.square()
    odds = math.log(SPIKES / (1 - SPIKES)) + (torch.log(total / wide) + square / total - square / wide) / 2
    spike = torch.sigmoid(odds) * (noise > 0)
    return (1 - spike + spike / SPIKE_FACTOR**2).rsqrt()
