"""Random numbers of each vehicle and episode: a pure function of seeds, vehicle, episode and step.

Each episode has a stream of them, whose state is in the TensorDict, so that a step depends on its input alone and a
transform holds no state.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec

from magrl.checks import check_number
from magrl.random_numbers import advanced, counter_stream
from magrl.transforms.base import Keys, StatefulTransform

EPISODE_STREAM = "episode_stream"
"""Key of the environment's number of an episode, from which random numbers derive: ``(..., 1)`` int64, privileged."""


class Episode(NamedTuple):
    """State of an episode at a reading: its numbers, the stream of random numbers, and whether it begins here."""

    numbers: Tensor
    stream: Tensor
    first: bool


class EpisodeNumbers(StatefulTransform):
    """Base class of transforms with random numbers that belong to a vehicle and an episode.

    A subclass draws the numbers of new episodes in :meth:`_constants`, and writes what they change in :meth:`_disturb`.
    On a TensorDict without an environment, an episode begins in each row. Without :data:`EPISODE_STREAM`, which the
    navigation environment writes, the numbers come from torch's default generator.

    Args:
        in_keys: of the transform.
        out_keys: of the transform.
        seed: seed of the numbers, beside the environment's seed.

    Raises:
        ValueError: for a seed that is not a whole number.
        KeyError: for a step from a TensorDict without the state.

    Example:
        >>> EpisodeNumbers(["field"], ["field"], seed=0.5)
        Traceback (most recent call last):
        ValueError: seed must be a whole number, got 0.5
    """

    channel: ClassVar[int] = 0
    """Second counter: it separates the numbers of a class from others of the same seed."""
    numbers_key: NestedKey
    """Key of the numbers of an episode ``(..., size)``."""
    stream_key: ClassVar[str]
    """Key of the state of the random numbers ``(..., 1)``, int64. Privileged."""
    size: int
    """Numbers of an episode."""
    numbers_dtype: ClassVar[torch.dtype | None] = None
    """Type of these numbers; by default the first value's."""
    draws = 0
    """Random numbers that an episode takes before its first reading."""
    step_draws = 0
    """Random numbers of each reading."""

    def __init__(self, in_keys: Keys | None = None, out_keys: Keys | None = None, *, seed: int = 0, **bad: Any) -> None:
        if bad:
            raise TypeError(f"{type(self).__name__} has no option {', '.join(bad)}")
        super().__init__(in_keys, out_keys)
        check_number(whole=True, seed=seed)
        self.seed = int(seed)

    # Data

    @property
    def state_keys(self) -> list[NestedKey]:
        """Keys that a step reads from the TensorDict before it."""
        return [self.numbers_key, self.stream_key]

    def _constants(self, stream: Tensor) -> Tensor:
        """Return the numbers of new episodes ``(..., size)``."""
        raise NotImplementedError

    def _disturb(self, tensordict: TensorDictBase, values: list[Tensor], episode: Episode) -> Tensor:
        """Write what the numbers change in the values at ``in_keys``; return the numbers of the next step."""
        raise NotImplementedError

    def _begin(self, tensordict: TensorDictBase, values: list[Tensor], mask: Tensor | None) -> None:
        stream = self._episode_stream(tensordict, values[0].device)
        numbers = self._begun(stream, mask).to(self.numbers_dtype or values[0].dtype)
        self._write(tensordict, values, Episode(numbers, advanced(stream, self.draws), first=True))

    def _begun(self, stream: Tensor, mask: Tensor | None) -> Tensor:
        """Return the numbers of new episodes ``(..., size)``, and 0 in rows whose episode goes on."""
        if mask is None or mask.device.type != "cpu":  # an accelerator would wait for the number of rows
            return self._constants(stream)
        begun = mask.reshape(stream.shape)
        drawn = self._constants(stream[begun])
        return drawn.new_zeros(*stream.shape, self.size).masked_scatter(begun.unsqueeze(-1), drawn)

    def _episode_stream(self, tensordict: TensorDictBase, device: torch.device) -> Tensor:
        """Return the stream of the episode in each row, ``(...)``."""
        episode = tensordict.get(EPISODE_STREAM, None)
        if episode is None:
            episode = torch.randint(-(2**63), 2**63 - 1, (*tensordict.batch_size, 1), device=device)
        return counter_stream(self.seed, torch.nn.functional.pad(episode, (0, 1), value=self.channel))

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:
        numbers, stream, *_ = state
        self._write(tensordict, values, Episode(numbers, advanced(stream.squeeze(-1), self.step_draws), first=False))

    def _write(self, tensordict: TensorDictBase, values: list[Tensor], episode: Episode) -> None:
        tensordict.set(self.numbers_key, self._disturb(tensordict, values, episode))
        tensordict.set(self.stream_key, episode.stream.unsqueeze(-1))

    # Specs

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Check the shapes that are read, and add what is written, the numbers and the state of the random ones."""
        observation_spec = super().transform_observation_spec(observation_spec)
        leaf = self._leaf(observation_spec, self.in_keys[0])
        self._add(observation_spec, leaf, self.numbers_key, self.size, dtype=self.numbers_dtype)
        self._add(observation_spec, leaf, self.stream_key, 1, dtype=torch.int64)
        return observation_spec
