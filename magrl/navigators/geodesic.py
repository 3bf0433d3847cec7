"""Navigator that knows both positions: the upper bound in every region."""

from __future__ import annotations

from typing import ClassVar

from tensordict import TensorDictBase
from torch import Tensor

from magrl import geodesy
from magrl.geodesy import steer
from magrl.navigators.base import Navigator


class Geodesic(Navigator):
    """Fly the shortest path to the destination's position: an oracle, which needs no field.

    Args:
        max_move_km: longest leg [km].
        max_turn_rad: largest turn [rad].

    Raises:
        ValueError: for a bound out of its range.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> env.rollout(50, Geodesic())["next", "success"].any()
        tensor(True)
    """

    name = label = "geodesic"
    description = "geodesic (both positions, an oracle)"
    oracle, needs = True, "the position"
    in_keys: ClassVar[list[str]] = ["position", "target_position", "heading", "elapsed_steps"]

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:  # noqa: ARG002
        distance, bearing = geodesy.geodesic(*seen["position"].unbind(-1), *seen["target_position"].unbind(-1))
        now = seen["heading"].squeeze(-1).double()
        return steer(now, bearing, distance, self.max_move_km, self.max_turn_rad)
