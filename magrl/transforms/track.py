"""Transforms that navigate by the vehicle's own readings: its belief of the field, search and the planned move."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite

from magrl import tracking
from magrl.checks import check_number, check_type
from magrl.sensor_std import STD_KEYS, SensorStd
from magrl.tracking import RANGE_KM, STEP_PRICE, Belief, DestinationPosterior, NoiseEstimate, Way
from magrl.tracking.belief import STATES
from magrl.transforms.base import GivenKeys, Keys, StatefulTransform
from magrl.transforms.errors.known_start import START_KEYS

IN_KEYS = ("field", "target_field", "move", "heading")
BELIEF_KEYS = ("belief_mean", "belief_covariance", "belief_latitude")
POSTERIOR_KEYS = ("destination_points", "destination_weights")
ESTIMATES = ("estimated_field", "estimated_gradient", "way", "way_covariance")
NOISE_KEYS = ("sensor_std", "noise_log_ratio", "noise_readings")
TRACK_KEYS = (*BELIEF_KEYS, *ESTIMATES, *POSTERIOR_KEYS)
PRICE_KM = 300.0
"""Way that counts as 100 % in the price of a step [km]."""
POINTS = 256
"""Number of points of the posterior."""


class TrackField(StatefulTransform):
    """Estimate the field around the vehicle and the way to the destination from the readings along the track.

    The belief of :mod:`magrl.tracking.belief`: it starts at a reset from the first reading; each step moves it by the
    last move and corrects it by the reading at its end. It is in the TensorDict (float64), with the posterior of the
    destination, so that what follows computes neither again. Nothing that it writes is privileged unless an input is.

    Where the start is known (:class:`~magrl.transforms.KnownStart` has written its keys), the belief begins with the
    elements there, and the first reading shows the errors of the sensors.

    Args:
        in_keys: reading ``(..., 3)``, elements at the target ``(..., 3)``, the last move ``(..., K)`` (its first number
            is the distance [km]), and the heading after the move ``(..., 1)`` [rad].
        out_keys: the belief: mean ``(..., 25)``, covariance ``(..., 25, 25)`` and reference latitude ``(..., 1)``
            [deg]; the estimated field ``(..., 3)``, its gradient ``(..., 3, 2)`` northward and eastward [element unit /
            km], the mean way to the destination ``(..., 2)`` [km] and its covariance ``(..., 2, 2)`` [km^2]; and the
            posterior of the way: points ``(..., M, 2)`` [km] and their probabilities ``(..., M)``. With
            ``estimate_noise`` also the standard deviation of the noise ``(..., 3)``, by default in place of the stated
            one, and its state: logarithms of the ratios of the variances and effective numbers of readings
            ``(..., 3)``.
        std_keys: where readings come with standard deviations ``(..., 3)``, their keys
            (:data:`magrl.sensor_std.STD_KEYS`), or that of the noise alone.
        sensor_std: accuracy of the sensors without ``std_keys``, a :class:`~magrl.sensor_std.SensorStd` or 3 numbers
            for white noise; perfect by default.
        estimate_noise: whether the stated noise is scaled by what the readings show
            (:func:`magrl.tracking.noise_estimate`). If it is too low, estimates are overconfident; if it is too high,
            readings are wasted. With ``std_keys``.
        range_km: prior standard deviation of the way along each axis [km].
        crust_nt: standard deviation of the field of the crust in each axis [nT], which the model does not know.

    Raises:
        ValueError: for an option out of its range, another number of keys, or shapes that do not match.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from torchrl.envs import TransformedEnv
        >>> env = TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), TrackField())
        >>> env.rollout(5)["next", "way"].shape
        torch.Size([2, 5, 2])
    """

    default_in_keys = IN_KEYS
    default_out_keys = (*TRACK_KEYS, *NOISE_KEYS)
    optional_in_keys = STD_KEYS
    in_counts = (4, 5, 8)
    out_counts = (len(TRACK_KEYS), len(TRACK_KEYS) + len(NOISE_KEYS))
    in_sizes = (3, 3, None, 1, 3, 3, 3, 3)
    out_sizes = (STATES,), (STATES, STATES), (1,), (3,), (3, 2), (2,), (2, 2), (POINTS, 2), (POINTS,), (3,), (3,), (3,)
    sensor_std: Tensor

    def __init__(
        self,
        in_keys: GivenKeys = None,
        out_keys: GivenKeys = None,
        *,
        std_keys: Keys = (),
        sensor_std: SensorStd | Sequence[float] | None = None,
        estimate_noise: bool = False,
        range_km: float = RANGE_KM,
        crust_nt: float = 0.0,
    ) -> None:
        super().__init__(in_keys, out_keys, std_keys)
        check_type(bool, estimate_noise=estimate_noise)
        if not estimate_noise:
            self.out_keys: list[NestedKey] = self.out_keys[: len(TRACK_KEYS)]
        if sensor_std is not None and std_keys:
            raise ValueError(f"give sensor_std or std_keys, not both: got {sensor_std} and {std_keys}")
        if estimate_noise and not std_keys:
            raise ValueError("estimate_noise scales the standard deviations that come with readings: give std_keys")
        check_number(0, above=True, range_km=range_km)
        check_number(0, crust_nt=crust_nt)
        self.estimate_noise, self.range_km, self.crust_nt = estimate_noise, float(range_km), float(crust_nt)
        stated = torch.tensor(SensorStd.of((0.0, 0.0, 0.0) if sensor_std is None else sensor_std), dtype=torch.float64)
        self.register_buffer("sensor_std", stated, persistent=False)

    @property
    def state_keys(self) -> list[NestedKey]:
        """The belief, and the state of the noise."""
        return [*self.out_keys[:3], *self.out_keys[10:]]

    def _begin(self, tensordict: TensorDictBase, values: list[Tensor], mask: Tensor | None) -> None:  # noqa: ARG002
        std = self._std(values)
        noise = NoiseEstimate(torch.zeros_like(std.noise), torch.zeros_like(std.noise))
        reading, _, _, heading, *_ = values
        start = [tensordict.get(key, None) for key in START_KEYS]
        if start[0] is None:
            belief = tracking.start(reading, std, heading.squeeze(-1), self.crust_nt)
        else:
            error, known, known_std, bias = start
            belief = tracking.known(tracking.before(known, std._replace(bias=bias)), known, known_std, self.crust_nt)
            belief = tracking.read(belief, reading + error, std.noise, heading.squeeze(-1), self.crust_nt)
        self._write(tensordict, values, belief, noise)

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:
        (reading, _, move, heading, *_), std = values, self._std(values)
        mean, covariance, latitude, *noise = state
        belief = Belief(mean, covariance, latitude.squeeze(-1))
        course, reading = heading.squeeze(-1), reading + tensordict.get(START_KEYS[0], 0.0)  # as it was read
        belief = tracking.moved(belief, move[..., 0], course, std)
        before = NoiseEstimate(*noise) if self.estimate_noise else NoiseEstimate(0 * std.noise, 0 * std.noise)
        new = tracking.innovation(belief, reading, std.noise * (before.log_ratio / 2).exp(), course, self.crust_nt)
        after = before
        if self.estimate_noise:
            after = tracking.noise_estimate(before, new, std.noise)
            new = tracking.innovation(belief, reading, std.noise * after.factor, course, self.crust_nt)
        self._write(tensordict, values, tracking.updated(belief, new), after)

    def _write(self, tensordict: TensorDictBase, values: list[Tensor], belief: Belief, noise: NoiseEstimate) -> None:
        reading, target, *_ = values
        written = [*tracked(belief, target, self.range_km, self.crust_nt)]
        if self.estimate_noise:
            written += [(self._std(values).noise * noise.factor).to(reading.dtype), *noise]
        for key, entry in zip(self.out_keys, written, strict=True):
            tensordict.set(key, entry)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add what is written; the state is in float64."""
        observation_spec = super().transform_observation_spec(observation_spec)
        for key, size in zip(self.out_keys, self.out_sizes, strict=False):
            if key in self.state_keys:
                self._add(observation_spec, observation_spec[self.in_keys[0]], key, *size, dtype=torch.float64)
        return observation_spec

    def _std(self, values: list[Tensor]) -> SensorStd:
        """Return the accuracy of a reading, of the TensorDict or as stated."""
        given = [x.double() for x in values[4:]] or [x.expand(values[0].shape) for x in self.sensor_std]
        return SensorStd(*given, *(torch.zeros_like(given[0]) for _ in STD_KEYS[len(given) :]))


def tracked(belief: Belief, target: Tensor, range_km: float, crust_nt: float = 0.0) -> list[Tensor]:
    """Return what :class:`TrackField` writes of a belief, in the order of its keys.

    Args:
        belief: what is known of the field.
        target: ``(..., 3)`` D [deg], I [deg], B_H [nT] at the destination.
        range_km: prior standard deviation of the way along each axis [km].
        crust_nt: standard deviation of the field of the crust in each axis [nT].

    Example:
        >>> belief = tracking.start(torch.tensor([3.0, 65.0, 18000.0]), SensorStd())
        >>> [value.shape[-1] for value in tracked(belief, torch.tensor([3.0, 66.0, 17500.0]), 300.0)]
        [25, 25, 1, 3, 2, 2, 2, 2, 256]
    """
    local = tracking.elements(belief)
    posterior = tracking.posterior(tracking.destination(belief, target, range_km, crust_nt), POINTS)
    estimates = local.value, local.gradient, *posterior.way(), *posterior
    return [*belief[:2], belief.latitude.unsqueeze(-1), *(x.to(target.dtype) for x in estimates)]


class SearchAim(StatefulTransform):
    """Write the way to the most probable destination that the vehicle has not visited.

    The destination is not at a visited place, because the episode did not end there: see
    :func:`magrl.tracking.unvisited`. This matters where the readings have a constant error: the estimate alone leads to
    a place beside the destination and stays there. For environments that end the episode at arrival; a vehicle that
    declares its arrival gets no such signal.

    It stands after :class:`TrackField`. Its state is in the TensorDict.

    Args:
        in_keys: reading and target ``(..., 3)``, last move ``(..., K)`` (distance [km] first), heading ``(..., 1)``
            [rad], the belief of :class:`TrackField`, the mean way ``(..., 2)`` [km] and its covariance ``(..., 2, 2)``
            [km^2].
        out_keys: the way to aim at ``(..., 2)`` [km], and the state: displacements to the last visited
            places ``(..., 24, 2)`` northward and eastward [km], and weights of the objective ``(..., 3)``.
        zeta: arrival threshold on the objective.
        radius_km: distance from the destination at which the episode ends [km]; None where the objective ends it.

    Raises:
        ValueError: for a threshold or radius that is not above 0, or another number of keys.
        KeyError: for a step from a TensorDict without the state.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> steps = Compose(TrackField(), SearchAim(zeta=0.01))
        >>> TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), steps).rollout(3)["visited"].shape
        torch.Size([2, 3, 24, 2])
    """

    default_in_keys = (*IN_KEYS, *BELIEF_KEYS, "way", "way_covariance")
    default_out_keys = ("aim", "visited", "arrival_weights")
    out_sizes = (2,), (tracking.VISITED, 2), (3,)

    def __init__(self, *, zeta: float, radius_km: float | None = None, **keys: Any) -> None:
        super().__init__(**keys)
        check_number(0, above=True, zeta=zeta)
        check_number(0, above=True, optional=True, radius_km=radius_km)
        self.zeta, self.radius_km = float(zeta), radius_km

    def _begin(self, tensordict: TensorDictBase, values: list[Tensor], mask: Tensor | None) -> None:  # noqa: ARG002
        reading, target, *_ = values
        weights = tracking.arrival_weights(reading, target, self.zeta)
        self._write(tensordict, values, tracking.unvisited_yet(reading), weights)

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:
        (visited, weights), (_, _, move, heading, *_) = state, values
        self._write(tensordict, values, tracking.visit(visited, displacement_of(move, heading)), weights)

    def _write(self, tensordict: TensorDictBase, values: list[Tensor], visited: Tensor, weights: Tensor) -> None:
        seen = self._named([x.double() for x in values])
        way = Way(seen["way"], seen["way_covariance"])
        local = tracking.elements(belief_of(seen))
        spread = local.covariance[..., 1:, 1:]
        ellipse = tracking.arrival_ellipse(local.gradient, spread, weights.double(), self.radius_km)
        aim = tracking.unvisited(way, visited.double(), ellipse)
        for key, value in zip(self.out_keys, (aim.to(visited.dtype), visited, weights), strict=True):
            tensordict.set(key, value)


class PlannedMove(StatefulTransform):
    """Write the move that dual control plans (:func:`magrl.tracking.planned_move`), for policies that correct it.

    It stands after :class:`TrackField`.

    Args:
        in_keys: elements at the target ``(..., 3)``, number of the step ``(..., 1)``, belief and posterior of
            :class:`TrackField`, way to aim at ``(..., 2)`` [km], and the standard deviations ``(..., 3)`` of
            :data:`magrl.sensor_std.STD_KEYS`.
        out_keys: displacement ``(..., 2)`` northward and eastward [km].
        max_move_km: longest move [km].
        max_steps: step limit.
        range_km: prior standard deviation of the way along each axis [km].
        crust_nt: as of :class:`TrackField`.
        step_price: price of a step [% of SPL], a way of ``price_km`` is 100 %; None where vehicles have their own, at
            ``step_price`` ``(..., 1)``.
        caution: weight of the uncertainty of the way.

    Raises:
        ValueError: for an option out of its range, or another number of keys.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from magrl.transforms import SensorNoise
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> plan = PlannedMove(max_move_km=50.0, max_steps=50)
        >>> steps = Compose(SensorNoise((0.05, 0.05, 5.0)), TrackField(), plan)
        >>> TransformedEnv(GeomagneticNavEnv(num_envs=2, seed=0), steps).rollout(3)["planned_move"].shape
        torch.Size([2, 3, 2])
    """

    default_in_keys = ("target_field", "elapsed_steps", *BELIEF_KEYS, *POSTERIOR_KEYS, "way", *STD_KEYS)
    default_out_keys = ("planned_move",)
    optional_in_keys = ("step_price",)
    in_sizes = (3, 1, STATES, STATES, 1, 2, None, 2, 3, 3, 3, 3, 1)
    out_sizes = ((2,),)

    def __init__(
        self,
        *,
        max_move_km: float,
        max_steps: int,
        range_km: float = RANGE_KM,
        crust_nt: float = 0.0,
        step_price: float | None = STEP_PRICE,
        caution: float = tracking.CAUTION,
        **keys: Any,
    ) -> None:
        super().__init__(optional=["step_price"] if step_price is None else (), **keys)
        check_number(0, above=True, max_move_km=max_move_km, range_km=range_km)
        check_number(0, caution=caution, crust_nt=crust_nt)
        check_number(1, whole=True, max_steps=max_steps)
        check_number(0, above=True, optional=True, step_price=step_price)
        self.max_move_km, self.max_steps, self.caution = float(max_move_km), int(max_steps), float(caution)
        self.range_km, self.crust_nt, self.step_price = float(range_km), float(crust_nt), step_price

    def _begin(self, tensordict: TensorDictBase, values: list[Tensor], mask: Tensor | None) -> None:  # noqa: ARG002
        self._advance(tensordict, values, [])

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:  # noqa: ARG002
        seen = self._named(values)
        price = seen["step_price"].squeeze(-1).double() if self.step_price is None else self.step_price
        errors, aim = SensorStd.read(seen), seen["way"].double()
        goal = tracking.destination(belief_of(seen), seen["target_field"], self.range_km, self.crust_nt)
        posterior = DestinationPosterior(*(seen[key] for key in POSTERIOR_KEYS))
        std, step = errors.noise, seen["elapsed_steps"].squeeze(-1)
        price = tracking.step_price(price, PRICE_KM, aim, step, std, self.max_steps, self.max_move_km)
        move = tracking.planned_move(goal, posterior, aim, errors, price, self.max_move_km, self.caution)
        tensordict.set(self.out_keys[0], move.to(seen["target_field"].dtype))


def belief_of(seen: Mapping[Any, Tensor]) -> Belief:
    """Return the belief that :class:`TrackField` wrote."""
    mean, covariance, latitude = (seen[key].double() for key in BELIEF_KEYS)
    return Belief(mean, covariance, latitude.squeeze(-1))


def displacement_of(move: Tensor, heading: Tensor) -> Tensor:
    """Return the displacement ``(..., 2)`` [km] of a move ``(..., K)``, distance [km] first, at a heading ``(..., 1)``.

    Example:
        >>> displacement_of(torch.tensor([30.0, 0.5]), torch.tensor([0.0]))
        tensor([30.,  0.])
    """
    return move[..., :1] * torch.cat((torch.cos(heading), torch.sin(heading)), -1)


def turned(vectors: Tensor, heading: Tensor) -> Tensor:
    """Return vectors ``(..., K, 2)`` northward and eastward as forward and to the right of a heading ``(..., 1)``.

    Example:
        >>> turned(torch.tensor([[0.0, 1.0]]), torch.tensor([0.0]))
        tensor([[0., 1.]])
    """
    (north, east), cos, sin = vectors.unbind(-1), torch.cos(heading), torch.sin(heading)
    return torch.stack((cos * north + sin * east, cos * east - sin * north), -1)
