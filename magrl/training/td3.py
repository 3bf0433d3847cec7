"""TD3: TorchRL's loss with a separate network for each role, for feedforward actors.

Source: Fujimoto, van Hoof and Meger, Addressing function approximation error in actor-critic methods, ICML 2018.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from functools import cached_property
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.modules import ValueOperator
from torchrl.objectives import SoftUpdate as TorchRLSoftUpdate
from torchrl.objectives import TD3Loss as TorchRLTD3Loss

from magrl.checks import check_number, check_type


class Networks(NamedTuple):
    """The networks of a :class:`TD3Loss`, which share the memory of its parameters.

    Example:
        >>> Networks._fields
        ('actor', 'target_actor', 'critics', 'target_critics', 'frozen_critic')
    """

    actor: Any
    target_actor: Any
    critics: list[nn.Module]
    target_critics: list[nn.Module]
    frozen_critic: nn.Module


class TD3Loss(TorchRLTD3Loss):
    """TorchRL's TD3 loss with equal values and gradients at a lower cost (``make bench``).

    TorchRL's class fills one network with the parameters of each role at every call, and evaluates both critics for the
    actor. This one keeps a network for each role, on the parameters, targets and state of the parent. Move actor and
    critic to their device before the loss is made.

    Args:
        actor: writes ``logits`` and ``action`` ``(..., 2)`` in [-1, 1].
        critic: reads observations and ``action``, in this order, by a module of one concatenated input.
        gamma: discount factor.
        policy_noise: standard deviation of the noise of target policy smoothing.
        noise_clip: largest noise of target policy smoothing.

    Raises:
        TypeError: for an actor or a critic of another type.
        ValueError: for a discount outside [0, 1] or a negative noise.

    Example:
        >>> from tensordict import TensorDict
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
    ) -> None:
        check_type(TensorDictSequential, actor=actor)
        check_type(ValueOperator, critic=critic)
        check_number(0, 1, gamma=gamma)
        check_number(0, policy_noise=policy_noise, noise_clip=noise_clip)
        super().__init__(
            actor,
            critic,
            action_spec=Bounded(-1.0, 1.0, (2,), device=next(actor.parameters()).device),
            loss_function="l2",
            policy_noise=policy_noise,
            noise_clip=noise_clip,
            deactivate_vmap=True,  # each critic is a module of its own
        )
        self.make_value_estimator(gamma=gamma)

    @cached_property
    def networks(self) -> Networks:
        """A network for each role, on the parameters of the loss."""
        critics, targets = (p.data.unbind(0) for p in (self.qvalue_network_params, self.target_qvalue_network_params))
        return Networks(
            actor=_holding(self.actor_network, self.actor_network_params),
            target_actor=_holding(self.actor_network, self.target_actor_network_params.data),
            critics=[_holding(self.qvalue_network, params).module.requires_grad_() for params in critics],
            target_critics=[_holding(self.qvalue_network, params).module for params in targets],
            # Without this, the loss of the actor would compute gradients of the critic's weights, too
            frozen_critic=_holding(self.qvalue_network, critics[0]).module.requires_grad_(False),
        )

    def actor_parameters(self) -> list[Tensor]:
        """Return the parameters that the actor's optimizer trains."""
        return list(self.actor_network_params.parameters())

    def critic_parameters(self) -> list[Tensor]:
        """Return the parameters that the critics' optimizer trains."""
        return [weight for critic in self.networks.critics for weight in critic.parameters()]

    def value_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of both critics (Eqs. (15) to (17)).

        Args:
            tensordict: ``(B,)`` transitions: observations, ``action``, and in ``next`` observations, ``reward`` and
                ``terminated``, or what ``set_keys(terminated=...)`` names.

        Returns:
            A scalar, and ``target_value`` ``(B, 1)``.
        """
        action, after = tensordict["action"], tensordict["next"]
        noise = (torch.randn_like(action) * self.policy_noise).clamp(-self.noise_clip, self.noise_clip)
        with torch.inference_mode():
            # Target policy smoothing: noise on the action of the target actor
            next_action = self.networks.target_actor(after.select(*self.actor_network.in_keys))["action"]
            next_action = (next_action + noise).clamp(self.min_action, self.max_action)
            # Clipped double Q: the smaller value of the two target critics
            next_obs_action = self._critic_input(after, next_action)
            target_q = torch.minimum(*(critic(next_obs_action) for critic in self.networks.target_critics))
            alive = (~after[self.tensor_keys.terminated]).to(target_q.dtype)
            target_value = after["reward"] + self.value_estimator.gamma * alive * target_q
        obs_action = self._critic_input(tensordict, action)
        q1, q2 = (critic(obs_action) for critic in self.networks.critics)
        loss = ((q1 - target_value).square() + (q2 - target_value).square()).mean()
        return loss, {"target_value": target_value}

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of the actor: minus the value that the first critic gives to its actions (Algorithm 1).

        Args:
            tensordict: ``(B,)`` transitions.

        Returns:
            A scalar, and all outputs of the actor with their gradient, such as ``logits`` and ``action``.
        """
        outputs = self.networks.actor(tensordict.select(*self.actor_network.in_keys))
        q1 = self.networks.frozen_critic(self._critic_input(tensordict, outputs["action"]))
        return -q1.mean(), {key: outputs[key] for key in self.actor_network.out_keys}

    def _critic_input(self, tensordict: TensorDictBase, action: Tensor) -> Tensor:
        return torch.cat([*(tensordict[key] for key in self.qvalue_network.in_keys[:-1]), action], -1)


def _holding(network: nn.Module, params: Any) -> Any:
    """Return a copy of a network that holds some parameters, sharing their memory."""
    copied = copy.deepcopy(network)
    params.to_module(copied, preserve_module_state=True)  # optimizers take the parameters of the copies
    return copied


class SoftUpdate(TorchRLSoftUpdate):
    """TorchRL's Polyak averaging of the target networks, in one call for all parameters.

    Example:
        >>> from magrl.navigators.networks import make_actor, make_critic
        >>> loss = TD3Loss(make_actor(13, (8,)), make_critic(13, (8,)), gamma=0.9, policy_noise=0.1, noise_clip=0.5)
        >>> SoftUpdate(loss, tau=0.25).step()
    """

    def step(self) -> None:
        """Move each target parameter by the share ``tau`` towards its source."""
        targets, sources = self._pair
        targets.lerp_(sources, 1 - self.eps)

    @cached_property
    def _pair(self) -> tuple[TensorDictBase, TensorDictBase]:
        return self._targets.data, self._sources.data


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
