"""Write swing.csv and way.csv: what a ship logs, simulated with IGRF: three axes, attitude, speed and position.

    python docs/examples/make_raw_log.py raw

The magnetometer has hard and soft iron, noise and spikes; the ship rolls and pitches, and drifts with a current.
"""

from __future__ import annotations

import sys
from pathlib import Path

from magrl.field import IGRF, elements_at
from magrl.geodesy import curvature_radii
from magrl.vehicle.logs import axes_of_elements

import numpy as np
import pandas
import torch

COURSES = [290.0] * 3 + [335.0] * 3 + [310.0] * 4 + [280.0] * 5
"""Headings of the hours of the passage [deg]."""
SPEED_KM_H, CURRENT_KM_H = 20.0, (0.9, -0.6)
"""Speed through the water, and the current northward and eastward."""
PLACE, START = (62.47, 6.15), pandas.Timestamp("2026-06-30T06:00:00Z")
SOFT_IRON = ((1.02, 0.01, 0.0), (-0.01, 0.97, 0.005), (0.0, 0.01, 1.01))
HARD_IRON_NT, NOISE_NT, ATTITUDE_DEG = (500.0, -350.0, 200.0), 30.0, 0.1


def logged(time: np.ndarray, heading: np.ndarray, tilt: float, place: np.ndarray, seed: int) -> pandas.DataFrame:
    """Return what the ship logs at times [s] with headings [deg], waves [deg] and positions ``(N, 2)`` [deg]."""
    random = np.random.default_rng(seed)
    attitude = np.stack((tilt * np.sin(time / 1.7), 0.5 * tilt * np.sin(time / 1.1 + 1), heading), -1)
    elements = elements_at(IGRF(START.isoformat()[:10]), torch.tensor(place))
    axes = axes_of_elements(elements, torch.tensor(attitude)).numpy() @ np.array(SOFT_IRON).T + HARD_IRON_NT
    axes += NOISE_NT * random.standard_normal(axes.shape) + 5000 * (random.random((len(axes), 1)) < 0.001)
    attitude += ATTITUDE_DEG * random.standard_normal(attitude.shape)
    stamp = (START + pandas.to_timedelta(time, "s")).strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    columns = {"time": stamp} | {f"mag_{name}_uT": (axes[:, i] / 1000).round(4) for i, name in enumerate("xyz")}
    columns |= {f"{name}_deg": attitude[:, i].round(3) for i, name in enumerate(("roll", "pitch", "heading_true"))}
    return pandas.DataFrame(columns | {"lat": place[:, 0].round(6), "lon": place[:, 1].round(6)})


def write(folder: Path) -> None:
    """Write both logs: a swing of ten minutes at 5 Hz at the quay, and a passage of 15 hours at 1 Hz."""
    folder.mkdir(parents=True, exist_ok=True)
    time = np.arange(3000) / 5
    logged(time, 720 * time / 600, 8.0, np.tile(PLACE, (3000, 1)), seed=0).to_csv(folder / "swing.csv", index=False)
    time = np.arange(3600.0 * len(COURSES))
    heading = np.repeat(COURSES, 3600)
    north, east = (
        SPEED_KM_H * turn(np.radians(heading)) + drift
        for turn, drift in zip((np.cos, np.sin), CURRENT_KM_H, strict=True)
    )
    latitude = PLACE[0] + np.degrees(np.cumsum(north) / 3600 / 6390)  # the radius of the meridian here
    meridian, normal = (radius.numpy() for radius in curvature_radii(torch.tensor(latitude)))
    latitude = PLACE[0] + np.degrees(np.cumsum(north / meridian) / 3600)
    longitude = PLACE[1] + np.degrees(np.cumsum(east / normal / np.cos(np.radians(latitude))) / 3600)
    table = logged(time, heading, 4.0, np.stack((latitude, longitude), -1), seed=1)
    table.assign(speed_km_h=SPEED_KM_H).to_csv(folder / "way.csv", index=False)


if __name__ == "__main__":
    write(Path(sys.argv[1]))
