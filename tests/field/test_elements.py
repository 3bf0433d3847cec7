"""The magnetic elements of Eq. (1): signs, limits, inverse and Jacobian."""

import math

import numpy as np
import pytest
import torch
from support.tracks import f64

from magrl.field.elements import (
    element_difference,
    elements_covariance,
    elements_gradient,
    elements_jacobian,
    elements_of_axes,
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


def turned_back(axes, attitude):
    """Elements by NumPy, from axes ``(N, 3)`` that are turned by roll, then pitch, then heading ``(N, 3)`` [deg]."""
    (sr, sp, sh), (cr, cp, ch) = np.sin(np.radians(attitude)).T, np.cos(np.radians(attitude)).T
    forward, right, down = axes.T
    right, down = cr * right - sr * down, sr * right + cr * down
    forward, down = cp * forward + sp * down, -sp * forward + cp * down
    north, east = ch * forward - sh * right, sh * forward + ch * right
    horizontal = np.hypot(north, east)
    return np.stack((np.degrees(np.arctan2(east, north)), np.degrees(np.arctan2(down, horizontal)), horizontal), -1)


def test_axes_and_an_attitude_are_elements_by_the_signs_of_navigation():
    """Roll lowers the right side, pitch raises the bow, heading is clockwise from north."""
    axes = random_fields(500, seed=3)
    attitude = (torch.rand(500, 3, generator=torch.Generator().manual_seed(4)).double() - 0.5) * 360
    expected = torch.from_numpy(turned_back(axes.numpy(), attitude.numpy()))
    torch.testing.assert_close(elements_of_axes(axes, attitude), expected, rtol=0, atol=1e-7)


def test_covariance_of_elements_is_that_of_drawn_errors():
    """Two attitudes, also that of a vehicle that rolls; errors of axes and attitude, each of another size."""
    axes = torch.tensor([[4000.0, -14000.0, 50000.0], [-9000.0, 21000.0, -30000.0]]).double()
    attitude = torch.tensor([[2.0, -3.0, 290.0], [25.0, 10.0, 100.0]]).double()
    axes_std, attitude_std = f64(5.0, 10.0, 20.0), f64(0.02, 0.05, 0.1)
    found = elements_covariance(axes, attitude, axes_std, attitude_std)
    random = np.random.default_rng(0)
    for row in range(2):
        drawn = [
            known[row].numpy() + std.numpy() * random.normal(size=(400_000, 3))
            for known, std in ((axes, axes_std), (attitude, attitude_std))
        ]
        expected = torch.from_numpy(np.cov(turned_back(*drawn).T))
        size = expected.diagonal().sqrt()
        torch.testing.assert_close(found[row] / size.outer(size), expected / size.outer(size), rtol=0, atol=0.01)
        alone = elements_covariance(axes[row], attitude[row], axes_std, attitude_std)
        torch.testing.assert_close(found[row], alone)
