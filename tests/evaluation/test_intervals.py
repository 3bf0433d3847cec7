"""Intervals and averages over runs, against hand-worked cases, the normal approximation and SciPy."""

import itertools
import math

import pytest
import scipy.stats
import torch
from torch import Tensor

from magrl.evaluation.intervals import bootstrap_interval, interquartile_mean, stratified_bootstrap, wilson_interval


def test_wilson_interval() -> None:
    for rate, count, expected in ((0.5, 10, (0.2366, 0.7634)), (0.0, 20, (0.0, 0.1611)), (1.0, 20, (0.8389, 1.0))):
        assert wilson_interval(rate, count) == pytest.approx(expected, abs=1e-4)


def test_wilson_interval_stays_within_all_and_nothing() -> None:
    assert all(wilson_interval(1.0, count)[1] <= 1 for count in range(1, 500))
    assert all(wilson_interval(0.0, count)[0] >= 0 for count in range(1, 500))


def test_bootstrap_interval_of_a_known_spread() -> None:
    torch.manual_seed(0)
    values = torch.randn(2000, dtype=torch.float64)
    low, high = bootstrap_interval(values)
    half = 1.96 * values.std().item() / math.sqrt(2000)
    assert low == pytest.approx(values.mean().item() - half, abs=0.005)
    assert high == pytest.approx(values.mean().item() + half, abs=0.005)
    assert bootstrap_interval(values) == bootstrap_interval(values, 1000, 0) == (low, high)


def test_interquartile_mean_by_hand() -> None:
    """A quarter of 4, 5 and 20 values is 1, 1 and 5; of fewer than 4 nothing is left out."""
    assert interquartile_mean(torch.tensor([10.0, 1.0, 2.0, 0.0])).item() == 1.5
    assert interquartile_mean(torch.tensor([[-90.0, 1.0, 2.0, 3.0, 90.0], [1.0, 1.0, 1.0, 9.0, 9.0]])).tolist() == [
        2,
        pytest.approx(11 / 3),
    ]
    assert interquartile_mean(torch.arange(20.0) ** 2).item() == sum(x * x for x in range(5, 15)) / 10
    assert interquartile_mean(torch.tensor([1.0, 2.0, 9.0])).item() == 4
    assert interquartile_mean(torch.tensor([1.0, 2.0, 3.0, math.nan])).isnan()


def test_interquartile_mean_is_that_of_scipy() -> None:
    for count in (1, 3, 4, 7, 20, 41):
        values = torch.rand(6, count, generator=torch.Generator().manual_seed(count), dtype=torch.float64)
        expected = scipy.stats.trim_mean(values.numpy(), 0.25, axis=1)
        assert interquartile_mean(values).numpy() == pytest.approx(expected, abs=1e-12)


def scores(count: int, seed: int = 0) -> Tensor:
    return 99 - torch.rand(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) ** 2


def test_stratified_bootstrap_is_that_of_scipy() -> None:
    """Of one stratum; both ends within the noise of 10 000 resamples."""
    values = scores(20)
    options = {"n_resamples": 10_000, "method": "percentile", "rng": 1}
    expected = scipy.stats.bootstrap((values.numpy(),), lambda x, axis: scipy.stats.trim_mean(x, 0.25, axis), **options)
    assert stratified_bootstrap([values]) == pytest.approx(tuple(expected.confidence_interval), abs=0.01)


def test_stratified_bootstrap_draws_within_strata() -> None:
    """Two groups without any spread: every resample has as many of each, so that the mean is always the same."""
    low, high = torch.zeros(10), torch.full((10,), 100.0)
    assert stratified_bootstrap([low, high]) == (50, 50)
    pooled = stratified_bootstrap([torch.cat((low, high))])
    assert pooled[0] < 20
    assert pooled[1] > 80


def test_stratified_bootstrap_shrinks_holds_the_mean_and_repeats() -> None:
    widths = []
    for count in (5, 20, 80, 320):
        values = scores(count)
        low, high = stratified_bootstrap([values])
        assert low < interquartile_mean(values).item() < high
        assert stratified_bootstrap([values]) == (low, high)
        widths.append(high - low)
    ratios = [after / before for before, after in itertools.pairwise(widths)]
    assert stratified_bootstrap([values], seed=1) != (low, high)
    assert all(0.3 < ratio < 0.75 for ratio in ratios), ratios  # four times the runs, half the width
    assert all(math.isnan(end) for end in stratified_bootstrap([torch.tensor([1.0, math.nan])]))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: bootstrap_interval(torch.zeros(2, 2)), r"values must be of shape \(M,\).*\(2, 2\)"),
        (lambda: stratified_bootstrap([torch.ones(0)]), r"strata must each be of shape \(R,\)"),
        (lambda: interquartile_mean(torch.zeros(2, 0)), r"values must be of shape \(\.\.\., R\).*\(2, 0\)"),
        (lambda: stratified_bootstrap([]), r"strata must each be of shape \(R,\) with R >= 1, got \[\]"),
        (lambda: wilson_interval(1.01, 10), "rate must be a finite number from 0 up to 1, got 1.01"),
        (lambda: wilson_interval(-0.01, 10), "rate must be a finite number from 0 up to 1, got -0.01"),
        (lambda: wilson_interval(0.5, 0), "count must be a whole number from 1 on, got 0"),
    ],
)
def test_bad_values_are_refused(call, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


def test_intervals_accept_their_bounds() -> None:
    assert bootstrap_interval(torch.ones(1), 1, -1) == (1.0, 1.0)
    for rate in (0.0, 1.0):
        low, high = wilson_interval(rate, 1)
        assert 0 <= low < high <= 1
