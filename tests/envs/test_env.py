"""The environment: specs, one move by hand, rewards, ends of episodes, seeds, independent vehicles, options, tracks."""

from __future__ import annotations

import copy
import gc
import math
import pickle
import re
import weakref
from collections.abc import Callable
from datetime import datetime
from itertools import pairwise
from typing import Any

import pytest
import torch
from ppigrf import igrf
from ppigrf.ppigrf import shc_fn_igrf13
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from magrl.envs import PAPER_REGION, PRIVILEGED_KEYS, PUBLIC_KEYS, GeomagneticNavEnv, Region, Scenario, Tasks
from magrl.envs.specs import REWARD_TERMS
from magrl.field import IGRF, RegionalField
from magrl.geodesy import geodesic, move
from magrl.transforms import AlignmentReward, FieldGradient, GradientHeading

ANTIMERIDIAN = Region((-5.0, 5.0), (175.0, 185.0))
HIGH_LATITUDE = Region((60.0, 70.0), (10.0, 30.0))


@pytest.fixture(autouse=True)
def _seeded() -> None:
    torch.manual_seed(0)


def make(num_envs: int = 1, **options: Any) -> GeomagneticNavEnv:
    """An environment of seed 0, from the options of the environment and of its scenario."""
    scenario = {name: options.pop(name) for name in options.keys() & Scenario.model_fields.keys()}
    return GeomagneticNavEnv(Scenario(**scenario), num_envs=num_envs, **{"seed": 0} | options)


def places(*positions: tuple[float, ...]) -> Tensor:
    return torch.tensor(positions, dtype=torch.float64)


def task(start: tuple[float, float], target: tuple[float, float]) -> Tasks:
    return Tasks(places(start), places(target))


def moved(place: tuple[float, float], heading: float, distance_km: float) -> tuple[float, float]:
    """Where a leg from a place leads [deg]."""
    inputs = (torch.tensor(float(x), dtype=torch.float64) for x in (*place, heading, distance_km))
    latitude, longitude = move(*inputs)
    return float(latitude), float(longitude)


def fly(env: GeomagneticNavEnv, *actions: tuple[float, float] | Tensor) -> list[TensorDictBase]:
    """The transitions of some moves, each the same for all vehicles or one row a vehicle; nobody is reset."""
    td, steps = env.reset(), []
    for action in actions:
        steps.append(env.step(td.set("action", torch.as_tensor(action).expand(env.num_envs, 2).clone())))
        td = env.step_mdp(steps[-1])
    return steps


def random_actions(steps: int, num_envs: int, seed: int = 0) -> Tensor:
    draws = torch.rand(steps, num_envs, 2, generator=torch.Generator().manual_seed(seed))
    return torch.stack((50 * draws[..., 0], (draws[..., 1] - 0.5) * math.pi), -1)


def fly_on(env: GeomagneticNavEnv, actions: Tensor) -> TensorDictBase:
    """Transitions ``(T, N)`` over several episodes: who is done starts anew."""
    td, steps = env.reset(), []
    for action in actions:
        step, td = env.step_and_maybe_reset(td.set("action", action.clone()))
        steps.append(step)
    return torch.stack(steps)


def assert_same(a: TensorDictBase, b: TensorDictBase, but: tuple[str, ...] = ()) -> None:
    """Equal to the last bit, entry by entry."""
    assert set(a.keys(True, True)) == set(b.keys(True, True))
    for key in a.keys(True, True):
        assert key in but or torch.equal(a[key], b[key]), key


# ---------------------------------------------------------------------------------------------------------------------
# Specs


def test_specs_match_the_data() -> None:
    for num_envs in (1, 3, 64):
        check_env_specs(make(num_envs), break_when_any_done="both")


@pytest.mark.parametrize(
    "options",
    [
        {"start_heading": "random"},
        {"max_steps": 1},
        {"max_steps": 2, "margin_deg": 0.0},
        {"max_turn_rad": math.pi, "max_move_km": 300.0},
        {"region": ANTIMERIDIAN, "generation": 14},
        {"region": HIGH_LATITUDE},
        {"region": Region((-80.0, -70.0), (-10.0, 40.0)), "field": IGRF(2027.0)},
    ],
    ids=["random heading", "one step", "no margin", "long legs", "antimeridian", "high latitude", "IGRF itself"],
)
def test_specs_match_the_data_with(options: dict[str, Any]) -> None:
    check_env_specs(make(3, **options), break_when_any_done="both")


ENTRIES = {
    "field": (3, torch.float32),
    "target_field": (3, torch.float32),
    "move": (2, torch.float32),
    "heading": (1, torch.float32),
    "step_count": (1, torch.int64),
    "position": (2, torch.float64),
    "target_position": (2, torch.float64),
    "start_position": (2, torch.float64),
    "objective": (1, torch.float32),
    "objective_weights": (3, torch.float32),
    "success": (1, torch.bool),
}
FLAGS = dict.fromkeys(("done", "terminated", "truncated"), (1, torch.bool))
REWARDS = dict.fromkeys(("reward", "reward_destination", "reward_proximity"), (1, torch.float32))


def test_keys_shapes_and_dtypes() -> None:
    for num_envs in (1, 5):
        env = make(num_envs)
        first = env.reset()
        step = env.rand_step(first.clone())["next"]
        for td, entries in ((first, ENTRIES | FLAGS), (step, ENTRIES | FLAGS | REWARDS)):
            assert {key: (value.shape, value.dtype) for key, value in td.items()} == {
                key: ((num_envs, size), dtype) for key, (size, dtype) in entries.items()
            }
        assert set(env.observation_spec.keys()) == set(ENTRIES)
        assert env.batch_size == (num_envs,)
        assert env.batch_locked


def test_privileged_keys_are_in_the_spec_and_what_is_measured_is_not_privileged() -> None:
    spec = make().observation_spec
    assert set(PRIVILEGED_KEYS) <= set(spec.keys())
    assert {"field", "target_field", "move", "heading", "step_count"} == set(spec.keys()) - set(PRIVILEGED_KEYS)
    assert {*PUBLIC_KEYS, "step_count"} == set(spec.keys()) - set(PRIVILEGED_KEYS)


def test_action_bounds() -> None:
    env = make(2, max_move_km=30.0, max_turn_rad=1.0)
    assert env.action_spec.space.low.tolist() == [[0.0, -1.0]] * 2
    assert env.action_spec.space.high.tolist() == [[30.0, 1.0]] * 2
    assert make().action_spec.space.high[0].tolist() == pytest.approx([50.0, math.pi / 2])


@pytest.mark.parametrize(
    "options", [{"margin_deg": 0.0}, {"region": HIGH_LATITUDE}, {"max_turn_rad": math.pi, "start_heading": "random"}]
)
def test_every_observation_stays_in_its_spec(options: dict[str, Any]) -> None:
    """From one reset to the next, the lost and the arrived included."""
    env = make(32, max_steps=12, **options)
    td = env.rollout(40, break_when_any_done=False)
    assert td["next", "done"].any()
    for k in range(40):
        for seen in (td[:, k], td[:, k]["next"]):
            assert env.observation_spec.is_in(seen.select(*ENTRIES))


# ---------------------------------------------------------------------------------------------------------------------
# One move by hand, between the paper's example points

START, TARGET = (-2.0, 162.0), (-8.0, 164.0)


def elements_by_ppigrf(latitude: float, longitude: float) -> Tensor:
    """D, I [deg], B_H [nT] of IGRF-13 at the start of 2022, by another program."""
    date = datetime(2022, 1, 1)
    east, north, up = (float(x.squeeze()) for x in igrf(longitude, latitude, 0.0, date, coeff_fn=shc_fn_igrf13))
    horizontal = math.hypot(east, north)
    angles = (math.degrees(math.atan2(east, north)), math.degrees(math.atan2(-up, horizontal)))
    return torch.tensor((*angles, horizontal), dtype=torch.float64)


def test_first_observation_is_that_of_the_paper() -> None:
    td = make(tasks=task(START, TARGET)).reset()[0]
    for key, values in (("field", (8.019, -16.150, 35467.990)), ("target_field", (9.228, -26.923, 35199.415))):
        assert ((td[key] - torch.tensor(values)).abs() < torch.tensor([0.002, 0.002, 1.5])).all(), key
    assert td["position"].tolist() == td["start_position"].tolist() == list(START)
    assert td["target_position"].tolist() == list(TARGET)
    assert td["objective"].item() == pytest.approx(3.0, rel=1e-6)  # each element is the whole of its way off
    weights = 1 / (elements_by_ppigrf(*TARGET) - elements_by_ppigrf(*START)).square()
    assert td["objective_weights"].tolist() == pytest.approx(weights.tolist(), rel=1e-5)
    assert td["heading"].item() == td["step_count"].item() == 0
    assert td["move"].tolist() == [0.0, 0.0]
    assert not td["success"]
    assert not td["done"]


def test_the_field_of_a_scenario_stays_on_its_device() -> None:
    scenario = Scenario(field=RegionalField(IGRF("2022-01-01", 13), (-16.0, 6.0), (154.0, 176.0)))
    env = GeomagneticNavEnv(scenario, seed=0)
    with pytest.raises((RuntimeError, NotImplementedError)):  # a device without values
        GeomagneticNavEnv(scenario, seed=0, device="meta")
    assert env.field.coefficients.device.type == scenario.field.coefficients.device.type == "cpu"


@pytest.mark.parametrize(
    ("turn", "end"),
    [  # 50 km on the ellipsoid, by GeographicLib 2.1
        (0.0, (-1.5478196360657286, 162.0)),
        (math.pi / 2, (-1.9999381077114553, 162.44942958007033)),
        (-3 * math.pi / 4, (-2.3197057250399222, 161.68214048662887)),
    ],
    ids=["north", "east", "south-west"],
)
def test_one_move_by_hand(turn: float, end: tuple[float, float]) -> None:
    (step,) = fly(make(tasks=task(START, TARGET), max_turn_rad=math.pi), (50.0, turn))
    after = step["next"][0]
    assert after["position"].tolist() == pytest.approx(end, abs=1e-7)  # a centimeter
    assert after["heading"].item() == pytest.approx(turn, abs=1e-6)
    assert after["move"].tolist() == pytest.approx([50.0, turn], abs=1e-6)
    assert after["step_count"].item() == 1

    origin, here, there = (elements_by_ppigrf(*place) for place in (START, end, TARGET))
    assert after["field"].tolist() == pytest.approx(here.tolist(), rel=1e-6, abs=1e-5)
    objective = float((((there - here) / (there - origin)) ** 2).sum())  # Eq. 2-6
    assert after["objective"].item() == pytest.approx(objective, rel=1e-5)
    assert after["reward"].item() == pytest.approx(10 * (3 - objective), rel=1e-3)  # Eq. 3-5
    assert not after["done"]


def test_turns_add_up_and_wrap() -> None:
    env = make(tasks=task(START, TARGET))
    headings = [step["next", "heading"].item() for step in fly(env, *[(1.0, 1.5)] * 5)]
    assert headings == pytest.approx([1.5, 3.0, 4.5 - 2 * math.pi, 6 - 2 * math.pi, 7.5 - 2 * math.pi], abs=1e-5)


def test_what_holds_for_the_episode_is_handed_on() -> None:
    env = make(3)
    steps = fly(env, *random_actions(4, 3))
    for key in ("target_field", "target_position", "start_position", "objective_weights"):
        assert all(torch.equal(step["next", key], steps[0][key]) for step in steps), key
    assert torch.equal(steps[0]["start_position"], steps[0]["position"])


def test_no_distance_is_no_move() -> None:
    step = fly(make(tasks=task(START, TARGET)), (0.0, 1.0))[0]["next"]
    assert step["position"][0].tolist() == pytest.approx(START, abs=1e-12)
    assert step["reward"].item() == pytest.approx(0.0, abs=1e-3)
    assert step["heading"].item() == 1.0


def test_floors_of_the_objective() -> None:
    """Two places 11 km apart: every difference is under its floor, so that F is small from the start."""
    env = make(tasks=task((-5.0, 165.0), (-5.1, 165.0)), objective_floors=(0.2, 0.5, 100.0))
    td = env.reset()[0]
    assert td["objective_weights"].tolist() == pytest.approx([25.0, 4.0, 1e-4])
    error = (td["target_field"] - td["field"]).double()
    assert td["objective"].item() == pytest.approx(float((error**2 * torch.tensor([25.0, 4.0, 1e-4])).sum()), rel=1e-3)


def test_late_rewards_decay() -> None:
    """Past half of 6 moves, n/6 of the size of the proximity term is taken off: gains shrink and losses grow."""
    turn_back, go_on, stay = (50.0, math.pi), (50.0, 0.0), (0.0, 0.0)
    for weight in (10.0, 2.5, 0.0):
        env = make(tasks=task(START, TARGET), max_steps=6, max_turn_rad=math.pi, proximity_weight=weight)
        steps = fly(env, turn_back, stay, go_on, turn_back, turn_back, go_on)  # south, south, north, south, south
        objective = [3.0, *(step["next", "objective"].item() for step in steps)]
        assert objective[3] < objective[4] > objective[5] > objective[6]
        plain = [weight * (before - after) for before, after in pairwise(objective)]
        taken = [0.0, 0.0, 0.0, 4 / 6, 5 / 6, 1.0]
        expected = [r - share * abs(r) for r, share in zip(plain, taken, strict=True)]
        for key in ("reward", "reward_proximity"):
            assert [step["next", key].item() for step in steps] == pytest.approx(expected, abs=1e-3)
        assert all(step["next", "reward_destination"] == 0 for step in steps)


# ---------------------------------------------------------------------------------------------------------------------
# How episodes end

LIVELY = {
    "max_steps": 7,
    "margin_deg": 0.0,
    "zeta": 0.5,
    "distance_range_km": (30.0, 120.0),
    "start_heading": "random",
    "seed": 5,
}
"""Short episodes that end in every way, so that vehicles are reset at different times."""


class TestArrival:
    here = (-5.0, 165.0)

    def test_one_known_move_arrives(self) -> None:
        for turn in (0.0, 1.0, -1.5):
            (step,) = fly(make(tasks=task(self.here, moved(self.here, turn, 40.0))), (40.0, turn))
            after = step["next"]
            assert step["objective"].item() > 0.5
            assert after["objective"].item() < 1e-6
            flags = [bool(after[key]) for key in ("success", "terminated", "done", "truncated")]
            assert flags == [True, True, True, False]
            proximity = 10 * (step["objective"] - after["objective"]).item()
            assert after["reward"].item() == pytest.approx(200 + proximity)
            assert after["reward_destination"].item() == 200
            assert after["reward_proximity"].item() == pytest.approx(proximity)

    def test_the_threshold_is_zeta(self) -> None:
        """A move that falls short of it by a little arrives only if zeta is that wide."""
        tasks = task(self.here, moved(self.here, 0.0, 45.0))
        left = fly(make(tasks=tasks), (40.0, 0.0))[0]["next", "objective"].item()
        assert left > 0.001
        for zeta, success in ((left * 0.99, False), (left * 1.01, True)):
            assert fly(make(tasks=tasks, zeta=zeta), (40.0, 0.0))[0]["next", "success"].item() is success

    def test_arriving_with_the_last_move_is_an_end_and_not_a_cut(self) -> None:
        """And the reward at arrival is not decayed, only the proximity term is, here to nothing."""
        env = make(tasks=task(self.here, moved(self.here, 0.0, 40.0)), max_steps=1, destination_weight=77.0)
        after = fly(env, (40.0, 0.0))[0]["next"]
        assert after["terminated"]
        assert not after["truncated"]
        assert after["reward"].item() == pytest.approx(77.0, abs=1e-4)
        assert after["reward_destination"].item() == 77.0

    def test_who_does_not_arrive_gets_nothing(self) -> None:
        target = moved(self.here, 0.0, 40.0)
        env = make(2, tasks=task(self.here, target))
        after = fly(env, torch.tensor([[40.0, 0.0], [5.0, 0.0]]))[0]["next"]
        assert after["success"].flatten().tolist() == [True, False]
        assert after["reward"][1] < 100


def test_truncated_at_the_step_limit() -> None:
    for max_steps in (1, 4):
        steps = fly(make(2, max_steps=max_steps), *[(1.0, 0.1)] * max_steps)
        for number, step in enumerate(steps, 1):
            after = step["next"]
            assert (after["step_count"] == number).all()
            assert (after["truncated"] == (number == max_steps)).all()
            assert (after["done"] == (number == max_steps)).all()
            assert not after["terminated"].any()


class TestLost:
    @pytest.fixture
    def env(self) -> GeomagneticNavEnv:
        """One vehicle 11 km south of the edge, one in the middle."""
        tasks = Tasks(places((-0.1, 165.0), (-5.0, 165.0)), places((-3.0, 166.0), (-8.0, 165.0)))
        return make(2, tasks=tasks, margin_deg=0.0, max_turn_rad=math.pi)

    def test_ends_in_failure(self, env: GeomagneticNavEnv) -> None:
        after = fly(env, (50.0, 0.0))[0]["next"]
        assert after["terminated"].flatten().tolist() == [True, False]
        assert after["done"].flatten().tolist() == [True, False]
        assert not after["success"].any()
        assert not after["truncated"].any()
        assert after["reward"][0] < 100

    def test_stays_where_it_was_lost(self, env: GeomagneticNavEnv) -> None:
        """Whatever it does next: the way back is closed."""
        steps = fly(env, (50.0, 0.0), (50.0, math.pi), (50.0, 0.0), (50.0, 0.5))
        lost = moved((-0.1, 165.0), 0.0, 50.0)
        for step in steps:
            after = step["next"]
            assert after["position"][0].tolist() == pytest.approx(lost, abs=1e-12)
            assert after["terminated"][0]
            assert not after["success"].any()
            assert not after["truncated"][0]
            assert env.observation_spec.is_in(after.select(*ENTRIES))
            assert torch.isfinite(after["reward"]).all()
        assert all(torch.equal(step["next", "field"][0], steps[0]["next", "field"][0]) for step in steps)
        assert [step["next", "reward"][0].item() for step in steps[1:]] == pytest.approx([0.0] * 3, abs=1e-4)
        assert not torch.equal(steps[3]["next", "position"][1], steps[2]["next", "position"][1])

    def test_a_target_beyond_the_edge_does_not_count(self) -> None:
        """Lost is lost, even on a place that reads like the destination."""
        beyond = moved((-0.1, 165.0), 0.0, 20.0)
        env = make(tasks=task((-0.1, 165.0), (-0.01, 165.0)), margin_deg=0.0, zeta=2.9)
        after = fly(env, (20.0, 0.0))[0]["next"]
        assert after["position"][0].tolist() == pytest.approx(beyond, abs=1e-9)
        assert after["objective"].item() < 2.9
        assert after["terminated"]
        assert not after["success"]

    def test_a_margin_gives_room(self) -> None:
        env = make(tasks=task((-0.1, 165.0), (-3.0, 166.0)), margin_deg=1.0)
        assert [bool(s["next", "terminated"]) for s in fly(env, *[(50.0, 0.0)] * 3)] == [False, False, True]


@pytest.mark.parametrize("max_steps", [3, 12])
def test_an_end_is_either_terminal_or_a_cut(max_steps: int) -> None:
    env = make(32, **LIVELY | {"max_steps": max_steps})
    after = fly_on(env, random_actions(30, 32))["next"]
    assert after["success"].any()
    assert after["truncated"].any()
    assert (after["terminated"] & ~after["success"]).any()  # the lost
    assert not (after["terminated"] & after["truncated"]).any()
    assert torch.equal(after["done"], after["terminated"] | after["truncated"])
    assert (after["success"] <= after["terminated"]).all()


def test_reward_is_the_sum_of_its_terms_and_all_are_reward_keys() -> None:
    """Over arrivals, losses and truncations, to the rounding of float32."""
    env = make(32, **LIVELY)
    assert set(env.reward_keys) == set(env.full_reward_spec.keys()) == {"reward", *REWARD_TERMS} == set(REWARDS)
    assert not set(env.reset().keys()) & set(REWARDS)
    after = fly_on(env, random_actions(30, 32))["next"]
    destination, proximity = (after[term].double() for term in REWARD_TERMS)
    torch.testing.assert_close(after["reward"].double(), destination + proximity, rtol=1e-6, atol=1e-6)
    assert torch.equal(destination, 200 * after["success"].double())
    assert after["success"].any()
    assert (proximity < 0).any()
    assert (proximity > 0).any()


def test_rollout_until_all_are_done() -> None:
    env = make(8, max_steps=9, margin_deg=0.0, seed=3)
    td = env.rollout(30, break_when_any_done=False, break_when_all_done=True)
    assert td.shape == (8, 9)
    ends = td["next", "done"].squeeze(-1)
    assert ends.any(-1).all()
    assert torch.isfinite(td["next", "field"]).all()
    assert torch.isfinite(td["next", "reward"]).all()


# ---------------------------------------------------------------------------------------------------------------------
# Vehicles do not know of each other


FLOAT64_KEYS = ("position", "target_position", "start_position")


def assert_same_flight(a: TensorDictBase, b: TensorDictBase) -> None:
    """All that is read, earned and decided to the last bit; positions within 0.1 micrometers.

    Some kernels treat the last rows of a batch, which do not fill a register, by other instructions, and so the last
    bit of a float64 depends on the size of the batch.
    """
    positions = tuple((*prefix, key) if prefix else key for prefix in ((), ("next",)) for key in FLOAT64_KEYS)
    assert_same(a, b, but=positions)
    for key in positions:
        torch.testing.assert_close(a[key], b[key], rtol=0, atol=1e-12)


@pytest.mark.parametrize(("few", "many"), [(2, 9), (1, 64)])
def test_a_flight_does_not_depend_on_the_size_of_the_batch(few: int, many: int) -> None:
    actions = random_actions(40, many)
    small, large = fly_on(make(few, **LIVELY), actions[:, :few]), fly_on(make(many, **LIVELY), actions)
    assert_same_flight(small, large[:, :few])
    assert small["next", "done"].sum() > 3 * few
    assert large["next", "success"].any()
    assert large["next", "truncated"].any()


def test_a_flight_does_not_depend_on_what_the_others_do() -> None:
    actions, others = random_actions(40, 6), random_actions(40, 6, seed=1)
    others[:, 2] = actions[:, 2]
    a, b = (fly_on(make(6, **LIVELY), x) for x in (actions, others))
    assert_same_flight(a[:, 2], b[:, 2])
    assert not torch.equal(a["next", "done"], b["next", "done"])


@pytest.mark.parametrize("mask", [[1, 0, 0, 0, 0], [0, 1, 0, 1, 1], [1, 1, 1, 1, 1], [0, 0, 0, 0, 0]])
def test_partial_reset_leaves_the_others_as_they_were(mask: list[int]) -> None:
    env = make(5)
    td = env.step_mdp(fly(env, *random_actions(3, 5))[-1])
    before = td.clone()
    chosen = torch.tensor(mask, dtype=torch.bool)
    after = env.reset(td.set("_reset", chosen.unsqueeze(-1)))
    assert_same(after.select(*ENTRIES, *FLAGS)[~chosen], before.select(*ENTRIES, *FLAGS)[~chosen])
    assert (after["step_count"][chosen] == 0).all()
    assert (after["position"] != before["position"])[chosen].all()
    assert torch.equal(after["position"][chosen], after["start_position"][chosen])
    step = env.step(after.set("action", torch.full((5, 2), 1.0)))["next"]
    assert step["step_count"].flatten().tolist() == [1 if m else 4 for m in mask]


def test_reset_mask_without_a_running_episode() -> None:
    td = TensorDict({"_reset": torch.ones(3, 1, dtype=torch.bool)}, batch_size=[3])
    assert_same(make(3).reset(td).exclude("_reset"), make(3).reset())


def test_time_steps_are_not_aliased() -> None:
    """What a step returned stays as it was while the flight goes on."""
    env = make(4, max_steps=3)
    td, kept = env.reset(), []
    for action in random_actions(8, 4):
        step, td = env.step_and_maybe_reset(td.set("action", action))
        kept.append((step, step.clone()))
    for step, copied in kept:
        assert_same(step, copied)
    rollout = make(4).rollout(5)
    for key in ("field", "position", "heading", "objective", "step_count"):
        assert (rollout["next", key][:, 1:] != rollout["next", key][:, :-1]).flatten(2).any(-1).all(), key
        assert torch.equal(rollout["next", key][:, :-1], rollout[key][:, 1:]), key


# ---------------------------------------------------------------------------------------------------------------------
# Seeds and tasks


def flown(env: GeomagneticNavEnv) -> TensorDictBase:
    torch.manual_seed(0)
    return env.rollout(12, break_when_any_done=False)


SHORT = {"max_steps": 5, "start_heading": "random"}


class TestSeeds:
    def test_same_seed_same_rollout(self) -> None:
        assert_same(*(flown(make(4, **SHORT, seed=11)) for _ in range(2)))

    def test_another_seed_another_rollout(self) -> None:
        a, b = (flown(make(4, **SHORT, seed=seed)) for seed in (11, 12))
        for key in ("start_position", "target_position", "heading"):
            assert (a[key] != b[key]).flatten(1).any(-1).all(), key

    def test_set_seed_starts_over(self) -> None:
        env = make(4, **SHORT, seed=11)
        first = flown(env)
        second = flown(env)
        assert not torch.equal(first["start_position"], second["start_position"])
        env.set_seed(11)
        assert_same(flown(env), first)
        env.set_seed(12)
        assert_same(flown(env), flown(make(4, **SHORT, seed=12)))

    def test_set_seed_needs_one(self) -> None:
        with pytest.raises(ValueError, match=r"seed.*None"):
            make().set_seed(None)

    def test_without_a_seed_the_tasks_are_drawn(self) -> None:
        assert not torch.equal(make(seed=None).reset()["position"], make(seed=None).reset()["position"])
        drawn = []
        for _ in range(2):
            torch.manual_seed(4)
            drawn.append(make(seed=None).reset())
        assert_same(*drawn)

    def test_a_seeded_env_leaves_the_global_generator_alone(self) -> None:
        torch.manual_seed(0)
        expected = torch.rand(1)
        torch.manual_seed(0)
        make(3, seed=9).reset()
        assert torch.equal(torch.rand(1), expected)

    def test_every_reset_starts_new_episodes(self) -> None:
        env = make(3)
        starts = torch.stack([env.reset()["position"] for _ in range(6)]).flatten(0, 1)
        assert len(torch.unique(starts, dim=0)) == 18

    @pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
    def test_copies_go_on_alike(self, copied: Callable[[GeomagneticNavEnv], GeomagneticNavEnv]) -> None:
        env = make(3, **SHORT)
        flown(env)
        assert_same(flown(copied(env)), flown(env))


def test_random_tasks_keep_to_the_region_and_the_distances() -> None:
    env = make(200, distance_range_km=(100.0, 150.0))
    for _ in range(2):
        td = env.reset()
        distance, _ = geodesic(*td["position"].unbind(-1), *td["target_position"].unbind(-1))
        assert (distance >= 100).all()
        assert (distance <= 150).all()
        assert PAPER_REGION.contains(torch.stack((td["position"], td["target_position"]))).all()


class TestStartHeading:
    def test_north_by_default(self) -> None:
        assert (make(50).reset()["heading"] == 0).all()

    def test_random_headings_fill_the_circle(self) -> None:
        env = make(2000, start_heading="random")
        heading = env.reset()["heading"]
        assert (heading > -math.pi).all()
        assert (heading <= torch.tensor(math.pi)).all()
        assert (torch.histc(heading, 8, -math.pi, math.pi) > 200).all()  # 250 expected
        assert not torch.equal(heading, env.reset()["heading"])

    def test_they_belong_to_the_vehicle_and_the_episode(self) -> None:
        few, many = (make(n, start_heading="random") for n in (3, 10))
        for _ in range(3):
            assert torch.equal(few.reset()["heading"], many.reset()["heading"][:3])

    def test_the_tasks_are_those_of_the_northward_start(self) -> None:
        north, any_way = (make(5, start_heading=x).reset() for x in ("north", "random"))
        assert_same(north, any_way, but=("heading",))


class TestFrozenTasks:
    @pytest.fixture
    def tasks(self) -> Tasks:
        latitude = -torch.arange(1.0, 6.0)
        return Tasks(
            torch.stack((latitude, torch.full((5,), 162.0)), -1), torch.stack((latitude, torch.full((5,), 166.0)), -1)
        )

    def started(self, td: TensorDictBase) -> list[int]:
        """Which tasks are flown, told by the latitude of the start and of the target."""
        assert torch.equal(td["position"][:, 0], td["target_position"][:, 0])
        assert (td["target_position"][:, 1] == 166.0).all()
        return [round(-1 - x) for x in td["position"][:, 0].tolist()]

    def test_vehicle_i_flies_task_i_and_goes_round(self, tasks: Tasks) -> None:
        env = make(2, tasks=tasks)
        assert [self.started(env.reset()) for _ in range(4)] == [[0, 1], [2, 3], [4, 0], [1, 2]]

    def test_more_vehicles_than_tasks(self, tasks: Tasks) -> None:
        assert self.started(make(7, tasks=tasks).reset()) == [0, 1, 2, 3, 4, 0, 1]

    def test_each_vehicle_counts_its_own_episodes(self, tasks: Tasks) -> None:
        env = make(2, tasks=tasks)
        td = env.reset()
        for expected in ([0, 3], [0, 0], [0, 2]):
            td = env.reset(td.set("_reset", torch.tensor([[False], [True]])))
            assert self.started(td) == expected
        env.reset(td.set("_reset", torch.tensor([[False], [False]])))
        assert self.started(env.reset()) == [2, 4]

    def test_they_do_not_depend_on_the_seed_and_set_seed_goes_back_to_the_first(self, tasks: Tasks) -> None:
        env = make(2, tasks=tasks, seed=1)
        assert self.started(env.reset()) == self.started(make(2, tasks=tasks, seed=2).reset())
        env.set_seed(3)
        assert self.started(env.reset()) == [0, 1]

    def test_they_may_lie_in_the_margin_and_at_any_distance(self) -> None:
        td = make(tasks=task((4.0, 156.0), (-14.0, 174.0))).reset()
        assert td["position"].tolist() == [[4.0, 156.0]]

    def test_changing_the_given_tensors_changes_nothing(self, tasks: Tasks) -> None:
        start = tasks.start.double()
        env = make(1, tasks=Tasks(start, tasks.target.double()))
        start.fill_(float("nan"))
        assert torch.isfinite(env.reset()["position"]).all()

    def test_longitudes_may_be_written_beyond_180_as_a_region_is(self) -> None:
        env = make(region=ANTIMERIDIAN, tasks=task((0.0, 184.0), (0.0, 178.0)))
        check_env_specs(env)
        env.set_seed(0)
        assert env.reset()["position"][0].tolist() == pytest.approx([0.0, -176.0], abs=1e-12)


# ---------------------------------------------------------------------------------------------------------------------
# Other regions


@pytest.mark.parametrize(
    ("region", "options"),
    [
        (ANTIMERIDIAN, {"generation": 14}),
        (HIGH_LATITUDE, {}),
        (Region((-75.0, -65.0), (-70.0, -40.0)), {"generation": 14, "date": 2028.5}),
    ],
    ids=["antimeridian", "north", "south"],
)
def test_other_regions(region: Region, options: dict[str, Any]) -> None:
    env = make(16, region=region, **options, max_steps=15, start_heading="random")
    check_env_specs(env, break_when_any_done="both")
    env.set_seed(0)
    td = fly_on(env, random_actions(30, 16))
    for key in td.keys(True, True):
        assert torch.isfinite(td[key].double()).all(), key
    longitude = td["next", "position"][..., 1]
    assert (longitude.abs() <= 180).all()
    distance, _ = geodesic(*td["position"].unbind(-1), *td["next", "position"].unbind(-1))
    torch.testing.assert_close(distance, td["next", "move"][..., 0].double(), rtol=0, atol=1e-3)  # one meter
    if region is ANTIMERIDIAN:
        assert ((td["position"][..., 1] * longitude < 0) & (longitude.abs() > 90)).any()


def test_the_default_field_covers_what_is_flown() -> None:
    for margin_deg in (0.0, 0.1, 0.2, 0.7, 1.3, 4.9):
        for region in (PAPER_REGION, Region((-9.9, 0.1), (160.3, 170.7))):
            field = make(region=region, margin_deg=margin_deg).field
            assert field.latitude[0] < region.latitude[0] - margin_deg
            assert field.longitude[1] > region.longitude[1] + margin_deg


# ---------------------------------------------------------------------------------------------------------------------
# What is refused

BAD_ACTIONS = {
    "NaN distance": (float("nan"), 0.0),
    "NaN turn": (1.0, float("nan")),
    "infinite": (float("inf"), 0.0),
    "minus infinite": (1.0, float("-inf")),
    "backwards": (-1.0, 0.0),
    "too far": (50.1, 0.0),
    "too sharp": (1.0, 1.6),
    "too sharp to the left": (1.0, -1.6),
}


@pytest.mark.parametrize("name", BAD_ACTIONS)
def test_bad_actions_are_refused(name: str) -> None:
    env = make(3)
    state = env.reset()
    for vehicle in (0, 2):
        actions = torch.full((3, 2), 0.5)
        actions[vehicle] = torch.tensor(BAD_ACTIONS[name])
        message = re.escape("GeomagneticNavEnv: actions of vehicles") + rf".*\[{vehicle}\]"
        with pytest.raises(ValueError, match=message):
            env.step(state.clone().set("action", actions))


def test_rounding_beyond_the_bounds_is_forgiven_and_cut() -> None:
    actions = torch.tensor([(50.0001, 0.0), (-0.0001, 0.0), (1.0, math.pi / 2 + 1e-6)])
    env = make(3)
    after = fly(env, actions)[0]["next"]
    low, high = env.action_spec.space.low, env.action_spec.space.high
    assert ((after["move"] >= low) & (after["move"] <= high)).all()
    assert env.observation_spec.is_in(after.select(*ENTRIES))


NAN, INF = float("nan"), float("inf")
BAD_OPTIONS = {
    "num_envs": [0, -1, 1.5, True, "3", None],
    "max_steps": [0, -1, 2.5, True],
    "max_move_km": [0.0, -1.0, NAN, INF, 5000.0],
    "max_turn_rad": [0.0, -1.0, NAN, 4.0],
    "zeta": [0.0, -1.0, NAN, INF, 3, 3.0, 5.0],
    "arrival": ["said", "", 0.0],
    "arrival_radius_km": [0.0, -1.0, NAN, INF],
    "start_heading": ["south", "North", 0.0],
    "destination_weight": [-1.0, NAN, INF],
    "proximity_weight": [-1.0, NAN, INF],
    "objective_limit": [0.0, -1.0, NAN, INF],
    "render_mode": ["human", "", True],
    "seed": [-1, 2**64, 0.5],
}


@pytest.mark.parametrize("option", BAD_OPTIONS)
def test_bad_options_are_refused_with_their_value(option: str) -> None:
    scenario = Scenario()
    for value in BAD_OPTIONS[option]:
        with pytest.raises(ValueError, match=rf"{option} must.*{re.escape(repr(value))}"):
            GeomagneticNavEnv(scenario, **{option: value})


def test_a_threshold_that_every_start_is_below_is_refused_with_the_reason() -> None:
    """F of Eq. 2-6 adds at most 1 for each of three elements: the first state of no task is above it."""
    assert make(64, zeta=2.99).reset()["objective"].max() <= 3
    with pytest.raises(ValueError, match=r"zeta must be below 3, got 5\.0: the objective F is at most 3 at the start"):
        make(zeta=5.0)


def test_a_scenario_must_be_one() -> None:
    with pytest.raises(TypeError, match="scenario must be a Scenario, got Region"):
        GeomagneticNavEnv(PAPER_REGION)


def test_a_field_that_does_not_cover_what_is_flown_is_refused() -> None:
    for latitude, longitude in (
        ((-10.0, 0.0), (160.0, 170.0)),
        ((-15.5, 5.5), (155.0, 175.5)),
        ((-15.5, 5.0), (154.5, 175.5)),
    ):
        small = RegionalField(IGRF("2022-01-01", 13), latitude, longitude)
        with pytest.raises(ValueError, match=r"not defined on all of .*-15\.5, 5\.5.*154\.5, 175\.5"):
            make(field=small)


def test_a_region_about_a_magnetic_pole_is_refused() -> None:
    """D is not continuous about the southern one, which lies near 64 S 136 E."""
    region = Region((-68.0, -60.0), (130.0, 140.0))
    with pytest.raises(ValueError, match=r"declination turns through south.*-68\.5, -59\.5"):
        make(region=region, field=IGRF(2022.0), margin_deg=0.0)


def test_a_field_of_just_the_right_size_is_taken() -> None:
    """A margin and moves that keep the vehicles inside it make the same field large enough."""
    small = RegionalField(IGRF("2022-01-01", 13), (-10.0, 0.0), (160.0, 170.0))
    check_env_specs(make(2, field=small, region=Region((-8.0, -2.0), (162.0, 168.0)), margin_deg=1.0))


def test_options_reach_the_data() -> None:
    """Those that no other test varies."""
    tasks = task(START, TARGET)
    plain, scaled = (
        fly(make(tasks=tasks, proximity_weight=w), (50.0, 1.0))[0]["next", "reward"].item() for w in (10.0, 30.0)
    )
    assert scaled == pytest.approx(3 * plain, rel=1e-5)
    # Away from the destination F grows from 3 to more than 3.1: the limit takes the rest of the loss.
    lost, limited = (
        fly(make(tasks=tasks, objective_limit=limit), (50.0, 0.0))[0]["next", "reward"].item() for limit in (None, 3.1)
    )
    assert lost < -1.2
    assert limited == pytest.approx(-1.0, abs=1e-4)
    north, east, _ = IGRF(1950.0, 13)(*places(START)[0]).tolist()
    td = make(tasks=tasks, field=IGRF(1950.0, 13)).reset()
    assert td["field"][0, 2].item() == pytest.approx(math.hypot(north, east), rel=1e-6)
    assert td["field"][0, 2].item() != pytest.approx(35467.990, rel=1e-4)


# ---------------------------------------------------------------------------------------------------------------------
# Tracks


class TestTracks:
    def test_a_track_is_the_running_episode_of_its_vehicle(self) -> None:
        """From its start on, whenever the others are reset."""
        env = make(6, **LIVELY, render_mode="rgb_array")
        td, longest = env.reset(), 0
        expected = [[position] for position in td["position"].tolist()]
        for action in random_actions(20, 6):
            step, td = env.step_and_maybe_reset(td.set("action", action))
            for vehicle, done in enumerate(step["next", "done"].flatten().tolist()):
                position = td["position"][vehicle].tolist()
                expected[vehicle] = [position] if done else [*expected[vehicle], position]
                assert env.track(vehicle).tolist() == expected[vehicle]
                longest = max(longest, len(expected[vehicle]))
        assert longest == LIVELY["max_steps"]
        assert len({len(track) for track in expected}) > 1

    def test_the_last_state_belongs_to_the_track(self) -> None:
        env = make(max_steps=3, render_mode="rgb_array")
        steps = fly(env, *[(10.0, 0.1)] * 3)
        assert steps[-1]["next", "done"]
        assert env.track(0).shape == (4, 2)
        assert torch.equal(env.track(0)[-1], steps[-1]["next", "position"][0])

    def test_without_a_render_mode_the_remedy_is_named(self) -> None:
        env = make(2)
        env.rollout(2)
        for call in (env.render, lambda: env.track(0)):
            with pytest.raises(RuntimeError, match=r"create the environment with render_mode='rgb_array'"):
                call()

    def test_positions_are_kept_with_a_render_mode_alone(self) -> None:
        """Training must not pay for pictures: without the mode, no state outlives its step."""
        for render_mode, is_kept in ((None, False), ("rgb_array", True)):
            env = make(2, render_mode=render_mode)
            td = env.reset()
            start = weakref.ref(td["position"])
            after = env._step(td.set("action", torch.ones(2, 2)))
            end = weakref.ref(after["position"])
            del td, after
            gc.collect()
            assert [ref() is not None for ref in (start, end)] == [is_kept] * 2

    def test_bad_calls(self) -> None:
        env = make(2, render_mode="rgb_array")
        for call in (env.render, lambda: env.track(0)):
            with pytest.raises(RuntimeError, match=r"call reset\(\) first"):
                call()
        env.reset()
        for vehicle in (2, -1):
            with pytest.raises(IndexError, match=f"vehicle {vehicle} .* 2 in the batch"):
                env.track(vehicle)
            with pytest.raises(IndexError, match=f"vehicle {vehicle} "):
                env.render([vehicle])
        for size_px in (0, 1.5):
            with pytest.raises(ValueError, match=f"size_px must be a whole number from 1 on, got {size_px}"):
                env.render(size_px=size_px)

    def test_recording_changes_no_number(self) -> None:
        actions = random_actions(15, 4)
        recorded, plain = (fly_on(make(4, **LIVELY, render_mode=mode), actions) for mode in ("rgb_array", None))
        assert_same(recorded, plain)


# ---------------------------------------------------------------------------------------------------------------------
# Compilation


def test_step_and_guidance_trace_as_one_graph() -> None:
    """Nothing in them breaks the graph of torch.compile, and the graph gives the same numbers."""
    env = make(4)
    td = env.rand_action(env.reset())
    guided = Compose(FieldGradient(env.field), GradientHeading(), AlignmentReward(weight=3.0, offset=0.785))
    TransformedEnv(env, guided).reset()
    before = guided._reset(td.clone(), td.clone())

    def step(before: TensorDictBase) -> TensorDictBase:
        return guided._step(before, env._step(before))

    traced = torch.compile(step, fullgraph=True, backend="aot_eager")(before)
    plain = step(before)
    assert {"field", "reward", "gradient_heading"} <= set(plain.keys())
    for key, value in plain.items():
        torch.testing.assert_close(traced[key], value, rtol=0, atol=0, msg=lambda text, key=key: f"{key}: {text}")
