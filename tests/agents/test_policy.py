"""Trained policies as navigators of the plain environment, and their files."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torchrl.envs import Compose, TransformedEnv

from magrl.agents import FieldPolicy, PolicyConfig, load_policy, save_policy
from magrl.envs import GeomagneticNavEnv, Scenario
from magrl.evaluation.navigators import training_settings
from magrl.files import load_tensors, save_tensors
from magrl.transforms import ObservationView

CELLS = (16, 16)


@pytest.fixture(scope="module")
def env() -> GeomagneticNavEnv:
    return GeomagneticNavEnv(num_envs=5, seed=3)


@pytest.fixture(scope="module")
def view(env) -> ObservationView:
    return env.observation_view()


@pytest.fixture
def policy(view) -> FieldPolicy:
    return FieldPolicy(PolicyConfig(view, CELLS))


def test_policy_acts_alike_in_the_plain_and_in_the_training_environment(env, view, policy) -> None:
    scenario = Scenario(field=env.field)
    transforms = Compose(*view.observation_transforms(), view.action_transform())
    training = TransformedEnv(GeomagneticNavEnv(scenario, num_envs=5, seed=9), transforms)
    one, other = GeomagneticNavEnv(scenario, num_envs=5, seed=9).rollout(6, policy), training.rollout(6, policy.actor)
    assert torch.equal(one["next", "position"], other["next", "position"])


def test_a_policy_is_of_its_region(env, policy) -> None:
    policy.check_fits(env)
    azores = Scenario(region={"latitude": (33.0, 43.0), "longitude": (-33.0, -23.0)})
    with pytest.raises(ValueError, match="the policy was trained where D is"):
        policy.check_fits(GeomagneticNavEnv(azores, seed=0))


# Files


@pytest.mark.parametrize("layer_norm", [True, False])
def test_save_and_load_give_the_same_actions(env, tmp_path: Path, layer_norm: bool) -> None:
    policy = FieldPolicy(PolicyConfig(env.observation_view(), CELLS, layer_norm))
    save_policy(tmp_path / "policy.pt", policy)
    loaded = load_policy(tmp_path / "policy.pt")
    assert loaded.config == policy.config
    for state in env.rollout(3).unbind(1):
        assert torch.equal(loaded(state.clone())["action"], policy(state.clone())["action"])


def config(**change) -> Callable:
    return lambda content: content | {"config": content["config"] | change}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda c: c | {"format": [1] * 10**5},
            r"a policy of format \[1, 1, .{70}\.\.\.; this version reads format 4: train it again",
        ),
        (lambda c: c | {"extra": 1}, "unexpected keyword argument 'extra'"),
        (lambda c: c | {"config": {"num_cells": (16,)}}, "view"),
        (config(num_cells=(8, 8)), "size mismatch for .*weight"),
        (config(view={}), "does not hold a valid policy"),
        (lambda c: c | {"weights": {k: v * math.nan for k, v in c["weights"].items()}}, "is not finite"),
    ],
)
def test_damaged_policy_is_refused(policy, tmp_path: Path, change, message: str) -> None:
    path = tmp_path / "policy.pt"
    save_policy(path, policy)
    save_tensors(change(load_tensors(path)), path)
    with pytest.raises(ValueError, match=message) as error:
        load_policy(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("read", [load_policy, lambda path: training_settings([f"td3={path}"])], ids=["policy", "run"])
@pytest.mark.parametrize(
    ("training", "message"),
    [
        ({"noise": [0.0, -1.0, 0.0]}, "noise.1 must be greater than or equal to 0, got -1"),
        ({"noise": [0.0, 1e308, 0.0]}, "noise must be below"),
        ({"zeta": math.nan}, "zeta must be a finite number, got nan"),
        ({"start_heading": "\x1b[2J"}, r"start_heading must be .*, got '\\x1b\[2J'"),
    ],
)
def test_settings_of_a_training_are_checked(policy, tmp_path: Path, read: Callable, training, message: str) -> None:
    path = tmp_path / "policy.safetensors"
    save_policy(path, policy)
    save_tensors(load_tensors(path) | {"training": training}, path)
    with pytest.raises(ValueError, match=message) as error:
        read(path)
    assert str(path) in str(error.value)


def test_missing_policy_and_foreign_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no policy file at .*none\.pt"):
        load_policy(tmp_path / "none.pt")
    (tmp_path / "text.pt").write_text("not an archive", encoding="utf-8")
    with pytest.raises(ValueError, match="no safetensors file"):
        load_policy(tmp_path / "text.pt")
