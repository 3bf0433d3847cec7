"""Quasi-Newton navigation: steps by a Jacobian that a filter estimates along the vehicle's own track.

Its prior is none, after two probing legs (:class:`Secant`), or a map of twelve numbers (:class:`MeanJacobian`).

The filter is a Kalman filter of elements and their gradients along a dead-reckoned track, each element by itself, and
needs no model of the field. Each element has three states, its value e at the vehicle and its gradient (g_N, g_E): a
leg by d changes the value by g·d, and a reading corrects the value and, by their covariance, the gradient. Its
functions batch over leading dimensions and take any number of elements E.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl.checks import check_number
from magrl.envs import GeomagneticNavEnv
from magrl.field.elements import NAMES, element_index
from magrl.field.model import FieldModel, elements_gradient_at
from magrl.geodesy import steer
from magrl.navigators.base import Navigator
from magrl.pilot.displacement import Displacement
from magrl.pilot.local import inverse2
from magrl.pilot.planning import SLOPES, sensor_length
from magrl.pilot.search import arrival_ellipse, arrival_weights, unvisited, unvisited_yet, visit
from magrl.sensor_std import PERFECT, SensorStd

CURVATURE = (1.5e-6, 1.8e-6, 1.2e-3)
"""Standard deviation of the change of a gradient along the path: D, I [deg], B_H [nT], per km^2, typical of the Earth's
field. The error of a linear step grows with it."""
PERIODS = (360.0, 0.0, 0.0)
"""Period of D, I [deg], B_H [nT] in readings; 0 for elements that are not wrapped."""
ROUNDING = 1e-7
"""Relative rounding of a reading in float32, its least standard deviation."""


class FieldTrack(NamedTuple):
    """Mean ``(..., E, 3)`` of value and gradient northward and eastward [per km], and covariance ``(..., E, 3, 3)``.

    Example:
        >>> track = FieldTrack(torch.zeros(5, 3, 3), torch.eye(3).expand(5, 3, 3, 3))
        >>> track.mean.shape
        torch.Size([5, 3, 3])
    """

    mean: Tensor
    covariance: Tensor


class GradientPrior(NamedTuple):
    """Expected gradient ``(..., E, 2)`` northward and eastward [element unit / km], and its standard deviations.

    Example:
        >>> GradientPrior(torch.zeros(3, 2), torch.ones(3, 2)).std.shape
        torch.Size([3, 2])
    """

    gradient: Tensor
    std: Tensor


def first_track(reading: Tensor, prior: GradientPrior, sensor_std: Tensor) -> FieldTrack:
    """Return the state after the first reading.

    Args:
        reading: ``(..., E)`` first reading.
        prior: expected gradient.
        sensor_std: ``(..., E)`` standard deviations of the noise.

    Example:
        >>> prior = GradientPrior(torch.zeros(3, 2), torch.ones(3, 2))
        >>> first_track(torch.tensor([8.0, -16.0, 35000.0]), prior, torch.ones(3)).covariance.shape
        torch.Size([3, 3, 3])
    """
    gradient = prior.gradient.expand(*reading.shape, 2).to(reading)
    variance = torch.cat((_std(reading, sensor_std).unsqueeze(-1), prior.std.expand_as(gradient).to(reading)), -1)
    return FieldTrack(torch.cat((reading.unsqueeze(-1), gradient), -1), torch.diag_embed(variance.square()))


def next_track(
    track: FieldTrack, leg: Tensor, reading: Tensor, sensor_std: Tensor, curvature: Tensor, periods: Tensor
) -> FieldTrack:
    """Return the state after a leg and the reading at its end.

    The gradient drifts with the path: with the curvature c, its variance grows by ``c^2 |d|^2``, the value's by
    ``c^2 |d|^4 / 4``, and their covariance by ``c^2 |d|^2 d / 2``.

    Args:
        track: state before the leg.
        leg: ``(..., 2)`` northward and eastward [km].
        reading: ``(..., E)``.
        sensor_std: ``(..., E)`` standard deviations of its noise.
        curvature: ``(E,)`` see :data:`CURVATURE`.
        periods: ``(E,)`` see :data:`PERIODS`.

    Example:
        >>> track = FieldTrack(torch.tensor([[0.0, 1.0, 0.0]]), torch.diag_embed(torch.ones(1, 3)))
        >>> none, leg = torch.zeros(1), torch.tensor([2.0, 0.0])
        >>> next_track(track, leg, torch.tensor([2.0]), none, none, none).mean  # as expected
        tensor([[2., 1., 0.]])
    """
    leg = leg.unsqueeze(-2).to(track.mean)
    step = torch.eye(3).to(leg).expand(*leg.shape[:-1], 3, 3).clone()
    step[..., 0, 1:] = leg
    lever = torch.cat((leg.unsqueeze(-2) / 2, torch.eye(2).to(leg).expand(*leg.shape[:-1], 2, 2)), -2)
    drift = (curvature.square() * leg.square().sum(-1))[..., None, None] * lever @ lever.mT
    mean = (step @ track.mean.unsqueeze(-1)).squeeze(-1)
    covariance = step @ track.covariance @ step.mT + drift
    cross = covariance[..., 0]
    gain = cross / (cross[..., :1] + _std(reading, sensor_std).square().unsqueeze(-1))
    mean = mean + gain * wrapped(reading - mean[..., 0], periods).unsqueeze(-1)
    return FieldTrack(mean, covariance - gain.unsqueeze(-1) * cross.unsqueeze(-2))


def estimated_displacement(
    track: FieldTrack, target: Tensor, range_km: float, bias_std: Tensor, curvature: Tensor, periods: Tensor
) -> Displacement:
    """Return the displacement to the place where the field has given values, and its covariance.

    It minimizes ``(r - g·d)^T S(d)^-1 (r - g·d) + |d|^2 / range^2``, with the remaining differences r and their
    variances S(d), in three solves; the first has the mean of S over displacements of the range.

    Args:
        track: state.
        target: ``(..., E)`` values at the destination.
        range_km: prior standard deviation of the displacement along each axis [km].
        bias_std: ``(..., E)`` standard deviations of a constant error of the readings, which gradients do not have.
        curvature: ``(E,)`` see :data:`CURVATURE`: it adds ``c^2 |d|^4 / 4`` to S(d).
        periods: ``(E,)`` see :data:`PERIODS`.

    Example:
        >>> gradient = torch.tensor([[0.0, 0.01, 0.0], [0.0, 0.0, 0.02]])  # the first element grows northward
        >>> track, none = FieldTrack(gradient, 1e-10 * torch.eye(3).expand(2, 3, 3)), torch.zeros(2)
        >>> estimated_displacement(track, torch.tensor([3.0, 4.0]), 1000.0, none, none, none).mean.round()
        tensor([300., 200.])
    """
    slopes, eye = track.mean[..., 1:], torch.eye(2).to(track.mean)
    left = wrapped(target.to(slopes) - track.mean[..., 0], periods)
    value = track.covariance[..., 0, 0] + bias_std.to(slopes).square()
    spread = track.covariance[..., 1:, 1:]
    variance = value + range_km**2 * spread.diagonal(dim1=-2, dim2=-1).sum(-1) + 2 * (curvature * range_km**2).square()
    for _ in range(3):
        weighted = slopes / variance.clamp_min(1e-16).unsqueeze(-1)
        covariance = inverse2(weighted.mT @ slopes + eye / range_km**2)
        displacement = (covariance @ weighted.mT @ left.unsqueeze(-1)).squeeze(-1)
        ahead = torch.cat((torch.ones_like(displacement[..., :1]), displacement), -1)[..., None, :, None]
        variance = (ahead.mT @ track.covariance @ ahead).squeeze((-1, -2)) + bias_std.to(slopes).square()
        variance = variance + (curvature * displacement.square().sum(-1, keepdim=True) / 2).square()
    return Displacement(displacement, covariance)


def wrapped(difference: Tensor, periods: Tensor) -> Tensor:
    """Return differences ``(..., E)`` of elements, those with a period within half of it.

    Example:
        >>> wrapped(torch.tensor([350.0, 350.0]), torch.tensor([360.0, 0.0]))
        tensor([-10., 350.])
    """
    return difference - periods * torch.round(difference / torch.where(periods > 0, periods, math.inf))


def _std(reading: Tensor, sensor_std: Tensor) -> Tensor:
    """Return the standard deviation of a reading, not below its rounding."""
    return torch.maximum(sensor_std.to(reading), reading.abs() * ROUNDING)


RANGE_KM = 1000.0
"""Prior standard deviation of the displacement to the destination along each axis [km]."""
SLOW_SHARE = 0.25
"""Share of the variance of slow errors that counts as new in each reading; chosen on random planets."""
SHORTEST_PROBE_KM = 0.5
"""Length of a probing leg with perfect sensors [km]: the rounding of float32 readings does not matter there."""


class QuasiNewton(Navigator):
    """Base class of quasi-Newton navigators: each leg goes to where the estimated Jacobian predicts no error.

    The filter (:func:`next_track`) weighs each reading by its noise and the length of the leg, and each
    element by how well it determines the displacement. Without noise, the first update is Broyden's. With ``search``,
    the vehicle aims at the most probable destination, given that the episode has not ended at the places where it has
    been (:func:`~magrl.pilot.search.unvisited`).

    A subclass returns the prior of the Jacobian in :meth:`prior`.

    Args:
        max_leg_km: longest leg [km].
        max_turn_rad: largest turn [rad].
        elements: two or three of D, I, B_H.
        sensor_std: accuracy of the sensors; three numbers are white noise of D [deg], I [deg], B_H [nT].
        zeta: arrival threshold on the objective, see :func:`~magrl.pilot.search.arrival_weights`.
        search: whether the episode ends at arrival, so that the destination is not where the vehicle has been; without
            it, the displacement is the estimated one.
        radius_km: distance from the destination at which the episode ends [km]; None where the objective ends it.

    Raises:
        ValueError: for an option out of its range, fewer than two elements, or a negative standard deviation.

    Source:
        C. G. Broyden, A class of methods for solving nonlinear simultaneous equations, Math. Comp. 19 (1965).

    Example:
        >>> class DipNavigator(QuasiNewton):
        ...     def prior(self, reading, target):  # I grows southward by about 1.5 degrees per 100 km
        ...         gradient = torch.tensor([[0.0, 0.0], [-0.015, 0.0], [0.0, 0.0]])
        ...         return GradientPrior(gradient, torch.tensor([[0.004], [0.01], [4.0]]).expand(3, 2))
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> from magrl.navigators import policy_env
        >>> dip = DipNavigator(50.0, 1.5)
        >>> policy_env(env, dip).rollout(50, dip)["next", "success"].any()
        tensor(True)
    """

    def __init__(
        self,
        max_leg_km: float,
        max_turn_rad: float,
        elements: Sequence[str] = NAMES,
        sensor_std: SensorStd | Sequence[float] = PERFECT,
        zeta: float = 0.01,
        search: bool = False,
        radius_km: float | None = None,
    ) -> None:
        super().__init__(max_leg_km, max_turn_rad)
        check_number(0, above=True, zeta=zeta)
        check_number(0, above=True, optional=True, radius_km=radius_km)
        self.zeta, self.search, self.radius_km = float(zeta), search, radius_km
        if len(set(elements)) != len(elements) or len(elements) < 2:
            raise ValueError(f"elements must be at least 2 different names of D, I, B_H, got {elements!r}")
        self.elements = [element_index(name) for name in elements]
        self._register("sensor_std", SensorStd.of(sensor_std))
        self._register("periods", [PERIODS[i] for i in self.elements])
        self._register("curvature", [CURVATURE[i] for i in self.elements])

    @staticmethod
    def env_options(env: GeomagneticNavEnv, sensor_std: SensorStd) -> dict[str, Any]:
        elements = {"elements": NAMES[1:]} if sensor_std.magnetic else {}
        radius_km = env.scenario.radius_km if env.arrival == "distance" else None
        search = {"search": not env.scenario.declared, "radius_km": radius_km}  # episodes end at arrival
        return {"sensor_std": sensor_std, "zeta": env.zeta, **search, **elements}

    def _register(self, name: str, values: Sequence[Any]) -> None:
        self.register_buffer(name, torch.tensor(values, dtype=torch.float64), persistent=False)

    def prior(self, reading: Tensor, target: Tensor) -> GradientPrior:
        """Return the expected gradient of the elements, given the first reading and the target's values ``(N, E)``.

        Raises:
            NotImplementedError: in the base class.
        """
        raise NotImplementedError(f"{type(self).__name__} must return a GradientPrior in prior(reading, target)")

    def accuracy(self, seen: TensorDictBase) -> SensorStd:
        """Return the accuracy of the present reading, see :meth:`magrl.sensor_std.SensorStd.at`."""
        return SensorStd(*self.sensor_std).at(seen)

    def reading_std(self, seen: TensorDictBase) -> Tensor:
        """Return the standard deviations of the present reading in the filter, of the chosen elements.

        Slow errors vary along the path, which the filter would take for a gradient: a share of them is noise to it.
        """
        std = self.accuracy(seen)
        return torch.hypot(std.noise, SLOW_SHARE**0.5 * std.drift)[..., self.elements]

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        field, there = (seen[key].double() for key in ("field", "target_field"))
        reading, target = field[:, self.elements], there[:, self.elements]
        track = first_track(reading, self.prior(reading, target), self.reading_std(seen))
        decisions = torch.zeros_like(seen["elapsed_steps"].squeeze(-1))
        places = {"visited": unvisited_yet(field), "weights": arrival_weights(field, there, self.zeta)}
        return {**track._asdict(), "decisions": decisions, **places}

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        return self.next_leg(self.read(seen, memory), seen, memory)

    def read(self, seen: TensorDictBase, memory: TensorDictBase) -> FieldTrack:
        """Return the state of the filter after the present reading, and keep it in the memory."""
        before = FieldTrack(memory["mean"], memory["covariance"])
        reading, moved = seen["field"].double()[:, self.elements], last_leg(seen)
        after = next_track(before, moved, reading, self.reading_std(seen), self.curvature, self.periods)
        began = (memory["decisions"] == 0)[:, None, None]  # the first reading is in the track already
        mean = torch.where(began, before.mean, after.mean)
        covariance = torch.where(began.unsqueeze(-1), before.covariance, after.covariance)
        memory.update({"mean": mean, "covariance": covariance, "decisions": memory["decisions"] + 1})
        return FieldTrack(mean, covariance)

    def next_leg(self, track: FieldTrack, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return distance [km] and turn [rad], each ``(N,)``, given the state of the filter."""
        target, bias_std = seen["target_field"].double(), self.accuracy(seen).bias.expand_as(seen["target_field"])
        target, bias_std = target[..., self.elements], bias_std[..., self.elements]
        displacement = estimated_displacement(track, target, RANGE_KM, bias_std, self.curvature, self.periods)
        aim = self.aim(track, displacement, seen, memory)
        heading, bearing = seen["heading"].squeeze(-1).double(), torch.atan2(aim[:, 1], aim[:, 0])
        return steer(heading, bearing, aim.norm(dim=-1), self.max_leg_km, self.max_turn_rad)

    def aim(
        self, track: FieldTrack, displacement: Displacement, seen: TensorDictBase, memory: TensorDictBase
    ) -> Tensor:
        """Return the displacement ``(N, 2)`` [km] to the most probable destination; store the end of the last leg."""
        visited = visit(memory["visited"].double(), last_leg(seen))
        memory["visited"] = torch.where((seen["elapsed_steps"] == 0).unsqueeze(-1), memory["visited"].double(), visited)
        if not self.search:
            return displacement.mean
        gradient, covariance = track.mean[..., 1:], track.covariance[..., 1:, 1:]
        ellipse = arrival_ellipse(gradient, covariance, memory["weights"][:, self.elements], self.radius_km)
        return unvisited(displacement, memory["visited"], ellipse)


def last_leg(seen: TensorDictBase) -> Tensor:
    """Return the last leg ``(N, 2)`` northward and eastward [km].

    Example:
        >>> from tensordict import TensorDict
        >>> last_leg(TensorDict({"leg": [[30.0, 0.0]], "heading": [[0.0]]}, 1))
        tensor([[30.,  0.]], dtype=torch.float64)
    """
    heading = seen["heading"].double()
    return seen["leg"][..., :1].double() * torch.cat((torch.cos(heading), torch.sin(heading)), -1)


def probe_length(noise: Sequence[float]) -> float:
    """Return the length of a probing leg [km]: longer legs lengthen the path, shorter ones suffer more from noise.

    The loss by both legs grows with their length p, the loss by the wrong direction with (noise / p)^2, the noise as in
    ``sensor_length``; their sum is smallest for p proportional to noise^(2/3). The factor is from
    simulations.

    Args:
        noise: standard deviations of D [deg], I [deg], B_H [nT].

    Example:
        >>> [round(probe_length(std), 1) for std in ((0, 0, 0), (0.02, 0.02, 2), (0.05, 0.05, 5), (0.1, 0.1, 10))]
        [0.5, 6.1, 11.2, 17.7]
    """
    length = float(sensor_length(torch.tensor(noise, dtype=torch.float64)))
    return max(SHORTEST_PROBE_KM, 5.0 * length ** (2 / 3))


class Secant(QuasiNewton):
    """Quasi-Newton navigation with a Jacobian estimated along the vehicle's own track: no map, no training, no oracle.

    Two short legs across each other give a first Jacobian of the elements by north and east. From then on each leg is
    a quasi-Newton step to the destination's elements, and each reading corrects the Jacobian.

    Args:
        max_leg_km: longest leg [km].
        max_turn_rad: largest turn [rad].
        probe_km: length of the two legs [km]; for None :func:`probe_length`, at most the longest leg.
        elements: all three by default, each weighted by how well it determines the displacement; or two of them.
        sensor_std: accuracy of the sensors; three numbers are white noise of D [deg], I [deg], B_H [nT].
        **options: ``zeta`` and ``search`` of :class:`QuasiNewton`.

    Raises:
        ValueError: for a bound or a leg out of its range, fewer than two elements, or a negative standard deviation.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> from magrl.navigators import policy_env
        >>> policy_env(env, Secant()).rollout(2, Secant())["action"][0].round(decimals=2)
        tensor([[0.5000, 0.0000],
                [0.5000, 1.5700]])
    """

    def __init__(
        self,
        max_leg_km: float = 50.0,
        max_turn_rad: float = math.pi / 2,
        probe_km: float | None = None,
        elements: Sequence[str] = NAMES,
        sensor_std: SensorStd | Sequence[float] = PERFECT,
        **options: Any,
    ) -> None:
        super().__init__(max_leg_km, max_turn_rad, elements, sensor_std, **options)
        noise = SensorStd.of(sensor_std).noise
        probe_km = min(probe_length(noise), self.max_leg_km) if probe_km is None else probe_km
        check_number(0, max_leg_km, above=True, probe_km=probe_km)
        self.probe_km, self.probe_turn = float(probe_km), min(math.pi / 2, self.max_turn_rad)

    def prior(self, reading: Tensor, target: Tensor) -> GradientPrior:  # noqa: ARG002
        std = reading.new_tensor([SLOPES[i] for i in self.elements]).unsqueeze(-1).expand(-1, 2)
        return GradientPrior(torch.zeros_like(std), std)

    def next_leg(self, track: FieldTrack, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        distance, turn = super().next_leg(track, seen, memory)
        decisions = memory["decisions"]
        probing, probe_turn = decisions <= 2, torch.where(decisions == 2, self.probe_turn, 0.0)
        return torch.where(probing, self.probe_km, distance), torch.where(probing, probe_turn, turn)

    name = "secant"
    description = "secant (quasi-Newton)"


class MeanJacobian(QuasiNewton):
    """Quasi-Newton navigation from the mean Jacobian of a region, without probing legs.

    The map is twelve numbers: mean and standard deviation over the region of the gradients of D, I, B_H northward and
    eastward. An agent that is trained in one region can learn as much.

    Args:
        field: field model, usually ``env.field``.
        position: ``(..., 2)`` places to average over, latitude, longitude [deg], usually ``env.region.grid(21)``.
        max_leg_km: longest leg [km].
        max_turn_rad: largest turn [rad].
        **options: ``sensor_std``, ``zeta`` and ``search`` of :class:`QuasiNewton`.

    Raises:
        ValueError: for a bound out of its range, or a negative standard deviation.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> from magrl.navigators import policy_env
        >>> navigator = MeanJacobian(env.field, env.region.grid(21))
        >>> policy_env(env, navigator).rollout(50, navigator)["next", "success"].any()
        tensor(True)
    """

    needs = "a map of the region"

    def __init__(
        self,
        field: FieldModel,
        position: Tensor,
        max_leg_km: float = 50.0,
        max_turn_rad: float = math.pi / 2,
        **options: Any,
    ) -> None:
        super().__init__(max_leg_km, max_turn_rad, **options)
        gradients = elements_gradient_at(field, position.reshape(-1, 2).double())
        self.register_buffer("mean", gradients.mean(0))
        self.register_buffer("std", gradients.std(0))

    def prior(self, reading: Tensor, target: Tensor) -> GradientPrior:  # noqa: ARG002
        return GradientPrior(self.mean, self.std)

    name, label = "mean_jacobian", "mean Jacobian"
    description = "mean Jacobian (quasi-Newton)"

    @staticmethod
    def env_options(env: GeomagneticNavEnv, sensor_std: SensorStd) -> dict[str, Any]:
        if len(env.region) > 1:
            raise ValueError(f"mean_jacobian needs a map of one region, and the scenario has {len(env.region)}")
        options = {"field": env.field, "position": env.region.grid(21).to(env.device)}
        return options | QuasiNewton.env_options(env, sensor_std)
