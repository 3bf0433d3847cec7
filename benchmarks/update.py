"""The recipe's gradient step beside a hand-written one, and beside its matrix products alone."""

from __future__ import annotations

import copy
import itertools
import sys
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn import functional

from benchmarks.timing import Row, alternate
from magrl import td3
from magrl.env import GeomagneticNavEnv

sys.path.insert(0, str(Path(__file__).parent.parent / "recipes"))
from td3_gradient_guided import Config, Learner, step

CONFIG = Config()
SATURATION = CONFIG.saturation_weight


def view() -> td3.PolicyConfig:
    """What the recipe's networks see."""
    return td3.policy_config(GeomagneticNavEnv(seed=0), CONFIG.num_cells, layer_norm=CONFIG.layer_norm)


def transitions(size: int) -> TensorDict:
    """A batch of transitions of the recipe's shape."""

    def seen() -> Tensor:
        return torch.rand(CONFIG.batch_size, size) * 2 - 1

    flag = torch.zeros(CONFIG.batch_size, 1, dtype=torch.bool)
    after = {"observation": seen(), "reward": torch.randn(CONFIG.batch_size, 1), "done": flag, "terminated": flag}
    action = torch.rand(CONFIG.batch_size, 2) * 2 - 1
    return TensorDict({"observation": seen(), "action": action, "next": after}, batch_size=[CONFIG.batch_size])


class Plain:
    """TD3 as a careful user would write it in PyTorch: the same networks, losses, optimisers and target updates."""

    def __init__(self, size: int) -> None:
        self.actor, self.critics = self.network(size, 2), [self.network(size + 2, 1) for _ in range(2)]
        self.target_actor, self.target_critics = copy.deepcopy((self.actor, self.critics))
        self.critic_weights = [p for critic in self.critics for p in critic.parameters()]
        self.critic_optimiser = torch.optim.Adam(self.critic_weights, lr=CONFIG.learning_rate, fused=True)
        self.actor_optimiser = torch.optim.Adam(self.actor.parameters(), lr=CONFIG.learning_rate, fused=True)
        self.weights = [*self.actor.parameters(), *self.critic_weights]
        targets = [p for critic in self.target_critics for p in critic.parameters()]
        self.target_weights = [*self.target_actor.parameters(), *targets]
        self.updates = 0

    @staticmethod
    def network(inputs: int, outputs: int) -> nn.Sequential:
        """Hidden layers with normalisation, as in the recipe."""
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
        step(self.critic_optimiser, sum(functional.mse_loss(critic(seen), target) for critic in self.critics))
        self.updates += 1
        if self.updates % CONFIG.policy_delay == 0:
            logits = self.actor(observation)
            for weight in self.critic_weights:
                weight.requires_grad_(False)
            value = self.critics[0](torch.cat((observation, logits.tanh()), -1)).mean()
            step(self.actor_optimiser, SATURATION * logits.square().mean() - value)
            for weight in self.critic_weights:
                weight.requires_grad_(True)
            with torch.no_grad():
                torch._foreach_lerp_(self.target_weights, self.weights, CONFIG.tau)


class Products:
    """The matrix products of a gradient step, and nothing else."""

    def __init__(self, size: int) -> None:
        actor = [size, *CONFIG.num_cells, 2]
        critic = [size + 2, *CONFIG.num_cells, 1]
        batch = CONFIG.batch_size
        # Target actor and critics forward; critics forward, gradients of weights, gradients of all but the inputs.
        self.critic_step = self.forward(actor, batch) + 4 * self.forward(critic, batch)
        self.critic_step += 2 * (self.weights(critic, batch) + self.inputs(critic, batch)[1:])
        # Actor and one critic forward, back through the critic to the action, back through the actor.
        self.actor_step = self.forward(actor, batch) + self.forward(critic, batch) + self.inputs(critic, batch)
        self.actor_step += self.weights(actor, batch) + self.inputs(actor, batch)[1:]
        self.updates = 0

    @staticmethod
    def forward(sizes: list[int], batch: int) -> list[tuple[Tensor, Tensor]]:
        """Inputs by weights."""
        return [(torch.rand(batch, a), torch.rand(b, a).t()) for a, b in itertools.pairwise(sizes)]

    @staticmethod
    def weights(sizes: list[int], batch: int) -> list[tuple[Tensor, Tensor]]:
        """Output gradients by inputs."""
        return [(torch.rand(batch, b).t(), torch.rand(batch, a)) for a, b in itertools.pairwise(sizes)]

    @staticmethod
    def inputs(sizes: list[int], batch: int) -> list[tuple[Tensor, Tensor]]:
        """Output gradients by weights."""
        return [(torch.rand(batch, b), torch.rand(b, a)) for a, b in itertools.pairwise(sizes)]

    def update(self) -> None:
        """The products of a step of the critics, and every second time of the actor."""
        self.updates += 1
        for left, right in self.critic_step + (self.actor_step if self.updates % CONFIG.policy_delay == 0 else []):
            torch.mm(left, right)


def rows(repeats: int = 15) -> list[Row]:
    """The two comparisons; a time is the mean of ten steps."""
    torch.manual_seed(0)
    seen = view()
    size = td3.observation_size(seen)
    learner, plain, products = Learner(CONFIG, seen, torch.device("cpu")), Plain(size), Products(size)
    batch = transitions(size)
    after = batch["next"]
    tensors = (batch["observation"], batch["action"], after["reward"], after["observation"], after["terminated"])

    def ours() -> None:
        learner.update(batch, SATURATION)

    options = {"repeats": repeats, "inner": 10}
    return [
        alternate(
            "gradient step: plain PyTorch / recipe", ours, lambda: plain.update(*tensors), goal="≥ 0.87", **options
        ),
        alternate("gradient step: products alone / recipe", ours, products.update, goal="≥ 0.56", **options),
    ]


if __name__ == "__main__":
    for row in rows():
        print(row)
