"""What is known of the gradients of D, I and B_H in advance, learned from random planets.

The elements at the start and at the target tell more about the gradients than a dipole through the start does: a large
difference of declination, for example, is probable where its gradient is large. A small network, fitted by likelihood
(``recipes/gradient_prior.py``), corrects the gradient of a dipole and gives standard deviations for each place.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn
from typing_extensions import Self

from magrl.checks import check_number, check_tensor
from magrl.field.elements import element_difference
from magrl.tracking.filter import GradientPrior
from magrl.tracking.priors import DIPOLE_STD_NT, dipole_prior, per_nanotesla

FILE = Path(__file__).with_suffix(".pt")
"""Weights of :meth:`LearnedPrior.pretrained`."""
FEATURES = 12
_LEAST_LOG, _MOST_LOG = -3.0, 2.0  # logarithm of a standard deviation over that of the dipole
_FARTHEST = 6.0  # a feature; beyond, it is as at this value
_FIELD_NT, _FIELD_RANGE_NT = (25_000.0, 45_000.0), (12_000.0, 15_000.0)  # of B_H and of the total intensity
_DIFFERENCE_NT = 1500.0


class LearnedPrior(nn.Module):
    """Expect the gradients of D, I and B_H by the elements at the start and at the target.

    Two hidden layers read twelve features: sine and cosine of I and D, B_H, the total intensity, and the differences of
    the elements as field components, with their absolute values. They write, along and across magnetic north, the
    deviation of the gradients from a dipole and its standard deviation. Before it is fitted, the prior is
    :func:`~magrl.tracking.dipole_prior`.

    Args:
        width: number of units of a hidden layer.

    Raises:
        ValueError: for a width below 1.

    Example:
        >>> prior = LearnedPrior.pretrained()
        >>> here, there = torch.tensor([0.0, 60.0, 20000.0]), torch.tensor([5.0, 62.0, 18500.0])
        >>> prior(here, there).gradient.shape
        torch.Size([3, 2])
    """

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        check_number(1, whole=True, width=width)
        hidden = [nn.Linear(FEATURES, width), nn.Tanh(), nn.Linear(width, width), nn.Tanh()]
        self.network = nn.Sequential(*hidden, nn.Linear(width, 12)).float()
        for parameter in self.network[-1].parameters():
            nn.init.zeros_(parameter)

    @classmethod
    def pretrained(cls) -> Self:
        """Return the prior that comes with the library, whose weights are not trained further."""
        prior = cls()
        prior.load_state_dict(torch.load(FILE, weights_only=True))
        return prior.requires_grad_(False)

    def forward(self, reading: Tensor, target: Tensor) -> GradientPrior:
        """Return the expected gradient and its standard deviations, as :func:`~magrl.tracking.dipole_prior` does.

        Args:
            reading: ``(..., 3)``: D [deg], I [deg], B_H [nT] at the start.
            target: ``(..., 3)`` the same at the target.

        Raises:
            ValueError: for shapes that do not match.
        """
        dipole = dipole_prior(reading)
        deviation, log_std = self.deviation(reading, target)
        unit = self._unit(reading)
        along = torch.stack((torch.cos(dipole.azimuth), torch.sin(dipole.azimuth)), -1).unsqueeze(-2)
        across = torch.stack((-along[..., 1], along[..., 0]), -1)
        deviation = deviation.to(reading.dtype) * unit
        gradient = dipole.gradient + deviation[..., :1] * along + deviation[..., 1:] * across
        return GradientPrior(gradient, log_std.to(reading.dtype).exp() * unit, dipole.azimuth)

    def deviation(self, reading: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Return the expected deviation from a dipole and the logarithm of its standard deviation, ``(..., 3, 2)``.

        Both are along and across magnetic north, in units of :data:`~magrl.tracking.priors.DIPOLE_STD_NT`.
        """
        written = self.network(features(reading, target).float()).unflatten(-1, (2, 3, 2))
        return written[..., 0, :, :], written[..., 1, :, :].clamp(_LEAST_LOG, _MOST_LOG)

    def loss(self, reading: Tensor, target: Tensor, gradient: Tensor) -> Tensor:
        """Return the negative logarithm ``(...)`` of the likelihood of true gradients ``(..., 3, 2)``, but a constant.

        Args:
            reading: ``(..., 3)``: D [deg], I [deg], B_H [nT] at the start.
            target: ``(..., 3)`` the same at the target.
            gradient: ``(..., 3, 2)`` true gradients northward and eastward [deg/km, deg/km, nT/km].
        """
        dipole = dipole_prior(reading)
        mean, log_std = self.deviation(reading, target)
        north, east = (gradient - dipole.gradient).unbind(-1)
        cos, sin = torch.cos(dipole.azimuth).unsqueeze(-1), torch.sin(dipole.azimuth).unsqueeze(-1)
        found = torch.stack((cos * north + sin * east, cos * east - sin * north), -1) / self._unit(reading)
        return (((found.to(mean.dtype) - mean) / log_std.exp()).square() / 2 + log_std).sum((-2, -1))

    @staticmethod
    def _unit(reading: Tensor) -> Tensor:
        """Return the standard deviations ``(..., 3, 2)`` of a dipole's gradients, the units of the network."""
        std = torch.tensor(DIPOLE_STD_NT, dtype=reading.dtype, device=reading.device) / 100
        return std * per_nanotesla(reading).unsqueeze(-1)


def features(reading: Tensor, target: Tensor) -> Tensor:
    """Return what a :class:`LearnedPrior` reads ``(..., 12)``.

    Example:
        >>> features(torch.tensor([0.0, 60.0, 25000.0]), torch.tensor([0.0, 60.0, 26500.0]))[8]
        tensor(1.)
    """
    check_tensor(3, reading=reading, target=target)
    declination, inclination = torch.deg2rad(reading[..., :2]).unbind(-1)
    strengths = torch.stack((reading[..., 2], reading[..., 2] / torch.cos(inclination).clamp_min(1e-3)), -1)
    difference = element_difference(target, reading) / per_nanotesla(reading) / _DIFFERENCE_NT
    angles = (torch.sin(inclination), torch.cos(inclination), torch.sin(declination), torch.cos(declination))
    strengths = (strengths - strengths.new_tensor(_FIELD_NT)) / strengths.new_tensor(_FIELD_RANGE_NT)
    found = torch.cat((torch.stack(angles, -1), strengths, difference, difference.abs()), -1)
    return found.clamp(-_FARTHEST, _FARTHEST)
