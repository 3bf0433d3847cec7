"""Tables as pyulog's ulog2csv writes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import torch

from magrl.field import IGRF, elements_at
from magrl.field.elements import axes_of_elements
from magrl.geodesy import move_place


def write_px4_flight(folder: Path) -> None:
    """Write a level flight of 99 km from Newfoundland to the west at 25 m/s, a row every 40 s."""
    rows, heading = torch.arange(100).double(), torch.tensor(300.0).double()
    place = move_place(torch.tensor([48.0, -50.0]).double(), heading.deg2rad(), rows)
    attitude = torch.stack((0 * rows, 0 * rows, heading.expand(100)), -1)
    axes = axes_of_elements(elements_at(IGRF("2026-06-30"), place), attitude).numpy() / 1e5
    half = np.deg2rad(heading.item()) / 2
    topics = {
        "sensor_mag": dict(zip("xyz", axes.T, strict=True)),
        "vehicle_attitude": {f"q[{i}]": value for i, value in enumerate((np.cos(half), 0.0, 0.0, np.sin(half)))},
        "vehicle_gps_position": {"latitude_deg": place[:, 0], "longitude_deg": place[:, 1], "vel_m_s": 25.0},
    }
    for topic, columns in topics.items():
        table = pd.DataFrame({"timestamp": (40_000_000 * rows).long()} | columns)
        table.to_csv(folder / f"flight_{topic}_0.csv", index=False)
