"""Magnetic north: a vehicle without a true-north reference steers by its compass and never knows D."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from magrl.errors.base import ReadingErrors
from magrl.geodesy import wrap_angle
from magrl.sensor_std import SensorStd
from magrl.transforms.base import Keys
from magrl.transforms.episode import Episode


class MagneticNorth(ReadingErrors):
    """Measure headings from magnetic north: the vehicle has a magnetometer and an accelerometer, and no true north.

    D is the direction of magnetic north from the vehicle's own north, so it reads 0 everywhere, and D of the
    destination is 0, too. That it tells nothing is stated by a ``bias_std`` of infinity. A leg starts along the
    vehicle's heading from magnetic north and keeps its course on the ground; at its end, the vehicle turns to the same
    heading from magnetic north there. So headings tell nothing of how D changes along the path. (On the Earth up to 60
    degrees of latitude, it changes by 0.2 degrees over 50 km on the mean, and a vehicle that follows its needle ends
    0.1 km beside this one.)

    It stands after all errors of readings: the compass shows the direction of the measured field. The true heading, D
    and the destination's D are kept at ``true_heading``, ``true_field`` and ``true_target_field`` and given back to the
    environment for its step.

    Args:
        in_keys: heading ``(..., 1)`` [rad], elements ``(..., 3)`` with D [deg] first, and the destination's.

    Raises:
        ValueError: for another number of keys.
        KeyError: for a step from a TensorDict without the true values.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> state = TransformedEnv(GeomagneticNavEnv(num_envs=1, seed=0), MagneticNorth()).reset()
        >>> state["field"][0, 0], state["heading"].rad2deg().round(), state["true_field"][0, 0].round()
        (tensor(0.), tensor([[-9.]]), tensor(9.))
    """

    channel, changes_inclination = 6, False
    true_keys = ("true_field", "true_heading", "true_target_field")
    hidden = {"heading": "true_heading", "target_field": "true_target_field"}
    default_in_keys = ("heading", "field", "target_field")
    default_out_keys = default_in_keys
    numbers_key, stream_key = "compass_declination", "compass_stream"
    in_sizes = {"heading": (1,), "field": (3,), "target_field": (3,)}
    size = 1

    def __init__(self, in_keys: Keys | None = None) -> None:
        super().__init__(in_keys)
        self.out_keys: list[NestedKey] = list(self.in_keys)
        self._set_accuracy()

    def _constants(self, stream: Tensor) -> Tensor:
        return torch.zeros_like(stream.unsqueeze(-1), dtype=torch.get_default_dtype())

    def _disturb(self, tensordict: TensorDictBase, values: list[Tensor], episode: Episode) -> Tensor:
        heading, field, target = values
        declination = field[..., :1]
        own = wrap_angle(heading - torch.deg2rad(declination if episode.first else episode.numbers))
        tensordict.set(self.true_keys[1], wrap_angle(own + torch.deg2rad(declination)))
        tensordict.set(self.true_keys[2], target)
        tensordict.set(self.out_keys[0], own)
        tensordict.set(self.out_keys[2], _without_declination(target))
        self._measure(tensordict, field, _without_declination(field))
        return declination

    def accuracy(self, field: Tensor) -> SensorStd:
        """Return the standard deviations that are added to a reading, each ``(..., 3)``.

        Example:
            >>> MagneticNorth().accuracy(torch.zeros(3)).bias
            tensor([inf, 0., 0.])
        """
        none = torch.zeros_like(field)
        return SensorStd(none, none + field.new_tensor((math.inf, 0.0, 0.0)), none, none)


def _without_declination(elements: Tensor) -> Tensor:
    """Return D, I, B_H ``(..., 3)`` with D as 0."""
    return torch.cat((torch.zeros_like(elements[..., :1]), elements[..., 1:]), -1)
