"""Errors of a vector magnetometer, by hand and by their variance."""

from __future__ import annotations

import math

import pytest
import torch

from magrl.field.elements import field_vector
from magrl.transforms import VectorErrors

F64 = torch.float64


def measured(elements: tuple[float, ...], heading_deg: float, **errors: object) -> list[float]:
    vector = VectorErrors(**errors, fixed=True)
    heading = torch.tensor([math.radians(heading_deg)], dtype=F64)
    return vector.disturb(
        torch.tensor(elements, dtype=F64), heading, vector.constants(torch.zeros(14).double())
    ).tolist()


@pytest.mark.parametrize(
    ("heading", "errors", "expected"),
    [
        (0, {"hard_iron_nt": (100, 0, 0)}, (5, 0, 20100)),  # along magnetic north
        (90, {"hard_iron_nt": (100, 0, 0)}, (5 + math.degrees(math.atan(0.005)), 0, math.hypot(20000, 100))),
        (0, {"hard_iron_nt": (0, 0, 200)}, (5, math.degrees(math.atan(0.01)), 20000)),
        (0, {"soft_iron": ((0.01, 0, 0), (0, 0, 0), (0, 0, 0))}, (5, 0, 20200)),
        (90, {"soft_iron": ((0.01, 0, 0), (0, 0, 0), (0, 0, 0))}, (5, 0, 20000)),
    ],
)
def test_iron_by_hand(heading: float, errors: dict, expected: tuple[float, ...]) -> None:
    """D = 5, I = 0, B_H = 20000: the heading is counted from magnetic north."""
    assert measured((5, 0, 20000), heading + 5, **errors) == pytest.approx(expected, abs=1e-9)


def test_attitude_by_hand() -> None:
    """I = 60: roll turns D by tan(I) times the angle on a heading to magnetic north, and I on one across it."""
    turned = math.degrees(math.atan(math.sin(math.radians(1)) * math.tan(math.radians(60))))
    declination, inclination, _ = measured((0, 60, 20000), 0, attitude_deg=(1, 0))
    assert (declination, round(turned, 4)) == (pytest.approx(-turned), 1.7314)
    assert inclination == pytest.approx(60, abs=0.02)
    total = 20000 / math.cos(math.radians(60))
    across = 0, 59, total * math.cos(math.radians(59))
    assert measured((0, 60, 20000), 90, attitude_deg=(1, 0)) == pytest.approx(across)
    assert measured((0, 60, 20000), 0, attitude_deg=(0, 1)) == pytest.approx(across)


def test_variance_of_a_vector_is_that_of_its_errors() -> None:
    vector = VectorErrors((60.0,) * 3, ((2e-3,) * 3,) * 3, (0.1, 0.1))
    draw = torch.Generator().manual_seed(0)
    constants = vector.constants(torch.randn(100_000, 14, generator=draw, dtype=F64))
    elements = torch.tensor([8.0, 50.0, 30000.0], dtype=F64)
    heading = 6.28 * torch.rand(100_000, 1, generator=draw, dtype=F64)
    error = vector.disturb(elements.expand(100_000, 3), heading, constants) - elements
    torch.testing.assert_close(error.var(0), vector.variance(elements), rtol=0.02, atol=0)


def test_the_constant_part_is_the_mean_error_over_the_headings() -> None:
    """In the vehicle's axes: hard iron, and the vertical field as soft iron and an error of the attitude turn it."""
    vector, draw = VectorErrors((60.0,) * 3, ((2e-3,) * 3,) * 3, (0.2, 0.2)), torch.Generator().manual_seed(0)
    constants = vector.constants(torch.randn(20_000, 14, generator=draw, dtype=F64))
    elements = torch.tensor([8.0, 50.0, 30000.0], dtype=F64)
    mean = torch.zeros(20_000, 3, dtype=F64)
    for heading in torch.arange(8, dtype=F64).unsqueeze(-1) * math.pi / 4:
        for sign, read in ((1, vector.disturb(elements.expand(20_000, 3), heading, constants)), (-1, elements)):
            mean += sign / 8 * field_vector(read - torch.tensor([1.0, 0.0, 0.0]) * torch.rad2deg(heading))
    torch.testing.assert_close(mean.std(0), vector.constant_std(elements), rtol=0.02, atol=0)
