"""Options of episodes, from the environment or its scenario: limits of steps and moves, arrival, start heading."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from magrl.checks import check_number
from magrl.envs.arrival import Arrival
from magrl.envs.scenario import Scenario

DEFAULTS: dict[str, Any] = {
    "max_steps": 50,
    "max_move_km": 50.0,
    "max_turn_rad": math.pi / 2,
    "zeta": 0.01,
    "arrival": "objective",
    "arrival_radius_km": 25.0,
    "start_heading": "north",
}
"""Options that neither the environment nor its scenario is given."""
START_HEADINGS = ("north", "random")


class EpisodeOptions(NamedTuple):
    """Options of episodes, checked.

    Example:
        >>> EpisodeOptions(50, 50.0, 1.5, Arrival("objective", 0.01, 25.0), "north").max_steps
        50
    """

    max_steps: int
    max_move_km: float
    max_turn_rad: float
    arrival: Arrival
    start_heading: str


def episode_options(scenario: Scenario, **given: Any) -> EpisodeOptions:
    """Return the options of episodes: those that are given, else those of the scenario, else :data:`DEFAULTS`.

    Args:
        scenario: its fields of the same names; its ``max_turn_deg`` is ``max_turn_rad``.
        **given: options by the names of :data:`DEFAULTS`, or None.

    Raises:
        ValueError: for an option out of its range, naming it and its value, or one that contradicts the scenario.

    Example:
        >>> episode_options(Scenario(max_steps=80), max_move_km=20.0)[:2]
        (80, 20.0)
    """
    options = {}
    for name, default in DEFAULTS.items():
        value, said = given.get(name), _said(scenario, name)
        if value is not None and said is not None and value != said:
            raise ValueError(
                f"{name} is {said!r} in the scenario, and {value!r} was given: give one of them, or change the "
                "scenario with scenario.replace"
            )
        options[name] = next((x for x in (value, said) if x is not None), default)
    steps, move_km, turn_rad, zeta, rule, radius_km, heading = options.values()
    check_number(1, whole=True, max_steps=steps)
    check_number(0, 1000, above=True, max_move_km=move_km)  # a move is one short leg
    check_number(0, math.pi, above=True, max_turn_rad=turn_rad)
    arrival = Arrival(rule, zeta, radius_km)
    if heading not in START_HEADINGS:
        raise ValueError(f"start_heading must be 'north' or 'random', got {heading!r}")
    return EpisodeOptions(steps, float(move_km), float(turn_rad), arrival, heading)


def _said(scenario: Scenario, name: str) -> Any:
    """Return an option of a scenario, or None."""
    if name != "max_turn_rad":
        return getattr(scenario, name)
    return None if scenario.max_turn_deg is None else math.radians(scenario.max_turn_deg)
