"""What the innovations of readings say of their noise."""

from __future__ import annotations

import math

import pytest
import torch
from support.tracks import F64, STD, f64, randn

from magrl.pilot.belief import STATES, Innovation, innovation, start, updated
from magrl.pilot.noise import NoiseEstimate, noise_estimate
from magrl.sensor_std import SensorStd

HERE, NOISE = f64(8.0, -16.0, 35000.0), f64(*STD)


def estimated(true: torch.Tensor, readings: int = 40, vehicles: int = 200) -> torch.Tensor:
    """Mean factor of the stated noise after readings at one place."""
    belief, stated = start(HERE.expand(vehicles, 3), SensorStd(NOISE)), NOISE.expand(vehicles, 3)
    estimate = NoiseEstimate(0 * stated, 0 * stated)
    for reading in HERE + true * randn(readings, vehicles, 3):
        new = innovation(belief, reading, stated * (estimate.log_ratio / 2).exp())
        estimate = noise_estimate(estimate, new, stated)
        belief = updated(belief, innovation(belief, reading, stated * estimate.factor))
    return estimate.factor.mean(0)


@pytest.mark.parametrize(("true", "low", "high"), [(0.4, 0.45, 0.6), (1.0, 0.97, 1.03), (3.0, 2.2, 2.8)])
def test_readings_show_the_noise(true: float, low: float, high: float) -> None:
    """A deviation is found, less the dead band; the noise as stated stays as it is."""
    factor = estimated(true * NOISE)
    assert (factor > low).all()
    assert (factor < high).all()


def test_an_element_with_more_noise_stands_out() -> None:
    factor = estimated(f64(4.0, 1.0, 1.0) * NOISE)
    assert factor[0] > 1.5 * factor[1:].max()


def seen(residual: torch.Tensor, variance: torch.Tensor) -> Innovation:
    return Innovation(residual, torch.zeros(3, STATES, dtype=F64), torch.diag(variance))


def test_the_estimate_by_hand() -> None:
    """Stated noise of 1 with a ratio of 2, and as much of the field: R / S = 1 / 2.

    Innovations of 0, 2 and 100 standard deviations give an evidence of -1/4, 3/4 and 8, the limit, instead of 2500.
    """
    before = NoiseEstimate(f64(2.0).log().expand(3), f64(1.0).expand(3))
    after = noise_estimate(before, seen(f64(0.0, 4.0, 200.0) * NOISE, 4 * NOISE.square()), NOISE)
    scores, weights = (0.5 * x.sum() + 0.5 * x for x in (f64(-0.25, 0.75, 8.0), f64(0.25, 0.25, 0.25)))
    torch.testing.assert_close(after.readings, 1 + weights)
    torch.testing.assert_close(after.log_ratio, f64(2.0).log() + scores / (4 + 1 + weights))
    for _ in range(40):
        after = noise_estimate(after, seen(1e9 * NOISE, after.log_ratio.exp() * NOISE.square()), NOISE)
    assert after.factor.tolist() == pytest.approx([(64 * math.exp(-0.4)) ** 0.5] * 3)


def test_what_says_nothing_of_the_noise_changes_nothing() -> None:
    """A missing reading, of one element as well; an element without noise; an unknown field."""
    before, far = NoiseEstimate(0.1 * f64(1.0, 2.0, 3.0), f64(1.0, 1.0, 1.0)), 10 * NOISE
    for std, variance in ((1e5 * NOISE, 1e10 * NOISE.square()), (0 * NOISE, NOISE**2), (NOISE, 1e6 * NOISE**2)):
        after = noise_estimate(before, seen(far, variance), std)
        torch.testing.assert_close(torch.stack(after), torch.stack(before), atol=1e-3, rtol=0)
    std = f64(1e4, *STD[1:])
    first, *others = noise_estimate(before, seen(0 * far, std.square()), std).readings.tolist()
    assert first - 1 == pytest.approx(sum(other - 1 for other in others) / 3)
