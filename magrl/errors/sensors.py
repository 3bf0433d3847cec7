"""Errors of sensors: noise, bias, scale, drift, outages, rounding, and the errors of a vector magnetometer."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import pad

from magrl.checks import check_number, check_tensor
from magrl.errors.base import ReadingErrors, build, check_sizes, gauss_markov
from magrl.errors.vector import VectorErrors
from magrl.random_numbers import normal_of, stream_uniform
from magrl.sensor_std import OUTAGE_STD, SensorStd
from magrl.transforms.episode import Episode

LEVEL_DRAWS = 12
"""Uniform numbers from which the standard deviations of an episode follow."""
LEVELS = ("noise_std", "bias_std", "drift_std")
"""Names of the standard deviations that are drawn for an episode."""
DRIFT_KM = 200.0
"""Correlation length of a drift [km]; chosen."""


class SensorErrors(ReadingErrors):
    """Add the errors of real sensors to a reading.

    In this order: the errors of a vector magnetometer, scale error, bias, drift, white noise, rounding, and outages, in
    which the last reading is repeated. Bias and scale error are constant in an episode; the drift is a first-order
    Gauss-Markov process along the path. Sizes are standard deviations of normal errors (cut at four of them), E numbers
    in the unit of each element; those that are not given are 0.

    ``sensor_std`` is of errors that are new at each reading (noise and rounding), during an outage
    :data:`~magrl.sensor_std.OUTAGE_STD`; ``bias_std`` is of constant and slow errors. Both are roots of sums of
    variances, at :data:`~magrl.errors.base.TYPICAL_FIELD`.

    Args:
        noise: white noise.
        bias: constant error.
        scale: error of the scale, as a share of the value, where the elements are D, I, B_H.
        drift: slow drift.
        drift_length: its correlation length [unit of the distance of a leg, or steps].
        resolution: the reading is rounded to multiples of this; 0 for no rounding.
        outage_rate: probability that a reading is missing; never the first of an episode.
        vector: errors of a vector magnetometer, where the elements are D, I, B_H; or the options of
            :class:`~magrl.errors.VectorErrors` by name.
        fixed: whether bias and scale are the errors themselves, in every episode.
        levels: function of uniform numbers ``(..., 12)`` in [0, 1), which returns further standard deviations
            ``(..., 2 E)`` for each vehicle and episode, such as :func:`~magrl.errors.sensor_levels`: of white
            noise, then of a bias, whose variance is shared between a constant error and a drift at random.
        in_keys: a value ``(..., E)``; optionally the last leg ``(..., K)``, whose first number is its distance,
            without which the drift is by steps; and optionally the heading ``(..., 1)`` [rad], in whose axes ``vector``
            acts.
        out_keys: the reading ``(..., E)``, in place by default.
        **options: ``seed`` of :class:`~magrl.errors.base.ReadingErrors`. The errors of the episode are
            one tensor at ``sensor_error``, which :meth:`named` splits: ``drift``, ``reading`` (the last one), ``bias``
            and ``scale``, E numbers each, ``vector`` (12) if there is one, and with ``levels`` the drawn standard
            deviations ``noise_std``, ``bias_std`` and ``drift_std``.

    Raises:
        ValueError: for sizes that are negative or of another number than ``noise``, a rate outside [0, 1], a length
            that is not above 0, ``scale`` or ``vector`` with other than three elements, or ``vector`` and no heading.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> errors = SensorErrors((0.05, 0.05, 5.0), bias=(0.1, 0.1, 20.0), drift=(0.0, 0.0, 10.0), drift_length=200.0)
        >>> state = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), errors).reset()
        >>> state["sensor_std"][0], state["bias_std"][0]
        (tensor([0.0500, 0.0500, 5.0000]), tensor([ 0.1000,  0.1000, 22.3607]))
    """

    channel = 2
    default_in_keys = ("field", "leg", "heading")
    optional_in_keys = ("leg", "heading")
    numbers_key, stream_key = "sensor_error", "sensor_stream"
    _sizes: Tensor

    def __init__(
        self,
        noise: Sequence[float] = (0.0, 0.0, 0.0),
        *,
        bias: Sequence[float] | None = None,
        scale: Sequence[float] | None = None,
        drift: Sequence[float] | None = None,
        drift_length: float = DRIFT_KM,
        resolution: Sequence[float] | None = None,
        outage_rate: float = 0.0,
        vector: VectorErrors | Mapping[str, Any] | None = None,
        fixed: bool = False,
        levels: Callable[[Tensor], Tensor] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        check_sizes(noise=noise)
        self.count = len(noise)
        sizes = [list(noise)]
        for name, values in {"bias": bias, "scale": scale, "drift": drift, "resolution": resolution}.items():
            values = (0.0,) * self.count if values is None else values
            check_sizes(self.count, fixed=fixed and name in ("bias", "scale"), **{name: values})
            sizes.append(list(values))
        self.register_buffer("_sizes", torch.tensor(sizes, dtype=torch.get_default_dtype()), persistent=False)
        check_number(0, 1, outage_rate=outage_rate)
        check_number(0, above=True, drift_length=drift_length)
        vector = build(VectorErrors, vector) if isinstance(vector, Mapping) else vector
        if vector is not None and "heading" not in self.in_names:
            raise ValueError(f"vector acts in the axes of a heading: in_keys must name one, got {self.in_keys}")
        if self.count != 3 and (vector is not None or any(scale or ())):
            raise ValueError(f"scale and vector act on D, I and B_H, got {self.count} elements in noise")
        self.drift_length, self.outage_rate, self.vector = float(drift_length), float(outage_rate), vector
        self.fixed, self.levels, self.in_sizes = fixed, levels, {"field": (self.count,), "heading": (1,)}
        self.level_draws = LEVEL_DRAWS + 1 + self.count if levels else 0
        self.layout = self._layout()
        self.size = sum(self.layout.values())
        self.draws = self.level_draws + 2 * self.count + (vector.draws if vector else 0)
        self.step_draws = 2 * self.count + 1
        self._set_accuracy()

    def _layout(self) -> dict[str, int]:
        """Return how many numbers of an episode each part has, in their order."""
        parts = dict.fromkeys(("drift", "reading", "bias", "scale"), self.count)
        parts |= {"vector": self.vector.size} if self.vector else {}
        return parts | (dict.fromkeys(LEVELS, self.count) if self.levels else {})

    def named(self, numbers: Tensor) -> dict[str, Tensor]:
        """Return the errors of an episode by name, from the value ``(..., size)`` at ``sensor_error``.

        Example:
            >>> from tensordict import TensorDict
            >>> errors = SensorErrors(bias=(0.1, 0.0, 5.0), in_keys=["field"], fixed=True)
            >>> errors.named(errors(TensorDict(field=torch.zeros(3)))["sensor_error"])["bias"]
            tensor([0.1000, 0.0000, 5.0000])
        """
        return dict(zip(self.layout, numbers.split(list(self.layout.values()), -1), strict=True))

    def _constants(self, stream: Tensor) -> Tensor:
        """Return the errors of an episode, with a drift and a last reading of 0."""
        ends = [self.level_draws, self.level_draws + 2 * self.count]
        level, constant, vector = stream_uniform(stream, self.draws).tensor_split(ends, -1)
        drawn = torch.ones_like(constant) if self.fixed else normal_of(constant)
        numbers = [torch.zeros_like(drawn), drawn * self._sizes[1:3].flatten()]
        if self.vector is not None:
            numbers.append(self.vector.constants(normal_of(vector)))
        if self.levels is not None:
            level, share, normal = level.split((LEVEL_DRAWS, 1, self.count), -1)
            noise_std, bias_std = self.levels(level).split(self.count, -1)
            numbers[1] = numbers[1] + pad(bias_std * share.sqrt() * normal_of(normal), (0, self.count))
            numbers += [noise_std, bias_std, bias_std * (1 - share).sqrt()]
        return torch.cat(numbers, -1)

    def _disturb(self, tensordict: TensorDictBase, values: list[Tensor], episode: Episode) -> Tensor:
        (value, *others), dtype = values, values[0].dtype
        numbers, stream, first = episode
        errors = self.named(numbers)
        noise_std, _, _, drift_std, resolution = self._sizes.to(dtype)
        *stated, iron = self._accuracy.to(dtype)
        if self.levels is not None:
            levels = [errors[name] for name in LEVELS]
            noise_std, drift_std = torch.hypot(noise_std, levels[0]), torch.hypot(drift_std, levels[2])
            stated = list(map(torch.hypot, stated, levels))
        uniform = stream_uniform(stream, self.step_draws)
        noise, walk = normal_of(uniform[..., :-1]).to(dtype).split(self.count, -1)
        distance = math.inf if first else others[0][..., :1] if others else 1.0
        drift = gauss_markov(errors["drift"], drift_std, distance, self.drift_length, walk)
        reading = self.vector.disturb(value, others[1], errors["vector"]) if self.vector else value
        reading = reading + (reading * errors["scale"] + errors["bias"] + drift + noise * noise_std)
        reading = torch.where(resolution > 0, torch.round(reading / resolution) * resolution, reading)
        missing = (uniform[..., -1:] < self.outage_rate) & (not first)
        reading = torch.where(missing, errors["reading"], reading)
        std = SensorStd(torch.where(missing, OUTAGE_STD, stated[0]), stated[1], stated[2], iron)
        self._measure(tensordict, value, reading, std)
        return torch.cat((drift, reading, numbers[..., 2 * self.count :]), -1)

    def accuracy(self, field: Tensor) -> SensorStd:
        """Return the standard deviations that the errors add to a reading, without ``levels``, each ``(..., E)``.

        Example:
            >>> SensorErrors((1.0, 1.0), bias=(2.0, 0.0)).accuracy(torch.zeros(2))
            SensorStd(noise=tensor([1., 1.]), bias=tensor([2., 0.]), drift=tensor([0., 0.]), iron=tensor([0., 0.]))
        """
        noise, bias, scale, drift, resolution = self._sizes.to(field.dtype).square()
        slow, iron = drift.expand_as(field), torch.zeros_like(field)  # an error of the vector varies with the heading
        if self.vector is not None:
            slow, iron = slow + self.vector.variance(field), self.vector.constant_std(field)
        noise, bias = (noise + resolution / 12).expand_as(field), bias + scale * field.square() + slow
        return SensorStd(noise.sqrt(), bias.sqrt(), slow.sqrt(), iron)


def sensor_levels(uniform: Tensor, exponent: float = 1.5) -> Tensor:
    """Return standard deviations of the errors of D [deg], I [deg] and B_H [nT] from perfect sensors to poor ones.

    In 15 % of cases there is no noise. Otherwise a common factor spans two decades up to 0.2 deg, 0.2 deg and 20 nT,
    half of them above 0.04 deg. Each element has a factor of its own, log-uniform from 0.4 to 2.5,
    and in 30 % of cases the factor of D is multiplied by a number from 1 to 7, as where the north reference is poor.

    In half of the cases there is a bias as well, log-uniform over 1.6 decades up to 0.35 deg, 0.05 deg and
    45 nT, with the same factors of their own.

    Args:
        uniform: ``(..., 12)`` uniform numbers in [0, 1).
        exponent: of the uniform number in the logarithm of the common factor: with 1 it is log-uniform, with half of
            the cases above 0.02 deg; the larger, the more noise.

    Returns:
        ``(..., 6)``: of the noise, and of the bias.

    Raises:
        ValueError: for another number of uniform numbers, or an exponent that is not above 0.

    Example:
        >>> sensor_levels(torch.tensor([0.5, 0.0, 0.5, 0.5, 0.5, 0.5, 0.5, 0.0, 0.5, 0.5, 0.5, 0.5]))
        tensor([ 0.2000,  0.2000, 20.0000,  0.0000,  0.0000,  0.0000])
    """
    check_tensor(LEVEL_DRAWS, uniform=uniform)
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
