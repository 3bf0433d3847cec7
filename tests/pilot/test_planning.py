"""The plan of the next leg: what a reading will teach, against the belief after it, and what the plan weighs."""

from __future__ import annotations

import math

import pytest
import torch
from support.tracks import F64, STD, f64, randn
from torch import Tensor
from torch.autograd.functional import jacobian

from magrl.field.elements import elements_jacobian
from magrl.geodesy import geodesic, move
from magrl.pilot import planning
from magrl.pilot.belief import ANOMALY, CONSTANT, Belief, elements, moved, read, start
from magrl.pilot.destination import Destination, destination, mode, posterior
from magrl.pilot.displacement import DestinationPosterior
from magrl.pilot.forecast import covariance_after
from magrl.pilot.planning import planned_leg, step_price
from magrl.pilot.prior import DEGREE, closure
from magrl.sensor_std import SensorStd

RANGE_KM, KM = 300.0, f64(40.0)[0]
HERE = f64(8.0, -16.0, 35000.0)
NOISE = f64(*STD)
WHITE = SensorStd(NOISE)
SHIP = SensorStd(NOISE, f64(3.0, 0.5, 150.0), f64(2.9, 0.4, 140.0), f64(100.0, 100.0, 100.0))


def track(reading: Tensor, errors: SensorStd, legs: int, crust_nt: float = 0.0) -> Belief:
    """A belief after some legs of 40 km."""
    belief = start(reading, errors, f64(0.3)[0])
    for leg in range(legs):
        course = f64(0.3 + 1.2 * leg)[0]
        belief = moved(belief, KM, course, errors, crust_nt=crust_nt)
        belief = read(belief, elements(belief).value + 0.5 * NOISE, errors.noise, course)
    return belief


def goal_of(belief: Belief, errors: SensorStd, crust_nt: float = 0.0) -> Destination:
    """A destination 150 km away from the expected one."""
    target = elements(moved(belief, f64(150.0)[0], f64(-0.7)[0])).value
    return destination(belief, target + f64(0.1, 0.1, 20.0), RANGE_KM, crust_nt, errors)


def flown(reading: Tensor, errors: SensorStd, legs: int) -> Destination:
    return goal_of(track(reading, errors, legs), errors)


def polar(displacement: Tensor) -> tuple[Tensor, Tensor]:
    return displacement.norm(), torch.atan2(displacement[1], displacement[0])


def prediction(belief: Belief, displacement: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The field at its end: covariance, slopes ``(6,)`` by differences over 2 km, and theirs ``(6, 6)``."""

    def field(mean: Tensor, north: float, east: float) -> Tensor:
        return moved(belief._replace(mean=mean), *polar(displacement + f64(north, east))).field

    def slopes(mean: Tensor) -> Tensor:
        ends = [field(mean, *end) - field(mean, *(-x for x in end)) for end in ((1.0, 0.0), (0.0, 1.0))]
        return torch.cat(ends) / 2

    one, six = jacobian(lambda mean: field(mean, 0.0, 0.0), belief.mean), jacobian(slopes, belief.mean)
    return one @ belief.covariance @ one.mT, slopes(belief.mean), six @ belief.covariance @ six.mT


def flown_covariance(
    belief: Belief, goal: Destination, displacement: Tensor, leg: Tensor, errors: SensorStd, readings: int = 1
) -> Tensor:
    """The covariance of a displacement by the belief after a leg and the expected readings at its end."""
    origin = belief.latitude, torch.zeros((), dtype=F64)
    km, course = polar(leg)
    after = moved(belief, km, course, errors, crust_nt=goal.crust)
    for _ in range(readings):
        anomaly = elements_jacobian(after.field) @ after.mean[ANOMALY]
        after = read(after, elements(after).value + after.mean[CONSTANT] + anomaly, errors.noise, course)
    after = destination(after, f64(0.0, 60.0, 20000.0), RANGE_KM, goal.crust, errors).belief
    distance, bearing = geodesic(*move(*origin, course, km), *move(*origin, *polar(displacement)[::-1]))
    covariance, _, later = prediction(after, distance * torch.stack((bearing.cos(), bearing.sin())))
    _, slopes, now = prediction(goal.belief, displacement)
    square = (displacement - leg).square().sum() / 1000**2
    left_out = closure().left_out_nt ** 2 * square**DEGREE + goal.noise_at(square)
    precision = torch.linalg.inv(covariance + left_out * torch.eye(3, dtype=F64))
    squares = (slopes[:, None] * slopes + now - later).unflatten(0, (2, 3)).unflatten(-1, (2, 3)).transpose(1, 2)
    return torch.linalg.inv((precision * squares).sum((-2, -1)) + torch.eye(2, dtype=F64) / RANGE_KM**2)


def differs(found: Tensor, expected: Tensor) -> float:
    return float((found - expected).norm() / expected.norm())


@pytest.mark.parametrize("missing", [None, 0])
@pytest.mark.parametrize(("reading", "legs"), [(HERE, 0), (f64(-10.0, 60.0, 20000.0), 3)], ids=["start", "track"])
@pytest.mark.parametrize(("errors", "crust_nt"), [(WHITE, 0.0), (SHIP, 20.0)], ids=["white", "ship"])
def test_the_forecast_is_the_covariance_after_the_leg_is_flown(
    errors: SensorStd, crust_nt: float, reading: Tensor, legs: int, missing: int | None
) -> None:
    """By ``moved``, ``read`` and differences of what is predicted."""
    belief, tried = track(reading, errors, legs, crust_nt), f64((30.0, 0.0), (-10.0, 40.0))
    goal = goal_of(belief, errors, crust_nt)
    displacement = mode(goal).mean
    if missing is not None:
        errors = errors._replace(noise=NOISE.index_fill(0, torch.tensor([missing]), math.inf))
    for found, leg in zip(covariance_after(goal, displacement, tried, errors), tried, strict=True):
        assert differs(found, flown_covariance(belief, goal, displacement, leg, errors)) < 0.015


def test_the_forecast_averages_the_noise_of_many_readings() -> None:
    errors, leg = SensorStd(4 * NOISE), f64(20.0, -30.0)
    belief = track(HERE, errors, 2)
    goal = goal_of(belief, errors)
    displacement = mode(goal).mean
    one, six = covariance_after(goal, displacement, leg.expand(2, 2), errors, torch.tensor([1, 6]))
    assert differs(six, flown_covariance(belief, goal, displacement, leg, errors, readings=6)) < 0.02
    assert six.trace() < 0.8 * one.trace()


@pytest.mark.parametrize("errors", [WHITE, SHIP], ids=["white", "ship"])
def test_a_more_accurate_reading_never_increases_the_forecast(errors: SensorStd) -> None:
    """In any direction; a missing reading is the least accurate."""
    goal, legs = flown(HERE, errors, 1), 60 * randn(20, 2)
    displacement, stds = mode(goal).mean, (math.inf, 30.0, 3.0, 1.0, 0.3, 0.0)
    noises = [NOISE * std if std else 0 * NOISE for std in stds]
    after = torch.stack([covariance_after(goal, displacement, legs, errors._replace(noise=noise)) for noise in noises])
    assert torch.linalg.eigvalsh(after[:-1] - after[1:]).amin() > -1e-4 * after.norm()
    assert (after.diagonal(dim1=-2, dim2=-1).sum(-1)[1:].diff(dim=0) < 0).all()


def plan(goal: Destination, price_km: float, errors: SensorStd, **options: float) -> tuple[float, float]:
    """Length [km] of the leg, and its angle to the displacement [deg]."""
    points = posterior(goal)
    aim = points.displacement().mean.double()
    planned = planned_leg(goal, points, aim, errors, f64(price_km)[0], 50.0, **options)
    (length, course), (_, ahead) = polar(planned), polar(aim)
    return length.item(), abs(math.degrees(course - ahead))


def test_the_plan_weighs_steps_path_and_what_is_learned() -> None:
    """Cheap steps are short ones; where the distance across is unknown, a leg aside teaches it, more so with noise."""
    goal, noisy = flown(HERE, WHITE, 0), SensorStd(4 * NOISE)
    cheap, dear = plan(goal, 0.1, WHITE), plan(goal, 100.0, WHITE)
    assert plan(goal, 0.1, WHITE, caution=0.0) == pytest.approx((5.0, 0.0), abs=1e-4)
    assert 5 < cheap[0] < dear[0] == pytest.approx(50.0)
    assert cheap[1] > 9 > 1e-3 > dear[1]
    assert plan(flown(HERE, noisy, 0), 0.1, noisy)[1] > cheap[1] + 9
    assert plan(goal, 0.1, WHITE, caution=3.0)[0] > cheap[0]


def test_a_sure_displacement_is_gone_and_a_batch_is_its_parts() -> None:
    goal = flown(HERE, WHITE, 2)
    sure = goal._replace(belief=goal.belief._replace(covariance=1e-9 * goal.belief.covariance))
    aims, prices, apart = f64((-90.0, 120.0), (0.0, 30.0)), f64(3.0, 1.0), f64((0.0, 5.0), (0.0, -5.0))

    def planned(index: slice | int) -> Tensor:
        belief = Belief(*(torch.stack(parts)[index] for parts in zip(sure.belief, goal.belief, strict=True)))
        field, noise, crust, share = (part.expand(2, *part.shape)[index] for part in (goal.field, *goal[3:6]))
        here = Destination(belief, field, goal.range, noise, crust, share)
        points = aims[index].unsqueeze(-2) + apart + 100.0  # of which only the shape counts
        posterior = DestinationPosterior(points, torch.full(points.shape[:-1], 0.5, dtype=F64))
        return planned_leg(here, posterior, aims[index], WHITE, prices[index], 50.0)

    torch.testing.assert_close(planned(0), f64(-30.0, 40.0))
    torch.testing.assert_close(planned(slice(None)), torch.stack((planned(0), planned(1))))


def test_the_detour_by_hand() -> None:
    """400 km and 300 km across; at the place itself; and 80 km along 60 km, of which a fifth counts."""
    displacement, across = f64((400.0, 0.0), (0.0, 0.0), (60.0, 0.0)), torch.zeros(3, 2, 2, dtype=F64)
    across[:2, 1, 1], across[2, 0, 0] = 300.0**2, 5 * 80.0**2
    torch.testing.assert_close(planning._detour(displacement, across), f64(100.0, 300.0, 40.0))


def test_the_price_of_a_step_rises_as_steps_run_out() -> None:
    """Of 50 steps, 15 are for a distance of 500 km; a poor reading keeps some in reserve, and a missing one none."""

    def price(percent: object, range_km: float, distance_km: float, steps: Tensor, std: object) -> list[float]:
        return step_price(percent, range_km, f64(0.0, distance_km), steps, std, 50, 50.0).tolist()

    exact, steps = (0.0, 0.0, 0.0), torch.tensor([0, 10, 34, 49])
    assert price(0.5, 400.0, 500.0, steps, exact) == pytest.approx([2 * (50 / x) ** 4 for x in (35, 25, 1, 1)])
    percent, steps = f64(0.25, 4.0, 4.0), torch.tensor([25, 20, 30])
    expected = [0.5 * 2**4, 8 * (5 / 3) ** 2, 2 * 2.5**4]
    assert price(percent, 200.0, 0.0, steps, exact) == pytest.approx(expected)
    std = f64(exact, (1.0, 0.15, 20.0), (1.0, 1.0, 1000.0), (1e4, 1e4, 1e4))
    expected = [2 * (50 / x) ** 4 for x in (29, 25, 19, 29)]
    assert price(0.5, 400.0, 0.0, torch.tensor(21), std) == pytest.approx(expected)
