"""Quasi-Newton navigator that starts from the mean Jacobian of a region, a map of twelve numbers."""

from __future__ import annotations

import math
from typing import Any

from torch import Tensor

from magrl.checks import check_tensor
from magrl.envs import GeomagneticNavEnv
from magrl.field.model import FieldModel, elements_gradient_at
from magrl.navigators.filter import GradientPrior
from magrl.navigators.quasi_newton import QuasiNewton
from magrl.sensor_std import SensorStd


class MeanJacobian(QuasiNewton):
    """Quasi-Newton navigation from the mean Jacobian of a region, without probing legs.

    The map is twelve numbers: mean and standard deviation over the region of the gradients of D, I, B_H northward and
    eastward. An agent that is trained in one region can learn as much.

    Args:
        field: field model, usually ``env.field``.
        position: ``(..., 2)`` places to average over, latitude, longitude [deg], usually ``env.region.grid(21)``.
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].
        **options: ``sensor_std``, ``zeta`` and ``search`` of :class:`QuasiNewton`.

    Raises:
        ValueError: for a bound out of its range, fewer than two places, or a negative standard deviation.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> env.rollout(50, MeanJacobian(env.field, env.region.grid(21)))["next", "success"].any()
        tensor(True)
    """

    needs = "a map of the region"

    def __init__(
        self,
        field: FieldModel,
        position: Tensor,
        max_move_km: float = 50.0,
        max_turn_rad: float = math.pi / 2,
        **options: Any,
    ) -> None:
        super().__init__(max_move_km, max_turn_rad, **options)
        if not hasattr(field, "value_and_gradient"):
            raise ValueError(f"field must have value_and_gradient(latitude, longitude), got {field!r}")
        check_tensor(2, position=position)
        if position.numel() < 4:
            raise ValueError(f"position must hold at least two places (..., 2), got shape {tuple(position.shape)}")
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
