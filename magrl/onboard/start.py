"""Start at a known place: the elements there, and a first reading that does not fit them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from magrl.checks import check_number, check_numbers
from magrl.field import IGRF, elements_at
from magrl.field.elements import element_difference
from magrl.geodesy import move
from magrl.onboard.readings import DISTURBANCE_NT, check_earth_distance, check_earth_reading
from magrl.sensor_std import SensorStd
from magrl.transforms import calibration

MODEL_STD = (0.26, 0.20, 133.0)
"""Standard deviations of D [deg], I [deg], B_H [nT] of a model of the core, which omits crust and currents.

To that of D, ``MODEL_D_NT / B_H`` degrees are added in squares. Source: the error model of the World Magnetic Model
2025 (technical report, NOAA NCEI and British Geological Survey, 2024).
"""
MODEL_D_NT = 5417.0
MOST_SIGMAS = 5.0
"""Deviation of a first reading beyond which it does not fit the known elements, in standard deviations."""
SLACK_NT = 100.0
"""Deviation of the field vector that always fits; chosen [nT]."""
NEAR_KM = 200.0
"""Largest distance from the start to its assumed place; chosen [km]."""

Elements = tuple[float, float, float]
Values = tuple[float, ...]


def known_elements(
    here: Sequence[float], std: Sequence[float] | None = None, date: str | None = None
) -> tuple[Elements, Elements]:
    """Return the elements at a known place, and their standard deviations.

    Args:
        here: D [deg], I [deg], B_H [nT], which are exact by default; or latitude and longitude [deg], at which they
            follow from IGRF, by default with the accuracy :data:`MODEL_STD`.
        std: standard deviations of the elements.
        date: date for IGRF, such as ``"2026-06-30"``.

    Raises:
        ValueError: for other than two or three numbers, elements that are not possible on the Earth, or a date that is
            missing or not needed.

    Example:
        >>> elements, std = known_elements((60.4, 5.3), date="2026-06-30")
        >>> [round(value, 1) for value in elements], [round(value, 2) for value in std]
        ([2.8, 73.1, 15002.9], [0.44, 0.2, 133.0])
    """
    if len(here) not in (2, 3):
        raise ValueError(f"here must be D, I and B_H, or latitude and longitude, got {here!r}")
    check_numbers(len(here), here=here)
    if (date is None) == (len(here) == 2):
        rule = "a latitude and longitude need a date" if date is None else "elements need no date"
        raise ValueError(f"here {tuple(here)}: {rule}, got date {date!r}")
    if date is None:
        elements, usual = (float(here[0]), float(here[1]), float(here[2])), (0.0, 0.0, 0.0)
    else:
        check_number(-90, 90, latitude=here[0])
        check_number(-360, 360, longitude=here[1])
        declination, inclination, intensity = elements_at(IGRF(date), torch.tensor(here, dtype=torch.float64)).tolist()
        elements = declination, inclination, intensity
        usual = math.hypot(MODEL_STD[0], MODEL_D_NT / elements[2]), *MODEL_STD[1:]
    check_earth_reading(*elements, what="here")
    if std is not None:
        check_numbers(3, 0, here_std=std)
    return elements, usual if std is None else (std[0], std[1], std[2])


def nearby_elements(
    near: Sequence[float], date: str | None, target: Elements, most_km: float
) -> tuple[Elements, Values]:
    """Return the elements at the assumed place of a vehicle, and their standard deviations at its true place.

    :data:`MOST_SIGMAS` of these are the largest change over :data:`NEAR_KM` plus a crust of
    :data:`~magrl.onboard.readings.DISTURBANCE_NT`.

    Args:
        near: latitude and longitude [deg].
        date: date for IGRF.
        target: elements of the destination.
        most_km: longest way [km].

    Raises:
        ValueError: for a place that is not on the Earth, no date, or a target that is too far.

    Example:
        >>> elements, std = nearby_elements((60.4, 5.3), "2026-06-30", (3.5, 73.0, 15000.0), 2500.0)
        >>> [round(5 * value, 1) for value in std]
        [9.2, 3.4, 2843.7]
    """
    elements, _ = known_elements(near, date=date)
    check_earth_distance(elements, target, most_km)
    bearing = torch.arange(0, 360, 45, dtype=torch.float64).deg2rad()
    latitude, longitude, distance = (torch.full_like(bearing, value) for value in (*near, NEAR_KM))
    ring = torch.stack(move(latitude, longitude, bearing, distance), -1)
    change = element_difference(elements_at(IGRF(str(date)), ring), torch.tensor(elements).double()).abs().amax(0)
    horizontal, total = elements[2], elements[2] / math.cos(math.radians(elements[1]))
    crust = math.degrees(DISTURBANCE_NT / horizontal), math.degrees(DISTURBANCE_NT / total), DISTURBANCE_NT
    return elements, tuple((core + local) / MOST_SIGMAS for core, local in zip(change.tolist(), crust, strict=True))


def calibrated(
    elements: Elements, elements_std: Elements, sensor_std: SensorStd, reading: Elements | None = None
) -> tuple[Values, SensorStd]:
    """Return the constant error of the readings, and the accuracy of the sensors without it.

    Args:
        elements: D [deg], I [deg], B_H [nT] at the start.
        elements_std: their standard deviations.
        sensor_std: accuracy of the sensors.
        reading: first reading; without it the error is unknown, and 0 is returned.

    Raises:
        ValueError: for a reading that does not fit the start; see :func:`check_start`.

    Example:
        >>> sensors = SensorStd(bias=(0.5, 0.1, 20.0), drift=(0.3, 0.0, 0.0))
        >>> error, left = calibrated((3.5, 73.0, 15000.0), (0.0, 0.0, 0.0), sensors, (4.0, 73.0, 15000.0))
        >>> round(error[0], 2), round(left.bias[0], 2)
        (0.32, 0.38)
    """
    if reading is not None:
        check_start(reading, elements, sensor_std, elements_std)
    rows = elements if reading is None else reading, elements, elements_std, *sensor_std
    first, there, there_std, *std = torch.tensor(rows, dtype=torch.float64)
    error, left = calibration(first, there, SensorStd(*std), there_std)
    return tuple(error.tolist()), sensor_std._replace(bias=tuple(left.bias.tolist()))


def check_start(reading: Elements, elements: Elements, sensor_std: SensorStd, elements_std: Sequence[float]) -> None:
    """Raise unless the first reading fits the elements at the start.

    Args:
        reading: D [deg], I [deg], B_H [nT].
        elements: D, I, B_H at the start.
        sensor_std: accuracy of the sensors.
        elements_std: standard deviations of the elements.

    Raises:
        ValueError: with the element that does not fit, and the mistake that would explain it, if one is known.

    Example:
        >>> sensors, exact = SensorStd(bias=(0.5, 0.1, 50.0)), (0.0, 0.0, 0.0)
        >>> check_start((3.4, 73.1, 14950.0), (3.5, 73.0, 15000.0), sensors, exact)
        >>> check_start((3.4, -73.1, 14950.0), (3.5, 73.0, 15000.0), sensors, exact)
        Traceback (most recent call last):
        ValueError: the first reading, D 3.4, I -73.1, B_H 14950, does not fit the start, D 3.5, I 73, B_H 15000 (I \
deviates by 146.1, where 0.612 is likely): it fits with -I: the vertical axis points up, and down is expected
    """
    std = [math.hypot(*parts) for parts in zip(sensor_std.noise, sensor_std.bias, elements_std, strict=True)]
    if deviation := misfit(reading, elements, std):
        texts: list[Any] = [f"D {values[0]:g}, I {values[1]:g}, B_H {values[2]:g}" for values in (reading, elements)]
        cause = deviation[1] or "check sensors, calibration, compass and place, or state a larger bias"
        raise ValueError(f"the first reading, {texts[0]}, does not fit the start, {texts[1]} ({deviation[0]}): {cause}")


def misfit(reading: Elements, expected: Elements, std: Sequence[float]) -> tuple[str, str | None] | None:
    """Return how a reading deviates from expected elements, and the mistake that would explain it; None if it fits.

    Args:
        reading: D [deg], I [deg], B_H [nT].
        expected: the elements at its place.
        std: standard deviations of the difference.

    Example:
        >>> misfit((3.4, -73.1, 14950.0), (3.5, 73.0, 15000.0), (0.5, 0.1, 50.0))[1]
        'it fits with -I: the vertical axis points up, and down is expected'
    """
    total = math.hypot(expected[2], expected[2] * math.tan(math.radians(expected[1])))
    slack = math.degrees(SLACK_NT / max(expected[2], SLACK_NT)), math.degrees(SLACK_NT / total), SLACK_NT
    most = tuple(MOST_SIGMAS * s + margin for s, margin in zip(std, slack, strict=True))

    def misfit(elements: Sequence[float]) -> list[float]:
        difference = [value - reference for value, reference in zip(elements, expected, strict=True)]
        difference[0] = math.remainder(difference[0], 360)
        return [abs(value) for value in difference]

    def fits(elements: Sequence[float]) -> bool:
        return all(value <= limit for value, limit in zip(misfit(elements), most, strict=True))

    if fits(reading):
        return None
    index, deviation = max(enumerate(misfit(reading)), key=lambda item: item[1] / most[item[0]])
    causes = [text for text, elements in _mistakes(*reading, declination_there=expected[0]) if fits(elements)]
    text = f"{('D', 'I', 'B_H')[index]} deviates by {deviation:.4g}, where {most[index]:.3g} is likely"
    return text, causes[0] if causes else None


def _mistakes(d: float, i: float, b: float, *, declination_there: float) -> list[tuple[str, Elements]]:
    """Return mistakes, and what the reading would be without each of them."""
    degrees_d, degrees_i = math.degrees(d), math.degrees(i)
    return [
        ("it fits with -I: the vertical axis points up, and down is expected", (d, -i, b)),
        ("it fits with -D: D is positive where magnetic north is east of true north", (-d, i, b)),
        ("it fits with -D and -I: the axes point left and up, and right and down are expected", (-d, -i, b)),
        ("it fits in radians, and degrees are expected", (degrees_d, degrees_i, b)),
        ("I fits in radians, and degrees are expected", (d, degrees_i, b)),
        ("D fits in radians, and degrees are expected", (degrees_d, i, b)),
        ("D and I are swapped", (i, d, b)),
        ("it fits with D + 180: the horizontal axes point backward", (d + 180, i, b)),
        ("it fits with 90 - D: the horizontal axes are swapped", (90 - d, i, b)),
        ("B_H is the total intensity: the horizontal one is expected", (d, i, b * math.cos(math.radians(i)))),
        ("D is 0: the heading is from magnetic north, and true north is expected", (d + declination_there, i, b)),
    ]
