"""The magnetic elements of Eq. (1): signs, limits, inverse and Jacobian."""

import math

import pytest
import torch
from support.tracks import f64

from magrl.field.elements import (
    element_difference,
    elements_gradient,
    elements_jacobian,
    field_vector,
    measured_elements,
)


def random_fields(*shape, seed=0):
    """Field vectors of the Earth's size in every direction."""
    generator = torch.Generator().manual_seed(seed)
    return 3e4 * torch.randn(*shape, 3, generator=generator, dtype=torch.float64)


@pytest.mark.parametrize(
    ("b_ned", "declination", "inclination"),
    [
        ((1.0, 0.0, 0.0), 0.0, 0.0),
        ((0.0, 1.0, 0.0), 90.0, 0.0),
        ((-1.0, 0.0, 0.0), 180.0, 0.0),
        ((-1.0, -0.0, 0.0), 180.0, 0.0),
        ((0.0, -1.0, 0.0), -90.0, 0.0),
        ((3.0, -4.0, 12.0), -math.degrees(math.atan2(4, 3)), math.degrees(math.atan2(12, 5))),
        ((-3.0, 4.0, -12.0), 180 - math.degrees(math.atan2(4, 3)), -math.degrees(math.atan2(12, 5))),
        ((-0.0, -0.0, 5e4), 0.0, 90.0),
        ((0.0, -0.0, -5e4), 0.0, -90.0),
    ],
)
def test_angles_by_hand(b_ned, declination, inclination):
    """D is in (-180, 180]: due south is +180, however its zero is signed; at a magnetic pole it is 0."""
    assert measured_elements(f64(*b_ned))[:2].tolist() == pytest.approx([declination, inclination], abs=1e-13)


def test_differences_in_declination_are_wrapped_and_others_are_not_rounded():
    here, there = torch.rand(2, 1000, 3, generator=torch.Generator().manual_seed(0)) * 180 - 90
    assert torch.equal(element_difference(here, there), here - there)
    turned = element_difference(here.double() + f64(360.0, 0, 0), there.double())
    torch.testing.assert_close(turned, here.double() - there.double())
    assert element_difference(f64(350.0, 200.0, 200.0), f64(0.0, 0.0, 0.0)).tolist() == [-10.0, 200.0, 200.0]
    assert element_difference(f64(180.25, 0.0, 0.0), f64(0.0, 0.0, 0.0))[0] == -179.75


def test_round_trip():
    b_ned = random_fields(1000, seed=1)
    torch.testing.assert_close(field_vector(measured_elements(b_ned)), b_ned, rtol=1e-10, atol=1e-7)


def test_jacobian_matches_autograd():
    b_ned = random_fields(200, seed=2)
    expected = torch.func.vmap(torch.func.jacrev(measured_elements))(b_ned)
    row = expected.abs().amax(-1, keepdim=True)
    assert ((elements_jacobian(b_ned) - expected).abs() / row).max() < 1e-12


@pytest.mark.parametrize("down", [0.0, 5e4])
def test_without_a_horizontal_field_no_derivative_is_nan(down):
    """The rows of D and B_H, which have no direction there, are zero; a change of B_z alone changes no element."""
    jacobian = elements_jacobian(f64(0.0, 0.0, down))
    assert jacobian.isfinite().all()
    assert torch.equal(jacobian[[0, 2]], torch.zeros(2, 3, dtype=torch.float64))
    assert torch.equal(jacobian[:, 2], torch.zeros(3, dtype=torch.float64))


def test_gradient_worked_by_hand():
    """B = (100, 0, 100) nT; eastward B_y grows by 1 nT/km, northward B_z by 2 nT/km."""
    gradient = torch.zeros(3, 2, dtype=torch.float64)
    gradient[1, 1], gradient[2, 0] = 1.0, 2.0
    found = elements_gradient(f64(100.0, 0.0, 100.0), gradient)
    expected = torch.zeros(3, 2, dtype=torch.float64)
    expected[0, 1] = math.degrees(1 / 100)  # D turns by dB_y / B_H
    expected[1, 0] = math.degrees(2 * 100 / (100**2 + 100**2))  # I by B_H dB_z / B_F^2
    torch.testing.assert_close(found, expected, rtol=1e-14, atol=0)


def test_nan_in_a_component_is_nan_in_what_depends_on_it():
    """B_H and D depend on north and east, I on all three; the derivatives of D and B_H downward are zero."""
    for place in range(3):
        b_ned = torch.ones(3, dtype=torch.float64)
        b_ned[place] = math.nan
        jacobian, horizontal = elements_jacobian(b_ned), place < 2
        assert measured_elements(b_ned).isnan().tolist() == [horizontal, True, horizontal]
        assert jacobian[1].isnan().all()
        assert (jacobian[[0, 2], :2].isnan() == horizontal).all()
    assert field_vector(f64(0.0, 0.0, math.nan)).isnan().all()
    assert elements_gradient(f64(1.0, 1.0, 1.0), torch.full((3, 2), math.nan, dtype=torch.float64)).isnan().all()
