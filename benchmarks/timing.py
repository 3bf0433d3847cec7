"""Two functions timed alternately in one run, so that what slows the machine slows both."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch

HEADER = "| baseline | magrl ms | baseline ms | speed-up | quartiles | goal |\n|---|---|---|---|---|---|\n"


@dataclass(frozen=True)
class Row:
    """A comparison of two times.

    Args:
        what: operation, and the baseline it is compared with.
        magrl_ms: median time of magrl [ms].
        baseline_ms: median time of the baseline [ms].
        speed_up: median of baseline over magrl, pair by pair.
        low: lower quartile of the speed-up.
        high: upper quartile of the speed-up.
        goal: goal of the speed-up, for a reader.
    """

    what: str
    magrl_ms: float
    baseline_ms: float
    speed_up: float
    low: float
    high: float
    goal: str = ""

    def __str__(self) -> str:
        """Return a line of the Markdown table that starts with :data:`HEADER`."""
        cells = (f"{self.magrl_ms:.3g}", f"{self.baseline_ms:.3g}", f"{self.speed_up:.2f}")
        return f"| {self.what} | {' | '.join(cells)} | {self.low:.2f}–{self.high:.2f} | {self.goal} |"


@contextmanager
def one_thread() -> Iterator[None]:
    """Use one thread in torch, and restore the number afterwards."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def alternate(
    what: str,
    magrl: Callable[[], object],
    baseline: Callable[[], object],
    *,
    repeats: int = 15,
    goal: str = "",
    inner: int = 1,
    limit_s: float = 60.0,
) -> Row:
    """Time two functions in turn, after one call of each that is not counted.

    Args:
        what: operation, and the baseline it is compared with.
        magrl: function under test.
        baseline: function that it is compared with.
        repeats: number of pairs.
        goal: goal of the speed-up.
        inner: calls that one time is the mean of, for functions of microseconds.
        limit_s: time after which no further pair is started, once there are five [s].
    """
    started = time.perf_counter()
    times: tuple[list[float], list[float]] = ([], [])
    for repeat in range(repeats + 1):
        if repeat > 5 and time.perf_counter() - started > limit_s:
            break
        for function, kept in zip((magrl, baseline), times, strict=True):
            began = time.perf_counter()
            for _ in range(inner):
                function()
            if repeat:
                kept.append((time.perf_counter() - began) * 1000 / inner)
    ratios = [b / a for a, b in zip(*times, strict=True)]
    low, ratio, high = statistics.quantiles(ratios, n=4)
    return Row(what, statistics.median(times[0]), statistics.median(times[1]), ratio, low, high, goal)
