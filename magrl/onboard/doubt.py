"""How surprising the readings of a flight are, where everything stated is true, and sensors that hang."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch

from magrl.field.elements import NAMES
from magrl.onboard.journal import Step
from magrl.pilot import Track
from magrl.pilot.anomalies import joint_tail
from magrl.pilot.belief import elements
from magrl.pilot.records import State

LEAST_FIT = 0.01
"""Fit of the readings (:class:`Command`) below which a vehicle does not say that it has arrived."""
LOST_SURPRISE = 20.0
"""Mean of the last surprises (:class:`~magrl.pilot.Track`) beyond which the readings contradict each other. With the
right accuracy, it stayed below 7 in simulation, under the conditions of four vehicles."""
_LAST, _LEAST = 8, 2
HANGS = 5.0
"""Expected change of an element along a leg, in standard deviations of its noise, after which an equal reading is that
of a sensor that hangs. Of 120 ships whose D froze (row frozen-d of tests/onboard/wrong_sheets.py, seed 20261129), 80
arrive, 4 claim it falsely and 28 are lost; with 20, it is 41, 3 and 74."""


class Doubt(NamedTuple):
    """The last surprises, the tail probability of the first reading, where the start is known, of the last ones,
    the least fit so far, which stays until a fix of the position, and of which elements a sensor hangs.

    Example:
        >>> Doubt().lost, Doubt(surprises=(900.0, 1100.0)).lost
        (False, True)
    """

    surprises: tuple[float, ...] = ()
    start: tuple[float, ...] = ()
    tails: tuple[float, ...] = ()
    fit: float = 1.0
    hung: tuple[bool, ...] = (False, False, False)

    @property
    def level(self) -> float:
        """Mean of the last surprises."""
        return sum(self.surprises) / max(len(self.surprises), 1)

    @property
    def lost(self) -> bool:
        """Whether the readings contradict each other."""
        return len(self.surprises) >= _LEAST and not self.level <= LOST_SURPRISE

    @property
    def contradiction(self) -> str:
        """By how much readings contradict each other, with likely causes, as text."""
        return (
            f"readings deviate {self.level**0.5:.0f} times as much as expected: either elements are wrong (the sign of "
            "I, its zero at the horizontal, their order, units), or heading or log drift more than stated, the "
            "altitude changed, or a storm or a large anomaly disturbs the field"
        )

    @property
    def text(self) -> str:
        """Which elements are not read any more, as text."""
        names = ", ".join(name for name, off in zip(NAMES, self.hung, strict=True) if off)
        return names and f"{names} stayed the same along a leg that changes it: it is not read any more"

    def found(self, state: State | None, noise: Sequence[float], last: Sequence[float], step: Step) -> Doubt:
        """Return the doubt with the sensors that hang: they show the last reading after a leg that changes it.

        Args:
            state: before the leg; None at the start.
            noise: standard deviations of the noise of D [deg], I [deg], B_H [nT]; one of 0 is never found to hang.
            last: reading before the leg.
            step: leg and reading at its end.
        """
        if state is None:
            return self
        equal = [new == old and std > 0 for new, old, std in zip(step.elements, last, noise, strict=True)]
        if not any(equal):
            return self
        course = math.radians(step.heading) + state.north.item()
        leg = step.distance * torch.tensor((math.cos(course), math.sin(course)), dtype=torch.float64)
        change = (elements(state.belief).gradient @ leg).abs().tolist()
        rows = zip(self.hung, equal, change, noise, strict=True)
        return self._replace(hung=tuple(before or (same and off > HANGS * std) for before, same, off, std in rows))

    def after(self, track: Track, *, first: bool) -> Doubt:
        """Return the doubt after a reading."""
        tail = (track.tail.item(),)
        start, tails = (tail, ()) if first else (self.start, (*self.tails, *tail)[-_LAST:])
        surprises = self.surprises if first else (*self.surprises, track.surprise.item())[-_LAST:]
        fit = min(self.fit, joint_tail(start + tails))
        return self._replace(surprises=surprises, start=start, tails=tails, fit=fit)
