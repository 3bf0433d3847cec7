"""A bank of regional expansions is each of its planets in its own box."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from torch import Tensor, nn

from magrl.field import FieldBank, RegionalField, SphericalHarmonicField, igrf_coefficients, random_planets
from magrl.geodesy import curvature_radii

ROUNDING_NT = 1e-8
TOLERANCE_NT = 1e-3


def f64(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


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


@pytest.fixture(scope="module")
def one() -> tuple[FieldBank, RegionalField]:
    """A bank of one box of the Earth, and the same as a region."""
    earth, box = igrf_coefficients("2022-01-01", 13), ((-15.5, 5.5), (154.5, 175.5))
    pair = FieldBank.build(earth.unsqueeze(0), torch.tensor([0]), *(f64(*edges).unsqueeze(0) for edges in box))
    return pair, RegionalField(SphericalHarmonicField(earth), *box)


def inside(count: int, seed: int = 1) -> tuple[Tensor, Tensor, Tensor]:
    """Random positions in random boxes of :data:`BOXES`, with the index of the box."""
    generator = torch.Generator().manual_seed(seed)
    index = torch.randint(len(PLANET), (count,), generator=generator)
    unit = torch.rand(2, count, generator=generator, dtype=torch.float64)
    latitude, longitude = (edges[index, 0] + 20 * u for edges, u in zip(BOXES, unit, strict=True))
    return latitude, longitude, index


def relative_error(found: Tensor, expected: Tensor) -> float:
    return float((found - expected).abs().max() / expected.abs().max())


def test_a_bank_of_one_is_the_region(one: tuple[FieldBank, RegionalField]) -> None:
    bank, region = one
    latitude, longitude = torch.meshgrid(
        torch.linspace(-15.5, 5.5, 31), torch.linspace(154.5, 175.5, 29), indexing="ij"
    )
    index = torch.zeros_like(latitude, dtype=torch.int64)
    torch.testing.assert_close(bank(latitude, longitude, index), region(latitude, longitude), rtol=0, atol=ROUNDING_NT)
    for found, expected in zip(
        bank.value_and_gradient(latitude, longitude, index),
        region.value_and_gradient(latitude, longitude),
        strict=True,
    ):
        torch.testing.assert_close(found, expected, rtol=0, atol=ROUNDING_NT)
    terms = region.degree + 1
    torch.testing.assert_close(bank.coefficients[0], region.coefficients[: 3 * terms].T, rtol=0, atol=ROUNDING_NT)
    assert float(bank.error_nt[0]) == pytest.approx(region.error_nt, rel=0.05, abs=ROUNDING_NT)


def test_the_error_is_measured_where_a_region_measures_it() -> None:
    earth, box = igrf_coefficients("2022-01-01", 13), ((-10.0, 10.0), (160.0, 180.0))
    region = RegionalField(SphericalHarmonicField(earth), *box, degree=5, tolerance_nt=10.0)
    edges = (f64(*x).unsqueeze(0) for x in box)
    bank = FieldBank.build(earth.unsqueeze(0), torch.tensor([0]), *edges, degree=5, tolerance_nt=10.0)
    assert 0.01 < region.error_nt < 10
    assert bank.error_nt.tolist() == pytest.approx([region.error_nt], rel=1e-6)


def test_each_expansion_is_its_planet(bank: FieldBank, planets: Tensor) -> None:
    latitude, longitude, index = inside(3000)
    value, gradient = bank.value_and_gradient(latitude, longitude, index)
    torch.testing.assert_close(bank(latitude, longitude, index), value, rtol=0, atol=ROUNDING_NT)
    for box, planet in enumerate(PLANET.tolist()):
        here = index == box
        expected = SphericalHarmonicField(planets[planet]).value_and_gradient(latitude[here], longitude[here])
        assert (value[here] - expected[0]).abs().max() < min(TOLERANCE_NT, 1.5 * float(bank.error_nt[box])), box
        assert relative_error(gradient[here], expected[1]) < 1e-5, box


def test_the_gradient_is_that_of_the_expansion(bank: FieldBank) -> None:
    """What autograd finds per degree."""
    latitude, longitude, index = inside(50)
    latitude.requires_grad_()
    longitude.requires_grad_()
    gradient = bank.value_and_gradient(latitude.detach(), longitude.detach(), index)[1]
    meridian, prime_vertical = curvature_radii(latitude.detach())
    km = torch.deg2rad(torch.stack((meridian, prime_vertical * torch.cos(torch.deg2rad(latitude.detach())))))
    for component in range(3):
        value = bank(latitude, longitude, index)[:, component].sum()
        slopes = torch.autograd.grad(value, (latitude, longitude))
        torch.testing.assert_close(torch.stack(slopes) / km, gradient[:, component].T, rtol=1e-9, atol=1e-9)
    value, gradient = bank.value_and_gradient(latitude, longitude, index)
    assert all(
        torch.isfinite(x).all() for x in torch.autograd.grad(gradient.sum() + value.sum(), (latitude, longitude))
    )


def test_any_turn_of_the_longitude(bank: FieldBank) -> None:
    latitude, longitude, index = inside(400)
    expected = bank.value_and_gradient(latitude, longitude, index)
    for turn in (-720, -360, 360):
        for found, known in zip(bank.value_and_gradient(latitude, longitude + turn, index), expected, strict=True):
            torch.testing.assert_close(found, known, rtol=0, atol=1e-7)


def test_a_box_on_a_pole_and_a_whole_turn(planets: Tensor) -> None:
    bank = FieldBank.build(
        planets, torch.tensor([1, 2]), f64(80, 90, 0, 5).view(2, 2), f64(-20, 20, -180, 180).view(2, 2), degree=60
    )
    latitude, longitude, index = f64(90, 80, 3), f64(10, 20, 170), torch.tensor([0, 0, 1])
    found = bank(latitude, longitude, index)
    for k, planet in enumerate((1, 1, 2)):
        expected = SphericalHarmonicField(planets[planet])(latitude[k], longitude[k])
        torch.testing.assert_close(found[k], expected, rtol=0, atol=TOLERANCE_NT)


def test_the_edges_belong_to_the_box_and_beyond_is_nan(bank: FieldBank) -> None:
    index = torch.arange(len(PLANET)).unsqueeze(-1)
    edges = bank.value_and_gradient(*BOXES, index)
    assert all(torch.isfinite(x).all() for x in edges)
    (south, north), (west, east) = BOXES[0].T, BOXES[1].T
    middle = south + 10, west + 10
    index = index.squeeze(-1)
    for latitude, longitude in (
        (south - 1e-4, middle[1]),
        (north + 1e-4, middle[1]),
        (middle[0], west - 1e-4),
        (middle[0], east + 1e-4),
        (middle[0], middle[1] + 180),
        (middle[0] * math.nan, middle[1]),
        (middle[0], middle[1] * math.inf),
    ):
        for found in (bank(latitude, longitude, index), *bank.value_and_gradient(latitude, longitude, index)):
            assert torch.isnan(found).all()


def test_decimal_edges_belong_to_their_boxes() -> None:
    south, west = torch.arange(-60, 61, 11) / 10, torch.arange(-1000, 1400, 213)[:11] / 10
    latitude, longitude = boxes(south.double(), west.double(), 9.7, 5.3)
    bank = FieldBank.build(random_planets(1, seed=1), torch.zeros(11, dtype=torch.int64), latitude, longitude)
    assert torch.isfinite(bank(latitude, longitude, torch.arange(11).unsqueeze(-1))).all()


def test_shapes_and_dtypes(bank: FieldBank) -> None:
    for shape in ((), (3,), (2, 3), (0,), (2, 0)):
        for dtype in (torch.float32, torch.float64):
            place = torch.full(shape, -5.0, dtype=dtype), torch.full(shape, 175.0, dtype=dtype)
            index = torch.zeros(shape, dtype=torch.int64)
            value, gradient = bank.value_and_gradient(*place, index)
            assert bank(*place, index).shape == value.shape == (*shape, 3)
            assert gradient.shape == (*shape, 3, 2)
            assert value.dtype == gradient.dtype == bank(*place, index).dtype == torch.float64


def test_positions_and_indices_broadcast(bank: FieldBank) -> None:
    latitude, longitude = f64(-5, 0, 5).unsqueeze(-1), f64(175, 185)
    expected = bank(*torch.broadcast_tensors(latitude, longitude, torch.zeros(3, 2, dtype=torch.int64)))
    assert torch.equal(bank(latitude, longitude, torch.tensor(0)), expected)
    both = bank(f64(5.0), f64(175.0), torch.tensor([0, 5]))
    assert both.shape == (2, 3)
    assert (both[0] != both[1]).any()


def test_chunks_do_not_show(bank: FieldBank) -> None:
    places = inside(1000)
    small = copy.deepcopy(bank)
    small.CHUNK = 7
    torch.testing.assert_close(small(*places), bank(*places), rtol=0, atol=ROUNDING_NT)
    for found, known in zip(small.value_and_gradient(*places), bank.value_and_gradient(*places), strict=True):
        torch.testing.assert_close(found, known, rtol=0, atol=ROUNDING_NT)


def test_many_boxes_are_built_as_one_by_one() -> None:
    """More boxes and planets than are expanded at a time."""
    planets = random_planets(70, seed=2, degree=4)
    planet = torch.arange(150) % 70
    edges = boxes(torch.linspace(-70, 60, 150).double(), torch.linspace(-180, 400, 150).double(), 8.0, 8.0)
    whole = FieldBank.build(planets, planet, *edges, degree=6, tolerance_nt=1.0)
    for k in (0, 63, 64, 69, 70, 149):
        alone = FieldBank.build(
            planets[planet[k]].unsqueeze(0),
            torch.tensor([0]),
            *(x[k].unsqueeze(0) for x in edges),
            degree=6,
            tolerance_nt=1.0,
        )
        torch.testing.assert_close(whole.coefficients[k], alone.coefficients[0], rtol=0, atol=ROUNDING_NT)
        torch.testing.assert_close(whole.error_nt[k], alone.error_nt[0], rtol=1e-3, atol=ROUNDING_NT)


@pytest.mark.parametrize(
    "cast", [lambda m: m.to(torch.float32), nn.Module.float, nn.Module.half], ids=["to", "float", "half"]
)
def test_a_cast_to_lower_precision_is_not_obeyed(cast, bank: FieldBank) -> None:
    places, other = inside(10), copy.deepcopy(bank)
    assert cast(other) is other
    assert {x.dtype for x in other.buffers()} == {torch.float64}
    assert torch.equal(other(*places), bank(*places))


def test_a_move_to_another_device_keeps_float64(bank: FieldBank) -> None:
    moved = copy.deepcopy(bank).to("meta")
    assert {(x.device.type, x.dtype) for x in moved.buffers()} == {("meta", torch.float64)}
    value, gradient = moved.value_and_gradient(*(x.to("meta") for x in inside(10)))
    assert (value.device.type, value.dtype, value.shape) == ("meta", torch.float64, (10, 3))
    assert (gradient.device.type, gradient.dtype, gradient.shape) == ("meta", torch.float64, (10, 3, 2))


def test_a_bank_is_traced_whole(bank: FieldBank) -> None:
    """Nothing in it breaks the graph that torch.compile makes."""
    places = inside(20)
    for function in (bank.forward, bank.value_and_gradient):
        whole = torch.compile(function, fullgraph=True, backend="eager")
        torch.testing.assert_close(whole(*places), function(*places), rtol=0, atol=ROUNDING_NT)


def test_a_bank_survives_a_state_dict(bank: FieldBank, planets: Tensor) -> None:
    places = inside(10)
    other = FieldBank.build(planets.flip(0), PLANET, *boxes(f64(*range(6)), f64(*range(6)), 10.0, 10.0))
    other.load_state_dict(bank.state_dict())
    assert torch.equal(other(*places), bank(*places))
    assert torch.equal(other.error_nt, bank.error_nt)
    assert not list(bank.parameters())
    assert set(bank.state_dict()) == {"coefficients", "scaling", "error_nt"}


def test_a_bank_of_given_coefficients() -> None:
    expansion = torch.zeros(1, 3, 2, 2)
    expansion[0, 2, 1, 0], expansion[0, 1, 0, 1] = 5.0, 7.0  # down rises northward, east rises eastward
    bank = FieldBank(expansion, f64(0, 10).view(1, 2), f64(0, 20).view(1, 2))
    assert bank(f64(10.0), f64(15.0), torch.tensor([0])).tolist() == [[0.0, 3.5, 5.0]]
    assert torch.isnan(bank.error_nt).all()
    assert "expansions=1, degree=1" in repr(bank)


@pytest.mark.parametrize("index", [-1, 6, 1000])
def test_an_index_out_of_range_is_refused(bank: FieldBank, index: int) -> None:
    for function in (bank, bank.value_and_gradient):
        with pytest.raises(ValueError, match=rf"index {index} is not in \[0, 6\)"):
            function(f64(0.0, 0.0), f64(175.0, 175.0), torch.tensor([0, index]))
        with pytest.raises(TypeError, match=r"index must be int64, got torch\.float32"):
            function(f64(0.0), f64(175.0), torch.tensor([0.0]))


def test_an_error_above_the_tolerance_names_the_worst_box(planets: Tensor) -> None:
    latitude, longitude = boxes(f64(0, -30, 20), f64(0, 160, 40), 10.0, 10.0)
    latitude[1, 1] = 30.0
    message = (
        r"degree 8 misses the field by \S+ nT in box 1, of planet 2, .*\(-30\.0, 30\.0\).*\(160\.0, 170\.0\).*0\.01 nT"
    )
    with pytest.raises(ValueError, match=message):
        FieldBank.build(planets, torch.tensor([0, 2, 1]), latitude, longitude, degree=8, tolerance_nt=0.01)


def test_bad_planets_and_boxes_are_refused(planets: Tensor) -> None:
    box, first = boxes(f64(0, 10), f64(0, 10)), torch.tensor([0, 0])
    low, flat = f64(0, 10, 10, -91).view(2, 2), f64(0, 20, 50, 50).view(2, 2)
    for arguments, error, message in (
        ((planets.real, first, *box), TypeError, "gauss .* torch.float64"),
        ((planets[0], first, *box), ValueError, r"gauss .*\(14, 14\)"),
        ((planets * math.nan, first, *box), ValueError, "gauss holds non-finite"),
        ((planets, torch.tensor([0, 3]), *box), ValueError, r"planet_index 3 is not in \[0, 3\)"),
        ((planets, torch.tensor([0, -1]), *box), ValueError, r"planet_index -1"),
        ((planets, torch.tensor([0.0, 1.0]), *box), TypeError, "planet_index must be int64"),
        ((planets, torch.tensor([0]), *box), ValueError, r"planet_index .*\(2,\).* got \(1,\)"),
        ((planets, first, low, box[1]), ValueError, r"latitudes \(10\.0, -91\.0\) of box 1 must rise"),
        ((planets, first, box[0], flat), ValueError, r"longitudes \(50\.0, 50\.0\) of box 1 must rise"),
        ((planets, first, box[0] + math.nan, box[1]), ValueError, r"latitudes \(nan, nan\) of box 0"),
        ((planets, first, box[0], box[1] + math.inf), ValueError, r"longitudes \(inf, inf\) of box 0"),
        ((planets, first, f64(0, 10, 80, 91).view(2, 2), box[1]), ValueError, r"latitudes \(80\.0, 91\.0\) of box 1"),
        ((planets, first, box[0], f64(0, 10, 0, 361).view(2, 2)), ValueError, r"longitudes \(0\.0, 361\.0\) of box 1"),
        ((planets, first, box[0][:1], box[1]), ValueError, r"\(1, 2\) and \(2, 2\)"),
        ((planets, first[:0], box[0][:0], box[1][:0]), ValueError, r"K >= 1"),
    ):
        with pytest.raises(error, match=message):
            FieldBank.build(*arguments)
    for options in ({"degree": 0}, {"tolerance_nt": 0.0}, {"tolerance_nt": math.nan}):
        with pytest.raises(ValueError, match=next(iter(options))):
            FieldBank.build(planets, first, *box, **options)
