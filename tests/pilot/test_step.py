"""The step of a vehicle: rules, batches in which some vehicles begin, search, prices and declarations."""

from __future__ import annotations

import math

import pytest
import torch
from support.readings import first_reading, moved
from support.tracks import STD, f64
from tensordict import TensorDict
from torch import Tensor

from magrl.pilot import Reading, Rules, act, advance, begin, declaring, earth_model, step
from magrl.pilot.belief import Belief, start
from magrl.pilot.decision import ArrivalDecision
from magrl.pilot.displacement import Displacement
from magrl.pilot.local import COEFFICIENTS, slopes
from magrl.pilot.records import State
from magrl.pilot.search import VISITED, arrival_ellipse, unvisited, unvisited_yet, visit
from magrl.sensor_std import SensorStd
from magrl.transforms.track import reading_of

ERRORS = SensorStd(STD, (0.5, 0.3, 60.0), (0.3, 0.2, 30.0), (20.0, 20.0, 20.0))
RULES = Rules(range_km=350.0)


def reading(seen: TensorDict, number: int) -> Reading:
    """A reading with the same errors for each vehicle."""
    read = reading_of(seen.set("elapsed_steps", torch.full((len(seen), 1), number)))
    return read._replace(std=SensorStd(*(f64(*std).expand(len(seen), 3) for std in ERRORS)))


@pytest.fixture
def readings() -> tuple[Reading, Reading]:
    """Those of four vehicles at the start and after a leg."""
    first = first_reading()
    return reading(first, 0), reading(moved(first, 40.0, 0.3, f64(0.3, 0.5, 60.0)), 1)


@pytest.mark.slow
def test_a_step_traces_as_one_graph(readings) -> None:
    """A later reading, and the declaration."""
    rules = RULES.replace(arrival="declared")

    def decided(state: State, reading: Reading) -> Tensor:
        track = advance(rules, state, reading)
        return declaring(rules, track, reading, act(rules, track, reading))[0]

    given = begin(rules, readings[0]).state, readings[1]
    torch.testing.assert_close(torch.compile(decided, fullgraph=True, backend="eager")(*given), decided(*given))


def test_the_first_reading_counts_with_twice_its_noise(readings) -> None:
    std = readings[0].std
    wanted = start(readings[0].field, std._replace(noise=2 * std.noise), readings[0].heading)
    found = begin(RULES, readings[0]).state.beliefs
    without_anomaly = Belief(found.mean[:, 0], found.covariance[:, 0], found.place[:, 0])
    torch.testing.assert_close(without_anomaly, wanted, rtol=0.02, atol=0.1, equal_nan=True)  # it may be a spike


def test_the_error_of_a_leg_turns_with_its_heading() -> None:
    """10 km along and 1 km across a leg to the east, and to the northeast."""
    found = step._leg_covariance(f64(10.0, 1.0).expand(2, 2), f64(math.pi / 2, math.pi / 4))
    expected = torch.stack((f64((1.0, 0.0), (0.0, 100.0)), f64((50.5, 49.5), (49.5, 50.5))))
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6)


def test_an_unknown_displacement_carries_the_slope_of_the_field(readings) -> None:
    """The covariance of the coefficients grows by the slopes times that of the displacement."""
    belief, square = begin(RULES, readings[0]).state.belief, torch.diag(f64(9.0, 4.0))
    slope = slopes(belief.mean[..., :COEFFICIENTS], belief.place)
    grown = (step.displaced(belief, square).covariance - belief.covariance)[..., :COEFFICIENTS, :COEFFICIENTS]
    torch.testing.assert_close(grown, slope @ square @ slope.mT, rtol=1e-6, atol=1e-6)
    assert grown.diagonal(dim1=-2, dim2=-1)[..., 0].min() > 0


def test_the_accuracy_of_a_reading_is_as_the_readings_show_it(readings) -> None:
    state = advance(RULES, begin(RULES, readings[0]).state, readings[1]).state
    noisier = state._replace(log_ratio=0 * state.log_ratio + math.log(4), readings=0 * state.readings + 100)
    assert (noisier.noise.factor > 1.5).all()
    found, stated = step._accuracy(noisier, readings[1]).noise, readings[1].std.noise
    torch.testing.assert_close(found, stated * noisier.noise.factor)


def test_a_spike_in_the_first_reading_hardly_counts(readings) -> None:
    """Of a vehicle that knows its place: 100 standard deviations move the field by less than five."""
    seen = readings[0]._replace(place=PLACE.expand(4, 2), target_place=(PLACE + 3).expand(4, 2))
    exact = MODEL.elements(PLACE.expand(4, 2))
    still, hit = (begin(Rules(**KNOWN), seen._replace(field=exact + f64((0.0, off, 0.0)))) for off in (0.0, 5.0))
    assert ((hit.local.value - still.local.value)[:, 1].abs() < 5 * STD[1]).all()


MODEL, PLACE = earth_model("IGRF-14", "2025-01-01"), f64(5.0, 20.0)
KNOWN = {"model": MODEL, "start_km": 5.0, "target_km": 5.0}


@pytest.mark.parametrize(("rule", "known"), [("distance", {}), ("declared", {}), ("distance", KNOWN)])
def test_a_place_without_an_arrival_is_left(rule: str, known: dict[str, object]) -> None:
    """A vehicle that is told of its arrival, and has not arrived where the destination seems to be, aims elsewhere; but
    where the place of the destination is known."""
    seen, rules, place = first_reading(), RULES.replace(arrival=rule, **known), PLACE.expand(4, 2)
    seen["field"] = MODEL.elements(place)
    seen["target_field"] = seen["field"].clone()
    still = moved(seen, 0.1, 0.0, f64(0.0, 0.0, 0.0))
    first, second = (reading(*one)._replace(place=place, target_place=place) for one in ((seen, 0), (still, 1)))
    track = advance(rules, begin(rules, first).state, second)
    apart = (track.aim - track.displacement.mean).norm(dim=-1)
    assert (apart > 5).all() if rules.signaled and not known else (apart == 0).all()


def test_each_vehicle_may_have_its_own_price_of_a_step(readings) -> None:
    """With a higher price legs are longer; without caution they are nearer to the displacement."""
    own = begin(RULES, readings[0]._replace(price=f64(0.1, 0.1, 30.0, 30.0)))
    cheap, dear, careless = (
        begin(RULES.replace(step_price=price, caution=caution), readings[0]).plan
        for price, caution in ((0.1, 0.3), (30.0, 0.3), (0.1, 0.0))
    )
    torch.testing.assert_close(own.plan, torch.cat((cheap[:2], dear[2:])))
    assert (cheap.norm(dim=-1) < dear.norm(dim=-1) - 10).any()
    ahead, aside = (torch.cosine_similarity(plan, own.displacement.mean) for plan in (careless, cheap))
    assert ahead.mean() > aside.mean() + 0.05


def test_it_goes_to_the_estimated_place_where_that_is_near(readings, monkeypatch) -> None:
    """20 km to the east of a vehicle that heads north, at a probability that is worth no declaration; and 30 km.

    Where it is near enough, 10 km to the west, it turns to read on another heading. The fourth declares.
    """
    near = f64((0.0, 20.0), (0.0, 30.0), (0.0, -10.0), (0.0, 0.0))
    sure, worth = f64(0.1, 0.1, 0.1, 0.7), f64(0.5, 0.5, 0.5, 0.5)
    decision = ArrivalDecision(sure, worth, sure, near, torch.full((4,), 12.0))
    monkeypatch.setattr(step, "arrival_decision", lambda *_: decision)
    seen = readings[0]._replace(heading=f64(0.0, 0.0, 0.0, 0.0))
    action = f64((50.0, -1.0)).expand(4, 2)
    sent, quarter = declaring(RULES, begin(RULES, seen), seen, action)[0], math.pi / 2
    expected = [[20.0 - 12.0, quarter, -1.0], [50.0, -1.0, -1.0], [0.0, quarter, -1.0], [0.0, 0.0, 1.0]]
    torch.testing.assert_close(sent, f64(*expected))
    sent = declaring(RULES.replace(confidence=0.8), begin(RULES, seen), seen, action)[0]
    assert sent[:, 2].tolist() == [-1.0] * 4


WRONG = {"max_leg_km": 0.0, "max_turn_rad": 4.0, "max_steps": 0, "zeta": math.nan, "arrival": "guessed"}
WRONG |= {"radius_km": -1.0, "confidence": 2.0, "range_km": math.inf, "target_std": (0.0, -1.0, 0.0), "step_price": 0.0}
WRONG |= {"caution": -0.1, "search": True, "start_km": 5.0, "target_km": 5.0}  # the last without a model


@pytest.mark.parametrize("name", WRONG)
def test_rules_out_of_range_are_named(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        Rules(**{name: WRONG[name]})


LONG = torch.tensor([[36.0, 200.0], [200.0, 2500.0]])  # [km^2]: 6 km northward, 50 km eastward, correlated
ELLIPSE = torch.diag(torch.tensor([1 / 20.0**2, 1 / 12.0**2]))


def searched(destinations: torch.Tensor, legs: int) -> torch.Tensor:
    """Which of some destinations are found, by vehicles that start at the mean of what is known and go where told."""
    count = len(destinations)
    here, visited = torch.zeros(count, 2), visit(unvisited_yet(torch.zeros(count, 3)), torch.zeros(count, 2))
    found = torch.zeros(count, dtype=torch.bool)
    for _ in range(legs):
        left = destinations - here
        found |= (left.unsqueeze(-2) @ ELLIPSE @ left.unsqueeze(-1)).flatten() <= 1
        step = unvisited(Displacement(-here, LONG.expand(count, 2, 2)), visited, ELLIPSE.expand(count, 2, 2))
        here, visited = here + step, visit(visited, step)
    return found


def test_a_search_finds_nearly_all_that_the_estimate_allows() -> None:
    normal = torch.randn(2000, 2, generator=torch.Generator().manual_seed(0))
    destinations = normal @ torch.linalg.cholesky(LONG).mT
    found = searched(destinations, 1).float().mean(), searched(destinations, 16).float().mean()
    assert found[0] < 0.3
    assert found[1] > 0.9  # the samples reach to two standard deviations


def test_the_mean_is_the_displacement_until_the_vehicle_has_been_there() -> None:
    mean = torch.tensor([100.0, -80.0])
    for nearest, expected in ((19.9, False), (20.1, True)):
        visited = unvisited_yet(torch.zeros(3))
        visited[5] = mean + torch.tensor([nearest, 0.0])
        assert torch.equal(unvisited(Displacement(mean, LONG), visited, ELLIPSE), mean) == expected


@pytest.mark.parametrize("north", [1000.0, -1000.0])
def test_of_places_as_probable_the_nearer_is_searched(north: float) -> None:
    """The mean has been visited, and the estimate is wide along the displacement to it."""
    mean, visited = torch.tensor([north, 0.0]), unvisited_yet(torch.zeros(3))
    visited[0] = mean
    found = unvisited(Displacement(mean, torch.diag(torch.tensor([400.0**2, 1.0]))), visited, ELLIPSE)
    assert found.norm() < 1000 - 20


def test_short_legs_do_not_fill_the_memory() -> None:
    visited = visit(unvisited_yet(torch.zeros(3)), torch.tensor([30.0, 0.0]))
    for _ in range(2 * VISITED):
        visited = visit(visited, torch.tensor([0.0, 0.5]))
    assert (visited.norm(dim=-1) < 1e3).sum() == 1
    visited = visit(visited, torch.tensor([0.0, 40.0]))
    assert visited[:2].tolist() == [[0.0, 0.0], [0.0, -40.0]]


def test_the_ellipse_shrinks_with_the_uncertainty_of_the_gradient() -> None:
    """The expected square of g·d is that of the mean plus the variance: here 1 + 3 along the first axis."""
    gradient, covariance = torch.tensor([[1.0, 2.0]]), torch.diag(torch.tensor([3.0, 5.0])).expand(4, 1, 2, 2)
    found = arrival_ellipse(gradient, covariance, torch.tensor([0.5]))
    torch.testing.assert_close(found, 0.5 * torch.tensor([[4.0, 2.0], [2.0, 9.0]]).expand(4, 2, 2))
    circle = arrival_ellipse(gradient, covariance, torch.tensor([0.5]), 25.0)
    torch.testing.assert_close(circle, torch.eye(2).expand(4, 2, 2) / 625)
