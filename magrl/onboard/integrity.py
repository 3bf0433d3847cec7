"""Integrity: a claim of an arrival must hold though start, drift or anomalies are not as stated.

Beside its own estimate, a vehicle that knows its start keeps two on the same legs and readings: one for a start, one
for a drift that are stated much too well. If all that is stated is true, such an estimate differs from its own by a
normal error whose covariance is the difference of theirs. Without a start, expected anomalies must be small.

All limits are chosen on flights of an independent simulator, which are not those of the documentation.

Source:
    J. Blanch et al., Baseline advanced RAIM user algorithm and possible improvements, IEEE Transactions on Aerospace
    and Electronic Systems 51 (2015): solution separation.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from magrl.pilot import Reading, Rules, goal_of, started
from magrl.pilot.belief import PLACE
from magrl.pilot.destination import posterior
from magrl.pilot.displacement import displacement_between
from magrl.pilot.records import FARTHEST_START_KM, State

DRIFT = 0.1
"""Drift of the second estimate [share of the distance]; the first has a start of 100 km."""
LEAST_FIT = 0.01, 0.05
"""Fit of the readings (:class:`~magrl.onboard.journal.Command`) below which no claim holds, without and with
integrity."""
MOST_SEPARATION = 6.6
"""Separation of the first estimate above which no claim holds."""
LEAST_PROBABILITY = 0.5
"""Probability of an arrival by the second below which no claim holds."""
MOST_ANOMALY_NT = 30.0
"""Expected anomaly above which no claim holds without a known start [nT]."""
LEAST_KM2 = 0.25
"""Least variance of a separation along its axes [km^2]; chosen."""


class Separation(NamedTuple):
    """What estimates say that do not rely on the stated start or drift: the normalized square of the first one's
    separation, which is chi-square of two degrees of freedom if all that is stated is true, and the probability of an
    arrival by the second.

    Example:
        >>> Separation(9.0, 0.9).start
        9.0
    """

    start: float
    drift: float


def begun(rules: Rules, reading: Reading) -> tuple[State, Tensor, Tensor]:
    """Return the state, surprise and tail after the first reading ``(K, ...)``: by what is stated, and, for integrity
    and from a known start, without relying on the start and the drift."""
    each = [rules]
    if rules.integrity and rules.start_km is not None:
        each += [rules.replace(start_km=FARTHEST_START_KM), rules.replace(drift=max(DRIFT, rules.drift))]
    states, surprises, tails = zip(*(started(stated, reading) for stated in each), strict=True)
    return State(*map(torch.stack, zip(*states, strict=True))), torch.stack(surprises), torch.stack(tails)


def separation(rules: Rules, states: State, reading: Reading) -> Separation | None:
    """Return what the other estimates say after a reading; None without any."""
    own, *others = (State(*parts) for parts in zip(*states, strict=True))
    if not others:
        return None
    here, there = own.belief, others[0].belief
    variance, axes = torch.linalg.eigh(there.covariance[PLACE, PLACE] - here.covariance[PLACE, PLACE])
    along = axes.mT @ displacement_between(here.place, there.place)
    square = (along.square() / variance.clamp_min(LEAST_KM2)).sum()
    within = posterior(goal_of(rules, others[1], reading)).within(rules.radius_km)
    return Separation(square.item(), within.item())


def objection(rules: Rules, fit: float, apart: Separation | None, crust_nt: float) -> str:
    """Return what is against an arrival, as text; empty if nothing is.

    Args:
        rules: of the vehicle.
        fit: of the readings.
        apart: by the other estimates; None without a known start.
        crust_nt: expected size of anomalies [nT].

    Example:
        >>> objection(Rules(integrity=True), 0.5, None, 50.0)
        'anomalies of 50 nT are expected, of at most 30 without a known start'
        >>> objection(Rules(integrity=True), 0.5, Separation(9.0, 0.9), 50.0)
        'without the stated start, the place is 3.0 standard errors away'
    """
    if fit < LEAST_FIT[rules.integrity]:
        return f"readings do not fit what is stated (p = {fit:.1g})"
    if not rules.integrity:
        return ""
    if apart is None:
        most = f"{MOST_ANOMALY_NT:g} without a known start"
        return f"anomalies of {crust_nt:.0f} nT are expected, of at most {most}" if crust_nt > MOST_ANOMALY_NT else ""
    if apart.start > MOST_SEPARATION:
        return f"without the stated start, the place is {apart.start**0.5:.1f} standard errors away"
    return f"it is {apart.drift:.2f} with a drift of {DRIFT:g}" if apart.drift < LEAST_PROBABILITY else ""
