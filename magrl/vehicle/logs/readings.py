"""From samples to readings: means of the vector over legs, how accurate they are, and mistakes that IGRF shows."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas
import torch
from numpy.typing import NDArray
from pandas import DataFrame
from torch import Tensor

from magrl.checks import check_choice, check_number, short
from magrl.field import IGRF
from magrl.field.elements import NAMES, element_difference, elements_jacobian, measured_elements
from magrl.files import numbers, read_table, read_text
from magrl.geodesy import geodesic
from magrl.sensor_std import OUTAGE_STD
from magrl.vehicle.logs.calibration import Calibration
from magrl.vehicle.logs.conventions import COLUMNS, NORTHS, UNITS, axes_of_elements, check_range, rotation, unit_of
from magrl.vehicle.logs.samples import ATTITUDE, AXES, Array, Log, date_of, new_times, times_of
from magrl.vehicle.onboard.known import deviation, likely_mistake, model_std

SPIKE_SIGMAS = 5.0
_BLOCKS = 10  # of the samples of a reading, whose means are nearly independent
_PATH, _FIELD, _MEANS = ["path_n", "path_e"], ["b_n", "b_e", "b_d"], ("heading", "latitude", "longitude", "altitude")
STD_NAMES = ("D_std", "I_std", "B_H_std")


def readings_of(
    log: Log,
    *,
    every_km: float = 20.0,
    north: str | None = None,
    calibration: Calibration | None = None,
) -> DataFrame:
    """Return one reading for each leg: the mean of the samples of that part of the track, at their mean position.

    The parts are as long as the legs, so that every sample counts once. The vector is averaged, without spikes.
    Positions are by dead reckoning along the heading, from the distances or the speeds of the log, or from its
    positions where it has neither.

    Args:
        log: samples. Without a heading, it is as of a compass: the horizontal field, leveled by roll and pitch.
        every_km: minimum length of a leg.
        north: north of the heading, one of :data:`~magrl.vehicle.logs.conventions.NORTHS`; default from the log.
        calibration: correction of the axes.

    Returns:
        Columns of ``recipes/replay_log.py``: ``time``, ``D``, ``I``, ``B_H``, ``heading`` and ``distance`` of the leg
        since the row before, ``latitude`` and ``longitude`` where known; and ``D_std``, ``I_std``, ``B_H_std``, the
        standard deviations of the means by the scatter of tenths of their samples, NaN where all legs have less than
        three, ``samples``, and ``spikes``.

    Raises:
        ValueError: for a log without a motion, an unknown north, or without a heading from that north.

    Example:
        >>> import pandas
        >>> time, heading = np.arange(2000.0), np.zeros(2000)
        >>> axes = {"x": 20000.0 - 0.01 * time, "y": 0 * time, "z": 40000.0 + 0 * time}
        >>> log = Log(pandas.DataFrame({"time": time, **axes, "heading": heading, "speed": 50 + 0 * time}), "by hand")
        >>> readings_of(log, every_km=25.0, north="true")[["B_H", "distance"]].round().values.tolist()
        [[19998.0, 0.0], [19992.0, 25.0], [19987.0, 25.0], [19982.0, 25.0]]
    """
    axes = log.tensor(*AXES) if calibration is None else calibration.apply(log.tensor(*AXES))
    if "heading" not in log.samples and north in (None, "magnetic"):
        log = _with_compass(log, axes)
    north = north or log.north
    if north is None:
        raise ValueError(f"the log does not state the north of the heading: give north, one of {', '.join(NORTHS)}")
    check_choice(NORTHS, north=north)
    check_number(0, above=True, every_km=every_km)
    field = (rotation(log.tensor(*ATTITUDE)) @ axes.unsqueeze(-1)).squeeze(-1).numpy()
    path, time = _path(log), log.samples["time"].to_numpy(float)
    part = _parts(path, every_km)
    samples = pandas.DataFrame(np.column_stack((time, path, field)), columns=["time", *_PATH, *_FIELD])
    for name in _MEANS:
        if name in log.samples:
            samples[name] = log.samples[name] if name == "altitude" else np.unwrap(log.samples[name], period=360)
    clean = ~_spikes(field, part)
    groups = samples[clean].groupby(part[clean])
    table = _table(groups.mean(), _covariance(field[clean], part[clean]), north)
    return table.assign(samples=groups.size(), spikes=np.bincount(part[~clean], minlength=len(table)))


def _with_compass(log: Log, axes: Tensor) -> Log:
    """Return a log with headings from magnetic north, of its own field ``(N, 3)``, leveled by roll and pitch."""
    tilt = torch.nn.functional.pad(log.tensor(*ATTITUDE[:2]), (0, 1))
    forward, right, _ = (rotation(tilt) @ axes.unsqueeze(-1)).squeeze(-1).unbind(-1)
    heading = torch.rad2deg(torch.atan2(-right, forward)).remainder(360)
    return replace(log, samples=log.samples.assign(heading=heading.numpy()), north="magnetic")


def read_readings(path: Path | str, names: Mapping[str, str], time: str | None = None) -> DataFrame:
    """Return the readings of a CSV file with a header, one for each leg.

    Args:
        path: the file.
        names: its columns by ``D``, ``I``, ``B_H``, ``heading``, ``distance``, and optionally ``latitude`` and
            ``longitude``, and ``altitude``, which the file may lack. A unit that ends a name counts, such as of
            ``H_uT``, and a name is also found with one, such as ``altitude_m``; without one, it is nT, deg or km.
        time: its column of the time, numbers or ISO 8601, which it may lack.

    Returns:
        Columns of these names, ``row``, the number of each in the file, and ``time``; without rows that repeat the time
        of the row before. ``attrs`` has the ``notes`` on the times, and their ``date``.

    Raises:
        ValueError: for a file that cannot be read, a missing column, a value that is not a number, or times that run
            backward.

    Example:
        >>> read_readings("nowhere.csv", {})
        Traceback (most recent call last):
        ValueError: cannot read nowhere.csv: [Errno 2] No such file or directory: 'nowhere.csv'
    """
    try:
        raw = read_table(read_text(Path(path)), dtype=str)
        log = DataFrame({"row": np.arange(len(raw)) + 1} | _columns(raw, names))  # the header is not counted
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
    except (OSError, ValueError) as error:
        raise ValueError(f"cannot read {path}: {error}") from error
    return log


def _columns(raw: DataFrame, names: Mapping[str, str]) -> dict[str, Array]:
    """Return the columns of readings by their keys."""
    columns, located = {}, any(names.get(key) in raw for key in ("latitude", "longitude"))
    for key, name in names.items():
        kind = "field" if key == "B_H" else COLUMNS.get(key, ("angle",))[0]
        others = {f"{name}_{unit}".lower() for unit in UNITS[kind]}
        name = next((other for other in raw if name not in raw and other.lower() in others), name)
        if name in raw:
            columns[key] = (unit_of(name, kind) or 1.0) * numbers(raw[name].fillna(""))
            check_range(key, columns[key])
        elif key in ("D", "I", "B_H", "heading", "distance") or (located and key != "altitude"):
            raise ValueError(f"no column is {name!r}: name the column of {key}, one of {short([*raw], 300)}")
    return columns


def joined(table: DataFrame, every_km: float) -> DataFrame:
    """Return the means of the rows of each leg in a table that already holds D, I, B_H; see :func:`readings_of`.

    Args:
        table: columns ``row``, ``D``, ``I``, ``B_H``, ``heading`` and ``distance`` since the row before, and others.
        every_km: minimum length of a leg; 0 for the rows as they are.

    Returns:
        The same columns; the others are of the middle row of each leg.

    Raises:
        ValueError: for legs so long that one reading is left.

    Example:
        >>> rows = {"row": range(1, 7), "D": 0.0, "I": 0.0, "B_H": range(6)}
        >>> rows |= {"heading": 90.0, "distance": [0] + [2.0] * 5}
        >>> joined(DataFrame(rows), 4.0)[["row", "B_H", "distance"]].round(9).values.tolist()
        [[1.0, 0.5, 0.0], [3.0, 2.5, 4.0], [5.0, 4.5, 4.0]]
    """
    check_number(0, every_km=every_km)
    if not every_km:
        return table
    heading = torch.tensor(table["heading"].to_numpy(float))
    attitude = torch.stack((torch.zeros_like(heading), torch.zeros_like(heading), heading), -1)
    axes = axes_of_elements(torch.tensor(table[list(NAMES)].to_numpy(float).copy()), attitude).numpy()
    samples = table.assign(time=np.arange(len(table)), **dict(zip(AXES, axes.T, strict=True)))
    readings = readings_of(Log(samples, "readings", "true"), every_km=every_km)
    if len(readings) < 2:
        raise ValueError(f"every_km {every_km:g} leaves one reading of {len(table)}: choose shorter legs")
    middle = table.iloc[readings["time"].astype(int)].reset_index(drop=True)
    return middle.assign(**{name: readings[name] for name in readings if name in table and name != "time"})


def _path(log: Log) -> Array:
    """Return places ``(N, 2)``, northward and eastward of the first one [km]."""
    samples = log.samples
    if "distance" in samples or "speed" in samples:
        step = np.diff(samples["time"], prepend=samples["time"].iloc[0])
        length = samples["distance"] if "distance" in samples else samples["speed"] * step / 1000
        heading = np.radians(samples["heading"])
    elif {"latitude", "longitude"} <= {*samples}:
        place = log.tensor("latitude", "longitude")
        distance, bearing = geodesic(*place[:-1].unbind(-1), *place[1:].unbind(-1))
        length, heading = (np.concatenate(([0.0], values.numpy())) for values in (distance, bearing))
    else:
        raise ValueError("the log has neither distances nor speeds nor positions, for the legs: log one of them")
    return np.cumsum(np.stack((length * np.cos(heading), length * np.sin(heading)), -1), 0)


def _parts(path: Array, every_km: float) -> NDArray[np.int64]:
    """Return the part of each sample ``(N,)``; a part ends where it is ``every_km`` from its first sample."""
    first, start = [0], path[0].tolist()
    for row, place in enumerate(path.tolist()):
        if math.dist(place, start) >= every_km:
            first.append(row)
            start = place
    if len(first) > 1 and np.hypot(*(path[-1] - path[first[-1]])) < every_km / 2:
        first.pop()
    return np.searchsorted(first, np.arange(len(path)), side="right") - 1


def _spikes(field: Array, part: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which vectors ``(N, 3)`` deviate from the median of their part by more than its scatter explains.

    A part of few samples has none: its scatter is unknown.
    """
    groups = pandas.DataFrame(field).groupby(part)
    deviation = np.abs(field - groups.transform("median").to_numpy())
    scatter = 1.4826 * pandas.DataFrame(deviation).groupby(part).transform("median").to_numpy()
    return (deviation > SPIKE_SIGMAS * scatter + 1.0).any(-1) & (np.bincount(part)[part] >= _BLOCKS)


def _covariance(field: Array, part: NDArray[np.int64]) -> Array:
    """Return the covariance ``(3, 3)`` of the mean of a part, as a mean over the parts; NaN if all are too short.

    The means of tenths of a part scatter by errors that last less than a tenth; their linear trend is the field's. With
    less than two samples in a tenth, the samples themselves are used, which do not show longer errors.
    """
    parts = np.split(field, np.flatnonzero(np.diff(part)) + 1)
    least = 2 * _BLOCKS if max(map(len, parts)) >= 2 * _BLOCKS else 3
    covariances = []
    for rows in parts:
        if len(rows) >= least:
            blocks = np.stack([block.mean(0) for block in np.array_split(rows, min(_BLOCKS, len(rows)))])
            line = np.linspace(-1, 1, len(blocks))
            residual = blocks - blocks.mean(0) - np.outer(line, line @ blocks / (line @ line))
            covariances.append(residual.T @ residual / (len(blocks) - 2) / len(blocks))
    return np.mean(covariances, 0) if covariances else np.full((3, 3), np.nan)


def _table(mean: DataFrame, covariance: Array, north: str) -> DataFrame:
    """Return the columns of readings from the means of parts."""
    field = torch.tensor(mean[_FIELD].to_numpy(float))
    jacobian = elements_jacobian(field)
    std = (jacobian @ torch.from_numpy(covariance) @ jacobian.mT).diagonal(dim1=-2, dim2=-1).sqrt()
    if north != "true":
        std[:, 0] = OUTAGE_STD
    move = np.diff(mean[_PATH].to_numpy(float), axis=0)
    course = np.degrees(np.arctan2(move[:, 1], move[:, 0])) % 360
    table = pandas.DataFrame(torch.cat((measured_elements(field), std), -1).numpy(), columns=[*NAMES, *STD_NAMES])
    table.insert(0, "time", mean["time"])
    table["heading"] = [mean["heading"].iloc[0] % 360, *course]
    table["distance"] = [0.0, *np.hypot(*move.T)]
    if "latitude" in mean:
        table["latitude"], table["longitude"] = mean["latitude"], (mean["longitude"] + 180) % 360 - 180
    if "altitude" in mean:
        table["altitude"] = mean["altitude"]
    return table


MOST_SPIKES = 0.2
"""Share of readings up to which those that do not fit are spikes, and not a mistake in all; chosen."""
MOST_DRIFT, LEAST_TURN_DEG = 0.25, 20.0
"""Share of a distance and angle of a course that currents explain, also an error that no compass has; chosen."""
_PLACE = "latitude", "longitude", "altitude"


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
    (:data:`~magrl.vehicle.onboard.known.MODEL_STD`), and legs with the positions.

    Args:
        readings: columns of :func:`~magrl.vehicle.logs.readings_of`. Where D is not measured (``D_std``), it converts
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
    return texts + _move_mistakes(readings, place[:, :2], expected[:, 0])


def _tensor(readings: DataFrame, *names: str) -> Tensor:
    return torch.tensor(readings[list(names)].to_numpy(float).copy())


def _places(readings: DataFrame) -> Tensor:
    """Return latitude, longitude [deg] and altitude [km] ``(N, 3)``; sea level where it is not known."""
    return _tensor(readings.assign(**{} if "altitude" in readings else {"altitude": 0.0}), *_PLACE)


def _igrf_elements(place: Tensor, date: str) -> Tensor:
    return measured_elements(IGRF(date)(*place.unbind(-1)))


# Readings


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


# Legs


def _move_mistakes(readings: DataFrame, place: Tensor, declination: Tensor) -> list[str]:
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
