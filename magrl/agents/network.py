"""Networks of one's own between a view and the action, as programs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor, nn
from torchrl.envs import Compose
from torchrl.envs.utils import ExplorationType, set_exploration_type

from magrl.agents.exported import EXAMPLES
from magrl.agents.pipeline import TOLERANCE, copied
from magrl.agents.program import TensorProgram, trace_program
from magrl.checks import check_type
from magrl.transforms import ObservationView, TrackView

_ROWS = 5


class Network(TensorDictModuleBase):
    """A network without a state, from what a view writes to ``action`` ``(..., 2)`` in [-1, 1], as a program.

    Args:
        in_keys: keys that it reads.
        program: from their values ``(N, ...)`` to the action ``(N, 2)``.

    Raises:
        TypeError: for arguments of another type.
        ValueError: for a program of another number of inputs and outputs.

    Example:
        >>> halves = TensorProgram(1, [["mul.Tensor", [{"value": 0}, 0.5], {}]], [], [1])
        >>> Network(["move"], halves)(TensorDict(move=torch.ones(3, 2), batch_size=[3]))["action"][0]
        tensor([0.5000, 0.5000])
    """

    out_keys = ["action"]  # noqa: RUF012 - as TensorDict modules have it

    def __init__(self, in_keys: Sequence[str], program: TensorProgram) -> None:
        super().__init__()
        check_type(list, in_keys=in_keys)
        check_type(TensorProgram, program=program)
        if (program.num_inputs, len(program.outputs)) != (len(in_keys), 1):
            raise ValueError(f"a network of {len(in_keys)} keys must take that many inputs, got {program.num_inputs}")
        self.in_keys, self.program = list(in_keys), program

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action``."""
        flat = tensordict if tensordict.ndim == 1 else tensordict.reshape(-1)
        (action,) = self.program(*(flat[key] for key in self.in_keys))
        return tensordict.set("action", action.reshape(*tensordict.shape, -1))

    def content(self) -> dict[str, Any]:
        """Return all that rebuilds the network as numbers, text and tensors."""
        return {"in_keys": self.in_keys, "program": self.program.content()}


def seen_by(view: ObservationView | TrackView) -> TensorDictBase:
    """Return what a view writes for one vehicle, and what it reads.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> seen_by(GeomagneticNavEnv(seed=0).observation_view())["observation"].shape
        torch.Size([1, 13])
    """
    return Compose(*view.observation_transforms())(TensorDict(EXAMPLES, [1]).clone())


class _Values(nn.Module):
    """A network over plain tensors."""

    def __init__(self, actor: TensorDictModuleBase, in_keys: Sequence[NestedKey]) -> None:
        super().__init__()
        self.actor, self.in_keys = actor, in_keys

    def forward(self, *inputs: Tensor) -> tuple[Tensor]:
        seen = TensorDict(dict(zip(self.in_keys, inputs, strict=True)), batch_size=inputs[0].shape[:1])
        return (self.actor(seen)["action"],)


def trace_network(actor: TensorDictModuleBase, view: ObservationView | TrackView) -> Network:
    """Return a network as a program, compared with it on random observations.

    Args:
        actor: network, from what the view writes to ``action`` ``(N, 2)`` in [-1, 1].
        view: what it observes.

    Raises:
        ValueError: for a key that the view does not write, an action of another size, or a network that PyTorch cannot
            export or that depends on more than the observation of one vehicle.

    Example:
        >>> from magrl.envs import GeomagneticNavEnv
        >>> from tensordict.nn import TensorDictModule
        >>> actor = TensorDictModule(nn.Linear(13, 2), ["observation"], ["action"])
        >>> trace_network(actor, GeomagneticNavEnv(seed=0).observation_view()).in_keys
        ['observation']
    """
    if isinstance(actor, Network):
        return actor
    actor = copied(actor).to("cpu").eval()
    seen = seen_by(view)
    keys = [unravel_key(key) for key in actor.in_keys]
    if unknown := [key for key in keys if key not in seen.keys(True, True)]:
        raise ValueError(
            f"the network reads {unknown}, which the view does not write: for a state or own transforms, export it by "
            "save_policy(path, actor, env)"
        )
    values = _Values(actor, keys)
    with torch.random.fork_rng(), torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        rows = [torch.rand(_ROWS, *seen[key].shape[1:]).to(seen[key].dtype) for key in keys]
        network = Network(keys, trace_program(values, rows))
        wanted = values(*rows)[0]
        got = torch.cat([network.program(*(row[i : i + 1] for row in rows))[0] for i in range(_ROWS)])
    if wanted.shape != (_ROWS, 2):
        raise ValueError(f"the action of a network must be (N, 2), got {tuple(wanted.shape)} for {_ROWS} vehicles")
    if not torch.allclose(got, wanted, TOLERANCE, TOLERANCE):
        raise ValueError("the network must depend on the observation of one vehicle only: its export acts otherwise")
    return network
