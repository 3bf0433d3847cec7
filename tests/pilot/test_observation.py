"""What an agent without a map observes: its 19 numbers by hand, and their frame."""

from __future__ import annotations

import math

import torch
from support.readings import first_reading
from support.tracks import STD, f64
from torch import Tensor

from magrl.pilot import Reading, Rules, Track, begin
from magrl.pilot.noise import DEAD_BAND
from magrl.pilot.observation import OBSERVATION_SIZE, track_observation
from magrl.pilot.step import observation
from magrl.sensor_std import STD_KEYS
from magrl.transforms.track import reading_of


def by_hand(**change: Tensor) -> Tensor:
    values = {
        "aim": f64(30.0, 40.0),
        "plan": f64(-12.0, 16.0),
        "covariance": f64((400.0, 100.0), (100.0, 1600.0)),
        "gradient": f64((0.01, 0.0), (0.0, 0.02), (1.0, 1.0)),
        "remaining": f64(0.1, -0.2, 3.0),
        "weights": f64(100.0, 25.0, 0.01),
        "std": f64(0.1, 0.0, 5.0),
        "time": f64(0.3),
        "price": f64(0.4),
    }
    return track_observation(**values | change)


def started() -> tuple[Rules, Track, Reading]:
    """The track of four vehicles after their first reading."""
    rules, seen = Rules(), first_reading().set("elapsed_steps", torch.zeros(4, 1, dtype=torch.int64))
    reading = reading_of(seen.update({STD_KEYS[0]: f64(*STD).expand(4, 3)}))
    return rules, begin(rules, reading), reading


def test_the_numbers_by_hand() -> None:
    """A distance of 50 km; standard deviations of 20 and 40 km; the ellipse [[.02, .01], [.01, .02]]; F of 2.09."""
    expected = [
        *(0.6, 0.8),  # direction
        *(math.log(3.5) - 2, 50 / 400 - 0.5),  # length
        *(0.0, math.log(2) / 2, 100 / 800),  # standard deviations over 20 km, and their correlation
        *[math.log(20 * math.sqrt(0.02)) / 2] * 2,  # axes of the ellipse
        0.5,  # their correlation
        math.log(2.1) / 3 - 0.5,  # F over the threshold
        0.3,  # time
        *(math.log(0.1) / 2 + 2, math.log(0.002) / 2 + 2, math.log(0.05) / 2 + 2),  # noise
        *(-0.6, 0.8, math.log(2) - 1),  # plan
        math.log(4) / 2,  # price
    ]
    torch.testing.assert_close(by_hand(), f64(*expected))
    assert len(expected) == OBSERVATION_SIZE


def test_numbers_at_the_extremes() -> None:
    """No distance, no uncertainty, no gradient; and a distance beyond all measure, whose direction is still seen."""
    flat = by_hand(aim=torch.zeros(2), covariance=torch.zeros(2, 2), gradient=torch.zeros(3, 2))
    assert flat.isfinite().all()
    assert flat[:2].tolist() == [0.0, 0.0]
    far = by_hand(aim=f64(0.0, -1e6))
    assert (far[1], far[3]) == (-1.0, 2500 / 400 - 0.5)


def test_the_noise_is_that_which_readings_show() -> None:
    """A reading with three times the stated noise is one that states it."""
    rules, track, reading = started()
    shown = track._replace(state=track.state._replace(log_ratio=torch.full((4, 3, 3), DEAD_BAND + 2 * math.log(3.0))))
    stated = reading._replace(std=reading.std._replace(noise=3 * reading.std.noise))
    torch.testing.assert_close(observation(rules, shown, reading), observation(rules, track, stated))


def test_a_turn_of_world_and_vehicle_is_not_observed() -> None:
    """D turns with the world, and passes 180 degrees; a turn of the vehicle alone is observed."""
    rules, track, reading = started()
    plain, other = observation(rules, track, reading), reading._replace(heading=reading.heading + 3.0)
    assert not torch.allclose(observation(rules, track, other), plain)
    turn = f64((math.cos(3.0), -math.sin(3.0)), (math.sin(3.0), math.cos(3.0)))
    field, target = reading.field.clone(), reading.target.clone()
    for elements in (field, target, track.local.value):
        elements[:, 0] = torch.remainder(elements[:, 0] + math.degrees(3.0) + 180, 360) - 180
    aim, plan, gradient = (vectors @ turn.mT for vectors in (track.aim, track.plan, track.local.gradient))
    displacement = track.displacement._replace(covariance=turn @ track.displacement.covariance.double() @ turn.mT)
    track = track._replace(aim=aim, plan=plan, displacement=displacement, local=track.local._replace(gradient=gradient))
    found = observation(rules, track, other._replace(field=field, target=target))
    torch.testing.assert_close(found, plain, rtol=1e-5, atol=1e-5)
