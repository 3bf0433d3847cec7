"""Navigators by the texts that commands take: labels, needs, options, and trained agents of every kind."""

import shutil
from pathlib import Path

import figures
import pytest
import torch
from plots import NAVIGATOR_COLORS
from support.networks import network_file
from torchrl.envs import StepCounter, TransformedEnv

from magrl import GeomagneticNavEnv, Region, Scenario, evaluate
from magrl.evaluation.options import choose_trips, first_trips
from magrl.navigators import NAVIGATORS, Anywhere, FieldPolicy, PolicyConfig, load_policy, policy_env, save_policy
from magrl.navigators.names import KINDS, PRETRAINED, check_distinct, make_navigator, named, training_settings
from magrl.navigators.quasi_newton import probe_length
from magrl.pilot.network import pretrained
from magrl.sensor_std import SensorStd
from magrl.transforms import ReadingView

STD, BIAS = (0.3, 0.0, 3.0), (0.4, 0.1, 4.0)


@pytest.fixture(scope="module")
def env() -> GeomagneticNavEnv:
    return GeomagneticNavEnv(num_envs=2, seed=0, max_leg_km=30.0)


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


def test_every_navigator_has_labels_and_a_color_and_moves(env: GeomagneticNavEnv) -> None:
    assert NAVIGATOR_COLORS.keys() <= KINDS.keys() == {"gg_td3", "td3", *NAVIGATORS, *PRETRAINED}
    for shown in (("gg_td3", "td3", "ga", "pso", "afsa", "secant", "parallel"), figures.MARKERS):  # of one figure
        assert len({NAVIGATOR_COLORS[name] for name in shown}) == len(shown)
    for name, kind in KINDS.items():
        assert kind.name == name
        assert kind.label in kind.description
        if name in NAVIGATORS:
            navigator = make_navigator(name, env)
            assert navigator(policy_env(env, navigator).reset())["action"].shape == (2, 2)


def test_a_file_says_what_its_agent_is(env: GeomagneticNavEnv, tmp_path: Path) -> None:
    """Its name in results, its label in tables, and what it was trained on; a label replaces the first two."""
    save_policy(tmp_path / "pilot.safetensors", Anywhere())
    region = "the region"
    for settings, wanted in (
        ({"guided": True}, ("gg_td3", "Gradient-Guided TD3", region)),
        ({"guided": True, "noise": STD}, ("gg_td3_noise", "Gradient-Guided TD3, trained with noise", region)),
        ({"guided": False}, ("td3", "TD3", region)),
        ({"guided": False, "noise": STD}, ("td3_noise", "TD3, trained with noise", region)),
        ({"guided": None}, ("run", "run", "tasks of its own")),
        (None, ("anywhere", "anywhere (PPO)", "random planets")),
    ):
        path = tmp_path / "pilot.safetensors"
        if settings:
            shutil.rmtree(tmp_path / "run", ignore_errors=True)
            path = trained(env, tmp_path / "run", **settings)
        for text, names in ((f"{path}", wanted[:2]), (f"my agent={path}", ("my agent", "my agent"))):
            kind, source, file = named(text)
            assert (kind.name, kind.description, kind.trained_on, source) == (*names, wanted[2], path)
            assert file.is_file()


def test_a_path_may_have_the_sign_of_a_label(env: GeomagneticNavEnv, tmp_path: Path) -> None:
    path = trained(env, tmp_path / "tau=0.1")
    assert [named(text).source for text in (f"{path}", f"A={path}")] == [path, path]


def test_navigators_are_made_for_their_environment_and_sensors(env: GeomagneticNavEnv) -> None:
    wrapped = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0, max_leg_km=30.0), StepCounter())
    for name, kind in NAVIGATORS.items():
        navigator = make_navigator(name, wrapped, sensor_std=SensorStd(STD, BIAS))
        assert type(navigator) is kind
        assert navigator.max_leg_km == 30
    assert make_navigator("secant", env, sensor_std=SensorStd(STD, BIAS)).probe_km == probe_length(STD)
    assert [make_navigator("ga", env, seed=seed).seed for seed in (3, 4)] == [3, 4]


def test_a_policy_of_any_algorithm_is_a_file_or_a_folder(env: GeomagneticNavEnv, run: Path, tmp_path: Path) -> None:
    """Its network may be none of the library: this one turns right and moves by 30 km."""
    view = ReadingView(keys=["elapsed_steps"], max_leg_km=30.0, max_turn_rad=1.5)
    save_policy(tmp_path / "policy.onnx", network_file(tmp_path, 1, bias=20.0), view)
    for text in (f"right={tmp_path / 'policy.onnx'}", str(tmp_path / "policy.onnx"), f"{tmp_path}"):
        assert make_navigator(text, env)(env.reset())["action"].tolist() == [[30, 1.5]] * 2
    assert isinstance(make_navigator(f"{run}", env), FieldPolicy)
    shutil.copy(tmp_path / "policy.onnx", tmp_path / "ppo.onnx")
    labels = [named(f"{path}").kind.label for path in (tmp_path, tmp_path / "policy.onnx", tmp_path / "ppo.onnx")]
    assert labels == [tmp_path.name, tmp_path.name, "ppo"]


def test_texts_that_name_no_navigator(env: GeomagneticNavEnv, run: Path, tmp_path: Path) -> None:
    for text, error, message in (
        ("dowsing", ValueError, r"unknown navigator 'dowsing': choose from kalman, anywhere, .*, or \[LABEL=\]PATH"),
        ("x" * 5000, ValueError, r"unknown navigator 'x{76}\.\.\.: choose"),
        (f"td3={run}", ValueError, "the name td3 follows from a file: leave it out, or choose another label"),
        (f"secant={run}", ValueError, "the name secant follows from a file"),
        (f"{tmp_path}", FileNotFoundError, f"there is no policy file at {tmp_path}/policy.safetensors"),
        ("A=b.onnx", FileNotFoundError, "there is no policy file at b.onnx"),
        (f"A=b/{'x' * 5000}", FileNotFoundError, "there is no policy file at b/xxx"),
    ):
        with pytest.raises(error, match=message):
            make_navigator(text, env)
    elsewhere = GeomagneticNavEnv(Scenario(region=Region((40, 50), (0, 10)), objective_floors=None), seed=0)
    with pytest.raises(ValueError, match=rf"^{run}: .*trained"):
        make_navigator(f"{run}", elsewhere)
    with pytest.raises(TypeError, match=rf"^{run} is trained and takes no options, got wings"):
        make_navigator(f"{run}", env, wings=2)


def test_a_price_of_a_step_is_an_option_of_the_agent_without_a_map() -> None:
    env = GeomagneticNavEnv(num_envs=50, seed=0, max_steps=80)
    agents = [make_navigator("anywhere", env, step_price=price) for price in (0.1, 3.0)]
    assert [agent.rules.step_price for agent in agents] == [0.1, 3.0]
    assert agents[0].rules.max_steps == 80
    assert not torch.equal(*(agent(policy_env(env, agent).reset())["action"] for agent in agents))


def test_the_agent_without_a_map_flies_within_the_limits_of_the_environment() -> None:
    limits = {"max_leg_km": 30, "max_turn_deg": 20, "max_steps": 80, "start_heading": "random"}
    episodes = evaluate("anywhere", first_trips(choose_trips(None, "paper-100"), 3), **limits)
    assert episodes["success"].all()
    assert episodes["spl"].mean() > 0.95


def test_navigators_that_are_given_twice(env: GeomagneticNavEnv, run: Path, tmp_path: Path) -> None:
    other = trained(env, tmp_path / "run", guided=False)
    check_distinct(["secant", "ga", f"A={run}", f"A={other}", "anywhere", f"B={pretrained('anywhere')}"])
    for texts, message in (
        (("secant", "ga", "secant"), "^secant is given twice: the same episodes again are no spread"),
        ((f"{run}", f"A={run / '..' / run.name}"), "^A=.* is given twice"),
        (("anywhere", f"{pretrained('anywhere')}"), "has the name of another navigator, anywhere: write LABEL="),
    ):
        with pytest.raises(ValueError, match=message):
            check_distinct(texts)


def test_settings_of_a_training_are_read_from_the_file_of_the_policy(env: GeomagneticNavEnv, tmp_path: Path) -> None:
    """An option overrides them, with a note; a scenario is the same by its content."""
    one, other = (trained(env, tmp_path / name, zeta=0.02, noise=STD, scenario="scenario.toml") for name in "ab")
    plain, texts = trained(env, tmp_path / "c"), ["secant", f"{one}", f"B={other}"]
    settings = {"zeta": 0.02, "errors": STD, "scenario": one / "scenario.toml"}
    assert training_settings(texts, zeta=None) == (settings, [])
    note = f"zeta is 0.5, in training 0.02 ({one}), 0.02 (B={other})"
    assert training_settings(texts, zeta=0.5) == (settings | {"zeta": 0.5}, [note])
    with pytest.raises(ValueError, match=r"trained with different zeta, .* \(.*c\): choose with --zeta"):
        training_settings([*texts, f"{plain}"])
    eddies = trained(env, tmp_path / "d", task="eddies")
    assert training_settings([f"{eddies}"])[1] == [
        f"{eddies} was trained for eddies, and flies other tasks here: score it there"
    ]
    save_policy(tmp_path / "pilot.safetensors", Anywhere(zeta=0.03))
    assert training_settings([f"{tmp_path / 'pilot.safetensors'}"]) == ({"zeta": 0.03}, [])


def test_a_policy_file_without_settings_of_a_training_is_loaded() -> None:
    path = pretrained("anywhere")
    assert load_policy(path).rules.max_steps == 120
    assert training_settings([str(path)])[0] == {"zeta": 0.01}
