"""Maps: contours of a field and the tracks of vehicles over them, drawn with matplotlib.

Importing this module does not import matplotlib; drawing does. Colors are from Okabe and Ito, which remain distinct
under color-vision deficiency.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl.checks import check_number, library
from magrl.envs.regions import Region, Regions, one_region
from magrl.field.elements import NAMES, UNITS
from magrl.field.model import FieldModel, device_of, elements_at

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.contour import ContourSet

ELEMENT_COLORS = {"D": "#E69F00", "I": "#0072B2", "B_H": "#009E73"}
ELEMENT_STYLES = {"D": "solid", "I": "dashed", "B_H": "solid"}
PATH, START, TARGET, AREA = "#404040", "#D55E00", "#CC79A7", "#808080"
SYMBOLS = {"D": "D", "I": "I", "B_H": "$B_H$"}


def rgb_array(draw: Callable[..., None], size_px: int, *args: Any) -> np.ndarray:
    """Return the image that a drawing function draws.

    Args:
        draw: called as ``draw(axes, *args)``.
        size_px: height and width [pixels].

    Returns:
        ``(size_px, size_px, 3)`` uint8.

    Raises:
        ValueError: for a size that is not a positive whole number.

    Example:
        >>> rgb_array(lambda axes, x: axes.plot(x), 100, [1, 3, 2]).shape
        (100, 100, 3)
    """
    check_number(1, whole=True, size_px=size_px)
    kind = library("matplotlib.figure", "plots").Figure
    figure = kind(figsize=(7, 7), dpi=(size_px + 0.01) / 7, layout="constrained")
    canvas = library("matplotlib.backends.backend_agg", "plots").FigureCanvasAgg(figure)
    draw(figure.subplots(), *args)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def contour_lines(axes: Axes, field: FieldModel, region: Region | Regions) -> dict[str, ContourSet]:
    """Draw lines of equal D (isogonics), I (isoclines) and B_H (isodynamics) over a region, without labels.

    Args:
        axes: axes to draw on.
        field: any model of :mod:`magrl.field`.
        region: region to show.

    Returns:
        Contours by the name of the element.

    Example:
        >>> from matplotlib.figure import Figure
        >>> from magrl.field import IGRF
        >>> list(contour_lines(Figure().subplots(), IGRF("2022-01-01"), Region((-10, 0), (160, 170))))
        ['D', 'I', 'B_H']
    """
    grid = Regions.of(one_region(region)).grid(61)[0]
    values = elements_at(field, grid.to(device_of(field))).cpu().numpy()
    longitude, latitude = grid[0, :, 1].numpy(), grid[:, 0, 0].numpy()
    contours: dict[str, ContourSet] = {}
    for index, name in enumerate(NAMES):
        look: dict[str, Any] = {"colors": ELEMENT_COLORS[name], "linestyles": ELEMENT_STYLES[name], "linewidths": 0.7}
        contours[name] = axes.contour(longitude, latitude, values[..., index], 9, **look)
    return contours


def draw_contours(axes: Axes, field: FieldModel, region: Region) -> None:
    """Draw labeled contours of D, I and B_H over a region (Fig. 5).

    Args:
        axes: axes to draw on.
        field: any model of :mod:`magrl.field`.
        region: region to show.

    Example:
        >>> from matplotlib.figure import Figure
        >>> from magrl.field import IGRF
        >>> figure = Figure()
        >>> draw_contours(figure.subplots(), IGRF("2022-01-01"), Region((-10, 0), (160, 170)))
        >>> figure.axes[0].get_legend_handles_labels()[1]
        ['D [deg]', 'I [deg]', '$B_H$ [nT]']
    """
    for (name, lines), unit in zip(contour_lines(axes, field, region).items(), UNITS, strict=False):
        axes.clabel(lines, fontsize=7, fmt="%g")
        axes.plot([], [], color=ELEMENT_COLORS[name], ls=ELEMENT_STYLES[name], lw=1, label=f"{SYMBOLS[name]} [{unit}]")
    axes.set(xlabel="longitude [° E]", ylabel="latitude [° N]", xlim=region.longitude, ylim=region.latitude)
    axes.set_aspect(1 / np.cos(np.radians(sum(region.latitude) / 2)))


def draw_tracks(
    axes: Axes,
    field: FieldModel,
    region: Region | Regions,
    paths: Sequence[Tensor],
    targets: Tensor,
    outlines: Sequence[Tensor] = (),
) -> None:
    """Draw episodes over the field's contours, each from its start (square) to its target (triangle).

    Args:
        axes: axes to draw on.
        field: any model of :mod:`magrl.field`.
        region: region of the trips; grown to contain all of the paths.
        paths: one ``(T, 2)`` latitude, longitude [deg] for each episode.
        targets: ``(len(paths), 2)`` [deg].
        outlines: of areas, each ``(P, 2)`` [deg].

    Example:
        >>> from matplotlib.figure import Figure
        >>> from magrl.field import IGRF
        >>> axes, target = Figure().subplots(), torch.tensor([[-8.0, 164.0]])
        >>> path = torch.tensor([[-2.0, 162.0], [-4.0, 163.0]])
        >>> draw_tracks(axes, IGRF("2022-01-01"), Region((-10, 0), (160, 170)), [path], target)
        >>> axes.get_xlabel()
        'longitude [° E]'
    """
    region = one_region(region)
    unwrapped, ends = [region.unwrapped(path) for path in paths], region.unwrapped(targets)
    draw_contours(axes, field, region.holding(torch.cat([*unwrapped, ends])))
    for ring in outlines:
        axes.fill(*region.unwrapped(ring).flip(-1).T, color=AREA, alpha=0.3)
    for path, end in zip(unwrapped, ends, strict=True):
        axes.plot(*torch.stack((path[0], end)).flip(-1).T, ":", color=TARGET, lw=0.8)
        axes.plot(path[:, 1], path[:, 0], "-", color=PATH, lw=1, marker=".", ms=3, alpha=0.8)
    starts = torch.stack([path[0] for path in unwrapped])
    axes.plot(starts[:, 1], starts[:, 0], "s", color=START, ms=5, label="start")
    axes.plot(ends[:, 1], ends[:, 0], "^", color=TARGET, ms=6, label="destination")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=5, fontsize=8, frameon=False)


class TrackRecorder:
    """Positions of the running episodes of a batch, kept for rendering.

    Args:
        length: states kept; the longest track that can be returned. With 0, no track is returned.

    Example:
        >>> from tensordict import TensorDict
        >>> recorder, step = TrackRecorder(length=3), torch.tensor([[0]])
        >>> for k in range(2):
        ...     place = torch.tensor([[-2.0 - k, 162.0]])
        ...     recorder.add(TensorDict(position=place, target_position=place, elapsed_steps=step + k, region=step))
        >>> recorder.track(0)
        tensor([[ -2., 162.],
                [ -3., 162.]])
    """

    def __init__(self, length: int) -> None:
        self._states: deque[tuple[Tensor, ...]] = deque(maxlen=length)

    def add(self, state: TensorDictBase, started: Tensor | None = None) -> None:
        """Record a state of every vehicle; at a partial reset, only the rows ``started`` ``(N,)`` are new."""
        if torch.compiler.is_compiling():
            return
        entry = tuple(state[key] for key in ("position", "elapsed_steps", "target_position", "region"))
        if started is not None and self._states:
            new, last = started.unsqueeze(-1), self._states.pop()
            entry = tuple(torch.where(new, a, b) for a, b in zip(entry, last, strict=True))
        self._states.append(entry)

    def track(self, vehicle: int) -> Tensor:
        """Return the positions of a vehicle in its running episode, ``(T, 2)`` [deg].

        Raises:
            RuntimeError: before the first state.
            ValueError: for a vehicle that is not in the batch.
        """
        check_number(0, len(self.latest[1]) - 1, whole=True, vehicle=vehicle)
        since = int(self.latest[1][vehicle])
        return torch.stack([state[0][vehicle] for state in list(self._states)[-(since + 1) :]])

    @property
    def latest(self) -> tuple[Tensor, ...]:
        """Position ``(N, 2)``, step ``(N, 1)``, destination ``(N, 2)`` and region ``(N, 1)`` of running episodes."""
        if not self._states:
            raise RuntimeError("no track is kept: create the environment with render_mode='rgb_array' and call reset()")
        return self._states[-1]
