"""What a vehicle that knows its place believes: its start, its destination, errors of legs, fixes, and arrivals."""

from __future__ import annotations

import copy
import itertools
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from support.tracks import f64

from magrl.field import IGRF, elements_at
from magrl.geodesy import geodesic, move_place, polar
from magrl.onboard import Command, Onboard
from magrl.onboard.doubt import Doubt
from magrl.onboard.journal import Step
from magrl.pilot import advance, advanced, earth_model
from magrl.pilot.anomalies import reweighed
from magrl.pilot.belief import PLACE, Motion, at_place, settled, updated
from magrl.pilot.step import position_fix
from magrl.sensor_std import OUTAGE_STD, SensorStd

BERGEN, DATE, FIELD = (60.4, 5.3), "2026-06-30", IGRF("2026-06-30")
NEAR = (60.43, 5.3)


def at(north_km: float, east_km: float = 0.0) -> list[float]:
    """The elements so far from Bergen."""
    distance, bearing = polar(f64(north_km, east_km))
    return elements_at(FIELD, move_place(f64(*BERGEN), bearing, distance)).tolist()


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
    """With a model of 2020, what is measured at the destination tells a vehicle more of the field on its path."""
    place, given = (61.4, 9.3), elements_at(FIELD, f64(61.4, 9.3)).tolist()
    found = []
    for more in ({}, {"target_elements": given, "target_std": (0.02, 0.02, 2.0)}):
        vehicle = begun(target=place, start_km=5.0, model="IGRF-2020", **more)
        vehicle.step(*at(0.0), heading=60.0)
        found.append(vehicle.step(*at(10.0, 17.3), heading=60.0, distance=20.0).confidence)
        assert (vehicle.target == pytest.approx(given, rel=1e-6)) == bool(more)
    assert begun(target=given, start_km=5.0, target_std=(0.1, 0.1, 9.0))._rules.target_std == (0.1, 0.1, 9.0)


def test_a_destination_by_coordinates_has_the_errors_of_the_model() -> None:
    """A vehicle that does not know its start compares elements, and those are not exact."""
    by_place, by_elements = (
        begun(start=None),
        begun(start=None, target=elements_at(FIELD, f64(*NEAR)), target_std=(0, 0, 0)),
    )
    near, exact = (vehicle.step(*at(0.0), heading=0.0).error_km for vehicle in (by_place, by_elements))
    assert near > exact + 5


def test_measured_elements_of_a_destination_must_fit_its_place() -> None:
    place = (61.4, 9.3)
    d, i, h = elements_at(FIELD, f64(*place)).tolist()
    std = (0.5, 0.1, 20.0)
    for model in ("IGRF-14", "IGRF-1990"):
        begun(target=place, target_elements=(d, i, h + 150.0), target_std=std, model=model)
    begun(target=place, target_elements=f64(d, i, h), target_std=std)


REYKJAVIK = (64.1, -21.9)


def sailed(*, fixed: tuple[float, float, float] | None = None, **errors: float) -> tuple[Onboard, Command]:
    """A vehicle after two legs along its reckoned place, with a fix after the first."""
    vehicle = Onboard("kalman", sensor_std=SensorStd((0.5, 0.5, 50.0), bias=(0.5, 0.1, 20.0)), drift=0.0)
    vehicle.start(REYKJAVIK, BERGEN, date=DATE)
    vehicle.step(*at(0.0), heading=270.0)
    for number in (1, 2):
        command = vehicle.step(*at(0.0, -40.0 * number), heading=270.0, distance=40.0, **errors)
        if fixed and number == 1:
            vehicle.fix(*fixed)
    return vehicle, command


def test_errors_of_a_leg_are_along_and_across_it() -> None:
    (north, _), (_, east) = sailed()[1].place_covariance_km2
    (along, _), (_, other) = sailed(distance_std=3.0)[1].place_covariance_km2
    assert other > east + 5
    assert along == pytest.approx(north, abs=0.5)
    (across, _), (_, other) = sailed(heading_std=3.0)[1].place_covariance_km2
    assert across > north + 2
    assert other == pytest.approx(east, abs=0.5)


def test_a_fix_is_weighed_by_its_error() -> None:
    belief = at_place(f64(*BERGEN), 6.0, SensorStd(*torch.zeros(4, 3)), Motion(earth_model("IGRF-14", "2026-06-30")))
    place = move_place(f64(*BERGEN), f64(0.5)[0], f64(8.0)[0])
    after = settled(updated(belief, position_fix(belief, place, 3.0)))
    assert geodesic(*f64(*BERGEN), *after.place)[0].item() == pytest.approx(8 * 36 / 45, rel=1e-3)
    assert after.covariance[PLACE, PLACE].trace().item() == pytest.approx(1 / (1 / 36 + 1 / 9))
    vehicle = begun(start_km=6.0)
    prior = f64(*vehicle.step(*at(0.0), heading=0.0).place_covariance_km2)
    new = position_fix(vehicle._state.beliefs, vehicle._state.place, 3.0)
    expected = reweighed(vehicle._state.log_weight, new)[0]
    assert not torch.allclose(expected, vehicle._state.log_weight, atol=1e-3)
    vehicle.fix(*vehicle._state.place.tolist(), std_km=3.0)
    torch.testing.assert_close(vehicle._state.log_weight, expected)
    found = vehicle._state.belief.covariance[PLACE, PLACE].inverse() - prior.inverse()
    torch.testing.assert_close(found, 2 / 9 * torch.eye(2).double(), rtol=0.02, atol=0.005)


def test_a_fix_is_restored_and_a_wrong_one_is_refused(tmp_path: Path) -> None:
    vehicle, command = sailed(fixed=(60.42, 4.55, 2.0), distance_std=3.0)
    assert command.place != sailed(distance_std=3.0)[1].place
    assert min(*command.sensor_errors_std, *(row[k] for k, row in enumerate(command.drift_covariance or ()))) >= 0
    vehicle.save(tmp_path / "state.json")
    again = Onboard("kalman", **{name: getattr(vehicle.options, name) for name in ("sensor_std", "drift")})
    again.restore(tmp_path / "state.json")
    step = (1.0, 73.0, 15000.0, 270.0, 40.0)
    assert again.step(*step) == vehicle.step(*step)
    with pytest.raises(ValueError, match=r"the fix is \d+ km from the estimated place, where \d km is likely"):
        sailed(fixed=(61.4, 4.6, 2.0))
    fresh = Onboard("kalman")
    for target in (None, REYKJAVIK):
        if target:
            fresh.start(target, date="2026-06-30")
        with pytest.raises(RuntimeError, match="start with a place and a date"):
            fresh.fix(60.4, 4.6, 1.0)


# Limits


def test_an_estimate_that_is_not_finite_is_refused_and_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    (vehicle, _), (other, _) = sailed(), sailed()
    step, right = {"heading": 270.0, "distance": 40.0}, advanced

    def wrong(*given: Any) -> Any:
        states, *rest = right(*given)
        return states._replace(mean=states.mean * float("nan")), *rest

    with monkeypatch.context() as patch:
        patch.setattr("magrl.onboard.vehicle.advanced", wrong)
        with pytest.raises(ValueError, match=r"the estimate is not finite after this leg: check its distance"):
            vehicle.step(*at(0.0, -120.0), **step)
    assert vehicle.step(*at(0.0, -120.0), **step) == other.step(*at(0.0, -120.0), **step)


DOORS: Any = {
    "start": lambda vehicle, *place: vehicle.start(place, (30.0, 10.0), date=DATE),
    "retarget": lambda vehicle, *place: vehicle.retarget(place),
    "fix": lambda vehicle, *place: vehicle.fix(*place, std_km=9.0),
}


def test_no_command_has_a_number_that_is_not_finite() -> None:
    """Of a place about the antipode, at each door, or after a leg that leads there; what is refused changes nothing."""
    here, *south = readings = [elements_at(FIELD, f64(30.0 - 0.375 * number, 10.0)).tolist() for number in range(5)]
    refused = []
    for door, (north, east) in itertools.product(DOORS, ((0.0, 0.0), (0.0, 0.5), (1.5, 0.0), (0.0, 2.0))):
        vehicle = begun(target=(30.5, 10.0), start=(30.0, 10.0))
        commands, other = [vehicle.step(*here, 0.0)], copy.deepcopy(vehicle)
        try:
            DOORS[door](vehicle, north - 30.0, east - 170.0)
            commands.append(vehicle.step(*here, 0.0))
            for reading in south:
                other = copy.deepcopy(vehicle)
                commands.append(vehicle.step(*reading, heading=180.0, distance=41.57))
        except ValueError:
            refused.append((door, len(commands) > 1))
            for each in (vehicle, other):
                each.retarget((30.5, 10.0))
            last = readings[max(0, len(commands) - 2)]
            commands += [each.step(*last, 0.0) for each in (vehicle, other)]
            assert commands[-1] == commands[-2]
        assert "nan" not in repr(commands)
    late = {"start": (False, False, True), "retarget": (False, False, True), "fix": (False,) * 4}
    assert refused == [(door, after) for door, calls in late.items() for after in calls]


@pytest.mark.parametrize(("std_km", "reset"), [(1.0, True), (99.0, False)])
def test_only_a_fix_that_is_better_than_the_estimate_resets_the_fit(std_km: float, reset: bool) -> None:
    vehicle, commands = flown(30.0, -30.0, 30.0, 0.0)
    assert commands[-1].fit < 0.01
    vehicle.fix(*commands[-1].place, std_km=std_km)
    assert (vehicle.step(*at(112.0), heading=0.0).fit > 0.01) == reset


@pytest.mark.parametrize(("latitude", "stop"), [(-86.0, "out of range"), (86.0, "out of range"), (-84.0, None)])
def test_a_place_near_a_pole_is_out_of_range(latitude: float, stop: str | None) -> None:
    """Of the Earth, in the north as in the south."""
    here, there = ((latitude - turn, -60.0) for turn in (0.0, math.copysign(1.0, latitude)))
    vehicle = begun(target=there, start=here)
    assert vehicle.step(*elements_at(FIELD, f64(*here)).tolist(), heading=0.0).stop == stop


def test_a_weak_horizontal_field_is_no_limit_where_the_place_is_known() -> None:
    """Near the magnetic pole; without a place it is refused."""
    here, there = (-65.6, 137.0), (-66.0, 138.0)
    elements, target = (elements_at(FIELD, f64(*place)).tolist() for place in (here, there))
    assert elements[2] < 2000 > target[2]
    assert begun(target=there, start=here).step(*elements, heading=0.0).stop is None
    with pytest.raises(ValueError, match=r"the target: B_H .* is out of the range of the navigator, 2000 to inf nT"):
        begun(target=there, start=None)


# Elements that are not read


@pytest.mark.parametrize(("off", "least", "most"), [(0.0, 0.5, 1.0), (0.6, 0.0, 0.1), (1.5, 0.0, 0.01)])
def test_declination_alone_is_doubted(off: float, least: float, most: float) -> None:
    """Five legs with D so many degrees off, at a stated .02; a part may be an anomaly."""
    vehicle = begun(target=(61.4, 5.3))
    vehicle.step(*at(0.0), heading=0.0)
    for number in range(1, 6):
        command = vehicle.step(at(10.0 * number)[0] + off, None, None, heading=0.0, distance=10.0)
    assert least <= command.fit <= most


def test_elements_that_are_not_read_count_neither_in_the_tail_nor_in_the_surprise() -> None:
    """As where they are missing (NaN), whatever the others are."""
    d, i, h = at(10.0)
    tracks = []
    for missing, noise in ((i, OUTAGE_STD), (float("nan"), 0.02)):
        vehicle = begun(target=(61.4, 5.3))
        vehicle.step(*at(0.0), heading=0.0)
        reading = vehicle._template._replace(field=f64(d + 0.3, missing, h).float(), distance=torch.tensor(10.0))
        reading = reading._replace(std=reading.std._replace(noise=f64(0.02, noise, 2.0)), step=torch.tensor(1))
        tracks.append(advance(vehicle._rules, vehicle._state, reading))
    outage, absent = tracks
    assert outage.surprise.item() == pytest.approx(absent.surprise.item(), rel=1e-3)
    assert outage.tail.item() == pytest.approx(absent.tail.item(), rel=1e-3)


# A sensor that hangs


def hung(*names: int, noise: float = 0.01) -> list[Command]:
    """Commands of a vehicle on its way, whose sensors show some elements as at its start from the third reading on."""
    vehicle = Onboard("kalman", sensor_std=(noise, noise, 100 * noise), confidence=0.9)
    vehicle.start((62.6, 5.3), BERGEN, date=DATE)
    commands, last = [], at(0.0)
    for number in range(6):
        read = at(40.0 * number)
        last = [old if number > 1 and k in names else new for k, (old, new) in enumerate(zip(last, read, strict=True))]
        commands.append(vehicle.step(*last, heading=0.0, distance=40.0 * (number > 0)))
    return commands


@pytest.mark.parametrize("element", [1, 2])
def test_an_element_of_a_sensor_that_hangs_is_not_read_any_more(element: int) -> None:
    """The operator is told, the others go on, and the place stays right; a change that noise hides is none."""
    commands, name = hung(element), ("D", "I", "B_H")[element]
    assert [command.reason for command in commands[:2]] == ["", ""]
    for number, command in enumerate(commands[2:], 2):
        assert command.reason == f"{name} stayed the same along a leg that changes it: it is not read any more"
        assert command.stop is None
        assert abs(command.place[0] - at_km(40.0 * number)) < 0.02
    assert not any("not read" in command.reason for command in (*hung(), *hung(element, noise=1.0)))


def test_digits_coarser_than_the_noise_are_not_found_to_hang_but_a_sensor_that_does_is() -> None:
    """Of 20 000 legs along which I changes by 0 to 10 times its noise, with digits of half the noise, as many repeat a
    reading as a normal distribution says; where 5 to 10 are expected, 1 in 100 000 legs does."""
    vehicle, random, noise = begun(), np.random.default_rng(5), 0.02
    vehicle.step(*at(0.0), heading=0.0)
    state, i = vehicle._state, at(0.0)[1]
    slope = (at(5.0)[1] - at(-5.0)[1]) / 10.0
    repeated, found = [], []
    for sizes in random.uniform(0.0, 10.0, 20_000):
        true = np.array((i, i + sizes * noise)) + random.uniform(0, noise)
        old, new = np.round((true + noise * random.normal(size=2)) / (noise / 2)) * (noise / 2)
        repeated.append(old == new)
        leg = Step(
            declination=None, inclination=new, horizontal_intensity=None, heading=0.0, distance=sizes * noise / slope
        )
        found.append(old == new and Doubt().found(state, (noise,) * 3, (0.0, old, 0.0), leg).hung[1])
    # Half a noise wide, N(size, 2): the integral over sizes is half, of 10.
    assert sum(repeated) == pytest.approx(20_000 * 0.5 / 10 / 2, rel=0.1)
    assert sum(found) <= 1
    for size, hung_there in ((4.5, False), (5.5, True)):
        leg = Step(
            declination=None, inclination=i, horizontal_intensity=None, heading=0.0, distance=size * noise / slope
        )
        assert Doubt().found(state, (noise,) * 3, (0.0, i, 0.0), leg).hung[1] == hung_there


def test_a_vehicle_whose_sensors_all_hang_is_lost() -> None:
    assert [command.stop for command in hung(0, 1, 2)][:2] == [None, None]
    assert "lost" in [command.stop for command in hung(0, 1, 2)]


def at_km(north_km: float) -> float:
    """The latitude so far north of Bergen."""
    return move_place(f64(*BERGEN), f64(0.0)[0], f64(north_km)[0])[0].item()


def test_a_doubt_stays_and_counts_the_first_reading() -> None:
    """Of a right reading after a surprising one, and of right readings after a first one that hardly fitted."""
    right = SimpleNamespace(tail=torch.tensor(0.7), surprise=torch.tensor(1.0))
    wrong = SimpleNamespace(tail=torch.tensor(1e-6), surprise=torch.tensor(30.0))
    doubt = Doubt().after(right, first=True).after(wrong, first=False)
    assert doubt.after(right, first=False).fit == doubt.fit < 1e-3
    begun = Doubt().after(wrong, first=True)
    assert begun.after(right, first=False).start == begun.start == (pytest.approx(1e-6),)
    assert begun._replace(fit=1.0).after(right, first=False).fit < 1e-3


@pytest.mark.parametrize("model", ["IGRF-14", "IGRF-2020"])
def test_a_vehicle_goes_on_to_another_destination_with_what_it_learned(model: str, tmp_path: Path) -> None:
    survey = {"target_elements": at(56.0, 56.0), "target_std": (0.1, 0.05, 30.0)}
    place = move_place(f64(*BERGEN), f64(math.pi / 4), f64(56.0 * math.sqrt(2)))[0].tolist()
    vehicle = begun(target=(61.4, 5.3), model=model, start_km=5.0)
    with pytest.raises(RuntimeError, match="no estimate to keep"):
        vehicle.retarget(place)
    commands = [vehicle.step(*at(28.0 * number), heading=0.0, distance=28.0 * (number > 0)) for number in range(3)]
    vehicle.retarget(place, **survey)
    vehicle.save(tmp_path / "flight.json")
    after = vehicle.step(*at(56.0), heading=0.0)
    assert after.displacement_km == pytest.approx((0.0, 56.0), abs=8.0)
    assert after.turn_deg == pytest.approx(90.0, abs=15.0)
    assert after.place_covariance_km2[0][0] <= commands[-1].place_covariance_km2[0][0]
    again = Onboard("kalman", sensor_std=(0.02, 0.02, 2.0), confidence=0.9)
    again.restore(tmp_path / "flight.json")
    assert again.step(*at(56.0), heading=0.0) == after
    fresh = begun(target=place, model=model, start_km=5.0, **survey).step(*at(0.0), heading=0.0)
    assert after.error_radius_km < fresh.error_radius_km
