"""Flights between two places: places as people write them, the recipe, and its figure."""

import json
import math
from pathlib import Path

import fly as recipe
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from magrl.agents import FieldPolicy, PolicyConfig, save_policy
from magrl.envs import PRIVILEGED_KEYS, GeomagneticNavEnv, Region, Regions
from magrl.evaluation.flight import coastlines, flight_figure, frame, shortest_path
from magrl.evaluation.places import (
    check_declination,
    find_elements,
    parse_coordinates,
    parse_elements,
    region_around,
    said,
)
from magrl.field import IGRF, elements_at
from magrl.geodesy import geodesic
from magrl.training import UsageError
from magrl.transforms import TrackView

BERGEN, LERWICK = "60.4N 5.3E", "60.2N 1.1W"
VIEW = TrackView(zeta=0.01, max_steps=4, max_move_km=50.0, max_turn_rad=math.pi / 2)


@pytest.fixture(scope="module")
def field() -> IGRF:
    return IGRF("2025-01-01")


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """Return the folder of an agent without a map, with new weights."""
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("run")
    save_policy(folder / "policy.pt", FieldPolicy(PolicyConfig(VIEW, (8,))))
    return folder


def place(*degrees: float) -> torch.Tensor:
    return torch.tensor(degrees, dtype=torch.float64)


# Places


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("60.4N 5.3E", (60.4, 5.3)),
        ("60.4, 5.3", (60.4, 5.3)),
        ("-33.9 18.4", (-33.9, 18.4)),
        (" 33.9s,18.4w ", (-33.9, -18.4)),
        ("60.4° N, 5.3° E", (60.4, 5.3)),
        ("0 200", (0, -160)),
        ("1N,181E", (1, -179)),
    ],
)
def test_coordinates(text: str, expected: tuple[float, float]) -> None:
    assert parse_coordinates(text).tolist() == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize(
    "text", ["Bergen", "60.4", "60.4N", "5.3E 60.4N", "60.4N5.3E7", "nan 3", "-3N 4", "91 0", "0 361"]
)
def test_coordinates_that_are_none(text: str) -> None:
    with pytest.raises(ValueError, match=r"must (be|have)"):
        parse_coordinates(text)


def test_elements_that_no_field_has() -> None:
    assert parse_elements("60.4N 5.3E") is None
    for text in ("D=181 I=0 BH=1", "D=0 I=91 BH=1", "D=0 I=0 BH=0"):
        with pytest.raises(ValueError, match=f"got '{text}'"):
            parse_elements(text)


def test_the_nearest_place_with_some_elements(field) -> None:
    """Rounded elements are found within 25 km; of two places with nearly the same elements, the nearest is taken."""
    for there, near in (((64.1, -21.9), (60.4, 5.3)), ((-33.9, 151.2), (51.5, -0.1)), ((35.7, 139.7), (21.3, -157.9))):
        elements = parse_elements(said(elements_at(field, place(*there))))
        assert geodesic(*find_elements(field, elements, place(*near)), *place(*there))[0] < 25
    canada, russia = place(57.3, -123.4), place(60.0, 54.6)
    elements = elements_at(field, canada)
    assert geodesic(*find_elements(field, elements, place(50, -100)), *canada)[0] < 0.1
    assert geodesic(*find_elements(field, elements, place(50, 30)), *russia)[0] < 300


def test_elements_of_no_place(field) -> None:
    with pytest.raises(ValueError, match=r"no place has D=-3.20 I=71.50 BH=60000 within .* most similar field found"):
        find_elements(field, place(-3.2, 71.5, 60000), place(60, 5))


def test_region_around_two_places(field) -> None:
    honolulu, tokyo = place(21.3, -157.9), place(35.7, 139.7)
    box = region_around(honolulu, tokyo, field)
    assert box.longitude[1] - box.longitude[0] < 150  # across the antimeridian, not around the Earth
    assert Regions.of(box).contains(torch.stack((honolulu, tokyo, place(28, 180)))).all()
    assert not Regions.of(box).contains(place(28, 0))
    # The margin is reduced where D jumps: that of half the distance, 9.9 degrees, would hold the pole of the field.
    assert 76 < region_around(place(76, 100), place(60, 140), field).latitude[1] < 85
    with pytest.raises(ValueError, match="the declination jumps"):
        region_around(place(85, 120), place(87, 160), field)


def test_declination_near_the_poles(field) -> None:
    for there in ((86.0, 140.0), (-64.0, 136.0), (89.5, 0.0)):
        with pytest.raises(ValueError, match="the declination is hardly defined at 'there', where BH is"):
            check_declination("there", place(*there), field)


# The recipe


def test_flight_of_a_navigator(tmp_path: Path, capsys) -> None:
    track = tmp_path / "tracks" / "flight.geojson"
    options = ("--navigator", "secant", "--out", str(tmp_path), "--export", str(track), "--start-heading", "270")
    recipe.main(["-33.9 18.4", "-33.0, 20.9", *options])
    assert "outcome       arrived\n" in capsys.readouterr().out
    result = json.loads((tmp_path / "flight.json").read_text())
    assert result["start_position"] == pytest.approx([-33.9, 18.4])
    assert result["zeta"] == 0.01
    assert result["max_steps"] == round(3 * result["shortest_km"] / 50) + 20
    assert result["shortest_km"] <= result["length_km"] * 1.1 < 400
    assert result["navigation_error_km"] < 30
    assert (tmp_path / "flight.png").stat().st_size > 10_000
    (feature,) = json.loads(track.read_text())["features"]
    assert feature["properties"]["navigator"] == "secant"
    (west, *_), (first, *_) = feature["geometry"]["coordinates"][:2]
    assert first < west  # the first move of secant leads ahead
    assert len(feature["geometry"]["coordinates"]) == result["steps"] + 1


def test_arrival_means_as_many_kilometers_at_every_distance(run: Path, tmp_path: Path) -> None:
    config = recipe.Config(BERGEN, "64.1N 21.9W", navigator=f"anywhere={run}", out=tmp_path)
    env, watched = recipe.prepare(config)
    assert env.zeta == pytest.approx(0.01 * (400 / watched.bar.total) ** 2)
    assert watched.navigator.config.view.zeta == env.zeta
    assert watched.navigator.config.view.max_steps == 4  # the share of the limit that it was trained with
    chosen, _ = recipe.prepare(recipe.Config(BERGEN, LERWICK, navigator="secant", zeta=0.02, max_steps=7, out=tmp_path))
    assert (chosen.zeta, chosen.max_steps) == (0.02, 7)


def test_flight_of_an_agent_is_repeatable_and_blind(run: Path, tmp_path: Path) -> None:
    """It observes no privileged key: with other values there it moves the same way."""
    config = recipe.Config(
        BERGEN, LERWICK, navigator=f"anywhere={run}", noise=(0.05, 0.05, 5.0), max_steps=6, out=tmp_path
    )
    first, second = recipe.fly(config), recipe.fly(config)
    assert first == second
    assert first["outcome"] == "reached the step limit"
    assert (first["navigator"], first["needs"]) == ("anywhere", "nothing")
    env, watched = recipe.prepare(config)
    state = env.reset()
    assert not set(watched.navigator.in_keys) & {*PRIVILEGED_KEYS, "true_field"}
    action = watched.navigator(state.clone())["action"]
    scrambled = state.clone()
    for key in (*PRIVILEGED_KEYS, "true_field"):
        scrambled[key] = torch.rand_like(scrambled[key].double()).to(scrambled[key].dtype)
    assert torch.equal(watched.navigator(scrambled)["action"], action)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"start": "Bergen"}, "a place must be written such as '60.4N 5.3E'"),
        ({"destination": BERGEN}, "are the same place"),
        ({"destination": "60.4S 174.7W"}, "is the antipode of the start"),
        ({"destination": "86N 140E"}, "the declination is hardly defined at '86N 140E', where BH is"),
        ({"destination": "D=-3.2 I=71.5 BH=60000"}, "no place has D=-3.20 I=71.50 BH=60000"),
        ({"noise": (-0.1, 0.0, 0.0)}, "noise must be .*-0.1"),
        ({"noise": (0.0, math.nan, 0.0)}, "noise must be .*nan"),
        ({"navigator": "compass"}, "unknown navigator 'compass': choose from anywhere, "),
        ({"navigator": "anywhere=nowhere"}, "there is no policy file at nowhere"),
        ({"date": "2031-01-01"}, "outside IGRF-14"),
        ({"zeta": 0.0}, "zeta"),
        ({"max_steps": 0}, "max_steps"),
        ({"start_heading": math.inf}, "start_heading"),
        ({"export": Path("track.txt")}, "must end in one of .geojson, .gpx, .kml"),
    ],
)
def test_wrong_settings(change: dict[str, object], message: str, tmp_path: Path) -> None:
    options = {"start": BERGEN, "destination": LERWICK, "navigator": "secant", "out": tmp_path / "out"} | change
    with pytest.raises(UsageError, match=message.replace("(", r"\(")):
        recipe.prepare(recipe.Config(**options))
    assert not (tmp_path / "out").exists()


def test_files_that_cannot_be_written_and_agents_of_one_region(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(UsageError, match="cannot write"):
        recipe.prepare(recipe.Config(BERGEN, LERWICK, navigator="secant", out=file))
    save_policy(tmp_path / "policy.pt", FieldPolicy(PolicyConfig(GeomagneticNavEnv(seed=0).observation_view(), (8,))))
    with pytest.raises(UsageError, match=r"anywhere=.*: .*trained"):
        recipe.prepare(recipe.Config(BERGEN, LERWICK, navigator=f"anywhere={tmp_path}", out=tmp_path))


def test_a_policy_may_fly_longer_than_it_was_trained_for() -> None:
    """The share of the step limit that it observes ends at 1."""
    view = TrackView(zeta=0.01, max_steps=2, max_move_km=50.0, max_turn_rad=math.pi / 2).observation_transforms()[-1]
    keys = {"field": 3, "target_field": 3, "estimated_field": 3, "aim": 2, "sensor_std": 3}
    state = TensorDict({key: torch.ones(3, size) for key, size in keys.items()}, batch_size=[3])
    state["estimated_gradient"], state["way_covariance"] = torch.ones(3, 3, 2), torch.eye(2).expand(3, 2, 2)
    state["step_count"] = torch.tensor([[1], [2], [5]])
    assert view(state)["observation"][:, 11].tolist() == [0.5, 1.0, 1.0]


# The figure


def test_coastlines() -> None:
    lines = coastlines()
    for known in ((-34.35, 18.48), (70.67, 23.67), (-55.98, -67.28), (28.21, -177.35)):
        north, east = (lines - known).T
        near = np.nanmin(np.hypot(north, east * math.cos(math.radians(known[0]))))
        assert (near < 0.3) == (known != (28.21, -177.35)), known  # Midway is too small
    assert np.nanmax(np.abs(np.diff(lines[:, 1]))) < 90
    assert np.isnan(lines).all(1).sum() == np.isnan(lines).any(1).sum() > 500


def test_shortest_path() -> None:
    path = shortest_path(place(51.5, -0.1), place(-33.9, 151.2), points=50)
    legs, _ = geodesic(*path[:-1].T, *path[1:].T)
    assert legs.sum().item() == pytest.approx(geodesic(*path[0], *path[-1])[0].item(), abs=0.01)
    assert legs.std() < 0.01


def test_frame_has_room_on_each_side() -> None:
    for positions in ([[0.0, 10.0], [0.0, 20.0]], [[60.0, 170.0], [62.0, 190.0]], [[80.0, 0.0], [-80.0, 5.0]]):
        box = frame(torch.tensor(positions))
        height = box.latitude[1] - box.latitude[0]
        width = (box.longitude[1] - box.longitude[0]) * math.cos(math.radians(sum(box.latitude) / 2))
        assert 0.4 < height / width < 2.6
        assert Regions.of(Region(box.latitude, box.longitude)).contains(torch.tensor(positions)).all()


def test_figure_across_the_antimeridian(tmp_path: Path) -> None:
    config = recipe.Config("17S 179.999E", "14S 172W", navigator="secant", max_steps=3, out=tmp_path)
    env, watched = recipe.prepare(config)
    steps = recipe.rollout(env, watched, 90.0)
    assert steps[0, 0]["heading"].item() == pytest.approx(math.pi / 2)
    axes = flight_figure(steps, env.base_env.field, env.base_env.region, "Fiji to Samoa").axes[0]
    lines = {line.get_label(): line.get_xydata() for line in axes.lines}
    assert {"track", "shortest path", "start", "destination", "destination, estimated"} <= lines.keys()
    assert len(lines["track"]) == 4
    between = lines["destination"][0, 0] - lines["start"][0, 0]
    assert between == pytest.approx(8.001, abs=1e-6)
    assert np.abs(np.diff(lines["track"][:, 0])).max() < 1
    with pytest.raises(ValueError, match="must be of one vehicle"):
        flight_figure(torch.cat((steps, steps)), env.base_env.field, env.base_env.region)
