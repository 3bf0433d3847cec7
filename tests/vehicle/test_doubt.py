"""What a vehicle does not believe: a wrong start, and an arrival by readings that do not fit what is stated."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from support.tracks import f64

from magrl.field import IGRF, elements_at
from magrl.geodesy import move_place
from magrl.vehicle.onboard import Command, Onboard

BERGEN, DATE, FIELD = (60.4, 5.3), "2026-06-30", IGRF("2026-06-30")
NEAR = (60.43, 5.3)


def at(north_km: float, east_km: float = 0.0) -> list[float]:
    """The elements so far from Bergen."""
    way = f64(north_km, east_km)
    return elements_at(FIELD, move_place(f64(*BERGEN), torch.atan2(way[1], way[0]), way.norm())).tolist()


def begun(**known: Any) -> Onboard:
    vehicle = Onboard("kalman", sensor_std=(0.02, 0.02, 2.0), confidence=0.9)
    vehicle.start(**{"target": NEAR, "start": BERGEN, "date": DATE} | known)
    return vehicle


def test_a_start_that_is_off_is_refused_and_the_next_reading_may_be_right() -> None:
    vehicle = begun(start_km=1.0)
    with pytest.raises(ValueError, match=r"does not fit the start, .* \(p = .* by what is stated\): check sensors"):
        vehicle.step(*at(-100.0), heading=0.0)
    assert vehicle.step(*at(0.0), heading=0.0).fit > 0.1
    assert begun(start_km=100.0).step(*at(-100.0), heading=0.0).stop is None


def flown(*storm_nt: float) -> tuple[Onboard, list[Command]]:
    """A vehicle that flies 112 km northward to its destination, with storms in its readings."""
    vehicle = begun(target=(61.4, 5.3))
    commands = [vehicle.step(*at(0.0), heading=0.0)]
    for number, storm in enumerate(storm_nt, 1):
        d, i, h = at(28.0 * number)
        commands.append(vehicle.step(d, i, h + storm, heading=0.0, distance=28.0))
    return vehicle, commands


def test_a_vehicle_has_not_arrived_by_readings_that_do_not_fit() -> None:
    """Until a fix of its position."""
    (_, right), (vehicle, wrong) = flown(0.0, 0.0, 0.0, 0.0), flown(30.0, -30.0, 30.0, 0.0)
    assert [command.stop for command in right] == [None] * 4 + ["arrived"]
    assert min(command.fit for command in right) > 0.1
    assert [command.stop for command in wrong] == [None] * 4 + ["nearest"]
    assert "do not fit what is stated (p = " in wrong[-1].reason
    assert wrong[-1].fit < 0.01 < wrong[1].fit
    vehicle.fix(*f64(61.4, 5.3).tolist(), std_km=1.0)
    again = vehicle.step(*at(112.0), heading=0.0)
    assert (again.stop, again.fit > 0.01) == ("arrived", True)


def test_the_elements_of_the_destination_count_where_they_are_given() -> None:
    """With a model of 2020, what is measured at the destination tells a vehicle more of the field on its way."""
    place, given = (61.4, 9.3), elements_at(FIELD, f64(61.4, 9.3)).tolist()
    ways = []
    for more in ({}, {"target_elements": given, "target_std": (0.02, 0.02, 2.0)}):
        vehicle = begun(target=place, start_km=5.0, model="IGRF-2020", **more)
        vehicle.step(*at(0.0), heading=60.0)
        ways.append(vehicle.step(*at(10.0, 17.3), heading=60.0, distance=20.0).confidence)
        assert vehicle.target == pytest.approx(given, abs=1e-9) if more else vehicle.target != given
    assert begun(target=given, start_km=5.0, target_std=(0.1, 0.1, 9.0))._rules.target_std == (0.1, 0.1, 9.0)


def test_a_destination_by_coordinates_has_the_errors_of_the_model() -> None:
    """A vehicle that does not know its start compares elements, and those are not exact."""
    by_place, by_elements = begun(start=None), begun(start=None, target=tuple(elements_at(FIELD, f64(*NEAR)).tolist()))
    near, exact = (vehicle.step(*at(0.0), heading=0.0).error_km for vehicle in (by_place, by_elements))
    assert near > exact + 5


def test_measured_elements_of_a_destination_must_fit_its_place() -> None:
    place = (61.4, 9.3)
    d, i, h = elements_at(FIELD, f64(*place)).tolist()
    std = (0.5, 0.1, 20.0)
    for model in ("IGRF-14", "IGRF-1990"):
        begun(target=place, target_elements=(d, i, h + 150.0), target_std=std, model=model)
    begun(target=place, target_elements=f64(d, i, h), target_std=std)


def test_a_rejected_start_changes_nothing(tmp_path: Path) -> None:
    vehicle = begun()
    command = vehicle.step(*at(0.0), heading=0.0)
    with pytest.raises(ValueError, match="start_km must be less"):
        vehicle.start((61.4, 9.3), BERGEN, date=DATE, start_km=200.0)
    vehicle.save(tmp_path / "state.json")
    vehicle.restore(tmp_path / "state.json")
    assert vehicle.target == begun().target
    assert vehicle.step(*at(0.0), heading=0.0).place == pytest.approx(command.place, abs=0.01)
