"""The belief in the axes of magnetic north: what a vehicle knows that measures I and B_H alone."""

from __future__ import annotations

import math

import torch
from support.tracks import F64, STD, f64, randn, unknown

from magrl.pilot.belief import STATES, Belief, elements, innovation, moved, start
from magrl.pilot.destination import destination, posterior
from magrl.pilot.forecast import covariance_after
from magrl.pilot.harmonics import turning
from magrl.pilot.local import COEFFICIENTS
from magrl.pilot.prior import CELLS, expected, latitude_cells
from magrl.sensor_std import SensorStd

COMPASS = SensorStd(f64(*STD), f64(math.inf, 0.0, 0.0), f64(0.0, 0.0, 0.0), f64(0.0, 0.0, 0.0))
NOISE = f64(*STD)


def test_the_prior_does_not_depend_on_the_direction_of_true_north() -> None:
    """Turning the field by the angle between two cells permutes them, and turns what is expected."""
    field, angle = f64(15000.0, 3000.0, 45000.0), math.pi / 2
    turn = turning(f64(math.cos(angle))[0], f64(math.sin(angle))[0], 3)
    cells = latitude_cells(12)
    (mean, covariance), (other, spread) = expected(field, cells), expected(turn[:3, :3] @ field, cells)
    torch.testing.assert_close(other[:-1], turn @ mean[:-1])
    torch.testing.assert_close(spread[:-1, :-1], turn @ covariance[:-1, :-1] @ turn.mT, rtol=1e-6, atol=1e-3)
    assert latitude_cells(12).mean.shape == (12 * CELLS, COEFFICIENTS)


def test_a_reading_leaves_declination_out() -> None:
    reading = f64(0.0, 60.0, 20000.0)
    belief = start(reading, COMPASS)
    assert belief.latitude.isnan()
    assert belief.covariance[1].abs().max() < 1e-6  # the field has no eastward part
    other = start(f64(77.0, 60.0, 20000.0), COMPASS)
    torch.testing.assert_close(other.mean, belief.mean)
    new = innovation(belief, f64(5.0, 60.1, 20010.0), NOISE)
    assert not new.rows[0].any()
    assert new.residual[0] == 0
    local = elements(belief)
    assert local.value[0] == 0
    assert not local.gradient[0].any()


def test_a_leg_turns_the_axes_to_magnetic_north_at_its_end() -> None:
    """The turn depends on the state: the covariance after it is that of samples, and the eastward field stays 0."""
    mean = start(f64(0.0, 55.0, 22000.0), COMPASS).mean
    spread = 1e-2 * torch.diag(torch.cat((f64(20.0, 0.0, 20.0), 100 + 0 * mean[3:COEFFICIENTS])))
    covariance = torch.zeros(STATES, STATES, dtype=F64)
    covariance[:COEFFICIENTS, :COEFFICIENTS] = spread @ spread
    nowhere, leg = f64(math.nan)[0], (f64(60.0), f64(4.0))
    belief = moved(Belief(mean.expand(1, -1), covariance.expand(1, -1, -1), unknown(nowhere.expand(1))), *leg)
    samples = mean + torch.nn.functional.pad(randn(4000, COEFFICIENTS, seed=1) @ spread, (0, STATES - COEFFICIENTS))
    sure = Belief(samples, torch.zeros(4000, STATES, STATES, dtype=F64), unknown(nowhere.expand(4000)))
    after = moved(sure, leg[0].expand(4000), leg[1].expand(4000))
    assert after.mean[:, 1].abs().max() < 1e-6
    fresh = after.covariance[0]  # that of the degrees that are left out
    sampled = torch.cov(after.mean.mT) + fresh
    scale = sampled.diagonal().clamp_min(1e-12).sqrt()
    known = scale > 1e-3
    ratio = ((belief.covariance[0] - sampled) / scale / scale.unsqueeze(-1))[known][:, known]
    assert ratio.abs().max() < 0.12
    assert belief.covariance[0, 1].abs().max() < 1e-6


def test_the_destination_and_the_forecast_leave_its_declination_out() -> None:
    """The elements of the destination may have any D, and the forecast is that of readings of I and B_H."""
    belief = start(f64(0.0, 60.0, 20000.0), COMPASS)
    goals = [destination(belief, f64(d, 61.0, 19500.0), 300.0) for d in (0.0, 50.0)]
    first, second = (posterior(goal) for goal in goals)
    torch.testing.assert_close(first, second)
    legs = f64((40.0, 0.0), (0.0, 40.0))
    after = [covariance_after(goal, f64(100.0, 0.0), legs, COMPASS) for goal in goals]
    torch.testing.assert_close(*after)
    worse = COMPASS._replace(noise=f64(1e3, *STD[1:]))
    torch.testing.assert_close(covariance_after(goals[0], f64(100.0, 0.0), legs, worse), after[0])
    along = after[0].diagonal(dim1=-2, dim2=-1)
    assert (along[:, 1] > 9 * along[:, 0]).all()  # known northward, and hardly eastward
