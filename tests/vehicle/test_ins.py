"""Beside an inertial navigation system: legs with errors, fixes of the position, and what is estimated."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from support.tracks import f64

from magrl.field import IGRF, elements_at
from magrl.geodesy import geodesic, move_place
from magrl.sensor_std import SensorStd
from magrl.tracking import Motion, earth_model
from magrl.tracking.belief import PLACE, at_place, settled, updated
from magrl.tracking.pilot import position_fix
from magrl.vehicle.onboard import Command, Onboard

BERGEN, REYKJAVIK = (60.4, 5.3), (64.1, -21.9)


def flown(*, fixed: tuple[float, float, float] | None = None, **errors: float) -> tuple[Onboard, Command]:
    """A vehicle after two legs along its reckoned place, with a fix after the first."""
    vehicle = Onboard("kalman", sensor_std=SensorStd((0.5, 0.5, 50.0), bias=(0.5, 0.1, 20.0)), drift=0.0)
    vehicle.start(REYKJAVIK, BERGEN, date="2026-06-30")
    place, field = f64(*BERGEN), IGRF("2026-06-30")
    vehicle.step(*elements_at(field, place).tolist(), heading=270.0)
    for number in range(2):
        place = move_place(place, torch.deg2rad(f64(270.0))[0], f64(40.0)[0])
        command = vehicle.step(*elements_at(field, place).tolist(), heading=270.0, distance=40.0, **errors)
        if fixed and number == 0:
            vehicle.fix(*fixed)
    return vehicle, command


def test_errors_of_a_leg_are_along_and_across_it() -> None:
    (north, _), (_, east) = flown()[1].place_covariance_km2
    (along, _), (_, other) = flown(distance_std=3.0)[1].place_covariance_km2
    assert other > east + 5
    assert along == pytest.approx(north, abs=0.5)
    (across, _), (_, other) = flown(heading_std=3.0)[1].place_covariance_km2
    assert across > north + 2
    assert other == pytest.approx(east, abs=0.5)


def test_a_fix_is_weighed_by_its_error() -> None:
    belief = at_place(f64(*BERGEN), 6.0, SensorStd(*torch.zeros(4, 3)), Motion(earth_model("IGRF-14", "2026-06-30")))
    place = move_place(f64(*BERGEN), f64(0.5)[0], f64(8.0)[0])
    after = settled(updated(belief, position_fix(belief, place, 3.0)))
    assert geodesic(*f64(*BERGEN), *after.place)[0].item() == pytest.approx(8 * 36 / 45, rel=1e-3)
    assert after.covariance[PLACE, PLACE].trace().item() == pytest.approx(1 / (1 / 36 + 1 / 9))


def test_a_fix_is_restored_and_a_wrong_one_is_refused(tmp_path: Path) -> None:
    vehicle, command = flown(fixed=(60.42, 4.55, 2.0), distance_std=3.0)
    assert command.place != flown(distance_std=3.0)[1].place
    assert min(*command.sensor_errors_std, *(row[k] for k, row in enumerate(command.drift_covariance or ()))) >= 0
    vehicle.save(tmp_path / "state.json")
    again = Onboard("kalman", **{name: getattr(vehicle.options, name) for name in ("sensor_std", "drift")})
    again.restore(tmp_path / "state.json")
    step = (1.0, 73.0, 15000.0, 270.0, 40.0)
    assert again.step(*step) == vehicle.step(*step)
    with pytest.raises(ValueError, match=r"the fix is \d+ km from the estimated place, where \d km is likely"):
        flown(fixed=(61.4, 4.6, 2.0))
    fresh = Onboard("kalman")
    for target in (None, REYKJAVIK):
        if target:
            fresh.start(target, date="2026-06-30")
        with pytest.raises(RuntimeError, match="start with a place and a date"):
            fresh.fix(60.4, 4.6, 1.0)
