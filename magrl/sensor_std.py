"""Accuracy of sensors: the standard deviations of their errors, by how long an error lasts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import torch
from torch import Tensor

from magrl.checks import check_numbers

if TYPE_CHECKING:
    from tensordict import TensorDictBase

STD_KEYS = ("sensor_std", "bias_std", "drift_std", "iron_std")
"""Keys of the fields of :class:`SensorStd` in a TensorDict, each ``(..., 3)``."""
OUTAGE_STD = 1e4
"""Standard deviation of a repeated reading, in the unit of each element: a filter ignores it."""
Noise = tuple[float, float, float]
"""Standard deviations of white noise on D [deg], I [deg], B_H [nT]."""
North = Literal["true", "magnetic"]
"""North of a vehicle: of its headings, and of D, which is measured from true north alone."""
_NONE: Noise = (0.0, 0.0, 0.0)


class SensorStd(NamedTuple):
    """Standard deviations of the errors of D [deg], I [deg], B_H [nT]: each three numbers, or tensors ``(..., 3)``.

    Args:
        noise: of errors that are new in each reading.
        bias: of all others. Infinite for D: the vehicle has no true north, and its headings are from magnetic north.
        drift: of errors that vary along the path or with the heading; at most ``bias``.
        iron: of the part of them that is a constant field in the vehicle's axes: forward, right, down [nT].

    Example:
        >>> SensorStd((0.02, 0.02, 2.0)).bias
        (0.0, 0.0, 0.0)
    """

    noise: Any = _NONE
    bias: Any = _NONE
    drift: Any = _NONE
    iron: Any = _NONE

    @property
    def magnetic(self) -> bool:
        """Whether the vehicle has no true north, of plain numbers.

        Example:
            >>> SensorStd(bias=(math.inf, 0.0, 0.0)).magnetic
            True
        """
        return math.isinf(self.bias[0])

    @classmethod
    def of(cls, sensor_std: SensorStd | Sequence[float], count: int = 3) -> SensorStd:
        """Return the record of an argument, in which numbers alone are white noise.

        Args:
            sensor_std: record of plain numbers, or ``count`` numbers.
            count: number of elements, where they are others than D, I, B_H.

        Raises:
            ValueError: for another number of elements, or a number that is negative or not finite.

        Example:
            >>> SensorStd.of((0.05, 0.05, 5)).noise
            (0.05, 0.05, 5.0)
        """
        given = sensor_std if isinstance(sensor_std, SensorStd) else (sensor_std, *[(0.0,) * count] * 3)
        for name, values in zip(cls._fields, given, strict=True):
            north = name == "bias" and count == 3 and list(values)[:1] == [math.inf]
            check_numbers(count, 0, **{f"sensor_std.{name}": (0.0, *values[1:]) if north else values})
        return cls(*(tuple(map(float, values)) for values in given))

    @classmethod
    def read(cls, tensordict: TensorDictBase | Mapping[str, Tensor]) -> SensorStd:
        """Return the standard deviations that come with a reading, at :data:`STD_KEYS`.

        Example:
            >>> SensorStd.read({key: torch.ones(3) for key in STD_KEYS}).drift
            tensor([1., 1., 1.])
        """
        return cls(*(tensordict[key] for key in STD_KEYS))

    def at(self, tensordict: TensorDictBase) -> SensorStd:
        """Return the standard deviations of a reading, given those that are stated.

        Noise and bias are the larger of the stated ones and of those that come with the reading: during an outage, or
        where readings show more noise, it is worse than stated. Drift and iron are the reading's, if it comes
        with them.

        Args:
            tensordict: ``P`` readings, with some of :data:`STD_KEYS`, or none.

        Returns:
            Each ``(P, 3)``, or as stated where readings come without.

        Example:
            >>> from tensordict import TensorDict
            >>> SensorStd(*torch.ones(4, 3)).at(TensorDict(bias_std=torch.tensor([0.5, 2.0, 1.0]))).bias
            tensor([1., 2., 1.])
        """
        noise, bias, *others = (
            stated if (own := tensordict.get(key, None)) is None else own.to(stated)
            for key, stated in zip(STD_KEYS, self, strict=True)
        )
        return SensorStd(torch.maximum(self.noise, noise), torch.maximum(self.bias, bias), *others)


PERFECT = SensorStd()
"""Sensors without errors."""
