"""Synthesis of a potential field from Schmidt semi-normalised spherical harmonics.

A potential ``V = a * sum (a/r)^(n+1) (g cos m.lon + h sin m.lon) S_nm`` is kept as one complex table
``c = g - i h``. The derivative of a solid harmonic along a Cartesian axis is a solid harmonic of the next degree,
so that *differentiating is a linear map of the table*: the field is the same basis times another table, and its
gradient the same basis times a third. One basis and one matrix product therefore give the field and its exact
gradient, with no singularity at the poles, and no loop over coefficients (the recursion runs over degrees,
vectorised over orders and points).

Source: L. E. Cunningham, On the computation of the spherical harmonic terms needed during the numerical
integration of the orbital motion of an artificial satellite, Celestial Mechanics 2 (1970); Schmidt
normalisation as in Winch et al., Geomagnetism and Schmidt quasi-normalization, GJI 160 (2005).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

REFERENCE_RADIUS_KM = 6371.2
"""Geomagnetic reference radius [km]: the ``a`` of the expansion."""


def differentiate(table: Tensor) -> Tensor:
    """Maps the table of a potential to the tables of its three Cartesian derivatives.

    Args:
        table: complex ``(..., N + 1, N + 1)``, entry ``[n, m]`` being ``g - i h``; zero where m > n.

    Returns:
        Complex ``(..., 3, N + 2, N + 2)``: derivatives along x, y, z, per unit of the reference radius.

    Example:
        >>> monopole = torch.ones(1, 1, dtype=torch.complex128)
        >>> differentiate(monopole)[2].real  # d(1/r)/dz = -z/r^3
        tensor([[ 0.,  0.],
                [-1.,  0.]], dtype=torch.float64)
    """
    size = table.shape[-1]
    n = torch.arange(size, dtype=torch.float64, device=table.device).unsqueeze(-1)
    m = torch.arange(size, dtype=torch.float64, device=table.device)
    table = torch.where(m <= n, table, torch.zeros_like(table))
    table = torch.where(m == 0, table.real.to(table.dtype), table)
    # Ratios of Schmidt norms; the factor sqrt(2) is where the order 0 is entered or left.
    leaves_zero = torch.where(m == 0, 1 / math.sqrt(2.0), torch.ones_like(m))
    enters_zero = torch.where(m == 1, math.sqrt(2.0), torch.ones_like(m))
    up = torch.sqrt((n + m + 1) * (n + m + 2)) * leaves_zero
    down = torch.sqrt(((n - m + 1) * (n - m + 2)).clamp_min(0)) * enters_zero * (m > 0)
    level = torch.sqrt(((n - m + 1) * (n + m + 1)).clamp_min(0))
    # Real parts only matter for m = 0, where both neighbours of an order are the same one.
    raised = torch.nn.functional.pad(table * up, (1, 0, 1, 0))
    lowered = torch.nn.functional.pad((table * down)[..., 1:], (0, 2, 1, 0))
    raised = torch.where(torch.arange(size + 1, device=table.device) == 1, raised * 2, raised)
    dz = torch.nn.functional.pad(-table * level, (0, 1, 1, 0))
    return torch.stack(((lowered - raised) / 2, 1j * (lowered + raised) / 2, dz), -3)


def basis(ecef_km: Tensor, degree: int) -> Tensor:
    """Solid harmonics ``(a/r)^(n+1) S_nm cos m.lon`` and ``... sin m.lon`` at given points.

    Args:
        ecef_km: ``(P, 3)`` Earth-centred coordinates [km].
        degree: highest degree.

    Returns:
        ``((degree + 1) * (degree + 2), P)``: for each degree its orders 0 to n, for each order cosine and sine.

    Example:
        >>> basis(torch.tensor([[0.0, 0.0, REFERENCE_RADIUS_KM]]), 1).squeeze(-1)  # at the pole only m = 0 lives
        tensor([1., 0., 1., 0., 0., 0.])
    """
    x, y, z = (ecef_km / REFERENCE_RADIUS_KM).unbind(-1)
    inverse_r2 = 1 / (x * x + y * y + z * z)
    x, y, z = x * inverse_r2, y * inverse_r2, z * inverse_r2
    first = torch.sqrt(inverse_r2)
    rows = [torch.stack((first, torch.zeros_like(first))).unsqueeze(0)]
    orders = torch.arange(degree, dtype=ecef_km.dtype, device=ecef_km.device).reshape(-1, 1, 1)
    for n in range(1, degree + 1):
        cosine, sine = rows[-1][-1]
        k = math.sqrt((2 * n - 1) / (2 * n)) if n > 1 else 1.0
        sectoral = torch.stack((x * cosine - y * sine, x * sine + y * cosine)) * k
        m = orders[:n]
        norm = torch.rsqrt(n * n - m * m)
        lower = ((2 * n - 1) * norm) * (z * rows[-1])
        if n > 1:
            ratio = torch.sqrt((n - 1) ** 2 - m[:-1] * m[:-1]) * norm[:-1]
            previous = ratio * (inverse_r2 * rows[-2])
            lower = torch.cat((lower[:-1] - previous, lower[-1:]))
        rows.append(torch.cat((lower, sectoral.unsqueeze(0))))
    return torch.cat(rows).flatten(0, 1)


def field_table(gauss: Tensor) -> Tensor:
    """Real weights that turn a basis into the field.

    Args:
        gauss: complex ``(N + 1, N + 1)`` table ``g - i h`` [nT].

    Returns:
        ``(3, K)`` weights of Bx, By, Bz [nT] over :func:`basis` of degree N + 1.

    Example:
        >>> g10 = torch.zeros(2, 2, dtype=torch.complex128)
        >>> g10[1, 0] = -30000.0
        >>> field_table(g10).shape
        torch.Size([3, 12])
    """
    return _weights(-differentiate(gauss))


def gradient_table(gauss: Tensor) -> Tensor:
    """Real weights that turn a basis into the gradient of the field.

    Args:
        gauss: complex ``(N + 1, N + 1)`` table ``g - i h`` [nT].

    Returns:
        ``(9, K)`` weights of dB_i/dx_j [nT/km], row-major in (i, j), over :func:`basis` of degree N + 2.

    Example:
        >>> gradient_table(torch.zeros(2, 2, dtype=torch.complex128)).shape
        torch.Size([9, 20])
    """
    return _weights(differentiate(-differentiate(gauss)).flatten(0, 1)) / REFERENCE_RADIUS_KM


def _weights(table: Tensor) -> Tensor:
    """Lays the lower triangle of complex tables out as :func:`basis` is: ``(R, N, N)`` to ``(R, N (N + 1))``."""
    n, m = torch.tril_indices(table.shape[-1], table.shape[-1], device=table.device)
    return torch.view_as_real(table[:, n, m].conj().resolve_conj()).flatten(1)
