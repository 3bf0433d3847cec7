"""Errors of motion: log, compass in motion, and currents. The vehicle goes elsewhere than it believes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from magrl.checks import check_number
from magrl.errors.base import LEG_ERROR, EpisodeErrors
from magrl.geodesy import MEAN_RADIUS_KM, curvature_radii, displaced, local_frame, polar, wrap_angle
from magrl.random_numbers import NORMAL_LIMIT, normal_of, stream_normal, stream_uniform
from magrl.transforms.base import observed_spec
from magrl.transforms.episode import Episode

EDDIES = 8
"""Number of waves of which a field of eddies is the sum."""


class MotionError(EpisodeErrors):
    """Move the vehicle elsewhere than it believes: errors of its log and of its compass in motion, and currents.

    A policy chooses a distance and a turn, and believes that it moves so: ``leg`` and ``heading`` are what was
    commanded. On the ground the vehicle goes the distance times ``1 + scale + noise``, along its heading plus the
    errors of the compass in motion, plus the current times the distance over the speed. The difference from the command
    is written as ``leg_error``, which the environment adds. The heading itself is right, so a declination measured
    from it is, too; see :class:`~magrl.errors.NorthReferenceError` for the contrary.

    Sizes are standard deviations of normal errors, cut at four of them, so that the farthest leg is known
    (:meth:`farthest_km`). The environment must allow it: ``GeomagneticNavEnv(drift_km=...)``. Stands before every
    transform of the action, such as its scaling.

    Args:
        log_scale: error of the log in an episode, as a share of the distance.
        log_noise: error of the log in a leg, as a share of the distance.
        compass_deg: error of the compass in motion in an episode [deg].
        current_km_h: speed of a current whose direction is random in each episode [km/h].
        eddies_km_h: root-mean-square speed of a field of eddies, another one in each episode [km/h]; see
            :func:`eddy_velocity`. It is integrated along a leg by the fourth-order Runge-Kutta method.
        eddy_km: wavelength of the eddies [km].
        speed_km_h: speed of the vehicle through the water or the air [km/h]; needed with currents.
        fixed: whether ``log_scale`` and ``compass_deg`` are the errors themselves, in every episode.
        in_keys: last leg ``(..., 2)``, distance [km] and turn [rad]; heading ``(..., 1)`` [rad]; and position
            ``(..., 2)`` [deg].
        out_keys: true leg ``(..., 2)``, its direction ``(..., 1)`` [rad], and the current at the vehicle's place over
            its speed ``(..., 2)``, northward and eastward. Privileged.
        **options: ``seed`` of :class:`~magrl.errors.base.EpisodeErrors`. The errors of the
            episode are scale, compass [deg], direction of the current and phases of the eddies [rad], and with
            eddies the uniform numbers of their directions (:func:`eddy_waves`).

    Raises:
        ValueError: for a negative size, errors of the log that could turn a leg around, a current without a speed of
            the vehicle, another number of keys, an environment that does not allow the farthest leg, or scaled actions.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> errors = MotionError(log_scale=0.1, fixed=True)
        >>> env = TransformedEnv(GeomagneticNavEnv(num_envs=1, seed=0, drift_km=5.0), errors)
        >>> after = env.step(env.reset().set("action", torch.tensor([[50.0, 0.5]])))["next"]
        >>> after["leg"], after["true_leg"]
        (tensor([[50.0000,  0.5000]]), tensor([[55.0000,  0.5000]]))
    """

    channel = 4
    default_in_keys = ("leg", "heading", "position")
    default_out_keys = ("true_leg", "true_course", "true_current")
    true_keys = (*default_out_keys, LEG_ERROR)
    numbers_key, stream_key = "motion_error", "motion_stream"
    in_sizes = {"leg": (2,), "heading": (1,), "position": (2,)}
    step_draws = 2  # one is used: published numbers rest on the stride, and on phases that are drawn without eddies

    def __init__(
        self,
        *,
        log_scale: float = 0.0,
        log_noise: float = 0.0,
        compass_deg: float = 0.0,
        current_km_h: float = 0.0,
        eddies_km_h: float = 0.0,
        eddy_km: float = 200.0,
        speed_km_h: float | None = None,
        fixed: bool = False,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self.in_keys_inv = self.out_keys_inv = ["action", self.in_keys[1]]
        check_number(-math.inf if fixed else 0, log_scale=log_scale, compass_deg=compass_deg)
        check_number(0, log_noise=log_noise, current_km_h=current_km_h, eddies_km_h=eddies_km_h)
        check_number(0, above=True, eddy_km=eddy_km)
        check_number(0, above=True, optional=not (current_km_h or eddies_km_h), speed_km_h=speed_km_h)
        self.log, self.compass_deg, self.fixed = (log_scale, log_noise), compass_deg, fixed
        self.current_km_h, self.speed_km_h = current_km_h, float(speed_km_h or 1.0)
        self.eddies_km_h, self.eddy_km = eddies_km_h, eddy_km
        self.size = self.draws = 3 + EDDIES + 2 * EDDIES * bool(eddies_km_h)
        shortest, _ = self._stretch
        if shortest <= 0:
            raise ValueError(f"log_scale {log_scale} and log_noise {log_noise} must keep every distance above 0")

    @property
    def _stretch(self) -> tuple[float, float]:
        """Smallest and largest ratio of a true distance through the water to its command."""
        noise = NORMAL_LIMIT * self.log[1]
        scale = (self.log[0],) * 2 if self.fixed else (-NORMAL_LIMIT * self.log[0], NORMAL_LIMIT * self.log[0])
        return 1 + scale[0] - noise, 1 + scale[1] + noise

    def farthest_km(self, max_leg_km: float) -> float:
        """Return the longest path on the ground of a commanded leg [km].

        Example:
            >>> MotionError(log_noise=0.01, current_km_h=3.0, speed_km_h=30.0).farthest_km(50.0)
            57.00000000000001
        """
        currents = self.current_km_h + math.sqrt(3 * EDDIES) * self.eddies_km_h
        return super().farthest_km(max_leg_km) * (self._stretch[1] + currents / self.speed_km_h)

    # Data

    def _constants(self, stream: Tensor) -> Tensor:
        uniform = stream_uniform(stream, self.draws)
        sizes = uniform.new_tensor((self.log[0], self.compass_deg))
        constants = sizes.expand_as(uniform[..., :2]) if self.fixed else sizes * normal_of(uniform[..., :2])
        angles, directions = uniform[..., 2:].tensor_split([1 + EDDIES], -1)
        return torch.cat((constants, 2 * math.pi * angles, directions), -1)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write what the errors add to the commanded leg, which the environment adds."""
        values = self._read(tensordict, [*self.in_keys_inv, self.in_keys[2]])
        return tensordict.set(LEG_ERROR, self._leg_error(*values, *self._state(tensordict)))

    def _leg_error(self, action: Tensor, heading: Tensor, position: Tensor, errors: Tensor, stream: Tensor) -> Tensor:
        """Return the leg on the ground minus the commanded one, ``(..., 2)`` northward and eastward [km]."""
        distance, turn = action[..., :2].double().unbind(-1)
        bow, errors = wrap_angle(heading[..., 0] + turn), errors.double()
        scale, compass, direction = errors[..., :3].unbind(-1)
        stretch = stream_normal(stream.squeeze(-1), 1).squeeze(-1)
        through = distance * (1 + scale + self.log[1] * stretch)
        course = bow + torch.deg2rad(compass)
        added = through.unsqueeze(-1) * _unit(course) - distance.unsqueeze(-1) * _unit(bow)
        hours = (distance / self.speed_km_h).unsqueeze(-1)
        added = added + hours * self.current_km_h * _unit(direction)
        return added + self._drift(added + distance.unsqueeze(-1) * _unit(bow), hours, position, errors)

    def _drift(self, leg: Tensor, hours: Tensor, position: Tensor, errors: Tensor) -> Tensor | float:
        """Return how far eddies carry a vehicle along a leg ``(..., 2)`` [km], by Runge and Kutta's four stages."""
        if not self.eddies_km_h:
            return 0.0
        velocity, hours = self._eddies(position, errors), self.eddies_km_h * hours
        first = hours * velocity(torch.zeros_like(leg))
        second = hours * velocity((leg + first) / 2)
        third = hours * velocity((leg + second) / 2)
        return (first + 2 * (second + third) + hours * velocity(leg + third)) / 6

    def _eddies(self, position: Tensor, errors: Tensor) -> Callable[[Tensor], Tensor]:
        phases, directions = errors[..., 3:].tensor_split([EDDIES], -1)
        return eddy_velocities(position.double(), eddy_waves(directions, self.eddy_km), phases)

    def _current(self, position: Tensor, errors: Tensor) -> Tensor:
        """Return the current at a place over the speed of the vehicle, ``(..., 2)`` northward and eastward."""
        current = self.current_km_h * _unit(errors[..., 2])
        if self.eddies_km_h:
            current = current + self.eddies_km_h * self._eddies(position, errors)(torch.zeros_like(position))
        return current / self.speed_km_h

    def _disturb(self, tensordict: TensorDictBase, values: list[Tensor], episode: Episode) -> Tensor:
        """Write the true leg, its direction, and the current."""
        leg, heading, position = values
        if not episode.first:
            distance, bow = leg[..., 0].double(), heading[..., 0].double()
            distance, course = polar(displaced(distance, bow, tensordict[LEG_ERROR]))
            leg = torch.stack((distance, leg[..., 1].double()), -1).to(leg.dtype)
            heading = torch.where(distance > 0, course, heading[..., 0]).unsqueeze(-1).to(heading.dtype)
        current = self._current(position, episode.numbers.double()).to(heading.dtype)
        self._write_named(tensordict, true_leg=leg, true_course=heading, true_current=current)
        return episode.numbers

    # Specs

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add the true leg, its direction, the current, the errors and the state of the numbers."""
        observation_spec = super().transform_observation_spec(observation_spec)
        leg, heading, _ = (observation_spec[key] for key in self.in_keys)
        for key in (self.out_keys[0], self.out_keys[2]):
            self._add(observation_spec, leg, key, 2)
        observation_spec[self.out_keys[1]] = heading.clone()
        return observation_spec

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """Make what a step reads part of the state, and check that the environment allows the farthest leg.

        Raises:
            ValueError: if it does not, with the distance that is missing.
        """
        input_spec = super().transform_input_spec(input_spec)
        if self.parent is None:
            return input_spec
        space = input_spec["full_action_spec"][self.in_keys_inv[0]].space
        if space.low[..., 0].min() < 0:
            raise ValueError("MotionError reads actions in km and rad, got scaled ones: put it before their scaling")
        commanded = float(space.high[..., 0].max())
        spec = observed_spec(self).get(LEG_ERROR, None)
        allowed = 0.0 if spec is None else float(spec.space.high.max()) - 2 * commanded
        drift = self.farthest_km(commanded) - commanded
        if spec is None or not drift <= allowed + 1e-6 * commanded:
            raise ValueError(
                f"MotionError carries a vehicle up to {drift:.6g} km farther than its command, the environment allows "
                f"{allowed:.6g} km: create it with drift_km={math.ceil(100 * drift) / 100}"
            )
        return input_spec


def eddy_waves(uniform: Tensor, wavelength_km: float) -> Tensor:
    """Return M wave vectors of random directions in space, ``(..., M, 3)`` [rad on the unit sphere].

    Args:
        uniform: ``(..., 2 M)`` uniform numbers in [0, 1): of the heights of the directions, then of their longitudes.
        wavelength_km: wavelength [km].

    Example:
        >>> eddy_waves(torch.rand(16), 200.0).norm(dim=-1).mul(200 / (2 * math.pi)).round()[0]  # the Earth's radius
        tensor(6371.)
    """
    height, longitude = uniform.unflatten(-1, (2, -1)).unbind(-2)
    up = 2 * height - 1
    level = torch.sqrt(1 - up.square()).unsqueeze(-1) * _unit(2 * math.pi * longitude)
    return torch.cat((level, up.unsqueeze(-1)), -1) * (2 * math.pi * MEAN_RADIUS_KM / wavelength_km)


def eddy_velocity(position: Tensor, waves: Tensor, phases: Tensor) -> Tensor:
    """Return the velocity of a field of eddies, whose mean square over places and phases is 1.

    The stream function is a sum of plane waves ``a / |k| sin(k·r + phase)`` in space, read on the unit sphere; the
    velocity is its gradient times the vertical, ``v = grad psi x r``. It is smooth everywhere, and its divergence on
    the sphere is 0. With M waves, a = sqrt(3 / M), and no speed exceeds sqrt(3 M).

    Args:
        position: ``(..., 2)`` latitude, longitude [deg].
        waves: ``(..., M, 3)`` wave vectors k, from :func:`eddy_waves`.
        phases: ``(..., M)`` [rad].

    Returns:
        ``(..., 2)`` northward and eastward.

    Example:
        >>> waves = torch.tensor([[0.0, 0.0, 1.0]])  # along the axis of the Earth: currents along the parallels
        >>> eddy_velocity(torch.zeros(1, 2), waves, torch.zeros(1, 1))
        tensor([[-0.0000, 1.7321]])
    """
    return eddy_velocities(position, waves, phases)(torch.zeros_like(position))


def eddy_velocities(position: Tensor, waves: Tensor, phases: Tensor) -> Callable[[Tensor], Tensor]:
    """Return :func:`eddy_velocity` as a function of displacements ``(..., 2)`` northward and eastward [km].

    It is expanded around the position, in whose axes velocities are: within 0.3 % at 50 km.

    Example:
        >>> place, waves = torch.tensor([10.0, 160.0]), eddy_waves(torch.rand(16), 250.0)
        >>> near, there = eddy_velocities(place, waves, torch.zeros(8)), torch.tensor([10.1, 160.0])
        >>> apart = near(torch.tensor([11.06, 0.0])) - eddy_velocity(there, waves, torch.zeros(8))
        >>> bool(apart.norm() < 0.01)
        True
    """
    latitude, longitude = position.unbind(-1)
    north, east, down = (waves @ local_frame(latitude, longitude).mT).unbind(-1)
    size = math.sqrt(3 / waves.shape[-2]) / waves.norm(dim=-1)
    radii = torch.stack(curvature_radii(latitude), -1)

    def velocity(displacement: Tensor) -> Tensor:
        arc = displacement / radii
        along, across = arc.unsqueeze(-2).unbind(-1)
        fall = arc.square().sum(-1, keepdim=True) / 2
        swing = size * torch.cos(phases + north * along + east * across - down * (1 - fall))
        # gradient x up: northward is -(gradient·east), eastward is gradient·north
        return torch.stack((-(swing * (east + down * across)).sum(-1), (swing * (north + down * along)).sum(-1)), -1)

    return velocity


def _unit(angle: Tensor) -> Tensor:
    return torch.stack((torch.cos(angle), torch.sin(angle)), -1)
