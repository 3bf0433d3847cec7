"""Soft actor-critic (SAC) with gradient guidance: TorchRL's SACLoss on the scenario, tasks and reward of TD3.

    python recipes/sac.py                     # minutes on one core
    python recipes/sac.py --seed 1 --out runs/my-sac
    python recipes/sac.py --resume RUN        # resume an interrupted run exactly
See docs/algorithms.md.
"""

from __future__ import annotations

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # spinning threads slow each other down; read when torch is imported

import math
from collections.abc import Sequence
from typing import Annotated, Literal

import torch
from pydantic import Field, model_validator
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torch.optim import Adam
from torchrl.collectors import BaseCollector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, RewardScaling, RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss, SoftUpdate

from magrl.agents import FieldPolicy, PolicyConfig, make_critic, optimize, saturation_penalty
from magrl.envs import GeomagneticNavEnv
from magrl.training import Run, RunConfig, command, parse_config
from magrl.training.collectors import make_collector
from magrl.training.config import Count, Discount, NonNegative, Positive, PositiveShare, Widths
from magrl.transforms import AlignmentReward, DistanceCost, FieldGradient, GradientHeading, ObservationView, SensorNoise

RECIPE = "sac.py"
LOSSES = ("loss_critic", "loss_actor", "loss_alpha", "alpha")
TRANSITION = ("observation", "action", *(("next", k) for k in ("observation", "reward", "done", "terminated")))


class Config(RunConfig):
    """Settings of a training."""

    # Environment
    start_heading: Literal["north", "random"] = "north"
    """Heading at the start of an episode."""
    alignment_weight: float = 3.0
    """Weight zeta_3 of the alignment reward (Eq. 3-6) [1/rad]."""
    alignment_offset: float = math.pi / 4
    """Heading deviation at which the alignment reward changes sign [rad]."""
    distance_cost: NonNegative = 0.1
    """Cost of a move [1/km]."""

    # Networks
    num_cells: Widths = (128, 128, 128)
    """Width of each hidden layer."""
    layer_norm: bool = True
    """Layer normalization in actor and critics."""
    scale_cells: Widths = (64,)
    """Width of each hidden layer of the network of the actor's standard deviation."""

    # SAC
    updates_per_batch: Count = 8
    """Gradient steps after each step of all vehicles."""
    batch_size: Count = 1024
    """Transitions per gradient step."""
    buffer_size: Count = 200_000
    """Capacity of the replay buffer [transitions]."""
    init_random_frames: Annotated[int, Field(ge=0)] = 1024
    """Steps with random actions before the policy acts."""
    gamma: Discount = 0.9
    """Discount factor."""
    tau: PositiveShare = 0.01
    """Polyak averaging factor of the target critics."""
    learning_rate: Positive = 2e-3
    """Learning rate of Adam at the start."""
    final_learning_rate: Positive = 4e-5
    """Learning rate at the end; linear in between."""
    alpha: Positive = 0.1
    """Weight of the entropy at the start."""
    alpha_learning_rate: Positive = 2e-3
    """Learning rate of the weight of the entropy."""
    target_entropy: float = -4.0
    """Mean entropy of the action that the weight of the entropy aims at [nat]."""
    reward_scale: Positive = 0.05
    """Factor on rewards for the critics; reported rewards are unscaled."""
    saturation_weight: NonNegative = 0.05
    """Weight of the penalty on the actor's mean before the tanh; falls linearly to 0."""

    @model_validator(mode="after")
    def _fits(self) -> Config:
        if self.buffer_size < self.batch_size:
            raise ValueError(f"buffer_size {self.buffer_size} does not hold one batch of {self.batch_size}")
        if self.batch_size > math.ceil(self.total_frames / self.num_envs) * self.num_envs:
            raise ValueError(f"batch_size {self.batch_size} must not exceed total_frames: no gradient step is possible")
        return self


def make_env(base: GeomagneticNavEnv, view: ObservationView, config: Config) -> TransformedEnv:
    """Add guidance by the true field, the sensors' noise, the agent's view and the scaled reward to the environment."""
    keys = ["reward", "reward_alignment"]
    guidance = [
        FieldGradient(base.field),
        GradientHeading(),
        AlignmentReward(out_keys=keys, weight=config.alignment_weight, offset=config.alignment_offset),
    ]
    sensors = [SensorNoise(config.noise, seed=base.seed)] if any(config.noise) else []
    scaling = [*view.observation_transforms(), view.action_transform()]
    rewards = [RewardSum(), DistanceCost(config.distance_cost), RewardScaling(loc=0.0, scale=config.reward_scale)]
    return TransformedEnv(base, Compose(*guidance, *sensors, *scaling, *rewards))


def make_stochastic_actor(
    actor: TensorDictSequential, env: TransformedEnv, view: ObservationView, config: Config
) -> ProbabilisticActor:
    """Return the actor of the training: a normal distribution whose mean is that of ``actor``, through a tanh.

    Its mean shares the weights of the deterministic ``actor``, which is evaluated and saved.
    """
    deviation = MLP(view.size, 2, num_cells=config.scale_cells, activation_class=nn.ReLU, device=env.device)
    scale = TensorDictModule(nn.Sequential(deviation, Deviation()), ["observation"], ["scale"])
    return ProbabilisticActor(
        TensorDictSequential(actor.module[0], scale),
        in_keys={"loc": "logits", "scale": "scale"},
        spec=env.action_spec_unbatched,
        distribution_class=TanhNormal,
    )


class Deviation(nn.Module):
    """Map numbers to standard deviations between two limits, on a logarithmic scale."""

    low, high = math.log(0.01), math.log(1.0)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return standard deviations of the shape of ``x``."""
        return (self.low + (self.high - self.low) * torch.sigmoid(x + 2.0)).exp()


def make_collection(
    env: TransformedEnv, actor: ProbabilisticActor, config: Config
) -> tuple[BaseCollector, TensorDictReplayBuffer]:
    """Return collector and replay buffer; a sample holds all batches of an iteration."""
    collector = make_collector(
        env,
        actor,
        frames_per_batch=config.num_envs,
        total_frames=config.total_frames,
        init_random_frames=config.init_random_frames,
    )
    storage = LazyTensorStorage(config.buffer_size, device=env.device)
    return collector, TensorDictReplayBuffer(storage=storage, batch_size=config.updates_per_batch * config.batch_size)


def train(config: Config) -> dict[str, float]:
    """Train, evaluate and write the run folder; return the content of its ``eval.json``."""
    torch.manual_seed(config.seed)
    with Run(config, recipe=RECIPE, name="sac", losses=LOSSES) as run:
        # Environments
        options = {"zeta": config.zeta, "start_heading": config.start_heading, "device": config.device}
        base = GeomagneticNavEnv(run.scenario.with_tasks(None), num_envs=config.num_envs, seed=config.seed, **options)
        validation, test = run.evaluation_envs(**options)
        view = base.observation_view()
        env = make_env(base, view, config)

        # Networks
        network = PolicyConfig(view, config.num_cells, config.layer_norm)
        actor = network.make_actor(env.device)
        stochastic_actor = make_stochastic_actor(actor, env, view, config)
        critic = make_critic(view.size, config.num_cells, layer_norm=config.layer_norm, device=env.device)

        # Loss, with two critics and a weight of the entropy that is learned
        loss = SACLoss(
            stochastic_actor,
            critic,
            loss_function="l2",
            alpha_init=config.alpha,
            target_entropy=config.target_entropy,
            deactivate_vmap=True,
        )
        loss.make_value_estimator(gamma=config.gamma)
        target_update = SoftUpdate(loss, tau=config.tau)
        networks = [*loss.actor_network_params.parameters(), *loss.qvalue_network_params.parameters()]
        optimizer = Adam(networks, lr=config.learning_rate, fused=True)
        alpha_optimizer = Adam([loss.log_alpha], lr=config.alpha_learning_rate)

        collector, buffer = make_collection(env, stochastic_actor, config)
        run.start(
            policy=FieldPolicy(network, actor).to(env.device),
            validation=validation,
            env=base,
            collector=collector,
            loss=loss,
            optimizer=optimizer,
            alpha_optimizer=alpha_optimizer,
            buffer=buffer,
        )
        stats = run.statistics
        for batch in run.batches():
            buffer.extend(batch.reshape(-1).select(*TRANSITION))
            optimizer.param_groups[0]["lr"] = config.linear("learning_rate", run.remaining)
            if len(buffer) < config.batch_size:
                continue
            for transitions in buffer.sample().split(config.batch_size):
                losses = loss(transitions).rename_key_("loss_qvalue", "loss_critic")
                total = losses["loss_critic"] + losses["loss_actor"] + losses["loss_alpha"]
                penalty = run.remaining * config.saturation_weight * saturation_penalty(actor(transitions)["logits"])
                optimize(total + penalty, optimizer, alpha_optimizer)
                target_update.step()  # Polyak averaging
                stats.updates += 1
            stats.losses = losses.select(*LOSSES).to_dict()
        return run.finish(test)


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line and train."""
    train(parse_config(Config, {"default": Config()}, RECIPE, __doc__, args))


if __name__ == "__main__":
    command(RECIPE, main)
