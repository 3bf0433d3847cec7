"""Base of the errors: true values, and the accuracy that vehicles know."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from inspect import Parameter, signature
from typing import Any, ClassVar, TypeVar

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite

from magrl.checks import check_number, check_numbers
from magrl.geodesy import wrap_longitude
from magrl.sensor_std import STD_KEYS, SensorStd
from magrl.transforms.base import Keys
from magrl.transforms.episode import EpisodeNumbers

T = TypeVar("T")
TYPICAL_FIELD = (10.0, 60.0, 24000.0)
"""D [deg], I [deg], B_H [nT] at middle latitudes, for which accuracy is stated where errors depend on the field.

The accuracy that a vehicle knows is constant, or follows from its readings. An accuracy at the true field, or at a
reading to which another error is added, would reveal that field or that reading.
"""

LEG_ERROR = "leg_error"
"""Key of what the environment adds to a commanded leg, northward and eastward ``(..., 2)`` [km]."""


class EpisodeErrors(EpisodeNumbers):
    """Base class of errors of a vehicle: their numbers, and what is true, are privileged.

    Example:
        >>> EpisodeErrors(["field"], ["field"]).farthest_km(50.0)
        50.0
    """

    true_keys: ClassVar[tuple[str, ...]] = ()
    """Keys of true values."""
    hidden: ClassVar[Mapping[str, str]] = {}
    """Keys by name that are replaced for the vehicle alone, with the keys of their true values: the environment gets
    these back for its step. A heading keeps its bounds, elements are unbounded."""

    def __init__(self, *keys: Keys | None, **options: Any) -> None:
        super().__init__(*keys, **options)
        if self.hidden:
            named = self._named(self.in_keys)
            self.in_keys_inv, self.out_keys_inv = [named[name] for name in self.hidden], list(self.hidden.values())

    @property
    def state_keys(self) -> list[NestedKey]:
        """Keys that a step reads from the TensorDict before it."""
        return [self.numbers_key, self.stream_key, *self.hidden.values()]

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Give the true values to the environment."""
        true = self._state(tensordict)[2:] if self.hidden else ()
        for key, value in zip(self.in_keys_inv, true, strict=True):
            tensordict.set(key, value)
        return tensordict

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the numbers, their state, and what is hidden."""
        observation_spec = super().transform_observation_spec(observation_spec)
        ins, outs = self._named(self.in_keys), dict(zip(self.out_names, self.out_keys, strict=True))
        for name, true in self.hidden.items():
            leaf = observation_spec[ins[name]]
            observation_spec[true] = leaf.clone()
            if name == "heading":
                observation_spec[outs[name]] = leaf.clone()
            else:
                self._add(observation_spec, leaf, outs[name], *leaf.shape[-1:])
        return observation_spec

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Make the state, and elements that are replaced, part of the input."""
        input_spec = super().transform_input_spec(input_spec)
        state = input_spec["full_state_spec"]
        for name, key in zip(self.hidden, self.in_keys_inv, strict=False):
            if name != "heading" and state is not None and key in state.keys(True, True):
                self._add(state, state[key], key, *state[key].shape[-1:])
        return input_spec

    @classmethod
    def from_options(cls, options: Any, speed_km_h: float, seed: int = 0) -> EpisodeErrors:
        """Return the error of a vehicle with the options that a file states.

        Args:
            options: options of the class by name.
            speed_km_h: speed of the vehicle [km/h], for a class that has this argument.
            seed: seed of the errors.

        Raises:
            ValueError: for an option that the class does not have, or one out of its range.
            TypeError: for an option that is missing, or one of another type.
        """
        speed = {"speed_km_h": speed_km_h} if "speed_km_h" in signature(cls).parameters else {}
        return build(cls, options, **speed, seed=seed)

    def accuracy(self, field: Tensor) -> SensorStd:
        """Return the standard deviations that the errors add to a reading, each ``(..., E)``.

        Args:
            field: ``(..., E)`` reading.
        """
        return SensorStd(*(torch.zeros_like(field) for _ in STD_KEYS))

    def farthest_km(self, max_leg_km: float) -> float:
        """Return the longest path on the ground of a commanded leg [km].

        Args:
            max_leg_km: longest leg that a policy may command [km].

        Raises:
            ValueError: for a leg that is not above 0.
        """
        check_number(0, above=True, max_leg_km=max_leg_km)
        return max_leg_km


def true_keys(kind: type[EpisodeErrors] = EpisodeErrors) -> tuple[str, ...]:
    """Return the keys of all errors that a policy may not read: what is true, the errors, and their streams.

    Args:
        kind: base class of the errors; a module that is not imported is left out.

    Example:
        >>> from magrl.errors import NorthReferenceError
        >>> true_keys(NorthReferenceError)
        ('true_field', 'true_heading', 'north_error', 'north_stream')
    """
    keys = [*kind.true_keys, kind.numbers_key, kind.stream_key] if kind.channel else []
    return tuple(dict.fromkeys([*keys, *(key for subclass in kind.__subclasses__() for key in true_keys(subclass))]))


class ReadingErrors(EpisodeErrors):
    """Base class of errors of a reading, which keep its true value and state its accuracy.

    The accuracy is :meth:`accuracy` at :data:`TYPICAL_FIELD`. Variances add up over the errors of a chain, and
    the first error of a chain keeps the true value. A reading of three elements is D, I, B_H. Where an error carries I
    beyond the vertical, the reading is as of a magnetometer: I is 180 degrees minus I, and D is reversed.

    It writes the true value at ``true_field``, privileged, and its accuracy at :data:`magrl.sensor_std.STD_KEYS`.

    Args:
        in_keys: of the transform.
        out_keys: of the transform.
        seed: seed of the errors.
        stated: accuracy that the vehicle knows, or the fields of :class:`~magrl.sensor_std.SensorStd` by name; by
            default the accuracy of the errors. Errors that no data sheet states have
            :data:`magrl.sensor_std.PERFECT`, or no fields.

    :meth:`_disturb` returns the numbers of the next step, so that a drift keeps its value. :meth:`accuracy` knows no
    time: of an error that grows, it is the mean over an episode.

    Example:
        >>> from magrl.random_numbers import stream_normal
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from torchrl.envs import TransformedEnv
        >>> class TemperatureError(ReadingErrors):
        ...     channel = 8  # a number that no other error has
        ...     default_in_keys, in_sizes = ("field",), {"field": (3,)}
        ...     numbers_key, stream_key = "temperature_error", "temperature_stream"  # privileged keys of its state
        ...     size = draws = 1  # numbers of an episode, and random numbers at its start
        ...     def __init__(self, std_nt, **options):
        ...         super().__init__(**options)
        ...         self.std_nt = std_nt
        ...         self._set_accuracy()
        ...     def _constants(self, stream):  # the errors of new episodes
        ...         return self.std_nt * stream_normal(stream, self.draws)
        ...     def _disturb(self, tensordict, values, episode):
        ...         shift = torch.cat((torch.zeros_like(values[0][..., :2]), episode.numbers), -1)
        ...         self._measure(tensordict, values[0], values[0] + shift)
        ...         return episode.numbers  # for the next step
        ...     def accuracy(self, field):
        ...         none = torch.zeros_like(field)
        ...         return SensorStd(none, field.new_tensor((0.0, 0.0, self.std_nt)).expand_as(field), none, none)
        >>> env = TransformedEnv(GeomagneticNavEnv(num_envs=4, seed=0), TemperatureError(10.0))
        >>> env.rollout(2)["bias_std"][0, 0]
        tensor([ 0.,  0., 10.])
    """

    default_out_keys: ClassVar[Keys] = ("field",)
    true_keys: ClassVar[tuple[str, ...]] = ("true_field",)
    changes_inclination: ClassVar[bool] = True
    """Whether the error may carry I beyond the vertical."""
    _accuracy: Tensor

    def __init__(self, *keys: Keys | None, stated: SensorStd | Mapping[str, Any] | None = None, **options: Any) -> None:
        super().__init__(*keys, **options)
        self.stated = build(SensorStd, stated) if isinstance(stated, Mapping) else stated

    def _set_accuracy(self) -> None:
        """Compute the standard deviations that the vehicle knows, when all sizes are set."""
        (count,) = self.in_sizes["field"]
        field = torch.tensor(TYPICAL_FIELD if count == 3 else (0.0,) * count, dtype=torch.float64)
        accuracy = torch.stack(self.accuracy(field)).to(torch.get_default_dtype())
        self.register_buffer("_accuracy", accuracy, persistent=False)

    def _measure(
        self, tensordict: TensorDictBase, value: Tensor, reading: Tensor, accuracy: SensorStd | None = None
    ) -> None:
        """Write a reading, its true value and its accuracy, if that is not always the same."""
        if tensordict.get(self.true_keys[0], None) is None:
            tensordict.set(self.true_keys[0], value)
        folds = self.changes_inclination and reading.shape[-1] == 3
        self._write_named(tensordict, field=folded(reading) if folds else reading)
        accuracy = SensorStd(*self._accuracy.to(reading.dtype)) if accuracy is None else accuracy
        accuracy = accuracy if self.stated is None else SensorStd(*reading.new_tensor(self.stated))
        for key, std in zip(STD_KEYS, accuracy, strict=True):
            before = tensordict.get(key, None)
            tensordict.set(key, std.expand_as(reading).clone() if before is None else torch.hypot(before, std))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the true value, the accuracy, the errors and the state of the numbers; the reading is unbounded."""
        observation_spec = super().transform_observation_spec(observation_spec)
        leaf = observation_spec[self._named(self.in_keys)["field"]]
        if self.true_keys[0] not in observation_spec.keys(True, True):
            observation_spec[self.true_keys[0]] = leaf.clone()
        for key in (self.out_keys[self.out_names.index("field")], *STD_KEYS):
            self._add(observation_spec, leaf, key, *leaf.shape[-1:])
        return observation_spec


def folded(elements: Tensor) -> Tensor:
    """Return D, I, B_H ``(..., 3)`` with I in [-90, 90]: beyond the vertical, the horizontal field is reversed."""
    declination, inclination, horizontal = elements.unbind(-1)
    folded = wrap_longitude(declination + 180), torch.sign(inclination) * 180 - inclination, horizontal
    return torch.where(inclination.abs().unsqueeze(-1) > 90, torch.stack(folded, -1), elements)


def build(kind: type[T], options: Any, **given: Any) -> T:
    """Return an object of a class with the options that a file states, and those that a program gives.

    Raises:
        ValueError: for an option that the class does not have, with those that a file may state.
        TypeError: for options that have no names.

    Example:
        >>> build(SensorStd, {"noice": [1.0, 1.0, 5.0]})
        Traceback (most recent call last):
        ValueError: SensorStd has no option 'noice': choose from noise, bias, drift, iron
    """
    if not isinstance(options, Mapping):
        raise TypeError(f"{kind.__name__} needs options by name, got {options!r}")
    kinds = [base for base in kind.__mro__ if base is kind or issubclass(base, EpisodeErrors)]
    arguments = [argument for base in kinds for argument in signature(base).parameters.values()]
    variadic = Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD
    names = dict.fromkeys(one.name for one in arguments if one.kind not in variadic)
    allowed = [name for name in names if name not in ("in_keys", "out_keys", "seed", "speed_km_h")]
    for name in options:
        if name not in allowed:
            raise ValueError(f"{kind.__name__} has no option {name!r}: choose from {', '.join(allowed)}")
    return kind(**options, **given)


def check_sizes(count: int | None = None, *, fixed: bool = False, **sizes: Sequence[float]) -> None:
    """Raise unless each size of an error consists of finite numbers, from 0 on if they are standard deviations.

    Args:
        count: how many numbers each has; None for any number of them.
        fixed: whether they are constant errors themselves, which may be negative.
        sizes: values by the name that the message uses.

    Raises:
        ValueError: with the name and the values.

    Example:
        >>> check_sizes(3, bias=(0.1, 0.1, -5.0))
        Traceback (most recent call last):
        ValueError: bias must be a finite number from 0 on, got -5.0
    """
    for name, values in sizes.items():
        length = len(values) if count is None and isinstance(values, Sequence) else count
        check_numbers(length or 1, -math.inf if fixed else 0, **{name: values})


def gauss_markov(value: Tensor, std: Tensor | float, distance: Tensor | float, length: float, normal: Tensor) -> Tensor:
    """Return a first-order Gauss-Markov process after a distance: stationary, with an exponential autocorrelation.

    x becomes ``phi x + std sqrt(1 - phi^2) w`` with ``phi = exp(-distance / length)``, so that the result does not
    depend on how a distance is divided into steps. An infinite distance draws a first value.

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
