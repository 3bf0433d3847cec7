"""Confidence intervals of means and proportions."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from magrl.checks import check_number, check_tensor


def bootstrap_interval(values: Tensor, resamples: int = 1000, seed: int = 0) -> tuple[float, float]:
    """Return the percentile bootstrap 95 % interval of a mean.

    Args:
        values: ``(M,)``.
        resamples: number of resamples.
        seed: random seed of the resamples.

    Returns:
        Low and high end; NaN if a value is NaN.

    Raises:
        ValueError: for no values, another shape, or no resamples.

    Source:
        B. Efron, Bootstrap methods: another look at the jackknife, Annals of Statistics 7 (1979).

    Example:
        >>> bootstrap_interval(torch.ones(10))
        (1.0, 1.0)
    """
    check_tensor(values=values)
    check_number(1, whole=True, resamples=resamples)
    check_number(whole=True, seed=seed)
    if values.ndim != 1 or not len(values):
        raise ValueError(f"values must be of shape (M,) with M >= 1, got {tuple(values.shape)}")
    generator = torch.Generator().manual_seed(seed)
    draws = torch.randint(len(values), (resamples, len(values)), generator=generator)
    low, high = (
        values.cpu().double()[draws].mean(1).quantile(torch.tensor((0.025, 0.975), dtype=torch.float64)).tolist()
    )
    return low, high


def wilson_interval(rate: float, count: int, z: float = 1.96) -> tuple[float, float]:
    """Return Wilson's score interval of a proportion.

    Args:
        rate: observed proportion, in [0, 1].
        count: number of trials.
        z: normal quantile; 1.96 for 95 %.

    Returns:
        Low and high end, in [0, 1].

    Raises:
        ValueError: for a rate outside [0, 1], or no trial.

    Source:
        E. B. Wilson, Probable inference, the law of succession, and statistical inference, JASA 22 (1927).

    Example:
        >>> [round(x, 4) for x in wilson_interval(1.0, 100)]
        [0.963, 1.0]
    """
    check_number(0, 1, rate=rate)
    check_number(1, whole=True, count=count)
    check_number(0, above=True, z=z)
    center = rate + z**2 / (2 * count)
    half = z * math.sqrt(rate * (1 - rate) / count + z**2 / (4 * count**2))
    scale = 1 + z**2 / count
    return max(0.0, (center - half) / scale), min(1.0, (center + half) / scale)
