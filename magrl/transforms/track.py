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
from magrl.tracking import STEP_PRICE, FieldTrack, GradientPrior, GradientRelation, LearnedPrior, Way
from magrl.transforms.base import (
    GivenKeys,
    StatefulTransform,
    several_keys,
)

STD_KEYS = ("sensor_std", "bias_std", "drift_std")
"""Standard deviations of a reading's new errors, of constant and slow ones, and of slow ones alone: D [deg], I [deg],
B_H [nT]."""
FRAMES = ("world", "vehicle")
IN_KEYS = ("field", "target_field", "move", "heading")
OUT_KEYS = ("track_mean", "track_covariance", "estimated_field", "estimated_gradient", "way", "way_covariance")


class TrackGradient(StatefulTransform):
    """Estimate the field, its gradient and the way to the target from the readings along the track.

    The filter of :mod:`magrl.tracking`: it starts at a reset from the first reading and a prior of the gradient; each
    step moves it by the last move and corrects it by the reading at its end. Its state is in the TensorDict
    (float64). Nothing that it writes is privileged unless an input is.

    Args:
        in_keys: readings ``(..., E)``, values at the target ``(..., E)``, the last move ``(..., K)`` (its first number
            is the distance [km]), the heading after the move ``(..., 1)`` [rad], and optionally standard deviations
            ``(..., E)``: that of the readings' noise, alone or with those of constant and slow errors, which widen the
            covariance of the way, and of slow errors alone, of which a part counts as noise.
        out_keys: the state, in the scaled units of :class:`~magrl.tracking.FieldTrack`: mean ``(..., E, 3)`` and
            covariance ``(..., E, 3, 3)``, always northward and eastward; then the estimates: the field ``(..., E)``,
            its gradient ``(..., E, 2)`` [element unit / km], the way to aim at ``(..., 2)`` [km] and the covariance of
            that to the target ``(..., 2, 2)`` [km^2] (:meth:`magrl.tracking.WayPosterior.aim`).
        sensor_std: standard deviation of the readings' noise, E numbers, where it is not among the ``in_keys``; by
            default 0. The filter has a floor, :data:`~magrl.tracking.VARIANCE_FLOOR`.
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
        sensor_std: Sequence[float] | None = None,
        prior: Callable[[Tensor, Tensor], GradientPrior] | None = None,
        relation: Callable[[Tensor], GradientRelation] | None = tracking.curl_relation,
        common: Callable[[Tensor], Tensor] | None = tracking.common_error,
        scales: Sequence[float] = tracking.ELEMENT_SCALES,
        curvature: Sequence[float] | Callable[[Tensor], Tensor] = tracking.field_curvature,
        angles: Sequence[int] = (0,),
        range_km: float = 300.0,
        frame: str = "world",
    ) -> None:
        super().__init__(in_keys, out_keys)
        if sensor_std is not None and len(self.in_keys) > 4:
            raise ValueError(f"give sensor_std or its key {self.in_keys[4]!r}, not both: got sensor_std {sensor_std}")
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
        self._register(count, scales=scales, sensor_std=(0.0,) * count if sensor_std is None else sensor_std)
        self._register(count, periods=[360.0 * (index in angles) for index in range(count)])
        if not callable(curvature):
            self._register(count, constant_curvature=curvature)

    def _register(self, count: int, **numbers: Sequence[float]) -> None:
        """Check and keep the numbers of each element; float64, as a 0.3 of float32 is another in float64."""
        for name, values in numbers.items():
            check_numbers(count, **{name: values})
            smallest: dict[str, Any] = {name: min(values, default=0.0)}
            check_number(0, above=name == "scales", **smallest)
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
        """Return the standard deviations of a reading and of constant errors, of the TensorDict or as given."""
        std = values[4:]
        if len(std) > 1:
            return tracking.reading_std(std[0], std[2]), std[1]
        return std[0] if std else self.sensor_std, None

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
        known, shared = (track, None) if self.relation is None else tracking.related(track, self.relation, self.scales)
        field, gradient = (f(known, self.scales) for f in (tracking.estimated_field, tracking.estimated_gradient))
        field = field - self.periods.to(field.dtype) * torch.round(field / 360)
        options = self.range_km, self.scales, shared, bias_std, self.periods, self._curvature(field)
        common = None if self.common is None or bias_std is None else self.common(field)
        posterior = tracking.way_posterior(known, target, *options, common, fine=False)
        aim = posterior.aim(tracking.way_to(known, target, *options))
        way, covariance = (part.to(target.dtype) for part in aim)
        if self.frame == "vehicle":
            gradient, covariance = _turned(gradient, heading), _turned(_turned(covariance, heading).mT, heading)
            way = _turned(way.unsqueeze(-2), heading).squeeze(-2)
        return field, gradient, way, covariance


class NoiseScale(StatefulTransform):
    """Scale the standard deviations of the noise of D, I, B_H on the data sheet by what the readings show.

    Where the data sheet is too small, estimates are too sure, and arrivals are declared too soon; where it is too
    large, readings are wasted. See :func:`magrl.tracking.noise_estimate`. It stands before :class:`TrackGradient`, so
    that this and all that follow read the scaled value; a navigator takes the larger of this and its own data sheet.
    An element without noise keeps 0. Its state is in the TensorDict.

    Args:
        in_keys: reading ``(..., 3)``, the last move ``(..., K)`` (distance [km] first), heading ``(..., 1)`` [rad], and
            the standard deviations ``(..., 3)`` of the noise on the data sheet and of slow errors.
        out_keys: the standard deviation of the noise ``(..., 3)``, by default in place of that of the data sheet; and
            the state: logarithms of the ratios of the variances ``(..., 3)``, and the effective numbers of readings
            ``(..., 3)``.
        track_keys: mean and covariance of the filter of :class:`TrackGradient`, which are read before a step.

    Raises:
        ValueError: for another number of keys, shapes that do not match, or a place behind :class:`TrackGradient`.
        KeyError: for a step from a TensorDict without the state or the track.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from magrl.transforms import SensorNoise
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> steps = Compose(SensorNoise((0.05, 0.05, 5.0)), NoiseScale(), TrackGradient((*IN_KEYS, *STD_KEYS)))
        >>> TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), steps).rollout(3)["noise_log_ratio"].shape
        torch.Size([2, 3, 3])
    """

    default_in_keys = (IN_KEYS[0], *IN_KEYS[2:], STD_KEYS[0], STD_KEYS[2])
    default_out_keys = (STD_KEYS[0], "noise_log_ratio", "noise_readings")
    in_sizes = (3, None, 1, 3, 3)
    out_sizes = ((3,),) * 3

    def __init__(
        self, in_keys: GivenKeys = None, out_keys: GivenKeys = None, track_keys: Sequence[NestedKey] = OUT_KEYS[:2]
    ) -> None:
        super().__init__(in_keys, out_keys)
        self.track_keys = several_keys(track_keys)
        if len(self.track_keys) != 2:
            raise ValueError(f"track_keys must be those of the mean and the covariance, got {track_keys!r}")

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Raise if the track is written before, by which the filter would not read the scaled value."""
        if known := [key for key in self.track_keys if key in observation_spec.keys(True, True)]:
            raise ValueError(f"NoiseScale stands before the transform that writes {known}: change their order")
        return super().transform_observation_spec(observation_spec)

    def _begin(self, tensordict: TensorDictBase, values: list[Tensor], mask: Tensor | None) -> None:  # noqa: ARG002
        none = torch.zeros_like(values[3])
        self._write(tensordict, values[3], tracking.NoiseEstimate(none, none))

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:
        reading, move, heading, *std = (x.double() for x in values)
        *before, mean, covariance = (x.double() for x in state)
        track, displacement = FieldTrack(mean, covariance), tracking.displacement_of(move, heading)
        estimate = tracking.noise_estimate(tracking.NoiseEstimate(*before), track, displacement, reading, *std)
        self._write(tensordict, values[3], estimate)

    def _write(self, tensordict: TensorDictBase, std: Tensor, estimate: tracking.NoiseEstimate) -> None:
        for key, value in zip(self.out_keys, (std * estimate.factor, *estimate), strict=True):
            tensordict.set(key, value.to(std.dtype))

    def _state(self, tensordict: TensorDictBase) -> list[Tensor] | None:
        state, track = super()._state(tensordict), self._read(tensordict, self.track_keys, state=True)
        return None if state is None or track is None else [*state, *track]


class SearchAim(StatefulTransform):
    """Write the way to the most probable destination that the vehicle has not visited.

    The episode has not ended where the vehicle was, so the destination is not there: see
    :func:`magrl.tracking.unvisited`. This matters where the readings have a constant error, since the estimate alone
    then leads to a place beside the destination, and stays there. For environments that end the episode at arrival; a
    vehicle that must declare its arrival does not know that it has not arrived.

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

    default_in_keys = (*IN_KEYS, "track_mean", "track_covariance", "way", "way_covariance")
    default_out_keys = ("aim", "visited", "arrival_weights")
    out_sizes = (2,), (tracking.VISITED, 2), (3,)

    def __init__(
        self, in_keys: GivenKeys = None, out_keys: GivenKeys = None, *, zeta: float, frame: str = "world"
    ) -> None:
        super().__init__(in_keys, out_keys)
        check_number(0, above=True, zeta=zeta)
        check_choice(FRAMES, frame=frame)
        self.zeta, self.frame = float(zeta), frame

    def _begin(self, tensordict: TensorDictBase, values: list[Tensor], mask: Tensor | None) -> None:  # noqa: ARG002
        weights = tracking.arrival_weights(values[0], values[1], self.zeta)
        self._write(tensordict, values, tracking.unvisited_yet(values[0]), weights)

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:
        (visited, weights), displacement = state, tracking.displacement_of(values[2], values[3])
        self._write(tensordict, values, tracking.visit(visited, displacement), weights)

    def _write(self, tensordict: TensorDictBase, values: list[Tensor], visited: Tensor, weights: Tensor) -> None:
        heading, mean, covariance, *way = (x.double() for x in values[3:])
        north_east = torch.eye(2, dtype=heading.dtype, device=heading.device)
        axes = _turned(north_east, heading).mT if self.frame == "vehicle" else None
        aim = tracking.aim(FieldTrack(mean, covariance), Way(*way), visited.double(), weights.double(), axes=axes)
        for key, value in zip(self.out_keys, (aim.to(visited.dtype), visited, weights), strict=True):
            tensordict.set(key, value)


class PlannedMove(StatefulTransform):
    """Write the move that dual control plans (:func:`magrl.tracking.planned_move`), for policies that correct it.

    It stands after :class:`TrackGradient`. It plans in float64, as :class:`~magrl.navigators.Kalman` does.

    Args:
        in_keys: values at the target ``(..., 3)``, heading ``(..., 1)`` [rad], number of the step ``(..., 1)``, mean
            ``(..., 3, 3)`` and covariance ``(..., 3, 3, 3)`` of the filter, way to aim at ``(..., 2)`` [km], and the
            standard deviations ``(..., 3)`` of new errors of a reading, of constant and slow ones, and of slow ones
            alone.
        out_keys: displacement ``(..., 2)`` [km].
        max_move_km: longest move [km].
        max_steps: step limit.
        range_km: prior standard deviation of the way along each axis [km].
        frame: axes of the way and the displacement, as in :class:`TrackGradient`.
        step_price: price of a step where it is not among the ``in_keys`` [% of SPL]; a way of ``range_km`` is 100 %.

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

    default_in_keys = ("target_field", "heading", "step_count", "track_mean", "track_covariance", "way", *STD_KEYS)
    default_out_keys = ("planned_move",)
    in_counts = (9, 10)
    in_sizes = (3, 1, 1, 3, 3, 2, 3, 3, 3, 1)
    out_sizes = ((2,),)

    def __init__(
        self,
        in_keys: GivenKeys = None,
        out_keys: GivenKeys = None,
        *,
        max_move_km: float,
        max_steps: int,
        range_km: float = 300.0,
        frame: str = "world",
        step_price: float = STEP_PRICE,
    ) -> None:
        super().__init__(in_keys, out_keys)
        check_number(0, above=True, max_move_km=max_move_km, range_km=range_km)
        check_number(1, whole=True, max_steps=max_steps)
        check_choice(FRAMES, frame=frame)
        check_number(0, above=True, step_price=step_price)
        self.max_move_km, self.max_steps = float(max_move_km), int(max_steps)
        self.range_km, self.frame, self.step_price = float(range_km), frame, float(step_price)

    def _begin(self, tensordict: TensorDictBase, values: list[Tensor], mask: Tensor | None) -> None:  # noqa: ARG002
        self._advance(tensordict, values, [])

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:  # noqa: ARG002
        target, heading, step, mean, covariance, aim, sensor_std, bias_std, drift_std = (x.double() for x in values[:9])
        given = values[9].double().squeeze(-1) if values[9:] else self.step_price
        turn = heading if self.frame == "vehicle" else 0 * heading
        aim, std = _turned(aim.unsqueeze(-2), -turn).squeeze(-2), tracking.reading_std(sensor_std, drift_std)
        track = FieldTrack(mean, covariance)
        known, shared = tracking.related(track, tracking.curl_relation)
        field = tracking.estimated_field(known)
        curvature, common = tracking.field_curvature(field), tracking.common_error(field)
        options = self.range_km, tracking.ELEMENT_SCALES, shared, bias_std, tracking.ELEMENT_PERIODS, curvature, common
        posterior = tracking.way_posterior(known, target, *options, fine=False)
        step, limits = step.squeeze(-1), (self.max_move_km, self.range_km)
        price = tracking.step_price(given, self.range_km, aim, step, std, self.max_steps, self.max_move_km)
        move = tracking.planned_move(track, aim, posterior, std, price, *limits, bias_std=bias_std, curvature=curvature)
        tensordict.set(self.out_keys[0], _turned(move.unsqueeze(-2), turn).squeeze(-2).to(values[1].dtype))


def _turned(vectors: Tensor, heading: Tensor) -> Tensor:
    """Return vectors ``(..., K, 2)`` northward and eastward as forward and to the right of a heading ``(..., 1)``."""
    (north, east), cos, sin = vectors.unbind(-1), torch.cos(heading), torch.sin(heading)
    return torch.stack((cos * north + sin * east, cos * east - sin * north), -1)
