"""Base of the errors of sensors and of motion: random numbers for each vehicle and episode, kept in the TensorDict.

The random numbers of an error are a pure function of (seed, vehicle, episode, step). Each episode has a stream of
them, whose state is in the TensorDict, so that a step depends on its input alone. The transform itself only holds the
streams from which the next episodes split off.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase, Transform

from magrl.checks import check_number, check_numbers
from magrl.counters import advanced, counter_stream, split
from magrl.transforms.base import Keys, ObservationTransform, observed_spec, with_state

TRUE_KEYS = (
    "true_field",
    "true_heading",
    "true_move",
    "true_course",
    "sensor_error",
    "north_error",
    "motion_error",
    "sensor_stream",
    "north_stream",
    "motion_stream",
    "weather_clock",
)
"""Keys of the errors that a policy may not read: what is true, the errors, and the states of their random numbers."""

TYPICAL_FIELD = (10.0, 60.0, 24000.0)
"""D [deg], I [deg], B_H [nT] at middle latitudes, for which data sheets state the errors that depend on the field.

What a vehicle is told is the same everywhere. Stated for the true field, or for a reading to which an error is still
added, it would give that field or that reading away.
"""


class EpisodeErrors(ObservationTransform):
    """Base class of transforms whose random numbers belong to a vehicle and an episode.

    Args:
        in_keys: of the transform.
        out_keys: of the transform.
        stream_key: key of the state of the random numbers ``(..., 1)``, int64.
        seed: seed of the errors. TorchRL's ``env.set_seed`` does not reach transforms; see :meth:`restart`.

    Raises:
        ValueError: for a seed that is not a whole number.

    Example:
        >>> EpisodeErrors(["field"], ["field"], stream_key="stream", seed=0.5)
        Traceback (most recent call last):
        ValueError: seed must be a whole number, got 0.5
    """

    channel: ClassVar[int] = 0
    """Second counter: it separates the numbers of a class from others of the same seed."""
    streams: Tensor | None

    def __init__(self, in_keys: Keys, out_keys: Keys, *, stream_key: NestedKey, seed: int) -> None:
        super().__init__(in_keys=in_keys, out_keys=out_keys)
        check_number(whole=True, seed=seed)
        self.stream_key, self.seed = stream_key, int(seed)
        self.register_buffer("streams", None)
        self._earlier: frozenset[NestedKey] | None = None

    def restart(self) -> None:
        """Begin with the first episode of each vehicle again, so that the episodes repeat their errors."""
        self.streams = None

    def _next_episode(self, tensordict: TensorDictBase, batch: torch.Size, device: torch.device) -> Tensor:
        """Return the streams of new episodes; the rows of vehicles that are not reset are placeholders."""
        if self.streams is None or self.streams.shape != batch:
            vehicle = torch.arange(batch.numel(), device=device).reshape(batch)
            self.streams = counter_stream(self.seed, torch.stack((vehicle, torch.full_like(vehicle, self.channel)), -1))
        self.streams = self.streams.to(device)  # a checkpoint may come from another one
        stream = split(self.streams)
        mask = tensordict.get("_reset", None)
        # Advanced out of place: a checkpoint may hold the old tensor.
        self.streams = advanced(self.streams, 1 if mask is None else mask.reshape(batch).long())
        return stream

    @staticmethod
    def _of_new_episodes(tensordict: TensorDictBase, stream: Tensor, draw: Callable[[Tensor], Tensor]) -> Tensor:
        """Return what is drawn from the streams of the vehicles that are reset; the rows of the others are 0."""
        mask = tensordict.get("_reset", None)
        if mask is None:
            return draw(stream)
        mask = mask.reshape(stream.shape)
        drawn = draw(stream[mask])
        return drawn.new_zeros(*stream.shape, drawn.shape[-1]).masked_scatter(mask.unsqueeze(-1), drawn)

    def set_container(self, container: Transform | EnvBase) -> None:
        """Become part of a chain of transforms or of an environment."""
        super().set_container(container)
        self._earlier = None

    def empty_cache(self) -> None:
        """Forget the environment before this transform, and its keys."""
        super().empty_cache()
        self._earlier = None

    def _comes_before(self, key: NestedKey | None) -> bool:
        """Return whether the environment or a transform before this one writes a key."""
        if self._earlier is None:
            if self.parent is None:
                return False
            self._earlier = frozenset(observed_spec(self).keys(True, True))
        return key in self._earlier

    def _keep(self, tensordict: TensorDictBase, key: NestedKey | None, value: Tensor) -> None:
        """Write a true value, unless a transform before this one has written it: the first error keeps it."""
        if key is not None and not self._comes_before(key):
            tensordict.set(key, value)

    def _tell(self, tensordict: TensorDictBase, key: NestedKey, std: Tensor, reading: Tensor) -> None:
        """Write standard deviations ``(E,)`` that the vehicle is told; their squares add to those written before."""
        std = std.to(reading.dtype)
        told = torch.hypot(tensordict[key], std) if self._comes_before(key) else std.expand_as(reading).clone()
        tensordict.set(key, told)

    def _written(self, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
        value = tensordict.get(key, None)
        if value is None:
            known = "which its reset writes: step from what reset() or step_mdp() returned"
            raise KeyError(f"{type(self).__name__} reads {key!r}, {known}")
        return value

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Raise an error: the errors of an episode begin with its reset."""
        raise NotImplementedError(f"{type(self).__name__} needs an environment: append it to a TransformedEnv")

    @property
    def _state_keys(self) -> list[NestedKey]:
        """Keys of this transform's observations that its next step reads."""
        return [self.stream_key]

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """Make what a step reads part of the state, so that environments in other processes pass it to the step."""
        input_spec = super().transform_input_spec(input_spec)
        if self.parent is None:
            return input_spec
        observed = self.transform_observation_spec(observed_spec(self).clone())
        return with_state(input_spec, {key: observed[key] for key in self._state_keys})

    def _load_from_state_dict(self, state_dict: Mapping[str, Any], prefix: str, *args: Any) -> None:
        saved = state_dict.get(f"{prefix}streams")
        self.streams = None if saved is None else torch.empty_like(saved)
        super()._load_from_state_dict(state_dict, prefix, *args)


def check_sizes(count: int, *, fixed: bool = False, **sizes: Sequence[float]) -> None:
    """Raise unless each size of an error is some finite numbers, from 0 on if they are standard deviations.

    Args:
        count: how many numbers each has.
        fixed: whether they are constant errors themselves, which may be negative.
        sizes: values by the name that the message uses.

    Raises:
        ValueError: with the name and the values.

    Example:
        >>> check_sizes(3, bias=(0.1, 0.1, -5.0))
        Traceback (most recent call last):
        ValueError: bias must be standard deviations, which are not negative, got (0.1, 0.1, -5.0)
    """
    for name, values in sizes.items():
        check_numbers(count, **{name: values})
        if not fixed and min(values) < 0:
            raise ValueError(f"{name} must be standard deviations, which are not negative, got {values!r}")


def gauss_markov(value: Tensor, std: Tensor | float, distance: Tensor | float, length: float, normal: Tensor) -> Tensor:
    """Return a first-order Gauss-Markov process after a distance: stationary, with an exponential autocorrelation.

    x becomes ``phi x + std sqrt(1 - phi^2) w`` with ``phi = exp(-distance / length)``, so that the result does not
    depend on how a distance is divided into steps.

    Args:
        value: ``(...)`` x before the distance.
        std: its standard deviation.
        distance: how far [unit of the length].
        length: correlation length.
        normal: ``(...)`` standard normal numbers w.

    Source:
        A. Gelb (ed.), Applied Optimal Estimation, MIT Press (1974), section 3.8.

    Example:
        >>> gauss_markov(torch.tensor([2.0]), 1.0, 0.0, 100.0, torch.tensor([9.0]))
        tensor([2.])
    """
    phi = torch.exp(-torch.as_tensor(distance, dtype=value.dtype, device=value.device) / length)
    return phi * value + torch.sqrt(1 - phi * phi) * std * normal.to(value.dtype)
