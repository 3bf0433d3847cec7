"""Calibration where the start is known: constant errors of the sensors show in the first reading."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl.checks import check_numbers, check_tensor
from magrl.field.elements import element_difference
from magrl.transforms.base import GivenKeys, StatefulTransform

EXACT = (0.0, 0.0, 0.0)


class Calibration(NamedTuple):
    """Constant error ``(..., 3)`` of D [deg], I [deg], B_H [nT], to be subtracted from readings, and the standard
    deviation ``(..., 3)`` of the constant and slow errors that are left.

    Example:
        >>> Calibration(torch.zeros(3), torch.ones(3)).bias_std
        tensor([1., 1., 1.])
    """

    error: Tensor
    bias_std: Tensor


def calibration(
    reading: Tensor, known: Tensor, sensor_std: Tensor, bias_std: Tensor, drift_std: Tensor, known_std: Tensor
) -> Calibration:
    """Return the constant errors of the sensors, given a reading where the elements are known.

    With ``c^2 = bias_std^2 - drift_std^2`` and ``m^2 = sensor_std^2 + drift_std^2 + known_std^2``, the difference of
    reading and known elements has the variance ``c^2 + m^2``. The error is ``c^2 / (c^2 + m^2)`` times the difference,
    and ``c^2 m^2 / (c^2 + m^2) + drift_std^2`` is the variance that is left.

    Args:
        reading: ``(..., 3)`` D [deg], I [deg], B_H [nT], the first reading.
        known: ``(..., 3)`` the elements there, such as those of a field model.
        sensor_std: ``(..., 3)`` standard deviations of the errors that are new in each reading.
        bias_std: ``(..., 3)`` those of constant and slow errors.
        drift_std: ``(..., 3)`` those of the slow errors alone, which vary along the way; at most ``bias_std``.
        known_std: ``(..., 3)`` those of the known elements: of the model, and of the crust at the start.

    Example:
        >>> here, none = torch.tensor([8.0, -16.0, 35000.0]), torch.zeros(3)
        >>> bias, drift = torch.tensor([0.5, 0.0, 0.0]), torch.tensor([0.3, 0.0, 0.0])
        >>> error, left = calibration(here + bias, here, none, bias, drift, none)
        >>> error[0], left[0]
        (tensor(0.3200), tensor(0.3842))
    """
    check_tensor(3, reading=reading, known=known)
    slow = drift_std.square()
    constant, other = (bias_std.square() - slow).clamp_min(0), sensor_std.square() + slow + known_std.square()
    gain = torch.where(constant > 0, constant / (constant + other), 0.0)
    return Calibration(gain * element_difference(reading, known), (gain * other + slow).sqrt())


class KnownStart(StatefulTransform):
    """Subtract from all readings the constant errors that the first one shows where the start is known.

    A vehicle usually starts where its position is known, and with it the elements of the field model: see
    :func:`calibration`. The transform stands after all errors. It reads the true elements at the first reading, and
    only there.

    Args:
        drift_std: standard deviations of slow errors, which vary along the way: of D [deg], I [deg], B_H [nT].
        known_std: standard deviations of the elements that are known at the start.
        in_keys: reading, elements without errors, and standard deviations of new errors, and of constant and slow ones,
            all ``(..., 3)``.
        out_keys: the reading without the error, the standard deviations of the constant and slow errors that are left,
            and the error itself, all ``(..., 3)``.

    Raises:
        ValueError: for a standard deviation that is negative, or another number of keys.
        KeyError: for a step from a TensorDict without the state.

    Example:
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from magrl.transforms import SensorErrors
        >>> steps = Compose(SensorErrors(bias=(0.1, 0.1, 20.0)), KnownStart())
        >>> state = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), steps).rollout(3)
        >>> (state["field"] - state["true_field"]).abs().max() < 0.01, state["bias_std"].max()
        (tensor(True), tensor(0.))
    """

    default_in_keys = ("field", "true_field", "sensor_std", "bias_std")
    default_out_keys = ("field", "bias_std", "start_error")
    in_sizes = (3, 3, 3, 3)
    out_sizes = (3,), (3,), (3,)
    _std: Tensor

    def __init__(
        self,
        drift_std: Sequence[float] = EXACT,
        known_std: Sequence[float] = EXACT,
        in_keys: GivenKeys = None,
        out_keys: GivenKeys = None,
    ) -> None:
        super().__init__(in_keys, out_keys)
        check_numbers(3, 0, drift_std=drift_std, known_std=known_std)
        self.register_buffer("_std", torch.tensor([list(drift_std), list(known_std)]), persistent=False)

    def _begin(self, tensordict: TensorDictBase, values: list[Tensor], mask: Tensor | None) -> None:  # noqa: ARG002
        found = calibration(*values, *self._std.to(values[0].dtype))
        self._write(tensordict, values[0], found.bias_std, found.error)

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:
        self._write(tensordict, values[0], *state)

    def _write(self, tensordict: TensorDictBase, reading: Tensor, bias_std: Tensor, error: Tensor) -> None:
        for key, value in zip(self.out_keys, (element_difference(reading, error), bias_std, error), strict=True):
            tensordict.set(key, value)
