"""How surprising the readings of a flight are, where everything stated is true."""

from __future__ import annotations

from typing import NamedTuple

from magrl.tracking import Track
from magrl.tracking.anomalies import joint_tail

LEAST_FIT = 0.01
"""Fit of the readings (:class:`Command`) below which a vehicle does not say that it has arrived."""
LOST_SURPRISE = 20.0
"""Mean of the last surprises (:class:`~magrl.tracking.Track`) beyond which the readings contradict each other. With the
right accuracy, it stayed below 7 in simulation, under the conditions of four vehicles."""
_LAST, _LEAST = 8, 2


class Doubt(NamedTuple):
    """The last surprises, the tail probability of the first reading, where the start is known, of the last ones,
    and the least fit so far: a doubt stays until a fix of the position.

    Example:
        >>> Doubt().lost, Doubt(surprises=(900.0, 1100.0)).lost
        (False, True)
    """

    surprises: tuple[float, ...] = ()
    start: tuple[float, ...] = ()
    tails: tuple[float, ...] = ()
    fit: float = 1.0

    @property
    def level(self) -> float:
        """Mean of the last surprises."""
        return sum(self.surprises) / max(len(self.surprises), 1)

    @property
    def lost(self) -> bool:
        """Whether the readings contradict each other."""
        return len(self.surprises) >= _LEAST and self.level > LOST_SURPRISE

    def after(self, track: Track, *, first: bool) -> Doubt:
        """Return the doubt after a reading."""
        tail = (track.tail.item(),)
        start, tails = (tail, ()) if first else (self.start, (*self.tails, *tail)[-_LAST:])
        surprises = self.surprises if first else (*self.surprises, track.surprise.item())[-_LAST:]
        return Doubt(surprises, start, tails, min(self.fit, joint_tail(start + tails)))
