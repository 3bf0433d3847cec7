"""Flights over the whole Earth, poles and places of weak horizontal field included, sorted by where they are.

Starts are uniform over the sphere, destinations uniform over the ring of 300-500 km about them, and start headings
random. The field is IGRF-14 itself, without regions and their edges.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from flights import flown, number
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor
from torchrl.data import Unbounded
from tqdm import tqdm

from magrl import paper
from magrl.envs import GeomagneticNavEnv, Region, Regions, Scenario, Tasks
from magrl.envs.specs import state_spec
from magrl.envs.tasks import task_set
from magrl.evaluation.maps import coastlines
from magrl.evaluation.runs import NO_NOISE, Noise
from magrl.evaluation.tables import markdown_table
from magrl.field import IGRF, elements_at, elements_gradient_at
from magrl.geodesy import geodesic, move
from magrl.guidance import OBJECTIVE_FLOORS

EARTH = Region((-90, 90), (-180, 180))
CHUNK = 1000  # tasks flown at a time
WEAK_NT, PARALLEL = 8000, 0.1
"""Contours of the map: B_H, and the weakest change below which gradients are nearly parallel."""
STEP_KM = 25.0
"""Distance over which elements change by about their floors :data:`~magrl.guidance.OBJECTIVE_FLOORS`."""
BANDS = {
    "latitude": {
        "latitude of the start up to 30°": 30.0,
        "latitude 30° to 60°": 60.0,
        "latitude 60° to 75°": 75.0,
        "latitude 75° to 85°": 85.0,
        "latitude 85° to 90°": math.inf,
    },
    "intensity_nt": {
        "smallest B_H on the way below 2000 nT": 2000.0,
        "smallest B_H 2000 to 4000 nT": 4000.0,
        "smallest B_H 4000 to 8000 nT": 8000.0,
        "smallest B_H above 8000 nT": math.inf,
    },
    "weakest": {
        "weakest change on the way below 0.05": 0.05,
        "weakest change 0.05 to 0.1": 0.1,
        "weakest change 0.1 to 0.2": 0.2,
        "weakest change 0.2 to 0.5": 0.5,
        "weakest change above 0.5": math.inf,
    },
}
"""Rows of the table: by property of a task, the upper end of each band, which begins where the one before it ends."""

Measures = Mapping[str, Tensor]


class GlobeEnv(GeomagneticNavEnv):
    """The environment over the whole Earth, where D takes every value, so that readings have no bounds to check."""

    def _make_specs(self, boxes: Regions) -> None:  # noqa: ARG002 - D is bounded in no box that holds a pole
        super()._make_specs(Regions.of(Region((-1, 1), (0, 1))))  # of any ordinary place; what differs follows
        for key in ("field", "target_field"):
            self.observation_spec[key] = Unbounded((self.num_envs, 3))
        self.state_spec = state_spec(self.observation_spec)


def earth_tasks(number: int, seed: int = 0) -> Tasks:
    """Return random tasks all over the Earth."""
    return task_set(number, 3 * paper.FIRST_RESERVED_SEED + seed, EARTH)


def measured(navigator: str, field: IGRF, tasks: Tasks, noise: Noise) -> Measures:
    """Return ``success``, ``spl`` and ``steps`` of each task at a level of noise, ``(M,)``."""
    parts = []
    for first in tqdm(range(0, len(tasks.start), CHUNK), unit="thousand tasks"):
        part = Tasks(*(ends[first : first + CHUNK] for ends in tasks))
        scenario = Scenario(region=EARTH, margin_deg=0, field=field, tasks=part)
        # the seed gives each chunk headings and noise of its own
        env = GlobeEnv(scenario, num_envs=len(part.start), start_heading="random", seed=first)
        parts.append(flown(navigator, env, noise))
    return {key: torch.cat([part[key] for part in parts]) for key in ("success", "spl", "steps")}


def weakest_change(field: IGRF, position: Tensor) -> Tensor:
    """Return how little D, I and B_H change over 25 km in the direction in which they change least, ``(...)``.

    In units of the floors of the objective: about 1 in an ordinary field, 0 where all three gradients are parallel.

    Args:
        field: field model.
        position: ``(..., 2)`` latitude, longitude [deg].
    """
    floors = torch.tensor(OBJECTIVE_FLOORS, dtype=torch.float64)
    return torch.linalg.svdvals(STEP_KM * elements_gradient_at(field, position) / floors.unsqueeze(-1))[..., 1]


def properties(field: IGRF, tasks: Tasks) -> Measures:
    """Return what the table sorts tasks by, ``(M,)``, from eleven places of each shortest path."""
    latitude, longitude = tasks.start.unsqueeze(1).unbind(-1)
    distance, bearing = geodesic(latitude, longitude, *tasks.target.unsqueeze(1).unbind(-1))
    share = torch.linspace(0, 1, 11, dtype=torch.float64)
    path = torch.stack(move(latitude, longitude, bearing, distance * share), -1)
    return {
        "latitude": tasks.start[:, 0].abs(),
        "intensity_nt": elements_at(field, path)[..., 2].amin(1),
        "weakest": weakest_change(field, path).amin(1),
    }


def cell(measures: Measures, chosen: Tensor) -> str:
    """Return SR, SPL and steps of some tasks, ``(M,)`` bool."""
    rate, spl = (100 * measures[key][chosen].double().mean().item() for key in ("success", "spl"))
    steps = measures["steps"][measures["success"] & chosen].double().mean().item()
    return " / ".join(map(number, (rate, spl, steps)))


def table(results: Mapping[str, Measures], known: Measures) -> str:
    """Return the table from the measures at each level of noise, without rows that hold no task."""
    bands = {"all": torch.ones_like(known["latitude"], dtype=torch.bool)}
    for key, ends in BANDS.items():
        low = 0.0
        for name, high in ends.items():
            bands[name] = (known[key] >= low) & (known[key] < high)
            low = high
    rows = [
        [name, int(chosen.sum()), *(cell(measures, chosen) for measures in results.values())]
        for name, chosen in bands.items()
        if chosen.any()
    ]
    return markdown_table(["tasks", "number", *results], rows)


def globe(navigator: str = "anywhere", *, tasks: int = 10_000, noise: Noise = (0.05, 0.05, 5.0)) -> str:
    """Return a row for each band of tasks, with perfect and with noisy sensors."""
    field, ends = IGRF("2025-01-01"), earth_tasks(tasks)
    levels = {"perfect sensors": NO_NOISE, "{:g}°, {:g}°, {:g} nT".format(*noise): noise}
    return table(
        {name: measured(navigator, field, ends, level) for name, level in levels.items()}, properties(field, ends)
    )


def globe_map(field: IGRF, tasks: Tasks, measures: Measures) -> Figure:
    """Return the map of the Earth (Mollweide's equal-area projection) with each task at its start."""
    figure = Figure(figsize=(9, 4.9), layout="constrained")
    axes = figure.add_subplot(projection="mollweide")
    axes.plot(*np.radians(coastlines()).T[::-1], color="#8c8c8c", lw=0.6)
    draw_field(axes, field)
    (north, east), arrived = np.radians(tasks.start.numpy()).T, measures["success"].numpy()
    order = np.flatnonzero(arrived)[(-measures["spl"].numpy()[arrived]).argsort(kind="stable")]  # detours on top
    spl = 100 * measures["spl"].numpy()[order]
    dots = axes.scatter(east[order], north[order], c=spl, s=4, lw=0, cmap="viridis", vmin=50, vmax=100)
    axes.plot(east[~arrived], north[~arrived], "x", color="#D55E00", ms=5, mew=1.5, label="not arrived")
    figure.colorbar(dots, shrink=0.7, pad=0.02, label="SPL of arrived tasks [%]", extend="min")
    axes.set(xticklabels=[], yticklabels=[])
    axes.grid(lw=0.3)
    figure.legend(loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return figure


def draw_field(axes: Axes, field: IGRF) -> None:
    """Draw the dip poles, where B_H is weak, and where gradients are nearly parallel."""
    latitude, longitude = torch.arange(-89.5, 90.0).double(), torch.arange(-180.0, 181.0).double()
    places = torch.stack(torch.meshgrid(latitude, longitude, indexing="ij"), -1)
    intensity, weakest = elements_at(field, places)[..., 2], weakest_change(field, places)
    where = np.radians(longitude.numpy()), np.radians(latitude.numpy())
    for values, level, look in ((intensity, WEAK_NT, "-"), (weakest, PARALLEL, ":")):
        axes.contour(*where, values, [level], colors="black", linewidths=0.9, linestyles=look)
    axes.plot([], [], "k-", lw=0.9, label=f"$B_H$ = {WEAK_NT} nT")
    axes.plot([], [], "k:", lw=0.9, label=f"weakest change {PARALLEL}")
    halves = (places[half].reshape(-1, 2)[intensity[half].argmin()] for half in (latitude < 0, latitude > 0))
    north, east = np.radians(torch.stack(tuple(halves)).numpy()).T
    axes.plot(east, north, "*", color="white", ms=13, mec="black", clip_on=False, zorder=4, label="dip pole")
