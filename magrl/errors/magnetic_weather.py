"""Magnetic weather: the measured field varies in time as an observatory recorded it."""

from __future__ import annotations

from numbers import Real
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn.functional import pad
from torchrl.data import Composite

from magrl.checks import check_number, check_type
from magrl.errors.base import ReadingErrors
from magrl.field.elements import elements_jacobian, field_vector, measured_elements
from magrl.field.weather import WeatherRecord, weather_record
from magrl.random_numbers import FIRST_RESERVED_SEED, stream_uniform
from magrl.sensor_std import SensorStd
from magrl.transforms.episode import Episode

READING_S = 60.0
"""Time that each step takes beside its leg [s], so that standing still takes time; chosen."""


class MagneticWeather(ReadingErrors):
    """Add the variation of the field in time to what a vehicle measures, as an observatory recorded it.

    Each episode starts at a minute of the record that is a pure function of (seed, vehicle, episode). A step takes
    ``distance / speed`` and :data:`READING_S`. The variation of the minute in which the step ends is added to the field
    vector; between the minutes of the record nothing is interpolated. All vehicles of a batch are in the weather of the
    record, wherever they are. ``bias_std`` and ``drift_std`` grow by the root mean square of the variation over the
    time of ``trip_km``, at :data:`~magrl.errors.base.TYPICAL_FIELD`.

    ``field`` becomes the measured field, and ``true_field`` the field without weather, from which the environment
    computes arrival, objective and reward. In ``Compose``, the weather stands before the errors of the sensors.

    Args:
        record: name in :data:`magrl.field.WEATHER`, or a record of one's own.
        speed_km_h: speed of the vehicles [km/h].
        span_h: longest duration of an episode [h]: it starts where the record has no gap for that time; after it, the
            weather stays constant. By default the longest legs until the step
            limit, where the environment has ``max_steps`` and ``max_leg_km``.
        trip_km: distance of a trip, whose weather a vehicle expects [km].
        surrogates: number of variations with the spectrum of the record and random phases
            (:meth:`~magrl.field.WeatherRecord.surrogates`), one of which each episode of a training gets: with an
            environment of a seed below :data:`magrl.random_numbers.FIRST_RESERVED_SEED`. Evaluations, with the seeds
            from there on, get the record itself, which no training has seen.
        in_keys: D [deg], I [deg], B_H [nT] ``(..., 3)``, and the last leg ``(..., K)``, whose first number is the
            distance [km].
        out_keys: the measured elements ``(..., 3)``, in place by default.
        **options: ``seed`` of :class:`~magrl.errors.base.ReadingErrors`. The errors of the
            episode, float64, are the minute of the record in which it started, and the minutes since then.

    Raises:
        ValueError: for a speed or distance that is not positive, another option out of its range, an unknown record, a
            record that is too short for the episode, or an episode without a longest time.
        KeyError: for a step from a TensorDict without the state.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> weather = MagneticWeather("disturbed", speed_km_h=24.0, seed=1)
        >>> state = TransformedEnv(GeomagneticNavEnv(num_envs=1000, seed=0), weather).reset()
        >>> (state["field"] - state["true_field"])[:, 2].std().round()
        tensor(26.)
    """

    channel = 7
    default_in_keys = ("field", "leg")
    numbers_key, stream_key = "weather_clock", "weather_stream"
    in_sizes = {"field": (3,)}
    size, numbers_dtype = 2, torch.float64
    variation: Tensor

    def __init__(
        self,
        record: str | WeatherRecord = "disturbed",
        *,
        speed_km_h: float,
        span_h: float | None = None,
        trip_km: float = 500.0,
        surrogates: int = 0,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self.record = weather_record(record) if isinstance(record, str) else record
        check_type(WeatherRecord, record=self.record)
        check_number(0, whole=True, surrogates=surrogates)
        check_number(0, above=True, speed_km_h=speed_km_h, trip_km=trip_km)
        check_number(0, optional=True, span_h=span_h)
        self.speed_km_h, self.span_h = float(speed_km_h), span_h
        self._starts_by_span: dict[float, Tensor] = {}
        drawn = self.record.surrogates(surrogates).flatten(0, 1) if surrogates else self.record.variation[:0]
        self.register_buffer("variation", torch.cat((self.record.variation, drawn)), persistent=False)
        moments = self.record.second_moments(trip_km / self.speed_km_h)
        self.register_buffer("_moments", moments, persistent=False)
        self._set_accuracy()
        if span_h is not None:
            self._starts()

    def _longest_h(self) -> float:
        """Return the longest time of an episode [h]; by default for the longest legs until the step limit."""
        if self.span_h is not None:
            return self.span_h
        steps, leg_km = (getattr(self.parent, name, None) for name in ("max_steps", "max_leg_km"))
        if not isinstance(steps, Real) or not isinstance(leg_km, Real):
            raise ValueError(
                "MagneticWeather needs span_h, the longest time that an episode takes [h]: there is no environment "
                "with max_steps and max_leg_km from which it follows, got span_h None"
            )
        return float(steps) * (float(leg_km) / self.speed_km_h + READING_S / 3600)

    def _starts(self) -> Tensor:
        """Return the minutes at which an episode can start, ``(S,)`` int64."""
        span_h = self._longest_h()
        if span_h not in self._starts_by_span:
            self._starts_by_span = {span_h: self.record.starts(span_h)}
        return self._starts_by_span[span_h]

    def _constants(self, stream: Tensor) -> Tensor:
        """Return the minute at which an episode starts, and 0 minutes since then, ``(..., 2)``.

        The minutes of the surrogates come after the record's.
        """
        starts, length = self._starts().to(stream.device), len(self.record.variation)
        if len(self.variation) > length and self._trains():
            later = torch.arange(length, len(self.variation), length, device=stream.device)
            starts = (later.unsqueeze(-1) + starts).flatten()
        return pad(starts[(stream_uniform(stream, 1) * len(starts)).long()].double(), (0, 1))

    def _trains(self) -> bool:
        """Return whether the seed of the environment, or the seeds of several, are of a training."""
        seeds = getattr(self.parent, "seed", None)
        seeds = seeds if isinstance(seeds, list) else [seeds]
        return all(seed is not None and seed < FIRST_RESERVED_SEED for seed in seeds)

    def _disturb(self, tensordict: TensorDictBase, values: list[Tensor], episode: Episode) -> Tensor:
        (field, leg), (start, minutes) = values, episode.numbers.unbind(-1)
        if not episode.first:
            step_h = leg[..., 0].double() / self.speed_km_h + READING_S / 3600
            minutes = (minutes + 60 * step_h).clamp(max=60 * self._longest_h())
        vector = field_vector(field.double()) + self.variation[(start + minutes).long()]
        self._measure(tensordict, field, measured_elements(vector).to(field.dtype))
        return torch.stack((start, minutes), -1)

    def accuracy(self, field: Tensor) -> SensorStd:
        """Return the standard deviations that the errors add to a reading, each ``(..., 3)``.

        Example:
            >>> weather = MagneticWeather("disturbed", speed_km_h=24.0)
            >>> [round(x, 2) for x in weather.accuracy(torch.tensor([0.0, 60.0, 24000.0])).drift.tolist()]
            [0.06, 0.05, 41.2]
        """
        change = elements_jacobian(field_vector(field))
        slow = (change @ self._moments.to(field) * change).sum(-1).sqrt()
        return SensorStd(torch.zeros_like(field), slow, slow, torch.zeros_like(field))

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the elements without weather and the state; the measured elements are unbounded.

        Raises:
            ValueError: if the record is too short for the episodes.
        """
        self._starts()  # an error before the first episode
        return super().transform_observation_spec(observation_spec)
