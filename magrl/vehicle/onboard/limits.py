"""Limits of a policy and of a vehicle: the longest move, the largest turn, the range of the field, and sensors."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tensordict.nn import TensorDictModuleBase

from magrl.field.elements import NAMES, UNITS
from magrl.tracking.planning import MISSING_KM, SLOPES
from magrl.transforms import ObservationView, TrackView

LEAST_NT = 2000.0
"""Least B_H for an agent without a map: below, it fails more often (docs/earth.md, the whole globe) [nT]."""

STUCK_KM = (100.0, 400.0)
"""Path without a change of any element, and of one element, after which a sensor counts as stuck, but at least 2 and 8
of the longest moves [km]. Coarse readings of one element can stay equal that long; chosen."""
LONGER = 1.1
"""A move may be as many times as long as the longest one that is commanded."""

View = ObservationView | TrackView | None
Path = tuple[float, float, float]
Reading = tuple[float | None, float | None, float | None]


def view_of(policy: TensorDictModuleBase) -> View:
    """Return what a trained policy observes; None for a navigator, or a policy of no region.

    Example:
        >>> from magrl.agents import load_pretrained
        >>> view_of(load_pretrained("anywhere")).max_steps
        120
    """
    view = getattr(getattr(policy, "config", policy), "view", None)
    return view if isinstance(view, (ObservationView, TrackView)) else None


def move_limits(
    policy: TensorDictModuleBase | None, max_move_km: float | None = None, max_turn_deg: float | None = None
) -> tuple[float, float]:
    """Return the longest move [km] and the largest turn [deg] of a vehicle that follows a policy.

    Args:
        policy: policy or navigator; None for one that is made for the vehicle.
        max_move_km: longest move of the vehicle; by default that of the policy, or 50 km.
        max_turn_deg: its largest turn to either side; by default that of the policy, or 90 degrees.

    Raises:
        ValueError: for a vehicle that cannot do what the policy commands.

    Example:
        >>> move_limits(None, max_move_km=20.0)
        (20.0, 90.0)
    """
    source = policy if policy is None else view_of(policy) or policy
    move, turn = getattr(source, "max_move_km", 0.0), math.degrees(getattr(source, "max_turn_rad", 0.0))
    limits = []
    for name, value, commanded, usual in (
        ("max_move_km", max_move_km, move, 50.0),
        ("max_turn_deg", max_turn_deg, turn, 90.0),
    ):
        if value is not None and value < commanded * (1 - 1e-6):
            raise ValueError(f"{name} must be at least {commanded:g}, which the policy commands, got {value!r}")
        limits.append(float(commanded or usual) if value is None else value)
    return limits[0], limits[1]


def out_of_range(view: View, elements: Sequence[float]) -> str:
    """Return which element is beyond the range that a policy was trained or tested in, as text; empty if none is.

    For a policy of a region, its :attr:`~magrl.transforms.ObservationView.field_limits`; for one that reads its own
    track, B_H of at least :data:`LEAST_NT`.

    Args:
        view: from :func:`view_of`.
        elements: D [deg], I [deg], B_H [nT].

    Example:
        >>> from magrl.agents import load_pretrained
        >>> out_of_range(view_of(load_pretrained("anywhere")), (0.0, 88.0, 1500.0))
        'B_H 1500 nT is out of the range of the policy, 2000 to inf nT'
    """
    low: Sequence[float] = (-180.0, -90.0, 0.0)
    high: Sequence[float] = (180.0, 90.0, math.inf)
    if isinstance(view, TrackView):
        low = (-180.0, -90.0, LEAST_NT)
    elif view is not None:
        low, high = view.field_limits
    for name, unit, value, least, most in zip(NAMES, UNITS, elements, low, high, strict=True):
        if not least <= value <= most:
            return f"{name} {value:g} {unit} is out of the range of the policy, {least:g} to {most:g} {unit}"
    return ""


def measured(std: Sequence[float]) -> tuple[bool, ...]:
    """Return which elements a vehicle measures: those whose standard deviation is less than their change over 1000 km.

    Args:
        std: standard deviations of the reading's noise: D [deg], I [deg], B_H [nT].

    Example:
        >>> measured((1e4, 0.02, 2.0))
        (False, True, True)
    """
    return tuple(value / slope < MISSING_KM for value, slope in zip(std, SLOPES, strict=True))


def unchanged_km(unchanged: Sequence[float], before: Sequence[float], after: Reading, move_km: float) -> Path:
    """Return the path since each element last changed ``(3,)`` [km], without moves that end without reading it.

    Args:
        unchanged: that path before the move.
        before: D, I, B_H before the move.
        after: the same after it; None for an element that was not read.
        move_km: its length.

    Example:
        >>> unchanged_km((30.0, 30.0, 30.0), (3.5, 73.0, 15000.0), (3.5, 73.1, None), 20.0)
        (50.0, 0.0, 30.0)
    """
    first, second, third = (
        km if new is None else km + move_km if new == old else 0.0
        for km, old, new in zip(unchanged, before, after, strict=True)
    )
    return first, second, third


def stuck(unchanged: Sequence[float], max_move_km: float) -> str:
    """Return which readings are those of a stuck sensor, as text; empty if none is.

    Args:
        unchanged: from :func:`unchanged_km`; 0 for an element that is not measured.
        max_move_km: longest move.

    Example:
        >>> stuck((450.0, 20.0, 0.0), max_move_km=50.0)
        'no change of D over 400 km: a sensor is stuck'
    """
    every_km, one_km = (max(km, moves * max_move_km) for km, moves in zip(STUCK_KM, (2, 8), strict=True))
    least_km = every_km if min(unchanged) >= every_km else one_km
    names = [name for name, km in zip(NAMES, unchanged, strict=True) if km >= least_km]
    return f"no change of {', '.join(names)} over {least_km:.0f} km: a sensor is stuck" if names else ""


def check_move(distance_km: float, max_move_km: float) -> None:
    """Raise unless a vehicle can have made a move.

    Args:
        distance_km: its length.
        max_move_km: longest move; a vehicle may drift a tenth farther.

    Raises:
        ValueError: naming the value and what would be right.

    Example:
        >>> check_move(30.0, max_move_km=50.0)
    """
    if distance_km > LONGER * max_move_km:
        raise ValueError(
            f"distance {distance_km:g} km is longer than the longest move of this vehicle, {max_move_km:g} km: it must "
            "be in kilometers, and since the last step; report a longer way in parts, None for the readings between"
        )
