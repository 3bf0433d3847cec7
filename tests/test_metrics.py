"""Measures of hand-made journeys: a straight line, a right angle, a failure, one move, standing still."""

import math

import pytest
import torch
from tensordict import TensorDict

from magrl.geodesy import geodesic, move
from magrl.metrics import TrainingTally, bootstrap_interval, episode_measures, flown, summarise, wilson_interval


def journey(legs: list[tuple[float, float]], target: tuple[float, float], success: bool, steps: int) -> TensorDict:
    """A rollout ``(1, steps)`` from (-5, 165): legs of (km, heading in degrees), then the last state repeated."""
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
    """The point at a distance [km] and bearing [deg] from (-5, 165)."""
    origin = torch.tensor([-5.0, 165.0, math.radians(bearing), distance], dtype=torch.float64)
    latitude, longitude = move(*origin)
    return float(latitude), float(longitude)


def measures(*args, steps: int = 6) -> dict[str, float]:
    return {key: float(value) for key, value in episode_measures(journey(*args, steps=steps)).items()}


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


def test_a_pause_is_neither_a_turn_nor_a_deviation() -> None:
    got = measures([(50.0, 0.0), (0.0, 90.0), (50.0, 0.0)], point(100.0, 0.0), True)
    assert got["smoothness_deg"] == pytest.approx(180, abs=1e-4)
    assert got["heading_mae_deg"] == pytest.approx(0, abs=1e-3)


def test_a_short_move_is_a_move() -> None:
    got = measures([(0.01, 0.0), (0.02, 90.0)], point(100.0, 0.0), False)
    assert got["smoothness_deg"] == pytest.approx(90, abs=1e-3)


def test_only_the_first_episode_counts() -> None:
    done = torch.tensor([[[False], [True], [False], [True]], [[False]] * 4])
    assert flown(done).tolist() == flown(done.squeeze(-1)).tolist() == [[True, True, False, False], [True] * 4]


def test_a_rollout_of_one_step_is_one() -> None:
    got = measures([(40.0, 10.0)], point(100.0, 10.0), False, steps=1)
    assert got["shortest_km"] == pytest.approx(100, abs=1e-3)
    assert got["navigation_error_km"] == pytest.approx(60, abs=1e-3)


def test_vehicles_are_measured_each_on_its_own() -> None:
    alone = [
        journey([(50.0, 30.0)] * 4, point(200.0, 30.0), True, 4),
        journey([(30.0, 0.0), (40.0, 90.0)], point(50.0, 90.0), True, 4),
        journey([(10.0, 180.0)] * 4, point(300.0, 0.0), False, 4),
    ]
    together = episode_measures(torch.cat(alone))
    for index, one in enumerate(map(episode_measures, alone)):
        for key, value in one.items():
            torch.testing.assert_close(together[key][index : index + 1], value, equal_nan=True)


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
    summary = summarise(episodes)
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
    """Ten kilometres are within ten; the mean of two values, drawn anew, is one of them or between."""
    episodes = dict.fromkeys(("length_km", "smoothness_deg", "heading_mae_deg", "heading_rmse_deg"), torch.ones(2))
    episodes |= {"success": torch.tensor([True, True]), "steps": torch.tensor([9, 9])}
    summary = summarise(
        episodes | {"navigation_error_km": torch.tensor([10.0, 25.0]), "spl": torch.tensor([0.5, 0.75])}
    )
    assert (summary["success_rate_within_10km"], summary["success_rate_within_25km"]) == (50, 100)
    assert (summary["spl_low"], summary["spl_high"]) == (50, 75)


def test_summary_without_success_is_nan_and_not_zero() -> None:
    episodes = episode_measures(journey([(50.0, 180.0)] * 3, point(300.0, 0.0), False, 3))
    assert math.isnan(summarise(episodes)["steps"])
    assert summarise(episodes)["spl"] == 0


@pytest.mark.parametrize(
    ("rate", "count", "expected"),
    [(0.5, 10, (0.2366, 0.7634)), (0.0, 20, (0.0, 0.1611)), (1.0, 20, (0.8389, 1.0))],
)
def test_wilson_interval(rate: float, count: int, expected: tuple[float, float]) -> None:
    assert wilson_interval(rate, count) == pytest.approx(expected, abs=1e-4)


def test_wilson_interval_of_half_a_standard_error() -> None:
    """By hand: centre 0.2125, half-width 0.06447, both over 1.025."""
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


def steps(*ended: tuple[float, bool], running: int = 0, reward: float = 0.0) -> TensorDict:
    """Transitions of vehicles whose journeys end (return, success), and of some that fly on."""
    count = len(ended) + running
    following = TensorDict(
        reward=torch.full((count, 1), reward),
        episode_reward=torch.tensor([[value] for value, _ in ended] + [[7.0]] * running),
        success=torch.tensor([[success] for _, success in ended] + [[False]] * running),
        done=torch.tensor([[True]] * len(ended) + [[False]] * running),
        batch_size=[count],
    )
    return TensorDict(next=following, batch_size=[count])


def test_tally_splits_the_reward_and_averages_the_last_episodes() -> None:
    tally = TrainingTally(destination_weight=200.0, reward_scale=0.5, window=2)
    batch = steps((300.0, True), (100.0, False), running=1)
    batch["next", "reward"] = 0.5 * torch.tensor([[201.0], [1.0], [1.0]])
    tally.add(batch, torch.full((3, 1), 0.25))
    assert (tally.frames, tally.episodes) == (3, 2)
    row = tally.row()
    assert row["return"] == 200
    assert row["success_rate"] == 50
    assert row["reward_destination"] == pytest.approx(200 / 3, rel=1e-12)
    assert row["reward_alignment"] == pytest.approx(0.25)
    assert row["reward_proximity"] == pytest.approx(0.75)
    assert math.isnan(tally.row()["reward_proximity"])


def test_tally_adds_up_and_forgets_the_oldest_episodes() -> None:
    tally = TrainingTally(destination_weight=0.0, reward_scale=1.0, window=1)
    tally.add(steps((300.0, False), (100.0, True), running=2, reward=2.0), None)
    tally.add(steps((50.0, True), reward=4.0), None)
    assert (tally.frames, tally.episodes) == (5, 3)
    expected = {"return": 50, "success_rate": 100, "reward_destination": 0, "reward_proximity": 3}
    assert tally.row() == {**expected, "reward_alignment": 0}


def test_tally_averages_two_hundred_episodes() -> None:
    tally = TrainingTally(200.0, 1.0)
    for value in range(201):
        tally.add(steps((float(value), value > 100)), None)
    assert (tally.row()["return"], tally.row()["success_rate"]) == (100.5, 50)  # the first of them is forgotten


def test_tally_of_no_episode_is_nan() -> None:
    tally = TrainingTally(200.0, 1.0)
    tally.add(steps(running=3, reward=1.0), None)
    row = tally.row()
    assert math.isnan(row["return"])
    assert math.isnan(row["success_rate"])
    assert row["reward_proximity"] == 1


def test_tally_goes_on_from_its_state() -> None:
    one, other = TrainingTally(200.0, 1.0), TrainingTally(200.0, 1.0)
    one.add(steps((300.0, True), (100.0, False), running=1, reward=2.0), torch.ones(3, 1))
    other.load_state_dict(one.state_dict())
    for tally in (one, other):
        tally.add(steps((20.0, True), reward=4.0), torch.zeros(1, 1))
    assert (other.frames, other.episodes) == (one.frames, one.episodes) == (4, 3)
    assert other.row() == one.row()
