"""Magnetic weather along an episode: the field that is measured varies in time, as an observatory recorded it."""

from __future__ import annotations

from numbers import Real

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs import EnvBase, Transform

from magrl.checks import check_number, check_tensor, check_type
from magrl.counters import stream_uniform
from magrl.field.elements import elements_jacobian, field_vector, measured_elements
from magrl.field.records import WeatherRecord, weather_record
from magrl.transforms.base import Keys, expect_keys, key_list, several_keys
from magrl.transforms.errors.base import TYPICAL_FIELD, EpisodeErrors

SPEEDS_KM_H = {"aircraft": 341.0, "ship": 24.0, "underwater": 6.1}
"""Speeds of vehicles [km/h], with which 400 km take 1.2 h, 17 h and 66 h.

- ``"aircraft"``: Cessna 208B Grand Caravan EX, 184 kn at 10 000 ft (manufacturer's figure).
- ``"ship"``: RRS Sir David Attenborough, cruising speed of 13 kn (British Antarctic Survey).
- ``"underwater"``: Kongsberg HUGIN Endurance, 2200 km in 15 days (manufacturer's figure).
"""


class MagneticWeather(EpisodeErrors):
    """Add the variation of the field in time to what a vehicle measures, as an observatory recorded it.

    Each episode starts at a minute of the record that is a pure function of (seed, vehicle, episode). A step takes
    ``distance / speed + reading_s``. The variation of the minute in which the step ends is added to the field vector;
    between the minutes of the record nothing is interpolated. All vehicles of a batch are in the weather of the record,
    wherever they are. The vehicle is told its size: ``bias_std`` grows by the root mean square of the variation, at
    :data:`~magrl.transforms.errors.TYPICAL_FIELD`.

    ``field`` becomes what is measured, and ``true_field`` what it was: arrival, objective and reward belong to the
    environment and know no weather. In ``Compose``, the weather stands before the errors of the sensors.

    Args:
        record: name in :data:`magrl.field.WEATHER`, or a record of one's own.
        speed_km_h: speed of the vehicles [km/h], as in :data:`SPEEDS_KM_H`.
        reading_s: time that each step takes beside its move [s], so that standing still takes time.
        span_h: longest time that an episode takes [h]: it starts where the record has no gap for so long, and the
            weather of an episode that takes longer stays as it is then. By default the longest moves until the step
            limit, where the environment has ``max_steps`` and ``max_move_km``.
        in_keys: D [deg], I [deg], B_H [nT] ``(..., 3)``, and the last move ``(..., K)``, whose first number is the
            distance [km].
        out_keys: the measured elements ``(..., 3)``, in place by default.
        true_key: key of the elements without weather, if no transform before this one has written it. Privileged: a
            policy must not read it.
        bias_key: key of the standard deviations of the elements' constant and slow errors ``(..., 3)``.
        clock_key: key of the state ``(..., 2)``, float64: the minute of the record in which the episode started, and
            the minutes since then. Privileged.
        seed: seed of the starts. TorchRL's ``env.set_seed`` does not reach transforms; see :meth:`restart`.

    Raises:
        ValueError: for a speed that is not positive, another option out of its range, an unknown record, a record that
            is too short for the episode, or an episode without a longest time.
        KeyError: for a step from a TensorDict without the state.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> weather = MagneticWeather("disturbed", speed_km_h=SPEEDS_KM_H["ship"], seed=1)
        >>> state = TransformedEnv(GeomagneticNavEnv(num_envs=1000, seed=0), weather).reset()
        >>> (state["field"] - state["true_field"])[:, 2].std().round()
        tensor(26.)
    """

    channel = 7
    variation: Tensor
    _known: tuple[Tensor, float] | None

    def __init__(
        self,
        record: str | WeatherRecord = "disturbed",
        *,
        speed_km_h: float,
        reading_s: float = 60.0,
        span_h: float | None = None,
        in_keys: Keys = ("field", "move"),
        out_keys: NestedKey | Keys = ("field",),
        true_key: NestedKey = "true_field",
        bias_key: NestedKey = "bias_std",
        clock_key: NestedKey = "weather_clock",
        seed: int = 0,
    ) -> None:
        super().__init__(several_keys(in_keys), key_list(out_keys), stream_key=clock_key, seed=seed)
        expect_keys(self, 2, 1)
        self.record = weather_record(record) if isinstance(record, str) else record
        check_type(WeatherRecord, record=self.record)
        check_number(0, above=True, speed_km_h=speed_km_h)
        check_number(0, reading_s=reading_s)
        self.speed_km_h, self.reading_s, self.span_h = float(speed_km_h), float(reading_s), span_h
        self.true_key, self.bias_key, self.clock_key = true_key, bias_key, clock_key
        self._known = None if span_h is None else (self.record.starts(span_h), float(span_h))
        self.register_buffer("variation", self.record.variation, persistent=False)
        self.register_buffer("_moments", self.record.second_moments(), persistent=False)
        slow = self.variances(torch.tensor(TYPICAL_FIELD, dtype=torch.float64))[1]
        self.register_buffer("_std", slow.sqrt().to(torch.get_default_dtype()), persistent=False)

    def set_container(self, container: Transform | EnvBase) -> None:
        """Attach to an environment, from which the longest time of an episode follows where it is not given."""
        super().set_container(container)
        self._known = None if self.span_h is None else self._known

    def _limits(self) -> tuple[Tensor, float]:
        """Return the minutes at which an episode can start, ``(S,)`` int64, and the longest time that it takes [h]."""
        if self._known is None:
            span_h = self._longest_h()
            self._known = self.record.starts(span_h), span_h
        return self._known

    def _longest_h(self) -> float:
        """Return the time of the longest moves until the step limit of the environment [h]."""
        steps, move_km = (getattr(self.parent, name, None) for name in ("max_steps", "max_move_km"))
        if not isinstance(steps, Real) or not isinstance(move_km, Real):
            raise ValueError(
                "MagneticWeather needs span_h, the longest time that an episode takes [h]: there is no environment "
                "with max_steps and max_move_km from which it follows, got span_h None"
            )
        return float(steps) * (float(move_km) / self.speed_km_h + self.reading_s / 3600)

    # Data

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        values = self._read(tensordict_reset)
        if values is not None:
            stream = self._next_episode(tensordict, tensordict_reset.batch_size, values[0].device)
            starts = self._limits()[0].to(stream.device)
            start = starts[(stream_uniform(stream, 1).squeeze(-1) * len(starts)).long()].double()
            tensordict_reset.set(self.clock_key, torch.stack((start, torch.zeros_like(start)), -1))
        return self._call(tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(next_tensordict)
        if values is not None:
            start, minutes = self._written(tensordict, self.clock_key).unbind(-1)
            step_h = values[1][..., 0].double() / self.speed_km_h + self.reading_s / 3600
            minutes = (minutes + 60 * step_h).clamp(max=60 * self._limits()[1])
            next_tensordict.set(self.clock_key, torch.stack((start, minutes), -1))
        return self._call(next_tensordict)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(next_tensordict)
        if values is None:
            return next_tensordict
        field, minute = values[0], self._written(next_tensordict, self.clock_key).sum(-1).long()
        vector = field_vector(field.double()) + self.variation[minute]
        self._keep(next_tensordict, self.true_key, field)
        self._tell(next_tensordict, self.bias_key, self._std, field)
        return next_tensordict.set(self.out_keys[0], measured_elements(vector).to(field.dtype))

    def variances(self, field: Tensor) -> tuple[Tensor, Tensor]:
        """Return the variances of the errors of a reading: of new errors, and of constant and slow ones.

        Args:
            field: ``(..., E)`` reading.

        Returns:
            Both ``(..., E)``.

        Example:
            >>> weather = MagneticWeather("disturbed", speed_km_h=24.0)
            >>> [round(x, 2) for x in weather.variances(torch.tensor([0.0, 60.0, 24000.0]))[1].sqrt().tolist()]
            [0.07, 0.04, 40.18]
        """
        check_tensor(3, field=field)
        change = elements_jacobian(field_vector(field))
        return torch.zeros_like(field), (change @ self._moments.to(field) * change).sum(-1)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Measure the elements of a TensorDict that holds the clock."""
        return self._call(tensordict)

    # Specs

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the elements without weather and the state; the measured elements are unbounded."""
        leaf = self._leaf(observation_spec, self.in_keys[0])
        self._leaf(observation_spec, self.in_keys[1])
        if leaf.shape[-1:] != (3,):
            raise ValueError(
                f"MagneticWeather changes D, I and B_H: {self.in_keys[0]!r} must be (..., 3), got {tuple(leaf.shape)}"
            )
        self._limits()  # an error before the first episode
        if not self._comes_before(self.true_key):
            observation_spec[self.true_key] = leaf.clone()
        for key in (self.out_keys[0], self.bias_key):
            observation_spec[key] = Unbounded(leaf.shape, device=leaf.device, dtype=leaf.dtype)
        clock = Unbounded((*leaf.shape[:-1], 2), device=leaf.device, dtype=torch.float64)
        observation_spec[self.clock_key] = clock
        return observation_spec
