"""Navigator that goes on while the objective falls and turns otherwise: the simplest use of the readings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl import guidance
from magrl.checks import check_number, check_numbers
from magrl.envs import GeomagneticNavEnv
from magrl.navigators.base import Navigator, Std


class RunAndTumble(Navigator):
    """Go on while the objective F (Eq. 2-6) falls, else turn to the right by a right angle: its own readings only.

    Each move is half of the longest: longer ones jump over the destination, shorter ones do not reach it in 50 steps.

    Args:
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].
        objective_floors: floors of Eq. 2-6: D [deg], I [deg], B_H [nT].

    Raises:
        ValueError: for a bound out of its range, or floors that are not three positive numbers.

    Source:
        H. C. Berg and D. A. Brown, Chemotaxis in Escherichia coli analysed by three-dimensional tracking, Nature 239
        (1972), whose bacteria turn at random.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=1, seed=0)
        >>> env.rollout(1, RunAndTumble())["action"][0, 0]
        tensor([25.,  0.])
    """

    name, label = "run_and_tumble", "run and tumble"
    description = label

    def __init__(
        self,
        max_move_km: float = 50.0,
        max_turn_rad: float = math.pi / 2,
        objective_floors: Sequence[float] = guidance.OBJECTIVE_FLOORS,
    ) -> None:
        super().__init__(max_move_km, max_turn_rad)
        check_numbers(3, objective_floors=objective_floors)
        check_number(0, above=True, objective_floors=min(objective_floors))
        self.in_keys = ["field", "target_field", "heading", "step_count"]
        self.turn, self.objective_floors = min(math.pi / 2, self.max_turn_rad), tuple(objective_floors)

    @staticmethod
    def env_options(env: GeomagneticNavEnv, sensor_std: Std, bias_std: Std) -> dict[str, Any]:  # noqa: ARG004
        return {"objective_floors": tuple(env.objective_floors.mean(0).tolist())}

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        here, there = seen["field"].double(), seen["target_field"].double()
        weights = guidance.objective_weights(here, there, here.new_tensor(self.objective_floors))
        return {"weights": weights, "objective": torch.full_like(here[:, :1], math.inf)}

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        here, there = seen["field"].double(), seen["target_field"].double()
        objective = guidance.objective(here, there, memory["weights"])
        falls = (objective < memory["objective"]).squeeze(-1)
        memory["objective"] = objective
        turn = torch.where(falls, 0.0, here.new_tensor(self.turn))
        return torch.full_like(turn, self.max_move_km / 2), torch.where(objective.squeeze(-1).isnan(), math.nan, turn)
