"""The dual-control navigator: what it predicts, how it chooses, and how it flies."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv

from magrl import tracking
from magrl.envs import PRIVILEGED_KEYS, GeomagneticNavEnv, Scenario, task_set
from magrl.evaluation import episode_measures, evaluation_rollout, summarize
from magrl.evaluation.navigators import make_navigator
from magrl.navigators import NAVIGATORS, Kalman
from magrl.navigators.kalman import ANGLES_DEG, LENGTHS, _certainty, _detour, trade_off
from magrl.tracking import FieldTrack
from magrl.transforms import SensorNoise

F64 = torch.float64
NOISE = (0.05, 0.05, 5.0)
TASKS = task_set(100, seed=93)


def env(num_envs: int = 100, **options: object) -> GeomagneticNavEnv:
    return GeomagneticNavEnv(Scenario(tasks=TASKS), num_envs=num_envs, seed=0, start_heading="random", **options)


def seen_at(batch: int = 3) -> TensorDict:
    field = torch.tensor([8.0, -16.0, 35000.0]).expand(batch, 3)
    target = field + torch.tensor([[1.0, 4.0, 100.0], [-0.5, -3.0, 0.0], [0.3, 2.0, -200.0]])[:batch]
    keys = {"field": field, "target_field": target, "heading": torch.zeros(batch, 1), "move": torch.zeros(batch, 2)}
    return TensorDict(keys | {"step_count": torch.zeros(batch, 1, dtype=torch.int64)}, batch_size=batch)


def success_and_spl(base: GeomagneticNavEnv, navigator: Kalman, noise: tuple[float, ...]) -> tuple[float, float]:
    """Success rate and success weighted by path length [%], of the fixed tasks."""
    rollout = evaluation_rollout(TransformedEnv(base, SensorNoise(noise)) if any(noise) else base, navigator)
    measures = summarize(episode_measures(rollout))
    return measures["success_rate"], measures["spl"]


@pytest.mark.parametrize(
    ("noise", "success", "spl"), [((0.0, 0.0, 0.0), 99.0, 97.0), (NOISE, 97.0, 86.0), ((0.1, 0.1, 10.0), 93.0, 83.0)]
)
def test_it_arrives_without_a_map_with_and_without_noise(noise: tuple[float, ...], success: float, spl: float) -> None:
    found = success_and_spl(env(), Kalman(noise=noise), noise)
    assert found > (success, 0), found
    assert found[1] > spl, found


def test_it_reads_nothing_privileged() -> None:
    base = env(20)
    state = base.reset()
    scrambled = state.clone()
    for key in {*PRIVILEGED_KEYS} - {"region"}:
        scrambled[key] = torch.rand_like(state[key].double()).to(state[key].dtype)
    assert not set(Kalman().in_keys) & set(PRIVILEGED_KEYS)
    assert torch.equal(Kalman()(state)["action"], Kalman()(scrambled)["action"])


def test_the_predicted_covariance_is_that_of_the_filter_after_the_move() -> None:
    """Where the gradients are known, a move teaches nothing, and the formula is that of way_to in a linear field."""
    navigator = Kalman(noise=NOISE)
    slope = torch.tensor([[[0.1, 0.4, 0.2], [0.0, -0.2, 0.9], [0.0, 0.5, 0.5]]], dtype=F64) * 1e4
    covariance = 1e-4 * torch.eye(3, dtype=F64).expand(1, 3, 3, 3)
    track = FieldTrack(slope, covariance)
    moves, left = torch.tensor([[[20.0, 10.0]]], dtype=F64), torch.tensor([[[150.0, -40.0]]], dtype=F64)
    found = navigator._covariance_after(track, moves, left)
    moved = tracking.predict(track, moves[:, 0], (0.0, 0.0, 0.0), navigator.scales)
    scales = torch.tensor(navigator.scales, dtype=F64)
    after = tracking.update(moved, moved.mean[..., 0] * scales, navigator.noise, navigator.scales)
    target = (after.mean[..., 0] + after.mean[..., 1:] @ (left[0, 0] / 100)) * scales
    expected = tracking.way_to(after, target, navigator.range_km, navigator.scales).covariance
    torch.testing.assert_close(found[:, 0], expected, rtol=1e-3, atol=1e-9)


def test_a_crossing_move_is_worth_more_than_one_along_the_way() -> None:
    """After a straight leg, the gradients along it are known and those across it are not."""
    navigator = Kalman()
    seen = seen_at()
    memory = TensorDict(navigator.first_memory(seen), batch_size=3)
    track = FieldTrack(memory["mean"], memory["covariance"])
    leg = torch.tensor([[30.0, 0.0]], dtype=F64)
    track = tracking.predict(track, leg, navigator.curvature, navigator.scales)
    reading = track.mean[..., 0] * torch.tensor(navigator.scales, dtype=F64)
    track = tracking.update(track, reading, NOISE, navigator.scales)
    moves = torch.tensor([[[10.0, 0.0], [0.0, 10.0]]], dtype=F64).expand(3, 2, 2)
    left = torch.tensor([200.0, 200.0], dtype=F64) - moves
    along, across = navigator._covariance_after(track, moves, left).diagonal(dim1=-2, dim2=-1).sum(-1).unbind(-1)
    assert (across < 0.5 * along).all()


def test_the_detour_by_hand() -> None:
    way = torch.tensor([400.0, 0.0], dtype=F64)
    covariance = torch.diag(torch.tensor([0.0, 300.0**2], dtype=F64))  # all of it across the way
    torch.testing.assert_close(_detour(way, covariance), torch.tensor(100.0, dtype=F64))
    torch.testing.assert_close(_detour(0 * way, covariance), torch.tensor(300.0, dtype=F64))
    along = torch.diag(torch.tensor([40.0**2 * 2, 0.0], dtype=F64))
    torch.testing.assert_close(_detour(way * 30 / 400, along), torch.tensor(20.0, dtype=F64))  # half of it: 50 - 30


def test_the_certainty_by_hand() -> None:
    """The direction is off by 400 km in 300 km: 0.6 is the cosine."""
    way = torch.tensor([[0.0, 300.0], [300.0, 0.0]], dtype=F64)
    covariance = torch.diag(torch.tensor([400.0**2, 0.0], dtype=F64)).expand(2, 2, 2)
    torch.testing.assert_close(_certainty(way, covariance), torch.tensor([[0.6], [1.0]], dtype=F64))


def test_the_moves_that_are_compared() -> None:
    way = torch.tensor([[0.0, 20.0]], dtype=F64)
    moves = Kalman()._moves(way)
    assert moves.shape == (1, (len(LENGTHS) + 1) * len(ANGLES_DEG), 2)
    assert (moves[0] - way[0]).norm(dim=-1).min() < 1e-9  # the way itself
    assert moves.norm(dim=-1).min() == 0  # standing still
    assert moves.norm(dim=-1).max() == pytest.approx(50.0)


def test_the_price_of_a_step_by_hand() -> None:
    navigator = Kalman(max_steps=50, step_km=2.0)
    way = torch.tensor([[500.0, 0.0]], dtype=F64)  # 15 steps are reserved for it
    price = [float(navigator._price(way, torch.tensor([[step]]))) for step in (0, 10, 34, 49)]
    assert price == pytest.approx([2 * (50 / 35) ** 2, 2 * 2**2, 2 * 50**2, 2 * 50**2])


def test_more_noise_means_less_caution_and_dearer_steps() -> None:
    levels = [trade_off(noise) for noise in ((0, 0, 0), (0.02, 0.02, 2), NOISE, (0.1, 0.1, 10))]
    cautions, prices = zip(*levels, strict=True)
    assert list(cautions) == sorted(cautions, reverse=True)
    assert list(prices) == sorted(prices)
    assert levels[1] == pytest.approx((2.25, 2 / 3))  # 0.02 deg of I is 4/3 km


def test_by_name_it_takes_bounds_noise_and_step_limit_from_the_environment() -> None:
    base = GeomagneticNavEnv(num_envs=2, seed=0, max_steps=30, max_move_km=40.0, max_turn_deg=math.degrees(1.0))
    navigator = make_navigator("kalman", base, "paper", 0, noise=NOISE)
    assert "kalman" in NAVIGATORS
    assert isinstance(navigator, Kalman)
    assert (navigator.max_steps, navigator.max_move_km, navigator.max_turn_rad) == (30, 40.0, 1.0)
    assert (navigator.caution, navigator.step_km) == trade_off(NOISE)
    assert math.isfinite(float(navigator(base.reset())["action"].sum()))
