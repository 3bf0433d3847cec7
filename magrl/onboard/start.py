"""What a vehicle knows at the start, and first readings and fixes that do not fit it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from magrl.checks import check_number, check_numbers
from magrl.field.elements import element_difference, field_vector, measured_elements
from magrl.field.igrf import parse_date
from magrl.geodesy import REFERENCE_RADIUS_KM, geodesic
from magrl.onboard.journal import Fix, Journal, Triple
from magrl.onboard.limits import check_earth_reading
from magrl.onboard.mistakes import deviation, likely_mistake, model_std
from magrl.pilot import Reading, Rules, earth_model
from magrl.pilot.anomalies import recentered, reweighed
from magrl.pilot.belief import Innovation, moved, updated
from magrl.pilot.earth import NEWEST, EarthModel
from magrl.pilot.planning import SLOPES
from magrl.pilot.records import State
from magrl.pilot.step import position_fix
from magrl.sensor_std import SensorStd

ANTIPODE_KM = 150.0
"""Distance from the antipode of a vehicle within which a destination may have no unique geodesic [km]."""
LEAST_TAIL = 0.01
"""Tail probability below which a first reading does not fit the start. Most of it is of large anomalies, which are
rare: of 144 right starts, none was below it, nor of 144 in the field of a crust."""


def known_elements(given: Sequence[float], name: str, model: EarthModel | None) -> tuple[Triple, Triple]:
    """Return the elements of a place and their standard deviations, given the elements, which are exact, or its
    latitude and longitude [deg].

    Args:
        given: D [deg], I [deg], B_H [nT]; or latitude and longitude, at which they follow from a model with the
            accuracy of :func:`~magrl.onboard.mistakes.model_std`.
        name: name of the place in messages.
        model: model of the Earth; None without a date.

    Raises:
        ValueError: for other than two or three numbers, elements that are not possible on the Earth, or a place without
            a model.

    Example:
        >>> elements, std = known_elements((60.4, 5.3), "here", earth_model("IGRF-14", "2026-06-30"))
        >>> [round(value, 1) for value in elements], [round(value, 2) for value in std]
        ([2.8, 73.1, 15002.9], [0.44, 0.2, 133.0])
    """
    if len(given) not in (2, 3):
        raise ValueError(f"{name} must be D, I and B_H, or latitude and longitude, got {tuple(given)}")
    check_numbers(len(given), **{name: given})
    if len(given) == 3:
        declination, inclination, intensity = given
        check_earth_reading(declination, inclination, intensity, what=f"the {name}")
        return (declination, inclination, intensity), (0.0, 0.0, 0.0)
    if model is None:
        raise ValueError(
            f"{name} {tuple(given)} is a place, which needs a model of the Earth: give the date of the flight"
        )
    check_number(-90, 90, latitude=given[0])
    check_number(-360, 360, longitude=given[1])
    elements = model.elements(_f64(given))
    (declination, inclination, intensity), (d, i, h) = torch.stack((elements, model_std(elements))).tolist()
    return (declination, inclination, intensity), (d, i, h)


def known_at_start(journal: Journal, place: Tensor | None = None) -> tuple[Rules, Reading]:
    """Return the rules of a vehicle, and the template of its readings, which holds what it knows at the start.

    A step replaces ``field``, ``distance``, ``heading``, ``step`` and ``leg_std`` of the template, and the noise of an
    element that was not read.

    Args:
        journal: what is given at the start.
        place: where the vehicle is, if that is another place than the one given.

    Raises:
        ValueError: for a place without a model, elements that are not possible on the Earth, or a destination about
            the antipode.
    """
    options, model = journal.options, _carried_model(journal)
    target, target_std = _destination(journal, model)
    rules: dict[str, Any] = {name: getattr(options, name) for name in Rules.model_fields}
    rules |= {"model": model, "target_std": target_std}
    places: dict[str, Tensor] = {}
    if len(journal.start or ()) == 2:
        rules["start_km"], places["place"] = journal.start_km, _f64(journal.start)
    if places and len(journal.target) == 2:
        rules["target_km"], places["target_place"] = journal.target_km, _f64(journal.target)
        rules["target_std"] = None if journal.target_elements is None else target_std
        latitude, longitude = places["place"] if place is None else place
        if geodesic(-latitude, longitude + 180, *places["target_place"])[0] < ANTIPODE_KM:
            raise ValueError(f"target {journal.target} is nearly the antipode of the vehicle's place: choose another")
    rows = torch.tensor([target, *_start(journal, model)], dtype=torch.float32)
    if options.magnetic:
        rows[:2, 0] = 0.0
    std, zero = SensorStd(*map(_f64, options.accuracy)), torch.tensor(0.0)
    there, *known = rows
    return Rules(**rules), Reading(there, there, zero, zero, std, torch.tensor(0), *known, **places)


def _f64(values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _start(journal: Journal, model: EarthModel | None) -> list[Triple]:
    """Return the elements at the start and their standard deviations, if they are known."""
    if journal.start_std is not None:
        check_numbers(3, 0, start_std=journal.start_std)
    if journal.start is None:
        return []
    elements, std = known_elements(journal.start, "start", model)
    d, i, h = journal.start_std or std
    if len(journal.start) == 2:
        d, i, h = (math.hypot(own, slope * journal.start_km) for own, slope in zip((d, i, h), SLOPES, strict=True))
    return [elements, (d, i, h)]


def _destination(journal: Journal, model: EarthModel | None) -> tuple[Triple, Triple]:
    """Return the elements of the destination and their standard deviations; they count as measured where given."""
    target, std = known_elements(journal.target, "target", model)
    measured, stated, by_place = journal.target_elements, journal.target_std, len(journal.target) == 2
    if by_place and measured is None:
        if stated is not None:
            raise ValueError(f"target_std {stated} needs the target_elements that have these errors")
        return target, std
    if stated is None:
        raise ValueError(
            "elements of a target need target_std, their errors with the field of the crust there, such as "
            "(0.1, 0.05, 30), or (0, 0, 0) where they are exact"
        )
    if measured is None:
        return at_flight_altitude(journal, target, journal.target_altitude_km, None), stated
    if not by_place:
        raise ValueError(f"target_elements {measured} need the place of the target, got {journal.target}")
    measured, _ = known_elements(measured, "target_elements", None)
    measured = at_flight_altitude(journal, measured, journal.target_altitude_km, _f64(journal.target))
    assert model is not None
    _check_measured((measured, target), (stated, std), model.error_nt, journal.options.magnetic)
    return measured, stated


def _check_measured(elements: Sequence[Triple], std: Sequence[Triple], error_nt: float, magnetic: bool) -> None:
    """Raise unless measured elements are possible at their place, by those of a model with an error.

    Raises:
        ValueError: with the element that does not fit, and the mistake that would explain it, if one is known.
    """
    read, there = _f64(elements)
    if magnetic:  # D is not measured
        read[..., 0] = there[..., 0]
    level, total = there[..., 2], field_vector(there).norm(dim=-1)
    shift = torch.stack((torch.rad2deg(error_nt / level), torch.rad2deg(error_nt / total), error_nt + 0 * level), -1)
    most = torch.cat((shift.unsqueeze(0), _f64(std))).norm(dim=0)
    if text := deviation(read, there, most):
        cause = likely_mistake(read, there, most)
        cause = cause or "check elements and place, or state a larger target_std"
        given, modeled = map(_text, elements)
        raise ValueError(f"target_elements {given} do not fit the target, {modeled} by the model ({text}): {cause}")


def _text(elements: Sequence[float]) -> str:
    return "D {:g}, I {:g}, B_H {:g}".format(*elements)


def _carried_model(journal: Journal) -> EarthModel | None:
    """Return the model of the Earth that a vehicle carries; without a date, the default is none."""
    if journal.date is None:
        if journal.model not in (None, NEWEST):
            raise ValueError(f"model {journal.model!r} needs the date of the flight, such as '2026-06-30', got None")
        return None
    parse_date(journal.date)
    return earth_model(journal.model, journal.date, journal.altitude_km) if journal.model is not None else None


def at_flight_altitude(journal: Journal, elements: Triple, altitude_km: float | None, place: Tensor | None) -> Triple:
    """Return elements that were read at an altitude as they are at the altitude of the flight.

    They differ as by the model of the Earth at a known place, else as the field of a dipole, which is proportional to
    r^-3.

    Args:
        journal: with model and altitude of the flight.
        elements: D, I [deg], B_H [nT].
        altitude_km: altitude of the reading above the ellipsoid [km]; None for that of the flight.
        place: ``(2,)`` latitude, longitude [deg], NaN where unknown; or None.
    """
    if altitude_km is None or altitude_km == journal.altitude_km:
        return elements
    model, (d, i, h) = _carried_model(journal), elements
    if model is None or place is None or place.isnan().any():
        return d, i, h * ((REFERENCE_RADIUS_KM + altitude_km) / (REFERENCE_RADIUS_KM + journal.altitude_km)) ** 3
    field: Any = model.field  # of the Earth, at any altitude
    flight, there = (measured_elements(field(*place, km)) for km in (journal.altitude_km, altitude_km))
    d, i, h = (_f64(elements) + element_difference(flight, there)).tolist()
    return d, i, h


def check_first_reading(reading: Reading, tail: float = 1.0) -> None:
    """Raise unless the first reading fits the elements at the start, where they are known.

    Args:
        reading: the first one.
        tail: probability of a reading that is more surprising, by the model of the Earth and all that is stated.

    Raises:
        ValueError: with the element that does not fit, and the mistake that would explain it, if one is known.

    Example:
        >>> here, zero, exact = torch.tensor([3.5, 73.0, 15000.0]), torch.tensor(0.0), torch.zeros(3)
        >>> std = SensorStd(exact, torch.tensor([0.5, 0.1, 50.0]))
        >>> reading = Reading(here, here, zero, zero, std, zero, here, exact)
        >>> check_first_reading(reading)
        >>> check_first_reading(reading._replace(field=torch.tensor([3.4, -73.1, 14950.0])))
        Traceback (most recent call last):
        ValueError: the first reading, D 3.4, I -73.1, B_H 14950, does not fit the start, D 3.5, I 73, B_H 15000 (I \
deviates by 146.1, where 0.612 is likely): it fits with -I: the vertical axis points up, and down is expected
    """
    if reading.known is None or reading.known_std is None:
        return
    read, there = reading.field.double(), reading.known.double()
    std = torch.stack((reading.std.noise, reading.std.bias, reading.known_std.double())).norm(dim=0)
    text = deviation(read, there, std)
    if text is None and tail >= LEAST_TAIL:
        return
    cause = likely_mistake(read, there, std) if text else None
    cause = cause or "check sensors, calibration, compass and place, state a larger error, or read again"
    text = text or f"p = {tail:.1g} by what is stated"
    first, start = (_text(row.tolist()) for row in (read, there))
    raise ValueError(f"the first reading, {first}, does not fit the start, {start} ({text}): {cause}")


def at_rest(rules: Rules, states: State, drift_km: Tensor) -> State:
    """Return the states ``(K, ...)`` of a vehicle that has drifted at rest as over a distance ``()`` [km]."""
    still = torch.zeros_like(states.log_weight[..., :1])
    mean, covariance, _ = moved(states.beliefs, still, still, motion=rules.motion._replace(drift_km=drift_km))
    return states._replace(mean=mean, covariance=covariance)


FIX_SQUARE = 13.8
"""Normalized square of the deviation of a fix in two axes that right ones exceed with a probability of .001."""


def fixed(states: State, fix: Fix) -> tuple[State, Tensor]:
    """Return states ``(K, ...)`` after a fix of the position, and its evidence ``(K,)``.

    Raises:
        ValueError: for a fix that does not fit the place that the first estimates.
    """
    place = _f64((fix.latitude, fix.longitude))
    new = Innovation(*(part[0] for part in position_fix(states.belief, place, fix.std_km)))
    off_km, likely_km = new.residual.norm().item(), new.covariance[:2, :2].trace().sqrt().item()
    if not new.square().item() <= FIX_SQUARE:  # NaN at the antipode
        raise ValueError(
            f"the fix is {off_km:.0f} km from the estimated place, where {likely_km:.0f} km is likely: check the fix, "
            "or state a larger std_km"
        )
    new = position_fix(states.beliefs, place, fix.std_km)
    log_weight, evidence = reweighed(states.log_weight, new)
    mean, covariance, place = recentered(updated(states.beliefs, new), log_weight)
    states = states._replace(mean=mean, covariance=covariance, place=place.squeeze(-2), log_weight=log_weight)
    return states, evidence
