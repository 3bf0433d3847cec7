"""What is known of the gradients of D, I and B_H in advance: a dipole nearby, and a field without curl.

Pure functions for the filter of :mod:`magrl.tracking`; they batch over leading dimensions.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from magrl.checks import check_tensor
from magrl.geodesy import REFERENCE_RADIUS_KM
from magrl.tracking.filter import GradientPrior, GradientRelation

DIPOLE_STD_NT = ((150.0, 220.0), (165.0, 140.0), (185.0, 135.0))
"""Deviation of the gradients of D, I and B_H from a dipole, along and across magnetic north: of the disturbed field
components [nT per 100 km]. An angle changes by the disturbance over B_H (D) or over the total intensity (I)."""

CURVATURE_NT = (8.5, 12.0, 8.5)
"""Standard deviation of the change of a gradient along the way, in the same way [nT per (100 km)^2]."""

LATITUDE_STD_DEG = 20.0
"""Deviation of the latitude from the magnetic latitude [deg], of planets with tilted dipoles."""

CURL_STD_NT = 0.01
"""Least standard deviation of :func:`curl_relation` [nT/km]; on the ellipsoid, it holds to 0.004 nT/km."""


def dipole_prior(reading: Tensor, target: Tensor | None = None) -> GradientPrior:  # noqa: ARG001
    """Return the gradient of a dipole field through a reading of D, I, B_H, and how far fields deviate from it.

    With the magnetic latitude phi of tan(phi) = tan(I) / 2, towards magnetic north (azimuth D) dI/ds =
    2 / ((1 + 3 sin^2 phi) R) and dB_H/ds = -B_H tan(phi) / R; D is constant.

    Args:
        reading: ``(..., 3)``: D [deg], I [deg], B_H [nT].
        target: not used; priors are given the values at the target, too.

    Returns:
        Gradient ``(..., 3, 2)`` and standard deviations ``(..., 3, 2)`` along and across magnetic north, in deg/km,
        deg/km, nT/km, and the azimuth of magnetic north ``(...)`` [rad].

    Example:
        >>> prior = dipole_prior(torch.tensor([0.0, 0.0, 30000.0]))  # at the magnetic equator
        >>> prior.gradient[1]  # I increases northward by 1.8 degrees per 100 km
        tensor([0.0180, 0.0000])
    """
    check_tensor(3, reading=reading)
    azimuth, inclination = torch.deg2rad(reading[..., :2]).unbind(-1)
    latitude = torch.atan2(torch.sin(inclination), 2 * torch.cos(inclination))
    dip_slope = torch.rad2deg(2 / (1 + 3 * torch.sin(latitude).square())) / REFERENCE_RADIUS_KM
    strength_slope = -reading[..., 2] * torch.tan(latitude) / REFERENCE_RADIUS_KM
    slopes = torch.stack((torch.zeros_like(dip_slope), dip_slope, strength_slope), -1)
    northward = torch.stack((torch.cos(azimuth), torch.sin(azimuth)), -1)
    std = torch.tensor(DIPOLE_STD_NT, dtype=slopes.dtype, device=slopes.device) / 100
    std = std * per_nanotesla(reading).unsqueeze(-1)
    return GradientPrior(slopes.unsqueeze(-1) * northward.unsqueeze(-2), std, azimuth)


def field_curvature(elements: Tensor) -> Tensor:
    """Return the standard deviation of the change of the gradients along the way, for :func:`~magrl.tracking.predict`.

    Args:
        elements: ``(..., 3)``: D [deg], I [deg], B_H [nT] at the place.

    Returns:
        ``(..., 3)``: D, I [deg], B_H [nT], per (100 km)^2.

    Example:
        >>> field_curvature(torch.tensor([0.0, 60.0, 20000.0])).round(decimals=3)
        tensor([0.0240, 0.0170, 8.5000])
    """
    check_tensor(3, elements=elements)
    return torch.tensor(CURVATURE_NT, dtype=elements.dtype, device=elements.device) * per_nanotesla(elements)


def common_error(elements: Tensor) -> Tensor:
    """Return how constant and slow errors of D, I and B_H are correlated, as shares of their standard deviations.

    An error of the field vector has a part along magnetic north, which changes B_H by that and I by -sin(I) of it, and
    a downward part, which changes I by cos(I) of it. Where the two are independent and of the same size, as those of
    hard iron, the correlation of I and B_H is -sin(I). Errors of the level and most weather have a stronger one. With
    shares c, the covariance of errors with the standard deviations b is ``diag(b^2 (1 - c^2)) + (c b) (c b)^T``.

    Args:
        elements: ``(..., 3)``: D [deg], I [deg], B_H [nT] at the place.

    Returns:
        ``(..., 3)``.

    Example:
        >>> common_error(torch.tensor([0.0, -30.0, 20000.0])).round(decimals=2)
        tensor([0.0000, 0.7100, 0.7100])
    """
    check_tensor(3, elements=elements)
    sin = torch.sin(torch.deg2rad(elements[..., 1]))
    root = sin.abs().sqrt()
    return torch.stack((torch.zeros_like(sin), root, -root * sin.sign()), -1)


def per_nanotesla(elements: Tensor) -> Tensor:
    """Return the change of D, I [deg] and B_H [nT] ``(..., 3)`` by a disturbance of 1 nT, above 0 for any reading."""
    strength = elements[..., 2].clamp_min(_LEAST_NT)
    declination = math.degrees(1) / strength
    inclination = declination * torch.cos(torch.deg2rad(elements[..., 1])).abs()
    return torch.stack((declination, inclination, torch.ones_like(strength)), -1)


def curl_relation(elements: Tensor) -> GradientRelation:
    """Return how the gradients of D and B_H are related: outside its sources, the field has no vertical curl.

    With m along and c across magnetic north, B_H dD/dm - dB_H/dc = B_H sin(D) tan(latitude) / R; the right side is the
    convergence of the meridians. The latitude is unknown. The magnetic latitude stands in for it.

    Args:
        elements: ``(..., 3)``: D [deg], I [deg], B_H [nT] at the place.

    Returns:
        Weights ``(..., 3, 2)`` of the gradients northward and eastward of D [nT/deg], I and B_H, and value and standard
        deviation ``(...)`` [nT/km].

    Example:
        >>> relation = curl_relation(torch.tensor([0.0, 45.0, 30000.0]))
        >>> relation.weights.round()  # 524 nT/km eastward for each deg/km of D northward
        tensor([[524.,   0.],
                [  0.,   0.],
                [  0.,  -1.]])
    """
    check_tensor(3, elements=elements)
    azimuth, inclination = torch.deg2rad(elements[..., :2]).unbind(-1)
    strength, (cos, sin) = elements[..., 2], (torch.cos(azimuth), torch.sin(azimuth))
    tan = torch.sin(inclination) / (2 * torch.cos(inclination).clamp_min(_LEAST_COS))
    zero, per_degree = torch.zeros_like(cos), strength * math.radians(1)
    weights = torch.stack((per_degree * cos, per_degree * sin, zero, zero, sin, -cos), -1).unflatten(-1, (3, 2))
    convergence = strength * sin / REFERENCE_RADIUS_KM
    spread = convergence.abs() * (1 + tan.square()) * math.radians(LATITUDE_STD_DEG)
    return GradientRelation(weights, convergence * tan, spread + CURL_STD_NT)


_LEAST_NT = 1000.0  # of the horizontal intensity; below, small angles no longer hold
_LEAST_COS = 1e-3  # of an inclination: keeps the square of the tangent finite
