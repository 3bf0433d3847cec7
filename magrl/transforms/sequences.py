"""Observation of readings and legs at each step, for policies with a memory."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from magrl.field.elements import element_difference
from magrl.sensor_std import STD_KEYS
from magrl.transforms.base import StatefulTransform

_LEG_KM = 50.0
_LEAST_LEG_KM = 0.5
_DIFFERENCE_NT = 2000.0
_RATE = 1.25  # unit of a change [nT/km]
_LEAST_NT = 1000.0  # of the horizontal intensity; below, small angles no longer hold
_FARTHEST = 6.0  # a feature; beyond, it is as at this value
_FIELD_NT, _FIELD_RANGE_NT = (25_000.0, 45_000.0), (12_000.0, 15_000.0)  # of B_H and of the total intensity
_FAR_NT = 1500.0  # unit of the difference to the target
_NOISE_NT = 5.0  # unit of the accuracy, as of good sensors


READING_SIZE = 26
"""Numbers of the observation of a reading."""
ACCURACY_KEYS = STD_KEYS[:2]
"""Keys of the accuracy that is observed: of errors that are new in each reading, and of all others."""


_OPEN = math.inf
READING_BOUNDS = (
    (*(-1.0,) * 4, *(-_FARTHEST,) * 5, *(0.0,) * 3, *(-_OPEN,) * 5, -1.0, -1.0, 0.0, *(0.0,) * 6),
    (*(1.0,) * 4, *(_FARTHEST,) * 8, *(_OPEN,) * 5, 1.0, 1.0, _OPEN, *(_FARTHEST,) * 6),
)
"""Lowest and highest values of :func:`observed_reading`."""


class ReadingObservation(StatefulTransform):
    """Write the reading, the last leg and the change of the reading along it, scaled; nothing is estimated.

    A single observation does not hold the direction to the destination: a policy needs a memory, such as TorchRL's
    :class:`~torchrl.modules.GRUModule`. The state is the reading before the step.

    Args:
        in_keys: reading and target ``(..., 3)``: D [deg], I [deg], B_H [nT]; last leg ``(..., 2)`` with the distance
            [km] first and the turn [rad] second; heading ``(..., 1)`` [rad]; and the accuracy that the vehicle knows
            ``(..., 3)`` each, of errors that are new in each reading and of all others, or no such keys with perfect
            sensors.
        out_keys: one observation ``(..., 26)``; see :func:`observed_reading`.

    Raises:
        ValueError: for another number of keys.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from torchrl.envs import TransformedEnv
        >>> env = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), ReadingObservation())
        >>> env.rollout(3)["observation"].shape
        torch.Size([2, 3, 26])
    """

    default_in_keys = ("field", "target_field", "leg", "heading")
    default_out_keys = ("observation",)
    optional_in_keys = ACCURACY_KEYS
    bounds = READING_BOUNDS
    out_sizes = {"observation": (READING_SIZE,)}

    @property
    def state_keys(self) -> list[NestedKey]:
        """Keys that a step reads from the TensorDict before it: the reading."""
        return self.in_keys[:1]

    def _begin(self, tensordict: TensorDictBase, values: list[Tensor], mask: Tensor | None) -> None:  # noqa: ARG002
        self._advance(tensordict, values, values[:1])

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:
        reading, target, leg, heading, *accuracy = values
        stds = accuracy or [torch.zeros_like(reading)] * len(ACCURACY_KEYS)
        observed = observed_reading(reading, target, leg[..., :1], heading, stds, state[0])
        tensordict.set(self.out_keys[0], observed)


def observed_reading(
    reading: Tensor, target: Tensor, moved: Tensor, heading: Tensor, accuracy: Sequence[Tensor], before: Tensor
) -> Tensor:
    """Return the observation of a reading and the one before it, scaled.

    Args:
        reading: ``(..., 3)`` D [deg], I [deg], B_H [nT].
        target: ``(..., 3)`` those at the destination.
        moved: ``(..., 1)`` distance of the last leg [km].
        heading: ``(..., 1)`` direction of that leg [rad].
        accuracy: standard deviations at :data:`ACCURACY_KEYS`, ``(..., 3)`` each.
        before: ``(..., 3)`` reading before the leg.

    Returns:
        ``(..., 26)``: reading and remaining differences (:func:`features`, 12), the change of D, I, B_H per kilometer
        of the last leg (3), how far along it the differences would be least, and how well it fits them (2), cosine and
        sine of the heading, the distance of the leg, and the accuracy (6).

    Example:
        >>> reading, moved = torch.tensor([0.0, 60.0, 25000.0]), torch.tensor([20.0])
        >>> observed_reading(reading, reading, moved, moved, [torch.zeros(3)] * 2, reading).shape
        torch.Size([26])
    """
    unit = per_nanotesla(reading)
    left = element_difference(target, reading) / unit / _DIFFERENCE_NT
    rate = element_difference(reading, before) / unit / moved.clamp_min(_LEAST_LEG_KM) / _RATE
    along, steep, far = ((a * b).sum(-1, keepdim=True) for a, b in ((left, rate), (rate, rate), (left, left)))
    observed = (
        features(reading, target),
        torch.asinh(rate),
        torch.asinh(4 * along / (steep + 1e-2)),
        along / (steep * far + 1e-6).sqrt(),
        torch.cos(heading),
        torch.sin(heading),
        moved / _LEG_KM,
        *(torch.asinh(std / unit / _NOISE_NT).clamp(max=_FARTHEST) for std in accuracy),
    )
    return torch.cat(observed, -1)


def features(reading: Tensor, target: Tensor) -> Tensor:
    """Return the features of a reading and a target ``(..., 12)``.

    They are sine and cosine of I and D, B_H, the total intensity, and the differences of the elements as field
    components, with their absolute values.

    Example:
        >>> features(torch.tensor([0.0, 60.0, 25000.0]), torch.tensor([0.0, 60.0, 26500.0]))[8]
        tensor(1.)
    """
    declination, inclination = torch.deg2rad(reading[..., :2]).unbind(-1)
    strengths = torch.stack((reading[..., 2], reading[..., 2] / torch.cos(inclination).clamp_min(1e-3)), -1)
    difference = element_difference(target, reading) / per_nanotesla(reading) / _FAR_NT
    angles = (torch.sin(inclination), torch.cos(inclination), torch.sin(declination), torch.cos(declination))
    strengths = (strengths - strengths.new_tensor(_FIELD_NT)) / strengths.new_tensor(_FIELD_RANGE_NT)
    written = torch.cat((torch.stack(angles, -1), strengths, difference, difference.abs()), -1)
    return written.clamp(-_FARTHEST, _FARTHEST)


def per_nanotesla(elements: Tensor) -> Tensor:
    """Return the change of D, I [deg] and B_H [nT] ``(..., 3)`` by a disturbance of 1 nT, above 0 for any reading.

    Example:
        >>> per_nanotesla(torch.tensor([0.0, 60.0, 20000.0])).round(decimals=4)
        tensor([0.0029, 0.0014, 1.0000])
    """
    strength = elements[..., 2].clamp_min(_LEAST_NT)
    declination = math.degrees(1) / strength
    inclination = declination * torch.cos(torch.deg2rad(elements[..., 1])).abs()
    return torch.stack((declination, inclination, torch.ones_like(strength)), -1)
