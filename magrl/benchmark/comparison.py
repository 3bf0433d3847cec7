"""Comparison of claimed episodes with flown ones. All limits come from the track and from what the verifier flies."""

from __future__ import annotations

import math

import numpy as np
import pandas

from magrl.benchmark.tracks import DRIFT_KM, Track
from magrl.geodesy import geodesic

BETTER = {"success": 1, "false_arrival": -1, "spl": 1, "steps": -1, "final_distance_km": -1}
"""Measures whose means are compared, and the sign of an improvement."""
TOLERANCE = {"success": 0, "false_arrival": 0, "spl": 1e-3, "steps": 0, "final_distance_km": 0.1}
"""Largest difference of a repeated episode. Other sizes of the batch change SPL by 1e-7 and distances by 0.1 m."""
STANDARD_ERRORS = 4.0
"""By how many standard errors a claimed mean may exceed the one that is flown."""
EXTREMES = round(STANDARD_ERRORS**2 / 2)
"""How many episodes at each end of the range are added to those that are flown, for a variance of what is rare.

Source:
    A. Agresti, B. Coull, Approximate is better than "exact" for interval estimation of binomial proportions, The
    American Statistician 52 (1998).
"""
MARGIN = 0.005
"""How much more a mean may exceed the flown one, as a share of 1, of the step limit and of the longest task."""
TOO_GOOD = " (too good)"
"""Mark of a mean that is claimed beyond its limit."""


def impossible(claimed: pandas.DataFrame, track: Track, navigator: str) -> list[str]:
    """Return what is wrong with rows that the track does not allow, or that contradict themselves.

    Args:
        claimed: episodes, whose tasks and levels are known to be those of the track.
        track: their track.
        navigator: name that the rows must have.
    """
    tasks, task = track.scenario.tasks, claimed["task"].to_list()
    assert tasks is not None
    success, spl, end_km = claimed["success"], claimed["spl"], claimed["final_distance_km"]
    shortest_km = geodesic(*tasks.start[task].unbind(-1), *tasks.target[task].unbind(-1))[0].numpy()
    reach_km = 1.001 * claimed["steps"] * (track.scenario.max_move_km + DRIFT_KM * bool(track.conditions))
    rules = {
        f"navigator {navigator}": claimed["navigator"] == navigator,
        "run 0": claimed["run"] == 0,
        "the region of the task": claimed["region"] == tasks.region[task].numpy(),
        f"seed {track.seed}": claimed["seed"] == track.seed,
        f"steps from 1 to {track.max_steps}": claimed["steps"].between(1, track.max_steps),
        "spl in (0, 1] with success, 0 without": spl.between(0, 1) & ((spl > 0) == success),
        "an spl that the steps allow": ~success | (spl == 1) | (shortest_km <= spl * reach_km),
        "a final_distance_km that the steps allow": (end_km >= 0) & ((end_km - shortest_km).abs() <= reach_km),
        "success near enough": ~success | (end_km <= (track.within_km or track.signal_km or math.inf)),
        "false_arrival without success": ~claimed["false_arrival"] | (~success & bool(track.within_km)),
    }
    broken = {rule: claimed[~holds].iloc[0] for rule, holds in rules.items() if not holds.all()}
    return [f"not all rows have {rule}: level {row['level']}, task {row['task']}" for rule, row in broken.items()]


def different(rows: pandas.DataFrame, again: pandas.DataFrame) -> pandas.MultiIndex:
    """Return level and task of the episodes that both tables hold and that end differently."""
    one, other = (table.set_index(["level", "task"])[list(TOLERANCE)].astype(float) for table in (rows, again))
    apart = ((one - other).abs() > pandas.Series(TOLERANCE)).any(axis=1)  # NaN where one table lacks the episode
    return apart.index[apart]


def compared(
    what: str, claim: pandas.DataFrame, flown: pandas.DataFrame, track: Track, apart: pandas.MultiIndex | None = None
) -> list[str]:
    """Return the means of each measure in a text for each level, with :data:`TOO_GOOD` where a claim exceeds its limit.

    The variance is that of the flown episodes. Episodes of other tasks are independent; of the same tasks, those that
    end differently are.

    Args:
        what: what is compared, for the text.
        claim: episodes of a submission.
        flown: episodes of the verifier.
        track: their track.
        apart: level and task of those that end differently, where both are of the same tasks.
    """
    found, units = [], (1, 1, 1, track.max_steps, track.distance_km[1])
    for level in track.errors:
        one, other = (table[table["level"] == level] for table in (claim, flown))
        share = 1 + len(other) / len(one)
        if apart is not None:
            share = 2 * (apart.get_level_values("level") == level).sum() / len(other)
        texts = []
        for (name, sign), unit in zip(BETTER.items(), units, strict=True):
            mean, real = one[name].mean(), other[name].mean()
            sample = np.array([*other[name], *EXTREMES * [0, unit]], float)
            error = math.sqrt(share * sample.var() / len(sample))
            excess = bool(sign * (mean - real) > STANDARD_ERRORS * error + MARGIN * unit)
            texts.append(f"{name} {mean:.4g} for {real:.4g} ± {error:.2g}{TOO_GOOD * excess}")
        found.append(f"{what}, {level}, claimed for flown: {', '.join(texts)}")
    return found
