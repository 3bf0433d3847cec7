"""The recipe of the agent without a map: its environment, what its agent may not know, and a small training."""

from __future__ import annotations

import json
import math
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
import td3_anywhere as recipe
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from magrl import paper
from magrl.agents import FieldPolicy, PolicyConfig, load_policy
from magrl.envs import PRIVILEGED_KEYS, GeomagneticNavEnv, Scenario, planet_scenario
from magrl.field import IGRF, elements_at, igrf_coefficients
from magrl.training import parse_config
from magrl.transforms import RandomSensorNoise, SensorNoise, TrackView

SMALL = {
    "num_regions": 8,
    "num_envs": 16,
    "total_frames": 320,
    "max_steps": 5,
    "num_cells": (16, 16),
    "batch_size": 32,
    "buffer_size": 1000,
    "init_random_frames": 32,
    "updates_per_batch": 2,
    "eval_every": 10,
    "eval_tasks_small": 4,
    "eval_tasks": 6,
    "wandb_mode": "disabled",
}
PRIVILEGED = (*PRIVILEGED_KEYS, "region", "true_field", "true_way", "true_way_scaled", "reward")


def settings(out: Path, **options: object) -> recipe.Config:
    return recipe.FAST.replace(out=out, **SMALL | options)


def view(**options: float) -> TrackView:
    return TrackView(**{"zeta": 0.01, "max_steps": 50, "max_move_km": 50.0, "max_turn_rad": math.pi / 2} | options)


def planet_env(num_envs: int = 6, **options: object) -> GeomagneticNavEnv:
    scenario = planet_scenario(8, seed=3, **recipe.FAST.regions)
    return GeomagneticNavEnv(scenario, num_envs=num_envs, start_heading="random", seed=5, **options)


def agent() -> FieldPolicy:
    torch.manual_seed(0)
    return FieldPolicy(PolicyConfig(view(), (16, 16)))


# Environment


@pytest.mark.parametrize("noise", [(0.0, 0.0, 0.0), (0.05, 0.05, 5.0)])
def test_specs_of_the_training_environment(noise: tuple[float, float, float]) -> None:
    env = recipe.make_env(planet_env(), view(), recipe.Config(noise=noise))
    check_env_specs(env, break_when_any_done="both")
    assert env.observation_spec["observation"].shape == (6, 15)
    assert env.action_spec_unbatched.low.tolist() == [-1.0, -1.0]
    assert (type(env.transform[0]) is RandomSensorNoise) == (not any(noise))
    assert env.transform[0].seed == 5


def test_critics_see_the_true_way_and_the_actor_does_not() -> None:
    env = recipe.make_env(planet_env(), view(), recipe.FAST)
    td = env.rollout(3)["next"]
    torch.testing.assert_close(td["true_way_scaled"], td["true_way"] / 200)
    assert 0.4 < td["true_way_scaled"].norm(dim=-1).mean() < 3.0
    assert PolicyConfig(view(), (8,)).make_actor().in_keys == ["observation"]
    assert recipe.OBSERVED == ("observation", "true_way_scaled")


def test_the_return_is_the_reward_of_the_agent_alone() -> None:
    td = recipe.make_env(planet_env(), view(), recipe.FAST).rollout(4, break_when_any_done=False)["next"]
    torch.testing.assert_close(td["episode_reward"], td["reward"].cumsum(1))
    assert "episode_reward_proximity" not in td.keys()  # noqa: SIM118


def scrambled(td: TensorDict) -> TensorDict:
    """Other values at all privileged keys, of the same shapes and dtypes."""
    other = td.clone()
    for key in set(PRIVILEGED) & set(td.keys()):
        value = td[key]
        other[key] = ~value if value.dtype == torch.bool else (value + 7 if key == "region" else value * 0 + math.nan)
    return other


def test_privileged_keys_do_not_reach_the_policy() -> None:
    """Neither the agent that flies, which carries its own filter, nor the observation that the actor is trained on."""
    base = planet_env(zeta=1.5, max_steps=7)
    with torch.no_grad():
        flight = TransformedEnv(base, SensorNoise((0.05, 0.05, 5.0), seed=1)).rollout(
            12, agent(), break_when_any_done=False
        )
        assert set(PRIVILEGED) - {"true_way", "true_way_scaled", "reward"} <= set(flight.keys())
        again = agent()
        for td in flight.unbind(1):
            assert torch.equal(again(scrambled(td.exclude("action", "next")))["action"], td["action"])
    assert not set(agent().in_keys) & set(PRIVILEGED)

    trained = recipe.make_env(planet_env(), view(), recipe.FAST).rollout(4)
    for td in trained.unbind(1):
        other = scrambled(td.exclude("next")).set("next", scrambled(td["next"]).exclude("observation"))
        seen = Compose(*view().observation_transforms())(other)["next", "observation"]
        assert torch.equal(seen, td["next", "observation"])


# Training


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> tuple[Path, dict[str, float]]:
    """Return the folder and the result of a small training that was left alone."""
    out = tmp_path_factory.mktemp("anywhere") / "run"
    return out, recipe.train(settings(out))


def test_run_folder(trained, outcome: Callable) -> None:
    out, result = trained
    names = {path.name for path in out.iterdir()}
    assert names == {".lock", "config.json", "train.csv", "policy.pt", "eval.json", "training.png"}
    assert (result["num_tasks"], result["frames"], result["tasks_seed"]) == (6, 320, paper.TEST_SEED)
    config = json.loads((out / "config.json").read_text())
    assert (config["recipe"], config["preset"], config["num_regions"]) == ("td3_anywhere.py", "fast", 8)
    rows, _ = outcome(out)
    assert [int(row["updates"]) for row in rows] == [18, 38]
    assert all(math.isfinite(float(row[key])) for row in rows for key in ("loss_critic", "loss_actor", "return"))
    assert all(math.isnan(float(row["return_proximity"])) for row in rows)
    policy = load_policy(out / "policy.pt")
    assert policy.config.view == view(max_steps=5)
    assert GeomagneticNavEnv(num_envs=3, seed=0).rollout(2, policy)["action"].isfinite().all()


@pytest.mark.usefixtures("without_figures")
def test_interrupted_training_resumes_exactly(trained, tmp_path: Path, signalled, same_outcome: Callable) -> None:
    """In the third episode of the vehicles, with the noise of its sensors."""
    run = tmp_path / "run"
    with signalled(12, signal.SIGINT), pytest.raises(SystemExit) as stop:
        recipe.train(settings(run))
    assert stop.value.code == 130
    recipe.train(parse_config(recipe.Config, recipe.PRESETS, recipe.RECIPE, None, ["--resume", str(run)]))
    assert same_outcome(run, trained[0])


@pytest.mark.usefixtures("without_figures")
def test_nothing_of_the_earth_but_its_spectrum_is_trained_on(
    trained, tmp_path: Path, monkeypatch, same_outcome: Callable
) -> None:
    """On an Earth whose coefficients have other signs, and thus the same spectrum, the training is the same."""

    def other_earth(*_: object) -> Tensor:
        earth = igrf_coefficients("2022-01-01", 13)
        signs = torch.randint(0, 2, (2, *earth.shape), generator=torch.Generator().manual_seed(1)) * 2 - 1
        return torch.complex(earth.real * signs[0], earth.imag * signs[1])

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("the coefficients of the Earth are read")

    monkeypatch.setattr("magrl.field.planets.igrf_coefficients", other_earth)
    monkeypatch.setattr("magrl.envs.random_regions.igrf_coefficients", refuse)
    monkeypatch.setattr("magrl.field.igrf.igrf_coefficients", refuse)  # of IGRF as a field model
    seeds = []

    def without_earth(count: int, seed: int, **options: object) -> Scenario:
        seeds.append(seed)
        return planet_scenario(count, seed, **options)

    monkeypatch.setattr(recipe, "earth_scenario", without_earth)
    recipe.train(settings(tmp_path / "run"))
    assert seeds == [paper.TEST_SEED]  # the test tasks alone are on Earth
    assert same_outcome(tmp_path / "run", trained[0])


def test_fields_of_the_planets_are_not_that_of_the_earth() -> None:
    """Beside the dipole: at the same places, the rest of both fields is not correlated."""
    scenario = planet_scenario(256, seed=0, **recipe.FAST.regions)
    middle = torch.stack((scenario.region.latitude.mean(-1), scenario.region.longitude.mean(-1)), -1)
    planets = elements_at(scenario.field, middle, torch.arange(256))
    earth = elements_at(IGRF("2025-01-01"), middle)
    correlation = torch.corrcoef(torch.stack((planets[:, 0], earth[:, 0])))[0, 1]  # D of an axial dipole is 0
    assert abs(correlation) < 0.25  # four standard deviations


# Settings


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"scenario": Path(__file__).parent.parent.parent / "docs/examples/azores.toml"}, "scenario must be left out"),
        ({"buffer_size": 10}, "buffer_size 10 does not hold one batch of 1024"),
        ({"total_frames": 100}, "batch_size 1024 must not exceed total_frames"),
        ({"num_regions": 0}, "num_regions"),
        ({"distance_range_km": (0.0, 500.0)}, "distance_range_km"),
        ({"noise": (0.1, -0.1, 5.0)}, "noise"),
        ({"noise": (0.1, 0.1)}, "noise"),
        ({"seed": paper.TEST_SEED}, "seed"),
    ],
)
def test_bad_settings_are_refused(bad: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        recipe.Config(**bad)


def test_presets() -> None:
    for name, far in (("fast", False), ("far", True)):
        config = parse_config(recipe.Config, recipe.PRESETS, recipe.RECIPE, None, ["--preset", name])
        assert (config.preset, config.regions.get("distance_law") == "log") == (name, far)
        scenario = planet_scenario(2, seed=0, **config.regions)
        assert scenario.distance_range_km == config.distance_range_km
        assert tuple(scenario.random_tasks(4, seed=0).start.shape) == (4, 2)
