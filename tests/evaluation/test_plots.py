"""Figures: they show the data that they are given."""

import math

import numpy as np
import pytest
import torch

from magrl.envs import GeomagneticNavEnv, Region, Scenario, Tasks
from magrl.envs.rendering import draw_tracks
from magrl.evaluation import plots
from magrl.evaluation.maps import flights_figure
from magrl.evaluation.metrics import first_episode_mask
from magrl.evaluation.navigators import NAVIGATOR_NAMES
from magrl.field import IGRF
from magrl.navigators import NAVIGATORS
from magrl.training.curves import RETURN_TERMS


@pytest.fixture(scope="module")
def env() -> GeomagneticNavEnv:
    return GeomagneticNavEnv(num_envs=4, seed=0, render_mode="rgb_array")


def test_render_shows_the_running_episode(env) -> None:
    env.reset()
    before = env.render()
    env.rollout(5)
    after = env.render()
    assert before.shape == after.shape == (700, 700, 3)
    assert before.dtype == np.uint8
    assert (before != after).any()
    assert env.render([0], size_px=300).shape == (300, 300, 3)


def test_track_is_the_path_of_the_running_episode(env) -> None:
    torch.manual_seed(0)
    rollout = env.rollout(6)
    for vehicle in range(4):
        expected = torch.cat((rollout["position"][vehicle, :1], rollout["next", "position"][vehicle]))
        assert torch.equal(env.track(vehicle), expected)


def test_track_after_a_partial_reset(env) -> None:
    state = env.rollout(3)["next"][:, -1].exclude("reward")
    kept = env.track(0)
    mask = torch.tensor([[False], [True], [False], [False]])
    started = env.reset(state.set("_reset", mask))
    assert torch.equal(env.track(0), kept)
    assert torch.equal(env.track(1), started["position"][1:2])


def test_render_before_reset_and_of_an_unknown_vehicle() -> None:
    env = GeomagneticNavEnv(num_envs=2, seed=0, render_mode="rgb_array")
    with pytest.raises(RuntimeError, match="call reset"):
        env.render()
    env.reset()
    with pytest.raises(IndexError, match="vehicle 2"):
        env.render([2])


def test_training_figure_leaves_out_what_is_missing() -> None:
    rows = [{"frames": 1.0, "return": math.nan}, {"frames": 2.0, "return": 5.0, "eval_spl": 90.0}]
    figure = plots.training_figure(rows)
    line = figure.axes[0].lines[0]
    assert line.get_xdata().tolist() == [2.0]
    assert [axes.get_xlabel() for axes in figure.axes[2:]] == ["frames (vehicle-steps)"] * 2


def test_training_figure_shows_the_columns_of_a_training() -> None:
    """Return, its terms, success and losses, each from its column; the labels tell lines of a panel apart."""
    columns = ["return", *(f"return_{term}" for term in RETURN_TERMS), "success_rate", "eval_success_rate", "eval_spl"]
    columns += ["loss_critic", "loss_actor"]
    rows = [{"frames": frames, **{key: 10.0 * i + frames for i, key in enumerate(columns)}} for frames in (1, 2)]
    panels = plots.training_figure(rows).axes
    assert [[line.get_ydata()[0] for line in axes.lines] for axes in panels] == [
        [1],
        [11, 21, 31],
        [41, 51, 61],
        [71, 81],
    ]
    assert [text.get_text() for text in panels[1].get_legend().get_texts()] == list(RETURN_TERMS)


def test_trajectories_end_where_the_episode_did(env) -> None:
    torch.manual_seed(1)
    rollout = env.rollout(10, break_when_any_done=False)
    figure = plots.trajectories_figure(rollout, env.field, env.region, episodes=2)
    axes = figure.axes[0]
    ends = {
        tuple(np.round((line.get_xdata()[-1], line.get_ydata()[-1]), 6)) for line in axes.lines if len(line.get_xdata())
    }
    last = first_episode_mask(rollout["next", "done"]).sum(1)[0] - 1
    latitude, longitude = rollout["next", "position"][0, last].tolist()
    assert (round(longitude, 6), round(latitude, 6)) in ends
    assert "deg" in axes.get_legend().get_texts()[0].get_text()


def test_flights_figure_has_axes_for_its_flights_alone(env) -> None:
    rollout = env.rollout(2)
    for count in range(1, 6):
        flights = dict.fromkeys("abcde"[:count], rollout)
        assert len(flights_figure(flights, env.field, env.region).axes) == count


def test_paths_across_the_antimeridian_do_not_jump() -> None:
    region = Region((-5.0, 5.0), (175.0, 185.0))
    start, target = torch.tensor([[0.0, 179.0]]), torch.tensor([[0.0, -178.0]])
    scenario = Scenario(region=region, tasks=Tasks(start, target))
    env = GeomagneticNavEnv(scenario, max_steps=4, seed=0, render_mode="rgb_array")
    state = env.reset()
    for _ in range(3):
        state["action"] = torch.tensor([[50.0, math.pi / 4]])
        state = env.step(state)["next"].exclude("reward")
    figure = plots.Figure()
    draw_tracks(figure.subplots(), IGRF(2025.0), region, [env.track(0)], target)
    assert max(abs(np.diff(line.get_xdata())).max() for line in figure.axes[0].lines if len(line.get_xdata()) > 1) < 5


def test_every_navigator_has_a_color_of_its_own() -> None:
    names = {*NAVIGATOR_NAMES, *NAVIGATORS}
    assert plots.NAVIGATOR_COLORS.keys() == names
    assert len(set(plots.NAVIGATOR_COLORS.values())) == len(names)


def test_noise_figure_shows_average_and_range_of_runs() -> None:
    """Four runs of one navigator, one run of another that did not fly at the second level, in its mode."""
    runs = [{"spl": spl} for spl in (80.0, 90.0, 92.0, 99.0)]
    levels = {"none": {"gg_td3": runs, "ga": [{"spl": 5.0}]}, "high": {"gg_td3": [{"spl": 70.0}, {"spl": None}]}}
    axes = plots.noise_figure(levels, "flown").axes[0]
    assert [line.get_ydata().tolist() for line in axes.lines] == [[91, 70], pytest.approx([5, math.nan], nan_ok=True)]
    assert [line.get_linestyle() for line in axes.lines] == ["-", "--"]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == [
        "Gradient-Guided TD3",
        "GA, flown (below 50 %)",
    ]
    assert [text.get_text() for text in axes.get_xticklabels()] == ["none", "high"]
    edge = axes.collections[0].get_paths()[0].vertices
    assert {tuple(point) for point in edge} == {(0, 80), (0, 99), (1, 70)}
    for levels in ({}, {"none": {}}):
        with pytest.raises(ValueError, match="at least one navigator"):
            plots.noise_figure(levels)
    with pytest.raises(ValueError, match="unknown navigator 'dowsing'"):
        plots.noise_figure({"none": {"dowsing": runs}})
