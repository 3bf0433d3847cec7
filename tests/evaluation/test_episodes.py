"""Rollouts, their measures on hand-made episodes, and intervals against hand-worked cases and SciPy."""

from __future__ import annotations

import itertools
import math
from functools import partial

import pytest
import scipy.stats
import torch
from support.episodes import episode, point
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType
from torchrl.modules import ProbabilisticActor, TanhNormal

from magrl import Anywhere
from magrl.agents import FieldPolicy, PolicyConfig
from magrl.envs import GeomagneticNavEnv, Scenario, Tasks, named_tasks
from magrl.envs.measures import path_efficiency, path_measures, spl
from magrl.envs.scenario import check_zeta
from magrl.evaluation import episode_measures, evaluate, evaluation_rollout, summarize
from magrl.evaluation.episodes import (
    bootstrap_interval,
    first_episode_mask,
    interquartile_mean,
    moved,
    stratified_bootstrap,
    wilson_interval,
)
from magrl.evaluation.navigators import fitted
from magrl.evaluation.scenarios import choose_tasks, first_tasks
from magrl.navigators import Secant
from magrl.transforms import SensorErrors


def test_every_task_is_flown_once_however_many_vehicles_fly() -> None:
    tasks = named_tasks("paper-100")
    together, batches = (evaluate("secant", tasks, num_envs=number) for number in (None, 30))
    assert together.shape == batches.shape == (100,)
    for key in ("shortest_km", "length_km", "spl"):
        torch.testing.assert_close(together[key], batches[key])
    assert torch.equal(together["steps"], batches["steps"])
    assert together["shortest_km"].unique().numel() == 100
    recipe = summarize(together)
    assert recipe["num_tasks"] == 100
    assert recipe["success_rate"] > 98


def test_batches_have_errors_of_their_own_that_repeat() -> None:
    """The same task in three batches has other noise and another start heading; the same call has the same."""
    tasks = named_tasks("figure-4-1")
    thrice = Scenario().with_tasks(Tasks(tasks.start.repeat(3, 1), tasks.target.repeat(3, 1)))
    for options in ({"errors": (0.05, 0.05, 5.0)}, {"start_heading": "random"}):
        one, again = (
            evaluate("secant", thrice, num_envs=1, max_steps=5, **options)["smoothness_deg"] for _ in range(2)
        )
        assert torch.equal(one, again)
        assert one.unique().numel() == 3
    perfect = evaluate("secant", thrice, num_envs=1, max_steps=5)
    torch.testing.assert_close(perfect["length_km"], perfect["length_km"][:1].expand(3))
    ship = evaluate("secant", thrice, errors="ship", max_steps=5)
    assert (ship["steps"] <= 5).all()


def test_a_stochastic_policy_is_evaluated_without_exploration() -> None:
    """Twice with the same actions, those of the mode of its distribution."""
    network = TensorDictModule(lambda move: (0 * move, 0 * move + 2.0), ["move"], ["loc", "scale"])
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
    episodes = [evaluate(policy, "figure-4-1", max_steps=4)["length_km"] for _ in range(2)]
    assert torch.equal(*episodes)


def test_what_cannot_be_evaluated_is_refused() -> None:
    agent = FieldPolicy(PolicyConfig(GeomagneticNavEnv(seed=0).observation_view(), (8,)))
    elsewhere = Scenario(region={"latitude": (40, 50), "longitude": (0, 10)}, objective_floors=None)
    elsewhere = elsewhere.with_tasks(elsewhere.random_tasks(2, seed=0))
    for call, error, message in (
        (lambda: evaluate("secant", Scenario()), ValueError, "the scenario has no tasks to fly"),
        (
            lambda: evaluate("secant", "figure-4-1", errors="yacht"),
            ValueError,
            "conditions must be one of 'laboratory'",
        ),
        (lambda: evaluate(agent, elsewhere), ValueError, "trained"),
        (lambda: evaluate(agent, "figure-4-1", max_turn_deg=20), ValueError, "up to 90°, the environment .* and 20°"),
        (lambda: evaluate(5, "figure-4-1"), TypeError, "policy must be callable"),
    ):
        with pytest.raises(error, match=message):
            call()


@pytest.mark.parametrize("options", [{"arrival": "declared"}, {"max_move_km": 20, "zeta": 0.02}])
def test_a_pretrained_policy_flies_as_by_its_name(options: dict) -> None:
    """Within the limits of the environment, which it gets from `evaluate`, or from a loop of one's own."""
    scenario = first_tasks(choose_tasks(None, "paper-100"), 3)
    policy, options = Anywhere(), {"max_steps": 6, **options}
    flights = (evaluate(agent, scenario, errors=(0.05, 0.05, 5.0), **options) for agent in ("anywhere", policy))
    named, given = flights
    assert all(torch.equal(named[key], given[key]) for key in named.keys())  # noqa: SIM118
    base = GeomagneticNavEnv(scenario, num_envs=3, seed=0, **options)
    env = TransformedEnv(base, SensorErrors((0.05, 0.05, 5.0)))
    with torch.no_grad():
        own = env.rollout(6, fitted(policy, base), break_when_any_done=False, break_when_all_done=True)
    assert torch.equal(episode_measures(own)["length_km"], named["length_km"])


def test_a_vehicle_without_a_finite_action_fails_alone() -> None:
    """The others fly as they do without it."""

    def broken(tensordict: TensorDict) -> TensorDict:
        hurt = (tensordict["elapsed_steps"] == 2) & (tensordict["target_position"] == target).all(-1, keepdim=True)
        action = secant(tensordict)["action"]
        return tensordict.set("action", torch.where(hurt, math.nan, action))

    secant, target = Secant(), named_tasks("paper-100").target[3]
    with pytest.warns(UserWarning, match=r"not finite: vehicles \[3\] stopped"):
        episodes = evaluate(broken, "paper-100")
    sound, others = evaluate("secant", "paper-100"), torch.arange(100) != 3
    assert not episodes["success"][3]
    for key in ("success", "length_km", "steps"):
        assert torch.equal(episodes[key][others], sound[key][others]), key


TOLERANCES = {"heading_mae_deg": 0.2, "heading_rmse_deg": 0.1, "navigation_error_km": 0.1}
TURN = math.degrees(math.atan2(40, 30))


def check(legs: list[tuple[float, float]], target: tuple[float, float], arrived: bool, **expected: float) -> None:
    got = episode_measures(episode(legs, target, arrived, steps=6))
    for key, value in expected.items():
        assert float(got[key]) == pytest.approx(value, abs=TOLERANCES.get(key, 1e-4), nan_ok=True), key


def test_straight_line() -> None:
    """The bearing turns a little along the geodesic."""
    lengths = {"length_km": 200, "navigation_error_km": 0, "spl": 1, "path_efficiency": 1}
    angles = {"smoothness_deg": 180, "heading_mae_deg": 0}
    check([(50.0, 30.0)] * 4, point(200.0, 30.0), True, success=1, steps=4, **lengths, **angles)


def test_right_angle() -> None:
    """The second leg points straight at the target."""
    angles = {"smoothness_deg": 90, "heading_mae_deg": TURN / 2, "heading_rmse_deg": TURN / math.sqrt(2)}
    check([(30.0, 0.0), (40.0, 90.0)], point(50.0, TURN), True, length_km=70, spl=50 / 70, **angles)


def test_failure_counts_nothing_towards_spl() -> None:
    """Straight, but away."""
    expected = {"success": 0, "spl": 0, "steps": 6, "path_efficiency": 1, "navigation_error_km": 600}
    check([(50.0, 180.0)] * 6, point(300.0, 0.0), False, heading_mae_deg=180, **expected)


def test_one_move_has_no_waypoint() -> None:
    """Arrival is declared a little before the point: never more than the shortest path."""
    check([(40.0, 10.0)], point(45.0, 10.0), True, steps=1, smoothness_deg=math.nan, spl=1, navigation_error_km=5)


def test_arrival_without_leaving() -> None:
    nothing = dict.fromkeys(("heading_mae_deg", "path_efficiency"), math.nan)
    check([(0.0, 0.0)], point(10.0, 0.0), True, length_km=0, spl=1, **nothing)


def test_path_efficiency_is_that_of_the_way_made() -> None:
    """There and back again: 20 km away after 80 km, whatever the destination; never above 1 by rounding."""
    for target, success in (((20.0, 0.0), True), ((300.0, 90.0), False)):
        check([(50.0, 0.0), (30.0, 180.0)], point(*target), success, path_efficiency=0.25)
    assert path_efficiency(torch.tensor([50.1, 10.0]), torch.tensor([50.0, 40.0])).tolist() == [1.0, 0.25]


@pytest.mark.parametrize(("success", "distance", "expected"), [(True, 0.0, 1), (False, 0.0, 0), (True, 5.0, 0)])
def test_start_at_the_destination(success: bool, distance: float, expected: float) -> None:
    """An episode that has no way to go: not moving is the shortest path, moving is a detour."""
    check([(distance, 0.0)], (-5.0, 165.0), success, shortest_km=0, spl=expected, navigation_error_km=distance)


def test_a_pause_is_neither_a_turn_nor_a_deviation() -> None:
    legs = [(50.0, 0.0), (0.0, 90.0), (50.0, 0.0)]
    check(legs, point(100.0, 0.0), True, smoothness_deg=180, heading_mae_deg=0)


def test_moves_of_less_than_a_kilometer_have_a_heading() -> None:
    check([(0.5, 0.0), (0.5, 90.0)], point(300.0, 0.0), False, smoothness_deg=90, length_km=1)


def test_moves_over_the_ground_are_the_true_ones() -> None:
    """Those of the errors of motion, or else of the north reference, or else those that were commanded."""
    steps = TensorDict(move=torch.tensor([[1.0, 0.0]]), heading=torch.tensor([[0.1]]))
    for key, value, expected in (
        ("heading", 0.1, (1.0, 0.1)),
        ("true_heading", 0.2, (1.0, 0.2)),
        ("true_course", 0.3, (1.0, 0.3)),
        ("true_move", 4.0, (4.0, 0.3)),
    ):
        steps[key] = torch.full((1, 2 if key == "true_move" else 1), value)
        assert [value.item() for value in moved(steps)] == pytest.approx(expected)


def test_only_the_first_episode_counts() -> None:
    done = torch.tensor([[[False], [True], [False], [True]], [[False]] * 4])
    expected = [[True, True, False, False], [True] * 4]
    assert first_episode_mask(done).tolist() == first_episode_mask(done.squeeze(-1)).tolist() == expected


def test_vehicles_are_measured_each_on_its_own() -> None:
    alone = [
        episode([(50.0, 30.0)] * 4, point(200.0, 30.0), True, 4),
        episode([(30.0, 0.0), (40.0, 90.0)], point(50.0, 90.0), True, 4),
        episode([(10.0, 180.0)] * 4, point(300.0, 0.0), False, 4),
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
    for measure in (partial(spl, success), path_efficiency):
        with pytest.raises(TypeError, match=r"^length_km must be a tensor"):
            measure(torch.ones(4), 5)
        with pytest.raises(TypeError, match="_km must be a tensor"):
            measure(5, torch.ones(4))


def test_path_measures_by_hand() -> None:
    """One degree of longitude at the equator is 111.3195 km; one degree of latitude there, 110.5744 km."""
    start, end, target = torch.tensor([[[0.0, 10.0]], [[0.0, 11.0]], [[1.0, 11.0]]], dtype=torch.float64)
    got = path_measures(torch.tensor([True]), start, end, end, torch.tensor([2 * 111.3195], dtype=torch.float64))
    expected = {"shortest_km": 111.3195, "navigation_error_km": 0, "spl": 0.5, "path_efficiency": 0.5}
    assert {key: got[key].item() for key in expected} == pytest.approx(expected, abs=1e-4)
    got = path_measures(torch.tensor([False]), start, end, target, torch.tensor([111.3195]))
    assert got["navigation_error_km"].item() == pytest.approx(110.5744, abs=1e-4)
    assert (got["spl"].item(), got["length_km"].item()) == (0, pytest.approx(111.3195))
    tables = [place.expand(3, 1, 2) for place in (start, end, target)]
    assert path_measures(torch.ones(3, 1) > 0, *tables, torch.ones(3, 1))["navigation_error_km"].shape == (3, 1)
    for index, name in enumerate(("start", "end", "target")):
        places = [start, end, target]
        places[index] = torch.zeros(1, 3)
        with pytest.raises(ValueError, match=rf"^{name} must have the shape \(..., 2\)"):
            path_measures(torch.tensor([True]), *places, torch.ones(1))


def test_summary_of_one_success_and_one_failure() -> None:
    episodes = {
        "success": torch.tensor([True, False]),
        "steps": torch.tensor([10, 50]),
        "shortest_km": torch.tensor([400.0, 400.0]),
        "length_km": torch.tensor([500.0, 1000.0]),
        "navigation_error_km": torch.tensor([8.0, 20.0]),
        "spl": torch.tensor([0.8, 0.0]),
        "path_efficiency": torch.tensor([0.75, math.nan]),
        "smoothness_deg": torch.tensor([170.0, 90.0]),
        "heading_mae_deg": torch.tensor([5.0, 90.0]),
        "heading_rmse_deg": torch.tensor([6.0, 95.0]),
    }
    summary = summarize(episodes)
    assert (summary["spl_low"], summary["spl_high"]) == pytest.approx((0, 80))  # of two values, both or neither
    assert [summary[f"path_efficiency{end}"] for end in ("", "_low", "_high")] == [75, 75, 75]  # one of them moved
    expected = {"success_rate": 50, "success_rate_within_10km": 50, "success_rate_within_25km": 100, "num_tasks": 2}
    expected |= {"trajectory_length_m": 500_000, "steps": 10}
    assert summary.items() >= (expected | {"navigation_error_km": 8}).items()
    assert summary["spl"] == pytest.approx(40)
    low, high = wilson_interval(0.5, 2)
    assert (summary["success_rate_low"], summary["success_rate_high"]) == (100 * low, 100 * high)


def test_summary_at_the_edge_of_a_distance_and_of_two_paths() -> None:
    """Ten kilometers are within ten; the mean of two values, drawn anew, is one of them or between."""
    ones = ("length_km", "smoothness_deg", "heading_mae_deg", "heading_rmse_deg", "path_efficiency")
    episodes = dict.fromkeys(ones, torch.ones(2))
    episodes |= {"success": torch.tensor([True, True]), "steps": torch.tensor([9, 9])}
    summary = summarize(
        episodes | {"navigation_error_km": torch.tensor([10.0, 25.0]), "spl": torch.tensor([0.5, 0.75])}
    )
    assert (summary["success_rate_within_10km"], summary["success_rate_within_25km"]) == (50, 100)
    assert (summary["spl_low"], summary["spl_high"]) == (50, 75)


def test_summary_without_success_is_nan_and_not_zero() -> None:
    episodes = episode_measures(episode([(50.0, 180.0)] * 3, point(300.0, 0.0), False, 3))
    assert math.isnan(summarize(episodes)["steps"])
    assert summarize(episodes)["spl"] == 0
    nowhere = {**episodes, "path_efficiency": torch.full((1,), math.nan)}
    assert all(math.isnan(summarize(nowhere)[f"path_efficiency{end}"]) for end in ("", "_low", "_high"))


def test_bad_values_are_named() -> None:
    for call, message in (
        (lambda: episode_measures(TensorDict(batch_size=[2, 0])), r"each at least 1, got \(2, 0\)"),
        (lambda: summarize({"success": torch.ones(2)}), "success must be bool"),
        (lambda: summarize({"success": torch.ones(2, 2) > 0}), "success must be bool of shape"),
        (lambda: summarize({"success": torch.ones(0) > 0}), "success must be bool of shape"),
        *((partial(check_zeta, zeta), f"^zeta must be a finite number above 0, got {zeta}$") for zeta in (0, -1)),
    ):
        with pytest.raises(ValueError, match=message):
            call()
    with pytest.raises(TypeError, match=r"^rollout must be a TensorDictBase"):
        episode_measures({})


def test_wilson_interval() -> None:
    for rate, count, expected in ((0.5, 10, (0.2366, 0.7634)), (0.0, 20, (0.0, 0.1611)), (1.0, 20, (0.8389, 1.0))):
        assert wilson_interval(rate, count) == pytest.approx(expected, abs=1e-4)


def test_wilson_interval_stays_within_all_and_nothing() -> None:
    assert all(wilson_interval(1.0, count)[1] <= 1 for count in range(1, 500))
    assert all(wilson_interval(0.0, count)[0] >= 0 for count in range(1, 500))


def test_bootstrap_interval_of_a_known_spread() -> None:
    torch.manual_seed(0)
    values = torch.randn(2000, dtype=torch.float64)
    low, high = bootstrap_interval(values)
    half = 1.96 * values.std().item() / math.sqrt(2000)
    assert low == pytest.approx(values.mean().item() - half, abs=0.005)
    assert high == pytest.approx(values.mean().item() + half, abs=0.005)
    assert bootstrap_interval(values) == bootstrap_interval(values, 1000, 0) == (low, high)


def test_interquartile_mean_by_hand() -> None:
    """A quarter of 4, 5 and 20 values is 1, 1 and 5; of fewer than 4 nothing is left out."""
    assert interquartile_mean(torch.tensor([10.0, 1.0, 2.0, 0.0])).item() == 1.5
    assert interquartile_mean(torch.tensor([[-90.0, 1.0, 2.0, 3.0, 90.0], [1.0, 1.0, 1.0, 9.0, 9.0]])).tolist() == [
        2,
        pytest.approx(11 / 3),
    ]
    assert interquartile_mean(torch.arange(20.0) ** 2).item() == sum(x * x for x in range(5, 15)) / 10
    assert interquartile_mean(torch.tensor([1.0, 2.0, 9.0])).item() == 4
    assert interquartile_mean(torch.tensor([1.0, 2.0, 3.0, math.nan])).isnan()


def test_interquartile_mean_is_that_of_scipy() -> None:
    for count in (1, 3, 4, 7, 20, 41):
        values = torch.rand(6, count, generator=torch.Generator().manual_seed(count), dtype=torch.float64)
        expected = scipy.stats.trim_mean(values.numpy(), 0.25, axis=1)
        assert interquartile_mean(values).numpy() == pytest.approx(expected, abs=1e-12)


def scores(count: int, seed: int = 0) -> Tensor:
    return 99 - torch.rand(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) ** 2


def test_stratified_bootstrap_is_that_of_scipy() -> None:
    """Of one stratum; both ends within the noise of 10 000 resamples."""
    values = scores(20)
    options = {"n_resamples": 10_000, "method": "percentile", "rng": 1}
    expected = scipy.stats.bootstrap((values.numpy(),), lambda x, axis: scipy.stats.trim_mean(x, 0.25, axis), **options)
    assert stratified_bootstrap([values]) == pytest.approx(tuple(expected.confidence_interval), abs=0.01)


def test_stratified_bootstrap_draws_within_strata() -> None:
    """Two groups without any spread: every resample has as many of each, so that the mean is always the same."""
    low, high = torch.zeros(10), torch.full((10,), 100.0)
    assert stratified_bootstrap([low, high]) == (50, 50)
    pooled = stratified_bootstrap([torch.cat((low, high))])
    assert pooled[0] < 20
    assert pooled[1] > 80


def test_stratified_bootstrap_shrinks_holds_the_mean_and_repeats() -> None:
    widths = []
    for count in (5, 20, 80, 320):
        values = scores(count)
        low, high = stratified_bootstrap([values])
        assert low < interquartile_mean(values).item() < high
        assert stratified_bootstrap([values]) == (low, high)
        widths.append(high - low)
    ratios = [after / before for before, after in itertools.pairwise(widths)]
    assert stratified_bootstrap([values], seed=1) != (low, high)
    assert all(0.3 < ratio < 0.75 for ratio in ratios), ratios  # four times the runs, half the width
    assert all(math.isnan(end) for end in stratified_bootstrap([torch.tensor([1.0, math.nan])]))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: bootstrap_interval(torch.zeros(2, 2)), r"values must be of shape \(M,\).*\(2, 2\)"),
        (lambda: stratified_bootstrap([torch.ones(0)]), r"strata must each be of shape \(R,\)"),
        (lambda: interquartile_mean(torch.zeros(2, 0)), r"values must be of shape \(\.\.\., R\).*\(2, 0\)"),
        (lambda: stratified_bootstrap([]), r"strata must each be of shape \(R,\) with R >= 1, got \[\]"),
        (lambda: wilson_interval(1.01, 10), "rate must be a finite number from 0 up to 1, got 1.01"),
        (lambda: wilson_interval(-0.01, 10), "rate must be a finite number from 0 up to 1, got -0.01"),
        (lambda: wilson_interval(0.5, 0), "count must be a whole number from 1 on, got 0"),
    ],
)
def test_bad_values_are_refused(call, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()
