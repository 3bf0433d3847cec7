"""Rollouts, their measures on hand-made episodes, and intervals against hand-worked cases and SciPy."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
import scipy.stats
import torch
from support.episodes import episode, point
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import CatFrames, InitTracker, Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType
from torchrl.modules import ProbabilisticActor, TanhNormal

from magrl import Anywhere, episode_measures, evaluate, evaluation_rollout, summarize
from magrl.envs import GeomagneticNavEnv, Scenario, Trips, named_trips
from magrl.envs.measures import (
    Episode,
    bootstrap_interval,
    interquartile_mean,
    measured,
    path_efficiency,
    spl,
    stratified_bootstrap,
    wilson_interval,
)
from magrl.envs.navigation import navigation_env
from magrl.errors import SensorErrors
from magrl.evaluation import Flight
from magrl.evaluation.arrays import ArrayPolicy
from magrl.evaluation.episodes import (
    first_episode_mask,
    moved,
)
from magrl.evaluation.options import choose_trips, first_trips
from magrl.navigators import FieldPolicy, PolicyConfig, Secant, policy_env


def test_every_trip_is_flown_once_with_errors_of_its_own() -> None:
    """The same trip has other noise and another start heading for each vehicle; the same call has the same."""
    trips = named_trips("paper-example")
    thrice = Scenario().with_trips(Trips(trips.start.repeat(3, 1), trips.target.repeat(3, 1)))
    for options in ({"errors": (0.05, 0.05, 5.0)}, {"start_heading": "random"}):
        one, again = (evaluate("secant", thrice, max_steps=5, **options)["smoothness_deg"] for _ in range(2))
        assert torch.equal(one, again)
        assert one.unique().numel() == 3
    perfect = evaluate("secant", thrice, max_steps=5)
    torch.testing.assert_close(perfect["length_km"], perfect["length_km"][:1].expand(3))
    assert (evaluate("secant", thrice, errors="ship", max_steps=5)["steps"] <= 5).all()


@pytest.mark.parametrize("known", [{}, {"model": "IGRF-13", "start_km": 5.0}])
def test_elements_at_the_destination_have_the_errors_that_vehicles_state(known: dict) -> None:
    """Whether they know the start or not; without D, that of D is none, and exact elements are as without errors."""
    std, trips = (0.1, 0.05, 30.0), named_trips("paper-100")
    for north, signs in (("true", [1, 1, 1]), ("magnetic", [0, 1, 1])):
        flight = Flight(Scenario().with_trips(trips), north=north, target_std=std, **known)
        error = flight.env.reset()["target_error"]
        assert error.std(0) == pytest.approx(torch.tensor(std) * torch.tensor(signs), rel=0.25)
        assert flight.navigator("kalman").rules.target_std == std
    for none in ((0.0, 0.0, 0.0), None):
        assert "target_error" not in Flight(Scenario().with_trips(trips), target_std=none, **known).env.reset()


def test_a_stochastic_policy_is_evaluated_without_exploration() -> None:
    """Twice with the same actions, those of the mode of its distribution."""
    network = TensorDictModule(lambda leg: (0 * leg, 0 * leg + 2.0), ["leg"], ["loc", "scale"])
    policy = ProbabilisticActor(
        network,
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        default_interaction_type=ExplorationType.RANDOM,
        distribution_kwargs={"low": torch.tensor([0.0, -1.0]), "high": torch.tensor([50.0, 1.0])},
    )
    env = GeomagneticNavEnv(num_envs=3, seed=0, max_steps=4)
    assert env.rollout(4, policy)["action"].unique().numel() > 4
    actions = evaluation_rollout(env, policy)["action"]
    assert torch.equal(actions, torch.tensor([25.0, 0.0]).expand_as(actions))
    episodes = [evaluate(policy, "paper-example", max_steps=4)["length_km"] for _ in range(2)]
    assert torch.equal(*episodes)


def test_what_cannot_be_evaluated_is_refused() -> None:
    agent = FieldPolicy(PolicyConfig(GeomagneticNavEnv(seed=0).observation_view(), (8,)))
    elsewhere = Scenario(region={"latitude": (40, 50), "longitude": (0, 10)}, objective_floors=None)
    elsewhere = elsewhere.with_trips(elsewhere.random_trips(2, seed=0))
    for policy, trips, options, message in (
        ("secant", Scenario(), {}, "the scenario has no trips to fly"),
        ("secant", "paper-example", {"errors": "yacht"}, "conditions must be one of 'laboratory'"),
        (agent, elsewhere, {}, "trained"),
        (agent, "paper-example", {"max_turn_deg": 20}, "up to 90°, the environment .* and 20°"),
        (5, "paper-example", {}, "policy must be callable"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            evaluate(policy, trips, **options)


@pytest.mark.parametrize("options", [{"arrival": "declared"}, {"max_leg_km": 20, "zeta": 0.02}])
def test_a_pretrained_policy_flies_as_by_its_name(options: dict) -> None:
    """Within the limits of the environment, which it gets from `evaluate`, or from a loop of one's own."""
    scenario = first_trips(choose_trips(None, "paper-100"), 3)
    policy, options = Anywhere(), {"max_steps": 4, **options}
    named, given = (evaluate(agent, scenario, errors=(0.05, 0.05, 5.0), **options) for agent in ("anywhere", policy))
    assert all(torch.equal(named[key], given[key]) for key in named.keys())  # noqa: SIM118
    base = GeomagneticNavEnv(scenario, num_envs=3, seed=0, **options)
    env = TransformedEnv(base, SensorErrors((0.05, 0.05, 5.0)))
    policy = policy.fitted(base, {})
    with torch.no_grad():
        own = policy_env(env, policy).rollout(4, policy, break_when_any_done=False, break_when_all_done=True)
    assert torch.equal(episode_measures(own)["length_km"], named["length_km"])


def test_a_vehicle_without_a_finite_action_fails_alone() -> None:
    """The others fly as they do without it."""

    class Broken(Secant):
        def forward(self, tensordict: TensorDict) -> TensorDict:
            hurt = (tensordict["elapsed_steps"] == 2) & (tensordict["target_position"] == target).all(-1, keepdim=True)
            action = super().forward(tensordict)["action"]
            return tensordict.set("action", torch.where(hurt, math.nan, action))

    trips = first_trips(choose_trips(None, "paper-100"), 6)
    target = trips.trips.target[3]
    with pytest.warns(UserWarning, match=r"not finite: vehicles \[3\] stopped"):
        episodes = evaluate(Broken(), trips)
    sound, others = evaluate("secant", trips), torch.arange(6) != 3
    assert not episodes["success"][3]
    for key in ("success", "length_km", "steps"):
        assert torch.equal(episodes[key][others], sound[key][others]), key


def test_a_vehicle_without_a_finite_action_stands_still_with_scaled_actions() -> None:
    """There 0 is half a leg; it neither moves nor declares."""

    def broken(tensordict: TensorDict) -> TensorDict:
        action = torch.full_like(tensordict["heading"].expand(-1, 2), 0.5)
        return tensordict.set("action", torch.where(tensordict["elapsed_steps"] > 0, math.nan, action))

    with pytest.warns(UserWarning, match=r"vehicles \[0, 1\] stopped"):
        rollout = evaluation_rollout(navigation_env(2, seed=0, max_steps=4), broken)
    assert rollout["next", "leg"][..., 0].tolist() == [[37.5, 0, 0, 0]] * 2


TOLERANCES = {"heading_mae_deg": 0.2, "heading_rmse_deg": 0.1, "navigation_error_km": 0.1}
TURN = math.degrees(math.atan2(40, 30))
STRAIGHT = {"smoothness_deg": 180, "heading_mae_deg": 0}
WHOLE = {"length_km": 200, "navigation_error_km": 0, "spl": 1, "path_efficiency": 1}
CORNER = {"smoothness_deg": 90, "heading_mae_deg": TURN / 2, "heading_rmse_deg": TURN / math.sqrt(2), "spl": 50 / 70}
AWAY = {"spl": 0, "path_efficiency": 1, "navigation_error_km": 600, "heading_mae_deg": 180}
NOWHERE = {"spl": 1, "length_km": 0, "heading_mae_deg": math.nan, "path_efficiency": math.nan}
HERE = point(0.0, 0.0)


@pytest.mark.parametrize(
    ("legs", "target", "success", "expected"),
    [
        pytest.param([(50, 30)] * 4, point(200, 30), True, {"success": 1, "steps": 4, **WHOLE, **STRAIGHT}, id="line"),
        pytest.param([(30, 0), (40, 90)], point(50, TURN), True, {"length_km": 70, **CORNER}, id="right angle"),
        pytest.param([(50, 180)] * 6, point(300, 0), False, {"success": 0, "steps": 6, **AWAY}, id="straight away"),
        pytest.param([(40, 10)], point(45, 10), True, {"smoothness_deg": math.nan, "spl": 1}, id="arrival before it"),
        pytest.param([(0, 0)], point(10, 0), True, NOWHERE, id="arrival without leaving"),
        pytest.param([(50, 0), (30, 180)], point(20, 0), True, {"path_efficiency": 0.25}, id="there and back"),
        pytest.param([(50, 0), (30, 180)], point(300, 90), False, {"path_efficiency": 0.25}, id="of the distance made"),
        pytest.param([(0, 0)], HERE, True, {"shortest_km": 0, "spl": 1, "navigation_error_km": 0}, id="at the end"),
        pytest.param([(0, 0)], HERE, False, {"shortest_km": 0, "spl": 0, "navigation_error_km": 0}, id="not arrived"),
        pytest.param([(5, 0)], HERE, True, {"shortest_km": 0, "spl": 0, "navigation_error_km": 5}, id="detour"),
        pytest.param([(50, 0), (0, 90), (50, 0)], point(100, 0), True, STRAIGHT, id="a pause is no turn"),
        pytest.param([(0.5, 0), (0.5, 90)], point(9, 0), False, {"smoothness_deg": 90, "length_km": 1}, id="short"),
    ],
)
def test_measures_of_episodes_by_hand(legs: list, target: tuple, success: bool, expected: dict) -> None:
    got = episode_measures(episode(legs, target, success, steps=6))
    for key, value in expected.items():
        assert float(got[key]) == pytest.approx(value, abs=TOLERANCES.get(key, 1e-4), nan_ok=True), key


def test_legs_have_the_commanded_distance_and_the_true_direction() -> None:
    """The direction of the errors of motion, or else of the north reference, or else the commanded one."""
    steps = TensorDict(leg=torch.tensor([[1.0, 0.0]]), heading=torch.tensor([[0.1]]))
    for key, value, expected in (
        ("heading", 0.1, (1.0, 0.1)),
        ("true_heading", 0.2, (1.0, 0.2)),
        ("true_course", 0.3, (1.0, 0.3)),
        ("true_leg", 4.0, (1.0, 0.3)),
    ):
        steps[key] = torch.full((1, 2 if key == "true_leg" else 1), value)
        assert [value.item() for value in moved(steps)] == pytest.approx(expected)


def test_only_the_first_episode_counts() -> None:
    done = torch.tensor([[[False], [True], [False], [True]], [[False]] * 4])
    expected = [[True, True, False, False], [True] * 4]
    assert first_episode_mask(done).tolist() == first_episode_mask(done.squeeze(-1)).tolist() == expected


def test_vehicles_are_measured_each_on_its_own() -> None:
    alone = [
        episode([(50, 30)] * 4, point(200, 30), True, 4),
        episode([(30, 0), (40, 90)], point(50, 90), True, 4),
        episode([(10, 180)] * 4, point(300, 0), False, 4),
    ]
    together = episode_measures(torch.cat(alone))
    for index, one in enumerate(map(episode_measures, alone)):
        for key, value in one.items():
            torch.testing.assert_close(together[key][index : index + 1], value, equal_nan=True)


def test_spl_by_hand() -> None:
    """A detour, a path shorter than the geodesic, a failure, and a start at the destination."""
    success = torch.tensor([True, True, False, True])
    got = spl(success, torch.tensor([300.0, 300.0, 300.0, 100.0]), torch.tensor([400.0, 290.0, 300.0, 0.0]))
    assert got.tolist() == [0.75, 1.0, 0.0, 1.0]
    assert path_efficiency(torch.tensor([50.1, 10.0]), torch.tensor([50.0, 40.0])).tolist() == [1.0, 0.25]


def test_measures_of_ends_take_any_batch() -> None:
    """One degree of latitude at the equator is 110.5744 km; a twice as long path has half the efficiency."""
    start, end = torch.tensor([0.0, 10.0]).double().expand(3, 1, 2), torch.tensor([1.0, 10.0]).double().expand(3, 1, 2)
    one = torch.ones(3, 1)
    got = measured(Episode(one > 0, one, start, end, end, 2 * 110.5744 * one))
    expected = {"shortest_km": 110.5744, "navigation_error_km": 0, "spl": 0.5, "path_efficiency": 0.5}
    assert got.keys() == expected.keys() | {"success", "steps", "length_km"}
    for key, value in expected.items():
        torch.testing.assert_close(got[key].double(), torch.full((3, 1), value).double(), atol=1e-4, rtol=0)


def test_summary_by_hand() -> None:
    """Ten kilometers are within ten; of two values, a bootstrap draws both or neither; NaN is left out."""
    angles = dict.fromkeys(("smoothness_deg", "heading_mae_deg", "heading_rmse_deg"), torch.ones(2))
    episodes = angles | {"success": torch.tensor([True, False]), "steps": torch.tensor([10, 50])}
    episodes |= {"navigation_error_km": torch.tensor([10.0, 25.0]), "length_km": torch.tensor([500.0, 1000.0])}
    episodes |= {"spl": torch.tensor([0.8, 0.0]), "path_efficiency": torch.tensor([0.75, math.nan])}
    summary = summarize(episodes)
    expected = {"success_rate": 50, "success_rate_within_10km": 50, "success_rate_within_25km": 100, "num_trips": 2}
    expected |= {"trajectory_length_m": 500_000, "steps": 10, "navigation_error_km": 10, "spl": 40}
    expected |= {"spl_low": 0, "spl_high": 80} | {f"path_efficiency{end}": 75 for end in ("", "_low", "_high")}
    assert {key: summary[key] for key in expected} == pytest.approx(expected)
    low, high = wilson_interval(0.5, 2)
    assert (summary["success_rate_low"], summary["success_rate_high"]) == (100 * low, 100 * high)
    failed = summarize(episodes | {"success": torch.zeros(2) > 0, "path_efficiency": torch.full((2,), math.nan)})
    assert all(math.isnan(failed[key]) for key in ("steps", "path_efficiency", "path_efficiency_low"))


def test_bad_values_are_named() -> None:
    for call, message in (
        (lambda: episode_measures({}), "^rollout must be a TensorDictBase"),
        (lambda: episode_measures(TensorDict(batch_size=[2, 0])), r"each at least 1, got \(2, 0\)"),
        (lambda: summarize({"success": torch.ones(2)}), "success must be bool"),
        (lambda: summarize({"success": torch.ones(2, 2) > 0}), "success must be bool of shape"),
        (lambda: summarize({"success": torch.ones(0) > 0}), "success must be bool of shape"),
        *((partial(Scenario, zeta=zeta), f"^zeta must be greater than 0, got {zeta}$") for zeta in (0, -1)),
        (lambda: bootstrap_interval(torch.zeros(2, 2)), r"values must be of shape \(M,\).*\(2, 2\)"),
        (lambda: stratified_bootstrap([torch.ones(0)]), r"strata must each be of shape \(R,\)"),
        (lambda: stratified_bootstrap([]), r"strata must each be of shape \(R,\) with R >= 1, got \[\]"),
        (lambda: interquartile_mean(torch.zeros(2, 0)), r"values must be of shape \(\.\.\., R\).*\(2, 0\)"),
        (lambda: wilson_interval(1.01, 10), "rate must be a finite number from 0 up to 1, got 1.01"),
        (lambda: wilson_interval(-0.01, 10), "rate must be a finite number from 0 up to 1, got -0.01"),
        (lambda: wilson_interval(0.5, 0), "count must be a whole number from 1 on, got 0"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            call()


def test_wilson_interval_is_that_of_scipy() -> None:
    for count in (1, 2, 10, 499):
        for successes in {0, 1, count // 2, count}:
            expected = scipy.stats.binomtest(successes, count).proportion_ci(method="wilson")
            low, high = wilson_interval(successes / count, count)
            assert (low, high) == pytest.approx((expected.low, expected.high), abs=1e-5)
            assert 0 <= low <= high <= 1


def test_bootstrap_interval_of_a_known_spread() -> None:
    torch.manual_seed(0)
    values = torch.randn(2000, dtype=torch.float64)
    interval = bootstrap_interval(values)
    half = 1.96 * values.std().item() / math.sqrt(2000)
    assert interval == pytest.approx((values.mean().item() - half, values.mean().item() + half), abs=0.005)
    assert bootstrap_interval(values) == bootstrap_interval(values, 1000, 0) == interval


def scores(count: int, seed: int = 0) -> Tensor:
    return 99 - torch.rand(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) ** 2


def test_interquartile_mean_and_its_bootstrap_are_those_of_scipy() -> None:
    """The bootstrap of one stratum; both ends within the noise of 10 000 resamples."""
    for count in (1, 3, 4, 7, 20, 41):
        values = torch.stack([scores(count, seed) for seed in range(6)])
        expected = scipy.stats.trim_mean(values.numpy(), 0.25, axis=1)
        assert interquartile_mean(values).numpy() == pytest.approx(expected, abs=1e-12)
    assert interquartile_mean(torch.tensor([1.0, 2.0, 3.0, math.nan])).isnan()
    options = {"n_resamples": 10_000, "method": "percentile", "rng": 1}
    for values in (scores(5), scores(20)):
        drawn = scipy.stats.bootstrap(
            (values.numpy(),), lambda x, axis: scipy.stats.trim_mean(x, 0.25, axis), **options
        )
        assert stratified_bootstrap([values]) == pytest.approx(tuple(drawn.confidence_interval), abs=0.01)
    assert stratified_bootstrap([values], seed=1) != stratified_bootstrap([values]) == stratified_bootstrap([values])
    assert all(math.isnan(end) for end in stratified_bootstrap([torch.tensor([1.0, math.nan])]))


def test_stratified_bootstrap_draws_within_strata() -> None:
    """Two groups without any spread: every resample has as many of each, so that the mean is always the same."""
    low, high = torch.zeros(10), torch.full((10,), 100.0)
    assert stratified_bootstrap([low, high]) == (50, 50)
    pooled = stratified_bootstrap([torch.cat((low, high))])
    assert pooled[0] < 20
    assert pooled[1] > 80


@pytest.mark.parametrize("name", ["dead_reckoning", "secant", "kalman"])
def test_navigators_fly_running_episodes_alone(name: str) -> None:
    """As they do among those that have ended, with their memory and the errors of each vehicle."""
    told = {"errors": (0.05, 0.05, 5.0), "seed": 1, "max_steps": 30}
    told |= {"arrival": "declared", "model": "IGRF-13", "start_km": 5.0} if name == "dead_reckoning" else {}
    flight = Flight(first_trips(choose_trips(None, "paper-100"), 6), **told)
    navigator, seen = flight.navigator(name), []
    hook = navigator.register_forward_pre_hook(lambda _, args: seen.append(len(args[0])))
    found = evaluation_rollout(flight.env_of(navigator), navigator)
    hook.remove()
    env = flight.env_of(navigator)
    wanted = evaluation_rollout(env, lambda state: navigator(state))  # others may expect all vehicles
    done = found["next", "done"].squeeze(-1)
    assert seen == [6, *(~done).sum(0)[:-1].tolist()]
    assert seen[-1] < seen[0]
    assert done[:, -1].all()
    for key, values in episode_measures(wanted).items():
        torch.testing.assert_close(episode_measures(found)[key], values, rtol=1e-4, atol=1e-3, equal_nan=True)


def test_a_function_sees_all_vehicles_at_each_step() -> None:
    """Of arrays or of TensorDicts: what it remembers by itself has one row for each."""
    seen = []
    env = navigation_env(4, seed=0)

    def act(observations, *_):
        seen.append(len(observations))
        return np.ones((len(observations), 2)) * [[1.0, 0.0]], None

    done = evaluation_rollout(env, ArrayPolicy(act))["next", "done"].squeeze(-1)
    assert done[:, :-1].any()
    assert set(seen) == {4}


def test_pictures_of_an_evaluation_have_all_vehicles() -> None:
    env = GeomagneticNavEnv(num_envs=6, seed=0, render_mode="rgb_array")
    rollout = evaluation_rollout(env, Secant.for_env(env))
    assert rollout["next", "done"][:, :-1].any()
    assert torch.equal(env.track(5)[-1], rollout["next", "position"][5, -1])


@pytest.mark.parametrize("transform", [InitTracker(), CatFrames(4, dim=-1, in_keys=["field"], out_keys=["fields"])])
def test_transforms_of_the_size_of_the_batch_keep_all_vehicles(transform: Transform) -> None:
    env = TransformedEnv(GeomagneticNavEnv(num_envs=8, seed=3), transform.clone())
    done = evaluation_rollout(env, Secant())["next", "done"]
    assert done[:, :-1].any()
    assert done.any(1).all()


def test_an_action_of_another_shape_is_named() -> None:
    with pytest.raises(ValueError, match=r"the agent's action must be \(2, 2\), got \(2, 3\)"):
        evaluation_rollout(navigation_env(2, seed=0), lambda state: state.set("action", torch.zeros(2, 3)))
