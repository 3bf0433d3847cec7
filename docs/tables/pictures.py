"""Draw the pictures of the README: an underwater vehicle in an unknown current, and an episode of each named task.

    python docs/tables/pictures.py    # docs/figures/underwater.gif, eddies.png and task-*.png; three minutes

The flights of the animation are two cells of the table known-1200: 300 trips by dead reckoning and by kalman, which has
elements measured at the destination and declares at once, of which it shows one that dead reckoning misses.
"""

from __future__ import annotations

import math
import sys
import tomllib
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from magrl.envs import Region
from magrl.envs.rendering import AREA, ELEMENT_COLORS, START, SYMBOLS, TARGET, contour_lines
from magrl.errors.motion import EDDIES, eddy_velocity, eddy_waves
from magrl.evaluation import episode_measures, evaluation_rollout
from magrl.evaluation.episodes import first_episode_mask
from magrl.evaluation.maps import LAND, coastlines, displacement_ellipse
from magrl.evaluation.scores import SEED
from magrl.field import IGRF, FieldModel
from magrl.files import read_text, write_with
from magrl.geodesy import geodesic
from magrl.named_tasks import EDDY_MOTION, NAMED_TASKS
from magrl.training import command
from magrl.transforms.areas import outlines

import numpy as np
import torch
import tyro
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver
from PIL import Image
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

sys.path.insert(0, str(Path(__file__).parent))
from bars import TASKS, flown
from flights import COLORS, Flights, believed_places, image_of, write_picture

SHOWN, WITHIN_KM = 212, 25.0
"""Trip of the animation, chosen in the open sea with a coast in sight, and the radius of arrival."""
FIELD = IGRF("2025-01-01")
GRAY, BLUE, VERMILION = "#707070", "#0072B2", "#D55E00"
KM_PER_DEG = 111.2
COUNTER = ((0.63, "black"), (0.65, GRAY), (0.795, "black"), (0.825, BLUE))
"""Place and color of each part of the counter."""
PIECE_KM, FRAME_MS, LAST_MS = 30.0, 120, 3000
"""Longest distance between two frames, and their durations."""
VEHICLES, ROOM_KM = 16, {"box": 0.0, "anywhere": 400.0}
"""Vehicles of a rollout, and room around an episode: none shows its whole region."""
COMMAND = "python docs/tables/pictures.py"


class Voyage(NamedTuple):
    """A flight at the start and after each step: true and believed places ``(T + 1, 2)`` [deg], and the covariance of
    the belief ``(T + 1, 2, 2)`` [km^2]."""

    true: Tensor
    believed: Tensor
    covariance: Tensor

    @property
    def error_km(self) -> float:
        """Error of the belief at the end."""
        return apart_km(self.true[-1], self.believed[-1])

    @classmethod
    def of(cls, steps: TensorDictBase, belief: str) -> Voyage:
        """Return the voyage of an episode ``(T,)`` by one of :func:`believed_places`."""
        steps = first_episode(steps)
        places = believed_places(steps["next"][None])[belief][0]
        key = "track", "displacement", "covariance"
        pairs = ("position", steps["next", "position"]), ("start_place", places), (key, steps["next", *key])
        return cls(*(torch.cat((steps[name][:1], after)).double() for name, after in pairs))

    def at(self, time: float) -> Voyage:
        """Return the voyage up to a time in steps; after its end, all of it."""
        step, last = int(time), len(self.true) - 1
        if time >= last:
            return self
        return Voyage(
            *(torch.cat((part[: step + 1], torch.lerp(*part[step : step + 2], time % 1)[None])) for part in self)
        )


def voyages(shown: int = SHOWN) -> tuple[Tensor, dict[str, tuple[Voyage, float]]]:
    """Return the destination of the trip that is shown, and voyage and arrivals [%] of each navigator."""
    table = tomllib.loads(read_text(Path(__file__).with_name("tables.toml")))["known-1200"]
    far = Flights.of(**{key: table[key] for key in table if key not in ("kind", "measures", "navigators", "against")})
    made, known, measured = {}, {"model": "IGRF-13", "start_km": 5.0}, far.sheet.target_std
    for name, belief, std in (("dead_reckoning", "compass and log", None), ("kalman", "and IGRF-13", measured)):
        flight = far.flight(far.errors["underwater"], **known, confidence=0.0, target_std=std)
        navigator = flight.navigator(name)
        steps = evaluation_rollout(flight.env_of(navigator, track=True), navigator)
        made[name] = Voyage.of(steps[shown], belief), 100 * episode_measures(steps)["success"].double().mean().item()
    return steps[shown, 0]["target_position"].double(), made


class Animation:
    """Two voyages on a map, drawn at any time.

    Args:
        target: destination ``(2,)`` [deg].
        reckoning: voyage of dead reckoning.
        filtered: voyage of kalman.
    """

    def __init__(self, target: Tensor, reckoning: Voyage, filtered: Voyage) -> None:
        self.target, self.voyages = target, (reckoning, filtered)
        self.figure = Figure(figsize=(7.2, 5.8), dpi=100)
        axes = self.figure.add_axes((0.01, 0.165, 0.98, 0.735))
        shown = torch.cat((reckoning.true, reckoning.believed, filtered.true, target[None]))
        draw_map(axes, FIELD, box_around(axes, shown), alpha=0.4)
        axes.plot(*coastlines().T[::-1], color=LAND, lw=2.5)
        draw_scale(axes, 200.0)
        circle = displacement_ellipse(target, torch.zeros(2), WITHIN_KM**2 * torch.eye(2), deviations=1)
        axes.plot(*circle.T.flip(0), color=TARGET, lw=2.5)
        axes.plot(*target.flip(-1)[:, None], "^", color=TARGET, ms=8, zorder=3)
        (self.ellipse,) = axes.fill([0], [0], fc=(*to_rgb(BLUE), 0.25), ec=BLUE, lw=2, label="its estimate, 2σ")
        self.lines = [
            axes.plot([], [], style, color=color, lw=3, ms=9, mew=2.5, mfc=fill, markevery=[-1], label=label)[0]
            for style, color, fill, label in (
                ("o--", GRAY, "white", "where it believes it is"),
                ("o-", GRAY, GRAY, "dead reckoning"),
                ("o-", BLUE, BLUE, "magrl (kalman)"),
            )
        ]
        handles = [self.lines[1], self.lines[0], self.lines[2], self.ellipse]
        self.figure.legend(handles=handles, loc="lower center", ncols=2, fontsize=18, frameon=False)
        self.texts = [self.figure.text(x, 0.95, "", color=color, fontsize=19, va="center") for x, color in COUNTER]
        self.texts[0].set_ha("right")

    def image(self, time: float, verdict: str = "") -> Image.Image:
        """Return the map at a time in steps, with a text above the paths."""
        here, there = (voyage.at(time) for voyage in self.voyages)
        for line, places in zip(self.lines, (here.believed, here.true, there.true), strict=True):
            line.set_data(*places.T.flip(0))
        ellipse = displacement_ellipse(there.believed[-1], torch.zeros(2), there.covariance[-1])
        self.ellipse.set_xy(ellipse.flip(-1))
        before = [voyage.at(int(time)) for voyage in self.voyages]
        error, other = (f"{voyage.error_km:.0f} km" for voyage in before)
        left = apart_km(before[1].true[-1], self.target)
        shown = (f"step {int(time)} · {left:.0f} km to go · error", error, "/", other)
        for text, content in zip(self.texts, shown, strict=True):
            text.set_text(content)
        if verdict:
            box = {"facecolor": "white", "edgecolor": BLUE, "lw": 2, "pad": 14}
            self.figure.text(0.66, 0.76, verdict, fontsize=22, ha="center", va="center", linespacing=1.6, bbox=box)
        return image_of(self.figure)

    def frames(self, verdict: str) -> Iterator[Image.Image]:
        """Yield images at most :data:`PIECE_KM` apart, and the verdict."""
        for step in range(len(self.voyages[1].true) - 1):
            legs = [apart_km(*(voyage.at(end).true[-1] for end in (step, step + 1))) for voyage in self.voyages]
            pieces = max(1, math.ceil(max(legs) / PIECE_KM))
            yield from (self.image(step + piece / pieces) for piece in range(pieces))
        yield self.image(step + 1)
        yield self.image(step + 1, verdict)


def apart_km(one: Tensor, other: Tensor) -> float:
    """Return the distance of two places ``(2,)`` [km]."""
    return geodesic(*one, *other)[0].item()


def box_around(axes: Axes, places: Tensor, room_km: float = 30.0) -> Region:
    """Return the box of a map that shows places ``(P, 2)`` [deg] with room around them, and fills the axes."""
    low, high = places.amin(0), places.amax(0)
    narrow, width, height = math.cos(math.radians((low + high)[0] / 2)), *axes.bbox.size
    north, east = (high - low) * torch.tensor([1, narrow]) / 2 + room_km / KM_PER_DEG
    half = max(north, east * height / width)
    half = torch.stack((half, half * width / height / narrow))
    return Region(*torch.stack(((low + high) / 2 - half, (low + high) / 2 + half), -1).tolist())


def draw_map(axes: Axes, field: FieldModel, box: Region, **look: float) -> None:
    """Draw contours of a field in a box, without any text."""
    for lines in contour_lines(axes, field, box).values():
        lines.set(**look)
    axes.set(xlim=box.longitude, ylim=box.latitude, xticks=[], yticks=[])


def draw_scale(axes: Axes, length_km: float) -> None:
    """Draw a scale bar and the direction of north in the corners of a map."""
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    here = south + 0.04 * (north - south)
    bar = length_km / KM_PER_DEG / math.cos(math.radians(here))
    left = east - 0.04 * (east - west) - bar
    axes.plot([left, left + bar], [here, here], color="black", lw=4, zorder=4)
    look = {"fontsize": 17, "ha": "center", "backgroundcolor": "white"}
    axes.text(left + bar / 2, here + 0.012 * (north - south), f"{length_km:.0f} km", **look)
    arrow = {"arrowstyle": "<-", "lw": 2.5}
    axes.annotate("N", (0.06, 0.82), (0.06, 0.94), "axes fraction", arrowprops=arrow, fontsize=19, ha="center")


def first_episode(steps: TensorDictBase) -> TensorDictBase:
    """Return the steps of a vehicle ``(T,)`` to the end of its first episode."""
    return steps[first_episode_mask(steps["next", "done"][None])[0].flatten()]


def task_picture(task: str) -> Figure:
    """Return what sets a task apart: its region, fields of four planets, readings, their errors, areas or currents."""
    navigator, number = TASKS[task].picture
    env, rollout = flown(task, navigator, VEHICLES)
    figure = Figure(figsize=(3, 3), dpi=100)
    if task in ("readings", "storm"):
        steps = first_episode(rollout[number])["next"]
        draw_readings(figure, steps["field"] - steps["target_field" if task == "readings" else "true_field"])
        return figure
    side = 2 if task == "anywhere" else 1
    figure.subplots_adjust(0.01, 0.01, 0.99, 0.99, 0.04, 0.04)
    for episode, axes in enumerate(figure.subplots(side, side, squeeze=False).flat, number):
        draw_episode(axes, env, first_episode(rollout[episode]), ROOM_KM.get(task, 30.0))
    return figure


def draw_episode(axes: Axes, env: EnvBase, steps: TensorDictBase, room_km: float) -> None:
    """Draw an episode ``(T,)`` over contours of its field or over its currents; without room, in its whole region."""
    index = steps["region"][0, 0]
    region, areas, currents = env.region[index], steps.get("no_go_areas", None), steps.get("motion_error", None)
    path, target = path_of(steps, region), region.unwrapped(steps["target_position"][:1].double())
    rings = path.new_empty(0, 1, 2) if areas is None else outlines(areas[0], target[0])
    box = box_around(axes, torch.cat((path, target, rings.flatten(0, 1))), room_km) if room_km else region
    if currents is None:
        field = partial(env.field, index=index) if len(env.region) > 1 else env.field
        draw_map(axes, field, box, alpha=0.6, linewidth=1.4)
    else:
        draw_currents(axes, currents[0].double(), box, 12)
    for ring in rings:
        axes.fill(*ring.T.flip(0), color=AREA, zorder=2)
    axes.plot(*path.T.flip(0), ".-", color="black", lw=3, ms=10)
    axes.plot(*path[0].flip(0)[:, None], "s", color=START, ms=11)
    axes.plot(*target.T.flip(0), "^", color=TARGET, ms=14)


def path_of(steps: TensorDictBase, region: Region) -> Tensor:
    """Return the places ``(T + 1, 2)`` [deg] of an episode."""
    return region.unwrapped(torch.cat((steps["position"][:1], steps["next", "position"])).double())


def eddies_picture() -> Figure:
    """Return the true bearing and the trained agent in an episode of *Eddies*, over its currents.

    Of the first vehicles, the scores of both are nearest to their medians over all episodes in this one.
    """
    figure = Figure(figsize=(7.2, 7.4), dpi=100)
    axes, paths = figure.add_axes((0.01, 0.22, 0.98, 0.77)), []
    navigator, number = TASKS["eddies"].picture
    for name, label, color in (("geodesic", "true bearing", VERMILION), (navigator, "trained agent", BLUE)):
        env, rollout = flown("eddies", name, VEHICLES)
        steps = first_episode(rollout[number])
        paths.append(path_of(steps, env.region[0]))
        spent = f"{label}: {steps['next', 'leg'][:, 0].sum():.0f} km through the water"
        axes.plot(*paths[-1].T.flip(0), "o-", color=color, lw=3, ms=7, label=spent)
    target = steps["target_position"][0].double()
    arrows = draw_currents(axes, steps["motion_error"][0].double(), box_around(axes, torch.cat(paths)), 18)
    key = {"labelpos": "E", "coordinates": "figure", "fontproperties": {"size": 18}, "labelsep": 0.3}
    axes.quiverkey(arrows, 0.13, 0.035, 1.0, "1 km/h, the speed of the vehicle", **key)
    axes.plot(*paths[0][0].flip(0)[:, None], "s", color=START, ms=13)
    circle = displacement_ellipse(target, torch.zeros(2), WITHIN_KM**2 * torch.eye(2), deviations=1)
    axes.plot(*circle.T.flip(0), color=TARGET, lw=4, label="destination, within 25 km")
    figure.legend(loc="lower left", bbox_to_anchor=(0.06, 0.04), fontsize=18, frameon=False, labelspacing=0.3)
    draw_scale(axes, 100.0)
    return figure


def draw_currents(axes: Axes, numbers: Tensor, box: Region, side: int) -> Quiver:
    """Draw and return the currents of an episode of *Eddies* at places of a square grid in a box."""
    lines = (torch.linspace(*ends, side + 2).double()[1:-1] for ends in (box.latitude, box.longitude))
    places = torch.cartesian_prod(*lines)
    phases, directions = numbers[3:].tensor_split([EDDIES], -1)
    waves = eddy_waves(directions, EDDY_MOTION["eddy_km"])
    north, east = (EDDY_MOTION["eddies_km_h"] * eddy_velocity(places, waves, phases)).T
    axes.set(xlim=box.longitude, ylim=box.latitude, xticks=[], yticks=[])
    return axes.quiver(*places.T.flip(0), east, north, color=AREA, width=0.06 / side, scale=1.3 * side)


def draw_readings(figure: Figure, values: Tensor) -> None:
    """Draw values of D, I and B_H ``(T, 3)`` by step, a panel for each."""
    panels = figure.subplots(3, gridspec_kw={"left": 0.2, "right": 0.99, "bottom": 0.01, "top": 0.99})
    for axes, series, (name, color) in zip(panels, values.T, ELEMENT_COLORS.items(), strict=True):
        axes.axhline(0, color=AREA, lw=2)
        axes.plot(series, ".-", color=color, lw=3, ms=10)
        axes.set(xticks=[], yticks=[], ymargin=0.15)
        axes.set_ylabel(SYMBOLS[name], fontsize=22, rotation=0, ha="right", va="center")


def save_gif(path: Path, frames: Sequence[Image.Image]) -> None:
    """Write images of one size as an animated GIF that loops; an existing file is replaced."""
    sample = np.hstack([np.asarray(image) for image in (frames[0], frames[len(frames) // 2], frames[-1])])
    palette = Image.fromarray(sample).quantize(COLORS)  # one for all frames: unchanged pixels compress well
    start, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in frames)
    durations = [FRAME_MS] * len(others) + [LAST_MS]
    options = {"duration": durations, "loop": 0, "comment": f"{COMMAND}: trip {SHOWN} of table known-1200"}
    write_with(path, start.save, "GIF", save_all=True, append_images=others, **options)


def main(out: Path = Path("docs/figures")) -> None:
    """Draw all pictures.

    Args:
        out: Folder of the pictures, which are replaced.
    """
    target, flights = voyages()
    (reckoning, few), (filtered, many) = flights.values()
    frames = Animation(target, reckoning, filtered).frames(
        f"dead reckoning {few:.0f} of 100,\nmagrl {many:.0f} of 100 arrive"
    )
    save_gif(out / "underwater.gif", list(frames))
    figures = {"eddies": eddies_picture()} | {f"task-{task}": task_picture(task) for task in NAMED_TASKS}
    for name, figure in figures.items():
        navigator, episode = TASKS[name.removeprefix("task-")].picture
        write_picture(out / f"{name}.png", figure, f"{COMMAND}: {navigator} in episode {episode} of seed {SEED}")


if __name__ == "__main__":
    command("pictures.py", lambda: tyro.cli(main, prog="pictures.py", description=__doc__))
