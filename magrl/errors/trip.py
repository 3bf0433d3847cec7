"""Errors of what a vehicle knows of its trip: the places of start and destination, and the elements there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl.checks import check_number
from magrl.errors.base import EpisodeErrors, check_sizes, folded
from magrl.geodesy import move_place
from magrl.random_numbers import stream_normal
from magrl.transforms.base import Keys
from magrl.transforms.episode import Episode, EpisodeNumbers
from magrl.transforms.track import PLACE_KEYS


class TargetErrors(EpisodeErrors):
    """Give a vehicle the elements at its destination with an error that is drawn for the episode.

    What it read is kept at ``exact_target_field`` and given back to the environment for its step, so that objective and
    arrival stay true. It stands after :class:`~magrl.errors.MagneticNorth`, if both are used: a vehicle without D
    has a ``target_std`` of D of 0.

    Args:
        target_std: standard deviations of D [deg], I [deg], B_H [nT].
        in_keys: elements at the destination ``(..., 3)``, which are replaced.
        **options: ``seed``.

    Raises:
        ValueError: for a standard deviation that is negative or not finite, or another number of keys.
        KeyError: for a step from a TensorDict without the state.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), TargetErrors((0.0, 0.0, 30.0)))
        >>> state = env.reset()
        >>> (state["target_field"] != state["exact_target_field"]).any(0)
        tensor([False, False,  True])
    """

    channel = 12
    true_keys = ("exact_target_field",)
    hidden = {"target_field": "exact_target_field"}
    default_in_keys = default_out_keys = ("target_field",)
    numbers_key, stream_key = "target_error", "target_stream"
    in_sizes = {"target_field": (3,)}
    size = draws = 3

    def __init__(
        self, target_std: Sequence[float] = (0.0, 0.0, 0.0), in_keys: Keys | None = None, **options: Any
    ) -> None:
        super().__init__(in_keys, in_keys, **options)
        check_sizes(3, target_std=target_std)
        self.target_std = tuple(target_std)

    def _constants(self, stream: Tensor) -> Tensor:
        return torch.tensor(self.target_std, device=stream.device) * stream_normal(stream, self.draws)

    def _disturb(self, tensordict: TensorDictBase, values: list[Tensor], episode: Episode) -> Tensor:
        tensordict.set(self.true_keys[0], values[0])
        tensordict.set(self.out_keys[0], folded(values[0] + episode.numbers))
        return episode.numbers


class KnownPlace(EpisodeNumbers):
    """Tell a vehicle the places of its start and of its destination, each with an error that is drawn for the episode.

    Args:
        start_km: root mean square error of the start [km].
        target_km: the same of the destination.
        in_keys: true places of start and destination ``(..., 2)`` latitude, longitude [deg]. Privileged.
        out_keys: the places that the vehicle knows ``(..., 2)`` [deg].
        **options: ``seed``.

    Raises:
        ValueError: for an error that is negative, or another number of keys.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from magrl.geodesy import geodesic
        >>> state = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), KnownPlace(5.0)).reset()
        >>> bool((geodesic(*state["start_place"].mT, *state["start_position"].mT)[0] < 30).all())
        True
    """

    channel = 10
    default_in_keys = ("start_position", "target_position")
    default_out_keys = PLACE_KEYS
    numbers_key, stream_key = "place_error", "place_stream"
    in_sizes = dict.fromkeys(default_in_keys, (2,))
    out_sizes = dict.fromkeys(PLACE_KEYS, (2,))
    size = draws = 4

    def __init__(self, start_km: float = 0.0, target_km: float = 0.0, **options: Any) -> None:
        super().__init__(**options)
        check_number(0, start_km=start_km, target_km=target_km)
        self.sizes = float(start_km), float(target_km)

    def _constants(self, stream: Tensor) -> Tensor:
        sizes = torch.tensor(self.sizes, device=stream.device).repeat_interleave(2) / math.sqrt(2)
        return sizes * stream_normal(stream, self.draws)

    def _disturb(self, tensordict: TensorDictBase, values: list[Tensor], episode: Episode) -> Tensor:
        for key, place, error in zip(self.out_keys, values, episode.numbers.split(2, -1), strict=True):
            north, east = error.to(place).unbind(-1)
            tensordict.set(key, move_place(place, torch.atan2(east, north), torch.hypot(north, east)))
        return episode.numbers
