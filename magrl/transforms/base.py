"""Common base of the transforms: keys, errors, and the addition of an observation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, TypeVar

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

T = TypeVar("T")
Keys = Sequence[NestedKey]


class ObservationTransform(Transform):
    """Base class of transforms that write observations: they also run at reset, and on plain TensorDicts.

    A subclass computes the values at ``out_keys`` from those at ``in_keys`` in :meth:`_compute`. It names its keys in
    class attributes; without names, each key is its own name.

    Args:
        in_keys: keys that are read, in the order of the names; optional ones at the end may be left out.
        out_keys: keys that are written, in the same order.
        **inverse: ``in_keys_inv`` and ``out_keys_inv`` of an invertible transform.

    Raises:
        ValueError: for another number of keys.
        TypeError: for anything else than keys.

    Example:
        >>> import torch
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> class Degrees(ObservationTransform):
        ...     out_sizes = {"heading_deg": (1,)}
        ...     def _compute(self, values):
        ...         return [torch.rad2deg(values[0])]
        >>> env = TransformedEnv(GeomagneticNavEnv(seed=0), Degrees(in_keys=["heading"], out_keys=["heading_deg"]))
        >>> env.rollout(3)["heading_deg"].shape
        torch.Size([1, 3, 1])
    """

    default_in_keys: Keys = ()
    """Names of the keys that are read by default."""
    default_out_keys: ClassVar[Keys] = ()
    """Names of the keys that are written by default."""
    optional_in_keys: ClassVar[Keys] = ()
    """Names of keys that may be left out; those that are not default ones are read only where they are given."""
    optional_out_keys: ClassVar[Keys] = ()
    """The same of keys that are written."""
    in_sizes: Mapping[NestedKey, tuple[int, ...]] = {}
    """Last dimensions of the values by name; others may have any."""
    out_sizes: Mapping[NestedKey, tuple[int, ...]] = {}
    """Last dimensions of unbounded values that are written, by name: an environment needs them."""

    def __init__(self, in_keys: Keys | None = None, out_keys: Keys | None = None, **inverse: Any) -> None:
        self.in_names, ins = _chosen(in_keys, self.default_in_keys, self.optional_in_keys)
        self.out_names, outs = _chosen(out_keys, self.default_out_keys, self.optional_out_keys)
        super().__init__(in_keys=ins, out_keys=outs, **inverse)

    def _named(self, values: Sequence[T]) -> dict[NestedKey, T]:
        """Return values of ``in_keys`` by name."""
        return dict(zip(self.in_names, values, strict=True))

    def _write_named(self, tensordict: TensorDictBase, **values: Tensor) -> None:
        """Write values by the names of ``out_keys``."""
        keys = dict(zip(self.out_names, self.out_keys, strict=True))
        for name, value in values.items():
            tensordict.set(keys[name], value)

    def _compute(self, values: list[Tensor]) -> Sequence[Tensor]:
        """Return the values at ``out_keys``, given those at ``in_keys``."""
        raise NotImplementedError(f"{type(self).__name__} has no method _compute(values), which returns what it writes")

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._compute(self._read(next_tensordict))
        if isinstance(values, Tensor) or len(values) != len(self.out_keys):
            raise ValueError(f"{type(self).__name__}._compute must return a list, a tensor for each of {self.out_keys}")
        for key, value in zip(self.out_keys, values, strict=True):
            next_tensordict.set(key, value)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:  # noqa: ARG002
        return self._call(tensordict_reset)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Read ``in_keys`` and write ``out_keys`` of a TensorDict, with or without an environment."""
        return self._call(tensordict)

    def _read(self, tensordict: TensorDictBase, keys: Keys | None = None, *, state: bool = False) -> list[Tensor]:
        """Return the values at ``keys``, by default ``in_keys``."""
        checked, keys = keys is None, self.in_keys if keys is None else keys
        values = [tensordict.get(key, None) for key in keys]
        missing = [key for key, value in zip(keys, values, strict=True) if value is None]
        if not missing:
            if checked:
                for name, key, value in zip(self.in_names, keys, values, strict=True):
                    self._check_shape(name, key, value.shape)
            return values
        name, available = type(self).__name__, sorted_keys(tensordict)
        if not state:
            raise KeyError(f"{name} reads {missing}, which are not among {available}")
        raise KeyError(
            f"{name} reads its state {missing}, which a reset writes: step from what reset() or step_mdp() returned; "
            f"got {available}"
        )

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """Raise if an out_key is part of the environment's state: its next step would start from the written value.

        Raises:
            ValueError: naming the key.
        """
        state = input_spec["full_state_spec"]
        for key in self.out_keys:
            if state is not None and key in state.keys(True, True) and key not in self.in_keys_inv:
                raise ValueError(
                    f"{type(self).__name__} would overwrite {key!r}, which the environment reads back as its state: "
                    "write to another out_key"
                )
        return input_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Check the shapes that are read, and add what is written.

        Raises:
            KeyError: for a key that is missing.
            ValueError: for a value of another shape.
        """
        for name, key in self._named(self.in_keys).items():
            if name in self.in_sizes:
                self._check_shape(name, key, self._leaf(observation_spec, key).shape)
        for name, key in zip(self.out_names, self.out_keys, strict=True):
            if name in self.out_sizes:
                self._add(observation_spec, self._leaf(observation_spec, self.in_keys[0]), key, *self.out_sizes[name])
        return observation_spec

    def _check_shape(self, name: NestedKey, key: NestedKey, shape: torch.Size) -> None:
        """Raise unless the last dimensions of a value that is read agree with :attr:`in_sizes`."""
        size = self.in_sizes.get(name, ())
        if size and shape[-len(size) :] != size:
            hint = f": UnsqueezeTransform(-1, [{key!r}], [...]) of torchrl adds the dimension" * (size == (1,))
            wanted = ", ".join(map(str, size))
            raise ValueError(f"{type(self).__name__} reads {key!r} as (..., {wanted}), got {tuple(shape)}{hint}")

    def _load_from_state_dict(self, state_dict: Mapping[str, Any], prefix: str, *args: Any) -> None:
        """Load buffers that are not set yet, too."""
        for name, buffer in self._buffers.items():
            if buffer is None and prefix + name in state_dict:
                self._buffers[name] = torch.empty_like(state_dict[prefix + name])
        super()._load_from_state_dict(state_dict, prefix, *args)

    def _leaf(self, spec: Composite, key: NestedKey) -> TensorSpec:
        if key not in spec.keys(True):
            raise KeyError(f"{type(self).__name__} reads {key!r}, which is not among {sorted_keys(spec)}")
        return spec[key]

    @staticmethod
    def _add(spec: Composite, like: TensorSpec, key: NestedKey, *size: int, dtype: torch.dtype | None = None) -> None:
        """Add an unbounded key to a spec: its last dimensions follow the batch of another leaf."""
        spec[key] = Unbounded((*like.shape[:-1], *size), device=like.device, dtype=dtype or like.dtype)


class StatefulTransform(ObservationTransform):
    """Base class of transforms that carry a state from step to step.

    The state is in the TensorDict: it is reset by row, stored with the data, and resumed with them. A reset begins it,
    and each step reads it from the TensorDict before the step. A subclass names its keys in :attr:`state_keys`, writes
    it with everything else in :meth:`_begin` and :meth:`_advance`, and adds its specs, as in :attr:`out_sizes`.

    Example:
        >>> import torch
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> class Odometer(StatefulTransform):
        ...     state_keys, out_sizes = ["path_km"], {"path_km": (1,)}
        ...     def _begin(self, tensordict, values, mask):
        ...         tensordict["path_km"] = values[0][..., :1]
        ...     def _advance(self, tensordict, values, state):
        ...         tensordict["path_km"] = state[0] + values[0][..., :1]
        >>> env = TransformedEnv(GeomagneticNavEnv(seed=0), Odometer(in_keys=["leg"], out_keys=["path_km"]))
        >>> env.rollout(3, lambda td: td.set("action", torch.tensor([[30.0, 0.0]])))["next", "path_km"].flatten()
        tensor([30., 60., 90.])
    """

    @property
    def state_keys(self) -> Keys:
        """Keys that a step reads from the TensorDict before it: ``out_keys`` but the first, unless there are others."""
        return self.out_keys[1:]

    @property
    def step_keys(self) -> Keys:
        """Keys that a step reads from the TensorDict after it: ``in_keys``, unless some are read before it alone."""
        return self.in_keys

    def _begin(self, tensordict: TensorDictBase, values: list[Tensor], mask: Tensor | None) -> None:
        """Write the first state; ``mask`` names the rows that are reset, None all of them."""
        raise NotImplementedError

    def _advance(self, tensordict: TensorDictBase, values: list[Tensor], state: list[Tensor]) -> None:
        """Write the next state, given the values at ``step_keys`` after the step and the state before it."""
        raise NotImplementedError

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        self._begin(tensordict_reset, self._read(tensordict_reset), tensordict.get("_reset", None))
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self._read(next_tensordict, self.step_keys)
        self._advance(next_tensordict, values, self._state(tensordict))
        return next_tensordict

    def _state(self, tensordict: TensorDictBase) -> list[Tensor]:
        """Return the values at ``state_keys``."""
        return self._read(tensordict, self.state_keys, state=True)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Begin at a TensorDict of first values; on transitions, compute the step from the state at the root."""
        if tensordict.get("next", None) is None:
            return self._reset(tensordict, tensordict)
        self._step(tensordict, tensordict["next"])
        return tensordict

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Check that nothing before it writes its state, and add what is written.

        Raises:
            ValueError: for a key of the state that is there already, as from another transform of the same class.
        """
        for key in self.state_keys:
            if key in observation_spec.keys(True) and key not in self.in_keys:
                raise ValueError(
                    f"{type(self).__name__} keeps its state at {key!r}, which another transform or the environment "
                    "writes, too: merge two transforms of one class into one, or give one of them other keys"
                )
        return super().transform_observation_spec(observation_spec)

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """Make the state part of the input, so that batched and parallel environments pass it to the next step."""
        input_spec = super().transform_input_spec(input_spec)
        if not self.state_keys or self.parent is None:
            return input_spec
        observed = self.transform_observation_spec(observed_spec(self).clone())
        return with_state(input_spec, {key: self._leaf(observed, key) for key in self.state_keys})


class StepReward(StatefulTransform):
    """Base class of rewards that depend on values before a step and after it; a reset has none.

    A subclass writes ``out_keys`` in :meth:`_advance`: the reward, whose spec becomes unbounded, and its terms, which
    are observations of the same shape. A reward that the environment lacks has the shape ``(..., 1)``.

    Example:
        >>> from tensordict import TensorDict
        >>> import torch
        >>> class Climb(StepReward):
        ...     state_keys = ["height"]
        ...     def _advance(self, tensordict, values, state):
        ...         tensordict["reward"] = values[0] - state[0]
        >>> step = TensorDict(height=torch.tensor([5.0]), next=TensorDict(height=torch.tensor([7.0])))
        >>> Climb(in_keys=["height"], out_keys=["reward"])(step)["next", "reward"]
        tensor([2.])
    """

    default_out_keys = ("reward",)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        key = self.out_keys[0]
        before, after = next_tensordict.get(key, None), super()._step(tensordict, next_tensordict)
        return after if before is None else after.set(key, after[key].to(before.dtype))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:  # noqa: ARG002
        for key in self.out_keys[1:]:
            tensordict_reset.set(key, torch.zeros_like(tensordict_reset[self.in_keys[0]][..., :1]))
        return tensordict_reset

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the reward of transitions."""
        if tensordict.get("next", None) is None:
            raise KeyError(f"{type(self).__name__} needs transitions, with 'next', got {sorted_keys(tensordict)}")
        return super().forward(tensordict)

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
        """Remove the bounds of the reward, or add it."""
        key = self.out_keys[0]
        known = key in reward_spec.keys(True, True)
        like = reward_spec[key] if known else self._leaf(observed_spec(self), self.in_keys[0])
        self._add(reward_spec, like, key, 1)
        return reward_spec


def observed_spec(transform: Transform) -> Composite:
    """Return the observations that come before a transform; none without an environment.

    Example:
        >>> from torchrl.envs import CatTensors
        >>> len(observed_spec(CatTensors(["field"], "observation")).keys())
        0
    """
    parent = transform.parent
    return Composite() if parent is None else parent.full_observation_spec


def with_state(input_spec: Composite, state: Mapping[NestedKey, TensorSpec]) -> Composite:
    """Return an input spec whose state has further keys: batched and parallel environments pass them to a step.

    Example:
        >>> from torchrl.data import Unbounded
        >>> empty = Composite(full_state_spec=None, full_action_spec=None)
        >>> sorted(with_state(empty, {"displacement": Unbounded(2)})["full_state_spec"].keys())
        ['displacement']
    """
    input_spec = input_spec.clone()
    if input_spec["full_state_spec"] is None:
        input_spec["full_state_spec"] = Composite(shape=input_spec.shape, device=input_spec.device)
    for key, spec in state.items():
        input_spec["full_state_spec"][key] = spec.clone()
    return input_spec


def sorted_keys(container: TensorDictBase | Composite) -> list[str]:
    """Return the leaves of a TensorDict or a spec as sorted text, for messages.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> sorted_keys(TensorDict(leg=torch.zeros(2), next=TensorDict(heading=torch.zeros(1))))
        ["('next', 'heading')", 'leg']
    """
    return sorted(str(key) for key in container.keys(True, True))


def key_list(keys: Keys) -> list[NestedKey]:
    """Return keys as a list; a string is one key, a sequence of strings several ones, as in TorchRL.

    Raises:
        TypeError: for anything else.

    Example:
        >>> key_list("heading"), key_list(["heading", ("next", "leg")])
        (['heading'], ['heading', ('next', 'leg')])
    """
    keys = [keys] if isinstance(keys, str) else keys
    if not isinstance(keys, Sequence) or not all(isinstance(key, (str, tuple)) for key in keys):
        raise TypeError(f"keys must be a list of names or of nested names, got {keys!r}")
    return [unravel_key(key) for key in keys]


def _chosen(given: Keys | None, default: Keys, optional: Keys) -> tuple[list[NestedKey], list[NestedKey]]:
    """Return names and keys, of those that a user gives.

    Raises:
        ValueError: for another number of keys.
    """
    names, keys = list(dict.fromkeys((*default, *optional))), key_list(default if given is None else given)
    if default and not len(set(default) - set(optional)) <= len(keys) <= len(names):
        rest = f" ({', '.join(map(str, optional))} may be left out)" * bool(optional)
        raise ValueError(f"give keys in the order {', '.join(map(str, names))}{rest}, got {keys}")
    return (names if default else keys)[: len(keys)], keys
