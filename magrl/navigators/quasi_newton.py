"""Quasi-Newton navigation: steps by a Jacobian that a filter estimates along the vehicle's own track."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl import tracking
from magrl.checks import check_numbers
from magrl.envs import GeomagneticNavEnv
from magrl.field.elements import NAMES
from magrl.navigators.base import Navigator, Std, element_indices, steer, total_std
from magrl.tracking import FieldTrack, GradientPrior

RANGE_KM = 1000.0
"""Prior standard deviation of the way to the destination along each axis [km]."""
_FINE = 1e-4  # units of the filter in float64: its smallest variance is then below the rounding of float32 readings


class QuasiNewton(Navigator):
    """Base class of quasi-Newton navigators: each move goes to where, by the estimated Jacobian, the error vanishes.

    The Jacobian is that of :mod:`magrl.tracking`. The filter weighs each reading by its noise and the length of the
    move, and each element by how well it determines the way. Without noise, the first update is Broyden's.

    A subclass returns the prior of the Jacobian in :meth:`prior`.

    Args:
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].
        elements: two or three of D, I, B_H.
        sensor_std: standard deviations of new errors of a reading: D [deg], I [deg], B_H [nT].

    Raises:
        ValueError: for a bound out of its range, fewer than two elements, or a negative standard deviation.

    Source:
        C. G. Broyden, A class of methods for solving nonlinear simultaneous equations, Math. Comp. 19 (1965).

    Example:
        >>> class DipoleNavigator(QuasiNewton):
        ...     def prior(self, reading):
        ...         return tracking.dipole_prior(reading)
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> env.rollout(50, DipoleNavigator(50.0, 1.5))["next", "success"].any()
        tensor(True)
    """

    def __init__(
        self,
        max_move_km: float,
        max_turn_rad: float,
        elements: Sequence[str] = NAMES,
        sensor_std: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        super().__init__(max_move_km, max_turn_rad)
        check_numbers(3, 0, sensor_std=sensor_std)
        self.in_keys = ["field", "target_field", "heading", "move", "step_count"]
        self.elements = element_indices(elements, 2)
        self._register("sensor_std", sensor_std)
        self._register("scales", [tracking.ELEMENT_SCALES[i] * _FINE for i in self.elements])
        self._register("periods", [tracking.ELEMENT_PERIODS[i] for i in self.elements])
        self._register("curvature", [tracking.CURVATURE[i] for i in self.elements])

    @staticmethod
    def env_options(env: GeomagneticNavEnv, sensor_std: Std, bias_std: Std) -> dict[str, Any]:  # noqa: ARG004
        return {"sensor_std": total_std(sensor_std, bias_std)}

    def _register(self, name: str, values: Sequence[float]) -> None:
        self.register_buffer(name, torch.tensor(values, dtype=torch.float64), persistent=False)

    def prior(self, reading: Tensor) -> GradientPrior:
        """Return the expected gradient of the elements, given the first reading ``(N, E)``.

        Raises:
            NotImplementedError: in the base class.
        """
        raise NotImplementedError(f"{type(self).__name__} must return a GradientPrior in prior(reading)")

    def reading_std(self, seen: TensorDictBase) -> Tensor:
        """Return the standard deviations of the present reading in the filter: D, I, B_H."""
        return self.accuracy(seen, self.sensor_std)

    def drift(self, reading: Tensor) -> Tensor:  # noqa: ARG002
        """Return the standard deviation of the change of the Jacobian, see :func:`magrl.tracking.predict`."""
        return self.curvature

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        reading = seen["field"].double()[:, self.elements]
        track = tracking.start(reading, self.prior(reading), self.sensor_std[self.elements], self.scales)
        decisions = torch.zeros_like(seen["step_count"].squeeze(-1))
        return {"mean": track.mean, "covariance": track.covariance, "decisions": decisions}

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        return self.move(self.read(seen, memory), seen, memory)

    def read(self, seen: TensorDictBase, memory: TensorDictBase) -> FieldTrack:
        """Return the state of the filter after the present reading, and keep it in the memory."""
        before = FieldTrack(memory["mean"], memory["covariance"])
        reading, displacement = seen["field"].double()[:, self.elements], self.displacement(seen)
        std = self.reading_std(seen)[..., self.elements]
        after = tracking.read(before, displacement, reading, std, self.drift(reading), self.scales, self.periods)
        began = (memory["decisions"] == 0)[:, None, None]  # the first reading is in the track already
        mean = torch.where(began, before.mean, after.mean)
        covariance = torch.where(began.unsqueeze(-1), before.covariance, after.covariance)
        memory.update({"mean": mean, "covariance": covariance, "decisions": memory["decisions"] + 1})
        return FieldTrack(mean, covariance)

    def move(self, track: FieldTrack, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:  # noqa: ARG002
        """Return distance [km] and turn [rad], each ``(N,)``, given the state of the filter."""
        target = seen["target_field"].double()[:, self.elements]
        way = tracking.way_to(track, target, RANGE_KM, self.scales, periods=self.periods).displacement
        return self.steer(seen, way, way.norm(dim=-1))

    def steer(self, seen: TensorDictBase, direction: Tensor, distance: Tensor) -> tuple[Tensor, Tensor]:
        """Return distance [km] and turn [rad] of a move in a direction ``(N, 2)`` northward and eastward."""
        heading = seen["heading"].squeeze(-1).double()
        wanted = torch.atan2(direction[:, 1], direction[:, 0])
        return steer(heading, wanted, distance, self.max_move_km, self.max_turn_rad)

    @staticmethod
    def displacement(seen: TensorDictBase) -> Tensor:
        """Return the last displacement ``(N, 2)`` northward and eastward [km]."""
        return tracking.displacement_of(seen["move"].double(), seen["heading"].double())
