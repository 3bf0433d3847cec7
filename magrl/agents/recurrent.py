"""The recurrent agent: TD3 on the paper's eight numbers, with an LSTM that estimates the heading.

A turn is relative to the last heading, which the state of Eq. 3-1 does not hold: without memory, a policy cannot tell
from it the direction of its next move. But episodes start northward and the last turn is one of the eight numbers, so
the sum of the turns is the heading. An LSTM learns this sum, and its estimate replaces the observed heading.

The training is asymmetric actor-critic: the critics read the true heading (``heading_vector``), the policy does not. It
uses stored-state replay: slices of an episode start from the recurrent state that was stored with them.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs import InitTracker, Transform
from torchrl.modules import LSTMModule, set_recurrent_mode

from magrl.agents.networks import Device, action_modules, make_mlp
from magrl.agents.td3 import TD3Loss
from magrl.checks import check_number
from magrl.transforms import AngleVector, ObservationView

STATE_KEYS = ("hidden", "cell")
"""Recurrent state, ``(..., 1, H)`` each."""


class LastMove(nn.Module):
    """The part of the observation that changes the heading: distance, turn, and the turn's cosine and sine.

    Args:
        max_turn_rad: turn that is scaled to 1 [rad].

    Example:
        >>> moves = torch.tensor([1.0, -1.0])  # the longest move, after the largest turn to the left
        >>> LastMove(max_turn_rad=1.5708)(moves).round(decimals=3)
        tensor([ 1., -1., -0., -1.])
    """

    def __init__(self, max_turn_rad: float) -> None:
        super().__init__()
        self.max_turn_rad = max_turn_rad

    def forward(self, move_scaled: Tensor) -> Tensor:
        """``(..., 2)`` scaled distance and turn to ``(..., 4)``."""
        turn = self.max_turn_rad * move_scaled[..., 1:]
        return torch.cat((move_scaled, torch.cos(turn), torch.sin(turn)), -1)


def make_recurrent_actor(
    view: ObservationView,
    num_cells: Sequence[int],
    memory_size: int,
    *,
    layer_norm: bool = True,
    device: Device = None,
) -> TensorDictSequential:
    """Return a deterministic recurrent actor: ``observation``, ``move_scaled`` and its state to ``action`` in [-1, 1].

    It also writes ``logits``, ``heading_estimate`` ``(..., 2)`` (cosine and sine) and, in ``next``, the state for the
    next step. Under :class:`torchrl.modules.set_recurrent_mode` it reads concatenated slices, ``(B,)``; ``is_init``
    marks the start of each, where its state is stored. Otherwise it reads single steps, and ``is_init`` marks those
    where the state is reset to zero.

    Args:
        view: what is observed, without the heading.
        num_cells: width of each hidden layer of the policy network.
        memory_size: width of the LSTM.
        layer_norm: whether hidden layers are normalized.
        device: device of the parameters.

    Raises:
        ValueError: for a size out of range.

    Example:
        >>> from tensordict import TensorDict
        >>> from magrl.envs import GeomagneticNavEnv
        >>> view = GeomagneticNavEnv(seed=0).observation_view(observe_heading=False)
        >>> first = TensorDict(observation=torch.zeros(5, 11), move_scaled=torch.zeros(5, 2), batch_size=5)
        >>> first["is_init"] = torch.ones(5, 1, dtype=torch.bool)
        >>> make_recurrent_actor(view, (32, 32), memory_size=8)(first)["action"].shape
        torch.Size([5, 2])
    """
    check_number(1, 65536, whole=True, memory_size=memory_size)
    memory = LSTMModule(
        input_size=4,
        hidden_size=memory_size,
        device=device,
        in_keys=["last_move", *STATE_KEYS],
        out_keys=["memory", *(("next", key) for key in STATE_KEYS)],
    )
    with torch.no_grad():  # the forget gate starts open, since the memory is to learn a sum
        memory.lstm.bias_ih_l0[memory_size : 2 * memory_size] += 1
    network = make_mlp(view.size + 2, 2, num_cells, layer_norm=layer_norm, device=device)
    return TensorDictSequential(
        TensorDictModule(LastMove(view.max_turn_rad), ["move_scaled"], ["last_move"]),
        memory,
        TensorDictModule(nn.Linear(memory_size, 2, device=device), ["memory"], ["heading_estimate"]),
        *action_modules(network, ["observation", "heading_estimate"]),
    )


def recurrent_transforms(view: ObservationView, actor: TensorDictSequential) -> list[Transform]:
    """Return the transforms of a training environment: first state, ``is_init``, view, and the heading for the critics.

    Example:
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from magrl.envs import GeomagneticNavEnv
        >>> base = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> view = base.observation_view(observe_heading=False)
        >>> actor = make_recurrent_actor(view, (8,), memory_size=4)
        >>> TransformedEnv(base, Compose(*recurrent_transforms(view, actor))).reset()["hidden"].shape
        torch.Size([2, 1, 4])
    """
    memory = next(module for module in actor.modules() if isinstance(module, LSTMModule))
    privileged = AngleVector("heading", "heading_vector")
    return [InitTracker(), memory.make_tensordict_primer(), *view.observation_transforms(), privileged]


class RecurrentTD3Loss(TD3Loss):
    """TD3 loss on slices of episodes, with an actor that is unrolled over each slice.

    Example:
        >>> from torchrl.envs import Compose, TransformedEnv
        >>> from magrl.agents import SoftUpdate
        >>> from magrl.agents.networks import make_critic
        >>> from magrl.envs import GeomagneticNavEnv
        >>> base = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> view = base.observation_view(observe_heading=False)
        >>> actor = make_recurrent_actor(view, (8,), memory_size=4)
        >>> critic = make_critic(view.size + 2, (8,), observation_keys=("observation", "heading_vector"))
        >>> env = TransformedEnv(base, Compose(*recurrent_transforms(view, actor), view.action_transform()))
        >>> slices = env.rollout(3, actor).reshape(-1)  # two slices of three steps
        >>> loss = RecurrentTD3Loss(actor, critic, gamma=0.9, policy_noise=0.1, noise_clip=0.5)
        >>> update = SoftUpdate(loss, tau=0.01)
        >>> loss.value_loss(slices)[0].requires_grad
        True
    """

    def value_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of both critics, with the target actor unrolled over the next observations.

        That sequence starts one step into the slice. The state there is computed anew with the target actor: the stored
        one comes from older weights.

        Args:
            tensordict: ``(B,)`` slices from a ``SliceSampler``, end to end; ``next`` gets their starts and states.

        Returns:
            A scalar, and ``target_value`` ``(B, 1)``.
        """
        begins = tensordict["is_init"].squeeze(-1)
        first = tensordict[begins].select(*self.actor_network.in_keys)
        first["is_init"] = torch.zeros_like(first["is_init"])  # continue from the stored state
        with torch.no_grad(), set_recurrent_mode(False):  # TorchRL calls every loss in recurrent mode
            self.networks.target_actor(first)
        following = tensordict["next"]
        following["is_init"] = tensordict["is_init"]
        for key in STATE_KEYS:
            following[key] = following[key].clone()
            following[key][begins] = first["next", key]
        return super().value_loss(tensordict)

    def memory_parameters(self) -> list[Tensor]:
        """Return the parameters of the LSTM."""
        return [value for name, value in self._named_actor_parameters() if ".lstm." in name]

    def actor_parameters(self) -> list[Tensor]:
        """Return the parameters of the actor other than those of the LSTM."""
        return [value for name, value in self._named_actor_parameters() if ".lstm." not in name]

    def _named_actor_parameters(self) -> list[tuple[str, Tensor]]:
        named = self.actor_network_params.flatten_keys(".").items()
        return [(name, value) for name, value in named if value.requires_grad]
