"""Measures of hand-made episodes: a straight line, a right angle, a failure, one move, standing still."""

import math
from functools import partial

import pytest
import torch
from support.episodes import episode, point
from tensordict import TensorDict

from magrl.envs.measures import path_efficiency, path_measures, spl
from magrl.envs.scenario import check_zeta
from magrl.evaluation.intervals import wilson_interval
from magrl.evaluation.metrics import episode_measures, first_episode_mask, moved, summarize

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
