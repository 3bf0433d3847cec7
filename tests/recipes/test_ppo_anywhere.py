"""The recipe of the agent without a map: its environment, what its agent may not know, and what it trains on."""

from __future__ import annotations

import math

import ppo_anywhere as recipe
import pytest
import torch
from support.recipes import small
from torch import Tensor
from torchrl.envs.utils import check_env_specs

from magrl import GeomagneticNavEnv, Scenario, planet_scenario
from magrl.field import igrf_coefficients, random_planets
from magrl.field.planets import gauss_moments
from magrl.geodesy import geodesic
from magrl.navigators import make_correcting_actor
from magrl.pilot.network import correction_network
from magrl.random_numbers import TEST_SEED
from magrl.training import parse_config


def training_env(noise: tuple[float, float, float] = (0.0, 0.0, 0.0), km: tuple = (300.0, 500.0), **rules):
    scenario = planet_scenario(8, seed=3, **recipe.PRESETS["fast"].regions | {"distance_range_km": km})
    base = GeomagneticNavEnv(scenario, num_envs=6, start_heading="random", seed=5, **rules)
    return recipe.make_env(base, recipe.Config(noise=noise))


def test_specs_of_the_training_environment() -> None:
    env = training_env()
    check_env_specs(env, break_when_any_done="both")
    assert env.observation_spec["observation"].shape == (6, 19)
    assert env.transform[0].levels is not None
    assert training_env((0.05, 0.05, 5.0)).transform[0].levels is None
    assert env.transform[0].seed == 5


def test_critics_see_the_true_displacement_and_the_return_is_the_reward() -> None:
    td = training_env().rollout(4, break_when_any_done=False)["next"]
    torch.testing.assert_close(td["true_displacement_scaled"], td["true_displacement"] / 200)
    assert 0.4 < td["true_displacement_scaled"].norm(dim=-1).mean() < 3.0
    torch.testing.assert_close(td["episode_reward"], td["reward"].cumsum(1))
    assert "episode_reward_proximity" not in td.keys()  # noqa: SIM118
    assert recipe.OBSERVED == ("observation", "true_displacement_scaled", "highest_spl")


def test_agents_that_declare_are_rewarded_for_right_declarations_alone() -> None:
    env = training_env(km=(60.0, 90.0), arrival="declared", radius_km=25.0, max_steps=6)
    assert env.action_spec.shape == (6, 2)
    actor = make_correcting_actor(correction_network((8,)), recipe.rules_of(env.base_env, recipe.PRESETS["fast"]))
    assert actor.in_keys == ["observation", ("track", "plan"), "heading"]
    td = env.rollout(6, actor, break_when_any_done=False)["next"]
    first = td["done"].cumsum(1) - td["done"].long() == 0
    assert ((td["declared"] & first).sum(1) == 1).all()
    right = td["success"] & first
    assert right.any()
    torch.testing.assert_close(td["highest_spl"][td["declared"] & first] > 0, td["success"][td["declared"] & first])


def test_the_vehicle_is_that_of_the_settings() -> None:
    config = recipe.PRESETS["fast"].replace(max_leg_km=10.0, max_turn_deg=20.0, drift=0.2)
    planets = planet_scenario(4, seed=3, **config.regions)
    base = GeomagneticNavEnv(planets, num_envs=6, seed=5, drift_km=config.drift_km, **config.rules)
    rules = recipe.rules_of(base, config)
    assert (rules.max_leg_km, math.degrees(rules.max_turn_rad)) == (10.0, pytest.approx(20.0))
    td = recipe.make_env(base, config).rollout(5)["next"]
    leg, true_leg = td["leg"], td["true_leg"]
    assert (leg[..., 1].abs() <= rules.max_turn_rad + 1e-6).all()
    drift = (true_leg - leg)[..., 0].abs() / leg[..., 0]
    assert 0.05 < drift.max() < 0.2 + 1e-5
    path_km = leg[..., 0].cumsum(1)
    trip_km = geodesic(*td["start_position"].unbind(-1), *td["target_position"].unbind(-1))[0]
    best = trip_km / (path_km + td["true_displacement"].norm(dim=-1))
    torch.testing.assert_close(td["highest_spl"].squeeze(-1).double(), best.clamp(max=1), rtol=1e-4, atol=1e-4)


@pytest.mark.usefixtures("without_figures")
def test_only_the_spectrum_of_the_earth_is_trained_on(tmp_path, monkeypatch) -> None:
    """Coefficients of other signs, and thus the same spectrum, give the same planets; no others are read."""

    def other_earth(*_: object) -> Tensor:
        earth = igrf_coefficients("2022-01-01", 13)
        signs = torch.randint(0, 2, (2, *earth.shape), generator=torch.Generator().manual_seed(1)) * 2 - 1
        return torch.complex(earth.real * signs[0], earth.imag * signs[1])

    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("the coefficients of the Earth are read")

    def without_earth(count: int, seed: int, **options: object) -> Scenario:
        seeds.append(seed)
        return planet_scenario(count, seed, **options)

    planets, moments, seeds = random_planets(4, seed=0), gauss_moments(), []
    monkeypatch.setattr("magrl.field.planets.igrf_coefficients", other_earth)
    assert torch.equal(random_planets(4, seed=0), planets)
    assert str(gauss_moments()) == str(moments)
    monkeypatch.setattr("magrl.envs.random_regions.igrf_coefficients", refuse)
    monkeypatch.setattr("magrl.field.igrf.igrf_coefficients", refuse)  # of IGRF as a field model
    monkeypatch.setattr(recipe, "earth_scenario", without_earth)
    recipe.train(small(recipe, tmp_path / "run", total_frames=64, max_steps=3))
    assert seeds == [TEST_SEED]  # the test trips alone are on Earth


def test_evaluations_are_by_the_reward_of_the_tasks() -> None:
    config = recipe.PRESETS["fast"].replace(drift=0.2)
    env = recipe.evaluation_env(planet_scenario(4, seed=3, **config.regions), 6, 5, config, **recipe.options_of(config))
    step = env.rollout(2)
    torch.testing.assert_close(step["next", "reward"], 10 * (step["next", "earned_spl"] - step["earned_spl"]))


def test_presets() -> None:
    for name, far in (("fast", False), ("far", True)):
        config = parse_config(recipe.Config, recipe.PRESETS, recipe.RECIPE, None, ["--preset", name])
        assert (config.preset, config.regions.get("distance_law") == "log") == (name, far)
        assert planet_scenario(2, seed=0, **config.regions).distance_range_km == config.distance_range_km
