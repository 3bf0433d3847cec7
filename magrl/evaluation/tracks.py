"""Benchmark: tracks, which fix all that decides its numbers except the navigator, and tables of their episodes.

A track with a version is frozen.
"""

from __future__ import annotations

import gzip
import hashlib
import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas
import torch
from torch import Tensor

from magrl import paper
from magrl.envs import PUBLIC_KEYS, Scenario, Trips, earth_scenario, named_trips
from magrl.errors import Conditions, conditions_named
from magrl.evaluation import Flight, Sheet
from magrl.files import write_atomically
from magrl.random_numbers import FIRST_RESERVED_SEED
from magrl.sensor_std import PERFECT, STD_KEYS, Noise

LEVELS: tuple[Noise, ...] = (PERFECT.noise, (0.05, 0.05, 5.0), (0.5, 0.1, 20.0))
"""Standard deviations of the noise on D [deg], I [deg], B_H [nT]."""
VEHICLES = ("aircraft", "ship", "underwater", "low-cost")
"""Conditions of vehicles with true north."""
DRIFT_KM = 40.0
"""How much farther than the longest leg errors may carry a vehicle [km], for one environment under all conditions."""
SEED = 3 * FIRST_RESERVED_SEED
"""Seed of regions and trips, beyond the seeds of trainings and of frozen sets."""
READINGS = (*PUBLIC_KEYS, "elapsed_steps")
"""Keys of the readings, without the accuracy of the sensors."""


@dataclass(frozen=True)
class Track:
    """Trips and errors under which navigators fly them.

    Example:
        >>> TRACKS["alone-v2"].max_steps, TRACKS["alone-v2"].within_km
        (80, 25)
    """

    conditions: Sequence[str] = ()
    """Errors of real vehicles; by default there is white noise of several levels."""
    levels: Sequence[Noise] = ()
    """Standard deviations of white noise on D [deg], I [deg], B_H [nT]; :data:`LEVELS` without conditions."""
    trips: int = 1000
    """Number of trips."""
    regions: int = 128
    """Number of random regions of the Earth."""
    distance_km: Sequence[float] = paper.DISTANCE_KM
    """Shortest and longest distance of a trip [km]."""
    max_steps: int = 50
    """Legs after which an episode ends."""
    within_km: float | None = None
    """Radius in which vehicles declare their arrival [km]; by default they get a signal, by the paper's rule."""
    sheet: Sheet = Sheet()
    """Data sheet of the vehicles, beside the errors of their sensors."""
    crust: bool = False
    """Whether the field is WMMHR, with crust, or IGRF-14."""
    box: bool = False
    """Whether the trips are in the paper's box, ``test-1000``, or in random regions."""
    date: str = "2025-01-01"
    """Date of IGRF-14 outside the paper's box."""
    seed: int = 0
    """Seed of errors and of random start headings."""
    keys: Sequence[str] = (*READINGS, *STD_KEYS)
    """Keys that a trained policy may read."""

    @cached_property
    def errors(self) -> dict[str, Noise | Conditions]:
        """Errors by the name of their level: of a vehicle, or the three standard deviations of white noise."""
        levels = self.levels or (() if self.conditions else LEVELS)
        noises: dict[str, Noise | Conditions] = {", ".join(f"{std:g}" for std in noise): noise for noise in levels}
        return noises | {name: conditions_named(name) for name in self.conditions}

    @cached_property
    def scenario(self) -> Scenario:
        """Scenario of the trips, with room for all errors of motion."""
        far = self.distance_km[1] > paper.DISTANCE_KM[1]
        size: dict[str, Any] = {"half_size_deg": 20, "degree": 16, "max_latitude": 75} if far else {"max_latitude": 70}
        size |= {"distance_range_km": tuple(self.distance_km), "max_leg_km": 50.0 + DRIFT_KM * bool(self.conditions)}
        size |= {"date": self.date, "start_heading": "random"} | ({"crust": True, "degree": 60} if self.crust else {})
        earth = Scenario() if self.box else earth_scenario(self.regions, SEED, **size)
        trips = named_trips("test-1000") if self.box else earth.random_trips(self.trips, SEED)
        rule: dict[str, Any] = {"arrival": "declared", "radius_km": self.within_km} if self.within_km else {}
        scenario = earth.replace(max_steps=self.max_steps, **rule)
        return scenario.with_trips(Trips(*(ends[: self.trips] for ends in trips)))

    def flight(self, errors: Noise | Conditions, trips: Trips | None = None, **changes: Any) -> Flight:
        """Return vehicles with some errors, one for each trip.

        Args:
            errors: of a level of :attr:`errors`.
            trips: trips that replace the track's.
            changes: options of :class:`~magrl.evaluation.Flight` that replace the track's.
        """
        scenario = self.scenario if trips is None else self.scenario.with_trips(trips)
        return Flight(scenario, **{"sheet": self.sheet, "errors": errors, "seed": self.seed} | changes)

    def record(self) -> dict[str, Any]:
        """Return the declaration of the track as plain data, and the digest of its trips."""
        ends = self.scenario.trips
        assert ends is not None
        fixed = {"levels": self.levels or LEVELS, "known_start": None}  # a key of the first declarations
        known = self.sheet.model_dump(include={"north", "confidence"}) | self.sheet.model_dump(exclude_unset=True)
        declared: dict[str, Any] = json.loads(json.dumps(asdict(self) | fixed | known | {"sheet": None}))
        del declared["sheet"]
        if not self.crust:  # as the first tracks were declared
            del declared["crust"]
        return declared | {"trips_sha256": digest(torch.cat((*ends[:2], ends.region.unsqueeze(-1)), -1))}


def digest(values: Tensor, digits: int = 6) -> str:
    """Return the SHA-256 of columns of numbers ``(..., C)``, rounded to some digits of the largest number of each.

    On another processor the last bits differ: in float64 by less than 1e-12, so that a number is rounded to another
    value with a probability below 1e-6. Numbers that were computed in float32 differ in the seventh digit: take four.

    Args:
        values: finite numbers.
        digits: number of digits.

    Example:
        >>> one, other = torch.tensor([[3.0], [0.5]]), torch.tensor([[3.0], [0.5 + 1e-9]])
        >>> digest(one) == digest(other), digest(one) == digest(one + 1e-4)
        (True, False)
    """
    columns = values.detach().cpu().double().reshape(-1, values.shape[-1])
    largest = columns.abs().amax(0).clamp_min(1e-6)
    rounded = (columns / 10 ** (largest.log10().floor() - digits + 1)).round().long()
    return hashlib.sha256(rounded.numpy().tobytes()).hexdigest()


TRACKS = {
    "box-v2": Track(box=True, levels=(PERFECT.noise, (0.02, 0.02, 2.0), (0.05, 0.05, 5.0), (0.1, 0.1, 10.0))),
    "earth-v2": Track(trips=2000),
    "alone-v2": Track(within_km=25, max_steps=80),
    "vehicles-v4": Track(trips=300, within_km=25, max_steps=120, sheet=Sheet(confidence=0.8), conditions=VEHICLES),
    "north-v1": Track(
        within_km=25,
        max_steps=80,
        sheet=Sheet(north="magnetic"),
        levels=(PERFECT.noise, (0.05, 0.05, 5.0), (0.1, 0.1, 10.0)),
    ),
}
"""Tracks by name and version. Published numbers rest on them: for a change, add a track with the next version."""


COLUMNS = {
    "track": str,
    "navigator": str,
    "run": int,
    "level": str,
    "trip": int,
    "region": int,
    "seed": int,
    "success": bool,
    "spl": float,
    "steps": int,
    "false_arrival": bool,
    "final_distance_km": float,
}
"""Columns and their types. ``run`` counts the trainings of a navigator; ``seed`` is the seed of the errors."""


def episode_table(measures: Mapping[str, Tensor], region: Tensor, **labels: str | int) -> pandas.DataFrame:
    """Return a row for each episode.

    Args:
        measures: ``(M,)`` each, of :func:`magrl.evaluation.episode_measures`, in the order of the trips.
        region: ``(M,)`` index of the region of each trip.
        labels: columns that are the same in each row, such as ``navigator`` and ``level``; empty or 0 by default.

    Example:
        >>> ends = {"success": torch.tensor([True]), "steps": torch.tensor([9])}
        >>> ends |= {"spl": torch.tensor([0.5]), "navigation_error_km": torch.tensor([4.0])}
        >>> episode_table(ends, torch.tensor([5]), navigator="secant")[["trip", "region", "spl"]].values.tolist()
        [[0.0, 5.0, 0.5]]
    """
    columns = {
        **dict.fromkeys(("track", "navigator", "level"), ""),
        **dict.fromkeys(("run", "seed"), 0),
        **labels,
        "trip": range(len(region)),
        "region": region.tolist(),
        "success": measures["success"].tolist(),
        "spl": measures["spl"].double().tolist(),
        "steps": measures["steps"].tolist(),
        "false_arrival": measures.get("false_arrival", torch.zeros_like(measures["success"])).tolist(),
        "final_distance_km": measures["navigation_error_km"].double().tolist(),
    }
    return pandas.DataFrame(columns)[list(COLUMNS)]


def write_episodes(path: Path | str, tables: Sequence[pandas.DataFrame]) -> None:
    """Write tables of episodes as one file, ``.csv.gz``; the same episodes give the same bytes.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "episodes.csv.gz"
        >>> write_episodes(path, [pandas.DataFrame({name: [kind()] for name, kind in COLUMNS.items()})])
        >>> len(read_episodes(path))
        1
    """
    text = pandas.concat(tables).to_csv(index=False, float_format="%.6g")
    write_atomically(Path(path), gzip.compress(text.encode(), mtime=0))


def read_episodes(path: Path | str) -> pandas.DataFrame:
    """Read a table of episodes.

    Raises:
        ValueError: for another file.
    """
    try:
        table = pandas.read_csv(path, keep_default_na=False).astype(COLUMNS)
    except (ValueError, KeyError, EOFError, zlib.error) as error:
        raise ValueError(f"{path} is not a table of episodes: {error}") from error
    return table[list(COLUMNS)]
