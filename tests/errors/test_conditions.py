"""Conditions of real vehicles: presets, what navigators are told, what they may read, and the commands."""

import math
from pathlib import Path

import evaluate
import fly
import pytest
import torch
import tyro
from support.errors import every_error
from tensordict import TensorDict
from torch import nn
from torch.nn.functional import pad
from torchrl.envs.utils import step_mdp

from magrl import Anywhere, Kalman
from magrl.envs import GeomagneticNavEnv, Region, Scenario
from magrl.errors import (
    CONDITIONS,
    ERRORS,
    Conditions,
    Spikes,
    VectorErrors,
    conditions_named,
    load_conditions,
    with_conditions,
)
from magrl.errors.base import TYPICAL_FIELD, ReadingErrors, true_keys
from magrl.evaluation import Sheet, evaluation_rollout
from magrl.field.elements import field_vector
from magrl.field.weather import weather_record
from magrl.navigators import Secant, policy_env
from magrl.navigators.names import make_navigator
from magrl.random_numbers import stream_normal
from magrl.sensor_std import OUTAGE_STD, STD_KEYS, SensorStd
from magrl.transforms import TrackField
from magrl.transforms.episode import Episode, EpisodeNumbers

NAMES = [name for name in CONDITIONS if name != "laboratory"]


def nav(num_envs: int, drift_km: float = 0.0, **options: object) -> GeomagneticNavEnv:
    return GeomagneticNavEnv(num_envs=num_envs, seed=0, start_heading="random", drift_km=drift_km, **options)


class TypicalField(nn.Module):
    """The field that data sheets are stated for, everywhere."""

    def forward(self, latitude: torch.Tensor, _: torch.Tensor) -> torch.Tensor:
        return field_vector(torch.tensor(TYPICAL_FIELD, dtype=torch.float64)).expand(*latitude.shape, 3)


@pytest.mark.parametrize("name", NAMES)
def test_what_is_told_is_the_size_of_the_errors(name: str) -> None:
    """At the latitude at which a dipole has the typical inclination; the weather of a ship over its trip of 500 km."""
    region = Scenario(region=Region((39, 43), (160, 170)))
    env = with_conditions(nav(1000, CONDITIONS[name].drift_km(50.0), scenario=region), name)
    env.base_env.field = TypicalField()
    state = env.reset()
    if name == "ship":
        ahead = env.full_action_spec["action"].space.high * torch.tensor([1.0, 0.0])
        state = env.rollout(10, lambda td: td.set("action", ahead), break_when_any_done=False)["next"].flatten(0, 1)
    error = state["field"] - state["true_field"]
    told = (state["sensor_std"].square() + state["bias_std"].square()).sqrt()
    measured = state["bias_std"][0] < math.inf
    size = (error / told).square().mean(0).sqrt()
    torch.testing.assert_close(size, measured.float(), rtol=0.12, atol=0)


VECTOR = VectorErrors((10.0,) * 3, attitude_deg=(0.1, 0.1))
EVERY_ERROR = Conditions(
    "own",
    errors={
        "sensors": {"scale": (0.01,) * 3, "outage_rate": 0.3, "vector": VECTOR},
        "north": "marine",
        "weather": {"record": "disturbed"},
    },
)


@pytest.mark.parametrize(
    "conditions", [CONDITIONS["low-cost"], CONDITIONS["ship"], EVERY_ERROR], ids=lambda one: one.name
)
def test_what_is_told_follows_from_the_reading(conditions: Conditions) -> None:
    """If it depended on the true field, a policy could compute that field from it.

    That of D grows with the latitude of a dipole with the inclination that is read.
    """
    rollout = with_conditions(nav(20, conditions.drift_km(50.0)), conditions).rollout(3)
    rows = rollout.flatten(0, 1)
    read = rows["sensor_std"][:, 1] < OUTAGE_STD
    assert 20 <= read.sum() < (55 if conditions is EVERY_ERROR else 61)
    tangent = torch.tan(torch.deg2rad(rows["field"][read, 1])) / 2
    grows = conditions.errors["north"] != "low-cost"
    north = conditions.transforms()[-1].accuracy(torch.zeros(3))
    for key, std, own in zip(STD_KEYS, conditions.std, north, strict=True):
        expected = torch.tensor(std).repeat(len(tangent), 1)
        expected[:, 0] = (expected[:, 0].square() + grows * own[0].square() * tangent.square()).sqrt()
        torch.testing.assert_close(rows[key][read], expected, rtol=1e-4, atol=1e-5)


def test_the_variances_of_all_errors_add_up() -> None:
    """By hand at I = 45 deg, B_H = 20000 nT, D = 0: weather, hard iron, bias, noise and north."""
    weather = {"record": "disturbed"}
    sensors = {"noise": (0.3, 0.0, 4.0), "bias": (0.0, 0.0, 5.0), "vector": VectorErrors((10.0,) * 3)}
    north = {"constant_deg": 0.4, "random_deg": 0.4}
    conditions = Conditions("own", errors={"sensors": sensors, "north": north, "weather": weather})
    reading = torch.tensor([0.0, 45.0, 20000.0], dtype=torch.float64)
    parts = torch.stack([torch.stack(part.accuracy(reading)) for part in conditions.transforms()])
    std = SensorStd(*parts.square().sum(0).sqrt())
    moments = weather_record("disturbed").second_moments(500 / 24)
    (north2, east2, down2), both = moments.diagonal(), moments[0, 2]
    nanotesla = torch.stack((east2 + 100, (north2 + down2) / 2 - both + 100, north2 + 100)).sqrt()
    degrees = torch.tensor([20000.0, 20000 * 2**0.5, 1.0], dtype=torch.float64).reciprocal()
    degrees[:2] = torch.rad2deg(degrees[:2])
    torch.testing.assert_close(std.noise, torch.tensor([0.5, 0.0, 4.0], dtype=torch.float64))
    torch.testing.assert_close(std.drift, nanotesla * degrees)
    constant = torch.tensor([0.4, 0.0, 5.0], dtype=torch.float64)
    torch.testing.assert_close(std.bias, torch.hypot(constant, std.drift))
    torch.testing.assert_close(std.iron, torch.tensor([10.0, 10.0, 10.0], dtype=torch.float64))


def test_navigators_are_told_what_they_can_tell_apart() -> None:
    env, told = nav(2), SensorStd((0.3, 0.0, 3.0), (0.4, 0.1, 4.0))
    secant = make_navigator("secant", env, sensor_std=told)
    assert secant.sensor_std.tolist() == [[0.3, 0.0, 3.0], [0.4, 0.1, 4.0], [0.0] * 3, [0.0] * 3]
    assert torch.equal(secant.reading_std(TensorDict()), secant.sensor_std[0])
    here = {"bias_std": torch.tensor([[0.9, 0.0, 4.0]]), "drift_std": torch.tensor([[0.8, 0.0, 0.0]])}
    here = TensorDict(here, batch_size=1)  # larger at this latitude
    assert secant.reading_std(here)[0].tolist() == pytest.approx([0.5, 0.0, 3.0])
    assert secant.accuracy(here).bias[0].tolist() == pytest.approx([0.9, 0.1, 4.0])


@pytest.mark.parametrize("kind", [Kalman, Anywhere])
def test_agents_heed_all_errors_that_are_stated(kind: type[Kalman]) -> None:
    """Each kind changes the leg; without a statement, readings are perfect."""
    state, policy, told = nav(4).reset(), kind(), {}

    def action() -> torch.Tensor:
        seen = TrackField(policy.rules, [*told])(state.clone().update(told))
        return policy(seen)["action"]

    actions = [action()]
    told = dict.fromkeys(STD_KEYS, 0 * state["field"])
    assert torch.equal(action(), actions[0])
    told = {}
    for key, std in zip(STD_KEYS, ((0.3, 0.3, 30.0), (3.0, 0.5, 90.0), (2.0, 0.4, 60.0), (40.0,) * 3), strict=True):
        told[key] = torch.tensor(std).expand(4, 3)
        actions.append(action())
        assert not torch.allclose(actions[-1], actions[-2]), key


# Commands


BOAT = Path(__file__).parent.parent.parent / "docs" / "examples" / "boat.toml"


def test_own_errors_in_a_file() -> None:
    """The errors of the example are those written in Python, and both commands take its path."""
    vector = VectorErrors(hard_iron_nt=(20.0, 20.0, 20.0), attitude_deg=(0.05, 0.05))
    options = {
        "sensors": {"noise": (0.02, 0.02, 5.0), "vector": vector},
        "north": {"constant_deg": 0.2, "random_deg": 0.1},
        "motion": {"log_scale": 0.02, "current_km_h": 1.0},
        "weather": {"record": "disturbed"},
    }
    boat = Conditions("survey boat", 15.0, options)
    assert (load_conditions(BOAT).name, load_conditions(BOAT).std) == (boat.name, boat.std)
    envs = [with_conditions(nav(2, 8.0, max_steps=2), each, 3) for each in (str(BOAT), boat)]
    flown = [evaluation_rollout(env, Secant()) for env in envs]
    torch.testing.assert_close(flown[0]["field"], flown[1]["field"], rtol=0, atol=0)
    for recipe, places in ((fly, ["60.4N 5.3E", "62.0N 6.7W"]), (evaluate, ["secant"])):
        assert tyro.cli(recipe.Config, args=[*places, "--errors", str(BOAT)]).sheet.errors == str(BOAT)
        noise = tyro.cli(recipe.Config, args=[*places, "--errors", "0.05", "0.05", "5"]).sheet.errors
        assert noise == (0.05, 0.05, 5.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "speed = 3",
            rf"mine\.toml: Conditions have name, .*errors {', '.join(ERRORS)}, got 'speed'",
        ),
        ("sensors.bais = [1, 1, 1]", r"SensorErrors has no option 'bais': choose from noise, bias, .*levels, stated$"),
        ("sensors.seed = 3", r"SensorErrors has no option 'seed'"),
        ("spikes.rates = 0.1", r"Spikes has no option 'rates': choose from sizes, rate, stated$"),
        ("spikes.rate = 0.1", r"mine\.toml: Spikes.*missing.*'sizes'"),
        ("motion.speed_km_h = 3", r"MotionError has no option 'speed_km_h'"),
        ("motion = 3", r"mine\.toml: MotionError needs options by name, got 3"),
        (
            "sensors.vector.hard_iron = [1, 1, 1]",
            r"VectorErrors has no option 'hard_iron': .*soft_iron, attitude_deg, fixed",
        ),
        ("weather.stated.nois = [1, 1, 1]", r"SensorStd has no option 'nois': choose from noise, bias, drift, iron"),
        ("[sensors.vector]\nhard_iron_nt = 3", r"mine\.toml: hard_iron_nt must be 3 .*got 3"),
        ("north = 'best'", r"mine\.toml: .*must be one of 'magnetic', 'fiber-optic'"),
        ("[north", r"mine\.toml: the file is not valid TOML"),
        (None, r"No such file.*mine\.toml"),
    ],
)
def test_files_of_errors_that_are_refused(tmp_path: Path, text: str | None, message: str) -> None:
    if text is not None:
        (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        conditions_named(str(tmp_path / "mine.toml"))


def test_no_two_errors_draw_the_same_random_numbers() -> None:
    kinds, channels = [EpisodeNumbers], []
    while kinds:
        kind = kinds.pop()
        kinds += [child for child in kind.__subclasses__() if child.__module__.startswith("magrl.")]
        channels += [vars(kind)["channel"]] if "channel" in vars(kind) else []
    assert len(channels) > 8
    assert sorted(channels) == sorted(set(channels))


class Temperature(ReadingErrors):
    """An error of B_H, constant in an episode, as a user writes it."""

    channel = 8
    default_in_keys, in_sizes = ("field",), {"field": (3,)}
    numbers_key, stream_key = "temperature_error", "temperature_stream"
    size = draws = 1

    def __init__(self, std_nt: float = 10.0, **options: object) -> None:
        super().__init__(**options)
        self.std_nt = std_nt
        self._set_accuracy()

    def _constants(self, stream: torch.Tensor) -> torch.Tensor:
        return self.std_nt * stream_normal(stream, self.draws)

    def _disturb(self, tensordict: TensorDict, values: list[torch.Tensor], episode: Episode) -> torch.Tensor:
        self._measure(tensordict, values[0], values[0] + pad(episode.numbers, (2, 0)))
        return episode.numbers

    def accuracy(self, field: torch.Tensor) -> SensorStd:
        none = torch.zeros_like(field)
        return SensorStd(none, none + field.new_tensor((0.0, 0.0, self.std_nt)), none, none)


def test_an_error_is_one_class_and_one_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files, conditions, environments, the accuracy that vehicles know, and the tests then have it."""
    monkeypatch.setitem(ERRORS, "temperature", Temperature)
    (tmp_path / "warm.toml").write_text("temperature.std_nt = 30.0\nspikes = { sizes = [1, 1, 9], rate = 0.5 }")
    warm = load_conditions(tmp_path / "warm.toml")
    assert [type(error) for error in warm.transforms()] == [Spikes, Temperature]
    assert warm.std.bias == (0.0, 0.0, 30.0)
    state = with_conditions(nav(500), warm).reset()
    assert state["temperature_error"].std().item() == pytest.approx(30.0, rel=0.1)
    assert (state["field"] - state["true_field"])[:, 2].std().item() == pytest.approx(30.7, rel=0.1)
    assert {"temperature_error", "temperature_stream"} <= set(true_keys())
    assert Temperature in map(type, every_error())
    with pytest.raises(ValueError, match=r"Temperature has no option 'std': choose from std_nt, stated$"):
        Conditions("own", errors={"temperature": {"std": 3.0}})


def test_fly_under_conditions(tmp_path: Path) -> None:
    """With a heading that was chosen, which is the true one; the measured one has the error of the north reference."""
    options = {"sheet": Sheet(errors="underwater"), "start_heading": 90.0, "max_steps": 2}
    config = fly.Config("60.4N 5.3E", "64.1N 21.9W", navigator="secant", out=tmp_path, **options)
    steps = fly.rollout(*fly.prepare(config)["with_signal"][1:], 90.0)
    north = torch.rad2deg(steps["true_heading"] - steps["heading"])[0, 0]
    torch.testing.assert_close(steps["true_heading"][0, 0], torch.tensor([torch.pi / 2]))
    torch.testing.assert_close(north, steps["north_error"][0, 0, 2:], atol=1e-4, rtol=0)
    assert north.abs() > 0.001


@pytest.mark.parametrize("name", ["kalman", "secant"])
def test_a_navigator_does_not_rely_on_the_reading_of_an_outage(name: str) -> None:
    """It goes the same way whatever the reading is, within a percent of what the reading is worth otherwise."""
    noise = (0.05, 0.05, 5.0)
    env = with_conditions(nav(10), Conditions("noise", errors={"sensors": {"noise": noise}}), seed=0)
    navigator = make_navigator(name, env.base_env, sensor_std=noise)
    env = policy_env(env, navigator)
    step = env.rollout(4, navigator, break_when_any_done=False)[:, -1]

    def turns(std: float, shift: float) -> torch.Tensor:
        """Turns [rad] after a reading with ``std`` times the noise that is shifted by ``shift`` times the noise."""
        told = (std * torch.tensor(noise)).expand(10, 3)
        read = step.clone()
        read["next", "field"], read["next", "sensor_std"] = step["next", "field"] + shift * torch.tensor(noise), told
        read = env.transform[-1](read) if name == "kalman" else read
        return navigator(step_mdp(read))["action"][:, 1]

    heeded, ignored = ((turns(std, 5.0) - turns(std, 0.0)).abs().mean() for std in (1.0, OUTAGE_STD))
    assert heeded > 0.01
    assert ignored < 0.01 * heeded
