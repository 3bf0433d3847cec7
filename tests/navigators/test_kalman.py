"""The dual-control navigator: what it predicts, how it chooses, and how it arrives."""

from __future__ import annotations

import math

import pytest
import torch
from support.tracks import F64, STD, f64
from torchrl.envs import TransformedEnv

from magrl import tracking
from magrl.envs import GeomagneticNavEnv, Scenario, task_set
from magrl.evaluation import episode_measures, evaluation_rollout, summarize
from magrl.navigators import Kalman
from magrl.navigators.kalman import ANGLES_DEG, LENGTHS, _certainty, _detour, trade_off
from magrl.tracking import FieldTrack
from magrl.transforms import SensorNoise


@pytest.mark.parametrize(
    ("std", "success", "spl"), [((0.0, 0.0, 0.0), 99.0, 97.0), (STD, 97.0, 86.0), ((0.1, 0.1, 10.0), 93.0, 83.0)]
)
def test_it_arrives_without_a_map_with_and_without_noise(std: tuple[float, ...], success: float, spl: float) -> None:
    scenario = Scenario(tasks=task_set(100, seed=93))
    base = GeomagneticNavEnv(scenario, num_envs=100, seed=0, start_heading="random")
    env = TransformedEnv(base, SensorNoise(std)) if any(std) else base
    found = summarize(episode_measures(evaluation_rollout(env, Kalman(sensor_std=std))))
    assert found["success_rate"] > success
    assert found["spl"] > spl


def test_the_predicted_covariance_is_that_of_the_filter_after_the_move() -> None:
    """Where the gradients are known, a move teaches nothing, and the formula is that of way_to in a linear field."""
    navigator = Kalman(sensor_std=STD)
    slope = 1e4 * f64(((0.1, 0.4, 0.2), (0.0, -0.2, 0.9), (0.0, 0.5, 0.5)))
    track = FieldTrack(slope, 1e-4 * torch.eye(3, dtype=F64).expand(1, 3, 3, 3))
    moves, left, scales = f64(((20.0, 10.0),)), f64(((150.0, -40.0),)), navigator.scales
    found = navigator._covariance_after(track, moves, left, navigator.sensor_std)
    moved = tracking.predict(track, moves[:, 0], (0.0, 0.0, 0.0), scales)
    after = tracking.update(moved, tracking.estimated_field(moved, scales), navigator.sensor_std, scales)
    target = (after.mean[..., 0] + after.mean[..., 1:] @ (left[0, 0] / 100)) * scales
    expected = tracking.way_to(after, target, navigator.range_km, scales).covariance
    torch.testing.assert_close(found[:, 0], expected, rtol=1e-3, atol=1e-9)


def test_a_crossing_move_is_worth_more_than_one_along_the_way() -> None:
    """After a straight leg, the gradients along it are known and those across it are not."""
    navigator, reading = Kalman(), f64((8.0, -16.0, 35000.0))
    scales = navigator.scales
    track = tracking.start(reading, navigator.prior(reading, reading), STD, scales)
    moved = tracking.predict(track, f64((30.0, 0.0)), navigator.curvature, scales)
    track = tracking.update(moved, tracking.estimated_field(moved, scales), STD, scales)
    moves = f64(((10.0, 0.0), (0.0, 10.0)))
    found = navigator._covariance_after(track, moves, f64(200.0, 200.0) - moves, navigator.sensor_std)
    along, across = found.diagonal(dim1=-2, dim2=-1).sum(-1)[0]
    assert across < 0.5 * along


def test_the_detour_and_the_certainty_by_hand() -> None:
    """400 km and 300 km across; the direction to a place in 300 km is off by 400 km: 0.6 is the cosine."""
    way, across = f64(400.0, 0.0), torch.diag(f64(0.0, 300.0**2))
    torch.testing.assert_close(_detour(way, across), f64(100.0)[0])
    torch.testing.assert_close(_detour(0 * way, across), f64(300.0)[0])
    along = torch.diag(f64(40.0**2 * 2, 0.0))
    torch.testing.assert_close(_detour(way * 30 / 400, along), f64(20.0)[0])  # half of it: 50 - 30
    ways, north = f64((0.0, 300.0), (300.0, 0.0)), torch.diag(f64(400.0**2, 0.0))
    torch.testing.assert_close(_certainty(ways, north.expand(2, 2, 2)), f64((0.6,), (1.0,)))


def test_the_moves_that_are_compared_and_the_price_of_a_step() -> None:
    navigator, way = Kalman(max_steps=50), f64((0.0, 20.0))
    moves = navigator._moves(way)
    assert moves.shape == (1, (len(LENGTHS) + 1) * len(ANGLES_DEG), 2)
    assert (moves[0] - way[0]).norm(dim=-1).min() < 1e-9  # the way itself
    assert moves.norm(dim=-1).min() == pytest.approx(5.0)
    assert moves.norm(dim=-1).max() == pytest.approx(50.0)
    navigator.step_km = 2.0
    price = [float(navigator._price(25 * way, torch.tensor([[step]]))) for step in (0, 10, 34, 49)]
    assert price == pytest.approx([2 * (50 / 35) ** 2, 2 * 2**2, 2 * 50**2, 2 * 50**2])  # 15 steps are for the way


def test_more_noise_means_less_caution_and_dearer_steps() -> None:
    levels = [trade_off(std) for std in ((0, 0, 0), (0.02, 0.02, 2), STD, (0.1, 0.1, 10))]
    cautions, prices = zip(*levels, strict=True)
    assert list(cautions) == sorted(cautions, reverse=True)
    assert list(prices) == sorted(prices)
    assert levels[1] == pytest.approx((2.25, 1 / 3))  # 0.02 deg of I is 4/3 km


def test_bad_options_are_refused() -> None:
    for options in ({"bias_std": (0.1, -0.1, 1.0)}, {"max_steps": 0}, {"zeta": math.nan}, {"range_km": 0.0}):
        with pytest.raises(ValueError, match=next(iter(options))):
            Kalman(**options)
