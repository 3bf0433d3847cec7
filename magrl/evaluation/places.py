"""Places on Earth: from coordinates as people write them, or from the magnetic elements there."""

from __future__ import annotations

import math
import re

import torch
from torch import Tensor

from magrl.checks import short
from magrl.envs import Region, Regions
from magrl.envs.specs import field_bounds
from magrl.field import FieldModel, elements_at, elements_gradient_at
from magrl.field.elements import element_difference
from magrl.geodesy import geodesic, move, wrap_longitude
from magrl.navigators.base import displacement_to

ELEMENT_TOLERANCE = (0.25, 0.25, 100.0)
"""Tolerance of D, I [deg] and B_H [nT] between the elements of a place and the given ones: their change over about
25 km."""
LEAST_INTENSITY_NT = 2000.0
"""Lowest horizontal intensity of a place: nearer to a magnetic pole, the declination is hardly defined."""
_NUMBER = r"([+-]?\d+(?:\.\d*)?)"
_ANGLE = rf"{_NUMBER}\s*°?(?:\s*(\d+(?:\.\d*)?)\s*['′](?:\s*(\d+(?:\.\d*)?)\s*[\"″])?)?"
_COORDINATES = re.compile(rf"\s*{_ANGLE}\s*([NS])?\s*[\s,]\s*{_ANGLE}\s*([EW])?\s*", re.IGNORECASE)
_ELEMENTS = re.compile(rf"\s*D={_NUMBER}[\s,]+I={_NUMBER}[\s,]+BH={_NUMBER}\s*", re.IGNORECASE)


def parse_coordinates(text: str) -> Tensor:
    """Return the place that a text such as ``60.4N 5.3E``, ``60.4, 5.3``, ``-33.9 18.4`` or ``58°58'N 5°44'E`` names.

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
        raise ValueError(
            f"a place must be written such as '60.4N 5.3E', '-33.9 18.4' or \"58°58'N 5°44'E\", got {short(text)}"
        )
    values = []
    for number, minutes, seconds, letter in (match.group(1, 2, 3, 4), match.group(5, 6, 7, 8)):
        if letter and number[0] in "+-":
            raise ValueError(f"a coordinate must have a sign or a letter, not both, got {number}{letter} in {text!r}")
        size = abs(float(number)) + _sixtieths(minutes, text) + _sixtieths(seconds, text) / 60
        values.append(-size if number[0] == "-" or (letter or "").upper() in ("S", "W") else size)
    latitude, longitude = values
    if abs(latitude) > 90 or abs(longitude) > 360:
        raise ValueError(f"a latitude must be within 90 and a longitude within 360 degrees, got {text!r}")
    place = torch.tensor(values, dtype=torch.float64)
    return torch.stack((place[0], wrap_longitude(place[1])))


def _sixtieths(number: str | None, text: str) -> float:
    """Return minutes in degrees, or seconds in minutes; 0 for none."""
    if float(number or 0) >= 60:
        raise ValueError(f"minutes and seconds must be below 60, got {number} in {text!r}")
    return float(number or 0) / 60


def parse_elements(text: str) -> Tensor | None:
    """Return the magnetic elements that a text such as ``D=-3.2 I=71.5 BH=15000`` names, or None for another text.

    Returns:
        ``(3,)`` D [deg], I [deg], B_H [nT], float64.

    Raises:
        ValueError: for values that no field has.

    Example:
        >>> parse_elements("D=-3.2 I=71.5 BH=15000").tolist(), parse_elements("60.4N 5.3E")
        ([-3.2, 71.5, 15000.0], None)
    """
    match = _ELEMENTS.fullmatch(text)
    if not match:
        return None
    declination, inclination, intensity = (float(number) for number in match.groups())
    if abs(declination) > 180 or abs(inclination) > 90 or intensity <= 0:
        raise ValueError(f"D must be within 180 degrees, I within 90 degrees and BH above 0 nT, got {text!r}")
    return torch.tensor((declination, inclination, intensity), dtype=torch.float64)


def find_elements(field: FieldModel, elements: Tensor, near: Tensor) -> Tensor:
    """Return the place with some magnetic elements that is nearest to another place.

    Gauss-Newton iterations start from a grid over the whole Earth. Where they converge, a place counts if each element
    is within :data:`ELEMENT_TOLERANCE`: three elements that are rounded fit no place exactly.

    Args:
        field: field model of the whole Earth.
        elements: ``(3,)`` D [deg], I [deg], B_H [nT].
        near: ``(2,)`` latitude, longitude [deg].

    Returns:
        ``(2,)`` latitude, longitude [deg], float64.

    Raises:
        ValueError: if there is no such place, with the most similar elements.

    Example:
        >>> from magrl.field import IGRF
        >>> field, bergen = IGRF("2025-01-01"), torch.tensor([60.4, 5.3], dtype=torch.float64)
        >>> find_elements(field, elements_at(field, bergen), near=bergen + 10).round(decimals=3)
        tensor([60.4000,  5.3000], dtype=torch.float64)
    """
    scale = torch.tensor(ELEMENT_TOLERANCE, dtype=torch.float64)
    place = Regions.of(Region((-80, 80), (-180, 176))).grid(45).reshape(-1, 2)
    for _ in range(16):
        slopes = elements_gradient_at(field, place) / scale.unsqueeze(-1)
        north, east = displacement_to(_difference(field, elements, place) / scale, slopes).unbind(-1)
        length = torch.hypot(north, east).clamp(max=600.0)
        place = torch.stack(move(place[:, 0], place[:, 1], torch.atan2(east, north), length), -1)
    misfit = (_difference(field, elements, place) / scale).abs().amax(-1)
    misfit = torch.where(length < 1, misfit, torch.inf)  # the others have not converged
    distance, _ = geodesic(*near.double().expand_as(place).unbind(-1), *place.unbind(-1))
    if misfit.min() > 1:
        closest = elements_at(field, place[misfit.argmin()])
        wanted, least, nearest = (elements_text(values) for values in (elements, scale, closest))
        raise ValueError(
            f"no place has {wanted} within {least}: the most similar elements are {nearest}; take the elements of one "
            "place and date, or give the destination by its coordinates"
        )
    return place[torch.where(misfit <= 1, distance.nan_to_num(nan=1e5), torch.inf).argmin()]


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


def region_around(start: Tensor, target: Tensor, field: FieldModel, max_move_km: float = 50.0) -> Region:
    """Return a box around two places, with a margin of up to half their distance, where the declination is continuous.

    Args:
        start: ``(2,)`` latitude, longitude [deg].
        target: ``(2,)`` latitude, longitude [deg].
        field: field model.
        max_move_km: longest leg, which may lead out of the box [km].

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
            field_bounds(field, Regions.of(box).reachable(max_move_km))
        except ValueError:
            continue
        return box
    raise ValueError(
        "the declination jumps between start and destination, because a pole of the Earth or of its field is near: "
        "choose places farther away from the poles"
    )


def elements_text(elements: Tensor) -> str:
    """Return magnetic elements as :func:`parse_elements` reads them.

    Example:
        >>> elements_text(torch.tensor([-3.2, 71.5, 15000.0]))
        'D=-3.20 I=71.50 BH=15000'
    """
    return "D={:.2f} I={:.2f} BH={:.0f}".format(*elements.tolist())


def _difference(field: FieldModel, elements: Tensor, place: Tensor) -> Tensor:
    """Return elements minus those at places, with D by the shorter way around."""
    return element_difference(elements.double(), elements_at(field, place))
