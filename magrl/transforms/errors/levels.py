"""Standard deviations of sensors that are drawn for each episode, from perfect sensors to poor ones."""

from __future__ import annotations

import torch
from torch import Tensor

from magrl.checks import check_number, check_tensor

LEVEL_DRAWS = 12
"""Uniform numbers from which the standard deviations of an episode follow."""


def sensor_levels(uniform: Tensor, exponent: float = 1.5) -> Tensor:
    """Return standard deviations of the errors of D [deg], I [deg] and B_H [nT] from perfect sensors to poor ones.

    In 15 % of cases there is no noise. Otherwise a common factor spans two decades up to 0.2 deg, 0.2 deg and 20 nT,
    half of them above 0.04 deg. Each element has a factor of its own, log-uniform from 0.4 to 2.5,
    and in 30 % of cases that of D is multiplied by a number from 1 to 7, as where the north reference is poor.

    In half of the cases there is a bias as well, log-uniform over 1.6 decades up to 0.35 deg, 0.05 deg and
    45 nT, with the same factors of their own.

    Args:
        uniform: ``(..., 12)`` uniform numbers in [0, 1).
        exponent: of the uniform number in the logarithm of the common factor: with 1 it is log-uniform, with half of
            the cases above 0.02 deg; the larger, the more noise.

    Returns:
        ``(..., 6)``: those of the noise, and those of the bias.

    Raises:
        ValueError: for another number of uniform numbers, or an exponent that is not above 0.

    Example:
        >>> sensor_levels(torch.tensor([0.5, 0.0, 0.5, 0.5, 0.5, 0.5, 0.5, 0.0, 0.5, 0.5, 0.5, 0.5]))
        tensor([ 0.2000,  0.2000, 20.0000,  0.0000,  0.0000,  0.0000])
    """
    check_tensor(LEVEL_DRAWS, uniform=uniform)
    check_number(0, above=True, exponent=exponent)
    none, common, poor, factor, exact, biased = (uniform[..., k : k + 1] for k in (0, 1, 5, 6, 7, 8))
    noise = 10 ** (-2 * common**exponent) * _factors(uniform[..., 2:5]) * uniform.new_tensor((0.2, 0.2, 20.0))
    declination = torch.where(poor < 0.3, 1 + 6 * factor, 1.0)
    noise = noise * torch.cat((declination, torch.ones_like(uniform[..., :2])), -1)
    bias = 10 ** (-1.6 * biased) * _factors(uniform[..., 9:12]) * uniform.new_tensor((0.35, 0.05, 45.0))
    return torch.cat((torch.where(none < 0.15, 0.0, noise), torch.where(exact < 0.5, 0.0, bias)), -1)


def _factors(uniform: Tensor) -> Tensor:
    """Return the factors of the elements, log-uniform from 0.4 to 2.5."""
    return 10 ** (0.8 * uniform - 0.4)
