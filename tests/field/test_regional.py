"""A regional expansion is its model inside the box, and NaN outside."""

import math

import pytest
import torch
from support.field_checks import f64, relative_error

from magrl.field.igrf import IGRF
from magrl.field.regional import RegionalField
from magrl.geodesy import curvature_radii

ROUNDING_NT = 1e-8
BOX = (-15.5, 5.5), (154.5, 175.5)


@pytest.fixture(scope="module")
def igrf() -> IGRF:
    return IGRF("2022-01-01", generation=13)


@pytest.fixture(scope="module")
def region(igrf) -> RegionalField:
    return RegionalField(igrf, *BOX)


def inside(latitude, longitude, count=2000, seed=5):
    """Random points of a box, its corners among them."""
    generator = torch.Generator().manual_seed(seed)
    unit = torch.rand(count, 2, generator=generator, dtype=torch.float64)
    unit[:4] = f64(0, 0, 0, 1, 1, 0, 1, 1).reshape(4, 2)
    return tuple(low + (high - low) * u for (low, high), u in zip((latitude, longitude), unit.unbind(-1), strict=True))


def test_region_is_the_model_inside(igrf, region):
    position = inside(*BOX)
    expected, expected_gradient = igrf.value_and_gradient(*position)
    value, gradient = region.value_and_gradient(*position)
    assert region.error_nt < 1e-5
    assert (value - expected).abs().max() < 1e-5
    assert torch.equal(region(*position), value)
    assert relative_error(gradient, expected_gradient) < 1e-6


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_outside_is_nan(region, dtype):
    """One position inside; seven outside or NaN."""
    latitude = torch.tensor([-5.0, -15.5001, 5.5001, -5.0, -5.0, -5.0, 80.0, math.nan], dtype=dtype)
    longitude = torch.tensor([165.0, 165.0, 165.0, 154.4999, 175.5001, -15.0, 0.0, 165.0], dtype=dtype)
    for found in (region(latitude, longitude), *region.value_and_gradient(latitude, longitude)):
        assert found[0].isfinite().all()
        assert found[1:].isnan().all()


@pytest.mark.parametrize("longitude", [(170.0, 190.0), (-190.0, -170.0), (530.0, 550.0)])
def test_a_box_across_the_antimeridian(igrf, longitude):
    field = RegionalField(igrf, (-10.0, 4.0), longitude)
    latitude = f64(-9.0, -3.0, 0.0, 4.0)
    for turn in (f64(171.0, 179.5, 180.0, 189.0), f64(-189.0, -180.5, -180.0, -171.0)):
        value, gradient = field.value_and_gradient(latitude, turn)
        expected = igrf.value_and_gradient(latitude, turn)
        torch.testing.assert_close(value, expected[0], rtol=0, atol=1e-5)
        assert relative_error(gradient, expected[1]) < 1e-6
    assert field(latitude, f64(169.9, 191.0, -168.0, 0.0)).isnan().all()


def test_the_edges_belong_to_the_box_however_they_round(igrf):
    for k in range(11):
        latitude = ((11 * k - 60) / 10, (11 * k + 37) / 10)
        longitude = ((213 * k - 1000) / 10, (213 * k - 947) / 10)
        field = RegionalField(igrf, latitude, longitude)
        assert field(f64(*latitude), f64(*longitude)).isfinite().all(), (latitude, longitude)


@pytest.mark.parametrize("model", ["igrf", "region"])
def test_shapes_and_dtypes_of_models(model, request):
    field = request.getfixturevalue(model)
    for shape in ((), (3,), (2, 3), (2, 0)):
        for dtype in (torch.float32, torch.float64):
            place = torch.full(shape, -8.0, dtype=dtype), torch.full(shape, 164.0, dtype=dtype)
            value, gradient = field.value_and_gradient(*place)
            assert value.shape == field(*place).shape == (*shape, 3)
            assert gradient.shape == (*shape, 3, 2)
            assert value.dtype == gradient.dtype == torch.float64
    value, gradient = field.value_and_gradient(f64(-8.0, -5.0, -2.0).unsqueeze(-1), f64(160.0, 165.0))
    one = field.value_and_gradient(f64(-5.0)[0], f64(165.0)[0])
    torch.testing.assert_close(value[1, 1], one[0], rtol=0, atol=ROUNDING_NT)
    torch.testing.assert_close(gradient[1, 1], one[1], rtol=0, atol=ROUNDING_NT)


@pytest.mark.parametrize("model", ["igrf", "region"])
def test_models_are_compiled_whole_and_can_be_differentiated(model, request):
    """Their own gradient, northward per km, is what autograd finds per degree."""
    field = request.getfixturevalue(model)
    latitude, longitude = f64(-8.0, -2.0).requires_grad_(), f64(164.0, 162.0)
    (slope,) = torch.autograd.grad(field(latitude, longitude).sum(), latitude)
    latitude = latitude.detach()
    meridian, _ = curvature_radii(latitude)
    expected = field.value_and_gradient(latitude, longitude)[1][..., 0].sum(-1) * torch.deg2rad(meridian)
    torch.testing.assert_close(slope, expected, rtol=1e-9, atol=0)
    whole = torch.compile(field.forward, fullgraph=True, backend="eager")
    torch.testing.assert_close(whole(latitude, longitude), field(latitude, longitude), rtol=0, atol=ROUNDING_NT)


@pytest.mark.parametrize(("degree", "tolerance_nt"), [(4, 1e-3), (12, 1e-13)])
def test_an_error_above_the_tolerance_raises(igrf, degree, tolerance_nt):
    message = rf"degree {degree} misses the field by \d[\d.e+-]* nT .*\(-10, 0\).*\(160, 170\).*{tolerance_nt:.3g} nT"
    with pytest.raises(ValueError, match=message):
        RegionalField(igrf, (-10, 0), (160, 170), degree=degree, tolerance_nt=tolerance_nt)


def test_a_region_survives_a_state_dict(region):
    twin = RegionalField(IGRF(1950.0), *BOX)
    twin.load_state_dict(region.state_dict())
    assert torch.equal(twin(f64(-8.0), f64(164.0)), region(f64(-8.0), f64(164.0)))
    assert not list(region.parameters())
