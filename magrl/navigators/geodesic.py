"""Navigator that knows both positions: the upper bound in every region."""

from __future__ import annotations

import math

from tensordict import TensorDictBase
from torch import Tensor

from magrl import geodesy
from magrl.navigators.base import Navigator, steer


class Geodesic(Navigator):
    """Fly the shortest path to the destination's position: an oracle, which needs no field.

    Args:
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].

    Raises:
        ValueError: for a bound out of its range.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> env.rollout(50, Geodesic())["next", "success"].any()
        tensor(True)
    """

    oracle = True
    needs = "the position"

    def __init__(self, max_move_km: float = 50.0, max_turn_rad: float = math.pi / 2) -> None:
        super().__init__(max_move_km, max_turn_rad)
        self.in_keys = ["position", "target_position", "heading", "step_count"]

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:  # noqa: ARG002 - no memory
        return {}

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:  # noqa: ARG002
        distance, bearing = geodesy.geodesic(*seen["position"].unbind(-1), *seen["target_position"].unbind(-1))
        now = seen["heading"].squeeze(-1).double()
        return steer(now, bearing, distance, self.max_move_km, self.max_turn_rad)
