"""An agent that reads the paper's eight numbers and nothing else: TD3 with a memory.

A turn is counted from the last heading, which the state of Eq. 3-1 does not hold: without memory no policy can tell
from it where it will go. But journeys begin northward, and the last turn is one of the eight numbers, so a vehicle
that adds up its turns knows its heading. Here an LSTM learns to do that, and its estimate stands where the networks of
:mod:`magrl.td3` read the heading.

Only training knows more: the critics, which do not fly, read the true heading (``heading_vector``), and the memory can
be taught by it. The policy reads ``observation``, made of the eight numbers, and what it remembers.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.envs import Compose, InitTracker, Transform
from torchrl.modules import LSTMModule, ValueOperator, set_recurrent_mode
from torchrl.objectives import TD3Loss

from magrl import td3
from magrl.checkpoints import load_tensors, save_tensors
from magrl.transforms import AngleVector

STATE_KEYS = ("hidden", "cell")
"""What the memory hands from step to step, ``(..., 1, H)`` each."""
POLICY_FORMAT = 1


class LastMove(nn.Module):
    """The part of ``observation`` that moves the heading, in a shape that is easy to add up.

    Args:
        max_turn_rad: the turn that is scaled to 1 [rad].

    Example:
        >>> seen = torch.zeros(11)
        >>> seen[6:8] = torch.tensor([1.0, -1.0])  # the longest move, after the largest turn to the left
        >>> LastMove(max_turn_rad=1.5708)(seen).round(decimals=3)
        tensor([ 1., -1., -0., -1.])
    """

    def __init__(self, max_turn_rad: float) -> None:
        super().__init__()
        self.max_turn_rad = max_turn_rad

    def forward(self, observation: Tensor) -> Tensor:
        """``(..., K)`` to ``(..., 4)``: last distance and turn, scaled, and the turn's cosine and sine."""
        turn = self.max_turn_rad * observation[..., 7:8]
        return torch.cat((observation[..., 6:8], torch.cos(turn), torch.sin(turn)), -1)


def observation_transforms(config: td3.PolicyConfig) -> list[Transform]:
    """From the public keys to ``observation``, which holds no heading, for training and flight alike.

    Example:
        >>> from magrl.env import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> view = td3.policy_config(env, (8,), layer_norm=True)
        >>> Compose(*observation_transforms(view))(env.reset())["observation"].shape
        torch.Size([2, 11])
    """
    return td3.observation_transforms(replace(config, observe_heading=False))


def training_transforms(config: td3.PolicyConfig, actor: TensorDictSequential) -> list[Transform]:
    """What a training environment needs: the memory's first state, ``is_init``, and the heading for the critics.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.env import GeomagneticNavEnv
        >>> base = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> view = td3.policy_config(base, (8,), layer_norm=True)
        >>> env = TransformedEnv(base, Compose(*training_transforms(view, make_actor(view, memory_size=4))))
        >>> env.reset()["hidden"].shape
        torch.Size([2, 1, 4])
    """
    memory = next(module for module in actor.modules() if isinstance(module, LSTMModule))
    privileged = AngleVector("heading", "heading_vector")
    return [InitTracker(), memory.make_tensordict_primer(), *observation_transforms(config), privileged]


def make_actor(config: td3.PolicyConfig, memory_size: int, device: torch.device | None = None) -> TensorDictSequential:
    """The deterministic policy: ``observation``, ``is_init`` and the memory's state to ``action`` in [-1, 1].

    It also writes ``heading_estimate`` ``(..., 2)``, cosine and sine, and the state for the next step. Under
    :class:`torchrl.modules.set_recurrent_mode` it reads slices end to end, ``(B,)``, each of which starts where
    ``is_init`` says, from the state that is stored there; else single steps, from zero where ``is_init`` says so.

    Args:
        config: what is observed and the shape of the policy network, as for :func:`magrl.td3.make_actor`.
        memory_size: width of the LSTM.
        device: where the networks live.

    Raises:
        ValueError: for a memory of no size.

    Example:
        >>> from magrl.env import GeomagneticNavEnv
        >>> view = td3.policy_config(GeomagneticNavEnv(seed=0), (32, 32), layer_norm=True)
        >>> first = TensorDict(observation=torch.zeros(5, 11), is_init=torch.ones(5, 1, dtype=torch.bool), batch_size=5)
        >>> make_actor(view, memory_size=8)(first)["action"].shape
        torch.Size([5, 2])
    """
    if memory_size < 1:
        raise ValueError(f"memory_size must be a whole number from 1 on, got {memory_size}")
    memory = LSTMModule(
        input_size=4,
        hidden_size=memory_size,
        device=device,
        in_keys=["last_move", *STATE_KEYS],
        out_keys=["memory", *(("next", key) for key in STATE_KEYS)],
    )
    with torch.no_grad():  # a forget gate that starts open: what is to be learned is a sum
        memory.lstm.bias_ih_l0[memory_size : 2 * memory_size] += 1
    network, squash = td3.make_actor(replace(config, observe_heading=True), device)
    return TensorDictSequential(
        TensorDictModule(LastMove(config.max_turn_rad), ["observation"], ["last_move"]),
        memory,
        TensorDictModule(nn.Linear(memory_size, 2, device=device), ["memory"], ["heading_estimate"]),
        TensorDictModule(network.module, ["observation", "heading_estimate"], ["logits"]),
        squash,
    )


def make_critic(config: td3.PolicyConfig, device: torch.device | None = None) -> ValueOperator:
    """The value of an action, for training only: it reads the true heading beside ``observation``.

    Example:
        >>> from magrl.env import GeomagneticNavEnv
        >>> critic = make_critic(td3.policy_config(GeomagneticNavEnv(seed=0), (8,), layer_norm=True))
        >>> critic.in_keys
        ['observation', 'heading_vector', 'action']
    """
    critic = td3.make_critic(replace(config, observe_heading=True), device)
    return ValueOperator(critic.module, in_keys=["observation", "heading_vector", "action"])


def make_loss(
    actor: TensorDictSequential, critic: ValueOperator, *, gamma: float, policy_noise: float, noise_clip: float
) -> TD3Loss:
    """TorchRL's TD3 loss for an actor with a memory and critics that see what it does not.

    Args:
        actor: of :func:`make_actor`.
        critic: of :func:`make_critic`.
        gamma: discount factor.
        policy_noise: standard deviation of the noise on target actions.
        noise_clip: largest noise on target actions.

    Returns:
        The loss; :func:`value_loss` and :func:`actor_losses` evaluate it on slices.

    Example:
        >>> from magrl.env import GeomagneticNavEnv
        >>> view = td3.policy_config(GeomagneticNavEnv(seed=0), (8,), layer_norm=True)
        >>> loss = make_loss(make_actor(view, 4), make_critic(view), gamma=0.9, policy_noise=0.1, noise_clip=0.5)
        >>> "heading_vector" in loss.in_keys
        True
    """
    # The loss hands its critics what its actor reads or writes, so the heading has to pass by the actor.
    beside = TensorDictModule(nn.Identity(), ["heading_vector"], ["heading_vector"])
    loss = TD3Loss(
        TensorDictSequential(actor, beside),
        critic,
        action_spec=Bounded(-1.0, 1.0, (2,), device=next(actor.parameters()).device),
        loss_function="l2",
        policy_noise=policy_noise,
        noise_clip=noise_clip,
        deactivate_vmap=True,
    )
    loss.make_value_estimator(gamma=gamma)
    return loss


def parameter_groups(loss: TD3Loss) -> tuple[list[Tensor], list[Tensor]]:
    """The actor's parameters: those of its memory, and the others.

    Example:
        >>> from magrl.env import GeomagneticNavEnv
        >>> view = td3.policy_config(GeomagneticNavEnv(seed=0), (8,), layer_norm=False)
        >>> loss = make_loss(make_actor(view, 4), make_critic(view), gamma=0.9, policy_noise=0.1, noise_clip=0.5)
        >>> memory, others = parameter_groups(loss)
        >>> len(memory), len(others)
        (4, 6)
    """
    named = loss.actor_network_params.flatten_keys(".").items()
    trained = [(name, value) for name, value in named if value.requires_grad]
    return [v for n, v in trained if ".lstm." in n], [v for n, v in trained if ".lstm." not in n]


def value_loss(loss: TD3Loss, slices: TensorDictBase) -> Tensor:
    """The critics' loss on slices, with target actions from an unrolled memory.

    The sequence of next observations starts one step into the slice, from a state that is computed anew: the one that
    was stored there came from weights of long ago.

    Args:
        loss: of :func:`make_loss`.
        slices: ``(B,)`` from a buffer with a ``SliceSampler``, end to end; ``next`` gets their starts and states.

    Returns:
        A scalar with a gradient for the critics.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.env import GeomagneticNavEnv
        >>> base = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> view = td3.policy_config(base, (8,), layer_norm=True)
        >>> actor = make_actor(view, memory_size=4)
        >>> env = TransformedEnv(base, Compose(*training_transforms(view, actor), td3.action_transform(view)))
        >>> slices = env.rollout(3, actor).reshape(-1)  # two slices of three steps
        >>> loss = make_loss(actor, make_critic(view), gamma=0.9, policy_noise=0.1, noise_clip=0.5)
        >>> value_loss(loss, slices).requires_grad
        True
    """
    begins = slices["is_init"].squeeze(-1)
    first = slices[begins].select(*loss.actor_network.in_keys)
    first["is_init"] = torch.zeros_like(first["is_init"])  # go on from the stored state, zero where a journey begins
    with torch.no_grad(), loss.target_actor_network_params.to_module(loss.actor_network):
        loss.actor_network(first)
    following = slices["next"]
    following["is_init"] = slices["is_init"]
    for key in STATE_KEYS:
        following[key] = following[key].clone()
        following[key][begins] = first["next", key]
    with set_recurrent_mode(True):
        return loss.value_loss(slices)[0]


def actor_losses(loss: TD3Loss, slices: TensorDictBase) -> dict[str, Tensor]:
    """What the actor is trained on, each a scalar with a gradient.

    Args:
        loss: of :func:`make_loss`.
        slices: ``(B,)``, as for :func:`value_loss`.

    Returns:
        ``value``, less the first critic's value of the actor's actions; ``heading``, the mean square error of the
        estimated heading's cosine and sine; ``saturation``, as :func:`magrl.td3.saturation_penalty`.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from magrl.env import GeomagneticNavEnv
        >>> base = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> view = td3.policy_config(base, (8,), layer_norm=True)
        >>> actor = make_actor(view, memory_size=4)
        >>> env = TransformedEnv(base, Compose(*training_transforms(view, actor), td3.action_transform(view)))
        >>> slices = env.rollout(3, actor).reshape(-1)  # two slices of three steps
        >>> loss = make_loss(actor, make_critic(view), gamma=0.9, policy_noise=0.1, noise_clip=0.5)
        >>> sorted(actor_losses(loss, slices))
        ['heading', 'saturation', 'value']
    """
    seen = slices.select(*loss.actor_network.in_keys)
    with set_recurrent_mode(True), loss.actor_network_params.to_module(loss.actor_network):
        loss.actor_network(seen)
    with loss.qvalue_network_params.data[0].to_module(loss.qvalue_network):
        value = loss.qvalue_network(seen.select(*loss.qvalue_network.in_keys))["state_action_value"]
    error = (seen["heading_estimate"] - seen["heading_vector"]).square().sum(-1)
    return {"value": -value.mean(), "heading": error.mean(), "saturation": td3.saturation_penalty(seen["logits"])}


class RecurrentPolicy(TensorDictModuleBase):
    """A trained agent with a memory as a navigator in the plain environment.

    It keeps its memory itself, for each vehicle of the batch, from the start of a journey (``step_count`` 0) on. Ask
    it once for each step.

    Args:
        config: what the policy observes and the shape of its network; whether it may observe the heading is ignored.
        memory_size: width of the LSTM.
        actor: trained by a recipe; a fresh one by default.

    Example:
        >>> from magrl.env import GeomagneticNavEnv
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> policy = RecurrentPolicy(td3.policy_config(env, (32, 32), layer_norm=True), memory_size=8)
        >>> env.rollout(2, policy)["action"].shape
        torch.Size([2, 2, 2])
    """

    in_keys: ClassVar[list[str]] = ["field", "target_field", "move", "step_count"]
    out_keys: ClassVar[list[str]] = ["action"]

    def __init__(self, config: td3.PolicyConfig, memory_size: int, actor: TensorDictSequential | None = None) -> None:
        super().__init__()
        self.config, self.memory_size = config, memory_size
        self.observe = Compose(*observation_transforms(config))
        self.act = td3.action_transform(config)
        self.actor = make_actor(config, memory_size) if actor is None else actor
        self.state: TensorDictBase | None = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes ``action`` ``(N, 2)``: distance [km] and turn [rad]; remembers the move."""
        seen = self.observe(tensordict.select(*self.in_keys))
        seen["is_init"] = seen["step_count"] == 0
        if self.state is None or self.state.shape != seen.shape or self.state.device != seen.device:
            zeros = seen["observation"].new_zeros(*seen.shape, 1, self.memory_size)
            self.state = TensorDict(dict.fromkeys(STATE_KEYS, zeros), seen.shape, device=seen.device)
        self.actor(seen.update(self.state))
        self.state = seen["next"].select(*STATE_KEYS).detach()
        return tensordict.set("action", self.act.denormalize("action", seen["action"]))


def save_policy(path: Path | str, policy: RecurrentPolicy) -> None:
    """Writes a policy: its configuration and its weights, as plain tensors and numbers.

    Example:
        >>> import tempfile
        >>> from magrl.env import GeomagneticNavEnv
        >>> view = td3.policy_config(GeomagneticNavEnv(seed=0), (8,), layer_norm=True)
        >>> save_policy(Path(tempfile.mkdtemp()) / "policy.pt", RecurrentPolicy(view, memory_size=4))
    """
    weights = {key: value.cpu() for key, value in policy.actor.state_dict().items() if isinstance(value, Tensor)}
    content = {"recurrent_format": POLICY_FORMAT, "config": asdict(policy.config), "memory_size": policy.memory_size}
    save_tensors(content | {"weights": weights}, Path(path))


def load_policy(path: Path | str, device: torch.device | str = "cpu") -> RecurrentPolicy:
    """Rebuilds a policy that :func:`save_policy` wrote.

    Args:
        path: the ``policy.pt`` of a run.
        device: where it shall act.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: for a file that is no recurrent policy, or with weights of other shapes.

    Example:
        >>> import tempfile
        >>> from magrl.env import GeomagneticNavEnv
        >>> view = td3.policy_config(GeomagneticNavEnv(seed=0), (8,), layer_norm=True)
        >>> path = Path(tempfile.mkdtemp()) / "policy.pt"
        >>> save_policy(path, RecurrentPolicy(view, memory_size=4))
        >>> load_policy(path).memory_size
        4
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no policy file at {path}")
    try:
        content = load_tensors(path)
        if content["recurrent_format"] != POLICY_FORMAT:
            raise ValueError(f"this version reads format {POLICY_FORMAT}, got {content['recurrent_format']!r}")
        policy = RecurrentPolicy(td3.PolicyConfig(**content["config"]), content["memory_size"])
        policy.actor.load_state_dict(content["weights"])
    except Exception as error:  # whatever a damaged archive raises
        raise ValueError(f"{path} is not the file of a recurrent policy: {error}") from error
    return policy.to(device).eval()
