"""Readings of a recorded flight: a table of them, and the mistakes that IGRF and positions show in it."""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas
import torch
from numpy.typing import NDArray
from pandas import DataFrame, Series
from torch import Tensor

from magrl.checks import short
from magrl.field import IGRF
from magrl.field.elements import FIELD_NT, NAMES, element_difference, measured_elements
from magrl.files import numbers, read_table, read_text
from magrl.geodesy import geodesic
from magrl.sensor_std import OUTAGE_STD
from magrl.vehicle.mistakes import deviation, likely_mistake, model_std

Array = NDArray[np.float64]

SYMBOLS = {"nt": "nanotesla", "mg": "milligauss", "ut": "microtesla", "μt": "microtesla", "g": "gauss"}
SYMBOLS |= {"mt": "millitesla", "t": "tesla"}
UNITS: Mapping[str, Mapping[str, float]] = {
    "field": FIELD_NT | {symbol: FIELD_NT[unit] for symbol, unit in SYMBOLS.items()},
    "angle": {"deg": 1.0, "rad": 57.29577951308232, "degrees": 1.0, "radians": 57.29577951308232},
    "length": {"km": 1.0, "m": 1e-3, "nmi": 1.852, "ft": 3.048e-4},
    "speed": {"m_s": 1.0, "km_h": 1 / 3.6, "kn": 1.852 / 3.6},
}
"""Suffixes of a column, in the first unit of each kind: nanotesla, degrees, kilometers, meters per second."""
_FORM = "columns are separated by commas, decimals have a point"
_ANY, _ROUNDING = (-math.inf, math.inf), 1e-3
COLUMNS: Mapping[str, tuple[str, float, float]] = {
    "B_H": ("field", *_ANY),
    "heading": ("angle", -360, 360),
    "distance": ("length", 0, 40000),
    "speed": ("speed", 0, 1000),
    "latitude": ("angle", -90, 90),
    "longitude": ("angle", -360, 360),
    "altitude": ("length", *IGRF.altitude_range_km),
}
"""Columns that are no unlimited angle: kind of the unit, the least and the greatest value."""
MAX_SPEED, ORBITAL_SPEED, SPACE_KM = 1000.0, 1e4, 100.0
"""Speed that no vehicle exceeds, and no satellite, which is above an altitude [m/s, m/s, km]."""
MAX_CURRENT = 3.0
"""Speed that no ocean current exceeds [m/s]; winds are less than half of an airspeed."""
_EPOCH = 1e8  # seconds: a time beyond is since 1970, one before since the log began

MOST_SPIKES = 0.2
"""Share of readings up to which those that do not fit are spikes, and not a mistake in all; chosen."""
MOST_DRIFT, LEAST_TURN_DEG = 0.25, 20.0
"""Share of a distance and angle of a course that currents explain, also an error that no compass has; chosen."""
_PLACE = "latitude", "longitude", "altitude"
NAMED = {key: key for key in (*NAMES, "heading", "distance", "speed", *_PLACE)}
"""Columns of a file by what they are."""


def read_readings(path: Path | str, names: Mapping[str, str] | None = None, time: str = "time") -> DataFrame:
    """Return the readings of a CSV file with a header, one for each leg.

    Args:
        path: the file.
        names: its columns that have other names, by ``D``, ``I``, ``B_H``, ``heading``, and ``distance``, or
            ``speed`` beside a time; and optionally ``latitude`` and ``longitude``, and ``altitude``, which the file may
            lack. A unit that ends a name counts, such as of ``H_uT``, and a name is also found with one, such as
            ``altitude_m``; without one, it is nT, deg, km or m/s.
        time: its column of the time, seconds or ISO 8601, which it may lack.

    Returns:
        Columns of these names, ``row``, the number of each in the file, and ``time``; without rows that repeat the time
        of the row before. ``attrs`` has the ``notes`` on the times, and their ``date``.

    Raises:
        ValueError: for a file that cannot be read, a missing column, a value that is not a number or not possible,
            times that run backward, or legs whose :func:`speeds <check_speeds>` are not possible.

    Example:
        >>> read_readings("nowhere.csv", {})
        Traceback (most recent call last):
        ValueError: cannot read nowhere.csv: [Errno 2] No such file or directory: 'nowhere.csv'
    """
    try:
        raw = read_table(read_text(Path(path)), dtype=str)
        log = DataFrame(
            {"row": np.arange(len(raw)) + 1} | _columns(raw, {**NAMED, **(names or {})})
        )  # the header is not counted
        if len(log) < 2:
            raise ValueError("it must hold at least two rows")
        log.attrs = {"notes": [], "date": None}
        if time in raw:
            times = times_of(raw[time])
            new = new_times(times)
            log.insert(1, "time", raw[time])
            log = log[new].reset_index(drop=True)
            left = int((~new).sum())
            notes = [f"{left} rows with the time of the row before left out"] if left else []
            log.attrs = {"notes": notes, "date": date_of(float(times[0]))}
            step_s = np.diff(times[new], prepend=times[0])
            if "distance" not in log:
                log["distance"] = log["speed"] * step_s / 1000
            check_speeds(log, step_s)
        elif "distance" not in log:
            raise ValueError(f"speeds need a column {time!r} of times, in seconds or ISO 8601")
    except (OSError, ValueError) as error:
        raise ValueError(f"cannot read {path}: {error}") from error
    return log


def _columns(raw: DataFrame, names: Mapping[str, str]) -> dict[str, Array]:
    """Return the columns of readings by their keys."""
    columns, located = {}, any(names.get(key) in raw for key in ("latitude", "longitude"))
    for key, name in names.items():
        kind = COLUMNS.get(key, ("angle",))[0]
        others = {f"{name}_{unit}".lower() for unit in UNITS[kind]}
        name = next((other for other in raw if name not in raw and other.lower() in others), name)
        if name in raw:
            columns[key] = (unit_of(name, kind) or 1.0) * numbers(raw[name].fillna(""))
            check_range(key, columns[key])
        elif key in ("D", "I", "B_H", "heading") or (located and key in _PLACE[:2]):
            raise ValueError(f"no column is {name!r}: name the column of {key}, one of {short([*raw], 300)}; {_FORM}")
    if "distance" in names and not columns.keys() & {"distance", "speed"}:
        raise ValueError(
            f"no column is the distance or the speed of the legs: name one of {short([*raw], 300)}; {_FORM}"
        )
    return columns


def unit_of(header: str, kind: str) -> float | None:
    """Return the unit that ends a header, as a factor to the first one of its kind; None where none does.

    Example:
        >>> unit_of("alt_km", "length"), unit_of("dip_rad", "angle"), unit_of("altitude", "length")
        (1.0, 57.29577951308232, None)
    """
    name = header.lower()
    return next((size for unit, size in UNITS[kind].items() if name.endswith(f"_{unit}")), None)


def check_range(name: str, values: Array) -> None:
    """Raise unless all values of a column are possible.

    Args:
        name: one of :data:`COLUMNS`, or another angle.
        values: in nT, deg and km.

    Raises:
        ValueError: with the first value that is not possible, and its unit.

    Example:
        >>> check_range("latitude", np.array([2.0, 200.0]))
        Traceback (most recent call last):
        ValueError: row 2, latitude 200 is not from -90 to 90 deg: check it and its unit, as in latitude_rad
    """
    kind, low, high = COLUMNS.get(name, ("angle", *_ANY))
    wrong = (values < low - _ROUNDING) | (values > high + _ROUNDING)
    if wrong.any():
        unit, other, *_ = UNITS[kind]
        row = int(wrong.argmax())
        limits = f"row {row + 1}, {name} {values[row]:.10g} is not from {low:g} to {high:g} {unit}"
        raise ValueError(f"{limits}: check it and its unit, as in {name}_{other}")


def check_speeds(log: DataFrame, step_s: Array) -> None:
    """Raise unless the speeds of all legs are possible: from positions, if there are any, and as stated.

    Args:
        log: columns ``row`` and ``distance``, and optionally ``latitude``, ``longitude`` and ``altitude``.
        step_s: time since the row before [s], ``(N,)``.

    Raises:
        ValueError: with the first row whose speed exceeds :data:`MAX_SPEED`, or whose speed over ground differs from
            the stated one by more than half of it and :data:`MAX_CURRENT`, and the likely cause.

    Example:
        >>> check_speeds(DataFrame({"row": [1, 2], "distance": [0.0, 20.0]}), np.array([0.0, 0.03]))
        Traceback (most recent call last):
        ValueError: row 2: a leg of 20 km in 0.03 s is 666667 m/s: times must be in seconds or ISO 8601, distances in km
    """
    stated = log["distance"].to_numpy(float)[1:] / step_s[1:] * 1000
    speed = stated
    if "latitude" in log:
        place = _places(log)[:, :2]
        speed = geodesic(*place[:-1].unbind(-1), *place[1:].unbind(-1))[0].numpy() / step_s[1:] * 1000
    space = log.get("altitude", log["distance"] * 0).to_numpy(float)[1:] > SPACE_KM
    apart = np.abs(speed - stated) > np.maximum(MAX_CURRENT, stated / 2)
    wrong = (np.maximum(speed, stated) > np.where(space, ORBITAL_SPEED, MAX_SPEED)) | apart
    if not wrong.any():
        return
    leg = int(wrong.argmax())
    row, seconds, km = log["row"][leg + 1], step_s[leg + 1], log["distance"][leg + 1]
    text = f"row {row}: a leg of {km:g} km in {seconds:g} s is {stated[leg]:.6g} m/s"
    if apart[leg]:
        text += f", the positions are {speed[leg] * seconds / 1000:.6g} km apart, which is {speed[leg]:.6g} m/s"
    raise ValueError(f"{text}: {_cause(log, apart, leg)}")


def _cause(log: DataFrame, apart: NDArray[np.bool_], leg: int) -> str:
    """Return the likely cause of an impossible speed of a leg."""
    if not apart[leg]:
        return "times must be in seconds or ISO 8601, distances in km"
    if (log.loc[leg : leg + 1, ["latitude", "longitude"]] == 0).all(axis=1).any():
        return "a position of 0, 0 stands for none: remove the row, or leave both columns out"
    if (log["distance"].diff()[2:] > 0).all() and apart.mean() > MOST_SPIKES:
        return "the distances look like those since the start: they must be since the row before"
    if apart.mean() <= MOST_SPIKES:
        return "the clock jumps there, or the position is wrong"
    return "check the units of times, speeds and distances, and the signs of the positions (east and north positive)"


def times_of(column: Series) -> Array:
    """Return times of numbers, or of texts in seconds since 1970, in UTC where they have no time zone.

    Args:
        column: numbers, or ISO 8601 texts; NaN for blank cells.

    Raises:
        ValueError: for a text that is neither, with its row.

    Example:
        >>> times_of(Series(["2026-06-30T12:00:00"], name="time"))
        array([1.7828208e+09])
    """
    if pandas.to_numeric(column, errors="coerce").notna().any() or column.isna().all():
        return numbers(column)
    parsed = pandas.to_datetime(column, utc=True, errors="coerce", format="ISO8601")
    bad = parsed.isna() & column.notna()
    if bad.any():
        row = int(bad.argmax())
        text = f"{short(column.iloc[row])} is no time such as 2026-06-30T12:00:00Z"
        raise ValueError(f"row {row + 1}, {column.name}: {text}")
    return (parsed - pandas.Timestamp(0, tz="UTC")).dt.total_seconds().to_numpy(float)


def new_times(time: Array) -> NDArray[np.bool_]:
    """Return which rows have another time than the row before.

    Args:
        time: ``(N,)``.

    Raises:
        ValueError: for times that are not finite or run backward, with the row.

    Example:
        >>> new_times(np.array([0.0, 1.0, 1.0, 2.0]))
        array([ True, True, False, True])
    """
    if not np.isfinite(time).all():
        raise ValueError(f"row {int(np.argmin(np.isfinite(time))) + 1} has no time")
    step = np.diff(time)
    if (step < 0).any():
        row = int((step < 0).argmax())
        raise ValueError(
            f"time runs backward from row {row + 1} to {row + 2}, from {time[row]:.10g} to {time[row + 1]:.10g}: "
            "sort the rows, or split the log where its clock was set"
        )
    return np.concatenate(([True], step > 0))


def date_of(time: float) -> str | None:
    """Return the date of a time in seconds since 1970; None for one since the log began.

    Example:
        >>> date_of(1.8e9), date_of(3600.0)
        ('2027-01-15', None)
    """
    return datetime.datetime.fromtimestamp(time, datetime.UTC).date().isoformat() if _EPOCH < time < 4.1e9 else None


def difference_from_igrf(readings: DataFrame, date: str) -> Tensor:
    """Return D [deg], I [deg], B_H [nT] of readings minus IGRF at their positions, ``(N, 3)``.

    Args:
        readings: columns D, I, B_H, latitude, longitude, and optionally altitude [km].
        date: date for IGRF.

    Example:
        >>> import pandas
        >>> row = {"D": [2.8], "I": [73.1], "B_H": [15003.0], "latitude": [60.4], "longitude": [5.3]}
        >>> difference_from_igrf(pandas.DataFrame(row), "2026-06-30").round(decimals=1)
        tensor([[-0.0000, 0.0000, 0.1000]], dtype=torch.float64)
    """
    return element_difference(_tensor(readings, *NAMES), _igrf_elements(_places(readings), date))


def mistakes(readings: DataFrame, date: str | None = None) -> list[str]:
    """Return the likely mistakes in a log with positions, as sentences; none where it fits.

    Readings are compared with IGRF, within the accuracy of a model of the core
    (:data:`~magrl.vehicle.mistakes.MODEL_STD`), and legs with the positions.

    Args:
        readings: columns of :func:`read_readings`. Where D is not measured (``D_std``), it converts
            the headings.
        date: date for IGRF; without it, legs alone are compared.

    Example:
        >>> import pandas
        >>> row = {"D": 2.8, "I": -73.1, "B_H": 15003.0, "latitude": 60.4, "longitude": 5.3}
        >>> mistakes(pandas.DataFrame([row | {"heading": 0.0, "distance": 0.0}] * 2), "2026-06-30")[0][-66:]
        'it fits with -I: the vertical axis points up, and down is expected'
    """
    if "latitude" not in readings or "longitude" not in readings:
        return []
    place = _places(readings)
    elements = _tensor(readings, *NAMES)
    expected = elements if date is None else _igrf_elements(place, date)
    texts = [] if date is None else _field_mistakes(readings, expected)
    if not _measured(readings):
        texts += [] if date is None else _compass_mistakes(elements[:, 0], expected[:, 0])
        readings = readings.assign(heading=readings["heading"] + (expected - elements)[:, 0].numpy())
    return texts + _leg_mistakes(readings, place[:, :2], expected[:, 0])


def _tensor(readings: DataFrame, *names: str) -> Tensor:
    return torch.tensor(readings[list(names)].to_numpy(float).copy())


def _places(readings: DataFrame) -> Tensor:
    """Return latitude, longitude [deg] and altitude [km] ``(N, 3)``; sea level where it is not known."""
    return _tensor(readings.assign(**{} if "altitude" in readings else {"altitude": 0.0}), *_PLACE)


def _igrf_elements(place: Tensor, date: str) -> Tensor:
    return measured_elements(IGRF(date)(*place.unbind(-1)))


def _field_mistakes(readings: DataFrame, expected: Tensor) -> list[str]:
    """Return which readings do not fit IGRF at their positions, and why."""
    elements, std = _tensor(readings, *NAMES), model_std(expected)
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
    heading = _tensor(readings, "heading")[wrong, 0]
    cause = likely_mistake(elements[wrong], expected[wrong], std[wrong], heading)
    return [f"{start}: {cause or 'no calibration, iron near the sensor, or a heading that is wrong'}"]


def _compass_mistakes(declination: Tensor, expected: Tensor) -> list[str]:
    """Return how far a compass is off: it has D 0, or the D of a model which was added to it."""
    off = torch.stack((declination, declination - expected)).add(180).remainder(360).sub(180)
    least = off[off.abs().median(1).values.argmin()].median().item()
    if abs(least) <= LEAST_TURN_DEG:
        return []
    shown = f"D is {declination.median():.0f} deg from the heading, IGRF's {expected.median():.0f}"
    return [f"{shown}: the compass is about {least:.0f} deg off; check its axes and its calibration"]


def _measured(readings: DataFrame) -> bool:
    """Return whether D was measured, which otherwise tells where the north of the headings is."""
    return "D_std" not in readings or bool((readings["D_std"] < OUTAGE_STD).any())


def _leg_mistakes(readings: DataFrame, place: Tensor, declination: Tensor) -> list[str]:
    """Return the likely mistakes in the unit of the distances and in the north of the headings."""
    distance, bearing = geodesic(*place[:-1].unbind(-1), *place[1:].unbind(-1))
    moved, heading = _tensor(readings, "distance", "heading")[1:].unbind(-1)
    going = (distance > 0) & (moved > 0)
    if not going.any():
        return []
    texts, ratio = [], float((distance[going] / moved[going]).median())
    if abs(ratio - 1) > MOST_DRIFT:
        far = f"the positions are {ratio:.3g} times as far apart as the distances of the legs"
        texts.append(f"{far}: check the log and its unit")
    turn, east = torch.rad2deg(bearing[going]) - heading[going], declination[1:][going]
    mirrored, scaled = torch.rad2deg(bearing[going]) + heading[going], torch.rad2deg(bearing[going] - heading[going])
    course = torch.deg2rad(turn)
    drift = math.degrees(torch.atan2(course.sin().mean(), course.cos().mean()).item())
    drifts, left, mirror, radians = (
        (angle + 180).remainder(360).sub(180).square().mean().sqrt() for angle in (turn, turn - east, mirrored, scaled)
    )
    text = f"the course between positions is {drift:.0f} deg to the right of the heading"
    if drifts > LEAST_TURN_DEG and mirror < drifts / 3:
        texts.append("the courses between positions mirror the headings: longitudes are positive to the west")
    elif drifts > LEAST_TURN_DEG and radians < drifts / 3:
        texts.append("the heading fits the courses between positions in radians")
    elif abs(abs(drift) - 180) < LEAST_TURN_DEG:
        texts.append(f"{text}: the heading is reciprocal, or the vehicle goes astern")
    elif drifts > 3 and left < drifts / 3:
        north = f"as D is {east.median():.0f} deg: the heading is from magnetic north, and true north is expected"
        texts.append(f"{text}, {north}")
    elif abs(drift) > LEAST_TURN_DEG:
        texts.append(f"{text}: check the compass and its axes")
    return texts
