"""The decision to declare an arrival, of a vehicle that knows the gradients, against its errors by hand."""

from __future__ import annotations

import math

import pytest
import torch
from support.tracks import F64, f64, randn
from torch import Tensor

from magrl.envs import earth_scenario
from magrl.field import IGRF, elements_gradient_at
from magrl.pilot.belief import STATES, Belief, elements, moved, start
from magrl.pilot.decision import ArrivalDecision, Progress, approach, arrival_decision
from magrl.pilot.destination import destination, posterior
from magrl.pilot.displacement import DestinationPosterior
from magrl.sensor_std import SensorStd

RADIUS_KM, UNITS = 25.0, f64(1.0, 1.0, 100.0)
HERE = f64(0.0, 60.0, 20000.0)


def decide(
    north_km: float, noise: float, bias: float, left: int = 50, *, path: float = 400.0, places: Tensor | None = None
) -> tuple[ArrivalDecision, Tensor]:
    """The decision at a distance from the destination, with errors in units of degrees and 100 nT; and the gradient."""
    errors = SensorStd(noise * UNITS, bias * UNITS)
    belief = start(HERE, errors)
    rows = torch.eye(STATES, dtype=F64)[3:16]  # all but the field and the errors of readings
    cross = belief.covariance @ rows.mT
    exact = rows @ cross + 1e-9 * torch.diag((rows @ cross).diagonal())
    mean = belief.mean.index_add(0, torch.tensor([3]), f64(6000.0))  # D changes by 1 degree over 100 km eastward
    belief = Belief(mean, belief.covariance - cross @ torch.linalg.solve(exact, cross.mT), belief.place)
    target = elements(moved(belief, f64(north_km)[0], f64(0.0)[0])).value
    goal = destination(belief, target, 300.0)
    progress = Progress(f64(path)[0], f64(400.0, 0.0), torch.tensor(left), 0.5, 50.0)
    points = posterior(goal, 512)
    if places is not None:
        points = DestinationPosterior(places, torch.full_like(places[:, 0], 1 / len(places)))
    decided = arrival_decision(goal, points, errors, progress, RADIUS_KM)
    return decided, elements(belief).gradient


@pytest.mark.parametrize("bias", [0.1, 0.2])
def test_what_a_constant_error_leaves_is_all_that_can_be_attained(bias: float) -> None:
    """However long one reads: the probability of the radius under the inverse of G^T (b b^T)^-1 G."""
    decided, gradient = decide(5.0, 0.05, bias)
    scaled = gradient / (bias * UNITS).unsqueeze(-1)
    error = randn(50_000, 2) @ torch.linalg.cholesky(torch.linalg.inv(scaled.mT @ scaled)).mT
    attainable = (error.norm(dim=-1) <= RADIUS_KM).double().mean()
    assert decided.attainable.item() == pytest.approx(attainable.item(), abs=0.03)
    assert decided.probability < decided.attainable
    assert decide(5.0, 0.05, 0.0)[0].attainable > 0.99


@pytest.mark.parametrize(
    ("north_km", "noise", "declare"),
    [(5.0, 1e-3, True), (15.0, 1e-3, True), (60.0, 1e-3, False), (400.0, 1e-3, False), (5.0, 0.3, False)],
)
def test_it_declares_where_it_is_sure_and_goes_on_elsewhere(north_km: float, noise: float, declare: bool) -> None:
    decided, _ = decide(north_km, noise, 0.0)
    assert decided.declare.item() is declare
    assert (decided.probability > 0.99) == declare
    if noise < 0.1:
        assert decided.displacement.tolist() == pytest.approx([north_km, 0.0], abs=0.5)


def test_fewer_steps_are_worth_less_and_without_any_it_declares() -> None:
    decided = [decide(5.0, 0.3, 0.1, left)[0] for left in (0, 1, 4, 32)]
    assert [one.declare.item() for one in decided] == [True, False, False, False]
    worth, attainable = (torch.stack([getattr(one, name) for one in decided]) for name in ("worth", "attainable"))
    assert worth[0] == 0
    assert attainable[0] == decided[0].probability
    assert (worth.diff() > 0).all()
    assert (attainable.diff() > 0).all()


def test_a_place_that_is_not_possible_here_is_never_declared() -> None:
    """Also without steps left, where going on is worth nothing."""
    decided = decide(400.0, 1e-3, 0.0, left=0, places=f64((400.0, 0.0)))[0]
    assert (decided.probability, decided.worth) == (0, 0)
    assert not decided.declare.item()


def test_tails_of_the_posterior_and_the_price_on_a_detour_by_hand() -> None:
    """Three of five places are 5 km ahead, and a reading there would be exact: (1 + 3/5) / 2 is attainable.

    Steps cost more of the SPL of an arrival now where the path is twice as long as the straight line of 405 km.
    """
    places = f64((5.0, 0.0), (5.0, 0.0), (5.0, 0.0), (0.0, 100.0), (0.0, -100.0))
    decided = decide(5.0, 1e-3, 0.0, path=810.0, places=places)[0]
    assert decided.probability.item() == pytest.approx(0.6)
    assert decided.attainable.item() == pytest.approx(0.8)
    assert decided.worth.item() == pytest.approx(0.8 * (810 / 815 - 2 * 0.5 / 100 * (1 + 5 / 50)))


def test_a_vehicle_near_the_border_goes_nearer_as_far_as_readings_there_help() -> None:
    """24 km away: one that is sure needs to go no nearer than 0.8 of the radius. The least distance is half of the
    estimate's error, at most a quarter of the radius."""
    sure, unsure = decide(24.0, 1e-3, 0.0)[0], decide(24.0, 0.1, 0.2)[0]
    assert sure.stop_km.item() == pytest.approx(20.0)
    assert unsure.stop_km.item() == pytest.approx(6.25)  # the nearest place, as each estimate differs
    for noise, least in ((1e-3, 0.32), (0.02, 1.77), (0.1, 6.25)):
        assert decide(5.0, noise, 0.0)[0].stop_km.item() == pytest.approx(least, rel=0.05)
    near = decide(20.0, 0.1, 0.0)[0]
    assert 0.4 < near.probability < 0.7 < near.worth
    barely = near._replace(probability=near.worth)
    assert barely.declare.item()
    assert not barely._replace(worth=near.worth * 1.001).declare.item()


def test_the_approach_turns_where_it_is_if_the_destination_is_behind() -> None:
    displacement = f64((0.0, 30.0), (-30.0, 0.0), (0.0, -80.0))
    action = approach(displacement, torch.zeros(3, 1, dtype=F64), f64(4.0).expand(3, 1), 50.0, math.pi / 2)
    assert action.tolist() == [pytest.approx(row) for row in ([26, math.pi / 2], [0, math.pi / 2], [50, -math.pi / 2])]


@pytest.mark.parametrize(("survey", "right", "false"), [((0.1, 0.05, 30.0), 19, 3), ((0.05, 0.02, 10.0), 73, 3)])
def test_where_nothing_else_is_known_the_survey_bounds_arrivals(survey, right, false):
    """In percent of flights, by the best unbiased estimate, which knows the gradients and has sensors without errors
    (docs/onboard.md)."""
    variance = f64(*survey).square()
    target = earth_scenario(128, seed=5, distance_range_km=(300.0, 500.0)).random_trips(2000, seed=1).target
    gradient = elements_gradient_at(IGRF("2025-01-01"), target)
    covariance = torch.linalg.inv(gradient.mT @ (gradient / variance.unsqueeze(-1)))
    off_km = (randn(2000, 2, seed=0) @ torch.linalg.cholesky(covariance).mT).norm(dim=-1)
    near = (off_km < RADIUS_KM).double().mean(-1)
    claims = near >= 0.8
    assert 100 * (near * claims).mean() == pytest.approx(right, abs=1)
    assert 100 * ((1 - near) * claims).mean() == pytest.approx(false, abs=1)
