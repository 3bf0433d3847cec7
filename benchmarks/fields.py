"""The field models beside ppigrf, and the gradient beside the value.

Run as ``python -m benchmarks.fields``: about a minute. Each row is a ratio of two times taken in turn.
"""

from __future__ import annotations

import argparse
from datetime import datetime

import ppigrf
import torch

from benchmarks.timing import Row, alternate
from magrl.fields import IGRF
from magrl.regional import RegionalField

DATE, GENERATION = datetime(2022, 1, 1), 13
BOX = (-15.5, 5.5), (154.5, 175.5)
POINTS = 10_000


def positions(count: int = POINTS) -> tuple[torch.Tensor, torch.Tensor]:
    """Latitudes and longitudes [deg] of points in the box that the paper's vehicles can reach."""
    generator = torch.Generator().manual_seed(0)
    unit = torch.rand(2, count, generator=generator, dtype=torch.float64)
    latitude, longitude = (low + (high - low) * u for (low, high), u in zip(BOX, unit, strict=True))
    return latitude, longitude


def rows(repeats: int = 15) -> list[dict[str, str | float]]:
    """Times of the models, as they are called in use.

    Args:
        repeats: pairs of times behind each row.

    Returns:
        For each comparison ``what``, ``ours_ms``, ``theirs_ms`` (medians), ``ratio`` (median of theirs over ours, pair
        by pair) and its quartiles ``low`` and ``high``. For the gradient "theirs" is value and gradient, "ours" the
        value.
    """
    latitude, longitude = positions()
    few = latitude[:1024], longitude[:1024]
    igrf = IGRF(DATE, GENERATION)
    region = RegionalField(igrf, *BOX)
    east, north = longitude.numpy(), latitude.numpy()
    height = torch.full_like(latitude, 100.0)

    def peer(altitude_km: float = 0.0) -> object:
        return ppigrf.igrf(east, north, altitude_km, DATE, coeff_fn=ppigrf.ppigrf.shc_fn_igrf13)

    compared = (
        alternate(f"IGRF, {POINTS} points, ppigrf", lambda: igrf(latitude, longitude), peer, repeats=repeats),
        alternate(
            f"IGRF at given altitudes, {POINTS} points, ppigrf",
            lambda: igrf(latitude, longitude, height),
            lambda: peer(100.0),
            repeats=repeats,
        ),
        alternate(
            f"IGRF, {POINTS} points, value and gradient against value",
            lambda: igrf(latitude, longitude),
            lambda: igrf.value_and_gradient(latitude, longitude),
            repeats=repeats,
        ),
        alternate(
            f"RegionalField, {POINTS} points, ppigrf", lambda: region(latitude, longitude), peer, repeats=repeats
        ),
        alternate(
            "RegionalField, 1024 points, value and gradient against value",
            lambda: region(*few),
            lambda: region.value_and_gradient(*few),
            repeats=repeats,
            inner=20,
        ),
    )
    return [_as_dict(row) for row in compared]


def _as_dict(row: Row) -> dict[str, str | float]:
    return {
        "what": row.what,
        "ours_ms": row.first_ms,
        "theirs_ms": row.second_ms,
        "ratio": row.ratio,
        "low": row.low,
        "high": row.high,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], help="of torch, one table for each")
    parser.add_argument("--repeats", type=int, default=15, help="pairs of times behind each row")
    args = parser.parse_args()
    for threads in args.threads:
        torch.set_num_threads(threads)
        print(f"threads: {threads}")
        for row in rows(args.repeats):
            print(
                "{ratio:7.1f} ({low:.1f} to {high:.1f})  {ours_ms:8.3f} ms, {theirs_ms:8.3f} ms  {what}".format(**row)
            )


if __name__ == "__main__":
    main()
