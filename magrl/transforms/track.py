"""Transforms that navigate by the vehicle's own track: estimates of a Kalman filter, search and declared arrival."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite

from magrl import tracking
from magrl.checks import check_choice, check_number, check_numbers
from magrl.sensor_std import STD_KEYS, SensorStd
from magrl.tracking import STEP_PRICE, FieldTrack, GradientPrior, GradientRelation, LearnedPrior, Way
from magrl.transforms.base import GivenKeys, Keys, StatefulTransform

FRAMES = ("world", "vehicle")
IN_KEYS = ("field", "target_field", "move", "heading")
TRACK_KEYS = ("track_mean", "track_covariance")
OUT_KEYS = (*TRACK_KEYS, "estimated_field", "estimated_gradient", "way", "way_covariance")


class TrackGradient(StatefulTransform):
    """Estimate the field, its gradient and the way to the target from the readings along the track.

    The filter of :mod:`magrl.tracking`: it starts at a reset from the first reading and a prior of the gradient; each
    step moves it by the last move and corrects it by the reading at its end. Its state is in the TensorDict
    (float64). Nothing that it writes is privileged unless an input is.

    Args:
        in_keys: readings ``(..., E)``, values at the target ``(..., E)``, the last move ``(..., K)`` (its first number
            is the distance [km]), and the heading after the move ``(..., 1)`` [rad].
        out_keys: the state, in the scaled units of :class:`~magrl.tracking.FieldTrack`: mean ``(..., E, 3)`` and
            covariance ``(..., E, 3, 3)``, always northward and eastward; then the estimates: the field ``(..., E)``,
            its gradient ``(..., E, 2)`` [element unit / km], the way to aim at ``(..., 2)`` [km] and the covariance of
            that to the target ``(..., 2, 2)`` [km^2] (:meth:`magrl.tracking.WayPosterior.aim`).
        std_keys: where readings come with standard deviations ``(..., E)``, the key of that of the noise, alone or with
            those of the bias, which widens the covariance of the way, and of the drift, of which a part counts as
            noise.
        sensor_std: accuracy of the sensors without ``std_keys``, a :class:`~magrl.sensor_std.SensorStd` or E numbers
            for white noise; perfect by default. The filter has a floor, :data:`~magrl.tracking.VARIANCE_FLOOR`.
        prior: function from a first reading and the values at the target, ``(..., E)`` each, to a
            :class:`~magrl.tracking.GradientPrior`; by default :class:`~magrl.tracking.LearnedPrior`. For other elements
            than D, I, B_H, give one, and also ``relation``, ``common``, ``scales``, ``curvature`` and ``angles``.
        relation: function from the estimated field ``(..., E)`` to a :class:`~magrl.tracking.GradientRelation` that the
            gradients obey; None for none.
        common: function from the estimated field ``(..., E)`` to how constant errors are correlated, ``(..., E)``, as
            :func:`~magrl.tracking.common_error`; None for independent ones.
        scales: units of the elements in the state, E numbers; see :func:`magrl.tracking.start`.
        curvature: standard deviation of the change of a gradient along the way, E numbers or a function from the
            estimated field ``(..., E)`` to them; see :func:`magrl.tracking.predict`.
        angles: elements that are angles in degrees, by index: their differences are wrapped, and their estimate is
            continued beyond 180 degrees.
        range_km: prior standard deviation of the way along each axis [km].
        frame: axes of the estimated gradient and way: ``"world"`` for north and east, ``"vehicle"`` for forward and to
            the right.

    Raises:
        ValueError: for an option out of its range, another number of keys, or shapes that do not match.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from torchrl.envs import TransformedEnv
        >>> env = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), TrackGradient())
        >>> env.rollout(5)["next", "estimated_gradient"].shape
        torch.Size([2, 5, 3, 2])
    """

    default_in_keys = IN_KEYS
    default_out_keys = OUT_KEYS
    optional_in_keys = STD_KEYS
    in_counts = (4, 5, 7)
    scales: Tensor
    sensor_std: Tensor
    periods: Tensor
    constant_curvature: Tensor

    def __init__(
        self,
        in_keys: GivenKeys = None,
        out_keys: GivenKeys = None,
        *,
        std_keys: Keys = (),
        sensor_std: SensorStd | Sequence[float] | None = None,
        prior: Callable[[Tensor, Tensor], GradientPrior] | None = None,
        relation: Callable[[Tensor], GradientRelation] | None = tracking.curl_relation,
        common: Callable[[Tensor], Tensor] | None = tracking.common_error,
        scales: Sequence[float] = tracking.ELEMENT_SCALES,
        curvature: Sequence[float] | Callable[[Tensor], Tensor] = tracking.field_curvature,
        angles: Sequence[int] = (0,),
        range_km: float = 300.0,
        frame: str = "world",
    ) -> None:
        super().__init__(in_keys, out_keys, std_keys)
        if sensor_std is not None and std_keys:
            raise ValueError(f"give sensor_std or std_keys, not both: got {sensor_std} and {std_keys}")
        check_number(0, above=True, range_km=range_km)
        check_choice(FRAMES, frame=frame)
        prior = LearnedPrior.pretrained() if prior is None else prior
        if not callable(prior) or not all(f is None or callable(f) for f in (relation, common)):
            wanted = "prior must be a function, relation one or None, and common one or None"
            raise ValueError(f"{wanted}, got {prior!r}, {relation!r} and {common!r}")
        self.prior, self.relation, self.common = prior, relation, common
        self.range_km, self.frame = float(range_km), frame
        self.curvature = curvature if callable(curvature) else None
        count = len(scales)
        self.in_sizes = (count, count, None, 1, count, count, count)
        self.out_sizes = (count, 3), (count, 3, 3), (count,), (count, 2), (2,), (2, 2)
        if not set(angles) <= set(range(count)):
            raise ValueError(f"angles must be indices of the {count} elements, got {angles!r}")
        stated = SensorStd.of((0.0,) * count if sensor_std is None else sensor_std, count)
        self.biased, numbers = any(stated.bias), {"scales": scales, "sensor_std": stated}
        numbers["periods"] = [360.0 * (index in angles) for index in range(count)]
        if not callable(curvature):
            check_numbers(count, 0, curvature=curvature)
            numbers["constant_curvature"] = curvature
        check_numbers(count, scales=scales)
        check_number(0, above=True, scales=min(scales))
        for name, values in numbers.items():  # float64, as a 0.3 of float32 is another in float64
            self.register_buffer(name, torch.tensor(values, dtype=torch.float64), persistent=False)

    @property
    def state_keys(self) -> list[NestedKey]:
        """Mean and covariance of the filter."""
        return self.out_keys[:2]

    def _begin(self, tensordict: TensorDictBase, values: list[Tensor], mask: Tensor | None) -> None:  # noqa: ARG002
        (reading, target, *_), (sensor_std, _) = (x.double() for x in values), self._std(values)
        self._write(tensordict, values, tracking.start(reading, self.prior(reading, target), sensor_std, self.scales))

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:
        (reading, _, move, heading, *_), (sensor_std, _) = (x.double() for x in values), self._std(values)
        track, displacement = FieldTrack(*state), tracking.displacement_of(move, heading)
        curvature = self._curvature(tracking.estimated_field(track, self.scales))
        track = tracking.read(track, displacement, reading, sensor_std, curvature, self.scales, self.periods)
        self._write(tensordict, values, track)

    def _curvature(self, field: Tensor) -> Tensor:
        """Return the standard deviation ``(..., E)`` of the change of a gradient along the way."""
        return self.constant_curvature if self.curvature is None else self.curvature(field)

    def _write(self, tensordict: TensorDictBase, values: list[Tensor], track: FieldTrack) -> None:
        (_, target, _, heading, *_), (_, bias_std) = (x.double() for x in values), self._std(values)
        estimates = (x.to(values[0].dtype) for x in self.estimates(track, target, heading, bias_std))
        for key, entry in zip(self.out_keys, (*track, *estimates), strict=True):
            tensordict.set(key, entry)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add what is written; the state is in float64."""
        observation_spec = super().transform_observation_spec(observation_spec)
        for key, size in zip(self.state_keys, self.out_sizes, strict=False):
            self._add(observation_spec, observation_spec[self.in_keys[0]], key, *size, dtype=torch.float64)
        return observation_spec

    def _std(self, values: list[Tensor]) -> tuple[Tensor, Tensor | None]:
        """Return the standard deviations of a reading and of its bias, of the TensorDict or as stated."""
        _, _, _, _, *given = values
        if len(given) == 1:
            return given[0], None
        std = SensorStd(*(given or self.sensor_std))
        return tracking.reading_std(std.noise, std.drift), std.bias if given or self.biased else None

    def estimates(
        self, track: FieldTrack, target: Tensor, heading: Tensor, bias_std: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the estimates of the field, its gradient, the way to aim at and its covariance, as written.

        Args:
            track: state of the filter.
            target: ``(..., E)`` values at the target.
            heading: ``(..., 1)`` [rad].
            bias_std: ``(..., E)`` standard deviation of a constant error of the readings.
        """
        related, cross = (track, None) if self.relation is None else tracking.related(track, self.relation, self.scales)
        field, gradient = (f(related, self.scales) for f in (tracking.estimated_field, tracking.estimated_gradient))
        field = field - self.periods.to(field.dtype) * torch.round(field / 360)
        options = self.range_km, self.scales, cross, bias_std, self.periods, self._curvature(field)
        common = None if self.common is None or bias_std is None else self.common(field)
        posterior = tracking.way_posterior(related, target, *options, common, fine=False)
        aim = posterior.aim(tracking.way_to(related, target, *options))
        way, covariance = (part.to(target.dtype) for part in aim)
        if self.frame == "vehicle":
            gradient, covariance = _turned(gradient, heading), _turned(_turned(covariance, heading).mT, heading)
            way = _turned(way.unsqueeze(-2), heading).squeeze(-2)
        return field, gradient, way, covariance


class NoiseScale(StatefulTransform):
    """Scale the stated standard deviations of the noise of D, I, B_H by what the readings show.

    If the stated noise is too low, estimates are overconfident and arrivals are declared too soon; if it is too high,
    readings are wasted. See :func:`magrl.tracking.noise_estimate`. It stands before :class:`TrackGradient`, so
    that this and all that follow read the scaled value; a navigator takes the larger of this and what it was given. An
    element without noise keeps 0. Its state is in the TensorDict.

    Args:
        in_keys: reading ``(..., 3)``, the last move ``(..., K)`` (distance [km] first), heading ``(..., 1)`` [rad], and
            the standard deviations ``(..., 3)`` of noise and drift.
        out_keys: the standard deviation of the noise ``(..., 3)``, by default in place of the stated one; and the
            state: logarithms of the ratios of the variances ``(..., 3)``, and the effective numbers of readings
            ``(..., 3)``.

    Raises:
        ValueError: for another number of keys, shapes that do not match, or a place behind :class:`TrackGradient`.
        KeyError: for a step from a TensorDict without the state or the track.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from magrl.transforms import SensorNoise
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> steps = Compose(SensorNoise((0.05, 0.05, 5.0)), NoiseScale(), TrackGradient(std_keys=STD_KEYS))
        >>> TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), steps).rollout(3)["noise_log_ratio"].shape
        torch.Size([2, 3, 3])
    """

    default_in_keys = ("field", "move", "heading", "sensor_std", "drift_std")
    default_out_keys = ("sensor_std", "noise_log_ratio", "noise_readings")
    in_sizes = (3, None, 1, 3, 3)
    out_sizes = ((3,),) * 3

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Raise if an earlier transform writes the track: its filter would not read the scaled value."""
        if written := [key for key in TRACK_KEYS if key in observation_spec.keys(True, True)]:
            raise ValueError(f"NoiseScale stands before the transform that writes {written}: change their order")
        return super().transform_observation_spec(observation_spec)

    def _begin(self, tensordict: TensorDictBase, values: list[Tensor], mask: Tensor | None) -> None:  # noqa: ARG002
        noise = self._named(values)["sensor_std"]
        self._write(tensordict, noise, tracking.NoiseEstimate(0 * noise, 0 * noise))

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:
        seen = self._named([x.double() for x in values])
        *before, mean, covariance = (x.double() for x in state)
        track, displacement = FieldTrack(mean, covariance), tracking.displacement_of(seen["move"], seen["heading"])
        errors = seen["field"], seen["sensor_std"], seen["drift_std"]
        estimate = tracking.noise_estimate(tracking.NoiseEstimate(*before), track, displacement, *errors)
        self._write(tensordict, self._named(values)["sensor_std"], estimate)

    def _write(self, tensordict: TensorDictBase, std: Tensor, estimate: tracking.NoiseEstimate) -> None:
        for key, value in zip(self.out_keys, (std * estimate.factor, *estimate), strict=True):
            tensordict.set(key, value.to(std.dtype))

    def _state(self, tensordict: TensorDictBase) -> list[Tensor] | None:
        state, track = super()._state(tensordict), self._read(tensordict, TRACK_KEYS, state=True)
        return None if state is None or track is None else [*state, *track]


class SearchAim(StatefulTransform):
    """Write the way to the most probable destination that the vehicle has not visited.

    The destination is not at a visited place, because the episode did not end there: see
    :func:`magrl.tracking.unvisited`. This matters where the readings have a constant error: the estimate alone leads to
    a place beside the destination and stays there. For environments that end the episode at arrival; a vehicle that
    declares its arrival gets no such signal.

    It stands after :class:`TrackGradient`. Its state is in the TensorDict.

    Args:
        in_keys: reading and target ``(..., 3)``, last move ``(..., K)`` (distance [km] first), heading ``(..., 1)``
            [rad], mean ``(..., 3, 3)`` and covariance ``(..., 3, 3, 3)`` of the filter, estimated way ``(..., 2)`` [km]
            and its covariance ``(..., 2, 2)`` [km^2].
        out_keys: the way to aim at ``(..., 2)`` [km], and the state: displacements to the last visited
            places ``(..., 24, 2)`` northward and eastward [km], and weights of the objective ``(..., 3)``.
        zeta: arrival threshold on the objective.
        frame: axes of the way, as in :class:`TrackGradient`.

    Raises:
        ValueError: for a threshold that is not above 0, an unknown frame, or another number of keys.
        KeyError: for a step from a TensorDict without the state.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> steps = Compose(TrackGradient(), SearchAim(zeta=0.01))
        >>> TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), steps).rollout(3)["visited"].shape
        torch.Size([2, 3, 24, 2])
    """

    default_in_keys = (*IN_KEYS, *TRACK_KEYS, "way", "way_covariance")
    default_out_keys = ("aim", "visited", "arrival_weights")
    out_sizes = (2,), (tracking.VISITED, 2), (3,)

    def __init__(self, *, zeta: float, frame: str = "world", **keys: Any) -> None:
        super().__init__(**keys)
        check_number(0, above=True, zeta=zeta)
        check_choice(FRAMES, frame=frame)
        self.zeta, self.frame = float(zeta), frame

    def _begin(self, tensordict: TensorDictBase, values: list[Tensor], mask: Tensor | None) -> None:  # noqa: ARG002
        reading, target, *_ = values
        weights = tracking.arrival_weights(reading, target, self.zeta)
        self._write(tensordict, values, tracking.unvisited_yet(reading), weights)

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:
        (visited, weights), (_, _, move, heading, *_) = state, values
        displacement = tracking.displacement_of(move, heading)
        self._write(tensordict, values, tracking.visit(visited, displacement), weights)

    def _write(self, tensordict: TensorDictBase, values: list[Tensor], visited: Tensor, weights: Tensor) -> None:
        seen = self._named([x.double() for x in values])
        track, way = FieldTrack(*(seen[key] for key in TRACK_KEYS)), Way(seen["way"], seen["way_covariance"])
        heading = seen["heading"]
        north_east = torch.eye(2, dtype=heading.dtype, device=heading.device)
        axes = _turned(north_east, heading).mT if self.frame == "vehicle" else None
        aim = tracking.aim(track, way, visited.double(), weights.double(), axes=axes)
        for key, value in zip(self.out_keys, (aim.to(visited.dtype), visited, weights), strict=True):
            tensordict.set(key, value)


class PlannedMove(StatefulTransform):
    """Write the move that dual control plans (:func:`magrl.tracking.planned_move`), for policies that correct it.

    It stands after :class:`TrackGradient`. It plans in float64, as :class:`~magrl.navigators.Kalman` does.

    Args:
        in_keys: values at the target ``(..., 3)``, heading ``(..., 1)`` [rad], number of the step ``(..., 1)``, mean
            ``(..., 3, 3)`` and covariance ``(..., 3, 3, 3)`` of the filter, way to aim at ``(..., 2)`` [km], and the
            standard deviations ``(..., 3)`` of noise, bias and drift.
        out_keys: displacement ``(..., 2)`` [km].
        max_move_km: longest move [km].
        max_steps: step limit.
        range_km: prior standard deviation of the way along each axis [km].
        frame: axes of the way and the displacement, as in :class:`TrackGradient`.
        step_price: price of a step [% of SPL], a way of ``range_km`` is 100 %; None where vehicles have their own, at
            ``step_price`` ``(..., 1)``.

    Raises:
        ValueError: for an option out of its range, or another number of keys.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from magrl.transforms import SensorNoise
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> plan = PlannedMove(max_move_km=50.0, max_steps=50)
        >>> steps = Compose(SensorNoise((0.05, 0.05, 5.0)), TrackGradient(), plan)
        >>> TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), steps).rollout(3)["planned_move"].shape
        torch.Size([2, 3, 2])
    """

    default_in_keys = ("target_field", "heading", "step_count", *TRACK_KEYS, "way", *STD_KEYS)
    default_out_keys = ("planned_move",)
    optional_in_keys = ("step_price",)
    in_sizes = (3, 1, 1, 3, 3, 2, 3, 3, 3, 1)
    out_sizes = ((2,),)

    def __init__(
        self,
        *,
        max_move_km: float,
        max_steps: int,
        range_km: float = 300.0,
        frame: str = "world",
        step_price: float | None = STEP_PRICE,
        **keys: Any,
    ) -> None:
        super().__init__(optional=["step_price"] if step_price is None else (), **keys)
        check_number(0, above=True, max_move_km=max_move_km, range_km=range_km)
        check_number(1, whole=True, max_steps=max_steps)
        check_choice(FRAMES, frame=frame)
        check_number(0, above=True, optional=True, step_price=step_price)
        self.max_move_km, self.max_steps = float(max_move_km), int(max_steps)
        self.range_km, self.frame, self.step_price = float(range_km), frame, step_price

    def _begin(self, tensordict: TensorDictBase, values: list[Tensor], mask: Tensor | None) -> None:  # noqa: ARG002
        self._advance(tensordict, values, [])

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:  # noqa: ARG002
        seen = self._named([x.double() for x in values])
        price = seen["step_price"].squeeze(-1) if self.step_price is None else self.step_price
        turn = seen["heading"] if self.frame == "vehicle" else 0 * seen["heading"]
        aim, errors = _turned(seen["way"].unsqueeze(-2), -turn).squeeze(-2), SensorStd.read(seen)
        std, track = tracking.reading_std(errors.noise, errors.drift), FieldTrack(*(seen[key] for key in TRACK_KEYS))
        related, shared = tracking.related(track, tracking.curl_relation)
        field = tracking.estimated_field(related)
        curvature, common = tracking.field_curvature(field), tracking.common_error(field)
        units, periods = tracking.ELEMENT_SCALES, tracking.ELEMENT_PERIODS
        options = self.range_km, units, shared, errors.bias, periods, curvature, common
        posterior = tracking.way_posterior(related, seen["target_field"], *options, fine=False)
        step, limits = seen["step_count"].squeeze(-1), (self.max_move_km, self.range_km)
        price = tracking.step_price(price, self.range_km, aim, step, std, self.max_steps, self.max_move_km)
        costs: dict[str, Any] = {"bias_std": errors.bias, "curvature": curvature}
        move = tracking.planned_move(track, aim, posterior, std, price, *limits, **costs)
        tensordict.set(self.out_keys[0], _turned(move.unsqueeze(-2), turn).squeeze(-2).to(values[1].dtype))


def _turned(vectors: Tensor, heading: Tensor) -> Tensor:
    """Return vectors ``(..., K, 2)`` northward and eastward as forward and to the right of a heading ``(..., 1)``."""
    (north, east), cos, sin = vectors.unbind(-1), torch.cos(heading), torch.sin(heading)
    return torch.stack((cos * north + sin * east, cos * east - sin * north), -1)
