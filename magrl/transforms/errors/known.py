"""What a vehicle knows of its start and destination: the elements at its start, and both places, each with an error."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl.checks import check_number, check_numbers, check_tensor
from magrl.counters import stream_normal
from magrl.field.elements import element_difference
from magrl.geodesy import move_place
from magrl.sensor_std import PERFECT, SensorStd
from magrl.transforms.base import StatefulTransform
from magrl.transforms.errors.base import Episode, EpisodeNumbers

START_KEYS = ("start_error", "start_field", "start_std", "start_bias_std")
"""Keys of what is known at the start; see :class:`KnownStart`."""
PLACE_KEYS = ("start_place", "target_place")
"""Keys of places that a vehicle knows; see :class:`KnownPlace`."""


def calibration(reading: Tensor, known: Tensor, sensor_std: SensorStd, known_std: Tensor) -> tuple[Tensor, SensorStd]:
    """Return the constant errors of the sensors, given a reading where the elements are known, and what is left.

    With ``c^2 = bias^2 - drift^2`` and ``m^2 = noise^2 + drift^2 + known_std^2``, the difference of reading and known
    elements has the variance ``c^2 + m^2``. The error is ``c^2 / (c^2 + m^2)`` times the difference, and ``c^2 m^2 /
    (c^2 + m^2) + drift^2`` is the variance that is left. An element whose bias is infinite is not measured.

    Args:
        reading: ``(..., 3)`` D [deg], I [deg], B_H [nT], the first reading.
        known: ``(..., 3)`` the elements there, such as those of a field model.
        sensor_std: accuracy of the sensors, each ``(..., 3)``.
        known_std: ``(..., 3)`` standard deviations of the known elements: of the model, and of the crust at the start.

    Returns:
        Constant error ``(..., 3)``, to be subtracted from readings, and the accuracy after that.

    Example:
        >>> here, none = torch.tensor([8.0, -16.0, 35000.0]), torch.zeros(3)
        >>> bias, drift = torch.tensor([0.5, 0.0, 0.0]), torch.tensor([0.3, 0.0, 0.0])
        >>> error, left = calibration(here + bias, here, SensorStd(none, bias, drift), none)
        >>> error[0], left.bias[0]
        (tensor(0.3200), tensor(0.3842))
    """
    check_tensor(3, reading=reading, known=known)
    noise, bias, slow = (std.square() for std in sensor_std[:3])
    constant, other = torch.where(bias < math.inf, bias - slow, 0.0).clamp_min(0), noise + slow + known_std.square()
    gain = torch.where(constant > 0, constant / (constant + other), 0.0)
    left = torch.where(bias < math.inf, gain * other + slow, math.inf).sqrt()
    return gain * element_difference(reading, known), sensor_std._replace(bias=left)


class KnownStart(StatefulTransform):
    """Subtract from all readings the constant errors that the first one shows where the start is known.

    A vehicle usually starts where its position is known, and with it the elements of the field model: see
    :func:`calibration`. The transform stands after all errors. It reads the true elements at the first reading, and
    only there.

    Args:
        sensor_std: accuracy of the sensors, of which the drift counts; noise and bias are those of the reading.
        known_std: standard deviations of the elements that are known at the start: D [deg], I [deg], B_H [nT].
        in_keys: reading, elements without errors, and standard deviations of noise and bias, all ``(..., 3)``.
        out_keys: the reading without the error, the standard deviations of the bias that is left, the error itself, the
            known elements, their standard deviations, and the standard deviations of the bias before, all ``(..., 3)``.
            From the last four, :class:`~magrl.transforms.TrackField` estimates the errors along the way.

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
    default_out_keys = ("field", "bias_std", *START_KEYS)
    in_sizes = dict.fromkeys(default_in_keys, (3,))
    out_sizes = dict.fromkeys(default_out_keys, (3,))
    _std: Tensor

    def __init__(
        self,
        sensor_std: SensorStd | Sequence[float] = PERFECT,
        known_std: Sequence[float] = PERFECT.noise,
        **keys: Any,
    ) -> None:
        super().__init__(**keys)
        check_numbers(3, 0, known_std=known_std)
        self.register_buffer("_std", torch.tensor([SensorStd.of(sensor_std).drift, known_std]), persistent=False)

    def _begin(self, tensordict: TensorDictBase, values: list[Tensor], mask: Tensor | None) -> None:  # noqa: ARG002
        reading, known, noise, bias = values
        drift, known_std = self._std.to(reading.dtype)
        known = torch.where(bias < math.inf, known, reading)  # what is not measured is not told, either
        error, left = calibration(reading, known, SensorStd(noise, bias, drift), known_std)
        given = {"start_error": error, "start_field": known, "start_std": known_std.expand_as(known).clone()}
        first = element_difference(reading, error)
        self._write_named(tensordict, field=first, bias_std=left.bias, start_bias_std=bias, **given)

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:
        before = dict(zip(self.out_names[1:], state, strict=True))
        self._write_named(tensordict, field=element_difference(values[0], before["start_error"]), **before)


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
