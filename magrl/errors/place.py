"""What a vehicle knows of its start and destination: both places, each with an error."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl.checks import check_number
from magrl.geodesy import move_place
from magrl.random_numbers import stream_normal
from magrl.transforms.episode import Episode, EpisodeNumbers
from magrl.transforms.track import PLACE_KEYS


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
