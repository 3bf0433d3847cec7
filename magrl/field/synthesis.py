"""Synthesis of a potential field from Schmidt semi-normalized spherical harmonics.

A potential ``V = a * sum (a/r)^(n+1) (g cos m.lon + h sin m.lon) S_nm`` is stored as one complex table
``c = g - i h``. The derivative of a solid harmonic along a Cartesian axis is a solid harmonic of the next degree, so
*differentiation is a linear map of the table*: the field is the same basis times a second table and its gradient the
same basis times a third, exactly and without a singularity at the poles.

:func:`basis` evaluates the harmonics by Cunningham's recursion and defines the layout of a table. At many points it is
faster to separate the longitude: S_nm is a polynomial in the cosine of the colatitude, times its sine where m is odd.
:func:`separate` converts weights over the basis into weights over the products ``(a/r)^(d+1) T_i(cos theta)``, once;
:func:`contract` then needs one matrix product and one sum over the orders. The Chebyshev polynomials T_i and the S_nm
stay within [-1, 1], so the change of basis is exact to rounding.

Source: L. E. Cunningham, On the computation of the spherical harmonic terms needed during the numerical
integration of the orbital motion of an artificial satellite, Celestial Mechanics 2 (1970). Schmidt normalization:
Winch et al., Geomagnetism and Schmidt quasi-normalization, GJI 160 (2005). Legendre functions as polynomials:
Sneeuw and Bun, Global spherical harmonic computation by two-dimensional Fourier methods, Journal of Geodesy 70 (1996).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from magrl.geodesy import REFERENCE_RADIUS_KM


def differentiate(table: Tensor) -> Tensor:
    """Return the tables of the three Cartesian derivatives of a potential.

    Args:
        table: complex ``(..., N + 1, N + 1)``, entry ``[n, m]`` is ``g - i h``; zero where m > n.

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
    # Ratios of Schmidt norms; the factor sqrt(2) belongs to steps to or from order 0.
    leaves_zero = torch.where(m == 0, 1 / math.sqrt(2.0), torch.ones_like(m))
    enters_zero = torch.where(m == 1, math.sqrt(2.0), torch.ones_like(m))
    up = torch.sqrt((n + m + 1) * (n + m + 2)) * leaves_zero
    down = torch.sqrt(((n - m + 1) * (n - m + 2)).clamp_min(0)) * enters_zero * (m > 0)
    level = torch.sqrt(((n - m + 1) * (n + m + 1)).clamp_min(0))
    # For m = 0 both neighboring orders are the same, and only the real part counts.
    raised = torch.nn.functional.pad(table * up, (1, 0, 1, 0))
    lowered = torch.nn.functional.pad((table * down)[..., 1:], (0, 2, 1, 0))
    raised = torch.where(torch.arange(size + 1, device=table.device) == 1, raised * 2, raised)
    dz = torch.nn.functional.pad(-table * level, (0, 1, 1, 0))
    return torch.stack(((lowered - raised) / 2, 1j * (lowered + raised) / 2, dz), -3)


def checked_gauss(gauss: Tensor, *, batch: bool = False) -> Tensor:
    """Return Gauss coefficients as complex128.

    Args:
        gauss: complex ``(N + 1, N + 1)`` table ``g - i h`` [nT], N >= 1.
        batch: whether there are many tables, ``(P, N + 1, N + 1)``.

    Raises:
        TypeError: for coefficients that are not a complex tensor.
        ValueError: for another shape, or non-finite coefficients.

    Example:
        >>> checked_gauss(torch.zeros(3, 2, dtype=torch.complex128))
        Traceback (most recent call last):
        ValueError: gauss must have the shape (N + 1, N + 1) with N >= 1, got (3, 2)
    """
    if not isinstance(gauss, Tensor) or not gauss.is_complex():
        kind = gauss.dtype if isinstance(gauss, Tensor) else repr(gauss)
        raise TypeError(f"gauss must be a tensor of complex numbers g - i h, got {kind}")
    if gauss.ndim != 2 + batch or gauss.shape[-1] != gauss.shape[-2] or gauss.shape[-1] < 2:
        wanted = "(P, N + 1, N + 1)" if batch else "(N + 1, N + 1)"
        raise ValueError(f"gauss must have the shape {wanted} with N >= 1, got {tuple(gauss.shape)}")
    if not torch.isfinite(torch.view_as_real(gauss)).all():
        raise ValueError("gauss holds non-finite coefficients")
    return gauss.to(torch.complex128)


def basis(ecef_km: Tensor, degree: int) -> Tensor:
    """Return the solid harmonics ``(a/r)^(n+1) S_nm cos m.lon`` and ``... sin m.lon`` at points.

    Args:
        ecef_km: ``(P, 3)`` Earth-centered coordinates [km].
        degree: highest degree.

    Returns:
        ``((degree + 1) * (degree + 2), P)``: for each degree its orders 0 to n, for each order cosine and sine.

    Example:
        >>> basis(torch.tensor([[0.0, 0.0, REFERENCE_RADIUS_KM]]), 1).squeeze(-1)  # at the pole only m = 0 is not zero
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
    """Return the real weights of the field over a basis.

    Args:
        gauss: complex ``(..., N + 1, N + 1)`` tables ``g - i h`` [nT].

    Returns:
        ``(..., 3, K)`` weights of Bx, By, Bz [nT] over :func:`basis` of degree N + 1.

    Example:
        >>> g10 = torch.zeros(2, 2, dtype=torch.complex128)
        >>> g10[1, 0] = -30000.0
        >>> field_table(g10).shape
        torch.Size([3, 12])
    """
    return _weights(-differentiate(gauss))


def gradient_table(gauss: Tensor) -> Tensor:
    """Return the real weights of the gradient of the field over a basis.

    Args:
        gauss: complex ``(..., N + 1, N + 1)`` tables ``g - i h`` [nT].

    Returns:
        ``(..., 9, K)`` weights of dB_i/dx_j [nT/km], row-major in (i, j), over :func:`basis` of degree N + 2.

    Example:
        >>> gradient_table(torch.zeros(2, 2, dtype=torch.complex128)).shape
        torch.Size([9, 20])
    """
    return _weights(differentiate(-differentiate(gauss)).flatten(-4, -3)) / REFERENCE_RADIUS_KM


def _weights(table: Tensor) -> Tensor:
    """Return lower triangles of complex tables in the layout of :func:`basis`: ``(..., N (N + 1))``."""
    n, m = torch.tril_indices(table.shape[-1], table.shape[-1], device=table.device)
    return torch.view_as_real(table[..., n, m].conj().resolve_conj()).flatten(-2)


def chebyshev_nodes(count: int, device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """Return the nodes at which to sample a function, and the matrix from samples to Chebyshev coefficients.

    Args:
        count: number of nodes, and of coefficients.
        device: device of the result.

    Returns:
        ``(count,)`` angles in (0, pi), whose cosines are the nodes, and the ``(count, count)`` matrix.

    Example:
        >>> angles, to_coefficients = chebyshev_nodes(3)
        >>> (to_coefficients @ torch.cos(2 * angles)).round().abs()
        tensor([0., 0., 1.], dtype=torch.float64)
    """
    k = torch.arange(count, dtype=torch.float64, device=device)
    angles = (k + 0.5) * (math.pi / count)
    matrix = torch.cos(k.unsqueeze(-1) * angles) * (2 / count)
    matrix[0] /= 2
    return angles, matrix


def separate(weights: Tensor, degree: int) -> Tensor:
    """Convert weights over :func:`basis` into weights for :func:`contract`.

    Args:
        weights: ``(R, (degree + 1) * (degree + 2))`` float64, for example a :func:`field_table`.
        degree: degree of the basis.

    Returns:
        ``(R, 2 * degree + 1, F)``: for each row the sines of orders 1 to degree and the cosines of orders 0 to
        degree; for each of these the products ``(a/r)^(d+1) T_i(cos theta)`` with d - i = 0, 2, 4 ..., by i in each.

    Example:
        >>> separate(torch.ones(3, 12, dtype=torch.float64), 2).shape
        torch.Size([3, 5, 4])
    """
    n, m = torch.tril_indices(degree + 1, degree + 1, device=weights.device)
    odd = m % 2
    angles, to_coefficients = chebyshev_nodes(degree + 1, weights.device)
    meridian = torch.stack((angles.sin(), torch.zeros_like(angles), angles.cos()), -1)
    legendre = basis(meridian * REFERENCE_RADIUS_KM, degree)[::2]
    polynomial = (legendre / angles.sin() ** odd.unsqueeze(-1)) @ to_coefficients.T

    def separated(rows: Tensor) -> Tensor:
        cosine, sine = (rows[:, k::2, None] * polynomial for k in (0, 1))
        full = rows.new_zeros(len(rows), 2, *[degree + 1] * 3)  # row, sine or cosine, m, d, i
        # An odd order gives one factor (a/r) to the sine of the colatitude: then d - i is even for every order.
        full[:, :, m, n - odd] = torch.stack((sine, cosine), 1)
        parts = [full[..., range(2 * k, degree + 1), range(degree + 1 - 2 * k)] for k in range(degree // 2 + 1)]
        return torch.cat(parts, -1).flatten(1, 2)[:, 1:]

    # At degree 133 one row of temporary arrays takes 40 MB.
    return torch.cat([separated(rows) for rows in weights.split(max(1, 2**20 // (degree + 1) ** 3))])


def on_surface(weights: Tensor, axis_km: Tensor, z_km: Tensor, degree: int) -> Tensor:
    """Restrict weights over :func:`basis` to a surface of revolution, where the latitude determines the radius.

    There an order is a function of the latitude alone, and its expansion is shorter.

    Args:
        weights: ``(R, (degree + 1) * (degree + 2))`` float64, for example a :func:`field_table`.
        axis_km: ``(K,)`` distance from the axis where the sine of the latitude is a Chebyshev node [km].
        z_km: ``(K,)`` height above the equatorial plane there [km].
        degree: degree of the basis.

    Returns:
        ``(R, 2 * degree + 1, K)`` weights over T_k(sin latitude), for :func:`waves` with lift cos(latitude).

    Example:
        >>> angles, _ = chebyshev_nodes(6)  # a sphere
        >>> sphere = REFERENCE_RADIUS_KM * torch.stack((angles.sin(), angles.cos()))
        >>> on_surface(torch.ones(3, 12, dtype=torch.float64), *sphere, degree=2).shape
        torch.Size([3, 5, 6])
    """
    _, order = torch.tril_indices(degree + 1, degree + 1, device=weights.device)
    angles, to_coefficients = chebyshev_nodes(len(z_km), weights.device)
    legendre = basis(torch.stack((axis_km, torch.zeros_like(z_km), z_km), -1), degree)[::2]
    expansion = legendre / angles.sin() ** (order % 2).unsqueeze(-1) @ to_coefficients.T
    parts = weights.unflatten(1, (-1, 2)).mT.flip(1)  # sines and cosines
    sums = torch.stack([parts[..., order == m] @ expansion[order == m] for m in range(degree + 1)], 2)
    return sums.flatten(1, 2)[:, 1:]


def chebyshev(x: Tensor, count: int) -> Tensor:
    """Return Chebyshev polynomials, by 2 T_a T_b = T_a+b + T_|a-b|: one operation for each.

    Args:
        x: any shape, in [-1, 1].
        count: number of polynomials, at least two.

    Returns:
        ``(count, ...)``: T_0 to T_count-1.

    Example:
        >>> chebyshev(torch.tensor(0.5), 4)
        tensor([ 1.0000,  0.5000, -0.5000, -1.0000])
    """
    rows = [torch.ones_like(x), x]
    minus = -rows[0], -x
    for k in range(2, count):
        rows.append(torch.addcmul(minus[k % 2], rows[k // 2], rows[k - k // 2], value=2))
    return torch.stack(rows)


def products(axis_km: Tensor, z_km: Tensor, degree: int) -> tuple[Tensor, Tensor]:
    """Return the features that :func:`separate` gives weights for.

    Args:
        axis_km: ``(P,)`` distance from the Earth's axis [km].
        z_km: ``(P,)`` height above the equatorial plane [km].
        degree: 1 or more.

    Returns:
        ``(F, P)`` products ``(a/r)^(d+1) T_i(cos theta)``, and ``(P,)`` the factor of odd orders, ``(a/r) sin theta``.

    Example:
        >>> features, lift = products(torch.tensor([REFERENCE_RADIUS_KM]), torch.zeros(1), degree=1)  # at the equator
        >>> features.squeeze(-1), lift
        (tensor([1., 0.]), tensor([1.]))
    """
    inverse = REFERENCE_RADIUS_KM / (axis_km * axis_km + z_km * z_km)
    ratio2, z = REFERENCE_RADIUS_KM * inverse, z_km * inverse
    ratio, twice = torch.sqrt(ratio2), z + z
    rows = [ratio, z * ratio]
    for _ in range(degree - 1):
        rows.append(torch.addcmul(twice * rows[-1], ratio2, rows[-2], value=-1))
    blocks = [torch.stack(rows)]
    while len(blocks[-1]) > 2:
        blocks.append(blocks[-1][:-2] * ratio2)
    return torch.cat(blocks), axis_km * inverse


def waves(cos_lon: Tensor, sin_lon: Tensor, lift: Tensor, degree: int) -> Tensor:
    """Return sines of orders 1 to degree and cosines of orders 0 to degree, odd orders times a factor.

    Args:
        cos_lon: ``(P,)`` cosine of the longitude.
        sin_lon: ``(P,)`` sine of the longitude.
        lift: ``(P,)`` factor of odd orders.
        degree: 1 or more.

    Returns:
        ``(2 * degree + 1, P)``.

    Example:
        >>> waves(torch.tensor([0.0]), torch.tensor([1.0]), torch.ones(1), degree=1).squeeze(-1)  # at 90 degrees east
        tensor([1., 1., 0.])
    """
    rows = [torch.stack((torch.zeros_like(cos_lon), torch.ones_like(cos_lon))), torch.stack((sin_lon, cos_lon))]
    minus = -rows[0], -rows[1]
    for k in range(2, degree + 1):  # 2 cos a sin b = sin(a + b) + sin(b - a), and likewise for the cosine
        rows.append(torch.addcmul(minus[k % 2], rows[k // 2][1:], rows[k - k // 2], value=2))
    table = torch.stack(rows, 1)
    table[:, 1::2] *= lift
    return table.flatten(0, 1)[1:]


def contract(weights: Tensor, features: Tensor, orders: Tensor) -> Tensor:
    """Sum an expansion at many points.

    Args:
        weights: ``(R, 2 * degree + 1, F)`` from :func:`separate` or :func:`on_surface`.
        features: ``(F, P)`` from :func:`products` or :func:`chebyshev`.
        orders: ``(2 * degree + 1, P)`` from :func:`waves`.

    Returns:
        ``(R, P)``, equal to the weights over :func:`basis` times that basis.

    Example:
        >>> g10 = torch.zeros(2, 2, dtype=torch.complex128)
        >>> g10[1, 0] = -30000.0
        >>> axis, z, cos, sin = (torch.tensor([x], dtype=torch.float64) for x in (REFERENCE_RADIUS_KM, 0.0, 1.0, 0.0))
        >>> features, lift = products(axis, z, 2)
        >>> contract(separate(field_table(g10), 2), features, waves(cos, sin, lift, 2)).T.round()
        tensor([[    0.,     0., 30000.]], dtype=torch.float64)
    """
    terms = (weights.flatten(0, 1) @ features).unflatten(0, weights.shape[:2])
    return terms.mul_(orders).sum(1)
