"""Recurrent TD3: train an agent that observes the paper's eight numbers, and no heading.

    python recipes/td3_recurrent.py                # about four minutes on one core
    python recipes/td3_recurrent.py --resume RUN   # resume an interrupted run exactly

It also observes their difference to the target. The state of Eq. 3-1 does not hold the heading from which turns are
counted, so the memoryless agent of td3_gradient_guided.py does not learn from it. This agent has an LSTM that sums the
turns. The critics read the true heading in training (asymmetric actor-critic). Expected: SR 95-100 %, SPL 87-97 %.
"""

from __future__ import annotations

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # spinning threads slow each other down; read when torch is imported

from collections.abc import Sequence
from typing import Annotated

import torch
from pydantic import Field, model_validator
from tensordict.nn import TensorDictSequential
from torch.optim import Adam
from torchrl.collectors import BaseCollector
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.envs import Compose, RewardScaling, RewardSum, TransformedEnv
from torchrl.modules import AdditiveGaussianModule, EGreedyModule

from magrl.agents import (
    FieldPolicy,
    PolicyConfig,
    RecurrentTD3Loss,
    SoftUpdate,
    make_critic,
    optimize,
    recurrent_transforms,
    saturation_penalty,
)
from magrl.agents.recurrent import STATE_KEYS
from magrl.envs import GeomagneticNavEnv
from magrl.training import Run, command, parse_config
from magrl.training.collectors import make_collector
from magrl.training.config import Count, GuidanceConfig, NonNegative, Positive, PositiveShare, Share, TD3Config
from magrl.transforms import AlignmentReward, FieldGradient, GradientHeading, ObservationView, SensorNoise

RECIPE = "td3_recurrent.py"
LOSSES = ("loss_critic", "loss_actor", "loss_heading")
OBSERVED = ("observation", "move_scaled", "heading_vector", *STATE_KEYS)
TRANSITION = (*OBSERVED, "is_init", "action", *(("next", k) for k in (*OBSERVED, "reward", "done", "terminated")))


class Config(TD3Config, GuidanceConfig):
    """Settings of a training."""

    # Own defaults of shared settings
    total_frames: Count = 163_840
    eval_every: Count = 10
    buffer_size: Count = 163_840
    exploration_noise: NonNegative = 0.5
    alignment_offset: float = 0.0  # the paper's pi / 4 pays for short steps

    # Environment
    train_steps: Count = 24
    """Step limit of training episodes; evaluation episodes have 50. Short episodes are replayed whole."""
    shortest_task_km: Positive = 100.0
    """Shortest distance of training tasks [km]; evaluation tasks keep the paper's. Near destinations are found by
    chance, which teaches the critics the reward for arriving."""

    # Networks
    memory_size: Count = 64
    """Width of the LSTM."""

    # TD3
    steps_per_batch: Annotated[int, Field(ge=2)] = 4
    """Steps of all vehicles between rounds of updates."""
    updates_per_step: Count = 16
    """Gradient steps per step of all vehicles."""
    num_slices: Count = 43
    """Slices of episodes per gradient step."""
    slice_length: Count = 24
    """Longest slice [steps]."""
    memory_rate: Positive = 5.0
    """Learning rate of the LSTM, as a multiple of the actor's."""
    heading_weight: NonNegative = 0.0
    """Weight of an auxiliary loss that teaches the LSTM the heading."""
    noise_share: PositiveShare = 0.3
    """Share of the training in which the exploration noise falls."""
    random_share: Share = 0.1
    """Share of training actions that are drawn at random."""
    clip_memory: Positive = 1.0
    """Largest norm of the gradient of the LSTM."""

    @model_validator(mode="after")
    def _fits(self) -> Config:
        if self.num_envs < 2:
            raise ValueError(f"num_envs must be at least 2, got {self.num_envs}: slices need a batch of vehicles")
        if self.buffer_size < self.num_envs * self.steps_per_batch:
            raise ValueError(f"buffer_size {self.buffer_size} does not hold num_envs * steps_per_batch transitions")
        if self.shortest_task_km >= (longest := self.load_scenario().distance_range_km[1]):
            raise ValueError(f"shortest_task_km must be below {longest:g}, got {self.shortest_task_km}")
        return self


def make_env(
    base: GeomagneticNavEnv, view: ObservationView, actor: TensorDictSequential, config: Config
) -> TransformedEnv:
    """Add guidance by the true field, the sensors' noise, the agent's view and state, and the scaled reward."""
    keys = ["reward", "reward_alignment"]
    guidance = [
        FieldGradient(base.field),
        GradientHeading(),
        AlignmentReward(out_keys=keys, weight=config.alignment_weight, offset=config.alignment_offset),
    ]
    sensors = [SensorNoise(config.noise, seed=base.seed)] if any(config.noise) else []
    scaling = [*recurrent_transforms(view, actor), view.action_transform()]
    rewards = [RewardSum(), RewardScaling(loc=0.0, scale=config.reward_scale)]
    return TransformedEnv(base, Compose(*guidance, *sensors, *scaling, *rewards))


def make_collection(
    env: TransformedEnv, actor: TensorDictSequential, config: Config
) -> tuple[AdditiveGaussianModule, BaseCollector, TensorDictReplayBuffer]:
    """Return exploration noise, collector and replay buffer; the steps of a vehicle follow each other in the buffer."""
    spec = env.action_spec_unbatched
    noise = AdditiveGaussianModule(
        spec=spec,
        sigma_init=config.exploration_noise,
        sigma_end=config.final_exploration_noise,
        annealing_num_steps=int(config.noise_share * config.total_frames),
        device=env.device,
    )
    random = EGreedyModule(spec=spec, eps_init=config.random_share, eps_end=config.random_share, device=env.device)
    exploration = TensorDictSequential(actor, noise, random)
    frames = config.steps_per_batch * config.num_envs
    collector = make_collector(env, exploration, frames_per_batch=frames, total_frames=config.total_frames)
    length, storage = config.slice_length, LazyTensorStorage(config.buffer_size, ndim=2, device=env.device)
    sampler = SliceSampler(slice_len=length, end_key=("next", "done"), strict_length=False, cache_values=True)
    return (
        noise,
        collector,
        TensorDictReplayBuffer(storage=storage, sampler=sampler, batch_size=config.num_slices * length),
    )


def make_base(run: Run, config: Config) -> GeomagneticNavEnv:
    """Return the environment of training: nearer destinations and shorter episodes than in the evaluations."""
    distances = (config.shortest_task_km, run.scenario.distance_range_km[1])
    near = run.scenario.with_tasks(None).replace(distance_range_km=distances)
    options = {"zeta": config.zeta, "max_steps": config.train_steps, "seed": config.seed, "device": config.device}
    return GeomagneticNavEnv(near, num_envs=config.num_envs, **options)


def train(config: Config) -> dict[str, float]:
    """Train, evaluate and write the run folder; return the content of its ``eval.json``."""
    torch.manual_seed(config.seed)
    with Run(config, recipe=RECIPE, name="td3_recurrent", losses=LOSSES) as run:
        # Environments
        base = make_base(run, config)
        validation, test = run.evaluation_envs(zeta=config.zeta, device=config.device)
        view = base.observation_view(observe_heading=False)

        # Networks: the critics also read the heading
        network = PolicyConfig(view, config.num_cells, memory_size=config.memory_size)
        actor = network.make_actor(base.device)
        keys = ("observation", "heading_vector")
        critic = make_critic(view.size + 2, config.num_cells, observation_keys=keys, device=base.device)
        env = make_env(base, view, actor, config)

        # Loss, with clipped double Q and target policy smoothing
        loss = RecurrentTD3Loss(
            actor, critic, gamma=config.gamma, policy_noise=config.policy_noise, noise_clip=config.noise_clip
        )
        target_update = SoftUpdate(loss, tau=config.tau)
        critic_optimizer = Adam(loss.critic_parameters(), lr=config.learning_rate, fused=True)
        actor_optimizer = Adam(loss.actor_parameters(), lr=config.learning_rate, fused=True)
        memory_optimizer = Adam(loss.memory_parameters(), lr=config.memory_rate * config.learning_rate, fused=True)

        noise, collector, buffer = make_collection(env, actor, config)
        run.start(
            policy=FieldPolicy(network, actor).to(env.device),
            validation=validation,
            env=base,
            collector=collector,
            loss=loss,
            critic_optimizer=critic_optimizer,
            actor_optimizer=actor_optimizer,
            memory_optimizer=memory_optimizer,
            noise=noise,
            buffer=buffer,
        )
        stats = run.statistics
        for batch in run.batches():
            buffer.extend(batch.select(*TRANSITION))
            noise.step(batch.numel())
            rate = config.linear("learning_rate", run.remaining)
            for optimizer in (critic_optimizer, actor_optimizer):
                optimizer.param_groups[0]["lr"] = rate
            memory_optimizer.param_groups[0]["lr"] = config.memory_rate * rate
            for _ in range(config.steps_per_batch * config.updates_per_step):
                slices = buffer.sample()
                stats.losses["loss_critic"], _ = loss.value_loss(slices)
                optimize(stats.losses["loss_critic"], critic_optimizer)
                stats.updates += 1
                if stats.updates % config.policy_delay == 0:  # delayed updates of actor and targets
                    stats.losses["loss_actor"], outputs = loss.actor_loss(slices)
                    error = (outputs["heading_estimate"] - slices["heading_vector"]).square().sum(-1).mean()
                    stats.losses["loss_heading"] = error
                    penalty = run.remaining * config.saturation_weight * saturation_penalty(outputs["logits"])
                    total = stats.losses["loss_actor"] + config.heading_weight * error + penalty
                    memory = loss.memory_parameters()
                    optimize(total, actor_optimizer, memory_optimizer, clip=memory, max_norm=config.clip_memory)
                    target_update.step()  # Polyak averaging
        return run.finish(test)


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line and train."""
    train(parse_config(Config, {"default": Config()}, RECIPE, __doc__, args))


if __name__ == "__main__":
    command(RECIPE, main)
