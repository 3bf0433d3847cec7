"""Figures of the documentation show the data that they are given."""

import math

import plots
import pytest
from pandas import DataFrame

from magrl.envs import named_trips
from magrl.field import IGRF


def test_learning_curves_show_the_mean_over_the_common_episodes() -> None:
    """Two runs, of which one ends earlier and one has a gap."""
    runs = ((0, 0, 0.0), (0, 50, 50.0), (1, 0, 10.0), (1, 50, 90.0), (1, 100, 70.0), (0, 100, math.nan), (1, 150, 9.0))
    data = DataFrame(runs, columns=["run", "episodes", "spl"]).assign(navigator="td3")
    axes = plots.learning_curves(data, "spl", "SPL [%]").axes[0]
    (mean,) = [line for line in axes.lines if line.get_label() == "TD3, 2 seeds"]
    assert mean.get_xdata().tolist() == [0, 50]
    assert mean.get_ydata().tolist() == [5, 70]
    assert len(axes.lines) == 3


def test_figures_of_the_example_trip() -> None:
    """The destination is a dashed line in each element; steps are counted from the first."""
    trip, values = named_trips("paper-example"), {"D": [8.0, 9.0], "I": [-16.0, -27.0], "B_H": [35466.0, 35000.0]}
    panels = plots.convergence({"secant": values | {"L": [0.0, 50.0]}}, IGRF("2022-01-01"), trip).axes
    assert [len(axes.lines) for axes in panels] == [2, 2, 2, 1]
    assert panels[3].lines[0].get_xydata().tolist() == [[1, 50]]
    assert panels[1].lines[1].get_ydata()[0] == pytest.approx(-26.92, abs=0.1)
    lines = plots.compared_trajectories({"secant": ([-2.0, -9.0], [162.0, 164.0])}, IGRF("2022-01-01"), trip).axes[0]
    shown = {line.get_label(): line.get_xydata() for line in lines.lines}
    assert shown["secant"].tolist() == [[162, -2], [164, -9]]
    assert shown["start"].tolist() == [[162, -2]]
    assert lines.get_ylim()[0] == pytest.approx(-9.5)


def test_boxes_hold_the_finite_values() -> None:
    measures = ("heading_mae_deg", "heading_rmse_deg", "smoothness_deg", "navigation_error_km")
    axes = plots.box_plots({"gg_td3": {key: [1.0, math.nan, 3.0] for key in measures}}).axes
    assert [text.get_text() for text in axes[0].get_xticklabels()] == ["GG TD3"]
    assert [line.get_ydata().tolist() for line in axes[3].lines if line.get_marker() == "^"] == [[2]]
