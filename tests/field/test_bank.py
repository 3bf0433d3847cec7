"""A regional expansion is its model inside its box, and NaN outside; a bank is each of its planets in its own box."""

import copy
import math
from collections.abc import Callable

import pytest
import torch
from support.tracks import f64
from torch import Tensor

from magrl.field import IGRF, FieldBank, RegionalField, SphericalHarmonicField, igrf_coefficients, random_planets
from magrl.geodesy import curvature_radii

ROUNDING_NT = 1e-8
TOLERANCE_NT = 1e-3


def boxes(south: Tensor, west: Tensor, height: float = 20.0, width: float = 20.0) -> tuple[Tensor, Tensor]:
    return torch.stack((south, south + height), -1), torch.stack((west, west + width), -1)


BOXES = boxes(f64(-10, 65, -85, -60, 30, 0), f64(170, -20, 100, -190, 350, 530))
"""Across the antimeridian in three ways, at high latitudes, and across Greenwich."""
PLANET = torch.tensor([0, 1, 2, 0, 1, 2])


@pytest.fixture(scope="module")
def planets() -> Tensor:
    return random_planets(3, seed=0)


@pytest.fixture(scope="module")
def bank(planets: Tensor) -> FieldBank:
    return FieldBank.build(planets, PLANET, *BOXES, tolerance_nt=TOLERANCE_NT)


def inside(count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Random positions in random boxes of :data:`BOXES`, with the index of the box."""
    generator = torch.Generator().manual_seed(1)
    index = torch.randint(len(PLANET), (count,), generator=generator)
    unit = torch.rand(2, count, generator=generator, dtype=torch.float64)
    latitude, longitude = (edges[index, 0] + 20 * u for edges, u in zip(BOXES, unit, strict=True))
    return latitude, longitude, index


def assert_same(one: tuple[Tensor, ...], other: tuple[Tensor, ...]) -> None:
    for found, expected in zip(one, other, strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=ROUNDING_NT, equal_nan=True)


@pytest.mark.parametrize(("degree", "error_nt"), [(5, 0.01), (12, 0.0)])
def test_a_bank_of_one_is_the_region(degree: int, error_nt: float) -> None:
    """With the same values, gradients, coefficients and error; NaN outside."""
    earth, box = igrf_coefficients("2022-01-01", 13), ((-15.5, 5.5), (154.5, 175.5))
    options = {"degree": degree, "tolerance_nt": 10.0}
    region = RegionalField(SphericalHarmonicField(earth), *box, **options)
    edges = (f64(*x).unsqueeze(0) for x in box)
    bank = FieldBank.build(earth.unsqueeze(0), torch.tensor([0]), *edges, **options)
    place = torch.meshgrid(torch.linspace(-17.5, 7.5, 26), torch.linspace(152.5, 177.5, 26), indexing="ij")
    index = torch.zeros(26, 26, dtype=torch.int64)
    assert_same((bank(*place, index),), (region(*place),))
    assert_same(bank.value_and_gradient(*place, index), region.value_and_gradient(*place))
    assert_same((bank.coefficients[0],), (region.coefficients[: 3 * degree + 3].T,))
    assert region.error_nt > error_nt
    assert float(bank.error_nt[0]) == pytest.approx(region.error_nt, rel=1e-4, abs=ROUNDING_NT)


def test_each_expansion_is_its_planet_at_any_turn(bank: FieldBank, planets: Tensor) -> None:
    latitude, longitude, index = inside(3000)
    value, gradient = bank.value_and_gradient(latitude, longitude, index)
    assert_same((bank(latitude, longitude - 720, index),), (value,))
    for box, planet in enumerate(PLANET.tolist()):
        here = index == box
        expected = SphericalHarmonicField(planets[planet]).value_and_gradient(latitude[here], longitude[here])
        assert (value[here] - expected[0]).abs().max() < min(TOLERANCE_NT, 1.5 * float(bank.error_nt[box])), box
        assert (gradient[here] - expected[1]).abs().max() < 1e-5 * expected[1].abs().max(), box


def test_grids_have_the_values_of_their_positions(bank: FieldBank) -> None:
    units = f64(-1.0, 0.3, 1.0), f64(0.9, -0.2, 1.0)
    latitude, longitude = (torch.lerp(*ends.split(1, 1), (1 + x) / 2) for ends, x in zip(BOXES, units, strict=True))
    grids = torch.stack(torch.broadcast_tensors(latitude.unsqueeze(2), longitude.unsqueeze(1) - 360), -1)
    expected = bank.value_and_gradient(grids[..., 0], grids[..., 1], torch.arange(len(bank)).reshape(-1, 1, 1))
    for found, exact in zip(bank.on_grids(grids), expected, strict=True):
        torch.testing.assert_close(found, exact, rtol=1e-9, atol=1e-9)


def test_a_box_on_a_pole_and_a_whole_turn(planets: Tensor) -> None:
    edges = f64(80, 90, 0, 5).view(2, 2), f64(-20, 20, -180, 180).view(2, 2)
    bank = FieldBank.build(planets, torch.tensor([1, 2]), *edges, degree=60)
    latitude, longitude, index = f64(90, 80, 3), f64(10, 20, 170), torch.tensor([0, 0, 1])
    found = bank(latitude, longitude, index)
    for k, planet in enumerate((1, 1, 2)):
        expected = SphericalHarmonicField(planets[planet])(latitude[k], longitude[k])
        torch.testing.assert_close(found[k], expected, rtol=0, atol=TOLERANCE_NT)


def test_the_edges_belong_to_the_box_and_beyond_is_nan(bank: FieldBank) -> None:
    index = torch.arange(len(PLANET))
    assert all(x.isfinite().all() for x in bank.value_and_gradient(*BOXES, index.unsqueeze(-1)))
    (south, north), (west, east) = BOXES[0].T, BOXES[1].T
    for latitude, longitude in (
        (south - 1e-4, west + 10),
        (north + 1e-4, west + 10),
        (south + 10, west - 1e-4),
        (south + 10, east + 1e-4),
        (south * math.nan, west + 10),
    ):
        for found in (bank(latitude, longitude, index), *bank.value_and_gradient(latitude, longitude, index)):
            assert found.isnan().all()


def test_many_boxes_are_built_as_one_by_one() -> None:
    """More boxes and planets than are expanded at a time."""
    planets, planet = random_planets(70, seed=2)[:, :5, :5], torch.arange(150) % 70
    edges = boxes(torch.linspace(-70, 60, 150).double(), torch.linspace(-180, 400, 150).double(), 8.0, 8.0)
    options = {"degree": 6, "tolerance_nt": 1.0}
    whole = FieldBank.build(planets, planet, *edges, **options)
    for k in (0, 63, 64, 149):
        alone = FieldBank.build(planets[planet[[k]]], torch.tensor([0]), *(x[[k]] for x in edges), **options)
        assert_same((whole.coefficients[k],), (alone.coefficients[0],))
        torch.testing.assert_close(whole.error_nt[k], alone.error_nt[0], rtol=1e-3, atol=ROUNDING_NT)


def test_another_device_and_a_cast_keep_float64(bank: FieldBank) -> None:
    moved = copy.deepcopy(bank).half().to("meta")
    assert {(x.device.type, x.dtype) for x in moved.buffers()} == {("meta", torch.float64)}
    value, gradient = moved.value_and_gradient(*(x.to("meta") for x in inside(10)))
    assert (value.device.type, value.shape, gradient.shape) == ("meta", (10, 3), (10, 3, 2))


def test_a_bank_of_given_coefficients() -> None:
    expansion = torch.zeros(1, 3, 2, 2)
    expansion[0, 2, 1, 0], expansion[0, 1, 0, 1] = 5.0, 7.0  # down rises northward, east rises eastward
    bank = FieldBank(expansion, f64(0, 10).view(1, 2), f64(0, 20).view(1, 2))
    assert bank(f64(10.0), f64(15.0), torch.tensor([0])).tolist() == [[0.0, 3.5, 5.0]]
    assert bank.error_nt.isnan().all()


def test_an_error_above_the_tolerance_names_the_worst_box(planets: Tensor) -> None:
    latitude, longitude = boxes(f64(0, -30, 20), f64(0, 160, 40), 10.0, 10.0)
    latitude[1, 1] = 30.0
    message = (
        r"degree 8 misses the field by \S+ nT in box 1, of planet 2, .*\(-30\.0, 30\.0\).*\(160\.0, 170\.0\).*0\.01 nT"
    )
    with pytest.raises(ValueError, match=message):
        FieldBank.build(planets, torch.tensor([0, 2, 1]), latitude, longitude, degree=8, tolerance_nt=0.01)


ONE = torch.zeros(1, 3, 2, 2)
MISTAKES: dict[str, dict | Callable[[FieldBank], object]] = {
    r"gauss .*\(P, N \+ 1, N \+ 1\).* got \(4, 4\)": {"gauss": torch.zeros(4, 4, dtype=torch.complex64)},
    r"planet_index -1 is not in \[0, 3\)": {"planet_index": torch.tensor([0, -1])},
    r"planet_index .*\(2,\).* got \(1,\)": {"planet_index": torch.tensor([0])},
    r"latitudes \(10\.0, -91\.0\) of box 1 must rise": {"latitude": f64(0, 10, 10, -91).view(2, 2)},
    r"longitudes of box 0 .*\(0\.0, inf\)": {"longitude": f64(0, math.inf, 0, 9).view(2, 2)},
    r"\(1, 2\) and \(2, 2\)": {"latitude": f64(0, 10).view(1, 2)},
    "degree .* got 0": {"degree": 0},
    "tolerance_nt .* got 0": {"tolerance_nt": 0.0},
    "must hold 1 boxes, as expansion, got 2": lambda _: FieldBank(ONE, *boxes(f64(0, 10), f64(0, 10))),
    r"shape \(K, 3, n, n\) .* got \(1, 2, 2, 2\)": lambda _: FieldBank(ONE[:, 1:], *boxes(f64(0), f64(0))),
    r"index 6 is not in \[0, 6\)": lambda bank: bank(f64(0.0), f64(175.0), torch.tensor([6])),
    r"index must be int64, got torch\.float32": lambda bank: bank(f64(0.0), f64(175.0), torch.tensor([0.0])),
}


@pytest.mark.parametrize("message", MISTAKES)
def test_mistakes(message: str, planets: Tensor, bank: FieldBank) -> None:
    latitude, longitude = boxes(f64(0, 10), f64(0, 10))
    good = {"gauss": planets, "planet_index": torch.tensor([0, 0]), "latitude": latitude, "longitude": longitude}
    bad = MISTAKES[message]
    with pytest.raises((TypeError, ValueError), match=message):
        FieldBank.build(**good | bad) if isinstance(bad, dict) else bad(bank)


# --- One region

BOX = (-15.5, 5.5), (154.5, 175.5)


@pytest.fixture(scope="module")
def igrf() -> IGRF:
    return IGRF("2022-01-01", generation=13)


@pytest.fixture(scope="module")
def region(igrf) -> RegionalField:
    return RegionalField(igrf, *BOX)


@pytest.mark.parametrize("model", ["igrf", "region"])
def test_shapes_and_dtypes_of_models(model, request):
    field = request.getfixturevalue(model)
    for dtype in (torch.float32, torch.float64):
        latitude, longitude = torch.tensor([[-8.0], [-5.0], [-2.0]], dtype=dtype), torch.tensor([160.0, 165.0])
        value, gradient = field.value_and_gradient(latitude, longitude)
        assert field(latitude, longitude).shape == (3, 2, 3)
        assert value.dtype == gradient.dtype == torch.float64
        one = field.value_and_gradient(f64(-5.0)[0], f64(165.0)[0])
        torch.testing.assert_close(value[1, 1], one[0], rtol=0, atol=ROUNDING_NT)
        torch.testing.assert_close(gradient[1, 1], one[1], rtol=0, atol=ROUNDING_NT)
    assert field(latitude[:0], longitude).shape == (0, 2, 3)


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


def test_an_error_of_a_region_above_the_tolerance_raises(igrf):
    with pytest.raises(ValueError, match=r"degree 4 misses the field by \S+ nT .*\(-10, 0\).*\(160, 170\).*0\.001 nT"):
        RegionalField(igrf, (-10, 0), (160, 170), degree=4)


def test_a_region_survives_a_state_dict(region):
    twin = RegionalField(IGRF(1950.0), *BOX)
    twin.load_state_dict(region.state_dict())
    assert torch.equal(twin(f64(-8.0), f64(164.0)), region(f64(-8.0), f64(164.0)))
    assert not list(region.parameters())
