"""Flights of tables and figures: frozen tasks in random regions, navigators that know the accuracy of their sensors."""

from __future__ import annotations

import glob
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from magrl import paper
from magrl.envs import Scenario, Tasks, earth_scenario, named_tasks
from magrl.evaluation import Flight, episode_measures, summarize
from magrl.evaluation.metrics import first_episode_mask
from magrl.evaluation.runs import NO_NOISE, Noise
from magrl.evaluation.tables import about, mean_of_runs
from magrl.geodesy import geodesic
from magrl.transforms import Conditions, conditions_named

import torch
from tensordict import TensorDictBase
from torch import Tensor

Errors, Measures = Noise | Conditions, Mapping[str, Tensor]
Spec = str | Mapping[str, Any]
"""Navigator: a text, as recipes/evaluate.py takes it, or a ``name`` with options of its own."""
LEVELS: tuple[Noise, ...] = (NO_NOISE, (0.05, 0.05, 5.0), (0.5, 0.1, 20.0))
"""Standard deviations of the noise on D [deg], I [deg], B_H [nT]."""
DRIFT_KM = 40.0
"""How much farther than the longest move errors may carry a vehicle [km], for one environment under all conditions."""
MEASURES = ("success_rate", "spl")
"""Measures in a cell of a table."""
OWN_OPTIONS = ("north", "known_start", "confidence")
"""Options of all flights that a navigator may have by itself."""
SEED = 3 * paper.FIRST_RESERVED_SEED
"""Seed of regions and tasks, beyond those of trainings and of frozen sets."""


@dataclass(frozen=True)
class Flights:
    """Tasks that navigators fly under several errors, and how they end."""

    conditions: Sequence[str] = ()
    """Errors of real vehicles; by default there is white noise of several levels."""
    levels: Sequence[Noise] = LEVELS
    tasks: int = 1000
    regions: int = 128
    distance_km: Sequence[float] = paper.DISTANCE_KM
    max_steps: int = 50
    within_km: float | None = None
    """Radius in which vehicles declare their arrival [km]; by default they get a signal, by the paper's rule."""
    confidence: float = 0.0
    """Minimum probability at which vehicles declare their arrival; also an option of a navigator."""
    signal_km: float | None = None
    """Radius in which a signal ends the episode [km]."""
    north: str = "true"
    """North of the vehicles, ``"true"`` or ``"magnetic"``; a navigator may have another one as an option."""
    known_start: Sequence[float] | None = None
    """Standard deviations of the elements at the start, where the vehicles know them; also an option of a navigator."""
    box: bool = False
    """Whether the tasks are those of the paper's box, ``test-1000``, in place of random regions."""

    @cached_property
    def errors(self) -> dict[str, Errors]:
        """Errors by the headings of their columns."""
        levels: dict[str, Errors] = {", ".join(f"{std:g}" for std in noise): noise for noise in self.levels}
        return {name: conditions_named(name) for name in self.conditions} or levels

    @cached_property
    def scenario(self) -> Scenario:
        """Scenario of the tasks, with room for all errors of motion."""
        far = self.distance_km[1] > paper.DISTANCE_KM[1]
        size = {"half_size_deg": 20, "degree": 16, "max_latitude": 75} if far else {"max_latitude": 70}
        size |= {"distance_range_km": tuple(self.distance_km), "max_move_km": 50.0 + DRIFT_KM * bool(self.conditions)}
        earth = Scenario() if self.box else earth_scenario(self.regions, SEED, **size, start_heading="random")
        tasks = named_tasks("test-1000") if self.box else earth.random_tasks(self.tasks, SEED)
        rule: dict[str, Any] = {"arrival": "declared", "arrival_radius_km": self.within_km} if self.within_km else {}
        rule |= {"arrival": "distance", "arrival_radius_km": self.signal_km} if self.signal_km else {}
        scenario = earth.replace(max_steps=self.max_steps, **rule)
        return scenario.with_tasks(Tasks(*(ends[: self.tasks] for ends in tasks)))

    def fly(self, navigator: Spec, errors: Errors) -> TensorDictBase:
        """Return an episode of each task."""
        given = {key: getattr(self, key) for key in OWN_OPTIONS}
        own = navigator if isinstance(navigator, Mapping) else {"name": navigator}
        options = {key: own.get(key, value) for key, value in given.items()}
        flight = Flight(self.scenario, errors=errors, **options)
        return flown(flight, {key: value for key, value in own.items() if key not in given})

    def episodes(self, navigator: Spec, errors: Errors) -> list[Measures]:
        """Return the measures of an episode of each task, once for each run that the pattern of a navigator names."""
        return [episode_measures(self.fly(run, errors)) for run in runs_of(navigator)]

    def summaries(self, navigator: Spec, errors: Errors) -> list[dict[str, float]]:
        """Return the summary of each run of a navigator."""
        return [summarize(episodes) for episodes in self.episodes(navigator, errors)]


def flown(flight: Flight, navigator: Spec) -> TensorDictBase:
    """Return an episode of each vehicle."""
    options = dict(navigator) if isinstance(navigator, Mapping) else {"name": navigator}
    return flight.fly(flight.navigator(options.pop("name"), **options))


def clustered(values: Tensor, region: Tensor) -> tuple[float, float]:
    """Return the mean of ``(N,)`` values, and the half-width of its 95 % interval, clustered by their regions ``(N,)``.

    Values of a region are not independent: the standard error is that of the sums over each region.
    """
    sums = torch.bincount(region, values - values.mean())
    return values.mean().item(), 1.96 * (sums.square().sum() * len(sums) / (len(sums) - 1)).sqrt().item() / len(values)


def paired_difference(first: Tensor, second: Tensor, region: Tensor) -> str:
    """Return the mean difference of two shares ``(N,)`` of the same tasks, in percent, with an interval of 95 %.

    An interval that excludes 0 is bold.
    """
    mean, half = clustered(100 * (first - second).double().flatten(), region)
    text = f"{mean:+.1f} ({mean - half:+.1f} to {mean + half:+.1f})"
    return f"**{text}**" if abs(mean) > half else text


def reliability(flight: TensorDictBase, region: Tensor, radius_km: float) -> list[tuple[float, float, float]]:
    """Return mean, share of correct readings and its error for ten bins of the stated probability of arrival.

    In percent; the error is the half-width of an interval of 95 %. Bins of fewer than 100 readings are left out.

    Args:
        flight: ``(N, T)`` from vehicles that declare.
        region: region of each vehicle ``(N,)``.
        radius_km: radius in which a declaration is correct [km].
    """
    flown = first_episode_mask(flight["next", "done"]).squeeze(-1)
    stated, ends = flight["arrival_probability"][flown].squeeze(-1).double(), flight["target_position"][flown]
    right = geodesic(*flight["position"][flown].unbind(-1), *ends.unbind(-1))[0] <= radius_km
    region, bins = region.unsqueeze(-1).expand_as(flown)[flown], (10 * stated).long().clamp_max(9)
    chosen = [bins == place for place in range(10) if (bins == place).sum() >= 100]
    return [(100 * stated[one].mean().item(), *clustered(100 * right[one].double(), region[one])) for one in chosen]


def matching(pattern: str) -> list[str]:
    """Return the paths that a pattern names, in natural order.

    Raises:
        FileNotFoundError: for a pattern without a match.
    """
    paths = sorted(glob.glob(pattern), key=lambda path: (len(path), path))
    if not paths:
        raise FileNotFoundError(f"there is no {pattern}: train it by make tables")
    return paths


def runs_of(navigator: Spec) -> list[Spec]:
    """Return a navigator once for each run that its pattern names."""
    name, _, pattern = navigator.partition("=") if isinstance(navigator, str) else ("", "", "")
    return [f"{name}={run}" for run in matching(pattern)] if "*" in pattern else [navigator]


def cell(runs: Sequence[Measures], measures: Sequence[str]) -> str:
    """Return measures of the episodes of one or several runs; of several, the SPL has an interval."""
    summaries = [summarize(episodes) for episodes in runs]
    if len(summaries) == 1:
        return " / ".join("—" if math.isnan(summaries[0][name]) else f"{summaries[0][name]:.1f}" for name in measures)
    return " / ".join(
        mean_of_runs([run[name] for run in summaries], form=".1f", interval=name == "spl") for name in measures
    )


def names(navigator: Spec) -> list[str]:
    """Return the label of a navigator, with its options, what it was trained on, and what it is given.

    A start that is known exactly has no numbers.
    """
    options = dict(navigator) if isinstance(navigator, Mapping) else {"name": navigator}
    text, *known = about(options.pop("name").partition("=")[0])
    shown = {key: "" if value == [0.0, 0.0, 0.0] else value for key, value in options.items()}
    return [", ".join([text, *(f"{key.replace('_', ' ')} {value}".strip() for key, value in shown.items())]), *known]
