"""Parallel approach with the true gradient: an oracle."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl.field.model import FieldModel, elements_gradient_at
from magrl.guidance import parallel_approach
from magrl.navigators.base import Navigator, displacement_to, element_indices, steer


class ParallelApproach(Navigator):
    """Parallel approach (Eq. 3-15) with the true gradient at the vehicle's position: an oracle and an upper bound.

    Args:
        field: field model, usually ``env.field``.
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].
        pair: two elements whose errors shrink in proportion.

    Raises:
        ValueError: for a bound out of its range, or ``pair`` that is not two different elements.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> env.rollout(50, ParallelApproach(env.field))["next", "success"].any()
        tensor(True)
    """

    oracle = True

    def __init__(
        self,
        field: FieldModel,
        max_move_km: float = 50.0,
        max_turn_rad: float = math.pi / 2,
        pair: Sequence[str] = ("D", "I"),
    ) -> None:
        super().__init__(max_move_km, max_turn_rad)
        if not hasattr(field, "value_and_gradient"):
            raise ValueError(f"field must have value_and_gradient(latitude, longitude), got {field!r}")
        self.in_keys = ["field", "target_field", "heading", "position", "step_count"]
        self.field, self.pair = field, element_indices(pair, 2)
        if len(self.pair) != 2:
            raise ValueError(f"pair must be two of D, I, B_H, got {tuple(pair)}")

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:  # noqa: ARG002 - no memory
        return {}

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:  # noqa: ARG002
        here, there = (seen[key][:, self.pair].double() for key in ("field", "target_field"))
        gradient = elements_gradient_at(self.field, seen["position"])[:, self.pair]
        way = displacement_to(there - here, gradient)
        heading, valid = (x.squeeze(-1) for x in parallel_approach(here, there, gradient))
        # Where the gradients are nearly parallel, least squares still give a useful heading.
        wanted = torch.where(valid, heading, torch.atan2(way[:, 1], way[:, 0]))
        now = seen["heading"].squeeze(-1).double()
        return steer(now, wanted, way.norm(dim=-1), self.max_move_km, self.max_turn_rad)
