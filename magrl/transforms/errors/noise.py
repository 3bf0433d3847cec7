"""White noise of sensors: what is measured is written over what is true, which is kept under a key of its own."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs import EnvBase, TransformedEnv

from magrl.checks import check_number, check_tensor, check_type
from magrl.counters import advanced, stream_uniform
from magrl.transforms.base import Keys, expect_keys, key_list
from magrl.transforms.errors.base import EpisodeErrors


class SensorNoise(EpisodeErrors):
    """Add white noise to a reading, independent for each element, at reset and at each step.

    The reading is ``value + std * z`` with a standard normal ``z``. Beside it, the transform writes the true value, the
    data sheet of the sensors, which a policy may read (the standard deviations, and those of constant errors, which are
    0), and the state of the random numbers.
    In ``Compose``, a transform that reads the true value stands before this one, such as ``GradientHeading``.

    Args:
        std: standard deviation of each element in its unit, E numbers. If all are 0, the reading is the value.
        in_keys: one value ``(..., E)``.
        out_keys: its reading ``(..., E)``, in place by default.
        true_key: key of the true value, or None to leave it out. Privileged: a policy must not read it. Where a
            transform before this one has written it, it stays.
        std_key: key of the standard deviations ``(..., E)``.
        bias_key: key of those of constant errors ``(..., E)``: 0, or what a transform before this one has written.
        stream_key: key of the state of the random numbers ``(..., 1)``, int64.
        seed: seed of the noise. TorchRL's ``env.set_seed`` does not reach transforms; see :meth:`restart`.

    Raises:
        ValueError: for standard deviations that are negative or not finite, a seed that is not a whole number, more
            than one key, or values with another number of elements.
        KeyError: for a step from a TensorDict without the state of the random numbers.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = TransformedEnv(GeomagneticNavEnv(num_envs=1000, seed=0), SensorNoise((0.05, 0.05, 5.0), seed=1))
        >>> state = env.reset()
        >>> [round(x, 2) for x in (state["field"] - state["true_field"]).std(0).tolist()]
        [0.05, 0.05, 4.98]
    """

    channel = 1
    draws = 0
    """Random numbers that an episode takes before its first reading."""

    def __init__(
        self,
        std: Sequence[float],
        *,
        in_keys: NestedKey | Keys = ("field",),
        out_keys: NestedKey | Keys = ("field",),
        true_key: NestedKey | None = "true_field",
        std_key: NestedKey = "sensor_std",
        bias_key: NestedKey = "bias_std",
        stream_key: NestedKey = "sensor_stream",
        seed: int = 0,
    ) -> None:
        super().__init__(key_list(in_keys), key_list(out_keys), stream_key=stream_key, seed=seed)
        expect_keys(self, 1, 1)
        self.std = check_std(std)
        self.true_key, self.std_key, self.bias_key = true_key, std_key, bias_key

    # Data

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        values = self._read(tensordict_reset)
        if values is not None:
            stream = self._next_episode(tensordict, tensordict_reset.batch_size, values[0].device)
            tensordict_reset.set(self.std_key, self._levels(stream).to(values[0].dtype))
            tensordict_reset.set(self.stream_key, advanced(stream, self.draws).unsqueeze(-1))
        return self._call(tensordict_reset)

    def _levels(self, stream: Tensor) -> Tensor:
        """Return the standard deviations of an episode, ``(..., E)``."""
        return torch.tensor(self.std, device=stream.device).expand(*stream.shape, -1)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if self._read(next_tensordict) is not None:
            stream, std = (self._written(tensordict, key) for key in (self.stream_key, self.std_key))
            next_tensordict.set(self.stream_key, advanced(stream, len(self.std)))
            next_tensordict.set(self.std_key, std)
        return self._call(next_tensordict)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(next_tensordict)
        if values is None:
            return next_tensordict
        stream, std = (self._written(next_tensordict, key) for key in (self.stream_key, self.std_key))
        self._keep(next_tensordict, self.true_key, values[0])
        if not self._comes_before(self.bias_key):
            next_tensordict.set(self.bias_key, torch.zeros_like(values[0]))
        return next_tensordict.set(self.out_keys[0], self._reading(values[0], std, stream))

    def _reading(self, value: Tensor, std: Tensor, stream: Tensor) -> Tensor:
        """Return what the sensors measure of a value ``(..., E)``."""
        if not any(self.std):
            return value
        uniform = stream_uniform(stream.squeeze(-1), len(self.std))
        normal = math.sqrt(2) * torch.erfinv(2 * uniform - 1 + 2.0**-53)  # the shift keeps it finite and centered
        return value + std * normal.to(value.dtype)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Measure the value of a TensorDict that holds the state of the random numbers."""
        return self._call(tensordict)

    # Specs

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the true value, the standard deviations and the state of the numbers; the reading is unbounded."""
        leaf = self._leaf(observation_spec, self.in_keys[0])
        if leaf.shape[-1:] != (len(self.std),):
            raise ValueError(
                f"{type(self).__name__} has {len(self.std)} standard deviations, one for each element; "
                f"{self.in_keys[0]!r} is {tuple(leaf.shape)}"
            )
        if self.true_key is not None and not self._comes_before(self.true_key):
            observation_spec[self.true_key] = leaf.clone()
        for key in (self.out_keys[0], self.std_key, self.bias_key):
            observation_spec[key] = Unbounded(leaf.shape, device=leaf.device, dtype=leaf.dtype)
        shape = (*observation_spec.shape, 1)
        observation_spec[self.stream_key] = Unbounded(shape, device=leaf.device, dtype=torch.int64)
        return observation_spec

    @property
    def _state_keys(self) -> list[NestedKey]:
        return [*super()._state_keys, self.std_key]


class RandomSensorNoise(SensorNoise):
    """White noise whose standard deviations are drawn for each vehicle and episode, for domain randomization.

    Args:
        levels: function of uniform numbers ``(..., draws)`` in [0, 1) that returns standard deviations ``(..., E)``.
        draws: how many uniform numbers it takes.
        **options: of :class:`SensorNoise`, except ``std``.

    Raises:
        TypeError: for ``levels`` that cannot be called.
        ValueError: for ``draws`` that is not a positive whole number.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), RandomSensorNoise(seed=1))
        >>> std = env.rollout(3)["sensor_std"]
        >>> bool((std[:, 0] == std[:, 2]).all()), bool((std[0] == std[1]).any())
        (True, False)
    """

    def __init__(self, levels: Callable[[Tensor], Tensor] | None = None, *, draws: int = 7, **options: Any) -> None:
        levels = sensor_levels if levels is None else levels
        if not callable(levels):
            raise TypeError(f"levels must be a function of uniform numbers, got {levels!r}")
        check_number(1, whole=True, draws=draws)
        elements = len(levels(torch.full((draws,), 0.5)))
        super().__init__([1.0] * elements, **options)  # a placeholder: each episode has levels of its own
        self.levels, self.draws = levels, draws

    def _levels(self, stream: Tensor) -> Tensor:
        return self.levels(stream_uniform(stream, self.draws))


def sensor_levels(uniform: Tensor, exponent: float = 1.5) -> Tensor:
    """Return standard deviations of D [deg], I [deg] and B_H [nT] from perfect sensors to poor ones.

    In 15 % of cases there is no noise. Otherwise a common factor spans two decades up to 0.2 deg, 0.2 deg and 20 nT,
    half of them above 0.04 deg. Each element has a factor of its own, log-uniform from 0.4 to 2.5,
    and in 30 % of cases that of D is multiplied by a number from 1 to 7, as where the north reference is poor.

    Args:
        uniform: ``(..., 7)`` uniform numbers in [0, 1).
        exponent: of the uniform number in the logarithm of the common factor: with 1 it is log-uniform, with half of
            the cases above 0.02 deg; the larger, the more noise.

    Returns:
        ``(..., 3)``.

    Raises:
        ValueError: for another number of uniform numbers, or an exponent that is not above 0.

    Example:
        >>> sensor_levels(torch.tensor([0.5, 0.0, 0.5, 0.5, 0.5, 0.5, 0.5]))
        tensor([ 0.2000,  0.2000, 20.0000])
    """
    check_tensor(7, uniform=uniform)
    check_number(0, above=True, exponent=exponent)
    none, common, poor, factor = (uniform[..., k : k + 1] for k in (0, 1, 5, 6))
    level = 10 ** (-2 * common**exponent) * 10 ** (0.8 * uniform[..., 2:5] - 0.4) * uniform.new_tensor((0.2, 0.2, 20.0))
    declination = torch.where(poor < 0.3, 1 + 6 * factor, 1.0)
    level = level * torch.cat((declination, torch.ones_like(uniform[..., :2])), -1)
    return torch.where(none < 0.15, 0.0, level)


def check_std(std: Sequence[float]) -> tuple[float, ...]:
    """Return standard deviations as floats; raise unless they are finite numbers from 0 on.

    Raises:
        ValueError: with the values.

    Example:
        >>> check_std((0.05, -0.05, 5))
        Traceback (most recent call last):
        ValueError: std must be finite numbers from 0 on, one for each element, got (0.05, -0.05, 5)
    """
    try:
        numbers = list(std)
        for number in numbers:
            check_number(0, std=number)
    except (TypeError, ValueError):
        numbers = []
    if not numbers:
        raise ValueError(f"std must be finite numbers from 0 on, one for each element, got {std!r}")
    return tuple(float(number) for number in numbers)


def with_sensor_noise(env: EnvBase, std: Sequence[float], seed: int = 0) -> EnvBase:
    """Return an environment whose readings have white noise, or the environment itself if ``std`` is 0 throughout.

    Args:
        env: environment with the key ``field``.
        std: standard deviation of each element, as :class:`SensorNoise` takes it.
        seed: seed of the noise.

    Raises:
        ValueError: as :class:`SensorNoise`.
        TypeError: for another environment.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> with_sensor_noise(env, (0.0, 0.0, 0.0)) is env
        True
    """
    noisy = any(check_std(std))
    check_type(EnvBase, env=env)
    return TransformedEnv(env, SensorNoise(std, seed=seed)) if noisy else env
