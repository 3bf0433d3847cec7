"""Rules of arrival: by the objective, as in the paper, by the distance, or by what the vehicle declares."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

from magrl.checks import check_number
from magrl.geodesy import geodesic

MAX_OBJECTIVE = 3
"""Largest objective F at the start: each of the three elements adds at most 1 (Eq. 2-6)."""


def check_zeta(zeta: float) -> float:
    """Return an arrival threshold on the objective; raise unless it lies between 0 and the largest F at the start.

    Raises:
        ValueError: with the value and the reason.

    Example:
        >>> check_zeta(5)
        Traceback (most recent call last):
        ValueError: zeta must be below 3, got 5: the objective F is at most 3 at the start, so every vehicle has arrived
    """
    check_number(0, above=True, zeta=zeta)
    if zeta >= MAX_OBJECTIVE:
        reason = f"the objective F is at most {MAX_OBJECTIVE} at the start, so every vehicle has arrived"
        raise ValueError(f"zeta must be below {MAX_OBJECTIVE}, got {zeta!r}: {reason}")
    return zeta


class Arrival(NamedTuple):
    """When an episode ends at a destination, and whether that is a success; see ``Scenario.arrival``.

    Args:
        rule: ``"objective"``: an episode ends where the objective F is below ``zeta``, which is a success.
            ``"distance"``: it ends within ``radius_km`` of the destination, which is a success. ``"declared"``: it ends
            with a move whose third number is above 0, by which the vehicle declares that it has arrived. That is a
            success within ``radius_km`` of the destination, and a false arrival elsewhere.
        zeta: arrival threshold on the objective.
        radius_km: largest distance from the destination of an arrival, or of a correct declaration [km].

    Example:
        >>> Arrival("declared", zeta=0.01, radius_km=25.0).declared
        True
    """

    rule: str
    zeta: float
    radius_km: float

    @property
    def declared(self) -> bool:
        """Whether the vehicle declares its arrival."""
        return self.rule == "declared"

    def __call__(self, action: Tensor, objective: Tensor, place: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Return whether episodes end with an arrival, and whether an arrival counts as a success there.

        Args:
            action: ``(N, 2)``, or ``(N, 3)`` by declaration.
            objective: ``(N, 1)`` objective F at the vehicle's place.
            place: ``(N, 2)`` latitude, longitude [deg].
            target: ``(N, 2)`` destination [deg].

        Returns:
            ``(N, 1)`` bool each.
        """
        if self.rule == "objective":
            arrived = objective < self.zeta
        else:
            distance_km, _ = geodesic(*place.unbind(-1), *target.unbind(-1))
            arrived = distance_km.unsqueeze(-1) <= self.radius_km
        return (action[:, 2:] > 0 if self.declared else arrived), arrived
