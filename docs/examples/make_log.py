"""Write log.csv: the log of a survey ship in the Norwegian Sea, simulated with IGRF and noisy sensors.

python docs/examples/make_log.py docs/examples/log.csv
"""

from __future__ import annotations

import csv
import sys
from pathlib import Path

from magrl.field import IGRF, elements_at
from magrl.geodesy import move

import torch

COURSES = [290.0] * 4 + [335.0] * 4 + [310.0] * 6 + [280.0] * 4 + [315.0] * 6
"""Headings of the legs [deg]."""
LEG_KM = 20.0
NOISE = (0.02, 0.02, 2.0)
"""Standard deviations of the noise on D [deg], I [deg], B_H [nT]."""


def write(path: Path) -> None:
    """Write reading [deg, deg, nT], heading [deg], distance since the last row [km] and position [deg]."""
    place = torch.tensor([62.0, 3.0], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["D", "I", "B_H", "heading", "distance", "latitude", "longitude"])
        for row, heading in enumerate([COURSES[0], *COURSES]):
            distance = LEG_KM if row else 0.0
            place = torch.stack(move(*place, torch.deg2rad(torch.tensor(heading).double()), torch.tensor(distance)))
            reading = elements_at(IGRF("2025-01-01"), place)
            reading = reading + torch.randn(3, generator=generator, dtype=torch.float64) * torch.tensor(NOISE)
            d, i, h = reading.tolist()
            latitude, longitude = place.tolist()
            numbers = f"{d:.3f} {i:.3f} {h:.1f} {heading:.1f} {distance:.1f} {latitude:.5f} {longitude:.5f}"
            writer.writerow(numbers.split())


if __name__ == "__main__":
    write(Path(sys.argv[1]))
