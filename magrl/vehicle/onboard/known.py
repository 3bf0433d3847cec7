"""Elements that are known at a place, and readings that do not fit them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from magrl.checks import check_number, check_numbers
from magrl.field.elements import FIELD_NT, NAMES, element_difference, field_vector, measured_elements
from magrl.field.igrf import parse_date
from magrl.sensor_std import SensorStd
from magrl.tracking import NEWEST, SLOPES, EarthModel, State, earth_model
from magrl.tracking.anomalies import recentered, reweighed
from magrl.tracking.belief import updated
from magrl.tracking.pilot import position_fix
from magrl.vehicle.onboard.journal import Fix, Journal
from magrl.vehicle.onboard.limits import check_earth_reading

MODEL_STD = (0.26, 0.20, 133.0)
"""Standard deviations of D [deg], I [deg], B_H [nT] of a model of the core, which omits crust and currents.

To D, ``MODEL_D_NT / B_H`` degrees are added in squares. Source: the error model of the World Magnetic Model
2025 (technical report, NOAA NCEI and British Geological Survey, 2024).
"""
MODEL_D_NT = 5417.0
MOST_SIGMAS = 5.0
"""Deviation of a first reading beyond which it does not fit the known elements, in standard deviations."""
SLACK_NT = 100.0
"""Deviation of the field vector that always fits; chosen [nT]."""
LEAST_TAIL = 0.01
"""Tail probability below which a first reading does not fit the start. Most of it is of large anomalies, which are
rare: of 144 right starts, none was below it, nor of 144 in the field of a crust."""
IRON_NT = 2000.0
"""Standard deviation of the iron of a vehicle along each of its axes, before a calibration; chosen [nT]."""
IRON_COST = 15.0
"""What iron must explain more, as a sum of squared standard deviations, since it can take any value; chosen."""

Elements = tuple[float, float, float]


class Known(NamedTuple):
    """Elements of a place, their standard deviations, and latitude and longitude [deg] from which they follow."""

    elements: Elements
    std: Elements
    place: Tensor | None


def known_elements(given: Sequence[float], name: str, model: Callable[[Tensor], Tensor] | None) -> Known:
    """Return what is known of a place, given its elements, which are exact, or its latitude and longitude [deg].

    Args:
        given: D [deg], I [deg], B_H [nT]; or latitude and longitude, at which they follow from a model with the
            accuracy of :func:`model_std`.
        name: name of the place in messages.
        model: elements ``(3,)`` of the model at a place ``(2,)``; None without a date.

    Raises:
        ValueError: for other than two or three numbers, elements that are not possible on the Earth, or a place without
            a model.

    Example:
        >>> known = known_elements((60.4, 5.3), "here", earth_model("IGRF-14", "2026-06-30").elements)
        >>> [round(value, 1) for value in known.elements], [round(value, 2) for value in known.std]
        ([2.8, 73.1, 15002.9], [0.44, 0.2, 133.0])
    """
    if len(given) not in (2, 3):
        raise ValueError(f"{name} must be D, I and B_H, or latitude and longitude, got {tuple(given)}")
    check_numbers(len(given), **{name: given})
    if len(given) == 3:
        declination, inclination, intensity = map(float, given)
        check_earth_reading(declination, inclination, intensity, what=f"the {name}")
        return Known((declination, inclination, intensity), (0.0, 0.0, 0.0), None)
    if model is None:
        raise ValueError(
            f"{name} {tuple(given)} is a place, which needs a model of the Earth: give the date of the flight"
        )
    check_number(-90, 90, latitude=given[0])
    check_number(-360, 360, longitude=given[1])
    place = torch.tensor(given, dtype=torch.float64)
    declination, inclination, intensity = model(place).tolist()
    elements = declination, inclination, intensity
    d, i, h = model_std(torch.tensor(elements, dtype=torch.float64)).tolist()
    return Known(elements, (d, i, h), place)


class Knowledge(NamedTuple):
    """What a vehicle knows when it starts.

    Attributes:
        target: elements of the destination.
        elements: elements at the start, and their standard deviations ``std``; None where they are not known.
        rules: values of :class:`~magrl.tracking.Rules`: the model of the Earth, and the errors of the places.
        place: latitude and longitude of the start [deg], and ``target_place`` of the destination; None where a
            vehicle does not use them.
    """

    target: Elements
    elements: Elements | None
    std: Elements
    rules: dict[str, Any]
    place: Tensor | None = None
    target_place: Tensor | None = None

    @classmethod
    def of(cls, journal: Journal) -> Knowledge:
        """Return what the arguments of :meth:`~magrl.vehicle.onboard.Onboard.start` tell.

        Raises:
            ValueError: for a place without a model, or elements that are not possible on the Earth.
        """
        model = _carried_model(journal)
        elements_of = None if model is None else model.elements
        target = _destination(journal, model)
        start = None if journal.start is None else known_elements(journal.start, "start", elements_of)
        elements, std = (start.elements, start.std) if start else (None, (0.0,) * 3)
        if journal.start_std is not None:
            check_numbers(3, 0, start_std=journal.start_std)
            std = journal.start_std
        rules: dict[str, Any] = {"target_std": target.std} | ({} if model is None else {"model": model})
        if start is None or start.place is None:
            return cls(target.elements, elements, std, rules)
        d, i, h = (math.hypot(own, slope * journal.start_km) for own, slope in zip(std, SLOPES, strict=True))
        rules |= {"start_km": journal.start_km} | ({} if target.place is None else {"target_km": journal.target_km})
        if journal.target_elements is None and target.place is not None:
            rules["target_std"] = None
        return cls(target.elements, elements, (d, i, h), rules, start.place, target.place)


def _destination(journal: Journal, model: EarthModel | None) -> Known:
    """Return what is known of the destination, whose elements count as measured where they are given."""
    target = known_elements(journal.target, "target", None if model is None else model.elements)
    measured = journal.target_elements
    if measured is None and target.place is None:
        return target._replace(std=journal.target_std or target.std)
    if measured is None:
        if journal.target_std is not None:
            raise ValueError(f"target_std {journal.target_std} needs the target_elements that have these errors")
        return target
    if target.place is None:
        raise ValueError(f"target_elements {measured} need the place of the target, got {journal.target}")
    if journal.target_std is None:
        raise ValueError(
            "target_elements need target_std, their errors with the field of the crust there, such as (0.2, 0.1, 60)"
        )
    given = known_elements(measured, "target_elements", None)._replace(std=journal.target_std, place=target.place)
    assert model is not None
    _check_measured(given, target, model.error_nt, journal.options.magnetic)
    return given


def _check_measured(given: Known, modeled: Known, error_nt: float, magnetic: bool) -> None:
    """Raise unless measured elements are possible at their place, by a model with an error.

    Raises:
        ValueError: with the element that does not fit, and the mistake that would explain it, if one is known.
    """
    read, there = torch.tensor([[given.elements], [modeled.elements]], dtype=torch.float64)
    if magnetic:  # D is not measured
        read[..., 0] = there[..., 0]
    level, total = there[..., 2], field_vector(there).norm(dim=-1)
    shift = torch.stack((torch.rad2deg(error_nt / level), torch.rad2deg(error_nt / total), error_nt + 0 * level), -1)
    std = torch.cat((shift, torch.tensor([given.std, modeled.std], dtype=torch.float64))).norm(dim=0)
    if text := deviation(read, there, std)[0]:
        texts = [
            f"D {values[0]:g}, I {values[1]:g}, B_H {values[2]:g}" for values in (given.elements, modeled.elements)
        ]
        cause = likely_mistake(read, there, std, torch.zeros(1).double())
        cause = cause or "check elements and place, or state a larger target_std"
        raise ValueError(f"target_elements {texts[0]} do not fit the target, {texts[1]} by the model ({text}): {cause}")


def _carried_model(journal: Journal) -> EarthModel | None:
    """Return the model of the Earth that a vehicle carries; without a date, the default is none."""
    if journal.date is None:
        if journal.model not in (None, NEWEST):
            raise ValueError(f"model {journal.model!r} needs the date of the flight, such as '2026-06-30', got None")
        return None
    parse_date(journal.date)
    return earth_model(journal.model, journal.date, journal.altitude_km) if journal.model is not None else None


def check_first_reading(
    reading: Elements, elements: Elements, sensor_std: SensorStd, elements_std: Sequence[float], tail: float = 1.0
) -> None:
    """Raise unless the first reading fits the elements at the start.

    Args:
        reading: D [deg], I [deg], B_H [nT].
        elements: D, I, B_H at the start.
        sensor_std: accuracy of the sensors.
        elements_std: standard deviations of the elements.
        tail: probability of a reading that is more surprising, by the model of the Earth and all that is stated.

    Raises:
        ValueError: with the element that does not fit, and the mistake that would explain it, if one is known.

    Example:
        >>> sensors, exact = SensorStd(bias=(0.5, 0.1, 50.0)), (0.0, 0.0, 0.0)
        >>> check_first_reading((3.4, 73.1, 14950.0), (3.5, 73.0, 15000.0), sensors, exact)
        >>> check_first_reading((3.4, -73.1, 14950.0), (3.5, 73.0, 15000.0), sensors, exact)
        Traceback (most recent call last):
        ValueError: the first reading, D 3.4, I -73.1, B_H 14950, does not fit the start, D 3.5, I 73, B_H 15000 (I \
deviates by 146.1, where 0.612 is likely): it fits with -I: the vertical axis points up, and down is expected
    """
    read, there = torch.tensor([[reading], [elements]], dtype=torch.float64)
    parts = torch.tensor([sensor_std.noise, sensor_std.bias, elements_std], dtype=torch.float64)
    std = parts.norm(dim=0)
    text = deviation(read, there, std)[0]
    if text is None and tail >= LEAST_TAIL:
        return
    texts = [f"D {values[0]:g}, I {values[1]:g}, B_H {values[2]:g}" for values in (reading, elements)]
    cause = likely_mistake(read, there, std, torch.zeros(1).double()) if text else None
    cause = cause or "check sensors, calibration, compass and place, state a larger error, or read again"
    text = text or f"p = {tail:.1g} by what is stated"
    raise ValueError(f"the first reading, {texts[0]}, does not fit the start, {texts[1]} ({text}): {cause}")


FIX_SQUARE = 13.8
"""Normalized square of the deviation of a fix in two axes that right ones exceed with a probability of .001."""


def fixed(state: State, fix: Fix) -> State:
    """Return the state after a fix of the position.

    Raises:
        ValueError: for a fix that does not fit the estimated place.
    """
    place = torch.tensor((fix.latitude, fix.longitude), dtype=torch.float64)
    new = position_fix(state.belief, place, fix.std_km)
    off_km, likely_km = new.residual.norm().item(), new.covariance[:2, :2].trace().sqrt().item()
    if new.square().item() > FIX_SQUARE:
        raise ValueError(
            f"the fix is {off_km:.0f} km from the estimated place, where {likely_km:.0f} km is likely: check the fix, "
            "or state a larger std_km"
        )
    new = position_fix(state.beliefs, place, fix.std_km)
    log_weight = reweighed(state.log_weight, new)
    mean, covariance, place = recentered(updated(state.beliefs, new), log_weight)
    return state._replace(mean=mean, covariance=covariance, place=place.squeeze(-2), log_weight=log_weight)


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


def likely_mistake(elements: Tensor, expected: Tensor, std: Tensor, heading_deg: Tensor) -> str | None:
    """Return the mistake that explains most of some readings, better than others and than iron; None without one.

    Iron is a constant vector in the vehicle's axes, whose standard deviation is :data:`IRON_NT`.

    Args:
        elements: ``(N, 3)`` D [deg], I [deg], B_H [nT].
        expected: ``(N, 3)`` the elements at their places.
        std: ``(..., 3)`` standard deviations of the difference.
        heading_deg: ``(N,)`` headings.

    Example:
        >>> there = torch.tensor([[3.5, 73.0, 15000.0]]).double()
        >>> read = torch.tensor([[3.4, -73.1, 14950.0]]).double()
        >>> likely_mistake(read, there, torch.tensor([0.5, 0.1, 50.0]), torch.zeros(1).double())
        'it fits with -I: the vertical axis points up, and down is expected'
    """
    iron, rest = _iron(elements, expected, heading_deg)
    guesses = _mistakes(elements, expected, heading_deg) | {"": rest}
    costs = {"": math.inf}
    for text, read in guesses.items():
        shares = element_difference(read, expected) / _most(expected, std)
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
