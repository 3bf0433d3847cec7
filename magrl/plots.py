"""Pictures: data to matplotlib axes, with no files read or written.

Colours are those of Okabe and Ito, which colour-blind readers tell apart; a navigator has the same one everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from tensordict import TensorDictBase
from torch import Tensor

from magrl.elements import NAMES, UNITS
from magrl.fields import FieldModel, elements_at
from magrl.geodesy import wrap_longitude
from magrl.metrics import flown
from magrl.tasks import Region

ELEMENT_COLOURS = {"D": "#E69F00", "I": "#0072B2", "B_H": "#009E73"}
PATH, START, TARGET = "#404040", "#D55E00", "#CC79A7"
LINES = ("#0072B2", "#D55E00", "#009E73")
TRAINING_PANELS = {
    "return of the last 200 episodes": {"return": "return"},
    "mean reward of a step": {f"reward_{term}": term for term in ("destination", "proximity", "alignment")},
    "success [%]": {
        "success_rate": "SR, last 200 episodes",
        "eval_success_rate": "SR, evaluation",
        "eval_spl": "SPL, evaluation",
    },
    "loss": {"loss_critic": "critics", "loss_actor": "actor"},
}
SYMBOLS = {"D": "D", "I": "I", "B_H": "$B_H$"}


def rgb_array(draw: Callable[..., None], size_px: int, *args: Any) -> np.ndarray:
    """What a drawing function makes of its arguments, as an image.

    Args:
        draw: called as ``draw(axes, *args)``.
        size_px: height and width [pixels].

    Returns:
        ``(size_px, size_px, 3)`` uint8.
    """
    figure = Figure(figsize=(size_px / 100, size_px / 100), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    draw(figure.subplots(), *args)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def draw_contours(axes: Axes, field: FieldModel, region: Region) -> None:
    """Contours of D, I and B_H over a region (Fig. 4-1).

    Args:
        axes: where to draw.
        field: any model of :mod:`magrl.fields`.
        region: what to show.
    """
    grid = region.grid(61)
    values = elements_at(field, grid.to(_device(field))).cpu().numpy()
    latitude, longitude = grid[:, 0, 0].numpy(), grid[0, :, 1].numpy()
    for index, name in enumerate(NAMES):
        style = "dashed" if name == "I" else "solid"
        lines = axes.contour(
            longitude, latitude, values[..., index], 9, colors=ELEMENT_COLOURS[name], linestyles=style, linewidths=0.7
        )
        axes.clabel(lines, fontsize=7, fmt="%g")
        axes.plot([], [], color=ELEMENT_COLOURS[name], ls=style, lw=1, label=f"{SYMBOLS[name]} [{UNITS[index]}]")
    axes.set(
        xlabel="longitude [° E]",
        ylabel="latitude [° N]",
        xlim=(longitude[0], longitude[-1]),
        ylim=(latitude[0], latitude[-1]),
    )
    axes.set_aspect(1 / np.cos(np.radians(latitude.mean())))


def draw_journeys(
    axes: Axes, field: FieldModel, region: Region, paths: Sequence[Tensor], targets: Tensor, zoom: bool = False
) -> None:
    """Journeys over the field's contours, each from its start (square) to its target (triangle).

    Args:
        axes: where to draw.
        field: any model of :mod:`magrl.fields`.
        region: where tasks lie; what strays beyond it is shown too.
        paths: one ``(T, 2)`` latitude, longitude [deg] for each journey.
        targets: ``(len(paths), 2)`` [deg].
        zoom: keep to the region even where a journey leaves it.
    """
    centre = sum(region.longitude) / 2
    unwrapped = [torch.stack((p[:, 0], centre + wrap_longitude(p[:, 1] - centre)), -1) for p in paths]
    ends = torch.stack((targets[:, 0], centre + wrap_longitude(targets[:, 1] - centre)), -1)
    points = torch.cat([*unwrapped, ends])
    shown = region if zoom else _around(region, points)
    draw_contours(axes, field, shown)
    for path, end in zip(unwrapped, ends, strict=True):
        axes.plot(*torch.stack((path[0], end)).flip(-1).T, ":", color=TARGET, lw=0.8)
        axes.plot(path[:, 1], path[:, 0], "-", color=PATH, lw=1, marker=".", ms=3, alpha=0.8)
    starts = torch.stack([path[0] for path in unwrapped])
    axes.plot(starts[:, 1], starts[:, 0], "s", color=START, ms=5, label="start")
    axes.plot(ends[:, 1], ends[:, 0], "^", color=TARGET, ms=6, label="destination")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=5, fontsize=8, frameon=False)


def _around(region: Region, points: Tensor) -> Region:
    """The region, grown to hold the points."""
    (south, north), (west, east) = region.latitude, region.longitude
    low, high = points.amin(0).tolist(), points.amax(0).tolist()
    return Region((min(south, low[0]), max(north, high[0])), (min(west, low[1]), max(east, high[1])))


def training_figure(rows: Sequence[Mapping[str, float]]) -> Figure:
    """Curves of one training: return, reward terms, success and SPL, losses.

    Args:
        rows: of a ``train.csv``; values that are missing or NaN are left out.
    """
    figure = Figure(figsize=(10, 7), layout="constrained")
    frames = np.array([row["frames"] for row in rows])
    for axes, (title, columns) in zip(figure.subplots(2, 2, sharex=True).flat, TRAINING_PANELS.items(), strict=True):
        for colour, (column, label) in zip(LINES, columns.items(), strict=False):
            values = np.array([row.get(column, np.nan) for row in rows], dtype=float)
            known = np.isfinite(values)
            axes.plot(frames[known], values[known], color=colour, lw=1.2, label=label)
        axes.set_title(title)
        axes.grid(alpha=0.3)
        if len(columns) > 1:
            axes.legend(fontsize=8)
    for axes in figure.axes[2:]:
        axes.set_xlabel("frames (vehicle-steps)")
    return figure


def trajectories_figure(rollout: TensorDictBase, field: FieldModel, region: Region, journeys: int = 24) -> Figure:
    """The first journeys of a rollout over the field's contours.

    Args:
        rollout: ``(M, T)`` from the environment.
        field: any model of :mod:`magrl.fields`.
        region: where tasks lie.
        journeys: how many to show.
    """
    shown = rollout[:journeys].cpu()
    steps = flown(shown["next", "done"]).sum(1)
    paths = [
        torch.cat((row["position"][:1], row["next", "position"][:count]))
        for row, count in zip(shown, steps.tolist(), strict=True)
    ]
    figure = Figure(figsize=(8, 8.4), layout="constrained")
    draw_journeys(figure.subplots(), field, region, paths, shown["target_position"][:, 0])
    return figure


def _device(field: FieldModel) -> torch.device:
    buffers = field.buffers() if isinstance(field, torch.nn.Module) else iter(())
    return next((b.device for b in buffers), torch.device("cpu"))
