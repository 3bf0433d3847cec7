"""How well readings fit the track, and what this says of their noise."""

import math

import pytest
import torch
from support.tracks import F64, SCALES, STD, f64, randn, started

from magrl.tracking import FieldTrack, NoiseEstimate, noise_estimate, read, surprise

HERE = f64(8.0, -16.0, 35000.0)


def estimated(true: torch.Tensor, stated: torch.Tensor, readings: int = 40, vehicles: int = 200) -> torch.Tensor:
    """Mean factor of the data sheet after readings at one place."""
    track, zeros = started(HERE.expand(vehicles, 3), tuple(stated.tolist())), torch.zeros(vehicles, 3, dtype=F64)
    estimate, still = NoiseEstimate(zeros, zeros), zeros[:, :2]
    for reading in HERE + true * randn(readings, vehicles, 3):
        estimate = noise_estimate(estimate, track, still, reading, stated, 0 * stated)
        track = read(track, still, reading, stated * estimate.factor)
    return estimate.factor.mean(0)


@pytest.mark.parametrize(("true", "low", "high"), [(0.4, 0.45, 0.6), (1.0, 0.97, 1.03), (3.0, 2.2, 2.8)])
def test_readings_show_the_noise(true: float, low: float, high: float) -> None:
    """A deviation is found, less the dead band; the noise as stated stays as it is."""
    factor = estimated(true * f64(*STD), f64(*STD))
    assert (factor > low).all()
    assert (factor < high).all()


def test_the_estimate_by_hand() -> None:
    """With P, R and a quarter of the variance of slow errors of 1, 2 and 1 each, in scaled units: R / S = 1 / 2.

    The innovations are 0, 2 and 100 standard deviations of S: evidence of -1/4, 3/4, and 8 in place of 2500.
    """
    track = FieldTrack(f64(0.0).expand(3, 3), torch.eye(3, dtype=F64).expand(3, 3, 3))
    before, sheet, slow = NoiseEstimate(f64(2.0).log().expand(3), f64(1.0).expand(3)), SCALES, 2 * SCALES
    reading = f64(0.0, 2.0, 100.0) * 2 * SCALES
    after = noise_estimate(before, track, f64(0.0, 0.0), reading, sheet, slow)
    scores, weights = (0.5 * x.sum() + 0.5 * x for x in (f64(-0.25, 0.75, 8.0), f64(0.25, 0.25, 0.25)))
    torch.testing.assert_close(after.readings, 1 + weights)
    torch.testing.assert_close(after.log_ratio, f64(2.0).log() + scores / (4 + 1 + weights))
    for _ in range(40):
        after = noise_estimate(after, track, f64(0.0, 0.0), 1e9 * SCALES, sheet, slow)
    assert after.factor.tolist() == pytest.approx([(64 * math.exp(-0.4)) ** 0.5] * 3)


def test_an_element_with_more_noise_stands_out() -> None:
    factor = estimated(f64(4.0, 1.0, 1.0) * f64(*STD), f64(*STD))
    assert factor[0] > 1.5 * factor[1:].max()


def test_what_says_nothing_of_the_noise_changes_nothing() -> None:
    """A missing reading, of one element as well; an element without noise; an unknown gradient."""
    track, before = started(HERE), NoiseEstimate(0.1 * f64(1.0, 2.0, 3.0), f64(1.0, 1.0, 1.0))
    none, far = f64(0.0, 0.0, 0.0), HERE + 10 * SCALES
    for std, way in ((f64(1e4, 1e4, 1e4), 0.0), (none, 0.0), (1e-3 * f64(*STD), 500.0)):
        after = noise_estimate(before, track, f64(way, way), far, std, none)
        torch.testing.assert_close(torch.stack(after), torch.stack(before), atol=1e-3, rtol=0)
    first, *others = noise_estimate(before, track, none[:2], HERE, f64(1e4, *STD[1:]), none).readings.tolist()
    assert first - 1 == pytest.approx(sum(other - 1 for other in others) / 3)


def test_the_surprise_does_not_depend_on_the_units_of_the_state() -> None:
    """A declination is continued, and a perfect sensor has the floor of 0.003 deg."""
    mean, covariance = f64((199.9, 0.1, 0.0), (60.0, 0.0, 0.0), (2e4, 0.0, 0.0)), f64(0.0).expand(3, 3, 3)
    found = [
        surprise(FieldTrack(mean / unit[:, None], covariance), f64(0.0, 0.0), f64(-160.0, 60.0, 2e4), (0.0,) * 3, unit)
        for unit in (f64(0.3, 1.5, 100.0), 1e-4 * f64(0.3, 1.5, 100.0))
    ]
    assert found == pytest.approx([(0.1 / 0.003) ** 2 / 3] * 2)
