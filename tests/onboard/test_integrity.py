"""Claims of a vehicle with integrity: two more estimates on the same legs, and what they say against an arrival."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from support.tracks import f64

from magrl.field import IGRF, elements_at
from magrl.geodesy import geodesic, move_place
from magrl.onboard import Command, Onboard
from magrl.onboard.integrity import Separation, objection
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


def test_the_separation_is_normalized_by_the_difference_of_the_covariances() -> None:
    """The probability without the drift is that of a sample."""
    vehicle, commands = sailed(8, radius_km=30.0)
    own, start, drift = (part(vehicle._states, index).belief for index in range(3))
    distance, bearing = geodesic(*own.place, *start.place)
    apart = distance * torch.stack((bearing.cos(), bearing.sin()))
    spread = (start.covariance - own.covariance)[PLACE, PLACE]
    assert commands[-1].separation is not None
    assert commands[-1].separation.start == pytest.approx((apart @ spread.inverse() @ apart).item(), rel=1e-6)
    distance, bearing = geodesic(*drift.place, *f64(*at(240.0)))
    normal = torch.distributions.MultivariateNormal(
        distance * torch.stack((bearing.cos(), bearing.sin())), drift.covariance[PLACE, PLACE]
    )
    torch.manual_seed(0)
    within = (normal.sample((100_000,)).norm(dim=-1) < 30).double().mean().item()
    assert commands[-1].separation.drift == pytest.approx(within, abs=0.02)
    assert 0.05 < within < 0.95


def test_a_start_that_is_not_as_stated_is_no_arrival() -> None:
    """Without integrity, the vehicle says that it has arrived."""
    flights = sailed(9, 80.0, integrity=False)[1], sailed(9, 80.0)[1], sailed(9)[1]
    assert [commands[-1].stop for commands in flights] == ["arrived", "nearest", "arrived"]
    assert flights[0][-1].separation is None
    assert "1.00, but without the stated start, the place is 4.2 standard errors away" in flights[1][-1].reason


def test_objections() -> None:
    rules, usual = Rules(integrity=True), Rules()
    assert objection(rules, 0.03, Separation(0.0, 1.0), 0.0) == "readings do not fit what is stated (p = 0.03)"
    assert objection(usual, 0.03, None, 90.0) == ""
    assert objection(usual, 0.003, None, 0.0) == "readings do not fit what is stated (p = 0.003)"
    assert objection(rules, 1.0, Separation(6.7, 1.0), 0.0).startswith("without the stated start")
    assert objection(rules, 1.0, Separation(6.5, 0.4), 0.0) == "it is 0.40 with a drift of 0.1"
    assert objection(rules, 1.0, Separation(6.5, 0.6), 90.0) == ""
    assert objection(rules, 1.0, None, 29.0) == ""


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


def test_separation_is_none_without_a_known_start() -> None:
    vehicle = Onboard("kalman", sensor_std=STD, integrity=True)
    vehicle.start((-23.0, -63.0, 12000.0), target_std=(0.0, 0.0, 0.0))
    assert vehicle.step(-24.0, -64.0, 11900.0, heading=0.0).separation is None


def test_a_simulated_vehicle_has_none() -> None:
    with pytest.raises(ValueError, match="integrity True are of a vehicle on board alone"):
        TrackField(Rules(integrity=True))
