"""Speed of the field models beside ppigrf, and of the gradient beside the value.

Run as ``python -m benchmarks.fields``: about a minute. Each row compares two times measured alternately.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime

from benchmarks.timing import Row, alternate, one_thread
from magrl import paper
from magrl.field import IGRF, RegionalField

import ppigrf
import torch

DATE = datetime.fromisoformat(paper.DATE)
BOX = tuple((low - 5.5, high + 5.5) for low, high in (paper.LATITUDE, paper.LONGITUDE))
"""Latitudes and longitudes that the paper's vehicles can reach [deg]."""
POINTS = 10_000


def positions(count: int = POINTS) -> tuple[torch.Tensor, torch.Tensor]:
    """Return latitudes and longitudes [deg] of random points that the paper's vehicles can reach."""
    generator = torch.Generator().manual_seed(0)
    unit = torch.rand(2, count, generator=generator, dtype=torch.float64)
    latitude, longitude = (low + (high - low) * u for (low, high), u in zip(BOX, unit, strict=True))
    return latitude, longitude


def rows(repeats: int = 11) -> list[Row]:
    """Return the times of the models on one thread, as ppigrf has it: a time is the mean of several calls.

    Args:
        repeats: pairs of times for each row.
    """
    latitude, longitude = positions()
    few = latitude[:1024], longitude[:1024]
    igrf = IGRF(DATE, paper.GENERATION)
    region = RegionalField(igrf, *BOX)
    east, north = longitude.numpy(), latitude.numpy()

    def peer() -> object:
        return ppigrf.igrf(east, north, 0.0, DATE, coeff_fn=ppigrf.ppigrf.shc_fn_igrf13)

    def row(what: str, magrl: Callable[[], object], baseline: Callable[[], object], goal: str, inner: int = 5) -> Row:
        return alternate(f"1 thread, {what}", magrl, baseline, repeats=repeats, goal=goal, inner=inner)

    with one_thread():
        return [
            row(f"{POINTS} points, IGRF: ppigrf", lambda: igrf(latitude, longitude), peer, "≥ 30"),
            row(
                f"{POINTS} points, IGRF value and gradient: value alone",
                lambda: igrf.value_and_gradient(latitude, longitude),
                lambda: igrf(latitude, longitude),
                "≥ 0.33",
            ),
            row(
                "1024 points, RegionalField value and gradient: value alone",
                lambda: region.value_and_gradient(*few),
                lambda: region(*few),
                "≥ 0.33",
                inner=20,
            ),
        ]


if __name__ == "__main__":
    print(*rows(), sep="\n")
