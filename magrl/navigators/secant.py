"""Quasi-Newton navigator: a Jacobian of the elements estimated along the vehicle's own track."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from magrl.checks import check_number, check_tensor
from magrl.navigators.base import Navigator, displacement_to, element_indices, steer

ELEMENT_SCALE = (1.0, 1.0, 0.01)
"""Factors of D [deg], I [deg], B_H [nT] that make their changes along an episode comparable."""


def broyden_update(jacobian: Tensor, displacement: Tensor, change: Tensor, direction: Tensor | None = None) -> Tensor:
    """Return a Jacobian after the rank-one update that makes it explain the last move.

    Args:
        jacobian: ``(..., E, 2)`` element unit per km, north and east.
        displacement: ``(..., 2)`` last move, north and east [km].
        change: ``(..., E)`` change of the elements over the move.
        direction: ``(..., 2)`` direction of the update, which leaves the Jacobian unchanged across it; by default the
            displacement.

    Returns:
        ``(..., E, 2)`` with ``J_new displacement = change``; unchanged where there was no move along ``direction``.
        NaN in gives NaN out.

    Raises:
        ValueError: for shapes that do not match.

    Source:
        C. G. Broyden, A class of methods for solving nonlinear simultaneous equations, Math. Comp. 19 (1965).

    Example:
        >>> broyden_update(torch.zeros(1, 2), torch.tensor([10.0, 0.0]), torch.tensor([0.2]))
        tensor([[0.0200, 0.0000]])
    """
    direction = displacement if direction is None else direction
    check_tensor(2, displacement=displacement, direction=direction)
    check_tensor(change=change)
    check_tensor(*change.shape[-1:], 2, jacobian=jacobian)
    surprise = change - (jacobian @ displacement.unsqueeze(-1)).squeeze(-1)
    along = (direction * displacement).sum(-1)[..., None, None]
    rank_one = surprise.unsqueeze(-1) * direction.unsqueeze(-2)
    still = along <= 1e-9  # False for NaN
    return torch.where(still, jacobian, jacobian + rank_one / torch.where(still, 1.0, along))


def project(vector: Tensor, onto: Tensor) -> Tensor:
    """Return the part of a vector along another, ``(..., 2)``; 0 along a zero vector, NaN where either is NaN.

    Example:
        >>> project(torch.tensor([3.0, 4.0]), torch.tensor([0.0, 2.0]))
        tensor([0., 4.])
    """
    check_tensor(2, vector=vector, onto=onto)
    square = onto.square().sum(-1, keepdim=True)
    return (vector * onto).sum(-1, keepdim=True) / torch.where(square > 0, square, 1.0) * onto


class Secant(Navigator):
    """Quasi-Newton navigation with a Jacobian estimated along the vehicle's own track: no map, no training, no oracle.

    Two short legs across each other give a first Jacobian of the elements by north and east. From then on each move is
    a quasi-Newton step to the destination's elements, after which Broyden's update corrects the Jacobian.

    Args:
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].
        probe_km: length of the two legs [km]. Longer legs lengthen the path, shorter ones suffer more from noise.
        elements: two elements whose contours cross, or all three by least squares.

    Raises:
        ValueError: for a bound or a leg out of its range, or fewer than two elements.

    Source:
        C. G. Broyden, A class of methods for solving nonlinear simultaneous equations, Math. Comp. 19 (1965).

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> env.rollout(2, Secant())["action"][0].round(decimals=2)
        tensor([[10.0000,  0.0000],
                [10.0000,  1.5700]])
    """

    def __init__(
        self,
        max_move_km: float = 50.0,
        max_turn_rad: float = math.pi / 2,
        probe_km: float = 10.0,
        elements: Sequence[str] = ("D", "I"),
    ) -> None:
        super().__init__(max_move_km, max_turn_rad)
        check_number(0, max_move_km, above=True, probe_km=probe_km)
        self.in_keys = ["field", "target_field", "heading", "move", "step_count"]
        self.probe_km, self.elements = float(probe_km), element_indices(elements, 2)
        self.probe_turn = min(math.pi / 2, self.max_turn_rad)

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        here = self._scaled(seen["field"])
        leg, jacobian = here.new_zeros(len(here), 2), here.new_zeros(*here.shape, 2)
        return {"here": here, "jacobian": jacobian, "leg": leg, "decisions": torch.zeros_like(leg[:, 0])}

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        here, decisions = self._scaled(seen["field"]), memory["decisions"]
        heading = seen["heading"].squeeze(-1).double()
        leg = seen["move"][:, :1].double() * torch.stack((torch.cos(heading), torch.sin(heading)), -1)
        # The second leg updates the Jacobian only across the first, whatever their angle.
        fresh = leg - project(leg, memory["leg"])
        direction = torch.where((decisions == 2).unsqueeze(-1), fresh, leg)
        jacobian = broyden_update(memory["jacobian"], leg, here - memory["here"], direction)
        memory.update({"here": here, "jacobian": jacobian, "leg": leg, "decisions": decisions + 1})
        way = displacement_to(self._scaled(seen["target_field"]) - here, jacobian)
        wanted = torch.atan2(way[:, 1], way[:, 0])
        distance, turn = steer(heading, wanted, way.norm(dim=-1), self.max_move_km, self.max_turn_rad)
        probe_turn = torch.where(decisions == 1, self.probe_turn, 0.0)
        probing = decisions < 2
        return torch.where(probing, self.probe_km, distance), torch.where(probing, probe_turn, turn)

    def _scaled(self, field: Tensor) -> Tensor:
        """Return the chosen elements in comparable units, ``(N, E)`` float64."""
        scale = torch.tensor(ELEMENT_SCALE, dtype=torch.float64, device=field.device)
        return (field.double() * scale)[:, self.elements]
