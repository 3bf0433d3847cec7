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
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from tensordict import TensorDictBase
from torch import Tensor

from magrl.checks import check_number, check_tensor, check_type
from magrl.elements import NAMES, UNITS
from magrl.fields import FieldModel, elements_at
from magrl.metrics import flown
from magrl.tasks import Region, Tasks

ELEMENT_COLOURS = {"D": "#E69F00", "I": "#0072B2", "B_H": "#009E73"}
ELEMENT_STYLES = {"D": "solid", "I": "dashed", "B_H": "solid"}
PATH, START, TARGET = "#404040", "#D55E00", "#CC79A7"
NAVIGATOR_NAMES = {
    "gg_td3": "Gradient-Guided TD3",
    "td3": "TD3",
    "recurrent": "recurrent TD3",
    "ga": "GA",
    "pso": "PSO",
    "afsa": "AFSA",
    "secant": "secant",
    "parallel": "parallel",
}
_COLOURS = ("#D55E00", "#0072B2", "#999999", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
NAVIGATOR_COLOURS = dict(zip(NAVIGATOR_NAMES, _COLOURS, strict=True))
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

    Raises:
        ValueError: for a size that is no positive whole number.

    Example:
        >>> rgb_array(lambda axes, x: axes.plot(x), 100, [1, 3, 2]).shape
        (100, 100, 3)
    """
    check_number(1, whole=True, size_px=size_px)
    figure = Figure(figsize=(7, 7), dpi=(size_px + 0.01) / 7, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    draw(figure.subplots(), *args)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def contour_lines(axes: Axes, field: FieldModel, region: Region) -> dict[str, ContourSet]:
    """Lines of equal D (isogonics), I (isoclines) and B_H (isodynamics) over a region, without labels.

    Args:
        axes: where to draw.
        field: any model of :mod:`magrl.fields`.
        region: what to show.

    Returns:
        By the name of the element.

    Example:
        >>> from magrl.env import paper_field
        >>> from magrl.tasks import PAPER_REGION
        >>> list(contour_lines(Figure().subplots(), paper_field(), PAPER_REGION))
        ['D', 'I', 'B_H']
    """
    check_type(Axes, axes=axes)
    check_type(Region, region=region)
    grid = region.grid(61)
    values = elements_at(field, grid.to(_device(field))).cpu().numpy()
    longitude, latitude = grid[0, :, 1].numpy(), grid[:, 0, 0].numpy()
    contours: dict[str, ContourSet] = {}
    for index, name in enumerate(NAMES):
        look: dict[str, Any] = {"colors": ELEMENT_COLOURS[name], "linestyles": ELEMENT_STYLES[name], "linewidths": 0.7}
        contours[name] = axes.contour(longitude, latitude, values[..., index], 9, **look)
    return contours


def draw_contours(axes: Axes, field: FieldModel, region: Region) -> None:
    """Contours of D, I and B_H over a region (Fig. 4-1).

    Args:
        axes: where to draw.
        field: any model of :mod:`magrl.fields`.
        region: what to show.

    Example:
        >>> from magrl.fields import IGRF
        >>> figure = Figure()
        >>> draw_contours(figure.subplots(), IGRF("2022-01-01"), Region((-10, 0), (160, 170)))
        >>> figure.axes[0].get_legend_handles_labels()[1]
        ['D [deg]', 'I [deg]', '$B_H$ [nT]']
    """
    for (name, lines), unit in zip(contour_lines(axes, field, region).items(), UNITS, strict=False):
        axes.clabel(lines, fontsize=7, fmt="%g")
        axes.plot([], [], color=ELEMENT_COLOURS[name], ls=ELEMENT_STYLES[name], lw=1, label=f"{SYMBOLS[name]} [{unit}]")
    axes.set(xlabel="longitude [° E]", ylabel="latitude [° N]", xlim=region.longitude, ylim=region.latitude)
    axes.set_aspect(1 / np.cos(np.radians(sum(region.latitude) / 2)))


def draw_journeys(axes: Axes, field: FieldModel, region: Region, paths: Sequence[Tensor], targets: Tensor) -> None:
    """Journeys over the field's contours, each from its start (square) to its target (triangle).

    Args:
        axes: where to draw.
        field: any model of :mod:`magrl.fields`.
        region: where tasks lie; what strays beyond it is shown too.
        paths: one ``(T, 2)`` latitude, longitude [deg] for each journey.
        targets: ``(len(paths), 2)`` [deg].

    Raises:
        ValueError: for no path, or another number of targets.

    Example:
        >>> from magrl.fields import IGRF
        >>> axes, target = Figure().subplots(), torch.tensor([[-8.0, 164.0]])
        >>> path = torch.tensor([[-2.0, 162.0], [-4.0, 163.0]])
        >>> draw_journeys(axes, IGRF("2022-01-01"), Region((-10, 0), (160, 170)), [path], target)
        >>> axes.get_xlabel()
        'longitude [° E]'
    """
    check_type(Region, region=region)
    check_tensor(2, targets=targets)
    if not len(paths) or targets.shape != (len(paths), 2):
        raise ValueError(f"there must be one target for each path, got {len(paths)} and {tuple(targets.shape)}")
    unwrapped, ends = [region.unwrapped(path) for path in paths], region.unwrapped(targets)
    draw_contours(axes, field, region.holding(torch.cat([*unwrapped, ends])))
    for path, end in zip(unwrapped, ends, strict=True):
        axes.plot(*torch.stack((path[0], end)).flip(-1).T, ":", color=TARGET, lw=0.8)
        axes.plot(path[:, 1], path[:, 0], "-", color=PATH, lw=1, marker=".", ms=3, alpha=0.8)
    starts = torch.stack([path[0] for path in unwrapped])
    axes.plot(starts[:, 1], starts[:, 0], "s", color=START, ms=5, label="start")
    axes.plot(ends[:, 1], ends[:, 0], "^", color=TARGET, ms=6, label="destination")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=5, fontsize=8, frameon=False)


def training_figure(rows: Sequence[Mapping[str, float]]) -> Figure:
    """Curves of one training: return, reward terms, success and SPL, losses.

    Args:
        rows: of a ``train.csv``; values that are missing or NaN are left out.

    Raises:
        ValueError: for no row, or one without ``frames``.

    Example:
        >>> rows = [{"frames": 1000, "return": -5.0}, {"frames": 2000, "return": 20.0, "success_rate": 10.0}]
        >>> [axes.get_title() for axes in training_figure(rows).axes]
        ['return of the last 200 episodes', 'mean reward of a step', 'success [%]', 'loss']
    """
    if not rows or not all("frames" in row for row in rows):
        raise ValueError(f"each row of a training must have its frames, got {list(rows)[:1]}")
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
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    return figure


def trajectories_figure(rollout: TensorDictBase, field: FieldModel, region: Region, journeys: int = 24) -> Figure:
    """The first journeys of a rollout over the field's contours.

    Args:
        rollout: ``(M, T)`` from the environment.
        field: any model of :mod:`magrl.fields`.
        region: where tasks lie.
        journeys: how many to show.

    Example:
        >>> from magrl.env import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> figure = trajectories_figure(env.rollout(3), env.field, env.region)
        >>> figure.axes[0].get_ylabel()
        'latitude [° N]'
    """
    check_type(TensorDictBase, rollout=rollout)
    check_number(1, whole=True, journeys=journeys)
    shown = rollout[:journeys].cpu()
    steps = flown(shown["next", "done"]).sum(1)
    paths = [
        torch.cat((row["position"][:1], row["next", "position"][:count]))
        for row, count in zip(shown, steps.tolist(), strict=True)
    ]
    figure = Figure(figsize=(8, 8.4), layout="constrained")
    draw_journeys(figure.subplots(), field, region, paths, shown["target_position"][:, 0])
    return figure


def _check_navigators(named: Mapping[str, Any]) -> None:
    unknown = [name for name in named if name not in NAVIGATOR_NAMES]
    if unknown or not named:
        raise ValueError(f"navigators must be among {', '.join(NAVIGATOR_NAMES)}, got {unknown or dict(named)}")


def _device(field: FieldModel) -> torch.device:
    buffers = field.buffers() if isinstance(field, torch.nn.Module) else iter(())
    return next((b.device for b in buffers), torch.device("cpu"))


def learning_curves(
    curves: Mapping[str, Sequence[tuple[Sequence[float], Sequence[float]]]], label: str, points: int = 200
) -> Figure:
    """Curves of several trainings of each navigator: every run faintly, their mean, and the span between extremes.

    Args:
        curves: by navigator, for each run its frames and its values; NaN is left out.
        label: of the vertical axis.
        points: at which the mean is drawn.

    Raises:
        ValueError: for a navigator that has no name and colour here.

    Example:
        >>> figure = learning_curves({"td3": [([0, 100], [0.0, 50.0]), ([0, 100], [10.0, 70.0])]}, "SPL [%]")
        >>> figure.axes[0].get_legend().get_texts()[0].get_text()
        'TD3, 2 seeds'
    """
    _check_navigators(curves)
    check_number(2, whole=True, points=points)
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.subplots()
    for name, runs in curves.items():
        known = [np.array(run)[:, np.isfinite(run[1])] for run in runs]
        known = [run for run in known if run.shape[1]]
        if not known:
            continue
        grid = np.linspace(max(run[0, 0] for run in known), min(run[0, -1] for run in known), points)
        values = np.array([np.interp(grid, *run) for run in known])
        axes.plot(grid, values.T, color=NAVIGATOR_COLOURS[name], lw=0.5, alpha=0.5)
        axes.fill_between(grid, values.min(0), values.max(0), color=NAVIGATOR_COLOURS[name], alpha=0.15, lw=0)
        label_text = f"{NAVIGATOR_NAMES[name]}, {len(known)} seed{'s' if len(known) > 1 else ''}"
        axes.plot(grid, values.mean(0), color=NAVIGATOR_COLOURS[name], lw=2, label=label_text)
    axes.set(xlabel="frames (vehicle-steps)", ylabel=label)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def compared_trajectories(
    tracks: Mapping[str, tuple[Sequence[float], Sequence[float]]], field: FieldModel, task: Tasks
) -> Figure:
    """One task flown by several navigators, over the field's contours (Fig. 4-4).

    Args:
        tracks: by navigator, latitudes and longitudes of its way-points [deg].
        field: any model of :mod:`magrl.fields`.
        task: one task.

    Raises:
        ValueError: for a navigator that has no name and colour here.

    Example:
        >>> from magrl.fields import IGRF
        >>> from magrl.tasks import named_tasks
        >>> track = ([-2.0, -8.0], [162.0, 164.0])
        >>> figure = compared_trajectories({"secant": track}, IGRF("2022-01-01"), named_tasks("figure-4-1"))
        >>> figure.axes[0].lines[-1].get_label()
        'destination'
    """
    _check_navigators(tracks)
    check_type(Tasks, task=task)
    figure = Figure(figsize=(8, 8.4), layout="constrained")
    axes = figure.subplots()
    points = torch.tensor([[lat, lon] for track in tracks.values() for lat, lon in zip(*track, strict=True)])
    points = torch.cat((points, task.start, task.target))
    low, high = (points.amin(0) - 0.5).tolist(), (points.amax(0) + 0.5).tolist()
    draw_contours(axes, field, Region((low[0], high[0]), (low[1], high[1])))
    for name, (latitude, longitude) in tracks.items():
        axes.plot(longitude, latitude, "o-", color=NAVIGATOR_COLOURS[name], ms=3, lw=1.5, label=NAVIGATOR_NAMES[name])
    axes.plot(*task.start.flip(-1).T, "s", color=START, ms=8, label="start")
    axes.plot(*task.target.flip(-1).T, "^", color=TARGET, ms=9, label="destination")
    axes.legend(fontsize=8, loc="best")
    return figure


def convergence(series: Mapping[str, Mapping[str, Sequence[float]]], field: FieldModel, task: Tasks) -> Figure:
    """D, I, B_H and the length of moves against the step (Fig. 4-5 a to d).

    Args:
        series: by navigator, values of ``D``, ``I``, ``B_H`` and ``L`` at each step, the start first.
        field: any model of :mod:`magrl.fields`, for the target's values.
        task: the task that was flown.

    Raises:
        ValueError: for a navigator that has no name and colour here.

    Example:
        >>> from magrl.fields import IGRF
        >>> from magrl.tasks import named_tasks
        >>> flight = {"D": [8.0, 9.0], "I": [-16.0, -27.0], "B_H": [35466.0, 35000.0], "L": [0.0, 50.0]}
        >>> figure = convergence({"secant": flight}, IGRF("2022-01-01"), named_tasks("figure-4-1"))
        >>> [axes.get_title() for axes in figure.axes]
        ['(a)', '(b)', '(c)', '(d)']
    """
    _check_navigators(series)
    check_type(Tasks, task=task)
    targets = dict(zip(NAMES, elements_at(field, task.target[0]).tolist(), strict=True))
    labels = {name: f"{SYMBOLS[name]} [{unit}]" for name, unit in zip(NAMES, UNITS, strict=True)}
    labels["L"] = "length of the move [km]"
    figure = Figure(figsize=(11, 8), layout="constrained")
    for letter, axes, (key, label) in zip("abcd", figure.subplots(2, 2).flat, labels.items(), strict=True):
        for name, values in series.items():
            shown = list(enumerate(values[key]))[key == "L" :]
            axes.plot(*zip(*shown, strict=True), color=NAVIGATOR_COLOURS[name], lw=1.5, label=NAVIGATOR_NAMES[name])
        if key in targets:
            axes.axhline(targets[key], color="#404040", ls="--", lw=1, label="at the destination")
        axes.set(xlabel="step", ylabel=label, title=f"({letter})")
        axes.grid(alpha=0.3)
    figure.axes[0].legend(fontsize=8)
    return figure


def box_plots(measures: Mapping[str, Mapping[str, Sequence[float]]]) -> Figure:
    """Heading deviation, smoothness and navigation error of successful journeys (Fig. 4-6 a to d).

    Args:
        measures: by navigator, one value for each journey of ``heading_mae_deg``, ``heading_rmse_deg``,
            ``smoothness_deg`` and ``navigation_error_km``; NaN is left out.

    Raises:
        ValueError: for a navigator that has no name and colour here, or none at all.

    Example:
        >>> measures = ("heading_mae_deg", "heading_rmse_deg", "smoothness_deg", "navigation_error_km")
        >>> figure = box_plots({"secant": dict.fromkeys(measures, [1.0, 2.0, 4.0])})
        >>> figure.axes[3].get_ylabel()
        'navigation error [km]'
    """
    _check_navigators(measures)
    labels = {
        "heading_mae_deg": "MAE of heading deviation [°]",
        "heading_rmse_deg": "RMSE of heading deviation [°]",
        "smoothness_deg": "path smoothness [°]",
        "navigation_error_km": "navigation error [km]",
    }
    figure = Figure(figsize=(11, 8), layout="constrained")
    for letter, axes, (key, label) in zip("abcd", figure.subplots(2, 2).flat, labels.items(), strict=True):
        values = [np.array(m[key])[np.isfinite(m[key])] for m in measures.values()]
        boxes = axes.boxplot(values, patch_artist=True, showmeans=True, flierprops={"ms": 2, "alpha": 0.4})
        for box, name in zip(boxes["boxes"], measures, strict=True):
            box.set(facecolor=NAVIGATOR_COLOURS[name], alpha=0.6)
        short = {"gg_td3": "GG TD3", "recurrent": "recurrent"}  # the full names would run into each other
        names = [short.get(name, NAVIGATOR_NAMES[name]) for name in measures]
        axes.set_xticks(range(1, len(names) + 1), names)
        axes.set(ylabel=label, title=f"({letter})")
        axes.grid(alpha=0.3, axis="y")
    return figure
