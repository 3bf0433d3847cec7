"""Random planets: magnetic fields that share only the spectrum and the polarity of the Earth's.

An agent that learns on one planet learns its map. One that learns on many planets can only learn what their fields have
in common, which also holds at a place that it never visited.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from magrl.checks import check_number
from magrl.field.igrf import igrf_coefficients

STRENGTH, TILT_DEG, SPREAD = (0.7, 1.3), 40.0, (0.5, 2.0)
"""Ranges of the strength of the dipole [Earth's], its largest tilt [deg] and the factor of a variance."""


def power_spectrum(gauss: Tensor) -> Tensor:
    """Return the mean square field of each degree on the reference sphere (Lowes-Mauersberger spectrum).

    Args:
        gauss: complex ``(..., N + 1, N + 1)`` table ``g - i h`` [nT].

    Returns:
        ``(..., N + 1)`` [nT²]: ``(n + 1)`` times the sum of ``g² + h²`` of degree n.

    Source:
        F. J. Lowes, Spatial power spectrum of the main geomagnetic field, and extrapolation to the core, Geophysical
        Journal of the Royal Astronomical Society 36 (1974).

    Example:
        >>> dipole = torch.zeros(2, 2, dtype=torch.complex128)
        >>> dipole[1, 0] = -30.0
        >>> power_spectrum(dipole)
        tensor([   0., 1800.], dtype=torch.float64)
    """
    n = torch.arange(1, gauss.shape[-1] + 1, device=gauss.device)
    return n * torch.view_as_real(gauss).square().sum((-2, -1))


def random_planets(count: int, seed: int) -> Tensor:
    """Return Gauss coefficients of planets whose fields have the Earth's spectrum, to degree 13.

    The dipole has the strength of the Earth's, times a random factor, is tilted from the axis of rotation to a random
    side, and has the polarity of the Earth's. Every other coefficient is normal; its variance is the Earth's power of
    its degree, shared over the 2n + 1 coefficients of the degree, times a random factor for each planet and degree. All
    factors and the tilt are uniform. Of IGRF-13 at 2022-01-01, only the power of each degree and the strength of the
    dipole are used.

    Args:
        count: number of planets.
        seed: random seed; the result is a pure function of the arguments.

    Returns:
        Complex ``(count, 14, 14)`` tables ``g - i h`` [nT], for :class:`~magrl.field.SphericalHarmonicField` and
        :class:`~magrl.field.FieldBank`.

    Raises:
        ValueError: for a count or seed that is not a whole number in its range.

    Example:
        >>> planets = random_planets(1000, seed=0)
        >>> planets.shape
        torch.Size([1000, 14, 14])
        >>> bool((planets[:, 1, 0].real < 0).all())  # as on the Earth, compasses point north
        True
    """
    check_number(1, whole=True, count=count)
    check_number(0, 2**63 - 1, whole=True, seed=seed)
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)

    variance = _earth_variance()
    factor = uniform(*SPREAD, count, len(variance), 1, 1)
    normal = torch.randn(count, len(variance), len(variance), 2, generator=generator, dtype=torch.float64)
    gauss = torch.view_as_complex(normal * torch.sqrt(variance.reshape(-1, 1, 1) * factor)).tril()
    gauss[..., 0] = gauss[..., 0].real.to(gauss.dtype)
    dipole = math.sqrt(float(power_spectrum(_earth())[1]) / 2) * uniform(*STRENGTH, count)
    tilt = torch.deg2rad(uniform(0.0, TILT_DEG, count))  # from the south pole, to a side
    gauss[:, 1, 0] = (-dipole * torch.cos(tilt)).to(gauss.dtype)
    gauss[:, 1, 1] = torch.polar(dipole * torch.sin(tilt), uniform(0.0, 2 * math.pi, count))
    return gauss


class GaussMoments(NamedTuple):
    """Moments of the Gauss coefficients of :func:`random_planets` [nT, nT^2].

    ``axial`` and ``axial_variance`` are those of the axial dipole. ``variance (14,)`` are those of each other
    coefficient by degree, whose means are 0; that of degree 1 is for the two equatorial coefficients.

    Example:
        >>> GaussMoments(-28000.0, 3e7, torch.zeros(3)).axial
        -28000.0
    """

    axial: float
    axial_variance: float
    variance: Tensor


def gauss_moments() -> GaussMoments:
    """Return the moments of the Gauss coefficients of :func:`random_planets`.

    Example:
        >>> moments = gauss_moments()
        >>> round(moments.axial), round(moments.axial_variance**0.5), round(float(moments.variance[1].sqrt()))
        (-27425, 5202, 8205)
    """
    tilt = math.radians(TILT_DEG)
    dipole = math.sqrt(float(power_spectrum(_earth())[1]) / 2)
    low, high = STRENGTH
    mean, square = (sum(low**i * high ** (k - i) for i in range(k + 1)) / (k + 1) * dipole**k for k in (1, 2))
    cos2 = (1 + math.sin(2 * tilt) / (2 * tilt)) / 2
    axial = -mean * math.sin(tilt) / tilt
    variance = _earth_variance() * sum(SPREAD) / 2
    variance[1] = square * (1 - cos2) / 2
    return GaussMoments(axial, square * cos2 - axial**2, variance)


def _earth_variance() -> Tensor:
    """Return the mean square coefficient of each degree, ``(14,)`` [nT²]; zero below degree 2."""
    power = torch.exp(torch.log(power_spectrum(_earth())[2:]))  # published numbers rest on this rounding
    n = torch.arange(len(power) + 2, dtype=torch.float64)
    return torch.nn.functional.pad(power, (2, 0)) / ((n + 1) * (2 * n + 1))


def _earth() -> Tensor:
    return igrf_coefficients("2022-01-01", 13)
