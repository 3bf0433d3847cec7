"""Measures of hand-made episodes: a straight line, a right angle, a failure, one move, standing still."""

import math

import pytest
import torch
from tensordict import TensorDict

from magrl.envs.measures import check_zeta, path_measures, spl
from magrl.evaluation.intervals import bootstrap_interval, wilson_interval
from magrl.evaluation.metrics import episode_measures, first_episode_mask, summarize
from magrl.geodesy import geodesic, move


def episode(legs: list[tuple[float, float]], target: tuple[float, float], success: bool, steps: int) -> TensorDict:
    """Return a rollout ``(1, steps)`` from (-5, 165): legs of (km, heading in degrees), then the last state."""
    rows, position = [], torch.tensor([-5.0, 165.0], dtype=torch.float64)
    start, end = position, torch.tensor(target, dtype=torch.float64)
    for index in range(steps):
        made = index < len(legs)
        distance, heading = legs[index] if made else legs[-1]
        heading_rad = torch.tensor(math.radians(heading), dtype=torch.float64)
        after = torch.stack(move(*position, heading_rad, torch.tensor(distance, dtype=torch.float64)))
        last = index >= len(legs) - 1
        following = {
            "position": after,
            "move": torch.tensor([distance, 0.0]),
            "heading": heading_rad.float().reshape(1),
            "success": torch.tensor([success and last]),
            "done": torch.tensor([last]),
        }
        rows.append(
            TensorDict(position=position, start_position=start, target_position=end, next=TensorDict(following))
        )
        position = after if made and not last else position
    return torch.stack(rows).unsqueeze(0)


def point(distance: float, bearing: float) -> tuple[float, float]:
    """Return the point at a distance [km] and bearing [deg] from (-5, 165)."""
    origin = torch.tensor([-5.0, 165.0, math.radians(bearing), distance], dtype=torch.float64)
    latitude, longitude = move(*origin)
    return float(latitude), float(longitude)


def measures(*args, steps: int = 6) -> dict[str, float]:
    return {key: float(value) for key, value in episode_measures(episode(*args, steps=steps)).items()}


def test_straight_line() -> None:
    got = measures([(50.0, 30.0)] * 4, point(200.0, 30.0), True)
    assert got["success"] == 1
    assert got["steps"] == 4
    assert got["length_km"] == pytest.approx(200)
    assert got["shortest_km"] == pytest.approx(200, abs=1e-3)
    assert got["spl"] == pytest.approx(1, abs=1e-5)
    assert got["navigation_error_km"] == pytest.approx(0, abs=0.1)
    assert got["smoothness_deg"] == pytest.approx(180, abs=1e-4)
    assert got["heading_mae_deg"] == pytest.approx(0, abs=0.2)  # the bearing turns a little along the geodesic


def test_right_angle() -> None:
    got = measures([(30.0, 0.0), (40.0, 90.0)], point(50.0, math.degrees(math.atan2(40, 30))), True)
    assert got["length_km"] == pytest.approx(70)
    assert got["spl"] == pytest.approx(50 / 70, rel=1e-3)
    assert got["smoothness_deg"] == pytest.approx(90, abs=1e-3)
    first = math.degrees(math.atan2(40, 30))  # then the second leg points straight at the target
    assert got["heading_mae_deg"] == pytest.approx(first / 2, abs=0.1)
    assert got["heading_rmse_deg"] == pytest.approx(first / math.sqrt(2), abs=0.1)


def test_failure_counts_nothing_towards_spl() -> None:
    got = measures([(50.0, 180.0)] * 6, point(300.0, 0.0), False)
    assert got["success"] == 0
    assert got["spl"] == 0
    assert got["steps"] == 6
    assert got["navigation_error_km"] == pytest.approx(600, rel=1e-3)
    assert got["heading_mae_deg"] == pytest.approx(180, abs=1e-3)


def test_one_move_has_no_waypoint() -> None:
    got = measures([(40.0, 10.0)], point(45.0, 10.0), True)
    assert got["steps"] == 1
    assert math.isnan(got["smoothness_deg"])
    assert got["spl"] == 1  # arrival is declared a little before the point: never more than the shortest path
    assert got["navigation_error_km"] == pytest.approx(5, abs=1e-3)


def test_arrival_without_leaving() -> None:
    got = measures([(0.0, 0.0)], point(10.0, 0.0), True)
    assert got["length_km"] == 0
    assert got["spl"] == 1
    assert math.isnan(got["heading_mae_deg"])


@pytest.mark.parametrize(("success", "distance", "expected"), [(True, 0.0, 1), (False, 0.0, 0), (True, 5.0, 0)])
def test_start_at_the_destination(success: bool, distance: float, expected: float) -> None:
    """An episode that has no way to go: not moving is the shortest path, moving is a detour."""
    got = measures([(distance, 0.0)], (-5.0, 165.0), success)
    assert (got["shortest_km"], got["spl"]) == (0, expected)
    assert got["navigation_error_km"] == pytest.approx(distance, abs=1e-6)


def test_spl_keeps_nan() -> None:
    """A length that is not known gives no success."""
    lengths = torch.tensor([math.nan, 1.0]), torch.tensor([1.0, math.nan])
    assert spl(torch.tensor([True, True]), *lengths).isnan().all()


def test_a_pause_is_neither_a_turn_nor_a_deviation() -> None:
    got = measures([(50.0, 0.0), (0.0, 90.0), (50.0, 0.0)], point(100.0, 0.0), True)
    assert got["smoothness_deg"] == pytest.approx(180, abs=1e-4)
    assert got["heading_mae_deg"] == pytest.approx(0, abs=1e-3)


def test_a_short_move_is_a_move() -> None:
    got = measures([(0.01, 0.0), (0.02, 90.0)], point(100.0, 0.0), False)
    assert got["smoothness_deg"] == pytest.approx(90, abs=1e-3)


def test_only_the_first_episode_counts() -> None:
    done = torch.tensor([[[False], [True], [False], [True]], [[False]] * 4])
    assert (
        first_episode_mask(done).tolist()
        == first_episode_mask(done.squeeze(-1)).tolist()
        == [[True, True, False, False], [True] * 4]
    )


def test_a_rollout_of_one_step_is_one() -> None:
    got = measures([(40.0, 10.0)], point(100.0, 10.0), False, steps=1)
    assert got["shortest_km"] == pytest.approx(100, abs=1e-3)
    assert got["navigation_error_km"] == pytest.approx(60, abs=1e-3)


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
    with pytest.raises(TypeError, match=r"success must be bool, got torch\.float32"):
        spl(torch.ones(1), torch.ones(1), torch.ones(1))
    with pytest.raises(TypeError, match="length_km must be a tensor"):
        spl(success, torch.ones(4), 5)


def test_path_measures_by_hand() -> None:
    """One degree of longitude at the equator is 111.3195 km; one degree of latitude there, 110.5744 km."""
    start, end, target = torch.tensor([[[0.0, 10.0]], [[0.0, 11.0]], [[1.0, 11.0]]], dtype=torch.float64)
    got = path_measures(torch.tensor([True]), start, end, end, torch.tensor([2 * 111.3195], dtype=torch.float64))
    assert [got[key].item() for key in ("shortest_km", "navigation_error_km", "spl")] == [
        pytest.approx(111.3195, abs=1e-4),
        pytest.approx(0, abs=1e-6),
        pytest.approx(0.5, abs=1e-6),
    ]
    got = path_measures(torch.tensor([False]), start, end, target, torch.tensor([111.3195]))
    assert got["navigation_error_km"].item() == pytest.approx(110.5744, abs=1e-4)
    assert (got["spl"].item(), got["length_km"].item()) == (0, pytest.approx(111.3195))
    with pytest.raises(ValueError, match=r"end must have the shape \(..., 2\)"):
        path_measures(torch.tensor([True]), start, torch.zeros(1, 3), target, torch.ones(1))


def test_summary_of_one_success_and_one_failure() -> None:
    episodes = {
        "success": torch.tensor([True, False]),
        "steps": torch.tensor([10, 50]),
        "shortest_km": torch.tensor([400.0, 400.0]),
        "length_km": torch.tensor([500.0, 1000.0]),
        "navigation_error_km": torch.tensor([8.0, 20.0]),
        "spl": torch.tensor([0.8, 0.0]),
        "smoothness_deg": torch.tensor([170.0, 90.0]),
        "heading_mae_deg": torch.tensor([5.0, 90.0]),
        "heading_rmse_deg": torch.tensor([6.0, 95.0]),
    }
    summary = summarize(episodes)
    assert summary["success_rate"] == 50
    assert summary["success_rate_within_10km"] == 50
    assert summary["success_rate_within_25km"] == 100
    assert summary["spl"] == pytest.approx(40)
    assert (summary["spl_low"], summary["spl_high"]) == pytest.approx((0, 80))  # of two values, both or neither
    assert summary["trajectory_length_m"] == 500_000
    assert summary["trajectory_length_m_all"] == 750_000
    assert (summary["steps"], summary["steps_all"]) == (10, 30)
    assert summary["navigation_error_km"] == 8
    assert summary["num_tasks"] == 2
    low, high = wilson_interval(0.5, 2)
    assert (summary["success_rate_low"], summary["success_rate_high"]) == (100 * low, 100 * high)


def test_summary_at_the_edge_of_a_distance_and_of_two_paths() -> None:
    """Ten kilometers are within ten; the mean of two values, drawn anew, is one of them or between."""
    episodes = dict.fromkeys(("length_km", "smoothness_deg", "heading_mae_deg", "heading_rmse_deg"), torch.ones(2))
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


def test_wilson_interval() -> None:
    for rate, count, expected in ((0.5, 10, (0.2366, 0.7634)), (0.0, 20, (0.0, 0.1611)), (1.0, 20, (0.8389, 1.0))):
        assert wilson_interval(rate, count) == pytest.approx(expected, abs=1e-4)


def test_wilson_interval_of_half_a_standard_error() -> None:
    """By hand: center 0.2125, half-width 0.06447, both over 1.025."""
    assert wilson_interval(0.2, 10, z=0.5) == pytest.approx((0.14442, 0.27021), abs=1e-5)


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


def test_bootstrap_interval_of_one_draw_is_that_draw() -> None:
    low, high = bootstrap_interval(torch.arange(10.0), resamples=1)
    assert low == high


def test_shortest_is_the_geodesic() -> None:
    target = (-8.0, 164.0)
    expected, _ = geodesic(*torch.tensor([-5.0, 165.0, *target], dtype=torch.float64))
    assert measures([(50.0, 0.0)], target, False)["shortest_km"] == pytest.approx(float(expected))


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: bootstrap_interval([1.0, 2.0]), TypeError, "values must be a tensor"),
        (lambda: bootstrap_interval(torch.zeros(0)), ValueError, r"values must be of shape \(M,\)"),
        (lambda: bootstrap_interval(torch.zeros(2, 2)), ValueError, r"values must be of shape \(M,\).*\(2, 2\)"),
        (lambda: bootstrap_interval(torch.ones(3), 0), ValueError, "resamples must be a whole number from 1 on, got 0"),
        (
            lambda: bootstrap_interval(torch.ones(3), 1.5),
            ValueError,
            "resamples must be a whole number from 1 on, got 1.5",
        ),
        (lambda: bootstrap_interval(torch.ones(3), 1, 0.5), ValueError, "seed must be a whole number, got 0.5"),
        (lambda: wilson_interval(1.01, 10), ValueError, "rate must be a finite number from 0 up to 1, got 1.01"),
        (lambda: wilson_interval(-0.01, 10), ValueError, "rate must be a finite number from 0 up to 1, got -0.01"),
        (lambda: wilson_interval(0.5, 0), ValueError, "count must be a whole number from 1 on, got 0"),
        (lambda: wilson_interval(0.5, 1.5), ValueError, "count must be a whole number from 1 on, got 1.5"),
        (lambda: wilson_interval(0.5, 10, z=0.0), ValueError, "z must be a finite number above 0, got 0"),
    ],
)
def test_intervals_refuse_bad_values(call, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        call()


def test_intervals_accept_their_bounds() -> None:
    assert bootstrap_interval(torch.ones(1), 1, -1) == (1.0, 1.0)
    for rate in (0.0, 1.0):
        low, high = wilson_interval(rate, 1)
        assert 0 <= low < high <= 1


def test_measures_refuse_what_they_cannot_use() -> None:
    flags, lengths, places = torch.ones(2, dtype=torch.bool), torch.ones(2), torch.zeros(2, 2)
    for call, error, message in (
        (lambda: check_zeta(3), ValueError, "zeta must be below 3, got 3: the objective F is at most 3"),
        (lambda: spl([True], lengths, lengths), TypeError, r"success must be a Tensor, got \[True\]"),
        (lambda: spl(flags.long(), lengths, lengths), TypeError, "success must be bool, got torch.int64"),
        (lambda: spl(flags, [1.0, 1.0], lengths), TypeError, "shortest_km must be a tensor"),
        (lambda: path_measures(flags, places[:, :1], places, places, lengths), ValueError, r"start .*\(2, 1\)"),
        (lambda: path_measures(flags, places, places[:, :1], places, lengths), ValueError, r"end .*\(2, 1\)"),
        (lambda: path_measures(flags, places, places, places[:, :1], lengths), ValueError, r"target .*\(2, 1\)"),
        (lambda: first_episode_mask([True]), TypeError, r"done must be a Tensor, got \[True\]"),
        (lambda: first_episode_mask(torch.zeros(2, 3)), ValueError, "done must be bool of shape"),
        (lambda: first_episode_mask(flags), ValueError, r"done must be bool of shape .*\(2,\)"),
        (lambda: first_episode_mask(flags.expand(1, 3, 2)), ValueError, r"done must be bool of shape .*\(1, 3, 2\)"),
    ):
        with pytest.raises(error, match=message):
            call()


def test_path_measures_of_batches_of_any_shape() -> None:
    """One value for each episode, whatever dimensions they are arranged in."""
    start, end, target = torch.rand(3, 4, 5, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    success, length = torch.ones(4, 5, dtype=torch.bool), torch.full((4, 5), 300.0, dtype=torch.float64)
    arranged = path_measures(success, start, end, target, length)
    flat = path_measures(*(x.flatten(0, 1) for x in (success, start, end, target, length)))
    for name, value in arranged.items():
        torch.testing.assert_close(value.flatten(), flat[name])
