"""Probabilities of arrival, against simulations."""

import pytest
import torch
from support.tracks import f64, randn

from magrl.tracking import FieldTrack, probability_below, probability_within, surprise

NORMAL = randn(200_000, 3)


def test_the_probability_of_an_objective_is_that_of_normal_errors() -> None:
    first, target, estimate, std = (0.0, 60.0, 20000.0), (2.0, 58.0, 20500.0), (1.9, 58.1, 20480.0), (0.1, 0.1, 20.0)
    remaining = f64(*target) - f64(*estimate) + f64(*std) * NORMAL
    share = ((remaining / f64(2.0, 2.0, 500.0)).square().sum(-1) < 0.01).double().mean().item()
    assert 0.3 < share < 0.9
    assert probability_below(first, target, estimate, std, 0.01) == pytest.approx(share, abs=0.01)
    across = (179.0, 60.0, 20000.0), (-179.0, 60.0, 20000.0)  # D through 180 degrees
    near = {d: probability_below(*across, (d, 60.0, 20000.0), (1e-3, 0.0, 0.0), 0.01) for d in (-179.1, -179.5, 179.9)}
    assert near == {-179.1: 1.0, -179.5: 0.0, 179.9: 0.0}


def test_the_probability_of_a_distance_is_that_of_normal_errors() -> None:
    covariance, way = f64((100.0, 40.0), (40.0, 60.0)), f64(15.0, -5.0)
    ends = way + NORMAL[:, :2] @ torch.linalg.cholesky(covariance).mT
    share = (ends.norm(dim=-1) <= 20).double().mean().item()
    assert probability_within(way, covariance, 20.0) == pytest.approx(share, abs=0.01)


def test_the_surprise_does_not_depend_on_the_units_of_the_state() -> None:
    """A declination is continued, and a perfect sensor has the floor of 0.003 deg."""
    mean, covariance = f64((199.9, 0.1, 0.0), (60.0, 0.0, 0.0), (2e4, 0.0, 0.0)), f64(0.0).expand(3, 3, 3)
    found = [
        surprise(FieldTrack(mean / unit[:, None], covariance), f64(0.0, 0.0), f64(-160.0, 60.0, 2e4), (0.0,) * 3, unit)
        for unit in (f64(0.3, 1.5, 100.0), 1e-4 * f64(0.3, 1.5, 100.0))
    ]
    assert found == pytest.approx([(0.1 / 0.003) ** 2 / 3] * 2)
