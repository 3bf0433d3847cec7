"""The command of a step on board."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from magrl.tracking import Way


@dataclass(frozen=True)
class Command:
    """Hold the command of a step and the estimates of the destination.

    Args:
        distance_km: distance to move; 0 to stay and read again.
        turn_deg: turn before the move, to the right.
        heading_deg: heading after that turn, 0 to 360: what to steer.
        way_km: mean of the way to the destination, northward and eastward.
        way_covariance_km2: its covariance, by rows.
        confidence: estimated probability that the destination is within ``radius_km`` of the options.
        stop: None, or ``"arrived"``, ``"nearest"`` (these sensors allow no better), ``"lost"`` or ``"out of range"``;
            the distance is then 0.
        reason: why to stop, as text; in the first command, what was not checked.
        error_radius_km: radius that holds the destination with the ``confidence`` of the options.
        place: estimated latitude and longitude [deg], where the vehicle knows its start; else None.
        place_covariance_km2: covariance of the place, northward and eastward.
        drift: estimated drift of dead reckoning, such as by a current, northward and eastward [share of the way].

    Example:
        >>> Command(30.0, -5.0, 355.0, (90.0, -12.0), ((9.0, 0.0), (0.0, 16.0)), 0.0).error_km
        5.0
    """

    distance_km: float
    turn_deg: float
    heading_deg: float
    way_km: tuple[float, float]
    way_covariance_km2: tuple[tuple[float, float], tuple[float, float]]
    confidence: float
    stop: str | None = None
    reason: str = ""
    error_radius_km: float = math.inf
    place: tuple[float, float] | None = None
    place_covariance_km2: tuple[tuple[float, float], tuple[float, float]] | None = None
    drift: tuple[float, float] | None = None

    @property
    def error_km(self) -> float:
        """Root mean square error of the estimated way: the root of the trace of its covariance [km]."""
        return math.sqrt(self.way_covariance_km2[0][0] + self.way_covariance_km2[1][1])

    @property
    def axes(self) -> tuple[float, float, float]:
        """Standard deviations of the estimated way along the long axis of its ellipse and across it [km], and the
        direction of that axis [deg, 0 to 180]: a long ellipse is a line on which the destination is."""
        along, across, bearing = Way(torch.tensor(self.way_km), torch.tensor(self.way_covariance_km2)).axes()
        return along.item(), across.item(), bearing.item()
