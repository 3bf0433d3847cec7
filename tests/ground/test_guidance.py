"""The paper's equations, each against a case worked by hand and in its limits."""

import math
from collections.abc import Callable

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


# --- objective, Eq. 2-6 -----------------------------------------------------------------------------------------------


def test_weights_and_objective_worked_by_hand():
    """Of the differences 2 deg, -10 deg, 200 nT a half, a fifth and a tenth are left: F = 1/4 + 1/25 + 1/100."""
    start, target = f64(8.0, -16.0, 35000.0), f64(10.0, -26.0, 35200.0)
    weights = objective_weights(start, target, FLOORS)
    torch.testing.assert_close(weights, f64(1 / 4, 1 / 100, 1 / 40000), rtol=1e-14, atol=0)
    found = objective(f64(9.0, -24.0, 35180.0), target, weights)
    torch.testing.assert_close(found, f64(0.25 + 0.04 + 0.01), rtol=1e-12, atol=0)
    assert float(objective(start, target, weights)) == pytest.approx(3.0, abs=1e-12)
    assert float(objective(target, target, weights)) == 0.0


def test_the_objective_takes_the_shorter_way_around_of_the_declination():
    start, target = f64(178.0, -16.0, 35000.0), f64(-178.0, -16.0, 35000.0)
    weights = objective_weights(start, target, FLOORS)
    assert float(weights[0]) == pytest.approx(1 / 16)
    assert float(objective(f64(-179.0, -16.0, 35000.0), target, weights)) == pytest.approx(1 / 16)


def test_small_differences_are_floored():
    """A difference of half the floor counts as the floor, one of twice the floor as itself; none is infinite."""
    start = f64(8.0, -16.0, 35000.0)
    for share, counted in ((0.0, 1.0), (0.5, 1.0), (-0.5, 1.0), (2.0, 2.0), (-2.0, 2.0)):
        target = start + 1000.0 + torch.diag(share * FLOORS - 1000.0)  # one element at a time
        weights = objective_weights(start, target, FLOORS).diagonal()
        torch.testing.assert_close(weights, (counted * FLOORS) ** -2, rtol=1e-9, atol=0)


# --- rewards, Eqs. 3-3 to 3-6 -----------------------------------------------------------------------------------------


def test_destination_pays_only_at_arrival():
    for shape in ((), (3,), (2, 3)):
        assert torch.equal(destination_reward(torch.ones(shape, dtype=torch.bool), 200.0), torch.full(shape, 200.0))
        assert torch.equal(destination_reward(torch.zeros(shape, dtype=torch.bool), 200.0), torch.zeros(shape))


@pytest.mark.parametrize("dtype", DTYPES)
def test_proximity_pays_what_the_objective_loses(dtype):
    before, after = torch.tensor([3.0, 2.5, 1.0], dtype=dtype), torch.tensor([2.5, 3.0, 1.0], dtype=dtype)
    found = proximity_reward(before, after, 10.0)
    assert found.dtype == dtype
    assert found.tolist() == [5.0, -5.0, 0.0]


@pytest.mark.parametrize("limit", [0.1, 2.0, 50.0])
def test_a_limit_of_the_objective_leaves_no_gain_in_a_round_trip(limit):
    """A bound on F, unlike one on the reward, pays nothing for going away and coming back."""
    values = f64(3.0, 900.0, 40.0, 2.5, 3.0)
    found = proximity_reward(values[:-1], values[1:], 10.0, limit)
    assert found.abs().max() <= 10 * limit
    assert float(found.sum()) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("dtype", DTYPES)
def test_late_gains_shrink_and_late_losses_grow(dtype):
    step = torch.tensor([[1], [25], [26], [40], [50]])  # 25 is half way: not yet
    gain = f64(4.0, 4.0, 4.0 * (1 - 0.52), 0.8, 0.0)
    loss = f64(-4.0, -4.0, -4.0 * (1 + 0.52), -7.2, -8.0)
    found = late_decay(torch.tensor([4.0, -4.0, 0.0], dtype=dtype), step, 50)
    expected = torch.stack((gain, loss, torch.zeros_like(gain)), -1).to(dtype)
    torch.testing.assert_close(found, expected, rtol=0, atol=8 * torch.finfo(dtype).eps)


def test_late_decay_of_an_odd_limit_starts_past_its_half():
    found = late_decay(torch.ones(2, dtype=torch.float64), torch.tensor([3, 4]), 7)
    torch.testing.assert_close(found, f64(1.0, 3 / 7), rtol=0, atol=1e-7)


@pytest.mark.parametrize("offset_deg", [45.0, 0.0])
@pytest.mark.parametrize("dtype", DTYPES)
def test_alignment(offset_deg, dtype):
    """Angle, reference and the deviation between them [deg]."""
    rows = f64(
        *(30.0, 30.0, 0.0),
        *(75.0, 30.0, 45.0),
        *(30.0, 75.0, 45.0),
        *(170.0, -170.0, 20.0),  # across south
        *(-170.0, 170.0, 20.0),
        *(180.0, -180.0, 0.0),
        *(-90.0, 90.0, 180.0),
        *(350.0, 10.0, 20.0),
        *(720.0 + 40.0, 10.0, 30.0),
    ).reshape(-1, 3)
    angle, reference, deviation = torch.deg2rad(rows).to(dtype).unbind(-1)
    found = alignment_reward(angle, reference, 3.0, math.radians(offset_deg))
    expected = 3 * (math.radians(offset_deg) - deviation)
    torch.testing.assert_close(found, expected, rtol=0, atol=60 * torch.finfo(dtype).eps)
    if offset_deg == 45:
        assert torch.equal(found, alignment_reward(angle, reference, 3.0))


# --- parallel approach, Eq. 3-15 --------------------------------------------------------------------------------------

# Rows: the two elements' slopes northward and eastward. The paper's box has about the first; the others have a
# determinant of the other sign, large and tiny slopes, and slopes that are all negative.
GRADIENTS = {
    "paper": ((0.0005, 0.002), (0.017, 0.001)),
    "positive": ((0.017, 0.001), (0.0005, 0.002)),
    "mixed units": ((3.0, -40.0), (2e-4, 1e-4)),
    "negative": ((-2.0, -1.0), (-1.0, -3.0)),
    "diagonal": ((1.0, 0.0), (0.0, -1.0)),
}


def approach_along(gradient, heading, distance=1.0):
    """The approach over errors that a displacement in direction ``heading`` would exactly remove."""
    displacement = distance * torch.stack((torch.cos(heading), torch.sin(heading)), -1)
    error = (gradient @ displacement.unsqueeze(-1)).squeeze(-1)
    here = torch.zeros_like(error)
    return parallel_approach(here, here + error, gradient)


@pytest.mark.parametrize("name", GRADIENTS)
def test_approach_points_at_the_destination_in_every_quadrant(name):
    gradient = torch.tensor(GRADIENTS[name], dtype=torch.float64)
    expected = torch.deg2rad(f64(0, 30, 90, 135, 180, -150, -90, -45))
    distance = f64(1.0, 1e-6, 1e4).reshape(3, 1, 1)
    heading, valid = (x.squeeze(-1) for x in approach_along(gradient, expected, distance))
    assert heading.shape == (3, 8)
    assert valid.all()
    assert ((heading > -math.pi) & (heading <= math.pi)).all()
    assert wrap_angle(heading - expected).abs().max() < 1e-12


def random_approaches(count, seed):
    """Gradients that cross at 10 degrees or more, and errors."""
    gradient = randn(4 * count, 2, 2, seed=seed)
    sine = torch.linalg.det(gradient).abs() / gradient.norm(dim=-1).prod(-1)
    return gradient[sine > math.sin(math.radians(10))][:count], randn(count, 2, seed=seed + 1)


def test_approach_is_the_direction_of_the_inverse():
    gradient, error = random_approaches(500, 2)
    solved = torch.linalg.solve(gradient, error)
    heading, valid = parallel_approach(torch.zeros_like(error), error, gradient)
    assert valid.all()
    assert wrap_angle(heading[:, 0] - torch.atan2(solved[:, 1], solved[:, 0])).abs().max() < 1e-12


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
    assert torch.isfinite(heading).all()
    assert torch.equal(heading != 0, valid)


def test_the_least_crossing_can_be_chosen():
    gradient, here = f64(1.0, 0.0, 1.0, 1.0).reshape(2, 2), torch.zeros(2, dtype=torch.float64)
    for least_deg, expected in ((0.0, True), (44.0, True), (46.0, False), (89.0, False)):
        _, valid = parallel_approach(here, here + 1, gradient, min_crossing=math.radians(least_deg))
        assert bool(valid) == expected


@pytest.mark.parametrize(
    ("gradient", "error"),
    [
        (((0.0, 0.0), (0.0, 0.0)), (1.0, 1.0)),
        (((0.0, 0.0), (1.0, 2.0)), (1.0, 1.0)),
        (((1.0, 2.0), (0.0, 0.0)), (1.0, 1.0)),
        (((1.0, 2.0), (2.0, 4.0)), (1.0, 3.0)),
        (((1.0, 0.0), (0.0, 1.0)), (0.0, 0.0)),
        (((-1.0, 0.0), (0.0, 1.0)), (0.0, 0.0)),
    ],
    ids=["none", "first none", "second none", "parallel", "on target", "on target, mirrored"],
)
@pytest.mark.parametrize("dtype", DTYPES)
def test_an_approach_without_direction_is_heading_zero_and_flagged(gradient, error, dtype):
    here = torch.zeros(2, dtype=dtype)
    heading, valid = parallel_approach(here, torch.tensor(error, dtype=dtype), torch.tensor(gradient, dtype=dtype))
    assert not bool(valid)
    assert float(heading) == 0


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
        found = best_pair(gradient * unit.unsqueeze(-1))
        assert found.dtype == torch.int64
        assert found.tolist() == list(rows.values())


@pytest.mark.parametrize("bad", [0.0, math.nan])
def test_a_gradient_that_is_zero_or_nan_is_not_of_the_best_pair(bad):
    for missing, expected in enumerate(([1, 2], [0, 2], [0, 1])):
        gradient = f64(1.0, 0.0, 1.0, 1.0, 1.0, 2.0).reshape(3, 2)
        gradient[missing] = bad
        assert best_pair(gradient).tolist() == expected


@pytest.mark.parametrize("function", [objective_weights, objective])
def test_elements_must_be_the_same(function):
    good = [torch.ones(2, 3)] * 3
    for k, shape in ((0, (2, 1)), (1, (2, 2)), (2, ())):
        with pytest.raises(
            ValueError,
            match=r"same elements, got field \(.*\), target_field \(.*\), \w+ \(",
        ):
            function(*[*good[:k], torch.ones(shape), *good[k + 1 :]])


@pytest.mark.parametrize("place", [0, 1, 2])
def test_nan_is_masked_in_its_own_vehicle(place):
    inputs = [torch.zeros(3, 2), torch.ones(3, 2), torch.eye(2).expand(3, 2, 2).clone()]
    inputs[place][1] = math.nan
    heading, valid = parallel_approach(*inputs)
    assert valid.squeeze(-1).tolist() == [True, False, True]
    assert heading[1] == 0


def test_approach_depends_on_the_difference_alone() -> None:
    here, there, gradient = (
        torch.tensor([3.0, -20.0]),
        torch.tensor([3.5, -19.0]),
        torch.tensor([[0.2, 0.1], [0.0, 1.5]]),
    )
    moved = parallel_approach(here + 7, there + 7, gradient)
    torch.testing.assert_close(parallel_approach(here, there, gradient), moved, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda: parallel_approach(torch.zeros(3), torch.zeros(2), torch.eye(2)), "field"),
        (lambda: parallel_approach(torch.zeros(2), torch.zeros(3), torch.eye(2)), "target_field"),
        (lambda: parallel_approach(torch.zeros(2), torch.zeros(2), torch.ones(3, 2)), "gradient"),
        (lambda: parallel_approach(torch.zeros(2), torch.zeros(2), torch.ones(2, 3)), "gradient"),
        (lambda: best_pair(torch.ones(3, 3)), "gradient"),
        (lambda: best_pair(torch.ones(1, 2)), "gradient"),
    ],
)
def test_a_wrong_size_is_named(call: Callable[[], object], name: str) -> None:
    with pytest.raises(ValueError, match=name):
        call()


def test_two_elements_have_one_pair() -> None:
    assert best_pair(torch.eye(2)).tolist() == [0, 1]
