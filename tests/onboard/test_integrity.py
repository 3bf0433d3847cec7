"""Claims of a vehicle with integrity: two more estimates on the same legs, and what they say against an arrival."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from support.tracks import f64
from torch.distributions import MultivariateNormal

from magrl.field import IGRF, elements_at
from magrl.geodesy import geodesic, move_place
from magrl.onboard import Command, Onboard
from magrl.onboard.integrity import NAMES, PRIOR, Hypothesis, objection
from magrl.pilot import Rules
from magrl.pilot.belief import PLACE
from magrl.pilot.records import State
from magrl.sensor_std import SensorStd
from magrl.transforms import TrackField

DATE, START = "2025-01-01", (-30.0, 20.0)
STD = SensorStd(noise=(0.02, 0.02, 2.0), bias=(0.3, 0.15, 30.0), drift=(0.05, 0.02, 5.0))


def at(north_km: float, off_km: float = 0.0) -> tuple[float, float]:
    """The place so far north of the start, and of a place so far west of it."""
    place = move_place(move_place(f64(*START), f64(-1.5708)[0], f64(off_km)[0]), f64(0.0)[0], f64(north_km)[0])
    return tuple(place.tolist())


def sailed(legs: int, off_km: float = 0.0, integrity: bool = True, **known: Any) -> tuple[Onboard, list[Command]]:
    """Legs of 30 km northward, from a start that is so far west of the stated one."""
    options, field = {"drift": 0.03, "radius_km": 25.0}, IGRF(DATE)
    options = {name: known.pop(name, value) for name, value in options.items()}
    vehicle = Onboard("kalman", sensor_std=STD, integrity=integrity, **options)
    vehicle.start(at(240.0), START, **{"date": DATE, "start_km": 5.0} | known)
    readings = [elements_at(field, f64(*at(30.0 * n, off_km))).tolist() for n in range(legs)]
    return vehicle, [vehicle.step(*read, heading=0.0, distance=30.0 * (n > 0)) for n, read in enumerate(readings)]


def part(states: State | None, index: int) -> State:
    assert states is not None
    return State(*(value[index] for value in states))


@pytest.mark.parametrize(("index", "known"), [(0, {}), (1, {"start_km": 100.0}), (2, {"drift": 0.1})], ids=str)
def test_each_estimate_is_that_of_a_vehicle_with_such_a_start_or_drift(index: int, known: dict[str, float]) -> None:
    vehicles = sailed(3)[0], sailed(3, **known)[0]
    for vehicle in vehicles:
        vehicle.fix(*at(62.0), 9.0)
        vehicle.retarget(at(150.0, -60.0))
        vehicle.step(None, -65.0, None, heading=45.0, distance=20.0)
    found, expected = part(vehicles[0]._states, index), part(vehicles[1]._states, 0)
    for name, value, other in zip(State._fields, found, expected, strict=True):
        torch.testing.assert_close(value, other, rtol=1e-6, atol=1e-6, msg=name)


def normal(vehicle: Onboard, index: int, there: tuple[float, float], std_km: float = 0.0) -> MultivariateNormal:
    """Of the displacement from a place to the vehicle by a hypothesis."""
    belief = part(vehicle._states, index).belief
    distance, bearing = geodesic(*f64(*there), *belief.place)
    mean = distance * torch.stack((bearing.cos(), bearing.sin()))
    return MultivariateNormal(mean, belief.covariance[PLACE, PLACE] + std_km**2 / 2 * torch.eye(2))


def test_the_arrival_by_a_hypothesis_is_that_of_a_sample() -> None:
    vehicle, commands = sailed(8, radius_km=30.0)
    torch.manual_seed(0)
    for index in (1, 2):
        sample = normal(vehicle, index, at(240.0)).sample((100_000,))
        within = (sample.norm(dim=-1) < 30).double().mean().item()
        assert commands[-1].hypotheses[index].arrival == pytest.approx(within, abs=0.02)
        assert 0.05 < within < 0.95
    assert commands[-1].confidence == pytest.approx(sum(p * arrival for _, p, arrival in commands[-1].hypotheses))


@pytest.mark.parametrize("off_km", [0.0, 8.0])
def test_a_fix_weighs_a_hypothesis_by_its_density(off_km: float) -> None:
    vehicle = sailed(3)[0]
    expected = [normal(vehicle, index, at(60.0 + off_km), 3.0).log_prob(f64(0.0, 0.0)).item() for index in range(3)]
    before = vehicle._evidence.clone()
    vehicle.fix(*at(60.0 + off_km), 3.0)
    found = (vehicle._evidence - before).tolist()
    assert [x - found[0] for x in found] == pytest.approx([x - expected[0] for x in expected], abs=0.1)
    last = vehicle.step(*[None] * 3, heading=0.0, distance=0.0).hypotheses
    ratio = [one.probability / PRIOR[k] for k, one in enumerate(last)]
    assert ratio[1] / ratio[0] == pytest.approx(math.exp(vehicle._evidence[1] - vehicle._evidence[0]))


def test_a_start_that_is_not_as_stated_is_no_arrival() -> None:
    """Without integrity, the vehicle says that it has arrived."""
    flights = sailed(9, 80.0, integrity=False)[1], sailed(9, 80.0)[1], sailed(9)[1]
    assert [commands[-1].stop for commands in flights] == ["arrived", "nearest", "arrived"]
    assert [len(commands[-1].hypotheses) for commands in flights] == [1, 3, 3]
    assert "1.00, but 0.00 by a start to 100 km, whose own probability is " in flights[1][-1].reason


def test_the_sentence_of_a_claim_has_the_probability_by_all_hypotheses() -> None:
    last = sailed(9, radius_km=12.0)[1][-1]
    assert last.hypotheses[0].arrival > last.confidence + 0.01
    assert last.reason == f"within 12 km with an estimated probability of {last.confidence:.2f}"


def test_anomalies_are_an_objection_without_a_known_start_alone() -> None:
    certain = [Hypothesis(name, 1.0, 1.0) for name in NAMES]
    rules, usual = Rules(integrity=True), Rules()
    assert objection(rules, certain[:1], 31.0).startswith("anomalies of 31 nT are expected, of at most 30")
    assert (
        objection(rules, certain[:1], 29.0)
        == objection(rules, certain, 90.0)
        == objection(usual, certain[:1], 90.0)
        == ""
    )


def test_a_flight_is_restored_to_the_bit(tmp_path: Path) -> None:
    vehicle = sailed(3)[0]
    vehicle.fix(*at(62.0), 9.0)
    vehicle.save(tmp_path / "flight.json")
    again = Onboard("kalman", sensor_std=STD, integrity=True, drift=0.03)
    again.restore(tmp_path / "flight.json")
    step = (-23.5, -63.5, 11800.0, 0.0, 30.0)
    assert again.step(*step) == vehicle.step(*step)
    with pytest.raises(ValueError, match="of a vehicle with another integrity, True"):
        Onboard("kalman", sensor_std=STD, drift=0.03).restore(tmp_path / "flight.json")


def test_there_is_one_hypothesis_without_a_known_start() -> None:
    vehicle = Onboard("kalman", sensor_std=STD, integrity=True)
    vehicle.start((-23.0, -63.0, 12000.0), target_std=(0.0, 0.0, 0.0))
    assert vehicle.step(-24.0, -64.0, 11900.0, heading=0.0).hypotheses[1:] == ()


def test_a_simulated_vehicle_has_none() -> None:
    with pytest.raises(ValueError, match="integrity True are of a vehicle on board alone"):
        TrackField(Rules(integrity=True))
