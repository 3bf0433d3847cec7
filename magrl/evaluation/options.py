"""Scenarios of evaluations: frozen trips, and the scenario keys that a command line can change."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from magrl.checks import check_number
from magrl.envs import Scenario, Trips, load_scenario, named_trips
from magrl.envs.scenario import RULES, rule_settings
from magrl.envs.trips import RANDOM_SETS
from magrl.random_numbers import FIRST_RESERVED_SEED

TripSet = Literal["test-1000", "paper-100", "paper-example"]
FIRST_TRIPS_SEED = 2 * FIRST_RESERVED_SEED
"""Seed of random trips with --trips-seed 0: beyond the seeds of trainings and of frozen sets."""

ScenarioOptions: Any = rule_settings(**dict.fromkeys((*RULES, "altitude_km")))
"""Fields of a scenario that a command line can change, each None for its value in the scenario's file or in the
trainings, or its default."""


def choose_trips(path: Path | None, trips: str | int | None, trips_seed: int | None = None, **changes: Any) -> Scenario:
    """Return a scenario with frozen trips.

    Args:
        path: scenario file; the paper's scenario by default.
        trips: trip set, or number of random trips; by default the scenario's own trips, or ``test-1000`` where it has
            none.
        trips_seed: seed of random trips; 0 by default.
        **changes: keys of the scenario that replace its own.

    Raises:
        ValueError: for a file that is not a scenario, the paper's example trip in another scenario, or a seed for trips
            that are not random.
        FileNotFoundError: for a missing file.

    Example:
        >>> choose_trips(None, 30, 7).trips.start.shape
        torch.Size([30, 2])
    """
    scenario = Scenario(**changes) if path is None else load_scenario(path, **changes)
    if isinstance(trips, int):
        trips_seed = 0 if trips_seed is None else trips_seed
        check_number(0, 2**62, whole=True, trips_seed=trips_seed)
        return scenario.with_trips(scenario.random_trips(trips, FIRST_TRIPS_SEED + trips_seed))
    if trips_seed is not None:
        raise ValueError(f"--trips-seed {trips_seed} needs a number of random trips, such as --trips 300")
    if path is None:
        return scenario.with_trips(named_trips(trips or "test-1000"))
    if trips == "paper-example":
        raise ValueError("--trips paper-example lies in the paper's region: omit it, or --scenario")
    if scenario.trips is not None and trips is None:
        return scenario
    return scenario.with_trips(scenario.random_trips(*RANDOM_SETS[trips or "test-1000"]))


def first_trips(scenario: Scenario, num_trips: int) -> Scenario:
    """Return a scenario with its first trips only.

    Raises:
        ValueError: for fewer than one trip, or more than it has.

    Example:
        >>> first_trips(choose_trips(None, "paper-100"), 3).trips.start.shape
        torch.Size([3, 2])
    """
    assert scenario.trips is not None
    check_number(1, len(scenario.trips.start), whole=True, num_trips=num_trips)
    trips = Trips(*(values[:num_trips] for values in scenario.trips))
    return scenario.replace(trips=trips, names=scenario.names[:num_trips])
