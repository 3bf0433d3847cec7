"""Navigators that need no training."""

import copy
import math

import pytest
import torch
from tensordict import TensorDict

from magrl.envs import PRIVILEGED_KEYS, GeomagneticNavEnv, Scenario, task_set
from magrl.evaluation import episode_measures, evaluation_rollout, summarize
from magrl.navigators import NAVIGATORS, ParallelApproach, Secant
from magrl.navigators.base import displacement_to, steer
from magrl.navigators.secant import broyden_update, project


@pytest.fixture(scope="module")
def env() -> GeomagneticNavEnv:
    return GeomagneticNavEnv(Scenario(tasks=task_set(200, seed=71)), num_envs=200, seed=0)


def flight(env: GeomagneticNavEnv, navigator) -> TensorDict:
    env.set_seed(0)  # back to each vehicle's first task
    return evaluation_rollout(env, navigator)


def scrambled(state: TensorDict) -> TensorDict:
    state = state.clone()
    for key in PRIVILEGED_KEYS:
        value = state[key]
        state[key] = ~value if value.dtype == torch.bool else torch.full_like(value, math.nan)
    return state


def test_steer_by_hand() -> None:
    distance, turn = steer(
        torch.tensor([3.0, 0.0, 0.0, 0.0]),
        torch.tensor([-3.0, 1.0, 3.0, 0.5]),
        torch.tensor([20.0, 80.0, 80.0, -1.0]),
        50.0,
        math.pi / 2,
    )
    torch.testing.assert_close(turn, torch.tensor([2 * math.pi - 6, 1.0, math.pi / 2, 0.5]))
    torch.testing.assert_close(distance, torch.tensor([20.0, 50.0, 0.0, 0.0]))


def test_displacement_solves_consistent_equations() -> None:
    draw = torch.Generator().manual_seed(0)
    for elements in (2, 3):
        for shape in ((), (4,), (2, 3)):
            jacobian = torch.randn(*shape, elements, 2, dtype=torch.float64, generator=draw)
            way = torch.randn(*shape, 2, dtype=torch.float64, generator=draw)
            error = (jacobian @ way.unsqueeze(-1)).squeeze(-1)
            torch.testing.assert_close(displacement_to(error, jacobian), way, atol=1e-5, rtol=1e-5)


def test_displacement_is_finite_without_a_gradient() -> None:
    for dtype in (torch.float32, torch.float64):
        assert torch.isfinite(displacement_to(torch.ones(2, dtype=dtype), torch.zeros(2, 2, dtype=dtype))).all()
        parallel = torch.tensor([[1.0, 1.0], [1.0, 1.0]], dtype=dtype)
        assert torch.isfinite(displacement_to(torch.tensor([1.0, 2.0], dtype=dtype), parallel)).all()


def test_broyden_update_satisfies_the_secant_equation() -> None:
    draw = torch.Generator().manual_seed(0)
    for shape in ((), (4,), (2, 3)):
        jacobian, leg, change = (
            torch.randn(*shape, *last, dtype=torch.float64, generator=draw) for last in ((3, 2), (2,), (3,))
        )
        new = broyden_update(jacobian, leg, change)
        torch.testing.assert_close((new @ leg.unsqueeze(-1)).squeeze(-1), change)
        across = torch.stack((-leg[..., 1], leg[..., 0]), -1).unsqueeze(-1)
        torch.testing.assert_close(new @ across, jacobian @ across)


def test_two_legs_that_are_no_right_angle_give_the_jacobian() -> None:
    truth = torch.tensor([[0.3, -0.2], [0.1, 0.7]], dtype=torch.float64)
    first, second = torch.tensor([[10.0, 0.0], [9.0, 3.0]], dtype=torch.float64)
    jacobian = broyden_update(torch.zeros(2, 2, dtype=torch.float64), first, truth @ first)
    jacobian = broyden_update(jacobian, second, truth @ second, second - project(second, first))
    torch.testing.assert_close(jacobian, truth)


def test_broyden_update_ignores_no_move() -> None:
    jacobian = torch.randn(2, 2)
    assert torch.equal(broyden_update(jacobian, torch.zeros(2), torch.ones(2)), jacobian)


def test_parallel_flies_the_shortest_path(env) -> None:
    navigator = ParallelApproach(env.field)
    rollout = flight(env, navigator)
    summary = summarize(episode_measures(rollout))
    assert summary["success_rate"] == 100
    assert summary["spl"] > 99.5
    assert summary["steps"] < 9
    assert navigator.oracle
    assert navigator.field_readings.tolist() == [0] * 200


def test_parallel_on_other_pairs(env) -> None:
    for pair in (("I", "B_H"), ("I", "D")):
        summary = summarize(episode_measures(flight(env, ParallelApproach(env.field, pair=pair))))
        assert summary["spl"] > 80, pair


def test_secant_navigates_by_its_track(env) -> None:
    navigator = Secant()
    summary = summarize(episode_measures(flight(env, navigator)))
    assert summary["success_rate"] >= 99
    assert summary["spl"] >= 94
    assert summary["steps"] < 11.5
    assert not navigator.oracle
    assert navigator.field_readings.tolist() == [0] * 200


def test_secant_on_all_three_elements_and_narrow_turns() -> None:
    env = GeomagneticNavEnv(Scenario(tasks=task_set(50, seed=72)), num_envs=50, seed=0, max_turn_rad=1.0)
    summary = summarize(episode_measures(flight(env, Secant(50.0, 1.0, elements=("D", "I", "B_H")))))
    assert summary["success_rate"] >= 95


def test_secant_reads_nothing_privileged(env) -> None:
    navigator = Secant()
    assert not set(navigator.in_keys) & set(PRIVILEGED_KEYS)
    env.set_seed(0)
    state, blind = env.reset(), Secant()
    for _ in range(6):
        action = navigator(state.clone())["action"]
        assert torch.equal(blind(scrambled(state))["action"], action)
        state = env.step(state.set("action", action))["next"]
    for key in navigator.in_keys:
        with pytest.raises(KeyError):
            Secant()(state.exclude(key))


@pytest.mark.parametrize("name", sorted(NAVIGATORS))
def test_actions_stay_in_bounds_that_are_not_the_default(name: str) -> None:
    env = GeomagneticNavEnv(num_envs=20, seed=4, max_move_km=8.0, max_turn_rad=0.7, start_heading="random")
    action = env.rollout(40, NAVIGATORS[name](env, "", 0), break_when_any_done=False)["action"]
    assert ((action[..., 0] >= 0) & (action[..., 0] <= 8.0)).all()
    assert (action[..., 1].abs() <= 0.7 + 1e-6).all()
    assert (action[..., 0] == 8.0).any()


@pytest.mark.parametrize("name", sorted(NAVIGATORS))
def test_vehicles_do_not_know_of_each_other(env, name: str) -> None:
    together = flight(env, NAVIGATORS[name](env, "", 0))
    few = GeomagneticNavEnv(env.scenario, num_envs=3, seed=0)
    alone = flight(few, NAVIGATORS[name](few, "", 0))
    steps = min(together.shape[1], alone.shape[1], 6)
    torch.testing.assert_close(alone["action"][:, :steps], together["action"][:3, :steps])


def test_a_new_episode_begins_a_new_memory_for_its_vehicle_alone(env) -> None:
    navigator = Secant()
    env.set_seed(0)
    state = env.reset()
    for _ in range(4):
        state = env.step(navigator(state))["next"]
    began = torch.arange(200) % 3 == 0
    first = env.reset()
    mixed = torch.where(began, first.select(*navigator.in_keys), state.select(*navigator.in_keys))
    going = copy.deepcopy(navigator)(state.clone())["action"]
    action = navigator(mixed)["action"]
    torch.testing.assert_close(action[began], torch.tensor([10.0, 0.0]).expand(int(began.sum()), 2))
    assert torch.equal(action[~began], going[~began])
    assert (navigator.memory["jacobian"][began] == 0).all()


def test_asking_twice_changes_nothing(env) -> None:
    navigator = Secant()
    env.set_seed(0)
    state = env.reset()
    for _ in range(4):
        state = env.step(navigator(state))["next"]
        again = navigator(state.clone())["action"]
        assert torch.equal(navigator(state.clone())["action"], again)


def test_secant_stands_a_field_without_change() -> None:
    state = GeomagneticNavEnv(num_envs=2, seed=0).reset()
    navigator = Secant()
    for step in range(5):
        state["step_count"] = torch.full((2, 1), step)
        state["move"] = torch.tensor([[10.0, 0.0]]).expand(2, 2) * (step > 0)
        assert torch.isfinite(navigator(state)["action"]).all()


def test_bad_options_are_refused_with_their_value() -> None:
    for options, message in (
        ({"max_move_km": -3.0}, "-3.0"),
        ({"max_turn_rad": 4.5}, "4.5"),
        ({"probe_km": 60.0}, "60.0"),
        ({"probe_km": 0.0}, r"0\.0"),
        ({"elements": ("D",)}, "'D'"),
        ({"elements": ("D", "D")}, "'D', 'D'"),
        ({"elements": ("D", "X")}, "'X'"),
    ):
        with pytest.raises(ValueError, match=message):
            Secant(**options)


def test_a_pair_is_two(env) -> None:
    with pytest.raises(ValueError, match="B_H"):
        ParallelApproach(env.field, pair=("D", "I", "B_H"))
