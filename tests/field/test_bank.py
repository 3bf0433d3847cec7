"""A bank of regional expansions is each of its planets in its own box."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from support.field_checks import f64
from torch import Tensor

from magrl.field import FieldBank, RegionalField, SphericalHarmonicField, igrf_coefficients, random_planets

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
        torch.testing.assert_close(found, expected, rtol=0, atol=ROUNDING_NT)


@pytest.mark.parametrize(("degree", "error_nt"), [(5, 0.01), (12, 0.0)])
def test_a_bank_of_one_is_the_region(degree: int, error_nt: float) -> None:
    """With the same values, gradients, coefficients and error."""
    earth, box = igrf_coefficients("2022-01-01", 13), ((-15.5, 5.5), (154.5, 175.5))
    options = {"degree": degree, "tolerance_nt": 10.0}
    region = RegionalField(SphericalHarmonicField(earth), *box, **options)
    edges = (f64(*x).unsqueeze(0) for x in box)
    bank = FieldBank.build(earth.unsqueeze(0), torch.tensor([0]), *edges, **options)
    place = torch.meshgrid(torch.linspace(-15.5, 5.5, 31), torch.linspace(154.5, 175.5, 29), indexing="ij")
    index = torch.zeros(31, 29, dtype=torch.int64)
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
    planets, planet = random_planets(70, seed=2, degree=4), torch.arange(150) % 70
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
    with pytest.raises(ValueError, match="must hold 1 boxes, as expansion, got 2"):
        FieldBank(expansion, *boxes(f64(0, 10), f64(0, 10)))
    with pytest.raises(ValueError, match=r"shape \(K, 3, n, n\) .* got \(1, 2, 2, 2\)"):
        FieldBank(expansion[:, 1:], *boxes(f64(0), f64(0)))


def test_an_index_out_of_range_raises(bank: FieldBank) -> None:
    with pytest.raises(ValueError, match=r"index 6 is not in \[0, 6\)"):
        bank(f64(0.0, 0.0), f64(175.0, 175.0), torch.tensor([0, 6]))
    with pytest.raises(TypeError, match=r"index must be int64, got torch\.float32"):
        bank.value_and_gradient(f64(0.0), f64(175.0), torch.tensor([0.0]))


def test_an_error_above_the_tolerance_names_the_worst_box(planets: Tensor) -> None:
    latitude, longitude = boxes(f64(0, -30, 20), f64(0, 160, 40), 10.0, 10.0)
    latitude[1, 1] = 30.0
    message = (
        r"degree 8 misses the field by \S+ nT in box 1, of planet 2, .*\(-30\.0, 30\.0\).*\(160\.0, 170\.0\).*0\.01 nT"
    )
    with pytest.raises(ValueError, match=message):
        FieldBank.build(planets, torch.tensor([0, 2, 1]), latitude, longitude, degree=8, tolerance_nt=0.01)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gauss": torch.zeros(4, 4, dtype=torch.complex64)}, r"gauss .*\(P, N \+ 1, N \+ 1\).* got \(4, 4\)"),
        ({"planet_index": torch.tensor([0, -1])}, r"planet_index -1 is not in \[0, 3\)"),
        ({"planet_index": torch.tensor([0])}, r"planet_index .*\(2,\).* got \(1,\)"),
        ({"latitude": f64(0, 10, 10, -91).view(2, 2)}, r"latitudes \(10\.0, -91\.0\) of box 1 must rise"),
        ({"longitude": f64(0, math.inf, 0, 9).view(2, 2)}, r"longitudes of box 0 .*\(0\.0, inf\)"),
        ({"latitude": f64(0, 10).view(1, 2)}, r"\(1, 2\) and \(2, 2\)"),
        ({"degree": 0}, "degree .* got 0"),
        ({"tolerance_nt": 0.0}, "tolerance_nt .* got 0"),
    ],
)
def test_bad_planets_and_boxes_raise(changes: dict, message: str, planets: Tensor) -> None:
    latitude, longitude = boxes(f64(0, 10), f64(0, 10))
    good = {"gauss": planets, "planet_index": torch.tensor([0, 0]), "latitude": latitude, "longitude": longitude}
    with pytest.raises((TypeError, ValueError), match=message):
        FieldBank.build(**good | changes)


def test_grids_have_the_values_of_their_positions(planets: Tensor) -> None:
    bank = FieldBank.build(planets, PLANET, *BOXES)
    units = f64(-1.0, 0.3, 1.0), f64(0.9, -0.2, 1.0)
    latitude, longitude = (torch.lerp(*ends.split(1, 1), (1 + x) / 2) for ends, x in zip(BOXES, units, strict=True))
    grids = torch.stack(torch.broadcast_tensors(latitude.unsqueeze(2), longitude.unsqueeze(1) - 360), -1)
    expected = bank.value_and_gradient(grids[..., 0], grids[..., 1], torch.arange(len(bank)).reshape(-1, 1, 1))
    for found, exact in zip(bank.on_grids(grids), expected, strict=True):
        torch.testing.assert_close(found, exact, rtol=1e-9, atol=1e-9)
