"""Functions of arrays as policies, whose state is in the TensorDict."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.utils._pytree import tree_flatten, tree_unflatten
from torchrl.envs import EnvBase, Transform

from magrl.checks import short
from magrl.navigators import Navigator
from magrl.navigators.base import MEMORY, memory_primer

Act = Callable[[NDArray[np.float32], Any, NDArray[np.bool_]], tuple[Any, Any]]
"""From observations, state, and whether episodes start, to actions and the next state."""


class ArrayPolicy(Navigator):
    """A function of arrays as a policy, which gets the observation and the state that it returned before.

    Args:
        act: function; its state is None at the start of an episode, then arrays ``(N, ...)`` or a tree of them.

    Raises:
        ValueError: for actions or a state of another shape.

    Example:
        >>> from magrl.envs.navigation import navigation_env
        >>> from magrl.navigators import policy_env
        >>> def act(observations, state, first):
        ...     steps = np.zeros((len(observations), 1)) if state is None else state
        ...     return np.concatenate((steps / 10, 0 * steps), 1), steps + 1
        >>> env, policy = navigation_env(2, seed=0), ArrayPolicy(act)
        >>> policy_env(env, policy).rollout(3, policy)["action"][0, :, 0]
        tensor([0.0000, 0.1000, 0.2000])
    """

    in_keys = ("observation", "elapsed_steps")

    def __init__(self, act: Act) -> None:
        super().__init__()
        self.act = act
        self._form: tuple[list[bool], Any] = [], None  # of a state: which of its arrays are tensors, and their tree

    def transforms(self, env: EnvBase, **rules: Any) -> list[Transform]:  # noqa: ARG002
        """Return the memory of its state, if it has one, in the form of that after a first step of zeros."""
        observed = env.observation_spec.zero()
        _, state = self._called(observed["observation"], None)
        return [memory_primer(state, env)] if state and MEMORY not in observed else []

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action and the next state; vehicles that start an episode are a batch of their own."""
        first = tensordict["elapsed_steps"].squeeze(-1) == 0
        rows = [mask.nonzero().squeeze(-1) for mask in (first, ~first) if mask.any()]
        parts = torch.cat([self._acted(tensordict[part], first=bool(first[part[0]])) for part in rows])
        return tensordict.update(parts[torch.cat(rows).argsort()])

    def _acted(self, tensordict: TensorDictBase, *, first: bool) -> TensorDict:
        """Return the actions and the next state of vehicles that all start an episode, or all go on."""
        memory = None if first else tensordict.get(MEMORY, None)
        action, state = self._called(tensordict["observation"], memory)
        return TensorDict({"action": action, **({"next": {MEMORY: state}} if state else {})}, [len(action)])

    def _called(self, seen: Tensor, memory: TensorDictBase | None) -> tuple[Tensor, dict[str, Tensor]]:
        """Return actions ``(N, A)`` and the arrays ``(N, ...)`` of the next state by their number."""
        count = len(seen)
        given = None if memory is None else self._state(memory)
        actions, state = self.act(np.array(seen.cpu().numpy()), given, np.full(count, memory is None))
        arrays, tree = ([], None) if state is None else tree_flatten(state)
        self._form = [isinstance(array, Tensor) for array in arrays], tree
        rows = {str(number): _rows(array, count) for number, array in enumerate(arrays)}
        return _checked(actions, count).to(seen.device), rows

    def _state(self, memory: TensorDictBase) -> Any:
        """Return a state in the form that the function returned it."""
        tensors, tree = self._form
        rows = (memory[str(number)] for number in range(len(tensors)))
        return tree_unflatten([a if tensor else a.numpy() for a, tensor in zip(rows, tensors, strict=True)], tree)


def _checked(actions: Any, count: int) -> Tensor:
    """Return actions as float32; raise unless they are finite numbers ``(count, 2)`` or ``(count, 3)``."""
    array = np.asarray(actions)
    sound = array.shape in [(count, 2), (count, 3)] and array.dtype.kind in "fiu"
    with np.errstate(over="ignore"):
        rounded = array.astype(np.float32) if sound else array
    if not sound or not np.isfinite(rounded).all():
        wanted = f"finite numbers of shape ({count}, 2), a vehicle per row"
        raise ValueError(f"actions must be {wanted}, got {array.dtype} {array.shape}: {short(array.tolist())}")
    return torch.from_numpy(rounded)


def _rows(array: Any, count: int) -> Tensor:
    """Return an array of a state as a tensor ``(count, ...)``; raise for another layout."""
    shape = tuple(getattr(array, "shape", ()))
    if shape[:1] != (count,):
        got = f"the shape {shape}" if shape else short(array)
        raise ValueError(
            f"a state must be None or hold arrays with the {count} vehicles on the first axis, got {got}: of (layers, "
            "N, ...), return state.movedim(1, 0), and take state.movedim(0, 1).contiguous()"
        )
    return torch.as_tensor(array)
