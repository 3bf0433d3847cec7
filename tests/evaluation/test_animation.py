"""The animation of a flight: the ellipse of the estimated destination, the frames, and the option of the recipe."""

from pathlib import Path

import fly as recipe
import numpy as np
import pytest
import torch
from magrl.evaluation.animation import way_ellipse, write_flight_gif
from PIL import Image
from tensordict import TensorDictBase

from magrl.envs import GeomagneticNavEnv
from magrl.evaluation import animation
from magrl.evaluation.replay import save_gif
from magrl.geodesy import geodesic
from magrl.training import UsageError


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> tuple[TensorDictBase, GeomagneticNavEnv]:
    """Return a flight of three moves across the antimeridian."""
    config = recipe.Config(
        "17S 179.9E", "14S 172W", navigator="geodesic", max_steps=3, out=tmp_path_factory.mktemp("fly")
    )
    env, watched = recipe.prepare(config)
    return recipe.rollout(env, watched, 90.0), env.base_env


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


def test_line_has_a_gap_at_the_edge_of_the_map() -> None:
    line = animation._unbroken(np.array([[0.0, 170.0], [1.0, 179.0], [2.0, -179.0], [3.0, -170.0]]))
    assert np.isnan(line).all(1).tolist() == [False, False, True, False, False]


def test_animation_has_two_frames_a_move(flight, tmp_path: Path) -> None:
    rollout, env = flight
    write_flight_gif(tmp_path / "a.gif", rollout, env.field, env.region, width_px=300)
    picture = Image.open(tmp_path / "a.gif")
    assert (picture.n_frames, picture.width) == (7, 300)
    assert picture.info["duration"] == animation.FRAME_MS


def test_map_holds_the_estimates_and_ends_with_the_last_one(flight, monkeypatch) -> None:
    rollout, env = flight
    rollout, seen = rollout.clone(), {}
    rollout["way"][0] = torch.tensor([[100.0, 100.0], [500.0, 0.0], [9000.0, 0.0]])
    rollout["next", "way"][0, -1] = torch.tensor([-300.0, 0.0])
    keep = animation.draw_legend
    monkeypatch.setattr(animation, "draw_legend", lambda figure: (seen.update(axes=figure.axes[0]), keep(figure)))
    list(animation._frames(rollout, env.field, env.region, "", 200))
    low, high = seen["axes"].get_ylim()
    assert -17 + 4.5 < high < 20  # 500 km to the north, but not 9000 km
    assert low < -17
    cross = next(line for line in seen["axes"].lines if line.get_marker() == "x").get_ydata()
    assert cross.item() == pytest.approx(rollout["next", "position"][0, -1, 0].item() - 300 / 110.65, abs=0.02)


def test_wrong_flights(flight, tmp_path: Path) -> None:
    rollout, env = flight
    file = tmp_path / "a.gif"
    with pytest.raises(KeyError, match="must be flown with TrackGradient"):
        write_flight_gif(file, rollout.exclude("way"), env.field, env.region)
    with pytest.raises(ValueError, match="must be of one vehicle"):
        write_flight_gif(file, torch.cat((rollout, rollout)), env.field, env.region)
    with pytest.raises(ValueError, match="width_px must be a whole number from 1 on, got 0"):
        write_flight_gif(file, rollout, env.field, env.region, width_px=0)
    with pytest.raises(ValueError, match="at least one image"):
        save_gif(file, [], 100)
    with pytest.raises(ValueError, match=r"colors must be .*, got 300"):
        save_gif(file, [Image.new("RGB", (2, 2))], 100, colors=300)
    with pytest.raises(ValueError, match="deviations must be"):
        way_ellipse(torch.zeros(2), torch.zeros(2), torch.eye(2), deviations=0)
    assert not file.exists()


def test_recipe_writes_the_animation(tmp_path: Path) -> None:
    options = {"navigator": "geodesic", "max_steps": 2, "start_heading": 270.0, "out": tmp_path}
    config = recipe.Config("60.4N 5.3E", "60.2N 1.1W", animate=tmp_path / "new" / "flight.gif", **options)
    assert "animate" not in recipe.fly(config)
    assert Image.open(config.animate).n_frames == 5
    assert Image.open(config.animate).width == 720
    with pytest.raises(UsageError, match=r"an animation must end in \.gif, got flight\.mp4"):
        recipe.prepare(recipe.Config("60.4N 5.3E", "60.2N 1.1W", animate=Path("flight.mp4"), **options))
