"""Policies of any algorithm as navigators of the plain environment: a program, and a state from step to step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase

from magrl.agents.program import TensorProgram
from magrl.checks import check_type
from magrl.envs import PUBLIC_KEYS, GeomagneticNavEnv
from magrl.sensor_std import STD_KEYS
from magrl.transforms import ObservationView

EXAMPLES = {key: torch.zeros(1, size) for key, size in zip(PUBLIC_KEYS, (3, 3, 2, 1), strict=True)}
EXAMPLES |= {key: torch.zeros(1, 3) for key in STD_KEYS} | {"elapsed_steps": torch.zeros(1, 1, dtype=torch.int64)}
"""A value of each key of the plain environment that a policy may read, for traces: ``(1, ...)`` zeros."""
READ_KEYS = tuple(EXAMPLES)
"""Keys of the plain environment that an exported policy may read."""


class TrainedPolicy(TensorDictModuleBase):
    """Base class of trained policies: from public keys of the plain environment to an action in km and rad."""

    out_keys: ClassVar[list[str]] = ["action"]
    view: Any
    """What the policy observes, with the range of the field where it was trained, if it was trained in one region."""
    declares = False
    """Whether its action has a third number, which declares the arrival."""
    state_keys: Sequence[str] = ()
    """Keys of the state that it keeps for each vehicle from step to step."""
    state: TensorDictBase | None = None
    """State after the last call, with the state before it; None before the first call."""

    def for_env(self, env: EnvBase) -> TrainedPolicy:
        """Return the policy for the limits of an environment.

        Raises:
            ValueError: as :meth:`check_fits`.
        """
        self.check_fits(env)
        return self

    def check_fits(self, env: EnvBase) -> None:
        """Raise unless an environment has the field of the policy, and allows its moves and declarations.

        Args:
            env: navigation environment, with transforms or without.

        Raises:
            ValueError: naming the element and both ranges, or both limits; or for a policy that declares its arrival,
                where the episode ends otherwise.
        """
        env = getattr(env, "base_env", env)
        check_type(GeomagneticNavEnv, env=env)
        if self.declares and not env.arrival.declared:
            raise ValueError(
                f"the policy declares its arrival: fly it with arrival 'declared', not {env.arrival.rule!r}"
            )
        if isinstance(self.view, ObservationView):
            self.view.check_covers(env.field, env.region.grid(81).to(env.device))

    def _state_before(self, seen: TensorDictBase) -> tuple[TensorDictBase | None, Tensor]:
        """Return the state before a step and a mask of new episodes ``(..., 1)``; repeated calls return the same."""
        stored, starts = self.state, seen["elapsed_steps"] == 0
        if stored is None or stored.shape != seen.shape or stored.device != seen.device:
            return None, torch.ones_like(starts)
        again = stored["step"] == seen["elapsed_steps"]
        before = torch.where(again.squeeze(-1), stored["before"], stored.select(*self.state_keys))
        return before, starts | (again & stored["starts"])

    def _keep_state(
        self, seen: TensorDictBase, before: TensorDictBase | None, starts: Tensor, state: TensorDictBase
    ) -> None:
        """Store the state for the next step, and the state before this one."""
        begun = {"step": seen["elapsed_steps"].clone(), "starts": starts, "before": state if before is None else before}
        self.state = state.clone(recurse=False).update(begun)


class ExportedPolicy(TrainedPolicy):
    """A trained policy of any algorithm, from the keys of the plain environment to an action in km and rad.

    :func:`~magrl.agents.export_policy` makes one. It acts without exploration. A policy with a state keeps it for each
    vehicle, as :class:`~magrl.agents.FieldPolicy` does.

    Args:
        in_keys: public keys that it reads. A standard deviation that the environment does not state is 0.
        program: from their values ``(N, ...)`` to the action ``(N, 2)`` or ``(N, 3)``. With a state: from ``(N, 1)``
            bool, which is True where an episode starts, their values, and the state to the action and the next state.
        view: range of the field in the region of the training; None for a policy of many regions.
        first_state: tensors ``(1, ...)`` of the shapes of the state; none for a policy without one.
        declares: whether the action has a third number, which declares the arrival.

    Raises:
        TypeError: for arguments of another type.
        ValueError: for a key that is not public, or a program of another number of inputs and outputs.

    Example:
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> halves = TensorProgram(1, [["mul.Tensor", [{"value": 0}, 0.5], {}]], [], [1])
        >>> env.rollout(3, ExportedPolicy(["move"], halves))["action"].shape
        torch.Size([2, 3, 2])
    """

    def __init__(
        self,
        in_keys: Sequence[str],
        program: TensorProgram,
        view: ObservationView | None = None,
        first_state: Sequence[Tensor] = (),
        declares: bool = False,
    ) -> None:
        super().__init__()
        check_type((list, tuple), in_keys=in_keys, first_state=first_state)
        check_type(TensorProgram, program=program)
        check_type((ObservationView, type(None)), view=view)
        check_type(bool, declares=declares)
        states = {f"state_{index}": tensor for index, tensor in enumerate(first_state)}
        check_type(Tensor, **states)
        if not in_keys or not all(key in READ_KEYS for key in in_keys):
            raise ValueError(f"in_keys must be among {', '.join(READ_KEYS)}, got {in_keys}")
        if states and "elapsed_steps" not in in_keys:
            raise ValueError(f"a policy with a state must read elapsed_steps, got {in_keys}")
        inputs = len(in_keys) + len(states) + bool(states)
        if (program.num_inputs, len(program.outputs)) != (inputs, 1 + len(states)):
            raise ValueError(
                f"a program for {len(in_keys)} keys and {len(states)} tensors of state must take {inputs} inputs and "
                f"return the action and the state, got {program.num_inputs} inputs and {len(program.outputs)} outputs"
            )
        self.in_keys, self.program, self.view = list(in_keys), program, view
        self.first_state, self.state_keys, self.declares = list(first_state), tuple(states), declares
        starts = [torch.ones(1, 1, dtype=torch.bool)] if states else []
        program.check_size(*starts, *(EXAMPLES[key] for key in self.in_keys), *self.first_state)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` ``(..., 2)``: distance [km] and turn [rad]; or ``(..., 3)`` with the declaration."""
        seen = tensordict.select(*self.in_keys, strict=False)
        for key in set(STD_KEYS) & set(self.in_keys) - set(seen.keys()):
            seen[key] = torch.zeros(*seen.shape, 3, device=seen.device)
        flat = seen.reshape(-1)
        values = [flat[key] for key in self.in_keys]
        if not self.state_keys:
            (action,) = self.program(*values)
            return tensordict.set("action", action.reshape(*seen.shape, -1))
        before, starts = self._state_before(seen)
        if before is None:
            begun = (tensor.to(starts.device).expand(len(flat), *tensor.shape[1:]) for tensor in self.first_state)
        else:
            begun = (before.reshape(-1)[key] for key in self.state_keys)
        action, *after = self.program(starts.reshape(-1, 1), *values, *begun)
        state = TensorDict(dict(zip(self.state_keys, after, strict=True)), flat.shape, device=seen.device)
        self._keep_state(seen, before, starts, state.reshape(seen.shape))
        return tensordict.set("action", action.reshape(*seen.shape, -1))

    def content(self) -> dict[str, Any]:
        """Return the content of the policy file: numbers, text and tensors."""
        content = {name: getattr(self, name) for name in ("in_keys", "first_state", "declares")}
        view = None if self.view is None else asdict(self.view)
        return {**content, "view": view, "program": self.program.content()}


def rebuild(exported: Any) -> ExportedPolicy:
    """Return a policy from its :meth:`ExportedPolicy.content`.

    Raises:
        KeyError, TypeError, ValueError, FloatingPointError: naming what is wrong.

    Example:
        >>> halves = TensorProgram(1, [["mul.Tensor", [{"value": 0}, 0.5], {}]], [], [1])
        >>> rebuild(ExportedPolicy(["move"], halves).content()).in_keys
        ['move']
    """
    view = exported["view"] and ObservationView(**exported["view"])
    return ExportedPolicy(**{**exported, "view": view, "program": TensorProgram(**exported["program"])})
