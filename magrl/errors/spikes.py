"""Spikes: single readings that are wrong by far, as beside a passing ship or under a power line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl.checks import check_number
from magrl.errors.base import ReadingErrors, check_sizes
from magrl.random_numbers import normal_of, stream_uniform
from magrl.transforms.episode import Episode


class Spikes(ReadingErrors):
    """Add spikes to some readings, at random; the vehicle is not told of them.

    Args:
        sizes: standard deviations of a spike of each element in its unit, E numbers.
        rate: probability of a spike in a reading.
        **options: ``in_keys``, ``out_keys`` and ``seed`` of :class:`~magrl.errors.base.ReadingErrors`.

    Raises:
        ValueError: for sizes that are negative or not finite, or a rate outside [0, 1].

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> state = TransformedEnv(GeomagneticNavEnv(num_envs=1000, seed=0), Spikes((1.0, 1.0, 99.0), rate=0.1)).reset()
        >>> (state["field"] != state["true_field"]).any(-1).sum()
        tensor(101)
    """

    channel = 9
    default_in_keys = ("field",)
    numbers_key, stream_key = "spike_error", "spike_stream"
    _sizes: Tensor

    def __init__(self, sizes: Sequence[float], *, rate: float, **options: Any) -> None:
        super().__init__(**options)
        check_sizes(sizes=sizes)
        check_number(0, 1, rate=rate)
        self.register_buffer("_sizes", torch.tensor(sizes, dtype=torch.get_default_dtype()), persistent=False)
        self.rate, self.size, self.step_draws = rate, len(sizes), len(sizes) + 1
        self.in_sizes = {"field": (len(sizes),)}
        self._set_accuracy()

    def _constants(self, stream: Tensor) -> Tensor:
        return self._sizes.new_zeros(*stream.shape, self.size)

    def _disturb(self, tensordict: TensorDictBase, values: list[Tensor], episode: Episode) -> Tensor:
        uniform = stream_uniform(episode.stream, self.step_draws)
        normal = normal_of(uniform[..., :-1]).to(episode.numbers)
        spike = torch.where(uniform[..., -1:] < self.rate, normal * self._sizes.to(normal), 0.0)
        self._measure(tensordict, values[0], values[0] + spike)
        return spike
