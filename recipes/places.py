"""Places on Earth, from coordinates as people write them, and the regions that hold them."""

from __future__ import annotations

import math
import re

from magrl.checks import short
from magrl.envs import Region, Regions
from magrl.envs.specs import field_bounds
from magrl.field import FieldModel, elements_at
from magrl.geodesy import geodesic, wrap_longitude

import torch
from torch import Tensor

LEAST_INTENSITY_NT = 2000.0
"""Lowest horizontal intensity of a place: nearer to a magnetic pole, the declination is hardly defined."""
_ANGLE = r"([+-]?\d+(?:\.\d*)?)\s*°?"
_COORDINATES = re.compile(rf"\s*{_ANGLE}\s*([NS])?\s*[\s,]\s*{_ANGLE}\s*([EW])?\s*", re.IGNORECASE)


def parse_coordinates(text: str) -> Tensor:
    """Return the place that a text such as ``60.4N 5.3E``, ``60.4, 5.3`` or ``-33.9 18.4`` names.

    Returns:
        ``(2,)`` latitude, longitude [deg], float64, the longitude in (-180, 180].

    Raises:
        ValueError: for another text, or coordinates that are not on Earth.

    Example:
        >>> parse_coordinates("33.9S 18.4E")
        tensor([-33.9000,  18.4000], dtype=torch.float64)
    """
    match = _COORDINATES.fullmatch(" ".join(text.split())) if len(text) < 100 else None  # its time grows with length³
    if not match:
        raise ValueError(f"a place must be written such as '60.4N 5.3E' or '-33.9 18.4', got {short(text)}")
    values = []
    for number, letter in (match.group(1, 2), match.group(3, 4)):
        if letter and number[0] in "+-":
            raise ValueError(f"a coordinate must have a sign or a letter, not both, got {number}{letter} in {text!r}")
        values.append(-float(number) if (letter or "").upper() in ("S", "W") else float(number))
    latitude, longitude = values
    if abs(latitude) > 90 or abs(longitude) > 360:
        raise ValueError(f"a latitude must be within 90 and a longitude within 360 degrees, got {text!r}")
    place = torch.tensor(values, dtype=torch.float64)
    return torch.stack((place[0], wrap_longitude(place[1])))


def check_declination(text: str, place: Tensor, field: FieldModel) -> None:
    """Raise unless the declination is well defined at a place.

    Args:
        text: the place in messages.
        place: ``(2,)`` latitude, longitude [deg].
        field: field model.

    Raises:
        ValueError: beyond 89 degrees of latitude, or where B_H is below :data:`LEAST_INTENSITY_NT`.

    Example:
        >>> from magrl.field import IGRF
        >>> check_declination("Bergen", torch.tensor([60.4, 5.3]), IGRF("2025-01-01"))
    """
    intensity = elements_at(field, place)[2].item()
    if abs(place[0].item()) > 89 or not intensity >= LEAST_INTENSITY_NT:
        raise ValueError(
            f"the declination is hardly defined at {text!r}, where BH is {intensity:.0f} nT: choose a place within "
            f"89 degrees of latitude with at least {LEAST_INTENSITY_NT:.0f} nT"
        )


def region_around(start: Tensor, target: Tensor, field: FieldModel, max_leg_km: float = 50.0) -> Region:
    """Return a box around two places, with a margin of up to half their distance, where the declination is continuous.

    Args:
        start: ``(2,)`` latitude, longitude [deg].
        target: ``(2,)`` latitude, longitude [deg].
        field: field model.
        max_leg_km: longest leg, which may lead out of the box [km].

    Raises:
        ValueError: if the declination jumps between them.

    Example:
        >>> from magrl.field import IGRF
        >>> tokyo, honolulu = torch.tensor([[35.7, 139.7], [21.3, -157.9]], dtype=torch.float64)
        >>> box = region_around(honolulu, tokyo, IGRF("2025-01-01"))
        >>> Regions.of(box).contains(torch.tensor([30.0, 180.0]))
        tensor([True])
    """
    distance_km = geodesic(*start, *target)[0].item()
    (south, north), west = sorted((start[0].item(), target[0].item())), start[1].item()
    west, east = sorted((west, west + wrap_longitude(target[1] - start[1]).item()))
    for share in (0.5, 0.35, 0.25, 0.15, 0.1, 0.05):
        margin = max(share * distance_km / 111, 2.0)
        aside = min(margin / math.cos(math.radians((south + north) / 2)), (360 - (east - west)) / 2)
        box = Region((max(south - margin, -89.0), min(north + margin, 89.0)), (west - aside, east + aside))
        try:
            field_bounds(field, Regions.of(box).reachable(max_leg_km))
        except ValueError:
            continue
        return box
    raise ValueError(
        "the declination jumps between start and destination, because a pole of the Earth or of its field is near: "
        "choose places farther away from the poles"
    )
