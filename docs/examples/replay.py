"""Replay a table of readings on board: what a vehicle would have said, and readings that do not fit the Earth's field.

    python docs/examples/replay.py docs/examples/log.csv 2025-01-01
    python docs/examples/replay.py mine.csv 2026-06-30 --noise 0.1 0.05 20 --bias 0.3 0.05 20 --drift 0.05

The table has the columns D, I [deg], B_H [nT], heading [deg], distance [km] since the row before, and the true place,
latitude and longitude [deg]; others are ignored. A row is the mean of the readings over a leg of some kilometers. D, I
or B_H may be empty, but in the first row. The vehicle knows the first place and the last one, its destination. Writes
replay.png.
"""

from __future__ import annotations

import math
import sys
from collections import Counter

from magrl.field import IGRF, elements_at
from magrl.geodesy import geodesic
from magrl.onboard import Onboard
from magrl.onboard.mistakes import deviation, likely_mistake, model_std
from magrl.sensor_std import SensorStd

import matplotlib.pyplot as plt
import pandas as pd
import torch
import tyro

LIMITS = {"D": 180, "I": 90, "B_H": 70_000, "heading": 360, "distance": 100, "latitude": 90, "longitude": 180}
"""Columns of the table, and their greatest absolute values; the first three may have empty cells."""
MOST_ROWS = 10_000


def read(path: str) -> torch.Tensor:
    """Return the rows of a table, with NaN for an empty cell; raise unless it has all columns, and possible numbers."""
    table = pd.read_csv(path, nrows=MOST_ROWS + 1)
    if not {*LIMITS} <= {*table} or not 2 <= len(table) <= MOST_ROWS:
        raise ValueError(
            f"expected 2 to {MOST_ROWS} rows of {', '.join(LIMITS)}, got {len(table)} of {', '.join(table)}"
        )
    for name, most in LIMITS.items():
        numbers = pd.to_numeric(table[name], errors="coerce")
        empty = table[name].isna() & (name in ("D", "I", "B_H"))
        for row in table.index[~(numbers.abs() <= most) & ~empty][:1]:
            raise ValueError(f"{name} in row {row} must be at most {most}, got {table[name][row]}")
    return torch.tensor(table[[*LIMITS]].to_numpy(float))


def check(rows: torch.Tensor, date: str) -> None:
    """Raise where most readings do not fit the field at their places; print those that do not, and distances."""
    places = rows[:, 5:]
    full = rows[~rows.isnan().any(1)]
    wrong, swapped = (
        misfits(full[:, :3], elements_at(IGRF(date), there)) for there in (full[:, 5:], full[:, 5:].flip(-1))
    )
    if 2 * len(wrong) > len(full):
        mistake, most = Counter(wrong).most_common(1)[0]
        mistake = "latitude and longitude are swapped" if not swapped else f"{mistake} ({most} of them)"
        raise ValueError(f"{len(wrong)} of {len(full)} readings do not fit IGRF: {mistake}")
    for text in wrong:
        print(f"one reading does not fit IGRF: {text}")
    ground, stated = geodesic(*places[:-1].T, *places[1:].T)[0], rows[1:, 4]
    for row in ((stated - ground).abs() > 2 + 0.4 * torch.minimum(stated, ground)).nonzero()[:, 0]:
        print(f"row {row + 1}: a distance of {stated[row]:.3g} km, and {ground[row]:.3g} km between the places")


def misfits(readings: torch.Tensor, expected: torch.Tensor) -> list[str]:
    """Return what is wrong with each reading that does not fit: the likely mistake, or how it deviates."""
    pairs = [(row, there, model_std(there)) for row, there in zip(readings, expected, strict=True)]
    return [likely_mistake(*pair) or text for pair in pairs if (text := deviation(*pair))]


def replay(
    table: str,
    date: str,
    /,
    noise: tuple[float, float, float] = (0.02, 0.02, 2.0),
    bias: tuple[float, float, float] = (0.0, 0.0, 0.0),
    start_km: float = 0.1,
    drift: float = 0.03,
) -> None:
    """Fly the legs on board, print what the vehicle says and how far off it is, and draw its track.

    Args:
        table: file of the table.
        date: its date, such as 2025-01-01.
        noise: standard deviations of the noise of D [deg], I [deg], B_H [nT].
        bias: the same of errors that outlast a reading.
        start_km: root mean square error of the first place [km].
        drift: standard deviation of the drift of dead reckoning [share of the distance].
    """
    check(rows := read(table), date)
    options = {"sensor_std": SensorStd(noise, bias), "drift": drift}
    vehicle = Onboard("kalman", max_leg_km=LIMITS["distance"], max_steps=len(rows) + 1, **options)
    vehicle.start(rows[-1, 5:], rows[0, 5:], date=date, start_km=start_km)
    track = []
    for number, (*reading, heading, distance, latitude, longitude) in enumerate(rows.tolist()):
        reading = [None if math.isnan(element) else element for element in reading]
        command = vehicle.step(*reading, heading=heading, distance=distance)
        track.append(command.place)
        off = geodesic(*map(torch.tensor, (*command.place, latitude, longitude)))[0]
        print(f"row {number}: {off:.1f} km off, error_km {command.error_km:.1f}, stop {command.stop}")
    print(f"fit {command.fit:.2g}; {command.reason}")
    for places, label in ((rows[:, 5:], "table"), (track, "estimated on board")):
        plt.plot(*torch.as_tensor(places).flip(-1).T, ".-", label=label)
    plt.gca().set(xlabel="longitude [deg]", ylabel="latitude [deg]", title=f"fit {command.fit:.2g}")
    plt.legend()
    plt.savefig("replay.png")


if __name__ == "__main__":
    try:
        tyro.cli(replay)
    except (OSError, ValueError) as error:
        sys.exit(f"error: {error}")
