"""Integrity: a claim of an arrival must hold though start, drift or anomalies are not as stated.

Beside the estimate by what is stated, a vehicle that knows its start keeps two on the same legs and readings: one for a
start, one for a drift that are stated much too well. Each has a probability, which changes by the likelihood of the
readings, and gives one of an arrival. That of a claim is their mean. Without a start, expected anomalies must be small.

Source:
    D. T. Magill, Optimal adaptive estimation of sampled stochastic processes, IEEE Transactions on Automatic Control 10
    (1965). RAIM separates such solutions by thresholds in place of probabilities: J. Blanch et al., Baseline advanced
    RAIM user algorithm and possible improvements, IEEE Transactions on Aerospace and Electronic Systems 51 (2015).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from magrl.pilot import Reading, Rules, goal_of, started
from magrl.pilot.destination import posterior
from magrl.pilot.records import FARTHEST_START_KM, State

DRIFT = 0.1
"""Drift of the third estimate [share of the distance]; the second has a start of 100 km."""
PRIOR = (0.5, 0.2, 0.3)
"""Their probabilities at the start: all is as stated, the start is not, the drift is not. Chosen on flights of the
simulator of the tests, with other seeds than those of the documentation."""
MOST_ANOMALY_NT = 30.0
"""Expected anomaly above which no claim holds without a known start [nT]; chosen on the same."""


class Hypothesis(NamedTuple):
    """What is assumed, its probability, and the probability that the destination is within the radius if it is right.

    Example:
        >>> Hypothesis("a start to 100 km", 0.4, 0.1).probability
        0.4
    """

    name: str
    probability: float
    arrival: float


NAMES = "all as stated", f"a start to {FARTHEST_START_KM:g} km", f"a drift of {DRIFT:g}"


def begun(rules: Rules, reading: Reading) -> tuple[State, Tensor, Tensor, Tensor]:
    """Return the states ``(K, ...)`` after the first reading, with surprise, tail and evidence ``(K,)``: by what is
    stated, and, for integrity and from a known start, by the other hypotheses."""
    each = [rules]
    if rules.integrity and rules.start_km is not None:
        each += [rules.replace(start_km=FARTHEST_START_KM), rules.replace(drift=max(DRIFT, rules.drift))]
    states, surprises, tails, evidence = zip(*(started(stated, reading) for stated in each), strict=True)
    together = State(*map(torch.stack, zip(*states, strict=True)))
    return together, torch.stack(surprises), torch.stack(tails), torch.stack(evidence)


def hypotheses(
    rules: Rules, states: State, reading: Reading, evidence: Tensor, stated: Tensor
) -> tuple[Hypothesis, ...]:
    """Return the hypotheses after a reading.

    Args:
        rules: of the vehicle.
        states: ``(K, ...)`` by them.
        reading: the last one.
        evidence: ``(K,)`` of all readings.
        stated: probability ``()`` of an arrival by what is stated.
    """
    others = [State(*parts) for parts in zip(*states, strict=True)][1:]
    arrivals = [posterior(goal_of(rules, other, reading)).within(rules.radius_km) for other in others]
    weights = torch.softmax(evidence + torch.tensor(PRIOR[: len(evidence)]).log(), 0)
    rows = zip(NAMES, weights.tolist(), torch.stack((stated, *arrivals)).tolist(), strict=False)
    return tuple(Hypothesis(*row) for row in rows)


def probability(held: Sequence[Hypothesis]) -> float:
    """Return the probability of an arrival by all hypotheses."""
    return sum(one.probability * one.arrival for one in held)


def objection(rules: Rules, held: Sequence[Hypothesis], crust_nt: float) -> str:
    """Return what is against an arrival, as text; empty if nothing is.

    Args:
        rules: of the vehicle.
        held: its hypotheses.
        crust_nt: expected size of anomalies [nT].

    Example:
        >>> objection(Rules(integrity=True), [Hypothesis("all as stated", 1.0, 0.9)], 50.0)
        'anomalies of 50 nT are expected, of at most 30 without a known start'
        >>> held = Hypothesis("all as stated", 0.5, 0.9), Hypothesis("a start to 100 km", 0.5, 0.1)
        >>> objection(Rules(integrity=True, confidence=0.8), held, 0.0)
        '0.10 by a start to 100 km, whose own probability is 0.50'
    """
    if len(held) == 1 and rules.integrity and crust_nt > MOST_ANOMALY_NT:
        return f"anomalies of {crust_nt:.0f} nT are expected, of at most {MOST_ANOMALY_NT:g} without a known start"
    if probability(held) >= rules.confidence:
        return ""
    name, weight, arrival = max(held, key=lambda one: one.probability * (1 - one.arrival))
    return f"{arrival:.2f} by {name}, whose own probability is {weight:.2f}"
