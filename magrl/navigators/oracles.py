"""Oracles, which know what no vehicle measures: both positions, or the true gradient."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl import geodesy
from magrl.envs import GeomagneticNavEnv
from magrl.field.bank import FieldBank
from magrl.field.elements import element_difference
from magrl.field.model import FieldModel, elements_gradient_at
from magrl.geodesy import steer
from magrl.guidance import displacement_to
from magrl.navigators.base import Navigator
from magrl.navigators.quasi_newton import CURVATURE
from magrl.sensor_std import SensorStd


class Geodesic(Navigator):
    """Fly the shortest path to the destination's position: an oracle, which needs no field.

    Args:
        max_leg_km: longest leg [km].
        max_turn_rad: largest turn [rad].

    Raises:
        ValueError: for a bound out of its range.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> env.rollout(50, Geodesic())["next", "success"].any()
        tensor(True)
    """

    name = "geodesic"
    description = "geodesic (both positions, an oracle)"
    oracle, needs = True, "the position"
    in_keys = ("position", "target_position", "heading", "elapsed_steps")

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:  # noqa: ARG002
        distance, bearing = geodesy.geodesic(*seen["position"].unbind(-1), *seen["target_position"].unbind(-1))
        now = seen["heading"].squeeze(-1).double()
        return steer(now, bearing, distance, self.max_leg_km, self.max_turn_rad)


class ParallelApproach(Navigator):
    """Newton steps with the true gradient at the vehicle's position: an oracle.

    Each step closes the errors of all three elements by least squares, weighted by the inverse of
    :data:`magrl.navigators.quasi_newton.CURVATURE`. The paper's parallel approach (Eq. (21)) closes those of two, and
    fails where their gradients are nearly parallel.

    Args:
        field: field model or bank of them, usually ``env.field``.
        max_leg_km: longest leg [km].
        max_turn_rad: largest turn [rad].

    Raises:
        ValueError: for a bound out of its range.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> env.rollout(50, ParallelApproach(env.field))["next", "success"].any()
        tensor(True)
    """

    name = "parallel"
    description = "parallel (true gradient, an oracle)"
    oracle, needs = True, "the gradient"

    def __init__(
        self, field: FieldModel | FieldBank, max_leg_km: float = 50.0, max_turn_rad: float = math.pi / 2
    ) -> None:
        super().__init__(max_leg_km, max_turn_rad)
        self.in_keys = ["field", "target_field", "heading", "position", "elapsed_steps", "region"]
        self.field = field

    @staticmethod
    def env_options(env: GeomagneticNavEnv, sensor_std: SensorStd) -> dict[str, Any]:  # noqa: ARG004
        return {"field": env.field}

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:  # noqa: ARG002
        here, there = (seen[key].double() for key in ("field", "target_field"))
        gradient = elements_gradient_at(self.field, seen["position"], seen["region"].squeeze(-1))
        scale = gradient.new_tensor(CURVATURE)
        displacement = displacement_to(element_difference(there, here) / scale, gradient / scale.unsqueeze(-1))
        wanted = torch.atan2(displacement[:, 1], displacement[:, 0])
        now = seen["heading"].squeeze(-1).double()
        return steer(now, wanted, displacement.norm(dim=-1), self.max_leg_km, self.max_turn_rad)
