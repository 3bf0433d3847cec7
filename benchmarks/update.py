"""Gradient step of the recipe beside plain PyTorch and TorchRL's loss."""

from __future__ import annotations

import copy
import sys
from pathlib import Path

from benchmarks.timing import Row, alternate
from magrl.navigators import make_actor, make_critic
from magrl.training import SoftUpdate, TD3Loss, optimize, saturation_penalty

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional
from torchrl.data import Bounded
from torchrl.objectives import SoftUpdate as TorchRLSoftUpdate
from torchrl.objectives import TD3Loss as TorchRLTD3Loss

sys.path.insert(0, str(Path(__file__).parent.parent / "recipes"))
from td3_gradient_guided import Config

CONFIG = Config()
SATURATION = CONFIG.saturation_weight
OBSERVATION_SIZE = 13


def transitions(size: int, batch: int) -> TensorDict:
    """Return a batch of transitions of the recipe's shape."""

    def seen() -> Tensor:
        return torch.rand(batch, size) * 2 - 1

    flag = torch.zeros(batch, 1, dtype=torch.bool)
    after = {"observation": seen(), "reward": torch.randn(batch, 1), "done": flag, "terminated": flag}
    action = torch.rand(batch, 2) * 2 - 1
    return TensorDict({"observation": seen(), "action": action, "next": after}, batch_size=[batch])


class Recipe:
    """The body of the recipe's loop over batches, with the same parts."""

    def __init__(self, size: int) -> None:
        shape = {"num_cells": CONFIG.num_cells, "layer_norm": CONFIG.layer_norm}
        noise = {"policy_noise": CONFIG.policy_noise, "noise_clip": CONFIG.noise_clip}
        self.loss = TD3Loss(make_actor(size, **shape), make_critic(size, **shape), gamma=CONFIG.gamma, **noise)
        self.target_update = SoftUpdate(self.loss, tau=CONFIG.tau)
        self.critic_optimizer = torch.optim.Adam(self.loss.critic_parameters(), lr=CONFIG.learning_rate, fused=True)
        self.actor_optimizer = torch.optim.Adam(self.loss.actor_parameters(), lr=CONFIG.learning_rate, fused=True)
        self.updates = 0

    def update(self, batch: TensorDict) -> None:
        """One gradient step of the critics, and every second time of the actor and the targets."""
        loss_critic, _ = self.loss.value_loss(batch)
        optimize(loss_critic, self.critic_optimizer)
        self.updates += 1
        if self.updates % CONFIG.policy_delay == 0:
            loss_actor, outputs = self.loss.actor_loss(batch)
            optimize(loss_actor + SATURATION * saturation_penalty(outputs["logits"]), self.actor_optimizer)
            self.target_update.step()


class Stock:
    """The step of the recipe with TorchRL's loss and target update; its loss gives no outputs for the penalty."""

    def __init__(self, size: int) -> None:
        shape = {"num_cells": CONFIG.num_cells, "layer_norm": CONFIG.layer_norm}
        options = {"policy_noise": CONFIG.policy_noise, "noise_clip": CONFIG.noise_clip, "loss_function": "l2"}
        networks = make_actor(size, **shape), make_critic(size, **shape)
        self.loss = TorchRLTD3Loss(*networks, action_spec=Bounded(-1.0, 1.0, (2,)), **options)
        self.loss.make_value_estimator(gamma=CONFIG.gamma)
        self.target_update = TorchRLSoftUpdate(self.loss, tau=CONFIG.tau)
        self.critic_optimizer, self.actor_optimizer = (
            torch.optim.Adam([p for p in weights.parameters() if p.requires_grad], lr=CONFIG.learning_rate, fused=True)
            for weights in (self.loss.qvalue_network_params, self.loss.actor_network_params)
        )
        self.updates = 0

    def update(self, batch: TensorDict) -> None:
        """One gradient step of the critics, and every second time of the actor and the targets."""
        optimize(self.loss.value_loss(batch)[0], self.critic_optimizer)
        self.updates += 1
        if self.updates % CONFIG.policy_delay == 0:
            optimize(self.loss.actor_loss(batch)[0], self.actor_optimizer)
            self.target_update.step()


class Plain:
    """TD3 as a careful user would write it in PyTorch: the same networks, losses, optimizers and target updates."""

    def __init__(self, size: int) -> None:
        self.actor, self.critics = self.network(size, 2), [self.network(size + 2, 1) for _ in range(2)]
        self.target_actor, self.target_critics = copy.deepcopy((self.actor, self.critics))
        self.critic_weights = [p for critic in self.critics for p in critic.parameters()]
        self.critic_optimizer = torch.optim.Adam(self.critic_weights, lr=CONFIG.learning_rate, fused=True)
        self.actor_optimizer = torch.optim.Adam(self.actor.parameters(), lr=CONFIG.learning_rate, fused=True)
        self.weights = [*self.actor.parameters(), *self.critic_weights]
        targets = [p for critic in self.target_critics for p in critic.parameters()]
        self.target_weights = [*self.target_actor.parameters(), *targets]
        self.updates = 0

    @staticmethod
    def network(inputs: int, outputs: int) -> nn.Sequential:
        """Return hidden layers with normalization, as in the recipe."""
        layers: list[nn.Module] = []
        for width in CONFIG.num_cells:
            layers += [nn.Linear(inputs, width), nn.LayerNorm(width), nn.ReLU()]
            inputs = width
        return nn.Sequential(*layers, nn.Linear(inputs, outputs))

    def update(self, observation: Tensor, action: Tensor, reward: Tensor, after: Tensor, terminated: Tensor) -> None:
        """One gradient step of the critics, and every second time of the actor and the targets."""
        with torch.no_grad():
            noise = (torch.randn_like(action) * CONFIG.policy_noise).clamp(-CONFIG.noise_clip, CONFIG.noise_clip)
            next_input = torch.cat((after, (self.target_actor(after).tanh() + noise).clamp(-1, 1)), -1)
            value = torch.min(*(critic(next_input) for critic in self.target_critics))
            target = reward + CONFIG.gamma * value * ~terminated
        seen = torch.cat((observation, action), -1)
        loss = sum(functional.mse_loss(critic(seen), target) for critic in self.critics)
        loss.backward()
        self.critic_optimizer.step()
        self.critic_optimizer.zero_grad()
        self.updates += 1
        if self.updates % CONFIG.policy_delay == 0:
            logits = self.actor(observation)
            for weight in self.critic_weights:
                weight.requires_grad_(False)
            value = self.critics[0](torch.cat((observation, logits.tanh()), -1)).mean()
            (SATURATION * logits.square().mean() - value).backward()
            self.actor_optimizer.step()
            self.actor_optimizer.zero_grad()
            for weight in self.critic_weights:
                weight.requires_grad_(True)
            with torch.no_grad():
                torch._foreach_lerp_(self.target_weights, self.weights, CONFIG.tau)


def rows(repeats: int = 15) -> list[Row]:
    """Return the comparisons of the preset fast; a time is the mean of ten steps."""
    torch.manual_seed(0)
    recipe, plain, stock = (kind(OBSERVATION_SIZE) for kind in (Recipe, Plain, Stock))
    batch = transitions(OBSERVATION_SIZE, CONFIG.batch_size)
    after = batch["next"]
    tensors = (batch["observation"], batch["action"], after["reward"], after["observation"], after["terminated"])
    return [
        alternate(what, magrl, baseline, goal=goal, repeats=repeats, inner=10)
        for what, magrl, baseline, goal in (
            ("gradient step: plain PyTorch", lambda: recipe.update(batch), lambda: plain.update(*tensors), "≥ 0.95"),
            ("gradient step: TorchRL's TD3Loss", lambda: recipe.update(batch), lambda: stock.update(batch), "≥ 1"),
        )
    ]


if __name__ == "__main__":
    for row in rows():
        print(row)
