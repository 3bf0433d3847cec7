"""Limits of the Earth's field, of a vehicle and of its sensors, for checks of plain numbers.

The limits of the field are from IGRF-14 at sea level, 1900 to 2030, on a grid of 1 by 2 degrees: a total intensity
of 21 900 to 69 400 nT, a horizontal intensity up to 41 900 nT, and a change of the vector of up to 16 nT/km between
75° S and 75° N and 63 nT/km up to 88°, where north turns along the path; B_H and B_Z alone change by up to 16.4 nT/km
anywhere. Where the inclination is within 1.6 degrees, the horizontal intensity is at least 24 100 nT and the gradient
of the inclination at least 1.5 degrees per 100 km. The checks leave room for the crust, magnetic storms, altitude and
errors of sensors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from typing import Any

from magrl.checks import check_number
from magrl.field.elements import FIELD_NT, NAMES, UNITS
from magrl.pilot.planning import MISSING_KM, SLOPES

TOTAL_NT = (20000.0, 76000.0)
"""Least and greatest total intensity: 10 % beyond IGRF [nT]."""
MOST_HORIZONTAL_NT = 44000.0
"""Greatest horizontal intensity: 2000 nT beyond IGRF [nT]."""
EQUATOR_NT = 22000.0
"""Least horizontal intensity where the inclination is within pi/2 degrees: 10 % below IGRF [nT]."""
EQUATOR_SLOPE_DEG = 0.5
"""Least gradient of the inclination where it is within pi/2 degrees: a third of IGRF's [deg per 100 km]."""
SLOPE_NT_KM = 60.0
"""Greatest change of the field vector along a path, up to 88 degrees of latitude [nT/km]."""
MERIDIAN_SLOPE_NT_KM = 16.4
"""Greatest change of B_H and B_Z, which do not depend on where north is, along a path [nT/km]."""
DISTURBANCE_NT = 2000.0
"""Change of the field vector between two readings by the crust and a severe magnetic storm; chosen [nT]."""
_SLACK_DEG = 1.0  # of an inclination
_SIGMAS = 8.0  # of the noise of a difference
LEAST_NT = 2000.0
"""Least B_H for an agent without a map: below, it fails more often (docs/results.md, the whole globe) [nT]."""
STUCK_KM = (100.0, 400.0)
"""Path without a change of any element, and of one element, after which a sensor counts as stuck, but at least 2 and 8
of the longest legs [km]; the first also without a complete reading before it is reported. Coarse readings of one
element can stay equal that long; chosen."""
ANYWHERE = ((-180.0, -90.0, 0.0), (180.0, 90.0, math.inf))
"""Least and greatest D [deg], I [deg], B_H [nT] of a reading."""
LEAST_LEG_STD_KM = 1.0
"""Error that any leg may have, beside its length [km]; chosen."""
LONGER = 1.1
"""A leg may be as many times as long as the longest one that is commanded."""

Triple = tuple[float, float, float]
Incomplete = tuple[float | None, float | None, float | None]


def check_earth_reading(
    declination: float, inclination: float, horizontal_intensity: float, what: str = "the reading"
) -> None:
    """Raise unless three elements are possible on the Earth.

    An inclination in radians is a small one in degrees. On the Earth, an inclination of at most pi/2 degrees comes with
    a strong horizontal field, so that most readings in radians are recognized, but not all: at 0.5 and 30000 nT both
    units are possible.

    Args:
        declination: D [deg], -180 to 180.
        inclination: I [deg], -90 to 90.
        horizontal_intensity: B_H [nT].
        what: context, at the start of the message.

    Raises:
        ValueError: naming the value, what is possible, and the unit that it probably has.

    Example:
        >>> check_earth_reading(3.5, 73.0, 15000.0)
        >>> check_earth_reading(3.5, 73.0, 15.0)
        Traceback (most recent call last):
        ValueError: the reading: horizontal_intensity 15 at an inclination of 73 deg is not possible on the Earth, \
where it is 5513 to 23485 nT there: it looks like microtesla, and nanotesla are expected
    """
    for name, value, least, most in (
        ("declination [deg]", declination, -180.0, 180.0),
        ("inclination [deg]", inclination, -90.0, 90.0),
        ("horizontal_intensity [nT]", horizontal_intensity, 0.0, math.inf),
    ):
        given: dict[str, Any] = {f"{what}: {name}": value}
        if isinstance(value, Real) and name == "declination [deg]" and 180 < value <= 360:
            raise ValueError(f"{what}: {name} must be from -180 up to 180, got {value:g}: give {value - 360:g}")
        check_number(least, most, **given)
    low, high = _horizontal_limits(abs(inclination))
    if low <= horizontal_intensity <= high:
        return
    units = [unit for unit, factor in FIELD_NT.items() if low <= factor * horizontal_intensity <= high]
    in_radians = abs(inclination) <= math.pi / 2 and abs(declination) <= math.pi
    least, most = _horizontal_limits(math.degrees(abs(inclination))) if in_radians else (math.inf, 0.0)
    guess = f": it looks like {units[0]}, and nanotesla are expected" if units else ""
    if least <= horizontal_intensity <= most:
        guess = ": the inclination looks like radians, and degrees are expected"
    raise ValueError(
        f"{what}: horizontal_intensity {horizontal_intensity:g} at an inclination of {inclination:g} deg is not "
        f"possible on the Earth, where it is {low:.0f} to {high:.0f} nT there{guess}"
    )


def _horizontal_limits(inclination: float) -> tuple[float, float]:
    """Return the least and the greatest horizontal intensity [nT] at the size of an inclination [deg]."""
    steep, flat = min(inclination + _SLACK_DEG, 90.0), max(inclination - _SLACK_DEG, 0.0)
    low = EQUATOR_NT if inclination <= math.pi / 2 else TOTAL_NT[0] * math.cos(math.radians(steep))
    return low, min(MOST_HORIZONTAL_NT, TOTAL_NT[1] * math.cos(math.radians(flat)))


def check_earth_distance(reading: Sequence[float], target: Sequence[float], most_km: float) -> None:
    """Raise if places with such elements are farther apart on the Earth than the longest distance.

    Args:
        reading: D [deg], I [deg], B_H [nT] at the start.
        target: the same at the destination.
        most_km: longest distance [km].

    Raises:
        ValueError: with the least distance.

    Example:
        >>> check_earth_distance((-7.7, -7.7, 40000.0), (3.3, 74.9, 13581.0), 2500.0)
        Traceback (most recent call last):
        ValueError: the reading at the start is at least 3639 km from the target, and the longest distance is 2500 km: \
check the target, and the axes, the units and the calibration of the sensors
    """
    here, there = ((b, b * math.tan(math.radians(i))) for _, i, b in (reading, target))  # B_H and B_Z
    least_km = (math.dist(here, there) - DISTURBANCE_NT) / MERIDIAN_SLOPE_NT_KM
    if not least_km <= most_km:
        raise ValueError(
            f"the reading at the start is at least {least_km:.0f} km from the target, and the longest distance is "
            f"{most_km:.0f} km: check the target, and the axes, the units and the calibration of the sensors"
        )


def check_earth_jump(
    before: Sequence[float], after: Sequence[float], distance_km: float, noise: Sequence[float] = (0.0, 0.0, 0.0)
) -> None:
    """Raise unless a leg can explain the change between two readings, up to 88 degrees of latitude.

    The change of each element is a change of the field vector of at least so many nanotesla. A leg changes the vector
    by at most :data:`SLOPE_NT_KM`, anything else by :data:`DISTURBANCE_NT`.

    Args:
        before: D [deg], I [deg], B_H [nT] before the leg.
        after: the same after it.
        distance_km: length of the leg [km].
        noise: standard deviations of the noise of a reading, in the same units.

    Raises:
        ValueError: naming the element, both values, and what a leg of this length can explain.

    Example:
        >>> check_earth_jump((3.5, 73.0, 15000.0), (4.0, 72.5, 15400.0), 50.0)
        >>> check_earth_jump((3.5, 40.0, 25000.0), (3.5, -40.0, 25000.0), 50.0)
        Traceback (most recent call last):
        ValueError: inclination changed from 40 to -40 deg over 50 km, by 41955 nT of the field vector; a leg of this \
length explains at most 5000 nT: the reading is wrong, or the distance is
    """
    horizontal = min(before[2], after[2])
    total = min(TOTAL_NT[1], *(b / max(math.cos(math.radians(i)), 1e-6) for _, i, b in (before, after)))
    radius = 2 * horizontal, 2 * total, 1.0
    noise_nt = math.radians(noise[0]) * horizontal, math.radians(noise[1]) * total, noise[2]
    for index, (name, unit) in enumerate((("declination", "deg"), ("inclination", "deg"), ("B_H", "nT"))):
        change = abs(after[index] - before[index])
        change = change if index == 2 else abs(math.sin(math.radians(change / 2)))
        most = DISTURBANCE_NT + SLOPE_NT_KM * distance_km + _SIGMAS * math.sqrt(2) * noise_nt[index]
        if not radius[index] * change <= most:
            raise ValueError(
                f"{name} changed from {before[index]:g} to {after[index]:g} {unit} over {distance_km:g} km, by "
                f"{radius[index] * change:.0f} nT of the field vector; a leg of this length explains at most "
                f"{most:.0f} nT: the reading is wrong, or the distance is"
            )


# The vehicle and its sensors


def check_leg(distance: float, distance_std: float, longest: float) -> None:
    """Raise unless a vehicle can have flown a leg and know its length so well.

    Args:
        distance: length of the leg [km].
        distance_std: its standard deviation [km].
        longest: longest leg that is commanded [km].

    Raises:
        ValueError: naming the value, the limit and the unit.

    Example:
        >>> check_leg(40.0, 500.0, 50.0)
        Traceback (most recent call last):
        ValueError: distance_std 500 km is more than a leg of 40 km allows, 41 km: it must be in kilometers
    """
    if not distance <= LONGER * longest:
        raise ValueError(
            f"distance {distance:g} km is longer than the longest leg of this vehicle, {longest:g} km: it must be in "
            "kilometers, and since the last step; report a longer distance in parts, with None between"
        )
    if not distance_std <= (most := distance + LEAST_LEG_STD_KM):
        raise ValueError(
            f"distance_std {distance_std:g} km is more than a leg of {distance:g} km allows, {most:g} km: it must be "
            "in kilometers"
        )


def out_of_range(limits: Sequence[Sequence[float]], elements: Sequence[float]) -> str:
    """Return which element is beyond the range that a navigator was trained or tested in; empty if none is.

    Args:
        limits: least and greatest D [deg], I [deg], B_H [nT].
        elements: D, I, B_H.

    Example:
        >>> out_of_range(((-180.0, -90.0, 2000.0), (180.0, 90.0, math.inf)), (0.0, 88.0, 1500.0))
        'B_H 1500 nT is out of the range of the navigator, 2000 to inf nT'
    """
    for name, unit, value, least, most in zip(NAMES, UNITS, elements, *limits, strict=True):
        if not least <= value <= most:
            return f"{name} {value:g} {unit} is out of the range of the navigator, {least:g} to {most:g} {unit}"
    return ""


def measured(std: Sequence[float]) -> tuple[bool, ...]:
    """Return which elements a vehicle measures: those whose standard deviation is less than their change over 1000 km.

    Args:
        std: standard deviations of the reading's noise: D [deg], I [deg], B_H [nT].

    Example:
        >>> measured((1e4, 0.02, 2.0))
        (False, True, True)
    """
    return tuple(value / slope < MISSING_KM for value, slope in zip(std, SLOPES, strict=True))


def unchanged_km(unchanged: Sequence[float], before: Sequence[float], after: Incomplete, leg_km: float) -> Triple:
    """Return the path since each element last changed ``(3,)`` [km], without legs that end without reading it.

    Args:
        unchanged: that path before the leg.
        before: D, I, B_H before the leg.
        after: the same after it; None for an element that was not read.
        leg_km: its length.

    Example:
        >>> unchanged_km((30.0, 30.0, 30.0), (3.5, 73.0, 15000.0), (3.5, 73.1, None), 20.0)
        (50.0, 0.0, 30.0)
    """
    first, second, third = (
        km if new is None else km + leg_km if new == old else 0.0
        for km, old, new in zip(unchanged, before, after, strict=True)
    )
    return first, second, third


def stuck(unchanged: Sequence[float], max_leg_km: float, useful: Sequence[bool], hung: Sequence[bool]) -> str:
    """Return which readings are from a stuck sensor, as text; empty if none is.

    Args:
        unchanged: from :func:`unchanged_km`.
        max_leg_km: longest leg.
        useful: which elements are measured.
        hung: which of them are not read any more: they end a flight only if all are stuck.

    Example:
        >>> stuck((450.0, 20.0, 0.0), 50.0, (True, True, False), (False, False, False))
        'no change of D over 400 km: a sensor is stuck'
    """
    every_km, one_km = (max(km, legs * max_leg_km) for km, legs in zip(STUCK_KM, (2, 8), strict=True))
    rows = list(zip(NAMES, unchanged, useful, hung, strict=True))
    every = min((km for _, km, use, _ in rows if use), default=0.0) >= every_km
    least_km = every_km if every else one_km
    names = [name for name, km, use, off in rows if use and km >= least_km and (every or not off)]
    return f"no change of {', '.join(names)} over {least_km:.0f} km: a sensor is stuck" if names else ""


def in_radians(inclination: float, slope: float) -> str:
    """Return that an inclination looks like radians, as text; empty if it does not.

    Args:
        inclination: as read.
        slope: largest likely size of its gradient [1/km].

    Example:
        >>> in_radians(1.2, 0.0001)
        'inclination 1.2 hardly changes: it looks like radians; degrees are expected'
    """
    if abs(inclination) > math.pi / 2 or 100 * slope >= EQUATOR_SLOPE_DEG:
        return ""
    return f"inclination {inclination:g} hardly changes: it looks like radians; degrees are expected"
