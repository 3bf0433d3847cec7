"""Errors of a vector magnetometer: magnetism and attitude of the vehicle, and their effect on D, I and B_H."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import pad

from magrl.errors.base import check_sizes
from magrl.field.elements import rotation

NO_MATRIX = ((0.0, 0.0, 0.0),) * 3


@dataclass(frozen=True)
class VectorErrors:
    """Hard iron, soft iron and attitude error of a vector magnetometer, constant in an episode.

    In the axes of the vehicle (forward, right, down; level), the magnetometer measures ``(1 + S) b + h``. The vehicle
    levels it by roll and pitch, whose errors r and p leave the rotation ``R = R_y(p) R_x(r)``.

    Args:
        hard_iron_nt: h, the field of the vehicle's permanent magnetism: forward, right, down [nT].
        soft_iron: S, 3 x 3: what its magnetically soft parts and a misalignment of the axes add, as a share of b.
        attitude_deg: errors r and p of roll (right side down) and pitch (nose up) [deg].
        fixed: whether these are the errors themselves, with their signs; otherwise standard deviations of normal ones,
            drawn for each vehicle and episode.

    Raises:
        ValueError: for numbers that are missing, not finite, or negative standard deviations.

    Source:
        The measurement model of V. Renaudin, M. H. Afzal and G. Lachapelle, Complete triaxis magnetometer calibration
        in the magnetic domain, Journal of Sensors (2010).

    Example:
        >>> errors = VectorErrors(attitude_deg=(1.0, 0.0), fixed=True)  # roll
        >>> elements, heading = torch.tensor([0.0, 60.0, 20000.0]), torch.zeros(1)
        >>> errors.disturb(elements, heading, errors.constants(torch.zeros(14)))[:2]  # D changes by tan(I) degrees
        tensor([-1.7314, 59.9849])
    """

    hard_iron_nt: Sequence[float] = (0.0, 0.0, 0.0)
    soft_iron: Sequence[Sequence[float]] = NO_MATRIX
    attitude_deg: Sequence[float] = (0.0, 0.0)
    fixed: bool = False

    draws = 14
    """Random numbers of an episode."""
    size = 12
    """Numbers that hold the errors of an episode."""

    def __post_init__(self) -> None:
        check_sizes(3, fixed=self.fixed, hard_iron_nt=self.hard_iron_nt)
        if not isinstance(self.soft_iron, Sequence) or len(self.soft_iron) != 3:
            raise ValueError(f"soft_iron must be 3 rows of 3 numbers, got {self.soft_iron!r}")
        for row in self.soft_iron:
            check_sizes(3, fixed=self.fixed, soft_iron=row)
        check_sizes(2, fixed=self.fixed, attitude_deg=self.attitude_deg)

    @cached_property
    def _mean_squares(self) -> tuple[float, ...]:
        """Mean squares of hard iron [nT^2], soft iron and attitude error [deg^2]."""
        parts = self.hard_iron_nt, [x for row in self.soft_iron for x in row], self.attitude_deg
        return tuple(sum(x * x for x in part) / len(part) for part in parts)

    def constants(self, normal: Tensor) -> Tensor:
        """Return the errors of an episode: the rows of ``R (1 + S) - 1`` and ``R h``.

        Args:
            normal: ``(..., 14)`` standard normal numbers; without effect if the errors are fixed.

        Returns:
            ``(..., 12)``.
        """
        sizes = (*self.hard_iron_nt, *(x for row in self.soft_iron for x in row), *self.attitude_deg)
        drawn = normal.new_tensor(sizes) * (torch.ones_like(normal) if self.fixed else normal)
        hard, soft, attitude = drawn.split((3, 9, 2), -1)
        turned, one = rotation(pad(attitude, (0, 1))), torch.eye(3, dtype=normal.dtype, device=normal.device)
        matrix = turned @ (one + soft.unflatten(-1, (3, 3))) - one
        return torch.cat((matrix.flatten(-2), (turned @ hard.unsqueeze(-1)).squeeze(-1)), -1)

    def disturb(self, elements: Tensor, heading: Tensor, constants: Tensor) -> Tensor:
        """Return the elements that the vehicle measures.

        Args:
            elements: ``(..., 3)`` D [deg], I [deg], B_H [nT].
            heading: ``(..., 1)`` [rad], from the north that D is measured from.
            constants: ``(..., 12)`` from :meth:`constants`.

        Returns:
            ``(..., 3)``.
        """
        declination, inclination, horizontal = elements.unbind(-1)
        bearing = torch.deg2rad(declination) - heading.squeeze(-1)  # of magnetic north from the bow
        cos, sin, tan = torch.cos(bearing), torch.sin(bearing), torch.tan(torch.deg2rad(inclination))
        level = torch.stack((cos, sin, tan), -1) * horizontal.unsqueeze(-1)
        matrix, offset = constants[..., :9].unflatten(-1, (3, 3)), constants[..., 9:]
        forward, right, down = (level + offset + (matrix @ level.unsqueeze(-1)).squeeze(-1)).unbind(-1)
        along, across = forward * cos + right * sin, right * cos - forward * sin  # of the true magnetic north
        measured = torch.hypot(forward, right)
        turned, dip = torch.atan2(across, along), torch.atan2(down, measured)
        return torch.stack((declination + torch.rad2deg(turned), torch.rad2deg(dip), measured), -1)

    def variance(self, elements: Tensor) -> Tensor:
        """Return the variance of the elements to first order, as a mean over the headings.

        Args:
            elements: ``(..., 3)`` D [deg], I [deg], B_H [nT].

        Returns:
            ``(..., 3)`` [deg^2, deg^2, nT^2].
        """
        hard, soft, attitude = self._mean_squares
        tan2, horizontal2 = torch.tan(torch.deg2rad(elements[..., 1])).square(), elements[..., 2].square()
        total2 = horizontal2 * (1 + tan2)
        vector = hard + soft * total2
        per_radian2 = math.degrees(1) ** 2
        declination = per_radian2 * vector / horizontal2 + attitude * tan2
        inclination = per_radian2 * vector / total2 + attitude
        horizontal = vector + attitude / per_radian2 * horizontal2 * tan2
        return torch.stack((declination, inclination, horizontal), -1)

    def constant_std(self, elements: Tensor) -> Tensor:
        """Return the standard deviation ``(..., 3)`` of the part that is constant in the vehicle's axes: forward,
        right, down [nT].

        An error of the attitude turns the vertical field into the horizontal plane; of what soft iron adds, the part by
        the vertical field is constant.

        Args:
            elements: ``(..., 3)`` D [deg], I [deg], B_H [nT].

        Example:
            >>> VectorErrors(attitude_deg=(0.01, 0.01)).constant_std(torch.tensor([0.0, 60.0, 20000.0])).round()
            tensor([6., 6., 0.])
        """
        hard, soft, attitude = self._mean_squares
        down2 = (torch.tan(torch.deg2rad(elements[..., 1])) * elements[..., 2]).square()
        constant = hard + soft * down2
        across = constant + attitude / math.degrees(1) ** 2 * down2
        return torch.stack((across, across, constant), -1).sqrt()
