"""TD3: a loss with a separate network for each role, for feedforward actors.

Source: Fujimoto, van Hoof and Meger, Addressing function approximation error in actor-critic methods, ICML 2018.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.func import functional_call
from torchrl.modules import ValueOperator
from torchrl.objectives import TD3Loss as TorchRLTD3Loss

from magrl.checks import check_number, check_type


class TD3Loss(nn.Module):
    """The loss of TD3, with the values and gradients of TorchRL's at a lower cost (``make bench``).

    TorchRL's class fills one network with the parameters of each role at every call, and evaluates both critics for the
    actor. This one holds a network for each role, so that it is copied, moved, cast and optimized as any module is.

    Args:
        actor: writes ``logits`` and ``action`` ``(..., 2)`` in [-1, 1]; it is trained in place.
        critic: reads observations and ``action``, in this order, by a module of one concatenated input; a model of both
            critics, whose weights TorchRL draws.
        gamma: discount factor.
        policy_noise: standard deviation of the noise of target policy smoothing.
        noise_clip: largest noise of target policy smoothing.
        terminated: key of the end after which no value is expected; ``"done"`` counts a step limit as one.

    Raises:
        TypeError: for an actor or a critic of another type.
        ValueError: for a discount outside [0, 1] or a negative noise.

    Example:
        >>> from magrl.navigators.networks import make_actor, make_critic
        >>> loss = TD3Loss(make_actor(13, (8,)), make_critic(13, (8,)), gamma=0.9, policy_noise=0.1, noise_clip=0.5)
        >>> update = SoftUpdate(loss, tau=0.01)
        >>> obs, ended = torch.zeros(5, 13), torch.ones(5, 1, dtype=torch.bool)
        >>> after = TensorDict(observation=obs, reward=torch.ones(5, 1), terminated=ended)
        >>> batch = TensorDict(observation=obs, action=torch.zeros(5, 2), next=after, batch_size=[5])
        >>> loss.value_loss(batch)[1]["target_value"].T
        tensor([[1., 1., 1., 1., 1.]])
    """

    def __init__(
        self,
        actor: TensorDictSequential,
        critic: ValueOperator,
        *,
        gamma: float,
        policy_noise: float,
        noise_clip: float,
        terminated: NestedKey = "terminated",
    ) -> None:
        super().__init__()
        check_type(TensorDictSequential, actor=actor)
        check_type(ValueOperator, critic=critic)
        check_number(0, 1, gamma=gamma)
        check_number(0, policy_noise=policy_noise, noise_clip=noise_clip)
        self.gamma, self.policy_noise, self.noise_clip, self.terminated = gamma, policy_noise, noise_clip, terminated
        self.observed = critic.in_keys[:-1]
        drawn = TorchRLTD3Loss(actor, critic, bounds=(-1.0, 1.0)).qvalue_network_params.data.clone().unbind(0)
        self.actor, self.critics = actor, nn.ModuleList(_holding(critic, weights).module for weights in drawn)
        self.target_actor, self.target_critics = copy.deepcopy((self.actor, self.critics))
        self.target_actor.requires_grad_(False)
        self.target_critics.requires_grad_(False)

    def actor_parameters(self) -> list[Tensor]:
        """Return the parameters that the actor's optimizer trains."""
        return list(self.actor.parameters())

    def critic_parameters(self) -> list[Tensor]:
        """Return the parameters that the critics' optimizer trains."""
        return list(self.critics.parameters())

    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Return ``loss_actor`` and ``loss_qvalue``, whose sum TorchRL's trainers minimize, and ``target_value``."""
        loss_actor, _ = self.actor_loss(tensordict)
        loss_qvalue, values = self.value_loss(tensordict)
        return TensorDict({"loss_actor": loss_actor, "loss_qvalue": loss_qvalue, **values})

    def value_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of both critics (Eqs. (15) to (17)).

        Args:
            tensordict: ``(B,)`` transitions: observations, ``action``, and in ``next`` observations, ``reward`` and
                ``terminated``, or the key that stands for it.

        Returns:
            A scalar, and ``target_value`` ``(B, 1)``.
        """
        action, after = tensordict["action"], tensordict["next"]
        noise = (torch.randn_like(action) * self.policy_noise).clamp(-self.noise_clip, self.noise_clip)
        with torch.inference_mode():
            # Target policy smoothing: noise on the action of the target actor
            next_action = self.target_actor(after.select(*self.actor.in_keys))["action"]
            next_action = (next_action + noise).clamp(-1.0, 1.0)
            # Clipped double Q: the smaller value of the two target critics
            next_obs_action = self._critic_input(after, next_action)
            target_q = torch.minimum(*(critic(next_obs_action) for critic in self.target_critics))
            target_value = after["reward"] + self.gamma * (~after[self.terminated]).to(target_q.dtype) * target_q
        obs_action = self._critic_input(tensordict, action)
        q1, q2 = (critic(obs_action) for critic in self.critics)
        loss = ((q1 - target_value).square() + (q2 - target_value).square()).mean()
        return loss, {"target_value": target_value}

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of the actor: minus the value that the first critic gives to its actions (Algorithm 1).

        Args:
            tensordict: ``(B,)`` transitions.

        Returns:
            A scalar, and all outputs of the actor with their gradient, such as ``logits`` and ``action``.
        """
        outputs = self.actor(tensordict.select(*self.actor.in_keys))
        # Detached, or the loss of the actor would compute gradients of the critic's weights, too
        weights = {name: weight.detach() for name, weight in self.critics[0].named_parameters()}
        q1 = functional_call(self.critics[0], weights, self._critic_input(tensordict, outputs["action"]))
        return -q1.mean(), {key: outputs[key] for key in self.actor.out_keys}

    def _critic_input(self, tensordict: TensorDictBase, action: Tensor) -> Tensor:
        return torch.cat([*(tensordict[key] for key in self.observed), action], -1)


def _holding(network: nn.Module, weights: TensorDictBase) -> Any:
    """Return a copy of a network that holds some weights."""
    copied = copy.deepcopy(network)
    weights.to_module(copied, preserve_module_state=True)
    return copied.requires_grad_()


class SoftUpdate:
    """Polyak averaging of the target networks of a loss.

    Args:
        loss: loss.
        tau: share by which each target moves towards its source.

    Raises:
        ValueError: for a share outside [0, 1].

    Example:
        >>> from magrl.navigators.networks import make_actor, make_critic
        >>> loss = TD3Loss(make_actor(13, (8,)), make_critic(13, (8,)), gamma=0.9, policy_noise=0.1, noise_clip=0.5)
        >>> SoftUpdate(loss, tau=0.25).step()
    """

    def __init__(self, loss: TD3Loss, *, tau: float) -> None:
        check_number(0, 1, tau=tau)
        self.loss, self.tau = loss, tau

    @torch.no_grad()
    def step(self) -> None:
        """Move each target parameter by the share ``tau`` towards its source."""
        pairs = (self.loss.target_actor, self.loss.actor), (self.loss.target_critics, self.loss.critics)
        for targets, sources in pairs:
            for target, source in zip(targets.parameters(), sources.parameters(), strict=True):
                target.lerp_(source, self.tau)


def mirrored(transitions: TensorDictBase, mirror: Tensor | None) -> TensorDictBase:
    """Return transitions, of which a random half are in mirror image; without a map to it, as they are.

    Args:
        transitions: ``(B,)`` with ``observation``, ``action`` and ``next``.
        mirror: linear map ``(K, K)`` of an observation, as :attr:`magrl.transforms.LegsView.mirror`; a turn changes its
            sign.

    Example:
        >>> after = TensorDict(observation=torch.ones(9, 2), batch_size=[9])
        >>> batch = TensorDict(observation=torch.ones(9, 2), action=torch.ones(9, 2), next=after, batch_size=[9])
        >>> found = mirrored(batch, torch.tensor([[1.0, 0.0], [0.0, -1.0]]))
        >>> torch.equal(found["action"], found["next", "observation"])
        True
    """
    if mirror is None:
        return transitions
    drawn, found = torch.rand(*transitions.shape, 1, device=mirror.device) < 0.5, transitions.copy()
    maps = {"observation": mirror, "action": mirror.new_tensor(((1, 0), (0, -1))), ("next", "observation"): mirror}
    for key, image in maps.items():
        found[key] = torch.where(drawn, found[key] @ image.T, found[key])
    return found


def saturation_penalty(logits: Tensor) -> Tensor:
    """Return the mean square of the actor's outputs before the tanh.

    Early in training every leg is a loss on average, whatever its direction. An actor that follows this gradient far
    into the saturation of the tanh stands still and has no gradient left. A small weight on this term prevents that.

    Args:
        logits: ``(B, 2)`` from :meth:`TD3Loss.actor_loss`.

    Returns:
        A scalar with a gradient for the actor.

    Example:
        >>> saturation_penalty(torch.tensor([[1.0, -3.0]]))
        tensor(5.)
    """
    return logits.square().mean()


def optimize(
    loss: Tensor, *optimizers: torch.optim.Optimizer, clip: Iterable[Tensor] = (), max_norm: float = 1.0
) -> None:
    """Take one gradient step.

    Args:
        loss: scalar.
        optimizers: optimizers to step; their gradients are cleared.
        clip: parameters whose gradient is scaled down to ``max_norm``.
        max_norm: largest norm of that gradient.

    Example:
        >>> weight = nn.Parameter(torch.tensor(1.0))
        >>> optimize(weight.square(), torch.optim.SGD([weight], lr=0.1))
        >>> weight.item()
        0.800000011920929
    """
    loss.backward()
    if clip := list(clip):
        nn.utils.clip_grad_norm_(clip, max_norm)
    for optimizer in optimizers:
        optimizer.step()
        optimizer.zero_grad()
