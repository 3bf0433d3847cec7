"""Quasi-Newton navigation: steps by a Jacobian that a filter estimates along the vehicle's own track."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl import tracking
from magrl.checks import check_number, check_numbers
from magrl.field.elements import NAMES
from magrl.navigators.base import CURVATURE, Navigator, element_indices, steer

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
        noise: standard deviations of the sensors, their data sheet: D [deg], I [deg], B_H [nT].

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
        noise: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        super().__init__(max_move_km, max_turn_rad)
        check_numbers(3, noise=noise)
        check_number(0, noise=min(noise))
        self.in_keys = ["field", "target_field", "heading", "move", "step_count"]
        self.elements = element_indices(elements, 2)
        self.noise, self.curvature = ([values[i] for i in self.elements] for values in (noise, CURVATURE))
        self.register_buffer("data_sheet", torch.tensor(noise, dtype=torch.float64), persistent=False)
        self.scales = [tracking.ELEMENT_SCALES[i] * _FINE for i in self.elements]

    def prior(self, reading: Tensor) -> tracking.GradientPrior:
        """Return the expected gradient of the elements, given the first reading ``(N, E)``.

        Raises:
            NotImplementedError: in the base class.
        """
        raise NotImplementedError(f"{type(self).__name__} must return a GradientPrior in prior(reading)")

    def _drift(self, seen: TensorDictBase) -> Tensor | list[float]:  # noqa: ARG002
        """Return the standard deviation of the change of the Jacobian, see :func:`magrl.tracking.predict`."""
        return self.curvature

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        reading = seen["field"].double()[:, self.elements]
        gradient, std, azimuth = self.prior(reading)
        track = tracking.start(reading, gradient, std, self.noise, azimuth, self.scales)
        decisions = torch.zeros_like(seen["step_count"].squeeze(-1))
        return {"mean": track.mean, "covariance": track.covariance, "decisions": decisions}

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        heading = seen["heading"].squeeze(-1).double()
        leg = seen["move"][:, :1].double() * torch.stack((torch.cos(heading), torch.sin(heading)), -1)
        track = tracking.FieldTrack(memory["mean"], memory["covariance"])
        moved = tracking.predict(track, leg, self._drift(seen), self.scales)
        noise = self.accuracy(seen, self.data_sheet)[..., self.elements]
        moved = tracking.update(moved, self._continued(seen["field"], moved), noise, self.scales)
        began = (memory["decisions"] == 0)[:, None, None]  # the first reading is in the track already
        mean = torch.where(began, track.mean, moved.mean)
        covariance = torch.where(began.unsqueeze(-1), track.covariance, moved.covariance)
        memory.update({"mean": mean, "covariance": covariance, "decisions": memory["decisions"] + 1})
        track = tracking.FieldTrack(mean, covariance)
        target = self._continued(seen["target_field"], track)
        way = tracking.way_to(track, target, RANGE_KM, self.scales).displacement
        wanted = torch.atan2(way[:, 1], way[:, 0])
        return steer(heading, wanted, way.norm(dim=-1), self.max_move_km, self.max_turn_rad)

    def _continued(self, values: Tensor, track: tracking.FieldTrack) -> Tensor:
        """Return the elements ``(N, E)`` of readings, with D within half a turn of the estimate."""
        values = values.double()[:, self.elements]
        near = track.mean[..., 0] * values.new_tensor(self.scales)
        period = values.new_tensor([360.0 * (index == 0) for index in self.elements])
        return values - period * torch.round((values - near) / 360)
