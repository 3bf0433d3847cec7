"""Readings beside IGRF at known positions: how far they deviate, and the mistakes that would explain it."""

from __future__ import annotations

import math

import torch
from pandas import DataFrame
from torch import Tensor

from magrl.field import IGRF
from magrl.field.elements import NAMES, element_difference, measured_elements
from magrl.geodesy import geodesic
from magrl.sensor_std import OUTAGE_STD
from magrl.vehicle.onboard.known import deviation, likely_mistake, model_std

MOST_SPIKES = 0.2
"""Share of readings up to which those that do not fit are spikes, and not a mistake in all; chosen."""
MOST_DRIFT, LEAST_TURN_DEG = 0.25, 20.0
"""Share of a distance and angle of a course that currents explain; chosen."""
_PLACE = "latitude", "longitude", "altitude"


def difference_from_igrf(readings: DataFrame, date: str) -> Tensor:
    """Return D [deg], I [deg], B_H [nT] of readings minus those of IGRF at their positions, ``(N, 3)``.

    Args:
        readings: columns D, I, B_H, latitude, longitude, and optionally altitude [km].
        date: date for IGRF.

    Example:
        >>> import pandas
        >>> row = {"D": [2.8], "I": [73.1], "B_H": [15003.0], "latitude": [60.4], "longitude": [5.3]}
        >>> difference_from_igrf(pandas.DataFrame(row), "2026-06-30").round(decimals=1)
        tensor([[-0.0000, 0.0000, 0.1000]], dtype=torch.float64)
    """
    return element_difference(_columns(readings, *NAMES), _igrf_elements(_places(readings), date))


def mistakes(readings: DataFrame, date: str | None = None) -> list[str]:
    """Return the likely mistakes in a log with positions, as sentences; none where it fits.

    Readings are compared with IGRF, within the accuracy of a model of the core
    (:data:`~magrl.vehicle.onboard.known.MODEL_STD`), and moves with the positions.

    Args:
        readings: columns of :func:`~magrl.vehicle.logs.readings_of`. Where D is not measured (``D_std``), it converts
            the headings.
        date: date for IGRF; without it, moves alone are compared.

    Example:
        >>> import pandas
        >>> row = {"D": 2.8, "I": -73.1, "B_H": 15003.0, "latitude": 60.4, "longitude": 5.3}
        >>> mistakes(pandas.DataFrame([row | {"heading": 0.0, "distance": 0.0}] * 2), "2026-06-30")[0][-66:]
        'it fits with -I: the vertical axis points up, and down is expected'
    """
    if "latitude" not in readings or "longitude" not in readings:
        return []
    place = _places(readings)
    elements = _columns(readings, *NAMES)
    expected = elements if date is None else _igrf_elements(place, date)
    texts = [] if date is None else _field_mistakes(readings, expected)
    if not _measured(readings):
        readings = readings.assign(heading=readings["heading"] + (expected - elements)[:, 0].numpy())
    return texts + _move_mistakes(readings, place[:, :2], expected[:, 0])


def _columns(readings: DataFrame, *names: str) -> Tensor:
    return torch.tensor(readings[list(names)].to_numpy(float).copy())


def _places(readings: DataFrame) -> Tensor:
    """Return latitude, longitude [deg] and altitude [km] ``(N, 3)``; sea level where it is not known."""
    return _columns(readings.assign(**{} if "altitude" in readings else {"altitude": 0.0}), *_PLACE)


def _igrf_elements(place: Tensor, date: str) -> Tensor:
    return measured_elements(IGRF(date)(*place.unbind(-1)))


# Readings


def _field_mistakes(readings: DataFrame, expected: Tensor) -> list[str]:
    """Return which readings do not fit IGRF at their positions, and why."""
    elements, std = _columns(readings, *NAMES), model_std(expected)
    if not _measured(readings):
        elements[:, 0], std[:, 0] = expected[:, 0], OUTAGE_STD
    deviations = deviation(elements, expected, std)
    wrong = torch.tensor([text is not None for text in deviations])
    if not wrong.any():
        return []
    row = int(wrong.nonzero()[0])
    start = f"{int(wrong.sum())} of {len(wrong)} readings do not fit IGRF, from row {row + 1} on ({deviations[row]})"
    if wrong.double().mean() <= MOST_SPIKES:
        return [f"{start}: spikes, or iron near the vehicle there"]
    heading = _columns(readings, "heading")[wrong, 0]
    cause = likely_mistake(elements[wrong], expected[wrong], std[wrong], heading)
    return [f"{start}: {cause or 'no calibration, iron near the sensor, or a heading that is wrong'}"]


def _measured(readings: DataFrame) -> bool:
    """Return whether D was measured, which otherwise tells where the north of the headings is."""
    return "D_std" not in readings or bool((readings["D_std"] < OUTAGE_STD).any())


# Moves


def _move_mistakes(readings: DataFrame, place: Tensor, declination: Tensor) -> list[str]:
    """Return the likely mistakes in the unit of the distances and in the north of the headings."""
    distance, bearing = geodesic(*place[:-1].unbind(-1), *place[1:].unbind(-1))
    moved, heading = _columns(readings, "distance", "heading")[1:].unbind(-1)
    going = (distance > 0) & (moved > 0)
    if not going.any():
        return []
    texts, ratio = [], float((distance[going] / moved[going]).median())
    if abs(ratio - 1) > MOST_DRIFT:
        far = f"the positions are {ratio:.3g} times as far apart as the distances of the moves"
        texts.append(f"{far}: check the log and its unit")
    turn, east = torch.rad2deg(bearing[going]) - heading[going], declination[1:][going]
    course = torch.deg2rad(turn)
    drift = math.degrees(torch.atan2(course.sin().mean(), course.cos().mean()).item())
    drifts, left = ((angle + 180).remainder(360).sub(180).square().mean().sqrt() for angle in (turn, turn - east))
    text = f"the course between positions is {drift:.0f} deg to the right of the heading"
    if abs(abs(drift) - 180) < LEAST_TURN_DEG:
        texts.append(f"{text}: the heading is reciprocal, or the vehicle goes astern")
    elif drifts > 3 and left < drifts / 3:
        north = f"as D is {east.median():.0f} deg: the heading is from magnetic north, and true north is expected"
        texts.append(f"{text}, {north}")
    elif abs(drift) > LEAST_TURN_DEG:
        texts.append(f"{text}: check the compass and its axes")
    return texts
