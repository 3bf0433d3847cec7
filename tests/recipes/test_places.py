"""Places on Earth, from coordinates as people write them."""

import pytest
import torch
from places import check_declination, parse_coordinates, region_around

from magrl.envs import Regions
from magrl.field import IGRF


@pytest.fixture(scope="module")
def field() -> IGRF:
    return IGRF("2025-01-01")


def place(*degrees: float) -> torch.Tensor:
    return torch.tensor(degrees, dtype=torch.float64)


def test_coordinates() -> None:
    for text, expected in (
        ("60.4N 5.3E", (60.4, 5.3)),
        ("60.4, 5.3", (60.4, 5.3)),
        ("-33.9 18.4", (-33.9, 18.4)),
        (" 33.9s,18.4w ", (-33.9, -18.4)),
        ("60.4° N, 5.3° E", (60.4, 5.3)),
        ("0 200", (0, -160)),
        ("1N,181E", (1, -179)),
    ):
        assert parse_coordinates(text).tolist() == pytest.approx(expected, abs=1e-12)


def test_texts_that_are_no_place() -> None:
    """Long ones took minutes: the time of the expression grew with powers of the length."""
    wrong = "60.4", "60.4N", "5.3E 60.4N", "60.4N5.3E7", "nan 3", "-3N 4", "91 0", "0 361", "58°58'N 5°44'E"
    for text in ("Bergen", *wrong, "1" * 30_000 + "x", "1" + " " * 30_000 + "x", "1'" * 15_000):
        with pytest.raises(ValueError, match=r"(must have|must be) .{10,150}$"):
            parse_coordinates(text)


def test_region_around_two_places(field) -> None:
    honolulu, tokyo = place(21.3, -157.9), place(35.7, 139.7)
    box = region_around(honolulu, tokyo, field)
    assert box.longitude[1] - box.longitude[0] < 150  # across the antimeridian, not around the Earth
    assert Regions.of(box).contains(torch.stack((honolulu, tokyo, place(28, 180)))).all()
    assert not Regions.of(box).contains(place(28, 0))
    # The margin is reduced where D jumps: that of half the distance, 9.9 degrees, would hold the pole of the field.
    assert 76 < region_around(place(76, 100), place(60, 140), field).latitude[1] < 85
    with pytest.raises(ValueError, match="the declination jumps"):
        region_around(place(85, 120), place(87, 160), field)


def test_declination_near_the_poles(field) -> None:
    for there in ((86.0, 140.0), (-64.0, 136.0), (89.5, 0.0)):
        with pytest.raises(ValueError, match="the declination is hardly defined at 'there', where BH is"):
            check_declination("there", place(*there), field)
