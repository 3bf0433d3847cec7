"""Maps of episodes, and the animated GIF: positions, estimates of the destination, and frames."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from magrl.envs import GeomagneticNavEnv, Region, Scenario, Tasks
from magrl.evaluation import episode_measures, evaluation_rollout, maps
from magrl.evaluation.maps import coastlines, trajectories_figure, way_ellipse, write_gif
from magrl.geodesy import geodesic
from magrl.navigators import Geodesic, Secant
from magrl.transforms import TrackField


def place(*degrees: float) -> torch.Tensor:
    return torch.tensor(degrees, dtype=torch.float64)


@pytest.fixture(scope="module")
def env() -> GeomagneticNavEnv:
    return GeomagneticNavEnv(num_envs=3, seed=0, max_steps=3)


@pytest.fixture(scope="module")
def flight() -> tuple[TensorDictBase, GeomagneticNavEnv]:
    """Return three moves of one vehicle across the antimeridian, with estimates of the destination."""
    tasks = Tasks(place(-17, 179.999)[None], place(-14, -172)[None])
    scenario = Scenario(region=Region((-25, -5), (170, 195)), tasks=tasks, objective_floors=None)
    base = GeomagneticNavEnv(scenario, seed=0, max_steps=3)
    return TransformedEnv(base, TrackField()).rollout(3, Geodesic()), base


def test_coastlines() -> None:
    lines = coastlines()
    for known in ((-34.35, 18.48), (70.67, 23.67), (-55.98, -67.28), (28.21, -177.35)):
        north, east = (lines - known).T
        near = np.nanmin(np.hypot(north, east * math.cos(math.radians(known[0]))))
        assert (near < 0.3) == (known != (28.21, -177.35)), known  # Midway is too small
    assert np.nanmax(np.abs(np.diff(lines[:, 1]))) < 90
    assert np.isnan(lines).all(1).sum() == np.isnan(lines).any(1).sum() > 500


def test_tracks_end_where_the_episode_did(env: GeomagneticNavEnv) -> None:
    """One map for each navigator, at most three in a row, and the names of the tasks."""
    rollout = evaluation_rollout(env, Secant())
    assert len(trajectories_figure(dict.fromkeys("abcd", rollout), env.field, env.region).axes) == 4
    axes = trajectories_figure(rollout, env.field, env.region, episodes=2, names=["home", "port", "other"]).axes[0]
    tracks = [line.get_xydata() for line in axes.lines if line.get_marker() == "."]
    assert len(tracks) == 2
    for row, track, steps in zip(rollout, tracks, episode_measures(rollout)["steps"].tolist(), strict=False):
        expected = torch.cat((row["position"][:1], row["next", "position"][:steps])).flip(-1)
        np.testing.assert_allclose(track, expected, atol=1e-9)
    (west, east), (south, north) = axes.get_xlim(), axes.get_ylim()
    assert all((track >= (west, south)).all() and (track <= (east, north)).all() for track in tracks)
    assert [text.get_text() for text in axes.texts if text.get_text().isalpha()] == ["home", "port"]
    with pytest.raises(ValueError, match="at least one navigator"):
        trajectories_figure({}, env.field, env.region)


def test_a_map_across_the_antimeridian_shows_the_estimates(flight) -> None:
    rollout, env = flight
    figure = trajectories_figure({"Fiji to Samoa": rollout}, env.field, env.region)
    lines = {line.get_label(): line.get_xydata() for line in figure.axes[0].lines}
    assert {"track", "shortest path", "start", "destination", "destination, estimated"} <= lines.keys()
    assert len(lines["track"]) == 4
    assert lines["destination"][0, 0] - lines["start"][0, 0] == pytest.approx(8.001, abs=1e-6)
    assert np.abs(np.diff(lines["track"][:, 0])).max() < 1
    assert figure.axes[0].get_title() == "Fiji to Samoa"


@pytest.mark.parametrize("across", [12.0, -12.0])
def test_ellipse_has_the_covariance_of_the_way(across: float) -> None:
    """Its points are two standard deviations away from the estimate, in every direction."""
    here = torch.tensor([10.0, 20.0])
    way, covariance = torch.tensor([3.0, -4.0]).double(), torch.tensor([[25.0, across], [across, 9.0]]).double()
    ends = way_ellipse(here, way, covariance)
    distance, bearing = geodesic(*here.double().expand_as(ends).T, *ends.T)
    offset = torch.stack((distance * torch.cos(bearing), distance * torch.sin(bearing)), -1) - way
    size = (offset @ covariance.inverse() * offset).sum(-1)
    assert size.numpy() == pytest.approx(4, abs=0.02)
    assert torch.allclose(ends[0], ends[-1], atol=1e-9)
    assert offset[:, 0].max() == pytest.approx(10, abs=0.1)


def test_gif_of_several_vehicles_shows_them_moving(env: GeomagneticNavEnv, tmp_path: Path) -> None:
    rollout = evaluation_rollout(env, Secant(probe_km=10.0))  # moves that a picture shows: equal frames are merged
    write_gif(tmp_path / "a.gif", rollout, env.field, env.region, width_px=320)
    with Image.open(tmp_path / "a.gif") as picture:
        assert picture.width == 320
        assert picture.n_frames == 2 * int(episode_measures(rollout)["steps"].max()) + 1
        assert (picture.info["loop"], picture.info["duration"]) == (0, maps.FRAME_MS)
        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(picture)]
    assert all((before != after).any() for before, after in itertools.pairwise(frames))
    assert (frames[0] == frames[-1]).all(-1).mean() > 0.9  # the map itself stands still
    with pytest.raises(ValueError, match="width_px must be a whole number from 1 on, got 0"):
        write_gif(tmp_path / "b.gif", rollout, env.field, env.region, width_px=0)


def test_gif_of_one_vehicle_holds_the_estimates_and_ends_with_the_last(flight, monkeypatch) -> None:
    rollout, env = flight
    rollout, drawn = rollout.clone(), []
    rollout["track", "way", "displacement"][0] = torch.tensor([[100.0, 100.0], [500.0, 0.0], [9000.0, 0.0]])
    rollout["next", "track", "way", "displacement"][0, -1] = torch.tensor([-300.0, 0.0])
    keep = maps._draw_legend
    monkeypatch.setattr(maps, "_draw_legend", lambda figure: (drawn.append(figure.axes[0]), keep(figure)))
    assert len(list(maps._frames(rollout, env.field, env.region[0], "", 200))) == 7
    low, high = drawn[0].get_ylim()
    assert -17 + 4.5 < high < 20  # 500 km to the north, but not 9000 km
    assert low < -17
    line = next(line for line in drawn[0].lines if line.get_marker() == "x").get_ydata()
    assert line[0] == pytest.approx(rollout["next", "position"][0, -1, 0].item() - 300 / 110.65, abs=0.02)
    assert np.isnan(line[1])


def test_an_ellipse_has_a_gap_at_the_edge_of_the_map(flight) -> None:
    state = flight[0]["next"][0, -1].clone()
    state["track", "way", "covariance"] = 4e6 * torch.eye(2)
    line = maps._estimate(state, Region((-25, -5), (-180, 180)))
    assert np.isnan(line).all(1).sum() > 1
    assert np.nanmax(np.abs(np.diff(line[2:, 1]))) < 180


def test_tracks_have_equal_pieces_on_their_geodesics_and_no_break_at_the_antimeridian(flight) -> None:
    rollout, env = flight
    (track,) = maps.episode_tracks(rollout, env.region[0])
    ends = rollout["position"][0, 0, 1], rollout["next", "position"][0, -1, 1] + 360
    assert track[[0, -1], 1].tolist() == pytest.approx([end.item() for end in ends])
    pieces, _ = geodesic(*track[:-1].T, *track[1:].T)
    legs, _ = geodesic(*track[: -maps.PIECES : maps.PIECES].T, *track[maps.PIECES :: maps.PIECES].T)
    np.testing.assert_allclose(pieces.reshape(-1, 4), legs[:, None].expand(-1, 4) / maps.PIECES, atol=1e-2)
