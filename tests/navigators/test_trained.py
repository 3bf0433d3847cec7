"""Trained policies as navigators of the plain environment, and their files."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torchrl.envs import Compose, TransformedEnv

from magrl import Anywhere, GeomagneticNavEnv, ObservationView, Scenario
from magrl.files import load_tensors, save_tensors
from magrl.named_tasks import no_go_env
from magrl.navigators import FieldPolicy, PolicyConfig, export_policy, load_policy, save_policy
from magrl.navigators.names import make_navigator, training_settings
from magrl.pilot.network import pretrained

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


def test_save_and_load_give_the_same_actions(env, tmp_path: Path) -> None:
    states = env.rollout(3).unbind(1)
    for layer_norm in (True, False):
        policy = FieldPolicy(PolicyConfig(env.observation_view(), CELLS, layer_norm))
        save_policy(tmp_path / "policy.pt", policy)
        loaded = load_policy(tmp_path / "policy.pt")
        assert loaded.config == policy.config
        assert all(torch.equal(loaded(state.clone())["action"], policy(state.clone())["action"]) for state in states)


@pytest.mark.parametrize("name", ["policy.safetensors", "policy.onnx"])
def test_a_file_holds_the_shield_of_its_policy(name: str, tmp_path: Path) -> None:
    env = no_go_env(64, seed=3, observation="dict", scale_actions=False)
    config = PolicyConfig(no_go_env(seed=3).view, CELLS)
    torch.manual_seed(0)
    bare = FieldPolicy(config)
    policy = FieldPolicy(replace(config, shield=True), bare.actor)
    if name == "policy.onnx":
        pytest.importorskip("onnxruntime")
        exported = export_policy(bare.actor, config.view)
        policy = FieldPolicy(replace(exported.config, shield=True), exported.actor)
    save_policy(tmp_path / name, policy)
    states = env.rollout(5, make_navigator("geodesic", env.base_env), break_when_any_done=False).flatten()
    loaded, same, other = (each(states.clone())["action"] for each in (load_policy(tmp_path / name), policy, bare))
    assert torch.equal(loaded, same)
    assert not torch.allclose(loaded, other, atol=0.01)


def test_a_policy_has_no_shield_by_default(view, policy, tmp_path: Path) -> None:
    """Nor has one whose file says nothing of it; it needs areas in the view."""
    save_policy(tmp_path / "policy.safetensors", policy)
    content = load_tensors(tmp_path / "policy.safetensors")
    del content["config"]["shield"]
    save_tensors(content, tmp_path / "policy.safetensors")
    assert not load_policy(tmp_path / "policy.safetensors").config.shield
    with pytest.raises(ValueError, match="shield True needs a view with no-go areas: take observe_areas=True, or"):
        PolicyConfig(view, CELLS, shield=True)


def test_an_actor_of_another_shape_is_not_saved(env, tmp_path: Path) -> None:
    """A file could not be read again; the check draws no random numbers, which a training would miss."""
    policy = FieldPolicy(PolicyConfig(env.observation_view(), CELLS))
    policy.actor, state = PolicyConfig(env.observation_view(), (7,)).make_actor(), torch.get_rng_state()
    with pytest.raises(ValueError, match=r"save_policy\('policy.onnx', actor, view\) for a network of your own"):
        save_policy(tmp_path / "policy.safetensors", policy)
    assert torch.equal(torch.get_rng_state(), state)
    assert not (tmp_path / "policy.safetensors").exists()


REAL = "must hold real numbers of size up to 1e\\+06"


@pytest.mark.parametrize("kind", ["region", "anywhere", "memory"])
def test_damaged_files_of_all_kinds_are_refused(kind: str, policy, tmp_path: Path) -> None:
    path, other = tmp_path / "policy.safetensors", {"memory": "rules"}.get(kind, "memory")
    save_policy(path, policy if kind == "region" else load_policy(pretrained(kind)))
    content = load_tensors(path)
    weights, name = content["weights"], next(iter(content["weights"]))
    for change, message in (
        ({"format": [1] * 10**5}, r"of format \[1, 1, .{70}\.\.\.; this version reads format 6: train it again"),
        ({"more": 1}, "unexpected keyword argument 'more'"),
        ({other: {}}, f"unexpected keyword argument '{other}'"),
        ({"kind": "map"}, "it is of the kind 'map', expected is pilot or memory or "),
        ({"config": {}}, "does not hold a valid policy"),
        ({"weights": {}}, "Missing key"),
        ({"weights": weights | {"more.weight": torch.zeros(1)}}, "more.weight"),
        ({"weights": weights | {name: weights[name] * math.nan}}, f"{name} is not finite"),
        ({"weights": weights | {name: weights[name] * 1e38}}, f"{name} {REAL}"),
        ({"weights": weights | {name: weights[name].to(torch.complex64)}}, f"{name} {REAL}, got torch.complex64"),
    ):
        save_tensors(content | change, path)
        with pytest.raises(ValueError, match=message) as error:
            load_policy(path)
        assert str(path) in str(error.value)


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        ("region", {"view": {}}, "does not hold a valid policy"),
        ("anywhere", {"rules": {"max_steps": 0}}, "max_steps"),
        ("anywhere", {"rules": {"speed": 3}}, "speed"),
        *((kind, {"num_cells": [8, 8]}, r"size mismatch|Missing key") for kind in ("region", "anywhere")),
        *(
            (kind, {"num_cells": cells}, "does not hold a valid policy")
            for kind in ("region", "anywhere")
            for cells in ((60000, 60000), (10**9,), (0,), ("a",), (1,) * 200_000, ((4,),))
        ),
    ],
)
def test_a_policy_of_another_shape_than_its_weights_is_refused(
    kind: str, change: dict, message: str, policy, tmp_path: Path
) -> None:
    """Before its network is made."""
    path = tmp_path / "policy.safetensors"
    save_policy(path, policy if kind == "region" else load_policy(pretrained(kind)))
    content = load_tensors(path)
    save_tensors(content | {"config": content["config"] | change}, path)
    with pytest.raises(ValueError, match=f"{path}.*{message}"):
        load_policy(path)


def test_settings_of_a_training_are_checked(policy, tmp_path: Path) -> None:
    path = tmp_path / "policy.safetensors"
    save_policy(path, policy)
    content = load_tensors(path)
    for training, message in (
        ({"noise": [0.0, -1.0, 0.0]}, "noise.1 must be greater than or equal to 0, got -1"),
        ({"start_heading": "\x1b[2J"}, r"start_heading must be .*, got '\\x1b\[2J'"),
    ):
        save_tensors(content | {"training": training}, path)
        for read in (load_policy, lambda path: training_settings([f"{path}"])):
            with pytest.raises(ValueError, match=message) as error:
                read(path)
            assert str(path) in str(error.value)


def test_a_shipped_agent_has_a_name() -> None:
    assert load_policy("nogo-TD3").config == load_policy(pretrained("nogo-TD3")).config
    with pytest.raises(ValueError, match=r"box-SB3-PPO.onnx .*: it is a bare network"):
        load_policy("box-SB3-PPO")


def test_missing_policy_and_foreign_file(tmp_path: Path) -> None:
    for read in (load_policy, lambda path: Anywhere(source=path)):
        with pytest.raises(FileNotFoundError, match=r"no policy file at .*none\.pt"):
            read(tmp_path / "none.pt")
    (tmp_path / "text.pt").write_text("not an archive", encoding="utf-8")
    with pytest.raises(ValueError, match="no safetensors file"):
        load_policy(tmp_path / "text.pt")
