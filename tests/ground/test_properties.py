"""What must hold for every input: symmetries, round trips and limits, on examples that hypothesis chooses.

Hand-worked numbers are in the tests of each module; here the inputs are any that the docstrings allow, poles,
antimeridian and zeros first.
"""

from __future__ import annotations

import math
from functools import cache

import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy
from support.field_checks import f64
from torch import Tensor

from magrl import geodesy
from magrl.field.elements import measured_elements
from magrl.field.spherical import SphericalHarmonicField


def scalars(*values: float) -> tuple[Tensor, ...]:
    return f64(*values).unbind()


def between(low: float, high: float, *special: float) -> SearchStrategy[float]:
    """Numbers in an interval, the special ones often."""
    return st.sampled_from(special) | st.floats(low, high) if special else st.floats(low, high)


LONGITUDES = between(-180, 180, -180.0, 180.0, 0.0, 179.9999999, -179.9999999)
ANGLES = between(-math.pi, math.pi, 0.0, math.pi, -math.pi, math.pi / 2, -math.pi / 2)


# --- Elements ---------------------------------------------------------------------------------------------------------

COMPONENTS = between(-70_000, 70_000, 0.0, -0.0, 1.0, -1.0)
VECTORS = st.tuples(COMPONENTS, COMPONENTS, COMPONENTS)
TILTED = VECTORS.filter(lambda b: math.hypot(*b[:2]) > 1)


@given(TILTED, ANGLES, between(0.01, 100))
def test_turning_and_scaling_the_field(b_ned: tuple[float, float, float], turn: float, scale: float) -> None:
    """A turn about the vertical is a change of D alone, a factor one of B_H alone; a mirror changes the sign of D."""
    north, east, down = b_ned
    sin, cos = math.sin(turn), math.cos(turn)
    before, turned, scaled, mirrored = measured_elements(
        f64(
            *b_ned,
            *(north * cos - east * sin, north * sin + east * cos, down),
            *(scale * x for x in b_ned),
            *(north, -east, down),
        ).unflatten(0, (4, 3))
    )
    assert abs(math.remainder(float(turned[0] - before[0]) - math.degrees(turn), 360)) < 1e-9
    torch.testing.assert_close(turned[1:], before[1:], rtol=1e-12, atol=1e-9)
    torch.testing.assert_close(scaled, before * f64(1, 1, scale), rtol=1e-12, atol=1e-9)
    assert abs(math.remainder(float(mirrored[0] + before[0]), 360)) < 1e-9
    torch.testing.assert_close(mirrored[1:], before[1:])


# --- Fields -----------------------------------------------------------------------------------------------------------


@cache
def random_field(degree: int, seed: int) -> SphericalHarmonicField:
    """An expansion of some degree, its coefficients falling off as the Earth's do."""
    generator = torch.Generator().manual_seed(seed)
    parts = torch.randn(2, degree + 1, degree + 1, generator=generator, dtype=torch.float64)
    gauss = torch.complex(*parts).tril() * 30_000 * 0.5 ** torch.arange(degree + 1).unsqueeze(-1)
    gauss[0] = 0
    return SphericalHarmonicField(gauss)


MODELS = st.builds(random_field, st.integers(1, 8), st.integers(0, 3))


def ecef_field(model: SphericalHarmonicField, latitude: Tensor, longitude: Tensor, altitude_km: Tensor) -> Tensor:
    """The field in axes that are the same everywhere, ``(..., 3)`` [nT]."""
    b_ned = model(latitude, longitude, altitude_km)
    return (geodesy.local_frame(latitude, longitude).mT @ b_ned.unsqueeze(-1)).squeeze(-1)


@given(MODELS, between(-88, 88, 0.0), LONGITUDES, between(-5, 990, 0.0))
def test_the_field_has_no_sources_and_no_curl(
    model: SphericalHarmonicField, latitude: float, longitude: float, altitude_km: float
) -> None:
    """Its tensor of derivatives in fixed axes, by fourth-order differences, has no trace and is symmetric."""
    steps = f64(0.02, 0.02 / math.cos(math.radians(latitude)), 2.0)  # deg, deg, km: about 2 km each
    offsets = torch.stack([k * torch.diag(steps) for k in (-2, -1, 1, 2)])  # (4, 3 coordinates, 3)
    weights = (f64(1, -8, 8, -1) / 12)[:, None, None] / steps[:, None]
    points = (f64(latitude, longitude, altitude_km) + offsets).unbind(-1)
    b_by_coordinate = (weights * ecef_field(model, *points)).sum(0)
    x_by_coordinate = (weights * geodesy.to_ecef(*points)).sum(0)
    tensor = torch.linalg.solve(x_by_coordinate, b_by_coordinate)  # [j, i] is dB_i / dx_j, in nT/km
    # Differences of 1e5 nT, good to 1e-11, over kilometers.
    tolerance = 1e-7 * float(tensor.norm()) + 1e-9 * float(model(*scalars(latitude, longitude, altitude_km)).norm())
    assert abs(float(tensor.trace())) < tolerance
    assert float((tensor - tensor.T).abs().max()) < tolerance
