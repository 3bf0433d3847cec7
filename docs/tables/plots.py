"""Figures of the documentation: functions from data to matplotlib figures, which read and write no files.

A navigator has the same color in every figure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from magrl.envs import Region, Trips
from magrl.envs.rendering import START, SYMBOLS, TARGET, draw_contours
from magrl.field import FieldModel, elements_at
from magrl.field.elements import NAMES, UNITS
from magrl.navigators.names import KINDS

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pandas import DataFrame

NAVIGATOR_COLORS = {"gg_td3": "#0072B2", "anywhere": "#0072B2", "td3": "#D55E00", "kalman": "#D55E00"}
NAVIGATOR_COLORS |= {"secant": "#009E73", "parallel": "#000000", "ga": "#E69F00", "pso": "#56B4E9", "afsa": "#CC79A7"}
"""Color of each navigator in every figure, of Okabe and Ito (2008); no figure has two navigators of one color."""


def _look(name: str) -> dict[str, Any]:
    """Return color and label of a navigator."""
    return {"color": NAVIGATOR_COLORS[name], "label": KINDS[name].label}


def _four_panels(labels: Mapping[str, str]) -> tuple[Figure, dict[str, Axes]]:
    """Return a figure of panels (a) to (d), and its axes by the keys of their vertical labels."""
    figure = Figure(figsize=(11, 8), layout="constrained")
    panels = dict(zip(labels, figure.subplots(2, 2).flat, strict=True))
    for letter, (key, axes) in zip("abcd", panels.items(), strict=True):
        axes.set(ylabel=labels[key], title=f"({letter})")
        axes.grid(alpha=0.3)
    return figure, panels


def learning_curves(data: DataFrame, column: str, label: str) -> Figure:
    """Return learning curves of several trainings of each navigator: single runs, their mean and their range.

    The lowest 2 % of the values, those of first episodes, are below the figure: they would squeeze the others.

    Args:
        data: a row for each ``navigator``, ``run`` and number of ``episodes``.
        column: name of the values.
        label: label of the vertical axis.

    Example:
        >>> data = DataFrame({"navigator": "td3", "run": [0, 1], "episodes": 50, "spl": [50.0, 70.0]})
        >>> learning_curves(data, "spl", "SPL [%]").legends[0].get_texts()[0].get_text()
        'TD3, 2 seeds'
    """
    figure = Figure(figsize=(8, 5.5), layout="constrained")
    axes = figure.subplots()
    for name, rows in data.groupby("navigator", sort=False):
        look = _look(str(name))
        runs = rows.pivot_table(column, "episodes", "run").dropna()
        axes.plot(runs, color=look["color"], lw=0.5, alpha=0.5)
        axes.fill_between(runs.index, runs.min(axis=1), runs.max(axis=1), color=look["color"], alpha=0.15, lw=0)
        text = f"{look['label']}, {runs.shape[1]} seed{'s' if runs.shape[1] > 1 else ''}"
        axes.plot(runs.mean(axis=1), color=look["color"], lw=2, label=text)
    axes.set(xlabel="episodes", ylabel=label)
    axes.set_ylim(bottom=data[column].quantile(0.02))
    axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=2)
    return figure


def compared_trajectories(
    tracks: Mapping[str, tuple[Sequence[float], Sequence[float]]], field: FieldModel, trip: Trips
) -> Figure:
    """Return a map of the paths of several navigators on one trip, over the field's contours (Fig. 8).

    Args:
        tracks: by navigator, latitudes and longitudes of its waypoints [deg].
        field: any model of :mod:`magrl.field`.
        trip: one trip.

    Example:
        >>> from magrl.field.igrf import IGRF
        >>> from magrl.envs.trips import named_trips
        >>> track = ([-2.0, -8.0], [162.0, 164.0])
        >>> figure = compared_trajectories({"secant": track}, IGRF("2022-01-01"), named_trips("paper-example"))
        >>> figure.axes[0].lines[-1].get_label()
        'destination'
    """
    figure = Figure(figsize=(8, 8.4), layout="constrained")
    axes = figure.subplots()
    points = torch.tensor([[lat, lon] for track in tracks.values() for lat, lon in zip(*track, strict=True)])
    points = torch.cat((points, trip.start, trip.target))
    low, high = (points.amin(0) - 0.5).tolist(), (points.amax(0) + 0.5).tolist()
    draw_contours(axes, field, Region((low[0], high[0]), (low[1], high[1])))
    for name, (latitude, longitude) in tracks.items():
        axes.plot(longitude, latitude, "o-", ms=3, lw=1.5, **_look(name))
    axes.plot(*trip.start.flip(-1).T, "s", color=START, ms=8, label="start")
    axes.plot(*trip.target.flip(-1).T, "^", color=TARGET, ms=9, label="destination")
    axes.legend(fontsize=8, loc="best")
    return figure


def convergence(series: Mapping[str, Mapping[str, Sequence[float]]], field: FieldModel, trip: Trips) -> Figure:
    """Return D, I, B_H and the length of legs against the step (Fig. 9 a to d).

    Args:
        series: by navigator, values of ``D``, ``I``, ``B_H`` and ``L`` at each step, the start first.
        field: any model of :mod:`magrl.field`, for the target's values.
        trip: the trip of all navigators.

    Example:
        >>> from magrl.field.igrf import IGRF
        >>> from magrl.envs.trips import named_trips
        >>> values = {"D": [8.0, 9.0], "I": [-16.0, -27.0], "B_H": [35466.0, 35000.0], "L": [0.0, 50.0]}
        >>> figure = convergence({"secant": values}, IGRF("2022-01-01"), named_trips("paper-example"))
        >>> [axes.get_title() for axes in figure.axes]
        ['(a)', '(b)', '(c)', '(d)']
    """
    targets = dict(zip(NAMES, elements_at(field, trip.target[0]).tolist(), strict=True))
    labels = {name: f"{SYMBOLS[name]} [{unit}]" for name, unit in zip(NAMES, UNITS, strict=True)}
    labels["L"] = "length of the leg [km]"
    figure, panels = _four_panels(labels)
    for key, axes in panels.items():
        for name, values in series.items():
            shown = list(enumerate(values[key]))[key == "L" :]
            axes.plot(*zip(*shown, strict=True), lw=1.5, **_look(name))
        if key in targets:
            axes.axhline(targets[key], color="#404040", ls="--", lw=1, label="at the destination")
        axes.set_xlabel("step")
    figure.axes[0].legend()
    return figure


def box_plots(measures: Mapping[str, Mapping[str, Sequence[float]]]) -> Figure:
    """Return box plots of heading deviation, smoothness and navigation error of successes (Fig. 10 a to d).

    Args:
        measures: by navigator, one value for each episode of ``heading_mae_deg``, ``heading_rmse_deg``,
            ``smoothness_deg`` and ``navigation_error_km``; NaN is left out.

    Example:
        >>> measures = ("heading_mae_deg", "heading_rmse_deg", "smoothness_deg", "navigation_error_km")
        >>> figure = box_plots({"secant": dict.fromkeys(measures, [1.0, 2.0, 4.0])})
        >>> figure.axes[3].get_ylabel()
        'navigation error [km]'
    """
    labels = {
        "heading_mae_deg": "MAE of heading deviation [°]",
        "heading_rmse_deg": "RMSE of heading deviation [°]",
        "smoothness_deg": "path smoothness [°]",
        "navigation_error_km": "navigation error [km]",
    }
    short = {"gg_td3": "GG TD3"}  # the full name would overlap
    names = [short.get(name, _look(name)["label"]) for name in measures]
    figure, panels = _four_panels(labels)
    for key, axes in panels.items():
        values = [np.array(m[key])[np.isfinite(m[key])] for m in measures.values()]
        boxes = axes.boxplot(values, patch_artist=True, showmeans=True, flierprops={"ms": 2, "alpha": 0.4})
        for box, name in zip(boxes["boxes"], measures, strict=True):
            box.set(facecolor=NAVIGATOR_COLORS[name], alpha=0.6)
        axes.set_xticks(range(1, len(names) + 1), names)
    return figure
