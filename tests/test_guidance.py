"""The paper's equations, each against a case worked by hand, in its limits, and in its symmetries."""

import math

import pytest
import torch
from support.tracks import f64, randn

from magrl.geodesy import wrap_angle
from magrl.guidance import (
    OBJECTIVE_FLOORS,
    alignment_reward,
    best_pair,
    destination_reward,
    late_decay,
    objective,
    objective_weights,
    parallel_approach,
    proximity_reward,
)

DTYPES = (torch.float32, torch.float64)
FLOORS = torch.tensor(OBJECTIVE_FLOORS, dtype=torch.float64)


# --- objective, Eq. (6) -----------------------------------------------------------------------------------------------


def test_weights_and_objective_worked_by_hand():
    """Of the differences 2 deg, -10 deg, 200 nT a half, a fifth and a tenth are left: F = 1/4 + 1/25 + 1/100."""
    start, target = f64(8.0, -16.0, 35000.0), f64(10.0, -26.0, 35200.0)
    weights = objective_weights(start, target, FLOORS)
    torch.testing.assert_close(weights, f64(1 / 4, 1 / 100, 1 / 40000), rtol=1e-14, atol=0)
    values = objective(
        torch.stack((f64(9.0, -24.0, 35180.0), start, target)), target.expand(3, 3), weights.expand(3, 3)
    )
    torch.testing.assert_close(values[:, 0], f64(0.3, 3.0, 0.0), rtol=0, atol=1e-12)
    start, target = f64(178.0, -16.0, 35000.0), f64(-178.0, -16.0, 35000.0)  # the shorter way around of D
    weights = objective_weights(start, target, FLOORS)
    assert float(objective(f64(-179.0, -16.0, 35000.0), target, weights)) == pytest.approx(1 / 16)


def test_small_differences_are_floored():
    """A difference of half the floor counts as the floor, one of twice the floor as itself; none is infinite."""
    start = f64(8.0, -16.0, 35000.0)
    for share, counted in ((0.0, 1.0), (0.5, 1.0), (-0.5, 1.0), (2.0, 2.0), (-2.0, 2.0)):
        target = start + 1000.0 + torch.diag(share * FLOORS - 1000.0)  # one element at a time
        weights = objective_weights(start, target, FLOORS).diagonal()
        torch.testing.assert_close(weights, (counted * FLOORS) ** -2, rtol=1e-9, atol=0)


# --- rewards, Eqs. (10) to (12) ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
def test_rewards_by_hand(dtype):
    assert destination_reward(torch.tensor([[True], [False]]), 200.0).tolist() == [[200.0], [0.0]]
    before, after = torch.tensor([3.0, 2.5, 1.0], dtype=dtype), torch.tensor([2.5, 3.0, 1.0], dtype=dtype)
    found = proximity_reward(before, after, 10.0)
    assert (found.dtype, found.tolist()) == (dtype, [5.0, -5.0, 0.0])
    step = torch.tensor([[1], [25], [26], [40], [50]])  # 25 is half way: not yet
    gain, loss = f64(4.0, 4.0, 4.0 * (1 - 0.52), 0.8, 0.0), f64(-4.0, -4.0, -4.0 * (1 + 0.52), -7.2, -8.0)
    late = late_decay(torch.tensor([4.0, -4.0, 0.0], dtype=dtype), step, 50)
    expected = torch.stack((gain, loss, torch.zeros_like(gain)), -1).to(dtype)
    torch.testing.assert_close(late, expected, rtol=0, atol=8 * torch.finfo(dtype).eps)
    odd = late_decay(torch.ones(2, dtype=dtype), torch.tensor([3, 4]), 7)
    torch.testing.assert_close(odd, f64(1.0, 3 / 7).to(dtype), rtol=0, atol=1e-7)


@pytest.mark.parametrize("limit", [0.1, 2.0, 50.0])
def test_a_limit_of_the_objective_leaves_no_gain_in_a_round_trip(limit):
    """A bound on F, unlike one on the reward, pays nothing for going away and coming back."""
    values = f64(3.0, 900.0, 40.0, 2.5, 3.0)
    found = proximity_reward(values[:-1], values[1:], 10.0, limit)
    assert found.abs().max() <= 10 * limit
    assert float(found.sum()) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("dtype", DTYPES)
def test_alignment(dtype):
    """Angle and reference of each row [deg], also across south and over a whole turn."""
    angle = f64(30, 75, 30, 170, -170, 180, -90, 350, 760)
    reference, deviation = f64(30, 30, 75, -170, 170, -180, 90, 10, 10), f64(0, 45, 45, 20, 20, 0, 180, 20, 30)
    found = alignment_reward(*(torch.deg2rad(x).to(dtype) for x in (angle, reference)), 3.0)
    expected = 3 * torch.deg2rad(45 - deviation).to(dtype)
    torch.testing.assert_close(found, expected, rtol=0, atol=60 * torch.finfo(dtype).eps)
    assert float(alignment_reward(f64(0.0), f64(1.0), 2.0, 0.0)) == -2.0


# --- parallel approach, Eq. (21) --------------------------------------------------------------------------------------


def approaches(count, seed):
    """Gradients of two elements that cross at 10 degrees or more, in units of 1e-3 to 1e3, and errors."""
    gradient, size = randn(4 * count, 2, 2, seed=seed), 10 ** randn(4 * count, 2, 1, seed=seed + 2).clamp(-3, 3)
    sine = torch.linalg.det(gradient).abs() / gradient.norm(dim=-1).prod(-1)
    return (size * gradient)[sine > math.sin(math.radians(10))][:count], randn(count, 2, seed=seed + 1)


def heading_of(error, gradient, offset=0.0):
    heading, valid = parallel_approach(torch.zeros_like(error) + offset, error + offset, gradient)
    assert valid.all()
    assert ((heading > -math.pi) & (heading <= math.pi)).all()
    return heading.squeeze(-1)


def test_approach_is_the_direction_of_the_inverse_in_any_axes_and_units():
    """In all quadrants, and on the axes themselves; it depends on the difference alone."""
    gradient, error = approaches(500, 2)
    angle = f64(0, 30, 90, 135, 180, -150, -90, -45).deg2rad()
    error[:8] = (gradient[:8] @ torch.stack((angle.cos(), angle.sin()), -1).unsqueeze(-1)).squeeze(-1)
    solved = torch.linalg.solve(gradient, error)
    heading = heading_of(error, gradient)
    assert wrap_angle(heading - torch.atan2(solved[:, 1], solved[:, 0])).abs().max() < 1e-12
    turn = torch.linspace(-3, 3, 500, dtype=torch.float64)
    axes = torch.stack((turn.cos(), -turn.sin(), turn.sin(), turn.cos()), -1).unflatten(-1, (2, 2))
    assert wrap_angle(heading - turn - heading_of(error, gradient @ axes)).abs().max() < 1e-9
    units = f64(1e-3, 1e3)
    assert wrap_angle(heading - heading_of(error * units, gradient * units.unsqueeze(-1))).abs().max() < 1e-9
    assert wrap_angle(heading - heading_of(error, gradient, 7.0)).abs().max() < 1e-6


@pytest.mark.parametrize("dtype", DTYPES)
def test_nearly_parallel_gradients_are_flagged(dtype):
    crossing = torch.deg2rad(f64(0.0, 1.9, 2.1, 90.0, 177.9, 178.1, 180.0, -1.9, -2.1))
    first = torch.stack((torch.ones_like(crossing), torch.zeros_like(crossing)), -1).expand(3, -1, -1)
    second = f64(1.0, 1e-4, 1e4).reshape(3, 1, 1) * torch.stack((crossing.cos(), crossing.sin()), -1)
    gradient = torch.stack((first, second), -2).to(dtype)
    here = torch.zeros(3, 9, 2, dtype=dtype)
    heading, valid = (x.squeeze(-1) for x in parallel_approach(here, here + 1, gradient))
    expected = torch.tensor([False, False, True, True, True, False, False, False, True])
    assert torch.equal(valid, expected.expand(3, 9))
    assert torch.equal(heading != 0, valid)
    for least_deg, crosses in ((0.0, True), (44.0, True), (46.0, False), (89.0, False)):
        slopes = torch.tensor([[1.0, 0.0], [1.0, 1.0]], dtype=dtype)
        _, valid = parallel_approach(here[0, 0], here[0, 0] + 1, slopes, min_crossing=math.radians(least_deg))
        assert bool(valid) == crosses


def test_an_approach_without_direction_is_heading_zero_and_flagged():
    """No slope, parallel slopes, or at the target; NaN is masked in its own vehicle."""
    zero, one, two, eye = [[0.0, 0.0]], [[1.0, 2.0]], [[2.0, 4.0]], [[1.0, 0.0], [0.0, 1.0]]
    nan = [[math.nan, 0.0], [0.0, 1.0]]
    gradient = torch.tensor([zero + zero, zero + one, one + zero, one + two, eye, nan, eye, eye])
    error = torch.tensor(
        [[1.0, 1.0], [1.0, 1.0], [1.0, 1.0], [1.0, 3.0], [0.0, 0.0], [1.0, 1.0], [math.nan, 1], [1, 1]]
    )
    heading, valid = (x.squeeze(-1) for x in parallel_approach(torch.zeros(8, 2), error, gradient))
    assert valid.tolist() == [False] * 7 + [True]
    assert not heading[:7].any()


def test_the_best_pair_crosses_nearest_to_a_right_angle():
    """Directions of the three gradients [deg]; 170 and 10 degrees cross at 20, as 10 and 30 do."""
    rows = {
        (0.0, 80.0, 45.0): [0, 1],
        (0.0, 30.0, 60.0): [0, 2],
        (0.0, 179.0, 89.0): [1, 2],
        (170.0, 10.0, 60.0): [0, 2],
        (0.0, 0.0, 0.0): [0, 1],
        (0.0, 90.0, -90.0): [0, 1],  # the first of two that are equal
    }
    angle = torch.deg2rad(f64(*rows).reshape(-1, 3))
    gradient = torch.stack((angle.cos(), angle.sin()), -1)
    for unit in (f64(1.0, 1.0, 1.0), f64(1e-3, 20.0, 5.0)):  # units do not matter
        assert best_pair(gradient * unit.unsqueeze(-1)).tolist() == list(rows.values())
    for missing, expected in enumerate(([1, 2], [0, 2], [0, 1])):
        for bad in (0.0, math.nan):
            gradient = f64(1.0, 0.0, 1.0, 1.0, 1.0, 2.0).reshape(3, 2)
            gradient[missing] = bad
            assert best_pair(gradient).tolist() == expected
