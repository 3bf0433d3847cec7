"""The Gymnasium face: the same bits as TorchRL, the conventions of Gymnasium, and what is built on those."""

import importlib.util
import math
import subprocess
import sys
import warnings
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from tensordict import TensorDict
from torchrl.envs import CatTensors, Compose, GymEnv, TransformedEnv

from magrl.envs import PRIVILEGED_KEYS, PUBLIC_KEYS, GeomagneticNavEnv, Scenario, Tasks, task_set
from magrl.envs.gymnasium import ENV_ID, GeomagneticNavGymEnv, GeomagneticNavVectorEnv
from magrl.envs.navigation import navigation_env
from magrl.evaluation import episode_measures
from magrl.transforms import (
    AlignmentReward,
    FieldGradient,
    GradientHeading,
    NorthReferenceError,
    SensorNoise,
    TrackGradient,
    TrackView,
)

ROOT = Path(__file__).parent.parent.parent
PAPER = Scenario(field=Scenario().build_field())
"""The paper's scenario, with its field built once for all tests."""
NUM, STEPS = 5, 25
SHORT = {"scenario": PAPER.replace(distance_range_km=(40, 120)), "max_steps": 7, "zeta": 0.3}
"""Options with which episodes end at every step limit, and some on arrival."""


def make(**options: Any) -> gymnasium.Env:
    return gymnasium.make(ENV_ID, **{"scenario": PAPER} | options)


def make_vec(num_envs: int = NUM, **options: Any) -> gymnasium.vector.VectorEnv:
    return gymnasium.make_vec(
        ENV_ID, num_envs=num_envs, vectorization_mode="vector_entry_point", **{"scenario": PAPER} | options
    )


def torchrl_env(num_envs: int, seed: int, *, guided: bool = True) -> TransformedEnv:
    """The environment of the recipes, built here from their parts."""
    base = GeomagneticNavEnv(num_envs=num_envs, seed=seed, **SHORT)
    view = base.observation_view()
    alignment = AlignmentReward(weight=3.0, offset=math.pi / 4)
    guidance = [FieldGradient(base.field), GradientHeading(), alignment] if guided else []
    return TransformedEnv(base, Compose(*guidance, *view.observation_transforms(), view.action_transform()))


def between(*ends: tuple[list[float], list[float]]) -> Scenario:
    """The paper's scenario with tasks from starts to targets."""
    return PAPER.with_tasks(Tasks(*torch.tensor(ends, dtype=torch.float64).unbind(1)))


def random_actions(num: int, seed: int, steps: int = STEPS) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, (steps, num, 2)).astype(np.float32)


def equal(array: np.ndarray, tensor: torch.Tensor) -> None:
    assert array.dtype == tensor.numpy().dtype
    np.testing.assert_array_equal(array, tensor.numpy())


# The same dynamics, to the bit


@pytest.mark.parametrize("reward", ["guided", "base"])
def test_batch_flies_as_in_torchrl(reward: str) -> None:
    envs, env = make_vec(reward=reward, **SHORT), torchrl_env(NUM, 11, guided=reward == "guided")
    state, ends, arrivals = env.reset(), 0, 0
    equal(envs.reset(seed=11)[0], state["observation"])
    for actions in random_actions(NUM, 0):
        step, state = env.step_and_maybe_reset(state.set("action", torch.from_numpy(actions)))
        observations, rewards, terminated, truncated, info = envs.step(actions)
        equal(observations, state["observation"])
        equal(rewards, step["next", "reward"].squeeze(-1))
        equal(terminated, step["next", "terminated"].squeeze(-1))
        equal(truncated, step["next", "truncated"].squeeze(-1))
        done = step["next", "done"].squeeze(-1).numpy()
        assert bool(info) == done.any()
        for index in done.nonzero()[0]:
            equal(info["final_obs"][index], step["next", "observation"][index])
        ends, arrivals = ends + done.sum(), arrivals + terminated.sum()
    assert ends > 3 * NUM, "every vehicle was to fly more than one episode"
    assert arrivals >= 3, "episodes were to end on arrival, apart from the others"


def test_one_vehicle_flies_as_in_torchrl() -> None:
    env, reference = make(**SHORT), torchrl_env(1, 11)
    state, (observation, info) = reference.reset(), env.reset(seed=11)
    for action in random_actions(1, 1):
        equal(observation, state["observation"][0])
        assert info == {}
        state = reference.step(state.set("action", torch.from_numpy(action)))
        observation, reward, terminated, truncated, info = env.step(action[0])
        after = state["next"][0]
        equal(observation, after["observation"])
        assert (reward, terminated, truncated) == tuple(after[k].item() for k in ("reward", "terminated", "truncated"))
        state = reference.step_mdp(state)
        if terminated or truncated:
            assert info["steps"] <= SHORT["max_steps"]
            state, (observation, info) = reference.reset(), env.reset()


def test_actions_in_kilometers_and_radians() -> None:
    env = make(scale_actions=False, observation="dict")
    assert env.action_space.contains(np.array([50, -math.pi / 2], dtype=np.float32))
    env.reset(seed=0)
    observation = env.step(np.array([12.5, 0.25], dtype=np.float32))[0]
    np.testing.assert_array_equal(observation["move"], np.array([12.5, 0.25], dtype=np.float32))
    assert observation["heading"] == np.float32(0.25)


def test_scaled_actions_span_the_physical_ones() -> None:
    for scaled, physical in (((-1, -1), (0, -math.pi / 2)), ((1, 1), (50, math.pi / 2)), ((0, 0), (25, 0))):
        env = make(observation="dict")
        env.reset(seed=0)
        move = env.step(np.array(scaled, dtype=np.float32))[0]["move"]
        np.testing.assert_array_equal(move, np.array(physical, dtype=np.float32))


def test_wraps_back_into_torchrl() -> None:
    env, reference = GymEnv(ENV_ID, **SHORT), torchrl_env(1, 0)
    reference.set_seed(5)
    wrapped, native = env.reset(seed=5), reference.reset()
    torch.testing.assert_close(wrapped["observation"], native["observation"][0], rtol=0, atol=0)
    for action in torch.from_numpy(random_actions(1, 2, steps=SHORT["max_steps"])):
        wrapped, native = env.step(wrapped.set("action", action[0])), reference.step(native.set("action", action))
        for key in ("observation", "reward", "done", "terminated", "truncated"):
            torch.testing.assert_close(wrapped["next", key], native["next", key][0], rtol=0, atol=0)
        if native["next", "done"].all():
            return
        wrapped, native = env.step_mdp(wrapped), reference.step_mdp(native)
    pytest.fail("the episode was to end within its limit")


# Seeds


def test_seeds_and_episodes() -> None:
    env = make()
    first, second = env.reset(seed=3)[0], env.reset()[0]
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(env.reset(seed=3)[0], first)
    np.testing.assert_array_equal(env.reset()[0], second)
    assert not np.array_equal(env.reset(seed=4)[0], first)


def test_first_row_of_a_batch_flies_the_episodes_of_the_single_vehicle() -> None:
    batch = make_vec(observation="dict").reset(seed=3)[0]
    single = make(observation="dict").reset(seed=3)[0]
    for key in PUBLIC_KEYS:
        np.testing.assert_array_equal(batch[key][0], single[key])
    assert len(np.unique(batch["target_field"], axis=0)) == NUM


def test_frozen_tasks_are_flown_in_turn() -> None:
    tasks = task_set(3, 0)
    env = make(scenario=PAPER.with_tasks(tasks), render_mode="rgb_array")
    for index in range(4):
        env.reset()
        position = env.unwrapped.torchrl_env.base_env.track(0)[0]
        torch.testing.assert_close(position, tasks.start[index % 3], rtol=0, atol=0)


# Spaces


def test_observations_stay_in_their_spaces() -> None:
    for observation in ("flat", "dict"):
        envs = make_vec(num_envs=64, observation=observation, start_heading="random", max_steps=50)
        assert envs.observation_space.contains(envs.reset(seed=0)[0])
        outward = np.tile(np.array([1, 0.1], dtype=np.float32), (64, 1))
        for actions in [*random_actions(64, 0, 20), *[outward] * 40]:
            observations, *_, info = envs.step(actions)
            assert envs.observation_space.contains(observations)
            for final in info.get("final_obs", ()):
                assert final is None or envs.single_observation_space.contains(final)


def test_bounds_of_the_flat_observation() -> None:
    space = make().observation_space
    assert space.shape == (13,)
    assert np.isfinite(space.low).all()
    assert np.isfinite(space.high).all()
    np.testing.assert_array_equal(space.low[[6, 7, 11, 12]], [-1] * 4)  # last move, then the heading's cosine and sine
    np.testing.assert_array_equal(space.high[[6, 7, 11, 12]], [1] * 4)
    np.testing.assert_array_equal(space.low[:3], space.low[3:6])  # the field here and at the destination


def test_dict_observation_is_the_public_keys() -> None:
    space = make(observation="dict").observation_space
    assert set(space.keys()) == set(PUBLIC_KEYS)
    assert not set(space.keys()) & set(PRIVILEGED_KEYS)
    example = between(([-2.0, 162.0], [-8.0, 164.0]))
    observation, _ = make(observation="dict", scenario=example).reset()
    np.testing.assert_allclose(observation["field"], [8.019, -16.150, 35467.99], atol=1.5)  # the paper's example


def test_writing_into_an_observation_does_not_move_the_vehicle() -> None:
    flown = []
    for spoil in (False, True):
        envs = make_vec(observation="dict")
        observations, _ = envs.reset(seed=0)
        if spoil:
            for value in observations.values():
                value[:] = 0.5
        flown.append(envs.step(np.zeros((NUM, 2), dtype=np.float32))[0])
    for key in flown[0]:
        np.testing.assert_array_equal(flown[0][key], flown[1][key])


# What is told at the end of an episode


def test_measures_are_those_of_metrics() -> None:
    env = GeomagneticNavEnv(num_envs=NUM, seed=3, **SHORT)
    envs, actions = make_vec(scale_actions=False, **SHORT), random_actions(NUM, 5)
    actions = np.stack((25 + 25 * actions[..., 0], math.pi / 2 * actions[..., 1]), -1)
    steps = iter(torch.from_numpy(actions.astype(np.float32)))

    def policy(tensordict: TensorDict) -> TensorDict:
        return tensordict.set("action", next(steps))

    rollout = env.rollout(SHORT["max_steps"], policy, break_when_any_done=False, break_when_all_done=True)
    expected = episode_measures(rollout)
    envs.reset(seed=3)
    none = np.zeros(NUM, dtype=bool)
    seen = none.copy()
    for action in actions.astype(np.float32)[: SHORT["max_steps"]]:
        *_, info = envs.step(action)
        for index in np.flatnonzero(info.get("_final_info", none) & ~seen):
            seen[index] = True
            for name in ("success", "steps", "shortest_km", "length_km", "navigation_error_km", "spl"):
                value = info["final_info"][name][index]
                assert value == pytest.approx(expected[name][index].item(), rel=1e-9), name
                assert info["final_info"][f"_{name}"][index]
    assert seen.all()
    assert expected["success"].any()


def test_measures_start_anew_with_each_episode() -> None:
    env = make(scale_actions=False, max_steps=2, scenario=between(([-5.0, 162.0], [-5.0, 165.0])))
    env.reset()
    env.step(np.array([40, 0], dtype=np.float32))  # an episode that is given up
    for _ in range(2):
        env.reset()
        env.step(np.array([30, math.pi / 2], dtype=np.float32))
        *_, truncated, info = env.step(np.array([20, 0], dtype=np.float32))
        assert truncated
        assert (info["steps"], info["success"], info["is_success"], info["spl"]) == (2, False, False, 0.0)
        assert info["length_km"] == 50.0
        assert info["shortest_km"] - info["navigation_error_km"] == pytest.approx(50, abs=0.1)  # straight towards it


def test_measures_start_anew_with_each_autoreset() -> None:
    envs, lengths = make_vec(2, scale_actions=False, max_steps=2), []
    envs.reset(seed=0)
    for distance in (10, 20, 30, 35):
        *_, info = envs.step(np.array([[distance, 0]] * 2, dtype=np.float32))
        lengths += info["final_info"]["length_km"].tolist() if info else []
    assert lengths == [30, 30, 65, 65]


def test_arrival_is_told() -> None:
    near = between(([-5.0, 162.0], [-4.0, 162.0]))  # 110.6 km due north
    env = make(scale_actions=False, scenario=near, reward="base")
    env.reset()
    for _ in range(3):
        _, reward, terminated, truncated, info = env.step(np.array([36.86, 0], dtype=np.float32))
    assert (terminated, truncated) == (True, False)
    assert reward > 200
    assert (info["success"], info["is_success"], info["steps"]) == (True, True, 3)
    assert info["spl"] == pytest.approx(1, abs=1e-3)
    assert info["length_km"] == pytest.approx(110.58, abs=1e-3)


def test_masks_tell_whose_episode_ended() -> None:
    scenario = between(([-5.0, 162.0], [-4.6, 162.0]), ([-5.0, 162.0], [-1.0, 162.0]))
    envs = make_vec(2, scenario=scenario, scale_actions=False)
    envs.reset()
    *_, terminated, truncated, info = envs.step(np.array([[44.2, 0], [44.2, 0]], dtype=np.float32))
    assert terminated.tolist() == [True, False]
    assert truncated.tolist() == [False, False]
    final = info["final_info"]
    for mask in (info["_final_obs"], info["_final_info"], final["_success"], final["_spl"]):
        assert mask.tolist() == [True, False]
    assert final["success"].tolist() == [True, False]
    assert info["final_obs"][0].shape == (13,)
    assert info["final_obs"][1] is None


def test_vector_wrappers_of_gymnasium() -> None:
    envs = gymnasium.wrappers.vector.RecordEpisodeStatistics(make_vec(**SHORT))
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    envs.reset(seed=0)
    returns, running = [], np.zeros(NUM)
    for actions in random_actions(NUM, 0, 8):
        _, rewards, terminated, truncated, info = envs.step(actions)
        running += rewards
        ended = terminated | truncated
        if ended.any():
            np.testing.assert_allclose(info["episode"]["r"][ended], running[ended], rtol=1e-6)
            returns += [*running[ended]]
            running[ended] = 0
    assert len(returns) >= NUM


# Pictures


def test_pictures() -> None:
    env = make(render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    assert (before.shape, before.dtype) == ((700, 700, 3), np.uint8)
    env.step(np.ones(2, dtype=np.float32))
    assert not np.array_equal(env.render(), before)


def test_pictures_of_a_batch_and_of_none() -> None:
    envs = make_vec(2, render_mode="rgb_array")
    envs.reset(seed=0)
    first, second = envs.render()
    assert first.shape == (700, 700, 3)
    assert not np.array_equal(first, second)
    with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
        assert GeomagneticNavGymEnv(scenario=PAPER).render() is None
    with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
        assert make_vec(2).render() is None


# Bad input


def test_bad_options() -> None:
    for options, error, message in (
        ({"observation": "pixels"}, ValueError, "observation must be one of 'flat', 'dict', got 'pixels'"),
        ({"reward": "sparse"}, ValueError, "reward must be one of 'guided', 'base', got 'sparse'"),
        ({"render_mode": "ansi"}, ValueError, "render_mode must be one of 'rgb_array', got 'ansi'"),
        ({"zeta": -1.0}, ValueError, "zeta must be .*, got -1.0"),
        ({"alignment_weight": math.nan}, ValueError, "weight .*finite.*, got nan"),
        ({"zetta": 1.0}, TypeError, "unexpected keyword argument 'zetta'.*'zeta'"),
        ({"num_envs": 3}, TypeError, "num_envs, got 3: use gymnasium.make_vec"),
        ({"regions": 3}, TypeError, "unexpected keyword argument 'regions'.*'scenario'"),
        ({"scenario": 3}, TypeError, "scenario must be a Scenario, got 3"),
        ({"scale_actions": 1}, TypeError, "scale_actions must be a bool, got 1"),
    ):
        with pytest.raises(error, match=message):
            GeomagneticNavGymEnv(**{"scenario": PAPER} | options)


def test_bad_calls() -> None:
    env, envs = GeomagneticNavGymEnv(scenario=PAPER, max_steps=1), make_vec(2)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2))
    with pytest.raises(ValueError, match=r"takes no options, got \{'task': 3\}"):
        env.reset(options={"task": 3})
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"must have shape \(1, 2\).*got shape \(1, 3\)"):
        env.step(np.zeros(3))
    with pytest.raises(ValueError, match=r"out of bounds"):
        env.step(np.array([1.5, 0.0]))
    env.step(np.zeros(2))
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2))
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=r"must have shape \(2, 2\).*got shape \(2,\)"):
        envs.step(np.zeros(2))


# What is built on the conventions


def test_importing_magrl_registers_the_id_and_nothing_heavy() -> None:
    code = f"""
import sys, warnings
import gymnasium
warnings.simplefilter("error")
import magrl
heavy = [name for name in ("torch", "torchrl", "matplotlib", "pandas", "wandb") if name in sys.modules]
before = gymnasium.spec({ENV_ID!r})
del sys.modules["magrl"]
import magrl  # a second import keeps the registration
assert gymnasium.spec({ENV_ID!r}) is before
print(heavy, before.entry_point, before.vector_entry_point)
"""
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    home = "magrl.envs.gymnasium"
    assert done.stdout.split() == ["[]", f"{home}:GeomagneticNavGymEnv", f"{home}:GeomagneticNavVectorEnv"]


def test_the_id_makes_both_environments() -> None:
    assert type(make().unwrapped) is GeomagneticNavGymEnv
    assert type(make_vec(1)) is GeomagneticNavVectorEnv


@pytest.mark.parametrize("observation", ["flat", "dict"])
def test_gymnasium_checker_finds_nothing(observation: str) -> None:
    env = make(observation=observation, disable_env_checker=True, render_mode="rgb_array").unwrapped
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env)


def test_copies_of_the_single_vehicle_in_gymnasiums_own_vector() -> None:
    envs = gymnasium.make_vec(ENV_ID, num_envs=2, vectorization_mode="sync", **SHORT)
    observations, _ = envs.reset(seed=[3, 4])
    single = make(**SHORT)
    np.testing.assert_array_equal(observations, [single.reset(seed=seed)[0] for seed in (3, 4)])
    for actions in random_actions(2, 0, 10):
        *_, info = envs.step(actions)
        assert ("success" in info) == bool(info)


def test_navigation_env_is_what_the_faces_drive() -> None:
    env = navigation_env(3, reward="base", seed=1, **SHORT)
    base, guided = torchrl_env(3, 1, guided=False), make_vec(3, **SHORT).unwrapped.torchrl_env
    torch.testing.assert_close(env.reset()["observation"], base.reset()["observation"], rtol=0, atol=0)
    assert "gradient_heading" in guided.observation_spec
    assert "gradient_heading" not in env.observation_spec


# stable-baselines3


def load(path: str) -> ModuleType:
    pytest.importorskip("stable_baselines3")
    spec = importlib.util.spec_from_file_location(Path(path).stem, ROOT / path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_stable_baselines3_checker_finds_nothing() -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for observation in ("flat", "dict"):
            checker.check_env(make(observation=observation, render_mode="rgb_array").unwrapped)


@pytest.mark.parametrize("algorithm", ["td3", "sac"])
def test_stable_baselines3_example(algorithm: str) -> None:
    example = load("docs/examples/sb3.py")
    result = example.main(
        example.Config(algorithm, num_envs=8, total_timesteps=400, learning_starts=300, eval_tasks=10)
    )
    assert result.keys() == {"success", "spl", "steps"}
    assert 1 <= result["steps"] <= 50


def test_batched_environment_under_stable_baselines3() -> None:
    adapter = load("benchmarks/sb3_vec_env.py")
    vec_env, envs = adapter.BatchedVecEnv(make_vec(**SHORT)), make_vec(**SHORT)
    vec_env.seed(9)
    np.testing.assert_array_equal(vec_env.reset(), envs.reset(seed=9)[0])
    ended = 0
    for actions in random_actions(NUM, 6):
        observations, rewards, dones, infos = vec_env.step(actions)
        expected, expected_rewards, terminated, truncated, info = envs.step(actions)
        np.testing.assert_array_equal(observations, expected)
        np.testing.assert_array_equal(rewards, expected_rewards)
        np.testing.assert_array_equal(dones, terminated | truncated)
        for index in range(NUM):
            assert infos[index]["TimeLimit.truncated"] == truncated[index]
            assert ("terminal_observation" in infos[index]) == dones[index]
            if dones[index]:
                np.testing.assert_array_equal(infos[index]["terminal_observation"], info["final_obs"][index])
                assert infos[index]["is_success"] == info["final_info"]["success"][index]
                ended += 1
    assert ended > 2 * NUM


def test_single_vehicle_trains_under_stable_baselines3() -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    settings = {
        "policy_kwargs": {"net_arch": [16]},
        "learning_starts": 50,
        "batch_size": 32,
        "device": "cpu",
        "seed": 0,
    }
    model = sb3.TD3("MlpPolicy", make(**SHORT), **settings).learn(200)
    assert model.num_timesteps == 200
    assert len(model.ep_info_buffer) >= 200 // SHORT["max_steps"]
    assert len(model.ep_success_buffer) == len(model.ep_info_buffer)


def test_episodes_of_the_batch_are_counted_by_stable_baselines3() -> None:
    adapter, sb3 = load("benchmarks/sb3_vec_env.py"), pytest.importorskip("stable_baselines3")
    vec_env = sb3.common.vec_env.VecMonitor(adapter.BatchedVecEnv(make_vec(**SHORT)))
    settings = {"policy_kwargs": {"net_arch": [16]}, "learning_starts": 50, "train_freq": 1, "device": "cpu", "seed": 0}
    model = sb3.TD3("MlpPolicy", vec_env, batch_size=32, **settings).learn(200)
    assert model.num_timesteps == 200
    assert len(model.ep_info_buffer) >= 200 // SHORT["max_steps"] - NUM
    assert len(model.ep_success_buffer) == len(model.ep_info_buffer)


def test_adapter_refuses_another_autoreset() -> None:
    adapter = load("benchmarks/sb3_vec_env.py")
    envs = gymnasium.make_vec(ENV_ID, num_envs=1, vectorization_mode="sync", **SHORT)
    with pytest.raises(ValueError, match="NEXT_STEP"):
        adapter.BatchedVecEnv(envs)


# Own transforms, declared arrival, errors in the units of the caller


def test_own_transforms_stand_behind_the_environment_and_their_keys_can_be_observed() -> None:
    parts = [SensorNoise((0.05, 0.05, 5.0), seed=3), TrackGradient()]
    envs = [gymnasium.make(ENV_ID, transforms=parts, observation=("field", "way")) for _ in range(2)]  # cloned
    first, second = (env.reset(seed=0)[0] for env in envs)
    assert set(first) == set(envs[0].observation_space.spaces) == {"field", "way"}
    assert envs[0].observation_space.contains(first)
    np.testing.assert_array_equal(first["field"], second["field"])
    clean, _ = gymnasium.make(ENV_ID, observation="dict").reset(seed=0)
    assert 0 < abs(first["field"] - clean["field"])[2] < 30
    noisy = gymnasium.make(ENV_ID, transforms=parts)
    assert not np.array_equal(noisy.reset(seed=0)[0], gymnasium.make(ENV_ID).reset(seed=0)[0])
    for options, error, message in (
        ({"transforms": [5]}, TypeError, r"transforms\[0\] must be a Transform, got 5"),
        ({"observation": ("field", "wings")}, ValueError, "observation names 'wings', which is not among the keys"),
        (
            {"wings": 2},
            TypeError,
            "'wings'; the options are .*'observation', .*'scale_actions', .*'transforms', 'zeta'",
        ),
    ):
        with pytest.raises(error, match=message):
            gymnasium.make(ENV_ID, **options)


@pytest.mark.parametrize("scaled", [True, False])
def test_an_arrival_is_declared_with_the_third_number(scaled: bool) -> None:
    env = gymnasium.make(ENV_ID, arrival="declared", scale_actions=scaled)
    env.reset(seed=0)
    high = [1.0, 1.0, 1.0] if scaled else [50.0, math.pi / 2, 1.0]
    np.testing.assert_allclose(env.action_space.high, high, rtol=1e-6)
    stay = -1.0 if scaled else 0.0
    assert not env.step(np.array([stay, 0.0, -0.5], dtype=np.float32))[2]
    *_, terminated, _, info = env.step(np.array([stay, 0.0, 0.5], dtype=np.float32))
    assert terminated
    assert (info["success"], info["false_arrival"]) == (False, True)


def test_errors_of_actions_are_in_the_units_of_the_caller() -> None:
    for options, action, message in (
        ({}, (1.5, 0.0), r"action \[1.5, 0.0\] of vehicle 0 is not finite or out of bounds, \[-1, 1\], \[-1, 1\]$"),
        ({}, (0.0, float("nan")), r"out of bounds, \[-1, 1\], \[-1, 1\]$"),
        ({"scale_actions": False}, (51.0, 0.0), r"out of bounds, \[0, 50\], \[-1.5708, 1.5708\]$"),
    ):
        env = gymnasium.make(ENV_ID, disable_env_checker=True, **options)
        env.reset(seed=0)
        with pytest.raises(ValueError, match=message):
            env.step(np.array(action, dtype=np.float32))


def test_a_seed_determines_the_errors_of_the_sensors() -> None:
    env = gymnasium.make(ENV_ID, transforms=[SensorNoise((0.05, 0.05, 5.0), seed=0)], observation="dict")
    first, later, again = (env.reset(seed=seed)[0]["field"] for seed in (0, None, 0))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, later)


def test_an_observation_of_own_transforms() -> None:
    """Of a name that "flat" uses too, and beside what "flat" joins."""
    view = TrackView(zeta=0.01, max_steps=50, max_move_km=50.0, max_turn_rad=math.pi / 2)
    parts = [SensorNoise((0.05, 0.05, 5.0), seed=0), *view.observation_transforms()]
    env = gymnasium.make(ENV_ID, transforms=parts, observation=["observation"])
    seen, _ = env.reset(seed=0)
    assert {key: value.shape for key, value in seen.items()} == {"observation": (view.size,)}
    assert env.observation_space.contains(seen)
    joined = CatTensors(["field", "move"], "both", del_keys=False)
    assert gymnasium.make(ENV_ID, transforms=[joined]).reset(seed=0)[0].shape == (13,)


def test_guidance_is_by_the_truth_and_a_compose_is_the_list_of_its_parts() -> None:
    """Whatever the errors of the readings are."""
    errors = [SensorNoise((0.2, 0.2, 20.0), seed=0), NorthReferenceError(2.0, fixed=True, seed=0)]
    clean, listed, composed = (
        navigation_env(20, transforms=transforms, seed=0, scale_actions=False)
        for transforms in ((), errors, [Compose(*errors)])
    )
    action = torch.tensor([[30.0, 0.0]]).expand(20, 2)
    true, erring, same = (env.step(env.reset().set("action", action))["next"] for env in (clean, listed, composed))
    assert (true["field"] != erring["field"]).all()
    assert (true["heading"] != erring["heading"]).all()
    for key in ("field", "heading", "reward"):
        torch.testing.assert_close(erring[key], same[key], rtol=0, atol=0)
    for key in ("gradient_heading", "reward"):
        torch.testing.assert_close(true[key], erring[key], rtol=0, atol=0)
