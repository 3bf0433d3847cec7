"""Flights whose data sheet is wrong: a vehicle may be lost, but must not say that it has arrived."""

from __future__ import annotations

from collections import Counter
from functools import cache

import numpy as np
import pytest
from ppigrf import igrf
from wrong_sheets import DATE, OUTCOMES, ROWS, Field, Flight, at, flown

FLIGHTS, CONFIDENCE, SEED, VEHICLES = 12, 0.9, 78, ("ship", "underwater")
BROKEN = (
    *("start-100-km", "start-unknown", "start-unknown-crust-30", "crust-30", "crust-60", "crust-90"),
    *("nothing-crust-60", "storm-on-path", "date-2015", "anomaly-133", "anomaly-266", "gyro"),
)


@cache
def flights(row: str) -> list[Flight]:
    return [flown(ROWS[row], VEHICLES[k % 2], k, SEED, confidence=CONFIDENCE) for k in range(FLIGHTS)]


@pytest.mark.slow
@pytest.mark.parametrize("row", ["right", "spike"])
def test_a_right_sheet_and_a_spike_cost_no_flight(row: str) -> None:
    assert sum(flight.outcome in OUTCOMES[:2] for flight in flights(row)) >= 9
    assert sum(flight.outcome == OUTCOMES[2] for flight in flights(row)) <= 2
    fits = [flight.fit for flight in flights(row)]
    assert np.median(fits) > 0.05
    assert row == "spike" or np.quantile(fits, 0.1) > 0.01


@pytest.mark.slow
def test_a_wrong_sheet_is_no_false_arrival() -> None:
    false = {row: sum(flight.outcome == OUTCOMES[2] for flight in flights(row)) for row in BROKEN}
    assert sum(false.values()) <= (1 - CONFIDENCE) * FLIGHTS * len(BROKEN), false


@pytest.mark.slow
def test_integrity_makes_false_arrivals_rare() -> None:
    """Of those from a wrong start and in a storm; arrivals of a right sheet stay."""
    ends = {
        (row, integrity): Counter(flown(ROWS[row], "ship", k, SEED, integrity=integrity).outcome for k in range(24))
        for row in ("start-100-km", "storm-on-path", "right")
        for integrity in (False, True)
    }
    false = [sum(counts["false"] for (_, on), counts in ends.items() if on == integrity) for integrity in (False, True)]
    assert false[1] < false[0] / 2
    assert ends["right", True]["arrived"] >= 14


def test_the_field_is_that_of_ppigrf_and_a_crust_the_gradient_of_a_potential() -> None:
    place, when = (52.0, -179.99), np.datetime64(DATE)
    east, north, up = (part.item() for part in igrf(*place[::-1], 1.0, when))
    fields = [Field(ROWS["crust-60"], place, np.random.default_rng(seed)) for seed in range(200)]
    np.testing.assert_allclose(fields[0](place, 1.0) - fields[0].anomaly(place, 1.0), (north, east, -up), atol=0.1)
    assert np.sqrt(np.mean([field.anomaly(place, 0.0) ** 2 for field in fields])) == pytest.approx(60.0, rel=0.1)
    moved = at(place, np.array((1.0, 0.0))), at(place, np.array((0.0, 1.0))), place
    slopes = np.array([fields[0].anomaly(x, z) for x, z in zip(moved, (0.0, 0.0, -1.0), strict=True)])
    slopes -= fields[0].anomaly(place, 0.0)  # nT / km northward, eastward, downward
    assert np.trace(slopes) == pytest.approx(0.0, abs=0.05)
    np.testing.assert_allclose(slopes, slopes.T, atol=0.05)
