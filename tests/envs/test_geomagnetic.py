"""The environment: specs, one leg by hand, rewards, ends of episodes, seeds, independent vehicles, options, tracks."""

import copy
import math
import pickle
from collections.abc import Callable
from datetime import datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from ppigrf import igrf
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import SerialEnv
from torchrl.envs.utils import check_env_specs

import magrl
from magrl.envs import PAPER_REGION, PRIVILEGED_KEYS, PUBLIC_KEYS, GeomagneticNavEnv, Region, Scenario, Trips
from magrl.envs.navigation import navigation_env
from magrl.envs.specs import REWARD_TERMS
from magrl.evaluation import Flight
from magrl.field import IGRF, RegionalField
from magrl.geodesy import move
from magrl.navigators import load_policy
from magrl.pilot.network import pretrained
from magrl.random_numbers import FIRST_RESERVED_SEED

ANTIMERIDIAN = Region((-5.0, 5.0), (175.0, 185.0))


def make(num_envs: int = 1, **options: Any) -> GeomagneticNavEnv:
    return GeomagneticNavEnv(num_envs=num_envs, **{"seed": 0} | options)


def places(*positions: tuple[float, ...]) -> Tensor:
    return torch.tensor(positions, dtype=torch.float64)


def trip(start: tuple[float, float], target: tuple[float, float]) -> Trips:
    return Trips(places(start), places(target))


def moved(place: tuple[float, float], heading: float, distance_km: float) -> tuple[float, float]:
    """Where a leg from a place leads [deg]."""
    inputs = (torch.tensor(float(x), dtype=torch.float64) for x in (*place, heading, distance_km))
    latitude, longitude = move(*inputs)
    return float(latitude), float(longitude)


def fly(env: GeomagneticNavEnv, *actions: tuple[float, float] | Tensor) -> list[TensorDictBase]:
    """The transitions of some legs, each the same for all vehicles or one row a vehicle; nobody is reset."""
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


@pytest.mark.parametrize(
    "options",
    [
        {"num_envs": 64, "max_turn_deg": 180.0, "max_leg_km": 300.0, "start_heading": "random"},
        {"max_steps": 1, "drift_km": 10.0},
        {"region": ANTIMERIDIAN, "generation": 14, "arrival": "declared"},
        {"region": Region((-80.0, -70.0), (-10.0, 40.0)), "field": IGRF(2027.0), "arrival": "distance"},
    ],
    ids=["long legs", "one step", "antimeridian", "IGRF itself"],
)
def test_specs_match_the_data(options: dict[str, Any]) -> None:
    check_env_specs(make(**{"num_envs": 3} | options), break_when_any_done="both")


def test_specs_do_not_depend_on_the_default_type() -> None:
    torch.set_default_dtype(torch.float64)
    try:
        env = navigation_env(2, observation="track", seed=0)
        check_env_specs(env)
    finally:
        torch.set_default_dtype(torch.float32)
    assert {env.base_env.observation_spec[key].dtype for key in PUBLIC_KEYS} == {torch.float32}


def test_a_collector_cuts_episodes() -> None:
    assert make().reward_key == "reward"  # transforms of TorchRL need one
    collector = Collector(make(2), frames_per_batch=90, total_frames=90, max_frames_per_traj=20)
    (data,) = collector
    assert torch.equal(data["elapsed_steps"], data["step_count"])  # the latter by TorchRL's StepCounter
    assert (data["next", "truncated"].cumsum(1)[:, -1] == 2).all()


# ---------------------------------------------------------------------------------------------------------------------
# One leg by hand, between the paper's example points

START, TARGET = (-2.0, 162.0), (-8.0, 164.0)


def elements_by_ppigrf(latitude: float, longitude: float) -> Tensor:
    """D, I [deg], B_H [nT] of IGRF-13 at the start of 2022, by another program, in which five years are 1827 days."""
    date, path = datetime(2020, 1, 1) + timedelta(days=0.4 * 1827), Path(magrl.__file__).parent / "field/igrf13.shc"
    east, north, up = (float(x.squeeze()) for x in igrf(longitude, latitude, 0.0, date, coeff_fn=str(path)))
    horizontal = math.hypot(east, north)
    angles = (math.degrees(math.atan2(east, north)), math.degrees(math.atan2(-up, horizontal)))
    return torch.tensor((*angles, horizontal), dtype=torch.float64)


def test_first_observation_is_that_of_the_paper() -> None:
    td = make(trips=trip(START, TARGET)).reset()[0]
    for key, values in (("field", (8.019, -16.150, 35467.990)), ("target_field", (9.228, -26.923, 35199.415))):
        assert ((td[key] - torch.tensor(values)).abs() < torch.tensor([0.001, 0.001, 0.004])).all(), key  # a float32
    assert td["position"].tolist() == td["start_position"].tolist() == list(START)
    assert td["target_position"].tolist() == list(TARGET)
    assert td["objective"].item() == pytest.approx(3.0, rel=1e-6)  # each element is the whole of its difference off
    weights = 1 / (elements_by_ppigrf(*TARGET) - elements_by_ppigrf(*START)).square()
    assert td["objective_weights"].tolist() == pytest.approx(weights.tolist(), rel=3e-5)  # B_H is a float32
    assert td["heading"].item() == td["elapsed_steps"].item() == 0
    assert td["leg"].tolist() == [0.0, 0.0]
    assert not td["success"]
    assert not td["done"]


def test_one_leg_by_hand() -> None:
    turn, end = -3 * math.pi / 4, (-2.3197057250399222, 161.68214048662887)  # 50 km, by GeographicLib 2.1
    (step,) = fly(make(trips=trip(START, TARGET), max_turn_deg=180.0), (50.0, turn))
    after = step["next"][0]
    assert after["position"].tolist() == pytest.approx(end, abs=1e-7)  # a centimeter
    assert after["heading"].item() == pytest.approx(turn, abs=1e-6)
    assert after["leg"].tolist() == pytest.approx([50.0, turn], abs=1e-6)
    assert after["elapsed_steps"].item() == 1

    origin, here, there = (elements_by_ppigrf(*place) for place in (START, end, TARGET))
    assert after["field"].tolist() == pytest.approx(here.tolist(), rel=1e-6, abs=1e-5)
    objective = float((((there - here) / (there - origin)) ** 2).sum())  # Eq. (6)
    assert after["objective"].item() == pytest.approx(objective, rel=1e-5)
    assert after["reward"].item() == pytest.approx(10 * (3 - objective), rel=1e-3)  # Eq. (11)
    assert not after["done"]


def test_late_rewards_decay() -> None:
    """Past half of 6 legs, n/6 of the size of the proximity term is taken off: gains shrink and losses grow."""
    turn_back, go_on, stay = (50.0, math.pi), (50.0, 0.0), (0.0, 0.0)
    env = make(trips=trip(START, TARGET), max_steps=6, max_turn_deg=180.0, proximity_weight=2.5)
    steps = fly(env, turn_back, stay, go_on, turn_back, turn_back, go_on)  # south, south, north, south, south
    objective = [3.0, *(step["next", "objective"].item() for step in steps)]
    assert objective[3] < objective[4] > objective[5] > objective[6]
    plain = [2.5 * (before - after) for before, after in pairwise(objective)]
    taken = [0.0, 0.0, 0.0, 4 / 6, 5 / 6, 1.0]
    expected = [r - share * abs(r) for r, share in zip(plain, taken, strict=True)]
    assert [step["next", "reward"].item() for step in steps] == pytest.approx(expected, abs=1e-3)


# ---------------------------------------------------------------------------------------------------------------------
# How episodes end


LIVELY: dict[str, Any] = {"margin_deg": 0.0, "zeta": 0.5, "distance_range_km": (30.0, 120.0), "start_heading": "random"}
LIVELY |= {"max_steps": 7, "seed": 5}
"""Short episodes that end in every way, so that vehicles are reset at different times."""


HERE = (-5.0, 165.0)


def test_the_threshold_is_zeta() -> None:
    """A leg that falls short of it by a little arrives only if zeta is that wide."""
    trips = trip(HERE, moved(HERE, 0.0, 45.0))
    left = fly(make(trips=trips), (40.0, 0.0))[0]["next", "objective"].item()
    assert left > 0.001
    for zeta, success in ((left * 0.99, False), (left * 1.01, True)):
        assert fly(make(trips=trips, zeta=zeta), (40.0, 0.0))[0]["next", "success"].item() is success


def test_arriving_with_the_last_leg_is_an_end_and_not_a_cut() -> None:
    """And the reward at arrival is not decayed, only the proximity term is, here to nothing."""
    env = make(trips=trip(HERE, moved(HERE, 0.0, 40.0)), max_steps=1, destination_weight=77.0)
    after = fly(env, (40.0, 0.0))[0]["next"]
    assert [bool(after[key]) for key in ("success", "terminated", "done", "truncated")] == [True, True, True, False]
    assert after["reward"].item() == pytest.approx(77.0, abs=1e-4)
    assert after["reward_destination"].item() == 77.0


def test_ends_and_rewards_of_many_episodes() -> None:
    """An end is terminal or a cut; the reward is the sum of its terms, to the rounding of float32."""
    env = make(32, **LIVELY)
    assert all((env.reset()[term] == 0).all() for term in REWARD_TERMS)
    after = fly_on(env, random_actions(30, 32))["next"]
    assert after["success"].any()
    assert after["truncated"].any()
    assert (after["terminated"] & ~after["success"]).any()  # the lost
    assert not (after["terminated"] & after["truncated"]).any()
    assert torch.equal(after["done"], after["terminated"] | after["truncated"])
    assert (after["success"] <= after["terminated"]).all()
    assert torch.equal(after["truncated"], (after["elapsed_steps"] == env.max_steps) & ~after["terminated"])
    destination, proximity = (after[term].double() for term in REWARD_TERMS)
    torch.testing.assert_close(after["reward"].double(), destination + proximity, rtol=1e-6, atol=1e-6)
    assert torch.equal(destination, 200 * after["success"].double())
    assert (proximity < 0).any()
    assert (proximity > 0).any()


def test_a_lost_vehicle_stays_where_it_was_lost() -> None:
    """Whatever it does next: the way back is closed, and a place there that reads like the destination is none."""
    trips = Trips(places((-0.1, 165.0), (-5.0, 165.0)), places((-0.01, 165.0), (-8.0, 165.0)))
    env = make(2, trips=trips, margin_deg=0.0, max_turn_deg=180.0, zeta=2.9)
    steps = fly(env, (20.0, 0.0), (50.0, math.pi), (50.0, 0.0), (50.0, 0.5))
    assert steps[0]["next", "objective"][0] < 2.9
    for step in steps:
        after = step["next"]
        assert after["position"][0].tolist() == pytest.approx(moved((-0.1, 165.0), 0.0, 20.0), abs=1e-9)
        assert after["terminated"][0]
        assert not after["success"][0]
        assert not after["truncated"].any()
        assert env.observation_spec.is_in(after.select(*PUBLIC_KEYS, *PRIVILEGED_KEYS, "elapsed_steps"))
        assert torch.equal(after["field"][0], steps[0]["next", "field"][0])
    assert [step["next", "reward"][0].item() for step in steps[1:]] == pytest.approx([0.0] * 3, abs=1e-4)
    assert not torch.equal(steps[3]["next", "position"][1], steps[2]["next", "position"][1])


# ---------------------------------------------------------------------------------------------------------------------
# Vehicles do not know of each other


def test_a_flight_does_not_depend_on_the_size_of_the_batch() -> None:
    """To the last bit; positions to 0.1 micrometers: kernels treat the last rows of a batch by other instructions."""
    few, many = 2, 64
    actions = random_actions(30, many)
    small, large = fly_on(make(few, **LIVELY), actions[:, :few]), fly_on(make(many, **LIVELY), actions)[:, :few]
    positions = [key for key in small.keys(True, True) if small[key].dtype == torch.float64]
    assert_same(small, large, but=tuple(positions))
    for key in positions:
        torch.testing.assert_close(small[key], large[key], rtol=0, atol=1e-12)
    assert small["next", "done"].sum() > 2 * few


def test_starts_computed_ahead_do_not_change_with_what_a_reset_returned_or_a_state_that_is_loaded() -> None:
    env, other = make(2), make(2, objective_floors=(1.0, 1.0, 100.0))
    with torch.inference_mode():
        first = env.reset()
    env.set_seed(0)
    env.reset()["field"].add_(1.0)
    env.set_seed(0)
    assert_same(env.reset(), first)
    for each in (env, other):
        each.set_seed(0)
    env.load_state_dict(other.state_dict())
    assert_same(env.reset(), other.reset())


@pytest.mark.parametrize("options", [{}, {"drift_km": 20.0, "start_heading": "random", "max_turn_deg": 180.0}])
def test_a_reset_to_a_state_goes_on_from_there(options: dict[str, Any]) -> None:
    """In an environment of another seed, too."""
    env, other = make(3, **options), make(3, **options | {"seed": 7, "render_mode": "rgb_array"})
    other.rollout(3)
    state, action = env.step_mdp(env.rand_step(env.reset())), random_actions(1, 3)[0]
    again = other.reset(state.clone(), set_state=True)
    assert_same(again.select(*state.keys()), state, but=REWARD_TERMS)
    assert torch.equal(other.track(1), state["position"][1:2])
    assert_same(*(each.step(td.set("action", action))["next"] for each, td in ((env, state), (other, again))))
    with pytest.raises(KeyError, match=r"lacks \[.*'objective_weights'.*'position', 'target_position'\] alone"):
        env.reset(state.exclude("objective_weights"), set_state=True)


def test_episodes_begin_at_places_of_ones_own() -> None:
    """With their own random numbers, as any episode."""
    ends = Trips(places(START, HERE), places(TARGET, START))
    own = TensorDict(position=ends.start, target_position=ends.target, batch_size=[2])
    for env in (make(2), navigation_env(2, seed=0), SerialEnv(1, lambda: navigation_env(2, seed=0))):
        given = own.expand(*env.batch_size).clone()
        first, second = (env.reset(given.clone(), set_state=True).reshape(2) for _ in range(2))
        expected = make(2, trips=ends).reset().exclude("episode_stream")
        assert_same(first.select(*expected.keys()), expected)
        assert (first["episode_stream"] != second["episode_stream"]).all()
    with pytest.raises(ValueError, match=r"must be in the region and its margin, got .*78\.0"):
        make(2).reset(own.set("position", ends.start + 80.0), set_state=True)


def test_a_reset_of_some_needs_the_state_of_the_others() -> None:
    mask = torch.tensor([True, False, True])
    for env in (make(3), navigation_env(3)):  # TorchRL hides the merge from an environment under transforms
        with pytest.raises(ValueError, match=r"no state .*: to reset the others alone, set '_reset' in the TensorDict"):
            env.rand_step(env.reset(TensorDict(_reset=mask, batch_size=[3])))
        assert (env.reset(TensorDict(_reset=torch.ones_like(mask), batch_size=[3]))["elapsed_steps"] == 0).all()
    batch = SerialEnv(2, lambda: make(3))
    td = batch.step_mdp(batch.rand_step(batch.reset()))
    after = batch.reset(td.set("_reset", torch.stack((mask, ~mask)).unsqueeze(-1)), set_state=False)
    assert after["elapsed_steps"].flatten().tolist() == [0, 1, 0, 1, 0, 1]


# ---------------------------------------------------------------------------------------------------------------------
# Seeds and trips


SEEDED: dict[str, Any] = {"num_envs": 4, "max_steps": 5, "start_heading": "random"}


def seeded(env: GeomagneticNavEnv) -> TensorDictBase:
    return fly_on(env, random_actions(12, 4))


def test_a_seed_gives_the_rollout_and_set_seed_starts_over() -> None:
    env = make(**SEEDED, seed=11)
    first, second = seeded(env), seeded(env)
    assert_same(seeded(make(**SEEDED, seed=11)), first)
    assert not torch.equal(first["start_position"], second["start_position"])
    env.set_seed(12)
    other = seeded(env)
    for key in ("start_position", "target_position", "heading"):
        assert (other[key] != first[key]).flatten(2).any(-1).all(), key
    env.set_seed(11)
    assert_same(seeded(env), first)
    with pytest.raises(ValueError, match=r"seed.*None"):
        env.set_seed(None)
    for copied in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        assert_same(seeded(copied), second)


@pytest.mark.parametrize("first", [0, FIRST_RESERVED_SEED + 5])
def test_seeds_of_several_environments_are_reserved_as_the_first_one_is(first: int) -> None:
    several, collector = SerialEnv(16, make), Collector(make(), frames_per_batch=1, total_frames=1)
    collector.set_seed(several.set_seed(first))
    seeds = [env.seed for env in (*several._envs, collector.env)]
    assert len({*seeds}) == 17
    assert {seed >= FIRST_RESERVED_SEED for seed in seeds} == {first > 0}
    assert [make().set_seed(seed, static_seed=True) for seed in seeds] == seeds


def test_random_headings_fill_the_circle() -> None:
    env = make(2000, start_heading="random")
    heading = env.reset()["heading"]
    assert (torch.histc(heading, 8, -math.pi, math.pi) > 200).all()  # 250 expected
    assert not torch.equal(heading, env.reset()["heading"])


def test_vehicles_fly_frozen_trips_in_turn_and_count_their_own_episodes() -> None:
    latitude = -torch.arange(1.0, 6.0)
    start, target = (torch.stack((latitude, torch.full((5,), longitude)), -1) for longitude in (162.0, 166.0))
    env, again = (make(2, trips=Trips(start, target)) for _ in range(2))

    def started(td: TensorDictBase) -> list[int]:
        """Which trips are flown, told by the latitude of the start and of the target."""
        assert torch.equal(td["position"][:, 0], td["target_position"][:, 0])
        assert (td["target_position"][:, 1] == 166.0).all()
        return [round(-1 - x) for x in td["position"][:, 0].tolist()]

    assert [started(env.reset()) for _ in range(4)] == [[0, 1], [2, 3], [4, 0], [1, 2]]
    td = again.reset()
    for expected in ([0, 3], [0, 0], [0, 2]):
        td = again.reset(td.set("_reset", torch.tensor([[False], [True]])), set_state=False)
        assert started(td) == expected
    again.reset(td.set("_reset", torch.tensor([[False], [False]])), set_state=False)
    assert started(again.reset()) == [2, 4]


# ---------------------------------------------------------------------------------------------------------------------
# What is refused


def test_a_bad_action_is_named_with_its_vehicle() -> None:
    env = make(3)
    for action in ((math.nan, 0.0), (1.0, math.inf), (-1.0, 0.0), (50.1, 0.0), (1.0, -1.6)):
        with pytest.raises(ValueError, match=r"GeomagneticNavEnv: actions of vehicles \[2\]"):
            env.step(env.reset().set("action", torch.tensor([[0.5, 0.5], [0.5, 0.5], action])))


def test_rounding_beyond_the_bounds_is_forgiven_and_cut() -> None:
    actions = torch.tensor([(50.0001, 0.0), (-0.0001, 0.0), (1.0, math.pi / 2 + 1e-6)])
    env = make(3)
    after = fly(env, actions)[0]["next"]
    low, high = env.action_spec.space.low, env.action_spec.space.high
    assert ((after["leg"] >= low) & (after["leg"] <= high)).all()
    assert env.observation_spec.is_in(after.select(*PUBLIC_KEYS, *PRIVILEGED_KEYS, "elapsed_steps"))


def test_a_field_that_is_moved_stays_where_it_was_in_the_scenario() -> None:
    """Without a second copy of its numbers."""
    scenario = Scenario(field=Scenario().build_field())
    env = GeomagneticNavEnv(scenario, seed=0)
    for one, other in zip(env.field.buffers(), scenario.field.buffers(), strict=True):
        assert one.data_ptr() == other.data_ptr()
    env.field.to("meta")
    assert {values.device.type for values in scenario.field.buffers()} == {"cpu"}


def test_options_replace_those_of_the_scenario() -> None:
    scenario = Scenario(max_steps=80, zeta=0.02)
    env = GeomagneticNavEnv(scenario, zeta=0.5, max_turn_deg=60, arrival="distance", radius_km=30)
    assert (env.max_steps, env.zeta, env.max_leg_km, env.start_heading) == (80, 0.5, 50.0, "north")
    assert (env.max_turn_rad, env.arrival, env.scenario.radius_km) == (math.radians(60), "distance", 30.0)
    assert (env.scenario.max_steps, env.scenario.zeta, scenario.zeta) == (80, 0.5, 0.02)
    with pytest.raises(TypeError, match=r"unexpected keyword argument 'speed'; the options are .*'max_steps'"):
        GeomagneticNavEnv(speed=3)
    with pytest.raises(TypeError, match="scenario must be a Scenario, got Region"):
        GeomagneticNavEnv(PAPER_REGION)


def test_a_field_that_does_not_cover_what_is_flown_is_refused() -> None:
    small = RegionalField(IGRF("2022-01-01", 13), (-15.5, 5.5), (155.0, 175.5))
    with pytest.raises(ValueError, match=r"not defined on all of .*-15\.5, 5\.5.*154\.5, 175\.5"):
        make(field=small)


def test_the_limit_of_the_objective_limits_losses() -> None:
    """Away from the destination F grows from 3 to more than 3.1: the limit takes the rest of the loss."""
    env = make(trips=trip(START, TARGET), objective_limit=3.1)
    assert fly(env, (50.0, 0.0))[0]["next", "reward"].item() == pytest.approx(-1.0, abs=1e-4)


# ---------------------------------------------------------------------------------------------------------------------
# Tracks


def test_a_track_is_the_running_episode_of_its_vehicle() -> None:
    """From its start on, whenever the others are reset."""
    env = make(6, **LIVELY, render_mode="rgb_array")
    td, longest = env.reset(), 0
    expected = [[position] for position in td["position"].tolist()]
    for action in random_actions(12, 6):
        step, td = env.step_and_maybe_reset(td.set("action", action))
        for vehicle, done in enumerate(step["next", "done"].flatten().tolist()):
            position = td["position"][vehicle].tolist()
            expected[vehicle] = [position] if done else [*expected[vehicle], position]
            assert env.track(vehicle).tolist() == expected[vehicle]
            longest = max(longest, len(expected[vehicle]))
    assert longest == LIVELY["max_steps"]


def test_bad_calls_of_tracks_and_pictures() -> None:
    env = make(2, render_mode="rgb_array")
    for call, message in (
        (make(2).render, r"create the environment with render_mode='rgb_array'"),
        (env.render, r"and call reset\(\)"),
        (lambda: env.track(0), r"and call reset\(\)"),
    ):
        with pytest.raises(RuntimeError, match=message):
            call()
    env.reset()
    for call, message in (
        (lambda: env.track(-1), "vehicle must be a whole number from 0 up to 1, got -1"),
        (lambda: env.render([2]), "vehicle must be a whole number from 0 up to 1, got 2"),
        (lambda: env.render(size_px=0), "size_px must be a whole number from 1 on, got 0"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


# ---------------------------------------------------------------------------------------------------------------------
# Compilation


def test_a_step_traces_as_one_graph() -> None:
    """Nothing in it breaks the graph of torch.compile, and the graph gives the same numbers."""
    env = make(4)
    before = env.rand_action(env.reset())
    traced, plain = torch.compile(env._step, fullgraph=True, backend="eager")(before), env._step(before)
    assert_same(traced, plain)


@pytest.mark.parametrize(
    "door",
    [
        lambda device: GeomagneticNavEnv(device=device),
        lambda device: GeomagneticNavEnv().to(device),
        lambda device: load_policy(pretrained("anywhere"), device),
        lambda device: Flight(Scenario(), device=device),
    ],
)
def test_a_device_that_is_not_there_is_refused(door: Callable[[str], object]) -> None:
    with pytest.raises(ValueError, match=r"device 'cuda:99' cannot be used here .*: choose another, such as cpu"):
        door("cuda:99")
