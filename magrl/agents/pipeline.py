"""Export of a policy of any algorithm, with the transforms that it needs."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, expand_as_right, unravel_key
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode
from torchrl.envs import Compose, EnvBase, InitTracker, TensorDictPrimer, Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import GRUModule, LSTMModule, set_recurrent_mode
from torchrl.modules.utils import get_primers_from_module

from magrl.agents.exported import READ_KEYS, ExportedPolicy
from magrl.agents.program import trace_program
from magrl.checks import check_finite, check_type
from magrl.envs import PRIVILEGED_KEYS, GeomagneticNavEnv
from magrl.field import FieldBank
from magrl.transforms.base import StatefulTransform
from magrl.transforms.errors.base import EpisodeNumbers

Keys = set[NestedKey]
CHECKED_STEPS = 6
"""Steps of the flight on which an export is compared with the policy."""
CHECKED_VEHICLES = 16
"""Vehicles of that flight."""
TOLERANCE = 1e-4
"""Largest difference of their actions, relative or in km and rad: float32 operations in another order."""


def export_policy(actor: TensorDictModuleBase, env: EnvBase) -> ExportedPolicy:
    """Return a policy of any algorithm as a navigator of the plain environment, and compare both in flight.

    The export includes the transforms of the environment that the policy needs: from public keys to its observation,
    and from its action to kilometers and radians. Errors of sensors and of motion stay behind.
    Neither the policy nor the environment is changed. It includes the state, whether of the policy (an
    :class:`~torchrl.modules.LSTMModule`, or any ``key`` that it reads and writes as ``("next", key)``) or of a
    :class:`~magrl.transforms.base.StatefulTransform`, such as those of a :class:`~magrl.transforms.TrackView`.

    Args:
        actor: policy that was trained in the environment; a stochastic one acts by its deterministic sample.
        env: navigation environment of the training, with its transforms. Where it lacks an ``InitTracker`` or the first
            state, they are added.

    Raises:
        TypeError: for an actor that is no TensorDict module, or another environment.
        ValueError: for a policy that reads a privileged key, that PyTorch cannot export, or whose export does not act
            like it, such as one with a state outside the TensorDict.

    Example:
        >>> from tensordict.nn import TensorDictModule as Mod
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> act = Mod(lambda field, goal: (goal - field)[:, :2].sigmoid(), ["field", "target_field"], ["action"])
        >>> export_policy(act, env).in_keys
        ['field', 'target_field']
    """
    check_type(TensorDictModuleBase, actor=actor)
    base = getattr(env, "base_env", env)
    check_type(GeomagneticNavEnv, env=base)
    try:
        return _exported(copied(actor).to("cpu").eval(), copy.deepcopy(env).to("cpu"))
    except (ValueError, FloatingPointError) as error:
        raise ValueError(f"the policy cannot be exported: {error}") from error


class _Values(TorchFunctionMode):
    """Copy non-leaf tensors by value, which ``deepcopy`` rejects and modules of other libraries may contain."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is Tensor.__deepcopy__ and not args[0].is_leaf:
            return args[0].detach().clone()
        return func(*args, **(kwargs or {}))


def copied(actor: TensorDictModuleBase) -> TensorDictModuleBase:
    """Return a copy of a policy.

    Raises:
        ValueError: for a policy that cannot be copied, with the reason.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> copied(TensorDictModule(nn.Identity(), ["move"], ["action"])).in_keys
        ['move']
    """
    try:
        with _Values():
            return copy.deepcopy(actor)
    except Exception as error:  # whatever its parts raise
        raise ValueError(f"it cannot be copied ({error}): give the network alone, without what trains it") from error


def _exported(actor: TensorDictModuleBase, env: EnvBase) -> ExportedPolicy:
    """Return an export that acts like the policy in the environment, both of which may change."""
    with (
        torch.random.fork_rng(),
        torch.no_grad(),
        set_exploration_type(ExplorationType.DETERMINISTIC),
        set_recurrent_mode(False),
    ):
        env = _with_first_state(env, actor)
        parts = _transforms(env)
        for part in parts:
            if hasattr(part, "to_observation_norm"):  # running statistics
                part.freeze()
        start, base = env.reset(), getattr(env, "base_env", env)
        pipeline = _Pipeline(_traceable(copy.deepcopy(actor)), parts, start)
        first_state = [start[key][:1] for key in pipeline.state_keys]
        inputs = [start[key] for key in pipeline.in_keys]
        if first_state:
            inputs = [torch.ones_like(start["elapsed_steps"], dtype=torch.bool), *inputs, *first_state]
        program = trace_program(pipeline, inputs)
        view = None if isinstance(base.field, FieldBank) else base.observation_view()
        policy = ExportedPolicy(pipeline.in_keys, program, view, first_state, base.arrival.declared)
        steps = env.rollout(min(base.max_steps, CHECKED_STEPS), actor, break_when_any_done=False)
        _compare(policy, steps[:CHECKED_VEHICLES], pipeline.after)
    return policy


def _with_first_state(env: EnvBase, actor: TensorDictModuleBase) -> EnvBase:
    """Return an environment whose reset writes the first state of a policy, and ``is_init``."""
    start = env.reset()
    written, missing = set(start.keys(True, True)), [InitTracker()]
    if "is_init" in written or "is_init" not in _keys(actor.in_keys):
        missing.clear()
    if lacking := sorted(set(_policy_state(actor)) - written, key=str):
        primer = get_primers_from_module(actor, warn=False)
        if primer is None:
            raise ValueError(f"its state {lacking} has no first value: add a TensorDictPrimer to the environment")
        missing.append(primer)
    return TransformedEnv(env, Compose(*missing), auto_unwrap=True) if missing else env


def _policy_state(actor: TensorDictModuleBase) -> list[NestedKey]:
    """Return the keys that a policy reads and writes for the next step."""
    written = _keys(actor.out_keys)
    return [key for key in dict.fromkeys(map(unravel_key, actor.in_keys)) if unravel_key(("next", key)) in written]


def _transforms(env: EnvBase) -> list[Transform]:
    """Return the transforms from the plain environment outward, without errors, which are of the world."""
    skipped = (Compose, EpisodeNumbers, InitTracker, TensorDictPrimer)
    return [part for part in env.modules() if isinstance(part, Transform) and not isinstance(part, skipped)]


class _RecurrentStep(TensorDictModuleBase):
    """One step of a recurrent module of TorchRL, without its branches on values, which a trace cannot follow."""

    def __init__(self, module: LSTMModule | GRUModule) -> None:
        super().__init__()
        self.in_keys, self.out_keys = module.in_keys, module.out_keys
        self.layer = module.lstm if isinstance(module, LSTMModule) else module.gru

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        value, *state = (tensordict[key] for key in self.in_keys if key != "is_init")
        before = [part.transpose(0, 1).contiguous() for part in state]  # (layers, N, H)
        output, after = self.layer(value.unsqueeze(1), before[0] if len(before) == 1 else tuple(before))
        after = [after] if len(before) == 1 else after
        written = [output.squeeze(1), *(part.transpose(0, 1) for part in after)]
        for key, part in zip(self.out_keys, written, strict=True):
            tensordict[key] = part
        return tensordict


def _traceable(module: Any) -> Any:
    """Return a module whose recurrent parts can be traced."""
    if isinstance(module, (LSTMModule, GRUModule)):
        return _RecurrentStep(module)
    for name, part in list(module.named_children()):
        setattr(module, name, _traceable(part))
    return module


class _Pipeline(nn.Module):
    """Transforms that a policy needs, the policy, and the transforms of its action, over plain tensors."""

    def __init__(self, actor: TensorDictModuleBase, parts: Sequence[Transform], start: TensorDictBase) -> None:
        super().__init__()
        self.policy_state = _policy_state(actor)
        observed = _keys(actor.in_keys) - {*self.policy_state, "is_init"}
        before, needed = _leading_to(observed, reversed(parts), "out_keys", "in_keys")
        available = set(start.keys(True, True))
        for key in sorted(needed - (set(READ_KEYS) & available), key=str):
            raise ValueError(f"it reads {key!r}, {_reason(key, available)}; it may read {', '.join(READ_KEYS)}")
        keys = [unravel_key(key) for part in before if isinstance(part, StatefulTransform) for key in part.state_keys]
        self.transform_state = list(dict.fromkeys(keys))
        self.marks = "is_init" in _keys(actor.in_keys)
        needed = needed | ({"elapsed_steps"} if self.state_keys or self.marks else set())
        self.in_keys = [key for key in READ_KEYS if key in needed]
        fixed = (part.to_observation_norm() if hasattr(part, "to_observation_norm") else part for part in before)
        self.before, self.actor = nn.ModuleList(fixed), actor
        self.first = [start[key][:1] for key in self.policy_state]
        self.after = nn.ModuleList(_leading_to({"action"}, parts, "in_keys_inv", "out_keys_inv")[0])
        for module in self.modules():  # a switch in a buffer, as that of ObservationNorm, is no constant to a trace
            for name, switch in list(module.named_buffers(recurse=False)):
                if switch.dtype == torch.bool and not switch.ndim:
                    delattr(module, name)
                    setattr(module, name, bool(switch))

    @property
    def state_keys(self) -> list[NestedKey]:
        """Keys of the state of the policy and of the transforms."""
        return [*self.policy_state, *self.transform_state]

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        starts = inputs[0] if self.state_keys else None
        values = inputs if starts is None else inputs[1:]
        state = dict(zip(self.state_keys, values[len(self.in_keys) :], strict=True))
        seen = TensorDict(dict(zip(self.in_keys, values, strict=False)), batch_size=inputs[0].shape[:1])
        acted = self.actor(self._observed(seen, starts, state))
        after = *(acted["next", key] for key in self.policy_state), *(acted[key] for key in self.transform_state)
        return _physical_action(acted, self.after), *after

    def _observed(self, seen: TensorDictBase, starts: Tensor | None, state: dict[NestedKey, Tensor]) -> TensorDictBase:
        """Return what the policy observes, with its state."""
        for part in self.before:
            first = part(seen.copy())
            if isinstance(part, StatefulTransform) and part.state_keys and starts is not None:
                before = TensorDict({key: state[unravel_key(key)] for key in part.state_keys}, seen.batch_size)
                moved = part._step(before, seen.copy())
                for key in part.out_keys:
                    first[key] = _where(starts, first[key], moved[key])
            seen = first
        if starts is None and self.marks:
            starts = seen["elapsed_steps"] == 0
        if starts is not None:
            for key, value in zip(self.policy_state, self.first, strict=True):
                seen[key] = _where(starts, value, state[key])
            seen["is_init"] = starts
        return seen


def _where(starts: Tensor, first: Tensor, later: Tensor) -> Tensor:
    """Return one value for the vehicles whose episode starts ``(N, 1)``, and another for the others."""
    return torch.where(expand_as_right(starts.squeeze(-1), later), first, later)


def _leading_to(needed: Keys, parts: Iterable[Transform], written: str, read: str) -> tuple[list[Transform], Keys]:
    """Return the transforms that compute some keys, in the order in which they act, and the keys that they start from.

    Args:
        needed: keys to compute.
        parts: transforms, from the last to act to the first.
        written: attribute that holds the keys that a transform writes.
        read: attribute that holds the keys that it reads.
    """
    chain: list[Transform] = []
    for part in parts:
        writes = _keys(getattr(part, written))
        if needed & writes:
            needed = needed - writes | _keys(getattr(part, read))
            chain.insert(0, part)
    return chain, needed


def _physical_action(acted: TensorDictBase, transforms: Iterable[Any]) -> Tensor:
    """Return the action of the environment, by the inverse transforms of the action of a policy."""
    for part in transforms:
        acted = part.inv(acted)
    return acted["action"]


def _reason(key: NestedKey, available: Keys) -> str:
    """Return why a policy cannot read a key."""
    if key in PRIVILEGED_KEYS:
        return "which a vehicle that navigates by the field does not know"
    return "which the plain environment does not have" if key in available else "which no transform writes"


def _keys(keys: Any) -> Keys:
    return {unravel_key(key) for key in keys or ()}


def _compare(policy: ExportedPolicy, steps: TensorDictBase, after: Iterable[Any]) -> None:
    """Raise unless a policy acts as in a rollout of the environment with its transforms.

    The policy acts on one vehicle at a time, in the order of its steps, so that its action depends on nothing else.

    Args:
        policy: exported policy.
        steps: ``(N, T)`` from the first step of an episode on.
        after: transforms of the action.
    """
    check_finite([("action", steps["action"])], "the policy")
    wanted = _physical_action(steps.clone(), after)
    singles = steps.select(*policy.in_keys, strict=False).reshape(-1).split(1)
    got = torch.cat([policy(single)["action"] for single in singles]).view_as(wanted)
    differ = ~torch.isclose(got, wanted.to(got.dtype), TOLERANCE, TOLERANCE)
    if differ.any():
        raise ValueError(
            f"its export acts differently: from step {differ.any(-1).any(0).int().argmax()} on the actions "
            f"differ by up to {(got - wanted).abs().flatten(0, 1).amax(0).tolist()} (km, rad). The policy and its "
            "transforms must depend on their in_keys and their state in the TensorDict, and on one vehicle only"
        )
