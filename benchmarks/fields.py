"""Speed of the field models beside ppigrf, and of the gradient beside the value.

Run as ``python -m benchmarks.fields``: about a minute. Each row compares two times measured alternately.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime

import ppigrf
import torch

from benchmarks.timing import Row, alternate
from magrl import paper
from magrl.field import IGRF, FieldModel, RegionalField

DATE, GENERATION = datetime.fromisoformat(paper.DATE), paper.GENERATION
BOX = tuple((low - 5.5, high + 5.5) for low, high in (paper.LATITUDE, paper.LONGITUDE))
"""Latitudes and longitudes that the paper's vehicles can reach [deg]."""
POINTS = 10_000


def positions(count: int = POINTS) -> tuple[torch.Tensor, torch.Tensor]:
    """Return latitudes and longitudes [deg] of random points that the paper's vehicles can reach."""
    generator = torch.Generator().manual_seed(0)
    unit = torch.rand(2, count, generator=generator, dtype=torch.float64)
    latitude, longitude = (low + (high - low) * u for (low, high), u in zip(BOX, unit, strict=True))
    return latitude, longitude


@contextmanager
def threads_of_torch(count: int) -> Iterator[None]:
    """Use a number of threads in torch, and restore the number afterwards."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def rows(repeats: int = 11, threads: int = 1) -> list[Row]:
    """Return the times of the models in normal use: a time is the mean of five consecutive calls.

    Args:
        repeats: pairs of times for each row.
        threads: threads of torch; one is fair beside ppigrf, which never uses more.
    """
    with threads_of_torch(threads):
        return _rows(repeats, f"{threads} thread{'s' * (threads > 1)}, {POINTS} points")


def _rows(repeats: int, points: str) -> list[Row]:
    latitude, longitude = positions()
    few = latitude[:1024], longitude[:1024]
    igrf = IGRF(DATE, GENERATION)
    region = RegionalField(igrf, *BOX)
    east, north = longitude.numpy(), latitude.numpy()
    height = torch.full_like(latitude, 100.0)

    def peer(altitude_km: float = 0.0) -> object:
        return ppigrf.igrf(east, north, altitude_km, DATE, coeff_fn=ppigrf.ppigrf.shc_fn_igrf13)

    def row(what: str, magrl: Callable[[], object], baseline: Callable[[], object], goal: str, inner: int = 5) -> Row:
        return alternate(what, magrl, baseline, repeats=repeats, goal=goal, inner=inner)

    found = [
        row(f"{points}, IGRF: ppigrf", lambda: igrf(latitude, longitude), peer, "≥ 30"),
        row(
            f"{points} at given altitudes, IGRF: ppigrf",
            lambda: igrf(latitude, longitude, height),
            lambda: peer(100.0),
            "",
        ),
        row(f"{points}, RegionalField: ppigrf", lambda: region(latitude, longitude), peer, "≥ 300"),
    ]
    if shutil.which("g++") or shutil.which("clang++"):  # what torch.compile needs
        compiled = torch.compile(region.forward, dynamic=False)
        what = f"{points}, RegionalField compiled: ppigrf"
        found.append(row(what, lambda: compiled(latitude, longitude), peer, "≥ 300"))
    return [
        *found,
        row(
            f"{points}, IGRF value and gradient: value alone",
            lambda: igrf.value_and_gradient(latitude, longitude),
            lambda: igrf(latitude, longitude),
            "≥ 0.33",
        ),
        row(
            f"{points.replace(str(POINTS), '1024')}, RegionalField value and gradient: value alone",
            lambda: region.value_and_gradient(*few),
            lambda: region(*few),
            "≥ 0.33",
            inner=20,
        ),
    ]


def peak_memory() -> dict[str, float]:
    """Return the peak memory of a process that evaluates value and gradient at 10 million points, by model [GiB]."""
    command = [sys.executable, "-m", "benchmarks.fields", "--memory", "--model"]
    return {
        model: float(subprocess.run([*command, model], check=True, capture_output=True, text=True).stdout)
        for model in ("igrf", "regional")
    }


def peak_gib(model: FieldModel, count: int = 10_000_000) -> float:
    """Return the peak memory of this process after value and gradient at many points [GiB]."""
    model.value_and_gradient(*positions(count))
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--threads", type=int, nargs="+", default=[1, 2], help="threads of torch; rows are measured for each number"
    )
    parser.add_argument(
        "--memory", action="store_true", help="print the peak memory at 10 million points [GiB] instead, of one model"
    )
    parser.add_argument("--model", choices=["igrf", "regional"], default="igrf", help="field model for --memory")
    options = parser.parse_args()
    if options.memory:
        model = IGRF(DATE, GENERATION)
        print(f"{peak_gib(model if options.model == 'igrf' else RegionalField(model, *BOX)):.2f}")
    else:
        for threads in options.threads:
            print(f"threads: {threads}", *rows(threads=threads), sep="\n")
