"""Navigators by the texts that commands take: labels, needs, options, and trained agents of every kind."""

from pathlib import Path

import pytest
import torch
from plots import NAVIGATOR_COLORS
from support.networks import network_file
from torchrl.envs import StepCounter, TransformedEnv

from magrl import GeomagneticNavEnv, Region, Scenario, evaluate
from magrl.agents import FieldPolicy, PolicyConfig, load_policy, save_policy
from magrl.evaluation.navigators import (
    NAVIGATOR_NAMES,
    TRAINED,
    check_distinct,
    label,
    make_navigator,
    needs,
    trained_on,
    training_settings,
)
from magrl.evaluation.scenarios import choose_tasks, first_tasks
from magrl.navigators import NAVIGATORS, Anywhere
from magrl.navigators.quasi_newton import probe_length
from magrl.sensor_std import SensorStd
from magrl.tracking.network import pretrained
from magrl.transforms import ReadingView

STD, BIAS = (0.3, 0.0, 3.0), (0.4, 0.1, 4.0)


@pytest.fixture(scope="module")
def env() -> GeomagneticNavEnv:
    return GeomagneticNavEnv(num_envs=2, seed=0, max_move_km=30.0)


def trained(env: GeomagneticNavEnv, folder: Path, **settings: object) -> Path:
    """Return the folder of a policy that has learned nothing, whose file holds settings of its training."""
    policy = FieldPolicy(PolicyConfig(env.observation_view(), (8,), layer_norm=False))
    policy.training = {"guided": True, "scenario": None, "zeta": 0.01, "noise": (0.0, 0.0, 0.0)} | settings
    folder.mkdir()
    save_policy(folder / "policy.safetensors", policy)
    if settings.get("scenario"):
        (folder / "scenario.toml").write_text("date = 2026-07-01", encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def run(env: GeomagneticNavEnv, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(env, tmp_path_factory.mktemp("runs") / "run")


def test_every_navigator_has_labels_and_a_color_and_moves(env: GeomagneticNavEnv, run: Path) -> None:
    assert NAVIGATOR_COLORS.keys() == NAVIGATOR_NAMES.keys() == {*TRAINED, *NAVIGATORS}
    assert len(set(NAVIGATOR_COLORS.values())) == len(NAVIGATOR_COLORS)
    for name in NAVIGATOR_NAMES:
        navigator = make_navigator(f"{name}={run}" if name in TRAINED else name, env)
        assert navigator(env.reset())["action"].shape == (2, 2)
        assert NAVIGATOR_NAMES[name] in label(name)
        assert needs(name) == getattr(navigator, "needs", needs(name))


def test_navigators_are_made_for_their_environment_and_sensors(env: GeomagneticNavEnv) -> None:
    wrapped = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0, max_move_km=30.0), StepCounter())
    for name, kind in NAVIGATORS.items():
        navigator = make_navigator(name, wrapped, sensor_std=SensorStd(STD, BIAS))
        assert type(navigator) is kind
        assert navigator.max_move_km == 30
    assert make_navigator("secant", env, sensor_std=SensorStd(STD, BIAS)).probe_km == probe_length(STD)
    first, second = (make_navigator("ga", env, seed=seed).generator.initial_seed() for seed in (3, 4))
    assert (first, second) == (3, 4)


def test_a_policy_of_any_algorithm_is_a_file_or_a_folder(env: GeomagneticNavEnv, run: Path, tmp_path: Path) -> None:
    """Its network may be none of the library: this one turns right and moves by 30 km."""
    view = ReadingView(keys=["elapsed_steps"], max_move_km=30.0, max_turn_rad=1.5)
    save_policy(tmp_path / "policy.onnx", network_file(tmp_path, 1, bias=20.0), view)
    for text in (f"policy:right={tmp_path / 'policy.onnx'}", str(tmp_path / "policy.onnx"), f"policy={tmp_path}"):
        assert make_navigator(text, env)(env.reset())["action"].tolist() == [[30, 1.5]] * 2
    assert isinstance(make_navigator(f"policy={run}", env), FieldPolicy)
    assert [label(text) for text in ("policy:SAC", "policy", "runs/ppo.onnx")] == ["SAC", "own policy", "ppo"]


def test_texts_that_name_no_navigator(env: GeomagneticNavEnv, run: Path, tmp_path: Path) -> None:
    for text in ("dowsing", "secant=runs/a", "secant:own", f"td3:own={run}"):
        with pytest.raises(
            ValueError, match=f"unknown navigator '{text}': choose from gg_td3=RUN, .*anywhere=RUN, .*kalman, anywhere"
        ):
            make_navigator(text, env)
    for function in (label, needs, trained_on):
        with pytest.raises(ValueError, match="unknown navigator 'dowsing'"):
            function("dowsing")
    for text, error, message in (
        ("gg_td3", ValueError, "gg_td3 needs the folder of a finished run: gg_td3=RUN"),
        ("policy:SAC", ValueError, "policy needs the folder of a finished run or the file of a policy"),
        (f"td3={tmp_path}", FileNotFoundError, "there is no policy file at"),
    ):
        with pytest.raises(error, match=message):
            make_navigator(text, env)
    elsewhere = GeomagneticNavEnv(Scenario(region=Region((40, 50), (0, 10)), objective_floors=None), seed=0)
    with pytest.raises(ValueError, match=rf"td3={run}: .*trained"):
        make_navigator(f"td3={run}", elsewhere)


def test_a_price_of_a_step_is_an_option_of_the_agent_without_a_map() -> None:
    env = GeomagneticNavEnv(num_envs=50, seed=0, max_steps=80)
    agents = [make_navigator("anywhere", env, step_price=price) for price in (0.1, 3.0)]
    assert [agent.rules.step_price for agent in agents] == [0.1, 3.0]
    assert agents[0].rules.max_steps == 80
    assert not torch.equal(*(agent(env.reset())["action"] for agent in agents))


def test_the_agent_without_a_map_flies_within_the_limits_of_the_environment() -> None:
    limits = {"max_move_km": 30, "max_turn_deg": 20, "max_steps": 80, "start_heading": "random"}
    episodes = evaluate("anywhere", first_tasks(choose_tasks(None, "paper-100"), 3), **limits)
    assert episodes["success"].all()
    assert episodes["spl"].mean() > 0.95


def test_navigators_that_are_given_twice(run: Path) -> None:
    check_distinct(["secant", "ga", f"td3={run}", "policy:A=a.safetensors", "policy:B=b.safetensors"])
    for texts, message in (
        (("secant", "ga", "secant"), "^secant is given twice: the same episodes again are no spread"),
        ((f"gg_td3={run}", f"td3={run.parent / 'x' / '..' / run.name}"), "^td3=.* is given twice"),
        (("anywhere", f"anywhere={run}"), "has the name of the pretrained anywhere: write policy:LABEL="),
    ):
        with pytest.raises(ValueError, match=message):
            check_distinct(texts)


def test_settings_of_a_training_are_read_from_the_file_of_the_policy(env: GeomagneticNavEnv, tmp_path: Path) -> None:
    """An option overrides them, with a note; a scenario is the same by its content."""
    one, other = (trained(env, tmp_path / name, zeta=0.02, noise=STD, scenario="scenario.toml") for name in "ab")
    plain, texts = trained(env, tmp_path / "c"), ["secant", f"gg_td3={one}", f"gg_td3_noise={other}"]
    settings = {"zeta": 0.02, "errors": STD, "scenario": one / "scenario.toml"}
    assert training_settings(texts, zeta=None) == (settings, [])
    note = f"zeta is 0.5, in training 0.02 (gg_td3={one}), 0.02 (gg_td3_noise={other})"
    assert training_settings(texts, zeta=0.5) == (settings | {"zeta": 0.5}, [note])
    with pytest.raises(ValueError, match=r"trained with different zeta, .* \(gg_td3=.*c\): choose with --zeta"):
        training_settings([*texts, f"gg_td3={plain}"])
    with pytest.raises(ValueError, match=rf"{plain} was trained as gg_td3, not td3: write gg_td3={plain}"):
        training_settings([f"td3={plain}"])
    save_policy(tmp_path / "pilot.safetensors", Anywhere(zeta=0.03))
    assert training_settings([f"anywhere={tmp_path / 'pilot.safetensors'}"]) == ({"zeta": 0.03}, [])


def test_a_policy_file_without_settings_of_a_training_is_loaded() -> None:
    path = pretrained("anywhere")
    assert load_policy(path).rules.max_steps == 120
    assert training_settings([str(path)])[0] == {"zeta": 0.01}
