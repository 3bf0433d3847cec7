"""Policies of any algorithm as navigators of the plain environment, with the transforms that they need."""

from __future__ import annotations

import copy
import io
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.envs import Compose, EnvBase, InitTracker, TensorDictPrimer, Transform
from torchrl.envs.utils import ExplorationType, set_exploration_type

from magrl.agents.program import TensorProgram, export_module, trace_program
from magrl.checks import check_finite, check_type
from magrl.envs import PRIVILEGED_KEYS, PUBLIC_KEYS, GeomagneticNavEnv
from magrl.field import FieldBank
from magrl.transforms import ObservationView
from magrl.transforms.errors.base import EpisodeErrors

Keys = set[NestedKey]
_EXAMPLES = {key: torch.zeros(1, size) for key, size in zip(PUBLIC_KEYS, (3, 3, 2, 1), strict=True)}
_EXAMPLES["step_count"] = torch.zeros(1, 1, dtype=torch.int64)
READ_KEYS = tuple(_EXAMPLES)
"""Keys of the plain environment that an exported policy may read."""
CHECKED_STEPS = 6
"""Steps of the flight on which an export is compared with the policy."""
TOLERANCE = 1e-4
"""Largest difference of their actions, relative or in km and rad: float32 operations in another order."""


class TrainedPolicy(TensorDictModuleBase):
    """Base class of trained policies: from public keys of the plain environment to an action in km and rad."""

    out_keys: ClassVar[list[str]] = ["action"]
    view: Any
    """What the policy observes, with the range of the field where it was trained, if it was trained in one region."""

    def check_fits(self, env: GeomagneticNavEnv) -> None:
        """Raise unless the field of an environment is within what the policy was trained in.

        Raises:
            ValueError: naming the element and both ranges.
        """
        check_type(GeomagneticNavEnv, env=env)
        if isinstance(self.view, ObservationView):
            self.view.check_covers(env.field, env.region.grid(81).to(env.device))


class ExportedPolicy(TrainedPolicy):
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
        file, examples = io.BytesIO(), [_EXAMPLES[key] for key in self.in_keys]
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
    view = content["view"] and ObservationView(**content["view"])
    return ExportedPolicy(content["in_keys"], TensorProgram(**content["program"]), view)


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
    base = getattr(env, "base_env", env)
    check_type(GeomagneticNavEnv, env=base)
    try:
        return _exported(copy.deepcopy(actor).to("cpu").eval(), copy.deepcopy(env).to("cpu"))
    except (ValueError, FloatingPointError) as error:
        raise ValueError(f"the policy cannot be exported: {error}") from error


def _exported(actor: TensorDictModuleBase, env: EnvBase) -> ExportedPolicy:
    """Return an export that acts like the policy in the environment, both of which may change."""
    parts = _transforms(env)
    for part in parts:
        if hasattr(part, "to_observation_norm"):  # running statistics
            part.freeze()
    with torch.random.fork_rng(), torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        start, base = env.reset(), getattr(env, "base_env", env)
        pipeline = _Pipeline(actor, parts, start)
        program = trace_program(pipeline, [start[key] for key in pipeline.in_keys])
        view = None if isinstance(base.field, FieldBank) else base.observation_view()
        policy = ExportedPolicy(pipeline.in_keys, program, view)
        steps = env.rollout(min(base.max_steps, CHECKED_STEPS), actor, break_when_any_done=False)
        _compare(policy, steps, pipeline.after)
    return policy


def _transforms(env: EnvBase) -> list[Transform]:
    """Return the transforms from the plain environment outward, without errors, which are of the world."""
    skipped = (Compose, EpisodeErrors, InitTracker, TensorDictPrimer)
    return [part for part in env.modules() if isinstance(part, Transform) and not isinstance(part, skipped)]


class _Pipeline(nn.Module):
    """Transforms that a policy needs, the policy, and the transforms of its action, over plain tensors."""

    def __init__(self, actor: TensorDictModuleBase, parts: Sequence[Transform], start: TensorDictBase) -> None:
        super().__init__()
        before, needed = _leading_to(_keys(actor.in_keys), reversed(parts), "out_keys", "in_keys")
        for key in sorted(needed - set(READ_KEYS), key=str):
            reason = _reason(key, _keys(actor.out_keys), set(start.keys(True, True)))
            raise ValueError(f"it reads {key!r}, {reason}; it may read {', '.join(READ_KEYS)}")
        self.in_keys = [key for key in READ_KEYS if key in needed]
        fixed = (part.to_observation_norm() if hasattr(part, "to_observation_norm") else part for part in before)
        self.before, self.actor = nn.ModuleList(fixed), actor
        self.after = nn.ModuleList(_leading_to({"action"}, parts, "in_keys_inv", "out_keys_inv")[0])
        for module in self.modules():  # a switch in a buffer, as that of ObservationNorm, is no constant to a trace
            for name, switch in list(module.named_buffers(recurse=False)):
                if switch.dtype == torch.bool and not switch.ndim:
                    delattr(module, name)
                    setattr(module, name, bool(switch))

    def forward(self, *inputs: Tensor) -> tuple[Tensor]:
        seen = TensorDict(dict(zip(self.in_keys, inputs, strict=True)), batch_size=inputs[0].shape[:1])
        for part in (*self.before, self.actor):
            seen = part(seen)
        return (_physical_action(seen, self.after),)


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
    """Return the action of the environment that transforms make of the action of a policy."""
    for part in transforms:
        acted = part.inv(acted)
    return acted["action"]


def _reason(key: NestedKey, written: Keys, known: Keys) -> str:
    """Return why a policy cannot read a key."""
    if key == "is_init" or unravel_key(("next", key)) in written:
        return "so it keeps a state from step to step"
    if key in PRIVILEGED_KEYS:
        return "which a vehicle that navigates by the field does not know"
    return "which the plain environment does not have" if key in known else "which no transform writes"


def _keys(keys: Any) -> Keys:
    return {unravel_key(key) for key in keys or ()}


def _compare(policy: ExportedPolicy, steps: TensorDictBase, after: Iterable[Any]) -> None:
    """Raise unless a policy acts as in a rollout of the environment with its transforms.

    The policy acts on one step of one vehicle at a time, so that its action depends on nothing else.

    Args:
        policy: exported policy.
        steps: ``(N, T)`` from the first step of an episode on.
        after: transforms of the action.
    """
    check_finite([("action", steps["action"])], "the policy")
    wanted = _physical_action(steps.clone(), after)
    singles = steps.select(*policy.in_keys).reshape(-1).split(1)
    got = torch.cat([policy(single)["action"] for single in singles]).view_as(wanted)
    differ = ~torch.isclose(got, wanted.to(got.dtype), TOLERANCE, TOLERANCE)
    if differ.any():
        raise ValueError(
            f"its export acts otherwise than itself: from step {differ.any(-1).any(0).int().argmax()} on the actions "
            f"differ by up to {(got - wanted).abs().flatten(0, 1).amax(0).tolist()} (km, rad). The policy and its "
            "transforms must depend on their in_keys at one step and of one vehicle only"
        )
