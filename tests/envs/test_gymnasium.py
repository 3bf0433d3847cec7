"""The Gymnasium interface: the same bits as TorchRL, the conventions of Gymnasium, and stable-baselines3."""

import importlib
import math
import os
import subprocess
import sys
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from pandas import DataFrame
from support.recipes import load
from torchrl.envs import Compose, TransformedEnv

import magrl
from magrl import score
from magrl.envs import PUBLIC_KEYS, GeomagneticNavEnv, Scenario, geomagnetic, planet_scenario
from magrl.envs.gymnasium import ANYWHERE_ID, ENV_ID, GeomagneticNavGymEnv, GeomagneticNavVectorEnv
from magrl.errors import SensorErrors
from magrl.evaluation import episode_measures
from magrl.field import elements_at
from magrl.named_tasks import NAMED_TASKS, anywhere_env
from magrl.pilot.observation import OBSERVATION_SIZE
from magrl.transforms import AlignmentReward, FieldGradient, GradientHeading, TargetDifference

PAPER = Scenario(field=Scenario().build_field())
"""The paper's scenario, with its field built once for all tests."""
NUM = 5
SHORT = {"scenario": PAPER.replace(distance_range_km=(40, 120)), "max_steps": 7, "zeta": 0.3}
"""Options with which episodes end at every step limit, and some on arrival."""
NOISE = SensorErrors((0.05, 0.05, 5.0), seed=3)


def make(**options: Any) -> gymnasium.Env:
    return gymnasium.make(ENV_ID, **{"scenario": PAPER} | options)


def make_vec(num_envs: int = NUM, **options: Any) -> gymnasium.vector.VectorEnv:
    return gymnasium.make_vec(ENV_ID, num_envs=num_envs, **{"scenario": PAPER} | options)


def torchrl_env() -> TransformedEnv:
    """The environment of the recipes, built here from their parts."""
    base = GeomagneticNavEnv(num_envs=NUM, seed=11, **SHORT)
    view = base.observation_view()
    guidance = (FieldGradient(base.field), GradientHeading(), AlignmentReward(weight=3.0, offset=math.pi / 4))
    return TransformedEnv(base, Compose(*guidance, *view.observation_transforms(), view.action_transform()))


def random_actions(num: int, seed: int, steps: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (steps, num, 2)).astype(np.float32)


def action(*numbers: float) -> np.ndarray:
    return np.array(numbers, dtype=np.float32)


def equal(array: np.ndarray, tensor: torch.Tensor) -> None:
    assert array.dtype == tensor.numpy().dtype
    np.testing.assert_array_equal(array, tensor.numpy())


# The same dynamics, to the bit


PLANETS = {"scenario": planet_scenario(3, seed=0, distance_range_km=(60, 200)), "max_steps": 2, "reward": "spl"}
FLIGHTS = {
    "paper": (ENV_ID, SHORT | {"reward": "paper"}, torchrl_env),
    "anywhere": (ANYWHERE_ID, PLANETS, lambda: anywhere_env(NUM, seed=11, **PLANETS)),
}


@pytest.mark.parametrize(("name", "options", "make_env"), FLIGHTS.values(), ids=FLIGHTS)
def test_a_batch_flies_as_in_torchrl(name: str, options: dict, make_env: Callable[[], TransformedEnv]) -> None:
    envs, env = gymnasium.make_vec(name, num_envs=NUM, autoreset_mode="SameStep", **options), make_env()
    state, ends, arrivals, returns = env.reset(), 0, 0, np.zeros(NUM)
    equal(envs.reset(seed=11)[0], state["observation"])
    for actions in random_actions(NUM, 0, 4 if options is PLANETS else 25):
        step, state = env.step_and_maybe_reset(state.set("action", torch.from_numpy(actions)))
        observations, rewards, terminated, truncated, info = envs.step(actions)
        equal(observations, state["observation"])
        for value, key in ((rewards, "reward"), (terminated, "terminated"), (truncated, "truncated")):
            equal(value, step["next", key].squeeze(-1))
        done, returns = step["next", "done"].squeeze(-1).numpy(), returns + rewards
        assert bool(info) == done.any()
        for index in done.nonzero()[0]:
            equal(info["final_obs"][index], step["next", "observation"][index])
            if options["reward"] == "spl":  # each episode begins at 0
                assert returns[index] == pytest.approx(10 * step["next", "earned_spl"][index].item(), abs=1e-5)
            returns[index] = 0.0
        ends, arrivals = ends + done.sum(), arrivals + terminated.sum()
    assert ends >= 2 * NUM, "every vehicle was to fly more than one episode"
    assert arrivals >= 3 or options is PLANETS, "episodes were to end on arrival, apart from the others"


# Without a map


def test_starts_without_a_map() -> None:
    state, northward = anywhere_env(NUM, seed=11, **PLANETS).reset(), planet_scenario(3, seed=0, start_heading="north")
    assert (state["heading"] != 0).all()
    assert (anywhere_env(NUM, scenario=northward).reset()["heading"] == 0).all()
    assert (state["sensor_std"] > 0).any()


def test_a_scenario_of_many_regions() -> None:
    planets = planet_scenario(3, seed=0)
    envs = make_vec(scenario=planets, observation="track", reward="base")
    envs.reset(seed=0)
    assert np.isfinite(envs.step(random_actions(NUM, 0, 1)[0])[1]).all()
    with pytest.raises(ValueError, match="is of one region, the scenario has 3: take observation='track'"):
        make_vec(scenario=planets)


# Named tasks


def test_tasks_have_a_score_to_reach_and_a_step_limit() -> None:
    """The registry has no step limit, with which Gymnasium would cut the episodes of longer scenarios."""
    for name in filter(lambda name: name.startswith("magrl/"), gymnasium.registry):
        assert 5 < gymnasium.spec(name).reward_threshold < 10
    env, envs = make(max_steps=60), make_vec(max_episode_steps=60)
    assert env.spec.max_episode_steps == envs.spec.max_episode_steps == 60
    assert env.spec.reward_threshold == gymnasium.spec(ENV_ID).reward_threshold
    for again in (gymnasium.make(env.spec), gymnasium.make_vec(env.spec)):
        assert again.unwrapped.torchrl_env.base_env.max_steps == again.spec.max_episode_steps == 60


def test_tasks_on_planets_end_by_distance() -> None:
    """Unless a scenario says otherwise; those of the paper's region end by its rule."""
    planets = planet_scenario(1, seed=0)
    for task in ("anywhere", "readings", "storm"):
        assert NAMED_TASKS[task].make(1, scenario=planets).arrival == "distance"
    assert NAMED_TASKS["storm"].make(1, scenario=planets.replace(arrival="objective")).arrival == "objective"


@pytest.mark.parametrize("task", ["readings", "storm"])
def test_tasks_for_a_memory_show_readings_alone(task: str) -> None:
    """Those of Storm are farther from the truth than what the vehicle is told."""
    planets = planet_scenario(3, seed=0)
    envs = gymnasium.make_vec(f"magrl/GeomagneticNavigation{task.title()}-v2", num_envs=40, scenario=planets)
    assert envs.reset(seed=0)[0].shape == (40, 26)
    state = envs.unwrapped.torchrl_env.rollout(8, break_when_any_done=False)
    assert not {"displacement", "planned_leg", "belief_mean"} & set(state.keys())
    error = (state["field"] - state["true_field"])[..., 2]
    told = torch.hypot(state["sensor_std"], state["bias_std"])[..., 2]
    assert (error.square().mean() > 9 * told.square().mean()) == (task == "storm")


# Modes of autoreset

MODES = {"default": {}, "disabled": {"autoreset_mode": "Disabled"}}


def ended_after(envs: gymnasium.vector.VectorEnv, step: tuple) -> tuple:
    """The results of a step, and the first observation of the vehicles that ended, where they do not start alone."""
    ended = step[2] | step[3]
    if envs.metadata["autoreset_mode"] is AutoresetMode.DISABLED and ended.any():
        with pytest.raises((gymnasium.error.ResetNeeded, AssertionError)):  # the latter by Gymnasium's
            envs.step(envs.action_space.sample())
        return *step, envs.reset(options={"reset_mask": ended})[0]
    return *step, step[0]


@pytest.mark.parametrize("mode", MODES.values(), ids=MODES)
def test_modes_are_those_of_gymnasium(mode: dict) -> None:
    batch, reference = make_vec(1, **mode, **SHORT), make_vec(1, vectorization_mode="sync", vector_kwargs=mode, **SHORT)
    assert batch.metadata["autoreset_mode"] is batch.autoreset_mode is reference.metadata["autoreset_mode"]
    np.testing.assert_array_equal(batch.reset(seed=4)[0], reference.reset(seed=4)[0])
    for actions in random_actions(1, 2, 16):
        flown = [ended_after(envs, envs.step(actions)) for envs in (batch, reference)]
        (*results, info, start), (*expected, last, first) = flown
        for value, other in zip((*results, start), (*expected, first), strict=True):
            np.testing.assert_array_equal(value, other.astype(value.dtype))
        assert info.keys() == last.keys()
        assert all(info[name][0] == last[name][0] for name in info)


@pytest.mark.parametrize("mode", MODES.values(), ids=MODES)
def test_modes_fly_the_same_episodes(mode: dict) -> None:
    flights = []
    for envs in (make_vec(**mode, **SHORT), make_vec(autoreset_mode="SameStep", **SHORT)):
        steps: list[list[tuple]] = [[] for _ in range(NUM)]
        state, idle = envs.reset(seed=11)[0], np.zeros(NUM, dtype=bool)
        for _ in range(24):
            *step, _, after = ended_after(envs, envs.step(np.sin(9 * state[:, :2])))
            for row in np.flatnonzero(~idle):
                steps[row].append((*state[row], *(value[row] for value in step[1:])))
            if envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP:
                assert not step[1][idle].any()
                idle = step[2] | step[3]
            state = after
        flights.append(steps)
    for some, others in zip(*flights, strict=True):
        assert len(some) > 16
        assert some == others[: len(some)]


# Spaces


def test_dict_observation_is_a_copy_of_the_public_keys() -> None:
    flown = []
    for spoil in (False, True):
        env = make(observation="dict")
        assert set(env.observation_space.keys()) == set(PUBLIC_KEYS)
        observation, _ = env.reset(seed=0)
        for value in observation.values() if spoil else ():
            value[:] = 0.5
        flown.append(env.step(action(0, 0))[0]["field"])
    np.testing.assert_array_equal(*flown)


def test_keys_of_own_transforms_can_be_observed() -> None:
    """Also one of a name that "flat" uses; the transforms are cloned."""
    parts = [NOISE, TargetDifference()]
    envs = [make(transforms=parts, observation=("field", "field_difference")) for _ in range(2)]
    first, second = (env.reset(seed=0)[0] for env in envs)
    assert set(first) == set(envs[0].observation_space.spaces) == {"field", "field_difference"}
    assert envs[0].observation_space.contains(first)
    np.testing.assert_array_equal(first["field"], second["field"])
    clean, _ = make(observation="dict").reset(seed=0)
    assert 0 < abs(first["field"] - clean["field"])[2] < 30
    env = make(transforms=[NOISE], observation="track")
    assert env.reset(seed=0)[0].shape == env.observation_space.shape == (OBSERVATION_SIZE,)


# The end of an episode


def test_measures_are_those_of_metrics() -> None:
    torch.manual_seed(2)
    env, envs = GeomagneticNavEnv(num_envs=NUM, seed=3, **SHORT), make_vec(scale_actions=False, **SHORT)
    rollout = env.rollout(SHORT["max_steps"], break_when_any_done=False, break_when_all_done=True)
    expected = episode_measures(rollout)
    envs.reset(seed=3)
    seen = none = np.zeros(NUM, dtype=bool)
    for actions in rollout["action"].unbind(1):
        *_, info = envs.step(actions.numpy())
        for index in np.flatnonzero(info.get("_success", none) & ~seen):
            for name in ("success", "steps", "shortest_km", "length_km", "navigation_error_km", "spl"):
                assert info[name][index] == pytest.approx(expected[name][index].item(), rel=1e-9), name
        seen = seen | info.get("_success", none)
    assert seen.all()
    assert expected["success"].any()


@pytest.mark.parametrize("scaled", [True, False])
def test_an_arrival_is_declared_with_the_third_number(scaled: bool) -> None:
    env = make(arrival="declared", scale_actions=scaled)
    env.reset(seed=0)
    np.testing.assert_allclose(env.action_space.high, [1, 1, 1] if scaled else [50, math.pi / 2, 1], rtol=1e-6)
    stay = -1.0 if scaled else 0.0
    assert not env.step(action(stay, 0.0, -0.5))[2]
    *_, terminated, _, info = env.step(action(stay, 0.0, 0.5))
    assert terminated
    assert (info["success"], info["false_arrival"]) == (False, True)


# Pictures


def test_pictures() -> None:
    envs, env = make_vec(2, render_mode="rgb_array"), make(render_mode="rgb_array")
    envs.reset(seed=0)
    env.reset(seed=0)
    first, second = envs.render()
    assert (first.shape, first.dtype) == ((700, 700, 3), np.uint8)
    assert not np.array_equal(first, second)
    env.step(action(1, 1))
    assert not np.array_equal(env.render(), first)
    with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
        assert make_vec(2).render() is GeomagneticNavGymEnv(scenario=PAPER).render() is None


# Bad input


def test_bad_options() -> None:
    for options, message in (
        ({"observation": 5}, "observation must be a Sequence, got 5"),
        ({"observation": ("field", "wings")}, "observation names 'wings', which is not among the keys"),
        ({"num_envs": 2}, "makes one vehicle, without 'num_envs': use gymnasium.make_vec"),
        ({"autoreset_mode": "SameStep"}, "without 'autoreset_mode': use gymnasium.make_vec"),
        ({"transforms": [5]}, r"transforms\[0\] must be a Transform, got 5"),
        (
            {"task": "boxes"},
            f"task must be one of {', '.join(map(repr, NAMED_TASKS))}, got 'boxes'",
        ),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            make(**options)


def test_bad_calls() -> None:
    env = GeomagneticNavGymEnv(scenario=PAPER, max_steps=1)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2))
    env.reset(seed=0, options={"task": 3})  # ignored, as in Gymnasium's environments
    for bad, message in (
        ((0, 0, 0), r"real numbers of shape \(1, 2\).*got int64 of shape \(1, 3\)"),
        ((1.5, 0.0), r"of vehicles \[0\] are not finite or out of bounds, \[\[1.5, 0.0\]\] in \[-1, 1\]: clip them"),
        ((0.1j, 0), "actions must be real numbers of .* got complex"),
    ):
        with pytest.raises(ValueError, match=message):
            env.step(np.array(bad))
    envs = make_vec(2, scale_actions=False)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=r"of vehicles \[1\] .* out of bounds.* or \[\[51.0, 0.0\]\] as distance"):
        envs.step(np.array([[50.0, 0.0], [51.0, 0.0]]))


# Conventions of Gymnasium


@pytest.mark.slow
def test_programs_choose_how_processes_start_and_forked_ones_do_not_wait_for_threads_of_their_parent() -> None:
    code = f"""
import multiprocessing
import gymnasium
import magrl
gymnasium.make({ENV_ID!r}).reset(seed=0)
print(multiprocessing.get_start_method(allow_none=True))
envs = gymnasium.make_vec({ENV_ID!r}, 1, "async", {{"context": "fork"}})
print(envs.reset(seed=0)[0].shape)
envs.close()
"""
    command = {"args": [sys.executable, "-W", "ignore", "-c", code], "env": {**os.environ, "OMP_NUM_THREADS": "2"}}
    done = subprocess.run(**command, capture_output=True, text=True, check=False, timeout=100, encoding="utf-8")
    assert done.stdout.splitlines() == ["None", "(1, 13)"], done.stderr


def test_environments_are_registered_once() -> None:
    before = gymnasium.spec(ENV_ID)
    importlib.reload(magrl)
    assert gymnasium.spec(ENV_ID) is before
    assert type(make().unwrapped) is GeomagneticNavGymEnv
    assert type(make_vec(1)) is GeomagneticNavVectorEnv


def test_checkers_find_nothing() -> None:
    stable_baselines3 = pytest.importorskip("stable_baselines3.common.env_checker")
    env = make(disable_env_checker=True).unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env, skip_render_check=True)
        stable_baselines3.check_env(env)


# stable-baselines3


def test_stable_baselines3_example(tmp_path: Path, monkeypatch) -> None:
    """It leaves its curve, and an agent that has the score of its model."""
    pytest.importorskip("stable_baselines3")
    example = load("docs/examples/sb3")
    monkeypatch.setattr(example, "POINTS", 2)
    monkeypatch.setattr(example, "score", partial(score, max_steps=5))
    small = {"num_envs": 8, "total_timesteps": 80, "learning_starts": 60, "gradient_steps": 1, "episodes": 4}
    run = tmp_path / "nogo-SAC-seed0"
    result = example.main(example.Config("sac", "nogo", **small, out=run))
    load("docs/tables/agents").keep_agents(
        [(("nogo", "SAC"), DataFrame({"seed": [0], "score": [1]}))], tmp_path, tmp_path
    )
    assert b"docs/examples" in (run / "policy.onnx").read_bytes()
    assert b"docs/examples" not in (tmp_path / "nogo-SAC.onnx").read_bytes()
    for path in (run / "policy.onnx", tmp_path / "nogo-SAC.onnx"):
        saved = score(path, "nogo", episodes=4, max_steps=5)
        assert result["score"] == pytest.approx(saved["score"], abs=1e-3)
    head, *rows = (run / "train.csv").read_text("utf-8").split()
    assert head == "frames,eval_score,eval_success_rate,eval_spl"
    assert [int(row.split(",")[0]) for row in rows] == [8, 40, 80, 80]


def test_batched_environment_under_stable_baselines3() -> None:
    pytest.importorskip("stable_baselines3")
    from magrl.envs.sb3 import BatchedVecEnv

    options, ended = {"autoreset_mode": "SameStep", **SHORT}, 0
    vec_env, envs = BatchedVecEnv(make_vec(**options)), make_vec(**options)
    vec_env.seed(9)
    np.testing.assert_array_equal(vec_env.reset(), envs.reset(seed=9)[0])
    for actions in random_actions(NUM, 6, 15):
        observations, rewards, dones, infos = vec_env.step(actions)
        expected, expected_rewards, terminated, truncated, info = envs.step(actions)
        np.testing.assert_array_equal(observations, expected)
        np.testing.assert_array_equal(rewards, expected_rewards)
        np.testing.assert_array_equal(dones, terminated | truncated)
        np.testing.assert_array_equal([each["TimeLimit.truncated"] for each in infos], truncated)
        for index in np.flatnonzero(dones):
            np.testing.assert_array_equal(infos[index]["terminal_observation"], info["final_obs"][index])
            assert infos[index]["is_success"] == info["final_info"]["success"][index]
            ended += 1
    assert ended > NUM
    with pytest.raises(ValueError, match=r"autoreset_mode='SameStep'\), got .*NEXT_STEP"):
        BatchedVecEnv(make_vec(1))


def test_stable_baselines3_makes_environments_without_a_map(monkeypatch) -> None:
    """With the render mode that it chooses: each vehicle is drawn over its own region."""
    env_util = pytest.importorskip("stable_baselines3.common.env_util")
    planets = planet_scenario(3, seed=0)
    vec_env = env_util.make_vec_env(ANYWHERE_ID, n_envs=2, seed=0, env_kwargs={"scenario": planets})
    vec_env.reset()
    drawn: list[tuple] = []
    image = np.zeros((2, 2, 3), dtype=np.uint8)
    monkeypatch.setattr(geomagnetic, "rgb_array", lambda *args: drawn.append(args[2:]) or image)
    assert len(vec_env.get_images()) == 2
    for (field, boxes, paths, *_), env in zip(drawn, vec_env.envs, strict=True):
        state = env.unwrapped._envs._state
        assert list(boxes) == [env.unwrapped.torchrl_env.base_env.region[int(state["region"])]]
        torch.testing.assert_close(elements_at(field, paths[0][:1]).float(), state["true_field"])
    monkeypatch.undo()
    env = GeomagneticNavEnv(planets, num_envs=9, seed=0, render_mode="rgb_array")
    env.reset()
    with pytest.raises(ValueError, match="made for one region, got 3"):
        env.render()


def test_without_stable_baselines3_the_extra_is_named(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "stable_baselines3.common.vec_env", None)
    monkeypatch.delitem(sys.modules, "magrl.envs.sb3", raising=False)
    with pytest.raises(ImportError, match=r"pip install 'magrl\[sb3\]'"):
        importlib.import_module("magrl.envs.sb3")


@pytest.mark.parametrize("task", ["anywhere", "readings", "storm"])
def test_observations_stay_within_their_bounds(task: str) -> None:
    """Of random flights that end far away; the parts that are clamped have finite bounds."""
    envs = GeomagneticNavVectorEnv(16, task=task, max_steps=20)
    space, seen = envs.single_observation_space, [envs.reset(seed=0)[0]]
    envs.action_space.seed(0)
    seen += [envs.step(envs.action_space.sample())[0] for _ in range(20)]
    assert all(space.contains(row) for rows in seen for row in rows)
    assert np.isfinite(space.high).sum() == (5 if task == "anywhere" else 20)
