"""Base class of navigators (policies without training), and what they share.

A navigator reads keys of the plain :class:`magrl.envs.GeomagneticNavEnv` in physical units and writes ``action``
``(N, 2)``: distance [km] and turn [rad]. A navigator that reads privileged keys, or the field at places where the
vehicle has not been, has ``oracle = True``; ``needs`` states what it knows beside its own readings.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Self

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from magrl.checks import check_number
from magrl.envs import GeomagneticNavEnv
from magrl.field.elements import element_index
from magrl.sensor_std import PERFECT, STD_KEYS, SensorStd


def displacement_to(error: Tensor, jacobian: Tensor) -> Tensor:
    """Return the displacement that closes an error in the elements, by least squares.

    Args:
        error: ``(..., E)`` target elements minus measured elements, in comparable units.
        jacobian: ``(..., E, 2)`` change of the elements, in the same units per km north and east.

    Returns:
        ``(..., 2)`` north, east [km]; finite for singular equations. NaN in gives NaN out.

    Example:
        >>> displacement_to(torch.tensor([2.0, 1.0]), torch.tensor([[0.0, 0.1], [0.5, 0.0]]))
        tensor([ 2., 20.])
    """
    wide, sides = jacobian.double(), error.double().unsqueeze(-1)  # the normal equations halve the digits
    normal, right = wide.mT @ wide, (wide.mT @ sides).squeeze(-1)
    ridge = 1e-12 * normal.diagonal(dim1=-2, dim2=-1).sum(-1) + 1e-30
    a, b, c = normal[..., 0, 0] + ridge, normal[..., 0, 1], normal[..., 1, 1] + ridge
    north, east = right.unbind(-1)
    solved = torch.stack((c * north - b * east, a * east - b * north), -1) / (a * c - b * b).unsqueeze(-1)
    return solved.to(error.dtype)


def element_indices(elements: Sequence[str], least: int) -> list[int]:
    """Return the columns of ``field`` that hold some elements.

    Raises:
        ValueError: for an unknown name, a repeated name, or fewer than ``least`` names.

    Example:
        >>> element_indices(("D", "B_H"), least=2)
        [0, 2]
    """
    if isinstance(elements, str) or len(set(elements)) != len(elements) or len(elements) < least:
        raise ValueError(f"elements must be at least {least} different names of D, I, B_H, got {elements!r}")
    return [element_index(name) for name in elements]


class Navigator(TensorDictModuleBase):
    """Base class of untrained policies: action bounds, and a memory of each vehicle for the length of an episode.

    A subclass sets its ``in_keys``, returns the memory at the start of an episode (``elapsed_steps`` 0) in
    :meth:`first_memory`, and chooses the next leg in :meth:`decide`. :meth:`decide` is called once for each step of a
    vehicle, so that calling the navigator twice on one state changes nothing; if ``done`` is among the ``in_keys``, it
    is not called after the end of an episode. With the class attributes below, and a place in the list of
    :data:`magrl.navigators.NAVIGATORS`, commands, tables and figures know it by its name.

    Args:
        max_move_km: longest leg [km].
        max_turn_rad: largest turn [rad].

    Raises:
        ValueError: for a bound out of its range.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from magrl.geodesy import steer
        >>> class DueEast(Navigator):
        ...     def __init__(self):
        ...         super().__init__(max_move_km=50.0, max_turn_rad=math.pi / 2)
        ...         self.in_keys = ["heading", "elapsed_steps"]
        ...
        ...     def decide(self, seen, memory):
        ...         heading = seen["heading"].squeeze(-1)
        ...         east, way = torch.full_like(heading, math.pi / 2), torch.full_like(heading, 30.0)
        ...         return steer(heading, east, way, self.max_move_km, self.max_turn_rad)
        >>> GeomagneticNavEnv(num_envs=1, seed=0).rollout(2, DueEast())["action"].round(decimals=2)
        tensor([[[30.0000,  1.5700],
                 [30.0000,  0.0000]]])
    """

    name: str
    """Name in commands."""
    label: str
    """Label in figures."""
    description: str
    """Label in tables."""
    oracle: bool = False
    """Whether the navigator reads privileged keys, or the field where the vehicle has not been."""
    needs: str = "nothing"
    """What it needs beside its readings and the standard deviations of the sensors, such as ``"the position"``."""
    trained_on: str = "nothing"
    """What it was trained on."""
    optional_keys: ClassVar[tuple[str, ...]] = STD_KEYS
    """Keys that :meth:`decide` reads where an environment has them."""
    action_size = 2
    """Numbers of the action: 3 with a declaration of the arrival."""
    options: tuple[str, ...] = ()
    """Further options of :meth:`for_env` that a command has: ``seed``."""

    def __init__(self, max_move_km: float = 50.0, max_turn_rad: float = math.pi / 2) -> None:
        super().__init__()
        check_number(0, above=True, max_move_km=max_move_km)
        check_number(0, math.pi, above=True, max_turn_rad=max_turn_rad)
        self.max_move_km, self.max_turn_rad = float(max_move_km), float(max_turn_rad)
        self.out_keys = ["action"]
        self.memory: TensorDictBase | None = None
        self._remembers = False

    @property
    def declares(self) -> bool:
        """Whether its action has a third number, which declares the arrival."""
        return self.action_size > 2

    @classmethod
    def for_env(
        cls, env: GeomagneticNavEnv, *, sensor_std: SensorStd | Sequence[float] = PERFECT, **options: Any
    ) -> Self:
        """Return the navigator of an environment.

        Args:
            env: environment to navigate in.
            sensor_std: accuracy of the sensors; three numbers are white noise of D [deg], I [deg], B_H [nT].
            options: further options of the class.

        Raises:
            ValueError: for an option out of its range, or an environment that the navigator cannot navigate in.
        """
        return cls(**cls.bounds(env) | cls.env_options(env, SensorStd.of(sensor_std)) | options)

    @staticmethod
    def bounds(env: GeomagneticNavEnv) -> dict[str, Any]:
        """Return the limits of an environment as the constructor names them."""
        return {"max_move_km": env.max_move_km, "max_turn_rad": env.max_turn_rad}

    @staticmethod
    def env_options(env: GeomagneticNavEnv, sensor_std: SensorStd) -> dict[str, Any]:  # noqa: ARG004
        """Return the options of the constructor, beside bounds, that follow from an environment and its sensors."""
        return {}

    def check_fits(self, env: EnvBase) -> None:
        """Raise a ValueError where an environment is none that it was made for."""

    def fitted(self, env: GeomagneticNavEnv, rules: Mapping[str, Any]) -> Navigator:  # noqa: ARG002
        """Return it for an environment, with rules of :class:`~magrl.tracking.Rules` that say what a vehicle knows."""
        self.check_fits(env)
        return self

    def first_memory(self, seen: TensorDictBase) -> dict[str, Tensor]:  # noqa: ARG002
        """Return the memory of vehicles at the start of an episode: tensors ``(N, ...)``; none by default."""
        return {}

    def decide(self, seen: TensorDictBase, memory: TensorDictBase) -> tuple[Tensor, Tensor] | Tensor:
        """Return distance [km] and turn [rad], each ``(P,)``, of vehicles in a new state, and update their memory; or
        the whole action ``(P, A)``."""
        raise NotImplementedError

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` ``(N, 2)``: distance [km] and turn [rad]; with a declaration, ``(N, 3)``."""
        seen = tensordict.select(*self.in_keys).update(tensordict.select(*self.optional_keys, strict=False))
        self.memory = memory = self._recall(seen)
        step = seen["elapsed_steps"].squeeze(-1)
        if "done" in self.in_keys:  # a rollout steps all vehicles until the last one is done
            memory["over"] = memory["over"] | seen["done"].squeeze(-1)
            memory["action"] = torch.where(memory["over"].unsqueeze(-1), 0.0, memory["action"])
        mark = _mark(seen.select(*self.in_keys).exclude("done"))
        repeated = (step == memory["decided_at"]) & (mark == memory["mark"]).all(-1)
        if self._remembers and (~repeated & ~memory["over"] & (memory["decided_at"] >= step)).any():
            raise RuntimeError(f"{self.label} remembers other vehicles: each environment needs a navigator of its own")
        rows = (~repeated & ~memory["over"]).nonzero().squeeze(-1)
        if len(rows):
            part = memory[rows]
            chosen = self.decide(seen[rows], part)
            action = chosen if isinstance(chosen, Tensor) else torch.stack(chosen, -1)
            part["action"] = action.to(part["action"].dtype)
            part["decided_at"], part["mark"] = step[rows], mark[rows]
            memory[rows] = part
        for key in self.out_keys:
            tensordict.set(key, memory[key].clone())
        return tensordict

    def _recall(self, seen: TensorDictBase) -> TensorDictBase:
        """Return the memory of the batch, reset where an episode starts."""
        step, memory = seen["elapsed_steps"].squeeze(-1), self.memory
        known = memory is not None and memory.shape == step.shape and memory.device == step.device
        if memory is not None and known and not (step == 0).any():
            return memory
        common = {"action": torch.zeros(len(step), self.action_size, dtype=torch.float32, device=step.device)}
        common |= {"decided_at": torch.full_like(step, -1), "field_readings": torch.zeros_like(step)}
        common |= {"over": torch.zeros_like(step, dtype=torch.bool)}
        common |= {"mark": torch.zeros_like(_mark(seen.select(*self.in_keys).exclude("done")))}
        own = self.first_memory(seen)
        self._remembers = bool(own)
        first = TensorDict(own | common, batch_size=step.shape, device=step.device)
        return torch.where(step == 0, first, memory) if memory is not None and known else first

    @property
    def field_readings(self) -> Tensor:
        """``(N,)`` int64: readings of the field in this episode at places where the vehicle has not been."""
        return torch.zeros(0, dtype=torch.int64) if self.memory is None else self.memory["field_readings"]


def _mark(seen: TensorDictBase) -> Tensor:
    """Return all that vehicles see ``(N, K)``, by which a second call for one step is told from another batch."""
    return torch.cat([value.double().flatten(1) for value in seen.values(True, True)], -1).nan_to_num()
