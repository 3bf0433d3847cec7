"""Noise of sensors: readings replace the true values, which move to another key."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv

from magrl.checks import check_number, check_tensor, check_type
from magrl.counters import normal_of, stream_uniform
from magrl.sensor_std import SensorStd
from magrl.transforms.base import Keys
from magrl.transforms.errors.base import Episode, ReadingErrors, check_sizes, gauss_markov

DRIFT_KM = 200.0
"""Correlation length of the drift of random noise [km]; chosen."""


class SensorNoise(ReadingErrors):
    """Add white noise to a reading, independent for each element, at reset and at each step.

    The reading is ``value + noise * z`` with a standard normal ``z``. Beside it, the transform writes the true
    value, the standard deviations, which a policy may read, and the state of the random numbers.
    In ``Compose``, a transform that reads the true value stands before this one, such as ``GradientHeading``.

    Args:
        noise: standard deviation of each element in its unit, E numbers. If all are 0, the reading is the value.
        in_keys: one value ``(..., E)``.
        out_keys: its reading ``(..., E)``, in place by default.
        **options: ``seed`` of :class:`~magrl.transforms.errors.base.ReadingErrors`.

    Raises:
        ValueError: for standard deviations that are negative or not finite, a seed that is not a whole number, more
            than one key, or values with another number of elements.
        KeyError: for a step from a TensorDict without the state of the random numbers.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = TransformedEnv(GeomagneticNavEnv(num_envs=2000, seed=0), SensorNoise((0.05, 0.05, 5.0)))
        >>> state = env.reset()
        >>> [round(x, 2) for x in (state["field"] - state["true_field"]).std(0).tolist()]
        [0.05, 0.05, 4.99]
    """

    channel = 1
    default_in_keys: ClassVar[Keys] = ("field",)
    numbers_key, stream_key = "sensor_error", "sensor_stream"

    def __init__(self, noise: Sequence[float], **options: Any) -> None:
        super().__init__(**options)
        check_sizes(noise=noise)
        self.noise = tuple(float(std) for std in noise)
        self.size = self.step_draws = len(self.noise)
        self.in_sizes = (self.size,)
        self._set_accuracy()

    def _constants(self, stream: Tensor) -> Tensor:
        """Return the standard deviations of an episode ``(..., E)``."""
        return torch.tensor(self.noise, device=stream.device).expand(*stream.shape, -1)

    def _disturb(self, tensordict: TensorDictBase, values: list[Tensor], episode: Episode) -> Tensor:
        uniform = stream_uniform(episode.stream, self.step_draws)
        normal = math.sqrt(2) * torch.erfinv(2 * uniform - 1 + 2.0**-53)  # the shift keeps it finite and centered
        none = torch.zeros_like(episode.numbers)
        reading = values[0] + episode.numbers * normal.to(values[0].dtype)
        self._measure(tensordict, values[0], reading, SensorStd(episode.numbers, none, none, none))
        return episode.numbers

    def accuracy(self, field: Tensor) -> SensorStd:
        """Return the standard deviations that the errors add to a reading, each ``(..., E)``.

        Example:
            >>> SensorNoise((1.0, 2.0)).accuracy(torch.zeros(2)).noise
            tensor([1., 2.])
        """
        return super().accuracy(field)._replace(noise=field.new_tensor(self.noise).expand_as(field))


class RandomSensorNoise(SensorNoise):
    """Noise and bias whose standard deviations are drawn for each vehicle and episode (domain randomization).

    The bias is the sum of a constant error and of a drift, a first-order Gauss-Markov process along the way
    (:data:`DRIFT_KM`), with shares of its variance that are drawn, too.

    Args:
        levels: function of uniform numbers ``(..., draws)`` in [0, 1) that returns standard deviations ``(..., 2 E)``:
            those of the noise, then those of the bias.
        draws: how many uniform numbers it takes.
        **options: of :class:`SensorNoise`, except ``noise``; ``in_keys`` are a reading and the last move.

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

    default_in_keys: ClassVar[Keys] = ("field", "move")

    def __init__(self, levels: Callable[[Tensor], Tensor] | None = None, *, draws: int = 12, **options: Any) -> None:
        levels = sensor_levels if levels is None else levels
        if not callable(levels):
            raise TypeError(f"levels must be a function of uniform numbers, got {levels!r}")
        check_number(1, whole=True, draws=draws)
        typical = levels(torch.full((draws,), 0.5)).tolist()
        super().__init__(typical[: len(typical) // 2], **options)
        self.levels, self.level_draws, self.count = levels, draws, self.size
        self.in_sizes = (self.count, None)
        self.draws, self.step_draws, self.size = draws + 1 + 2 * self.count, 2 * self.count, 5 * self.count

    def _constants(self, stream: Tensor) -> Tensor:
        uniform = stream_uniform(stream, self.draws)
        level, share, normal = uniform.split((self.level_draws, 1, self.step_draws), -1)
        noise_std, bias_std = self.levels(level).split(self.count, -1)
        constant_std, drift_std = bias_std * share.sqrt(), bias_std * (1 - share).sqrt()
        first, second = normal_of(normal).split(self.count, -1)
        return torch.cat((noise_std, bias_std, constant_std * first, drift_std, drift_std * second), -1)

    def _disturb(self, tensordict: TensorDictBase, values: list[Tensor], episode: Episode) -> Tensor:
        value, move = values
        normal = normal_of(stream_uniform(episode.stream, self.step_draws)).to(value.dtype)
        noise, walk = normal.split(self.count, -1)
        noise_std, bias_std, constant, drift_std, drift = episode.numbers.split(self.count, -1)
        if not episode.first:
            drift = gauss_markov(drift, drift_std, move[..., :1], DRIFT_KM, walk)
        reading = value + noise_std * noise + constant + drift
        self._measure(
            tensordict, value, reading, SensorStd(noise_std, bias_std, drift_std, torch.zeros_like(noise_std))
        )
        return torch.cat((noise_std, bias_std, constant, drift_std, drift), -1)


def sensor_levels(uniform: Tensor, exponent: float = 1.5) -> Tensor:
    """Return standard deviations of the errors of D [deg], I [deg] and B_H [nT] from perfect sensors to poor ones.

    In 15 % of cases there is no noise. Otherwise a common factor spans two decades up to 0.2 deg, 0.2 deg and 20 nT,
    half of them above 0.04 deg. Each element has a factor of its own, log-uniform from 0.4 to 2.5,
    and in 30 % of cases that of D is multiplied by a number from 1 to 7, as where the north reference is poor.

    In half of the cases there is a bias as well, log-uniform over 1.6 decades up to 0.35 deg, 0.05 deg and
    45 nT, with the same factors of their own.

    Args:
        uniform: ``(..., 12)`` uniform numbers in [0, 1).
        exponent: of the uniform number in the logarithm of the common factor: with 1 it is log-uniform, with half of
            the cases above 0.02 deg; the larger, the more noise.

    Returns:
        ``(..., 6)``: those of the noise, and those of the bias.

    Raises:
        ValueError: for another number of uniform numbers, or an exponent that is not above 0.

    Example:
        >>> sensor_levels(torch.tensor([0.5, 0.0, 0.5, 0.5, 0.5, 0.5, 0.5, 0.0, 0.5, 0.5, 0.5, 0.5]))
        tensor([ 0.2000,  0.2000, 20.0000,  0.0000,  0.0000,  0.0000])
    """
    check_tensor(12, uniform=uniform)
    check_number(0, above=True, exponent=exponent)
    none, common, poor, factor, exact, biased = (uniform[..., k : k + 1] for k in (0, 1, 5, 6, 7, 8))
    noise = 10 ** (-2 * common**exponent) * _factors(uniform[..., 2:5]) * uniform.new_tensor((0.2, 0.2, 20.0))
    declination = torch.where(poor < 0.3, 1 + 6 * factor, 1.0)
    noise = noise * torch.cat((declination, torch.ones_like(uniform[..., :2])), -1)
    bias = 10 ** (-1.6 * biased) * _factors(uniform[..., 9:12]) * uniform.new_tensor((0.35, 0.05, 45.0))
    return torch.cat((torch.where(none < 0.15, 0.0, noise), torch.where(exact < 0.5, 0.0, bias)), -1)


def _factors(uniform: Tensor) -> Tensor:
    """Return the factors of the elements, log-uniform from 0.4 to 2.5."""
    return 10 ** (0.8 * uniform - 0.4)


def with_sensor_noise(env: EnvBase, noise: Sequence[float], seed: int = 0) -> EnvBase:
    """Return an environment whose readings have white noise, or the environment itself if there is none.

    Args:
        env: environment with the key ``field``.
        noise: standard deviation of each element, as :class:`SensorNoise` takes it.
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
    transform = SensorNoise(noise, seed=seed)
    check_type(EnvBase, env=env)
    return TransformedEnv(env, transform) if any(noise) else env
