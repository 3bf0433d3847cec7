"""Flights over the whole Earth, poles and places of weak horizontal field included, sorted by where they are.

Starts are uniform over the sphere, destinations uniform over the ring of 300-500 km about them, and start headings
random. The field is IGRF-14 itself, without regions and their edges.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

from magrl.benchmark import SEED, episode_table
from magrl.envs import GeomagneticNavEnv, Region, Regions, Scenario, Tasks
from magrl.envs.specs import state_spec
from magrl.envs.tasks import task_set
from magrl.evaluation import Flight, episode_measures
from magrl.evaluation.maps import coastlines
from magrl.evaluation.tables import markdown_table
from magrl.field import IGRF, elements_at, elements_gradient_at
from magrl.geodesy import geodesic, move
from magrl.guidance import OBJECTIVE_FLOORS
from magrl.sensor_std import PERFECT, Noise

import numpy as np
import torch
from flights import MEASURES, Errors, Measures, Spec, Table, cell, flown, names
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor
from torchrl.data import Unbounded
from tqdm import tqdm

EARTH, FIELD = Region((-90, 90), (-180, 180)), IGRF("2025-01-01")
CHUNK = 1000  # tasks flown at a time
WEAK_NT, PARALLEL = 8000, 0.1
"""Contours of the map: B_H, and the weakest change below which gradients are nearly parallel."""
STEP_KM = 25.0
"""Distance over which elements change by about their floors :data:`~magrl.guidance.OBJECTIVE_FLOORS`."""
BANDS = {
    "latitude": ("latitude of the start {} to {}°", (0, 30, 60, 75, 85, 90)),
    "intensity_nt": ("smallest B_H on the way {} to {} nT", (0, 2000, 4000, 8000, math.inf)),
    "weakest": ("weakest change on the way {} to {}", (0, 0.05, 0.1, 0.2, 0.5, math.inf)),
}
"""Rows of the table: by property of a task, the label of a band, and the ends of the bands."""


class GlobeEnv(GeomagneticNavEnv):
    """The environment over the whole Earth, where D takes every value, so that readings have no bounds to check."""

    def _make_specs(self, boxes: Regions) -> None:  # noqa: ARG002 - D is bounded in no box that holds a pole
        super()._make_specs(Regions.of(Region((-1, 1), (0, 1))))  # of any ordinary place; what differs follows
        for key in ("field", "target_field"):
            self.observation_spec[key] = Unbounded((self.num_envs, 3))
        self.state_spec = state_spec(self.observation_spec)


class GlobeFlight(Flight):
    """Vehicles all over the Earth."""

    env_class = GlobeEnv


def earth_tasks(count: int) -> Tasks:
    """Return random tasks all over the Earth."""
    return task_set(count, SEED, EARTH)


def measured(navigator: Spec, tasks: Tasks, errors: Errors) -> Measures:
    """Return the measures of an episode of each task, ``(M,)``."""
    parts = []
    for first in tqdm(range(0, len(tasks.start), CHUNK), unit="thousand tasks"):
        part = Tasks(*(ends[first : first + CHUNK] for ends in tasks))
        scenario = Scenario(region=EARTH, margin_deg=0, field=FIELD, tasks=part)
        # the seed gives each chunk headings and noise of its own
        flight = GlobeFlight(scenario, errors=errors, start_heading="random", seed=first)
        parts.append(episode_measures(flown(flight, navigator)))
    return {key: torch.cat([part[key] for part in parts]) for key in parts[0]}


def weakest_change(position: Tensor, field: IGRF = FIELD) -> Tensor:
    """Return how little D, I and B_H change over 25 km in the direction in which they change least, ``(...)``.

    In units of the floors of the objective: about 1 in an ordinary field, 0 where all three gradients are parallel.

    Args:
        position: ``(..., 2)`` latitude, longitude [deg].
        field: field model.
    """
    floors = torch.tensor(OBJECTIVE_FLOORS, dtype=torch.float64)
    return torch.linalg.svdvals(STEP_KM * elements_gradient_at(field, position) / floors.unsqueeze(-1))[..., 1]


def properties(tasks: Tasks) -> Measures:
    """Return what the table sorts tasks by, ``(M,)``, from eleven places of each shortest path."""
    latitude, longitude = tasks.start.unsqueeze(1).unbind(-1)
    distance, bearing = geodesic(latitude, longitude, *tasks.target.unsqueeze(1).unbind(-1))
    path = torch.stack(move(latitude, longitude, bearing, distance * torch.linspace(0, 1, 11).double()), -1)
    weakest, intensity = weakest_change(path).amin(1), elements_at(FIELD, path)[..., 2].amin(1)
    return {"latitude": tasks.start[:, 0].abs(), "intensity_nt": intensity, "weakest": weakest}


def table(results: Mapping[str, Measures], sorted_by: Measures) -> str:
    """Return the table from the measures at each level of noise, without rows that hold no task."""
    bands = {"all": torch.ones_like(sorted_by["latitude"], dtype=torch.bool)}
    for key, (label, ends) in BANDS.items():
        for low, high in itertools.pairwise(ends):
            bands[label.format(low, high).replace("to inf", "and more")] = (sorted_by[key] >= low) & (
                sorted_by[key] < high
            )
    rows = [
        [
            name,
            int(chosen.sum()),
            *(cell([{key: x[chosen] for key, x in values.items()}], MEASURES) for values in results.values()),
        ]
        for name, chosen in bands.items()
        if chosen.any()
    ]
    return markdown_table(["tasks", "number", *results], rows)


def globe(navigators: Sequence[Spec], *, tasks: int = 10_000, noise: Noise = (0.05, 0.05, 5.0)) -> Table:
    """Return a row for each band of tasks, with perfect and with noisy sensors, of one navigator."""
    (navigator,), ends = navigators, earth_tasks(tasks)
    levels = {"perfect sensors": PERFECT.noise, "{:g}°, {:g}°, {:g} nT".format(*noise): noise}
    results = {name: measured(navigator, ends, level) for name, level in levels.items()}
    episodes = [
        episode_table(values, ends.region, navigator=names(navigator)[0], level=level)
        for level, values in results.items()
    ]
    return Table(table(results, properties(ends)), episodes)


def globe_map(tasks: Tasks, measures: Measures) -> Figure:
    """Return the map of the Earth (Mollweide's equal-area projection) with each task at its start."""
    figure = Figure(figsize=(9, 4.9), layout="constrained")
    axes = figure.add_subplot(projection="mollweide")
    axes.plot(*np.radians(coastlines()).T[::-1], color="#8c8c8c", lw=0.6)
    draw_field(axes)
    (north, east), arrived = np.radians(tasks.start.numpy()).T, measures["success"].numpy()
    order = np.flatnonzero(arrived)[(-measures["spl"].numpy()[arrived]).argsort(kind="stable")]  # detours on top
    spl = 100 * measures["spl"].numpy()[order]
    dots = axes.scatter(east[order], north[order], c=spl, s=4, lw=0, cmap="viridis", vmin=50, vmax=100)
    axes.plot(east[~arrived], north[~arrived], "x", color="#D55E00", ms=5, mew=1.5, label="not arrived")
    figure.colorbar(dots, shrink=0.7, pad=0.02, label="SPL of arrived tasks [%]", extend="min")
    axes.set(xticklabels=[], yticklabels=[])
    figure.legend(loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return figure


def two_elements_map() -> Figure:
    """Return the map of the angle between the gradients of I and B_H: where it is small, two elements give a line and
    not a place."""
    figure = Figure(figsize=(9, 4.6), layout="constrained")
    axes = figure.add_subplot(projection="mollweide")
    latitude, longitude = torch.arange(-89.5, 90.0).double(), torch.arange(-180.0, 181.0).double()
    places = torch.stack(torch.meshgrid(latitude, longitude, indexing="ij"), -1)
    north, east = elements_gradient_at(FIELD, places)[..., 1:, :].unbind(-1)
    bearing = torch.rad2deg(torch.atan2(east, north))
    angle = 90 - (bearing.diff(dim=-1).squeeze(-1).remainder(180) - 90).abs()
    where = np.radians(longitude.numpy()), np.radians(latitude.numpy())
    filled = axes.contourf(*where, angle, [0, 5, 10, 20, 45, 90], cmap="viridis")
    axes.plot(*np.radians(coastlines()).T[::-1], color="white", lw=0.6)
    weight = torch.cos(torch.deg2rad(latitude)) * (latitude.abs() < 60)
    share = (weight @ (angle < 5).double().mean(-1)) / weight.sum()
    axes.set(xticklabels=[], yticklabels=[], title=f"below 5° at {100 * share:.0f} % of places between 60° S and 60° N")
    figure.colorbar(filled, shrink=0.7, pad=0.02, label="angle between the gradients of I and B_H [°]")
    return figure


def draw_field(axes: Axes) -> None:
    """Draw the dip poles, where B_H is weak, and where gradients are nearly parallel."""
    latitude, longitude = torch.arange(-89.5, 90.0).double(), torch.arange(-180.0, 181.0).double()
    places = torch.stack(torch.meshgrid(latitude, longitude, indexing="ij"), -1)
    intensity, weakest = elements_at(FIELD, places)[..., 2], weakest_change(places)
    where = np.radians(longitude.numpy()), np.radians(latitude.numpy())
    for values, level, look, name in (
        (intensity, WEAK_NT, "-", f"$B_H$ = {WEAK_NT} nT"),
        (weakest, PARALLEL, ":", f"weakest change {PARALLEL}"),
    ):
        axes.contour(*where, values, [level], colors="black", linewidths=0.9, linestyles=look)
        axes.plot([], [], f"k{look}", lw=0.9, label=name)
    halves = [places[half].reshape(-1, 2)[intensity[half].argmin()] for half in (latitude < 0, latitude > 0)]
    north, east = np.radians(torch.stack(halves).numpy()).T
    axes.plot(east, north, "*", color="white", ms=13, mec="black", clip_on=False, zorder=4, label="dip pole")
