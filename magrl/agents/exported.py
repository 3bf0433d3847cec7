"""Policies of any algorithm as navigators of the plain environment, with the transforms that they need."""

from __future__ import annotations

import copy
import io
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.envs import Compose, EnvBase, InitTracker, TensorDictPrimer, Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from magrl.agents.program import TensorProgram, export_module, trace_program
from magrl.checks import check_finite, check_type
from magrl.envs import PRIVILEGED_KEYS, PUBLIC_KEYS, GeomagneticNavEnv
from magrl.transforms import ObservationView
from magrl.transforms.errors.base import EpisodeErrors

READ_KEYS = (*PUBLIC_KEYS, "step_count")
"""Keys of the plain environment that an exported policy may read."""
_DTYPES = {"step_count": torch.int64}
_SIZES = {"field": 3, "target_field": 3, "move": 2, "heading": 1, "step_count": 1}
CHECKED_STEPS = 6
"""Steps of the flight on which an export is compared with the policy."""
TOLERANCE = 1e-4
"""Largest difference of their actions, relative or in km and rad: float32 operations in another order."""


class ExportedPolicy(TensorDictModuleBase):
    """A trained policy of any algorithm, from the keys of the plain environment to an action in km and rad.

    :func:`export_policy` makes one. It acts without exploration and keeps no state from step to step.

    Args:
        in_keys: public keys that it reads.
        program: from their values ``(N, ...)`` to the action ``(N, 2)``.
        view: range of the field in the region of the training; None for a policy of many regions.

    Raises:
        TypeError: for arguments of another type.
        ValueError: for a key that is not public, or a program of another number of inputs and outputs.

    Example:
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> halves = TensorProgram(1, [["mul.Tensor", [{"value": 0}, 0.5], {}]], [], [1])
        >>> env.rollout(3, ExportedPolicy(["move"], halves))["action"].shape
        torch.Size([2, 3, 2])
    """

    out_keys: ClassVar[list[str]] = ["action"]

    def __init__(self, in_keys: Sequence[str], program: TensorProgram, view: ObservationView | None = None) -> None:
        super().__init__()
        check_type((list, tuple), in_keys=in_keys)
        check_type(TensorProgram, program=program)
        check_type((ObservationView, type(None)), view=view)
        if not in_keys or not all(key in READ_KEYS for key in in_keys):
            raise ValueError(f"in_keys must be among {', '.join(READ_KEYS)}, got {in_keys}")
        if (program.num_inputs, len(program.outputs)) != (len(in_keys), 1):
            raise ValueError(
                f"a program for {len(in_keys)} keys must take that many inputs and return the action, got "
                f"{program.num_inputs} inputs and {len(program.outputs)} outputs"
            )
        self.in_keys, self.program, self.view = list(in_keys), program, view

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action`` ``(..., 2)``: distance [km] and turn [rad]."""
        seen = tensordict.select(*self.in_keys).reshape(-1)
        (action,) = self.program(*(seen[key] for key in self.in_keys))
        return tensordict.set("action", action.reshape(*tensordict.shape, -1))

    def check_fits(self, env: GeomagneticNavEnv) -> None:
        """Raise unless the field of an environment is within what the policy was trained in.

        Raises:
            ValueError: naming the element and both ranges.
        """
        check_fits(self.view, env)

    def write_torch(self, path: Path | str) -> None:
        """Write a file for :func:`torch.export.load`, which acts without magrl and TorchRL.

        Its module takes the values of ``in_keys`` in their order, ``(N, ...)`` each, and returns a tuple of the action.
        PyTorch reads such a file with pickle: load it only from a source that you trust.

        Args:
            path: path of the file, ``.pt2``.

        Raises:
            ValueError: for another suffix.
            OSError: if it cannot be written.
        """
        if Path(path).suffix != ".pt2":
            raise ValueError(f"a file for torch.export.load must end with .pt2, got {str(path)!r}")
        examples = [torch.zeros(1, _SIZES[key], dtype=_DTYPES.get(key, torch.float32)) for key in self.in_keys]
        file = io.BytesIO()
        torch.export.save(export_module(copy.deepcopy(self.program).cpu(), examples), file)
        Path(path).write_bytes(file.getvalue())

    def content(self) -> dict[str, Any]:
        """Return all that rebuilds the policy as numbers, text and tensors on the CPU."""
        view = None if self.view is None else asdict(self.view)
        return {"in_keys": self.in_keys, "view": view, "program": self.program.content()}


def rebuild(content: Any) -> ExportedPolicy:
    """Return a policy from its :meth:`ExportedPolicy.content`.

    Raises:
        TypeError, ValueError, FloatingPointError: naming what is wrong.

    Example:
        >>> rebuild({"in_keys": ["move"]})
        Traceback (most recent call last):
        ValueError: an exported policy must hold exactly in_keys, program, view
    """
    parts = {"in_keys", "program", "view"}
    if not isinstance(content, dict) or set(content) != parts:
        raise ValueError(f"an exported policy must hold exactly {', '.join(sorted(parts))}")
    check_type(dict, program=content["program"])
    view = content["view"] and ObservationView(**content["view"])
    return ExportedPolicy(content["in_keys"], TensorProgram(**content["program"]), view)


def check_fits(view: ObservationView | None, env: GeomagneticNavEnv) -> None:
    """Raise unless the field of an environment is within the range of the region that an agent was trained in.

    Args:
        view: range of that region; None for an agent of no region.
        env: environment to fly in.

    Raises:
        ValueError: naming the element and both ranges.

    Example:
        >>> env = GeomagneticNavEnv(seed=0)
        >>> check_fits(env.observation_view(), env)
    """
    check_type(GeomagneticNavEnv, env=env)
    if view is not None:
        if len(env.region) > 1:
            raise ValueError(f"the policy was trained in one region, and cannot fly in {len(env.region)} regions")
        view.check_covers(env.field, env.region.grid(81).to(env.device))


def export_policy(actor: TensorDictModuleBase, env: EnvBase) -> ExportedPolicy:
    """Return a policy of any algorithm as a navigator of the plain environment, and compare both in flight.

    Of the transforms of the environment, those are taken along that the policy needs: they lead from public keys to
    what it observes, and from its action to kilometers and radians. Errors of sensors and of motion stay behind.
    Neither the policy nor the environment is changed.

    Args:
        actor: policy that was trained in the environment; a stochastic one acts by its deterministic sample.
        env: navigation environment of the training, with its transforms.

    Raises:
        TypeError: for an actor that is no TensorDict module, or another environment.
        ValueError: for a policy that reads a privileged key, that PyTorch cannot export, or whose export does not act
            like it, such as one with a transform that keeps a state.

    Example:
        >>> from tensordict.nn import TensorDictModule as Mod
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> act = Mod(lambda field, goal: (goal - field)[:, :2].sigmoid(), ["field", "target_field"], ["action"])
        >>> export_policy(act, env).in_keys
        ['field', 'target_field']
    """
    check_type(TensorDictModuleBase, actor=actor)
    check_type(EnvBase, env=env)
    base = getattr(env, "base_env", env)
    check_type(GeomagneticNavEnv, env=base)
    try:
        return _exported(copy.deepcopy(actor).to("cpu").eval(), copy.deepcopy(env).to("cpu"))
    except (ValueError, FloatingPointError) as error:
        raise ValueError(f"the policy cannot be exported: {error}") from error


def _exported(actor: TensorDictModuleBase, env: EnvBase) -> ExportedPolicy:
    """Return an export that acts like the policy in the environment, both of which may change."""
    parts = list(_transforms(env))
    for part in parts:
        if hasattr(part, "to_observation_norm"):  # running statistics
            part.freeze()
    with torch.random.fork_rng(), torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        start, base = env.reset(), getattr(env, "base_env", env)
        pipeline = _Pipeline(actor, parts, start)
        program = trace_program(pipeline, [start[key] for key in pipeline.in_keys])
        view = None if len(base.region) > 1 else base.observation_view()
        policy = _reloaded(ExportedPolicy(pipeline.in_keys, program, view))
        steps = env.rollout(min(base.max_steps, CHECKED_STEPS), actor, break_when_any_done=False)
        _compare(policy, steps, parts)
    return policy


def _transforms(env: EnvBase) -> Iterator[Transform]:
    """Yield the transforms of an environment, from the plain environment outward."""
    if isinstance(env, TransformedEnv):
        yield from _transforms(env.base_env)
        yield from _flat(env.transform)


def _flat(transform: Transform) -> Iterator[Transform]:
    if isinstance(transform, Compose):
        for part in transform:
            yield from _flat(part)
    else:
        yield transform


class _Pipeline(nn.Module):
    """Transforms that a policy needs, the policy, and the transforms of its action, over plain tensors."""

    def __init__(self, actor: TensorDictModuleBase, parts: Sequence[Transform], start: TensorDictBase) -> None:
        super().__init__()
        own = [part for part in parts if not isinstance(part, EpisodeErrors)]  # errors are of the world
        needed, before = set(_keys(actor.in_keys)), list[Transform]()
        for part in reversed(own):
            if not isinstance(part, (InitTracker, TensorDictPrimer)) and needed & set(_keys(part.out_keys)):
                needed = needed - set(_keys(part.out_keys)) | set(_keys(part.in_keys))
                before.insert(0, part.to_observation_norm() if hasattr(part, "to_observation_norm") else part)
        for key in sorted(needed - set(READ_KEYS), key=str):
            reason = _reason(key, set(_keys(actor.out_keys)), set(start.keys(True, True)))
            raise ValueError(f"it reads {key!r}, {reason}; it may read {', '.join(READ_KEYS)}")
        if not needed:
            raise ValueError("it reads nothing")
        self.in_keys = [key for key in READ_KEYS if key in needed]
        self.before, self.actor = nn.ModuleList(before), actor
        self.after = nn.ModuleList(_of_action(own))
        for module in self.modules():  # a switch in a buffer, as that of ObservationNorm, is no constant to a trace
            for name, switch in list(module.named_buffers(recurse=False)):
                if switch.dtype == torch.bool and not switch.ndim:
                    delattr(module, name)
                    setattr(module, name, bool(switch))

    def forward(self, *inputs: Tensor) -> tuple[Tensor]:
        seen = TensorDict(dict(zip(self.in_keys, inputs, strict=True)), batch_size=inputs[0].shape[:1])
        for part in (*self.before, self.actor):
            seen = part(seen)
        for part in self.after:
            seen = part.inv(seen)  # type: ignore[operator]
        return (seen["action"],)


def _of_action(parts: Sequence[Transform]) -> list[Transform]:
    """Return the transforms that lead from the action of a policy to that of the environment, in their order."""
    needed, found = set[NestedKey](["action"]), list[Transform]()
    for part in parts:
        if needed & set(_keys(part.in_keys_inv)):
            needed = needed - set(_keys(part.in_keys_inv)) | set(_keys(part.out_keys_inv))
            found.insert(0, part)
    return found


def _reason(key: NestedKey, written: set[NestedKey], known: set[NestedKey]) -> str:
    """Return why a policy cannot read a key."""
    if key == "is_init" or unravel_key(("next", key)) in written:
        return "so it keeps a state from step to step"
    if key in PRIVILEGED_KEYS:
        return "which a vehicle that navigates by the field does not know"
    return "which the plain environment does not have" if key in known else "which no transform writes"


def _keys(keys: Any) -> list[NestedKey]:
    return [unravel_key(key) for key in keys or ()]


def _reloaded(policy: ExportedPolicy) -> ExportedPolicy:
    """Return a policy as a file would give it back."""
    file = io.BytesIO()
    torch.save(policy.content(), file)
    file.seek(0)
    return rebuild(torch.load(file, weights_only=True))


def _compare(policy: ExportedPolicy, steps: TensorDictBase, parts: Sequence[Transform]) -> None:
    """Raise unless a policy acts as in a rollout of the environment with its transforms.

    Args:
        policy: exported policy.
        steps: ``(N, T)`` from the first step of an episode on.
        parts: transforms of the environment.
    """
    check_finite([("action", steps["action"])], "the policy")
    inverse = _of_action([part for part in parts if not isinstance(part, EpisodeErrors)])
    for step in range(steps.shape[1]):
        state = steps[:, step].clone()
        for part in inverse:
            state = part.inv(state)
        wanted = state["action"]
        for count in (len(wanted), 1):
            got = policy(steps[:count, step].select(*policy.in_keys))["action"]
            if not torch.allclose(got, wanted[:count].to(got.dtype), TOLERANCE, TOLERANCE):
                worst = (got - wanted[:count]).abs().amax(0).tolist()
                raise ValueError(
                    f"its export acts otherwise than itself: at step {step} of {count} vehicles the "
                    f"actions differ by up to {worst} (km, rad). The policy and its transforms must depend on their "
                    "in_keys at one step and of one vehicle only"
                )
