"""Rules of arrival: by the objective, as in the paper, by the distance, or by what the vehicle declares."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from magrl.checks import check_number
from magrl.envs.measures import check_zeta
from magrl.geodesy import geodesic

ARRIVALS = ("objective", "distance", "declared")
"""Rules by name."""


@dataclass(frozen=True)
class Arrival:
    """When an episode ends at a destination, and whether that is a success.

    By ``"objective"``, an episode ends where the objective F is below ``zeta``, which is a success. By ``"distance"``,
    it ends within ``radius_km`` of the destination, which is a success. By ``"declared"``, the action has a third
    number, and an episode ends with a move of which it is above 0: the vehicle declares that it has arrived. That is a
    success within ``radius_km`` of the destination, and a false arrival elsewhere.

    Args:
        rule: ``"objective"``, ``"distance"`` or ``"declared"``.
        zeta: arrival threshold on the objective.
        radius_km: largest distance from the destination of an arrival, or of a right declaration [km].

    Raises:
        ValueError: for another rule, or a number out of its range.

    Example:
        >>> Arrival("declared", zeta=0.01, radius_km=25.0).low
        (-1.0,)
    """

    rule: str
    zeta: float
    radius_km: float

    def __post_init__(self) -> None:
        if self.rule not in ARRIVALS:
            raise ValueError(f"arrival must be one of {', '.join(map(repr, ARRIVALS))}, got {self.rule!r}")
        check_zeta(self.zeta)
        check_number(0, above=True, arrival_radius_km=self.radius_km)

    @property
    def declared(self) -> bool:
        """Whether the vehicle declares its arrival."""
        return self.rule == "declared"

    @property
    def low(self) -> tuple[float, ...]:
        """Lowest values of what the action has beside distance and turn."""
        return (-1.0,) if self.declared else ()

    @property
    def high(self) -> tuple[float, ...]:
        """Highest values of what the action has beside distance and turn."""
        return (1.0,) if self.declared else ()

    def __call__(self, action: Tensor, objective: Tensor, place: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Return whether episodes end with an arrival, and whether an arrival is right there.

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
