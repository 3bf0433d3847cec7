"""Two things timed alternately in one run, so that what slows the machine slows both."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Row:
    """A ratio of two times.

    Args:
        what: is compared.
        first_ms: median time of the first [ms].
        second_ms: median time of the second [ms].
        ratio: median of second over first, pair by pair: how many times faster the first is.
        low: its lower quartile.
        high: its upper quartile.
        goal: what the ratio should be, for a reader.
    """

    what: str
    first_ms: float
    second_ms: float
    ratio: float
    low: float
    high: float
    goal: str = ""


def alternate(
    what: str,
    first: Callable[[], object],
    second: Callable[[], object],
    *,
    repeats: int = 15,
    goal: str = "",
    inner: int = 1,
) -> Row:
    """Times two functions in turn, after one call of each that is not counted.

    Args:
        what: is compared.
        first: function under test.
        second: what it is compared with.
        repeats: pairs of times.
        goal: what the ratio should be.
        inner: calls that one time is the mean of, for functions of microseconds.
    """
    times: tuple[list[float], list[float]] = ([], [])
    for repeat in range(repeats + 1):
        for function, kept in zip((first, second), times, strict=True):
            began = time.perf_counter()
            for _ in range(inner):
                function()
            if repeat:
                kept.append((time.perf_counter() - began) * 1000 / inner)
    ratios = [b / a for a, b in zip(*times, strict=True)]
    low, ratio, high = statistics.quantiles(ratios, n=4)
    return Row(what, statistics.median(times[0]), statistics.median(times[1]), ratio, low, high, goal)
