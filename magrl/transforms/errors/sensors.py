"""Errors of sensors beyond white noise: bias, scale, drift, outages, rounding, and those of a vector magnetometer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded

from magrl.checks import check_number, check_tensor, check_type
from magrl.counters import advanced, normal_of, stream_normal, stream_uniform
from magrl.transforms.errors.base import TYPICAL_FIELD, check_sizes, gauss_markov
from magrl.transforms.errors.noise import SensorNoise
from magrl.transforms.errors.vector import VectorErrors

OUTAGE_STD = 1e4
"""Standard deviation of a repeated reading, in the unit of each element: a filter ignores it."""


class SensorErrors(SensorNoise):
    """Add the errors of real sensors to a reading.

    In this order: the errors of a vector magnetometer, scale error, bias, drift, white noise, rounding, and outages, in
    which the last reading is repeated. Bias and scale error are constant in an episode; the drift is a first-order
    Gauss-Markov process along the way. Sizes are standard deviations of normal errors (cut at four of them), E numbers
    in the unit of each element; those that are not given are 0.

    The vehicle is told the data sheets: ``sensor_std`` is that of the errors which are new at each reading (noise and
    rounding), during an outage :data:`OUTAGE_STD`; ``bias_std`` that of the constant and the slow ones. Both are roots
    of sums of variances, at :data:`~magrl.transforms.errors.TYPICAL_FIELD`.

    Args:
        std: white noise.
        bias: constant error.
        scale: error of the scale, as a share of the value, where the elements are D, I, B_H.
        drift: slow drift.
        drift_length: its correlation length [unit of the distance in ``move_key``, or steps]; with ``drift`` alone.
        resolution: the reading is rounded to multiples of this; 0 for no rounding.
        outage_rate: probability that a reading is missing; never the first of an episode.
        vector: errors of a vector magnetometer, where the elements are D, I, B_H.
        fixed: whether bias and scale are the errors themselves, in every episode.
        heading_key: key of the heading ``(..., 1)`` [rad] in whose axes ``vector`` acts.
        move_key: key of the last move, whose first number is its distance; None for a drift by steps.
        error_key: key of the errors of the episode ``(..., K)``: bias, scale error, drift, last reading, and those of
            ``vector``. Privileged.
        **options: of :class:`~magrl.transforms.SensorNoise`, except ``std``.

    Raises:
        ValueError: for sizes that are negative or of another number than ``std``, a rate outside [0, 1), a drift
            without its length, or ``scale`` or ``vector`` with other than three elements.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> errors = SensorErrors((0.05, 0.05, 5.0), bias=(0.1, 0.1, 20.0), drift=(0.0, 0.0, 10.0), drift_length=200.0)
        >>> state = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), errors).reset()
        >>> state["sensor_std"][0], state["bias_std"][0]
        (tensor([0.0500, 0.0500, 5.0000]), tensor([ 0.1000,  0.1000, 22.3607]))
    """

    channel = 2

    def __init__(
        self,
        std: Sequence[float] = (0.0, 0.0, 0.0),
        *,
        bias: Sequence[float] | None = None,
        scale: Sequence[float] | None = None,
        drift: Sequence[float] | None = None,
        drift_length: float | None = None,
        resolution: Sequence[float] | None = None,
        outage_rate: float = 0.0,
        vector: VectorErrors | None = None,
        fixed: bool = False,
        heading_key: NestedKey = "heading",
        move_key: NestedKey | None = "move",
        error_key: NestedKey = "sensor_error",
        **options: Any,
    ) -> None:
        super().__init__(std, **options)
        count = len(self.std)
        given = {"bias": bias, "scale": scale, "drift": drift, "resolution": resolution}
        sizes = {name: (0.0,) * count if values is None else values for name, values in given.items()}
        for name, values in sizes.items():
            check_sizes(count, fixed=fixed and name in ("bias", "scale"), **{name: values})
            self.register_buffer(f"_{name}", torch.tensor(values, dtype=torch.get_default_dtype()), persistent=False)
        check_number(0, 1, outage_rate=outage_rate)
        if outage_rate == 1:
            raise ValueError("outage_rate must be below 1, got 1: no reading would be new")
        self.drifting, self.rounded = any(sizes["drift"]), any(sizes["resolution"])
        if self.drifting:
            check_number(0, above=True, drift_length=drift_length)
        if vector is not None:
            check_type(VectorErrors, vector=vector)
        for name, given_errors in (("scale", any(sizes["scale"])), ("vector", vector is not None)):
            if given_errors and count != 3:
                raise ValueError(f"{name} acts on D, I and B_H, got {count} elements in std")
        self.drift_length, self.outage_rate, self.vector = drift_length, float(outage_rate), vector
        self.fixed, self.heading_key, self.move_key, self.error_key = fixed, heading_key, move_key, error_key
        self.register_buffer("_noise", torch.tensor(self.std), persistent=False)
        self.draws = 2 * count + (vector.draws if vector else 0)
        field = torch.tensor(TYPICAL_FIELD if count == 3 else (0.0,) * count, dtype=torch.float64)
        for name, variance in zip(("_white_std", "_slow_std"), self.variances(field), strict=True):
            self.register_buffer(name, variance.sqrt().to(self._bias.dtype), persistent=False)

    # Data

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        values = self._read(tensordict_reset)
        if values is None:
            return tensordict_reset
        stream = self._next_episode(tensordict, tensordict_reset.batch_size, values[0].device)
        errors = self._of_new_episodes(tensordict, stream, self._constants).to(values[0].dtype)
        tensordict_reset.set(self.stream_key, advanced(stream, self.draws).unsqueeze(-1))
        return self._measure(tensordict_reset, values[0], errors, first=True)

    def _constants(self, stream: Tensor) -> Tensor:
        """Return the errors at the start of episodes ``(..., K)``, without drift and last reading."""
        count = len(self.std)
        normal = stream_normal(stream, self.draws)
        drawn = torch.ones_like(normal[..., : 2 * count]) if self.fixed else normal[..., : 2 * count]
        parts = [drawn * torch.cat((self._bias, self._scale)), torch.zeros_like(drawn)]
        if self.vector is not None:
            parts.append(self.vector.constants(normal[..., 2 * count :]))
        return torch.cat(parts, -1)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(next_tensordict)
        if values is None:
            return next_tensordict
        stream, errors = (self._written(tensordict, key) for key in (self.stream_key, self.error_key))
        next_tensordict.set(self.stream_key, advanced(stream, 2 * len(self.std) + 1))
        return self._measure(next_tensordict, values[0], errors, first=False)

    def _measure(self, tensordict: TensorDictBase, value: Tensor, errors: Tensor, first: bool) -> TensorDictBase:
        """Write a reading of a value, its accuracy, the true value and the errors."""
        count, dtype = len(self.std), value.dtype
        uniform = stream_uniform(tensordict[self.stream_key].squeeze(-1), 2 * count + 1)
        noise, walk = normal_of(uniform[..., :-1]).to(dtype).split(count, -1)
        bias, scale, drift, last, vector = errors.tensor_split([count, 2 * count, 3 * count, 4 * count], -1)
        if self.drifting:
            drift = self._drifted(tensordict, drift, walk, first)
        reading = value
        if self.vector is not None:
            reading = self.vector.disturb(reading, tensordict[self.heading_key], vector)
        reading = reading + (reading * scale + bias + drift + noise * self._noise)
        if self.rounded:
            step = self._resolution.to(dtype)
            reading = torch.where(step > 0, torch.round(reading / step) * step, reading)
        std = self._white_std.to(dtype).expand_as(reading).clone()
        if self.outage_rate and not first:
            missing = uniform[..., -1:] < self.outage_rate
            reading, std = torch.where(missing, last, reading), torch.where(missing, OUTAGE_STD, std)
        self._keep(tensordict, self.true_key, value)
        tensordict.set(self.out_keys[0], reading)
        tensordict.set(self.std_key, std)
        self._tell(tensordict, self.bias_key, self._slow_std, reading)
        return tensordict.set(self.error_key, torch.cat((bias, scale, drift, reading, vector), -1))

    def _drifted(self, tensordict: TensorDictBase, drift: Tensor, normal: Tensor, first: bool) -> Tensor:
        std = self._drift.to(drift.dtype)
        if first:
            return std * normal
        distance = 1.0 if self.move_key is None else tensordict[self.move_key][..., :1]
        return gauss_markov(drift, std, distance, float(self.drift_length or 0), normal)

    def variances(self, field: Tensor) -> tuple[Tensor, Tensor]:
        """Return the variances of the errors of a reading: of new errors, and of constant and slow ones.

        Args:
            field: ``(..., E)`` reading.

        Returns:
            Both ``(..., E)``.

        Example:
            >>> SensorErrors((1.0, 1.0), bias=(2.0, 0.0)).variances(torch.zeros(2))
            (tensor([1., 1.]), tensor([4., 0.]))
        """
        check_tensor(len(self.std), field=field)
        noise, bias, scale, drift, resolution = (
            getattr(self, f"_{part}").to(field.dtype).square()
            for part in ("noise", "bias", "scale", "drift", "resolution")
        )
        slow = bias + drift + scale * field.square()
        if self.vector is not None:
            slow = slow + self.vector.variance(field)
        return (noise + resolution / 12).expand_as(field), slow

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Raise an error: the errors of an episode begin with its reset."""
        raise NotImplementedError("SensorErrors needs an environment: append it to a TransformedEnv")

    # Specs

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the true value, the accuracy, the errors and the state of the numbers; the reading is unbounded."""
        observation_spec = super().transform_observation_spec(observation_spec)
        needed = [self.heading_key] * (self.vector is not None) + [self.move_key] * self.drifting
        for key in needed:
            if key is not None:
                self._leaf(observation_spec, key)
        reading = observation_spec[self.out_keys[0]]
        size = 4 * len(self.std) + (self.vector.size if self.vector else 0)
        shape = (*reading.shape[:-1], size)
        observation_spec[self.error_key] = Unbounded(shape, device=reading.device, dtype=reading.dtype)
        return observation_spec

    @property
    def _state_keys(self) -> list[NestedKey]:
        return [*super()._state_keys, self.error_key]
