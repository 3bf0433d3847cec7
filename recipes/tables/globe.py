"""Flights over the whole Earth, poles and places of weak horizontal field included, sorted by where they are.

Starts are uniform over the sphere, destinations uniform over the ring of 300-500 km about them, and start headings
random. The field is IGRF-14 itself, without regions and their edges.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from flights import flown
from torch import Tensor
from torchrl.data import Unbounded
from tqdm import tqdm

from magrl import paper
from magrl.envs import GeomagneticNavEnv, Region, Regions, Scenario, Tasks
from magrl.envs.specs import state_spec
from magrl.envs.tasks import task_set
from magrl.evaluation.runs import NO_NOISE, Noise
from magrl.evaluation.tables import markdown_table
from magrl.field import IGRF, elements_at, elements_gradient_at
from magrl.geodesy import geodesic, move
from magrl.guidance import OBJECTIVE_FLOORS

EARTH = Region((-90, 90), (-180, 180))
CHUNK = 1000  # tasks flown at a time
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
    return f"{rate:.1f} / {spl:.1f} / " + ("—" if math.isnan(steps) else f"{steps:.1f}")


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
