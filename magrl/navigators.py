"""Policies that need no training: the parallel approach, with the true gradient and with one found on the way.

Each reads keys of the plain :class:`magrl.env.GeomagneticNavEnv` in physical units and writes ``action`` ``(N, 2)``,
distance [km] and turn [rad]. One that reads privileged keys, or the field where it has not been, is named an oracle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from magrl.checks import check_number, check_tensor
from magrl.elements import element_index
from magrl.env import GeomagneticNavEnv
from magrl.fields import FieldModel, elements_gradient_at
from magrl.geodesy import wrap_angle
from magrl.guidance import parallel_approach

ELEMENT_SCALE = (1.0, 1.0, 0.01)
"""From D [deg], I [deg], B_H [nT] to numbers that change by about as much along a journey."""


def steer(
    heading: Tensor, wanted: Tensor, distance_km: Tensor, max_move_km: float, max_turn_rad: float
) -> tuple[Tensor, Tensor]:
    """The action that goes some way at a heading.

    Where one turn does not reach that heading, the vehicle turns as far as it can and stays: no path is shorter.

    Args:
        heading: ``(...)`` now [rad].
        wanted: ``(...)`` heading to go at [rad].
        distance_km: ``(...)`` how far [km].
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].

    Returns:
        Distance [km] and turn [rad], each ``(...)``, within their bounds; a heading that is NaN gives a turn of NaN.

    Raises:
        ValueError: for a bound that is not positive and finite.

    Example:
        >>> steer(torch.zeros(2), torch.tensor([-1.0, 2.0]), torch.tensor([70.0, 70.0]), 50.0, 1.5)
        (tensor([50.,  0.]), tensor([-1.0000,  1.5000]))
    """
    check_tensor(heading=heading, wanted=wanted, distance_km=distance_km)
    check_number(0, above=True, max_move_km=max_move_km, max_turn_rad=max_turn_rad)
    turn = wrap_angle(wanted - heading)
    within = turn.abs() <= max_turn_rad + 1e-6  # a right angle in float32 is still a right angle
    distance = torch.where(within, distance_km.clamp(0, max_move_km), 0.0)
    return distance, turn.clamp(-max_turn_rad, max_turn_rad)


def displacement_to(error: Tensor, jacobian: Tensor) -> Tensor:
    """The displacement that closes an error in the elements, in the sense of least squares.

    Args:
        error: ``(..., E)`` target less here, in units that may be compared.
        jacobian: ``(..., E, 2)`` the same units per km, north and east.

    Returns:
        ``(..., 2)`` north, east [km]; of singular equations, one that is finite. NaN in gives NaN out.

    Raises:
        ValueError: for shapes that do not match.

    Example:
        >>> displacement_to(torch.tensor([2.0, 1.0]), torch.tensor([[0.0, 0.1], [0.5, 0.0]]))
        tensor([ 2., 20.])
    """
    check_tensor(error=error)
    check_tensor(*error.shape[-1:], 2, jacobian=jacobian)
    wide, sides = jacobian.double(), error.double().unsqueeze(-1)  # squaring costs half of the digits
    normal, right = wide.mT @ wide, (wide.mT @ sides).squeeze(-1)
    ridge = 1e-12 * normal.diagonal(dim1=-2, dim2=-1).sum(-1) + 1e-30
    a, b, c = normal[..., 0, 0] + ridge, normal[..., 0, 1], normal[..., 1, 1] + ridge
    north, east = right.unbind(-1)
    solved = torch.stack((c * north - b * east, a * east - b * north), -1) / (a * c - b * b).unsqueeze(-1)
    return solved.to(error.dtype)


def broyden_update(jacobian: Tensor, displacement: Tensor, change: Tensor, direction: Tensor | None = None) -> Tensor:
    """The rank-one update that makes a Jacobian explain the last move.

    Args:
        jacobian: ``(..., E, 2)`` element unit per km, north and east.
        displacement: ``(..., 2)`` the last move, north and east [km].
        change: ``(..., E)`` what it changed.
        direction: ``(..., 2)`` the update leaves what is perpendicular to it alone; the displacement by default.

    Returns:
        ``(..., E, 2)`` with ``J_new displacement = change``; the old one where there was no move along ``direction``.
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
    still = along <= 1e-9  # which NaN is not
    return torch.where(still, jacobian, jacobian + rank_one / torch.where(still, 1.0, along))


def element_indices(elements: Sequence[str], least: int) -> list[int]:
    """Where some elements stand in ``field``.

    Raises:
        ValueError: for an unknown name, one that is repeated, or fewer than ``least``.

    Example:
        >>> element_indices(("D", "B_H"), least=2)
        [0, 2]
    """
    if isinstance(elements, str) or not isinstance(elements, Sequence):
        raise ValueError(f"elements must be a sequence of D, I, B_H, got {elements!r}")
    if len(set(elements)) != len(elements) or len(elements) < least:
        raise ValueError(f"elements must be at least {least} different ones of D, I, B_H, got {tuple(elements)}")
    return [element_index(name) for name in elements]


class Navigator(TensorDictModuleBase):
    """What every untrained policy shares: its bounds, and a memory for each vehicle that ends with its journey.

    A subclass names its ``in_keys``, says in :meth:`first_memory` what a vehicle remembers when a journey begins
    (``step_count`` 0), and in :meth:`decide` what it does next. It is asked about vehicles only once they have moved
    on, so that asking twice changes nothing; one that reads ``done``, only until their journeys are over.

    Args:
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].

    Raises:
        ValueError: for a bound out of its range.

    Example:
        >>> class DueEast(Navigator):
        ...     def __init__(self):
        ...         super().__init__(max_move_km=50.0, max_turn_rad=math.pi / 2)
        ...         self.in_keys = ["heading", "step_count"]
        ...
        ...     def first_memory(self, seen):
        ...         return {}
        ...
        ...     def decide(self, seen, memory):
        ...         heading = seen["heading"].squeeze(-1)
        ...         east, way = torch.full_like(heading, math.pi / 2), torch.full_like(heading, 30.0)
        ...         return steer(heading, east, way, self.max_move_km, self.max_turn_rad)
        >>> GeomagneticNavEnv(num_envs=1, seed=0).rollout(2, DueEast())["action"].round(decimals=2)
        tensor([[[30.0000,  1.5700],
                 [30.0000,  0.0000]]])
    """

    oracle: bool = False
    """Whether it reads privileged keys, or the field where the vehicle has not been."""

    def __init__(self, max_move_km: float, max_turn_rad: float) -> None:
        super().__init__()
        check_number(0, above=True, max_move_km=max_move_km)
        check_number(0, math.pi, above=True, max_turn_rad=max_turn_rad)
        self.max_move_km, self.max_turn_rad = float(max_move_km), float(max_turn_rad)
        self.out_keys = ["action"]
        self.memory: TensorDictBase | None = None

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:
        """What vehicles remember when a journey begins: tensors ``(N, ...)``."""
        raise NotImplementedError

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Distance [km] and turn [rad], each ``(P,)``, of vehicles that have moved on; writes to their memory."""
        raise NotImplementedError

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action`` ``(N, 2)``: distance [km] and turn [rad]."""
        seen = tensordict.select(*self.in_keys)
        self.memory = memory = self._recall(seen)
        step = seen["step_count"].squeeze(-1)
        if "done" in self.in_keys:  # a rollout flies its vehicles on until the last one is done
            memory["over"] = memory["over"] | seen["done"].squeeze(-1)
            memory["action"] = torch.where(memory["over"].unsqueeze(-1), 0.0, memory["action"])
        rows = ((step != memory["decided_at"]) & ~memory["over"]).nonzero().squeeze(-1)
        if len(rows):
            part = memory[rows]
            part["action"] = torch.stack(self.decide(seen[rows], part), -1).to(part["action"].dtype)
            part["decided_at"] = step[rows]
            memory[rows] = part
        return tensordict.set("action", memory["action"].clone())

    def _recall(self, seen: TensorDictBase) -> TensorDictBase:
        """The memory of the batch, a new one where a journey begins."""
        step = seen["step_count"].squeeze(-1)
        own = {"action": seen["heading"].new_zeros(len(step), 2), "decided_at": torch.full_like(step, -1)}
        own |= {"field_readings": torch.zeros_like(step), "over": torch.zeros_like(step, dtype=torch.bool)}
        first = TensorDict(self.first_memory(seen) | own, batch_size=step.shape, device=step.device)
        if self.memory is None or self.memory.shape != first.shape or self.memory.device != first.device:
            return first
        return torch.where(step == 0, first, self.memory)

    @property
    def field_readings(self) -> Tensor:
        """``(N,)`` int64: readings of the field on this journey where the vehicle was not."""
        return torch.zeros(0, dtype=torch.int64) if self.memory is None else self.memory["field_readings"]


class ParallelApproach(Navigator):
    """The parallel approach (Eq. 3-15) with the true gradient where the vehicle is: an oracle, and the ceiling.

    Args:
        field: the field model, usually ``env.field``.
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].
        pair: the two elements to close in proportion.

    Raises:
        ValueError: for a bound out of its range, or elements that are no pair.

    Example:
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
            raise ValueError(f"pair must be two elements, got {tuple(pair)}")

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:  # noqa: ARG002 - it remembers nothing
        return {}

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor]:  # noqa: ARG002
        here, there = (seen[key][:, self.pair].double() for key in ("field", "target_field"))
        gradient = elements_gradient_at(self.field, seen["position"])[:, self.pair]
        way = displacement_to(there - here, gradient)
        heading, valid = (x.squeeze(-1) for x in parallel_approach(here, there, gradient))
        # Between gradients that hardly cross, least squares still point somewhere useful.
        wanted = torch.where(valid, heading, torch.atan2(way[:, 1], way[:, 0]))
        now = seen["heading"].squeeze(-1).double()
        return steer(now, wanted, way.norm(dim=-1), self.max_move_km, self.max_turn_rad)


class Secant(Navigator):
    """The parallel approach on a Jacobian that the vehicle finds on its own track: no map, no training, no oracle.

    Two short legs across each other give a first Jacobian of the elements by north and east; from then on each move
    is a quasi-Newton step to the destination's elements, and Broyden's update learns from what it changed.

    Args:
        max_move_km: longest move [km].
        max_turn_rad: largest turn [rad].
        probe_km: length of the two legs [km]. Longer ones cost path, shorter ones are worth less under noise.
        elements: two that cross, or all three by least squares.

    Raises:
        ValueError: for a bound or a leg out of its range, or fewer than two elements.

    Source:
        C. G. Broyden, A class of methods for solving nonlinear simultaneous equations, Math. Comp. 19 (1965).

    Example:
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
        # The second leg may teach nothing that contradicts the first, however they cross.
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
        """The chosen elements in comparable numbers, ``(N, E)`` float64."""
        scale = torch.tensor(ELEMENT_SCALE, dtype=torch.float64, device=field.device)
        return (field.double() * scale)[:, self.elements]


def project(vector: Tensor, onto: Tensor) -> Tensor:
    """The part of a vector along another, ``(..., 2)``; zero along a zero vector, NaN where either is NaN.

    Example:
        >>> project(torch.tensor([3.0, 4.0]), torch.tensor([0.0, 2.0]))
        tensor([0., 4.])
    """
    check_tensor(2, vector=vector, onto=onto)
    square = onto.square().sum(-1, keepdim=True)
    return (vector * onto).sum(-1, keepdim=True) / torch.where(square > 0, square, 1.0) * onto


def _parallel(env: GeomagneticNavEnv, mode: str, seed: int) -> TensorDictModuleBase:  # noqa: ARG001
    return ParallelApproach(env.field, env.max_move_km, env.max_turn_rad)


def _secant(env: GeomagneticNavEnv, mode: str, seed: int) -> TensorDictModuleBase:  # noqa: ARG001
    return Secant(env.max_move_km, env.max_turn_rad, min(10.0, env.max_move_km))


NAVIGATORS: dict[str, Callable[[GeomagneticNavEnv, str, int], TensorDictModuleBase]] = {
    "parallel": _parallel,
    "secant": _secant,
}
"""By name: from an environment, a mode and a seed (which these two do without) to a navigator that fits it."""
