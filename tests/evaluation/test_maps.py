"""Maps of episodes: positions, and estimates of the destination."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from magrl.envs import GeomagneticNavEnv, Region, Scenario, Trips
from magrl.evaluation import episode_measures, evaluation_rollout
from magrl.evaluation.maps import coastlines, displacement_ellipse, trajectories_figure
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
    """Return three legs of one vehicle across the antimeridian, with estimates of the destination."""
    trips = Trips(place(-17, 179.999)[None], place(-14, -172)[None])
    scenario = Scenario(region=Region((-25, -5), (170, 195)), trips=trips, objective_floors=None)
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
    """One map for each navigator, at most three in a row, and the names of the trips."""
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
def test_ellipse_has_the_covariance_of_the_displacement(across: float) -> None:
    """Its points are two standard deviations away from the estimate, in every direction."""
    here, displacement = torch.tensor([10.0, 20.0]), torch.tensor([3.0, -4.0]).double()
    covariance = torch.tensor([[25.0, across], [across, 9.0]]).double()
    ends = displacement_ellipse(here, displacement, covariance)
    distance, bearing = geodesic(*here.double().expand_as(ends).T, *ends.T)
    offset = torch.stack((distance * torch.cos(bearing), distance * torch.sin(bearing)), -1) - displacement
    size = (offset @ covariance.inverse() * offset).sum(-1)
    assert size.numpy() == pytest.approx(4, abs=0.02)
    assert torch.allclose(ends[0], ends[-1], atol=1e-9)
    assert offset[:, 0].max() == pytest.approx(10, abs=0.1)
