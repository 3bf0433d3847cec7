"""Start at a known place: the elements there, and a first reading that does not fit them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from magrl.checks import check_number, check_numbers
from magrl.field import IGRF, elements_at
from magrl.field.elements import FIELD_NT, NAMES, element_difference, field_vector, measured_elements
from magrl.geodesy import move
from magrl.sensor_std import SensorStd
from magrl.transforms import calibration
from magrl.vehicle.onboard.readings import DISTURBANCE_NT, check_earth_distance, check_earth_reading

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
IRON_NT = 2000.0
"""Standard deviation of the iron of a vehicle along each of its axes, before a calibration; chosen [nT]."""
IRON_COST = 15.0
"""What iron must explain more, as a sum of squared standard deviations, since it can take any value; chosen."""
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
        usual = tuple(model_std(torch.tensor(elements, dtype=torch.float64)).tolist())
    check_earth_reading(*elements, what="here")
    if std is not None:
        check_numbers(3, 0, here_std=std)
    return elements, usual if std is None else (std[0], std[1], std[2])


def nearby_elements(
    near: Sequence[float], date: str | None, target: Elements, most_km: float
) -> tuple[Elements, Values]:
    """Return the elements at the assumed place of a vehicle, and their standard deviations at its true place.

    :data:`MOST_SIGMAS` of these are the largest change over :data:`NEAR_KM` plus a crust of
    :data:`~magrl.vehicle.onboard.readings.DISTURBANCE_NT`.

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
    read, there = torch.tensor([[reading], [elements]], dtype=torch.float64)
    parts = torch.tensor([sensor_std.noise, sensor_std.bias, elements_std], dtype=torch.float64)
    std = parts.norm(dim=0)
    text = deviation(read, there, std)[0]
    if text is None:
        return
    texts = [f"D {values[0]:g}, I {values[1]:g}, B_H {values[2]:g}" for values in (reading, elements)]
    cause = likely_mistake(read, there, std, torch.zeros(1).double(), {})
    cause = cause or "check sensors, calibration, compass and place, or state a larger bias"
    raise ValueError(f"the first reading, {texts[0]}, does not fit the start, {texts[1]} ({text}): {cause}")


def model_std(elements: Tensor) -> Tensor:
    """Return the standard deviations of D [deg], I [deg], B_H [nT] of a model of the core ``(..., 3)``.

    Args:
        elements: ``(..., 3)`` elements of the model.

    Example:
        >>> model_std(torch.tensor([3.5, 73.0, 15000.0]))
        tensor([  0.4450,   0.2000, 133.0000])
    """
    std = elements.new_tensor(MODEL_STD).expand_as(elements)
    return torch.hypot(std, torch.nn.functional.pad(MODEL_D_NT / elements[..., 2:], (0, 2)))


def _most(expected: Tensor, std: Tensor) -> Tensor:
    """Return the largest deviations from expected elements that are likely ``(..., 3)``."""
    strength = torch.stack((expected[..., 2].clamp_min(SLACK_NT), field_vector(expected).norm(dim=-1)), -1)
    slack = torch.cat((torch.rad2deg(SLACK_NT / strength), torch.full_like(strength[..., :1], SLACK_NT)), -1)
    return MOST_SIGMAS * std + slack


def deviation(elements: Tensor, expected: Tensor, std: Tensor) -> list[str | None]:
    """Return how each reading deviates from expected elements, as text; None for one that fits.

    Args:
        elements: ``(N, 3)`` D [deg], I [deg], B_H [nT].
        expected: ``(N, 3)`` the elements at their places.
        std: ``(..., 3)`` standard deviations of the difference.

    Example:
        >>> deviation(torch.tensor([[3.4, -73.1, 14950.0]]), torch.tensor([[3.5, 73.0, 15000.0]]), torch.zeros(3))
        ['I deviates by 146.1, where 0.112 is likely']
    """
    off, most = element_difference(elements, expected).abs(), _most(expected, std)
    worst = (off / most).max(-1)
    rows = zip(worst.values.tolist(), worst.indices.tolist(), off.tolist(), most.tolist(), strict=True)
    return [
        f"{NAMES[k]} deviates by {values[k]:.4g}, where {limits[k]:.3g} is likely" if share > 1 else None
        for share, k, values, limits in rows
    ]


def likely_mistake(
    elements: Tensor, expected: Tensor, std: Tensor, heading_deg: Tensor, others: Mapping[str, Tensor]
) -> str | None:
    """Return the mistake that explains most of some readings, better than others and than iron; None without one.

    Iron is a constant vector in the vehicle's axes, whose standard deviation is :data:`IRON_NT`.

    Args:
        elements: ``(N, 3)`` D [deg], I [deg], B_H [nT].
        expected: ``(N, 3)`` the elements at their places.
        std: ``(..., 3)`` standard deviations of the difference.
        heading_deg: ``(N,)`` headings.
        others: elements at other places, by a text that says what is then wrong with the places.

    Example:
        >>> there = torch.tensor([[3.5, 73.0, 15000.0]]).double()
        >>> read = torch.tensor([[3.4, -73.1, 14950.0]]).double()
        >>> likely_mistake(read, there, torch.tensor([0.5, 0.1, 50.0]), torch.zeros(1).double(), {})
        'it fits with -I: the vertical axis points up, and down is expected'
    """
    iron, rest = _iron(elements, expected, heading_deg)
    guesses = {text: (read, expected) for text, read in _mistakes(elements, expected, heading_deg).items()}
    guesses |= {text: (elements, there) for text, there in others.items()} | {"": (rest, expected)}
    costs = {"": math.inf}
    for text, (read, there) in guesses.items():
        shares = element_difference(read, there) / _most(there, std)
        if (shares.abs() <= 1).all(-1).double().mean() > 0.5:  # others may be spikes, whose squares are limited
            costs[text] = MOST_SIGMAS**2 * shares.square().sum(-1).clamp_max(3.0).sum().item()
    costs[""] += IRON_COST + (iron / IRON_NT).square().sum().item()
    return min(costs, key=lambda text: costs[text]) or None


def _iron(elements: Tensor, expected: Tensor, heading_deg: Tensor) -> tuple[Tensor, Tensor]:
    """Return the iron in the vehicle's axes [nT] that explains readings best, and the elements without it."""
    cos, sin = torch.cos(torch.deg2rad(heading_deg)), torch.sin(torch.deg2rad(heading_deg))
    none, read = torch.zeros_like(cos), field_vector(elements).unsqueeze(-1)
    turn = torch.stack((cos, -sin, none, sin, cos, none, none, none, none + 1), -1).unflatten(-1, (3, 3))
    iron = (turn.mT @ (read - field_vector(expected).unsqueeze(-1))).median(0).values
    return iron, measured_elements((read - turn @ iron).squeeze(-1))


def _mistakes(elements: Tensor, expected: Tensor, heading_deg: Tensor) -> dict[str, Tensor]:
    """Return what readings would be without each of the mistakes that engineers make."""
    d, i, b = elements.unbind(-1)
    wrong = {
        "it fits with -I: the vertical axis points up, and down is expected": (d, -i, b),
        "it fits with -D: D is positive where magnetic north is east of true north": (-d, i, b),
        "it fits with -D and -I: the axes point left and up, and right and down are expected": (-d, -i, b),
        "it fits in radians, and degrees are expected": (d.rad2deg(), i.rad2deg(), b),
        "I fits in radians, and degrees are expected": (d, i.rad2deg(), b),
        "D fits in radians, and degrees are expected": (d.rad2deg(), i, b),
        "the heading fits in radians, and degrees are expected": (d - heading_deg + heading_deg.rad2deg(), i, b),
        "D and I are swapped": (i, d, b),
        "it fits with D + 180: the horizontal axes point backward": (d + 180, i, b),
        "it fits with 90 - D: the horizontal axes are swapped": (90 - d, i, b),
        "B_H is the total intensity: the horizontal one is expected": (d, i, b * i.deg2rad().cos()),
        "D is 0: the heading is from magnetic north, and true north is expected": (d + expected[..., 0], i, b),
    }
    units = [(unit, factor) for unit, factor in FIELD_NT.items() if factor > 1]
    wrong |= {f"B_H looks like {unit}, and nanotesla are expected": (d, i, factor * b) for unit, factor in units}
    return {text: torch.stack(values, -1) for text, values in wrong.items()}
