"""Fly an agent over the whole Earth, poles and places of weak horizontal field included, and map where it fails.

    python recipes/tables/globe.py                        # the pretrained agent: less than a minute on one core
    python recipes/tables/globe.py kalman --tasks 2000 --table runs/kalman.md --figure runs/kalman.png

Starts are uniform over the sphere, destinations uniform over the ring of 300-500 km about them, and start headings
random. The field is IGRF-14 itself, without regions and their edges. Writes a Markdown table: success rate (SR) and
success weighted by path length (SPL) in percent, and steps over successes, with perfect and with noisy sensors; and a
map of the tasks with perfect sensors. Files of an earlier call are replaced.
"""

from __future__ import annotations

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # spinning threads slow each other down; read when torch is imported

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor
from torchrl.data import Unbounded
from tqdm import tqdm

from magrl import paper
from magrl.checks import check_number
from magrl.envs import GeomagneticNavEnv, Region, Regions, Scenario, Tasks
from magrl.envs.specs import state_spec
from magrl.envs.tasks import task_set
from magrl.evaluation import episode_measures, evaluation_rollout
from magrl.evaluation.flight import coastlines
from magrl.evaluation.navigators import make_navigator
from magrl.evaluation.tables import markdown_table
from magrl.field import IGRF, elements_at, elements_gradient_at
from magrl.files import check_writable
from magrl.geodesy import geodesic, move
from magrl.guidance import OBJECTIVE_FLOORS
from magrl.training import UsageError, command
from magrl.transforms import with_sensor_noise

RECIPE = "globe.py"
EARTH = Region((-90, 90), (-180, 180))
CHUNK = 1000  # tasks flown at a time
COLORS = 200  # of the map
STEP_KM = 25.0
"""Distance over which elements change by about their floors :data:`~magrl.guidance.OBJECTIVE_FLOORS`."""
WEAK_NT, PARALLEL = 8000, 0.1
"""Contours of the map: B_H, and the weakest change below which gradients are nearly parallel."""
ROWS = (
    ("all", "latitude", 0, math.inf),
    ("latitude of the start up to 30°", "latitude", 0, 30),
    ("latitude 30° to 60°", "latitude", 30, 60),
    ("latitude 60° to 75°", "latitude", 60, 75),
    ("latitude 75° to 85°", "latitude", 75, 85),
    ("latitude 85° to 90°", "latitude", 85, math.inf),
    ("smallest B_H on the way below 2000 nT", "intensity_nt", 0, 2000),
    ("smallest B_H 2000 to 4000 nT", "intensity_nt", 2000, 4000),
    ("smallest B_H 4000 to 8000 nT", "intensity_nt", 4000, 8000),
    ("smallest B_H above 8000 nT", "intensity_nt", 8000, math.inf),
    ("weakest change on the way below 0.05", "weakest", 0, 0.05),
    ("weakest change 0.05 to 0.1", "weakest", 0.05, 0.1),
    ("weakest change 0.1 to 0.2", "weakest", 0.1, 0.2),
    ("weakest change 0.2 to 0.5", "weakest", 0.2, 0.5),
    ("weakest change above 0.5", "weakest", 0.5, math.inf),
)
"""Rows of the table: name, property of a task, and the band that it must lie in."""

Measures = Mapping[str, Tensor]


@dataclass
class Config:
    """Navigator, sensors and files."""

    navigator: tyro.conf.Positional[str] = "anywhere"
    """Navigator, as in recipes/evaluate.py."""
    tasks: int = 10_000
    """Number of tasks."""
    noise: tuple[float, float, float] = (0.05, 0.05, 5.0)
    """Standard deviations of the noise on D [deg], I [deg], B_H [nT] in the column of noisy sensors."""
    date: str = "2025-01-01"
    """Date of the field, 1900 to 2030 (IGRF-14)."""
    zeta: float = 0.01
    """Arrival threshold on the objective (Eq. 2-7)."""
    max_steps: int = 50
    """Moves after which an episode ends."""
    seed: int = 0
    """Random seed of tasks, start headings and noise; no training uses it."""
    table: Path = Path("runs/globe.md")
    """File of the table, which is replaced."""
    figure: Path = Path("runs/globe.png")
    """File of the map, which is replaced."""


class GlobeEnv(GeomagneticNavEnv):
    """The environment over the whole Earth, where D takes every value, so that readings have no bounds to check."""

    def _make_specs(self, boxes: Regions) -> None:  # noqa: ARG002 - D is bounded in no box that holds a pole
        super()._make_specs(Regions.of(Region((-1, 1), (0, 1))))  # of any ordinary place; what differs follows
        for key in ("field", "target_field"):
            self.observation_spec[key] = Unbounded((self.num_envs, 3))
        self.state_spec = state_spec(self.observation_spec)


def flown(config: Config, field: IGRF, tasks: Tasks, noise: tuple[float, float, float], bar: tqdm) -> Measures:
    """Return ``success``, ``spl`` and ``steps`` of each task at a level of noise, ``(M,)``."""
    parts = []
    for first in range(0, len(tasks.start), CHUNK):
        part = Tasks(*(ends[first : first + CHUNK] for ends in tasks))
        env = GlobeEnv(
            Scenario(region=EARTH, margin_deg=0, field=field, tasks=part),
            num_envs=len(part.start),
            max_steps=config.max_steps,
            zeta=config.zeta,
            start_heading="random",
            seed=config.seed + first,  # other headings and noise than in other chunks
        )
        navigator = make_navigator(config.navigator, env, seed=config.seed, noise=noise)
        parts.append(episode_measures(evaluation_rollout(with_sensor_noise(env, noise, env.seed), navigator)))
        bar.update(len(part.start))
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


def table(results: Sequence[Measures], known: Measures, noise: tuple[float, float, float]) -> str:
    """Return the table, from the measures with perfect and with noisy sensors, without rows that hold no task."""
    rows = []
    for name, key, low, high in ROWS:
        chosen = (known[key] >= low) & (known[key] < high)
        if chosen.any():
            rows.append([name, int(chosen.sum()), *(cell(measures, chosen) for measures in results)])
    return markdown_table(["tasks", "number", "perfect sensors", "{:g}°, {:g}°, {:g} nT".format(*noise)], rows)


def cell(measures: Measures, chosen: Tensor) -> str:
    """Return SR, SPL and steps of some tasks, ``(M,)`` bool."""
    rate, spl = (100 * measures[key][chosen].double().mean().item() for key in ("success", "spl"))
    steps = measures["steps"][measures["success"] & chosen].double().mean().item()
    return f"{rate:.1f} / {spl:.1f} / " + ("—" if math.isnan(steps) else f"{steps:.1f}")


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


def write_png(path: Path, figure: Figure) -> None:
    """Write a figure with few colors, which keeps ten thousand dots small."""
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(120)
    canvas.draw()
    Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB").quantize(COLORS).save(path, optimize=True)


def globe(config: Config) -> None:
    """Fly, and write the table and the map.

    Raises:
        UsageError: for a navigator or a setting that is wrong.
    """
    try:
        check_number(0, noise=min(config.noise))
        for file in (config.table, config.figure):
            check_writable(file)
        field = IGRF(config.date)
        tasks = task_set(config.tasks, 3 * paper.FIRST_RESERVED_SEED + config.seed, EARTH)
        with tqdm(total=2 * config.tasks, unit="task") as bar:
            results = [flown(config, field, tasks, noise, bar) for noise in ((0.0, 0.0, 0.0), config.noise)]
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from error
    config.table.write_text(table(results, properties(field, tasks), config.noise) + "\n")
    write_png(config.figure, globe_map(field, tasks, results[0]))
    print(config.table, config.figure, sep="\n")


if __name__ == "__main__":
    command(RECIPE, lambda: globe(tyro.cli(Config, prog=RECIPE, description=__doc__)))
