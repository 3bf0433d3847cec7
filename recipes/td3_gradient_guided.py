"""Gradient-Guided TD3: train an agent to navigate by the Earth's magnetic field.

    python recipes/td3_gradient_guided.py                     # preset fast, about a minute on two cores
    python recipes/td3_gradient_guided.py --preset td3-fast   # without guidance, by the task's reward
    python recipes/td3_gradient_guided.py --preset paper      # Table 1 and eight additions; hours on a CPU
    python recipes/td3_gradient_guided.py --task nogo         # around no-go areas; three minutes
    python recipes/td3_gradient_guided.py --task eddies       # in currents as fast as the vehicle; seven minutes
    python recipes/td3_gradient_guided.py --resume RUN        # resume an interrupted run exactly

See docs/start.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Annotated, Any, Literal

from magrl import paper
from magrl.envs import GeomagneticNavEnv, Scenario
from magrl.envs.navigation import guidance, spl_reward
from magrl.envs.scenario import rule_settings
from magrl.envs.specs import REWARD_TERMS
from magrl.errors import SensorErrors
from magrl.named_tasks import NAMED_TASKS
from magrl.navigators import FieldPolicy, PolicyConfig, make_critic
from magrl.training import Run, SoftUpdate, TD3Loss, command, mirrored, optimize, parse_config, saturation_penalty
from magrl.training.collectors import make_collector
from magrl.training.config import Count, NonNegative, Positive, PositiveShare, RegionConfig, make_presets, read_presets
from magrl.transforms import DistanceCost, EpisodeSum, Shield

import torch
from pydantic import Field, model_validator
from tensordict.nn import TensorDictSequential
from torch.optim import Adam
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import RewardScaling, RewardSum, Transform, TransformedEnv
from torchrl.modules import AdditiveGaussianModule

RECIPE = "td3_gradient_guided.py"
TRANSITION = ("observation", "action", *(("next", k) for k in ("observation", "reward", "done", "terminated")))
LOSSES = ("loss_critic", "loss_actor", "q_value", "learning_rate", "exploration_noise")
CONSTANT = {f"final_{name}": paper.TABLE_1[name] for name in ("learning_rate", "exploration_noise")}
"""The paper's rates do not change."""
TABLES = read_presets(__file__, table_1=paper.TABLE_1 | CONSTANT)
TASKS = tuple(dict.fromkeys(table["task"] for table in TABLES.values()))
UNIT = 20.0
"""Reward of the paper for a reward of 1 of the task: 200 for an arrival by the shortest path."""


class Config(rule_settings("start_heading"), RegionConfig):
    """Settings of a training; the defaults are the preset's."""

    preset: Literal[*TABLES] = "fast"  # type: ignore[valid-type]
    """Source of the defaults: tuned for two cores, or the paper's Table 1; td3- without guidance; or for a task."""
    task: Literal[*TASKS] = TASKS[0]  # type: ignore[valid-type]
    """Named task (docs/tasks.md)."""
    reward: Literal["base", "spl"] = "base"
    """Reward of the training: the paper's without its alignment, or the task's in the paper's unit."""
    guided: bool = True
    """Gradient guidance: the theoretical heading and its alignment reward."""
    shield: bool = False
    """Turn legs that would meet a no-go area in sight, in training and as a fixed last layer of the policy."""

    # Environment
    distance_cost: NonNegative = 0.0
    """Cost of a leg [1/km] in the reward base; none in the paper."""
    objective_limit: Positive | None = None
    """Upper bound on the objective in the proximity reward; 10 in preset paper."""
    time_limit_ends: bool = False
    """Treat the step limit as a termination, without a bootstrapped value; on in preset paper."""
    observe_heading: bool = True
    """Observe cosine and sine of the heading."""
    observe_difference: bool = True
    """Observe target elements minus measured elements."""

    alignment_weight: float = 3.0
    """Weight zeta_3 of the alignment reward (Eq. (12)) [1/rad]."""
    alignment_offset: float = math.pi / 4
    """Heading deviation at which the alignment reward changes sign [rad]."""
    reward_scale: Positive = 0.05
    """Factor on the rewards that the critics learn from; reported rewards are unscaled."""

    # Networks
    layer_norm: bool = True
    """Layer normalization in actor and critics."""

    # TD3
    buffer_size: Count = 200_000
    """Capacity of the replay buffer [transitions]."""
    tau: PositiveShare = 0.01
    """Polyak averaging factor of the target networks."""
    policy_delay: Count = 2
    """Critic updates per update of the actor and the target networks."""
    exploration_noise: NonNegative = 0.2
    """Standard deviation of the exploration noise at the start, for actions in [-1, 1]."""
    final_exploration_noise: NonNegative = 0.1
    """Standard deviation of the exploration noise at the end; linear in between."""
    policy_noise: NonNegative = 0.1
    """Standard deviation of the noise of target policy smoothing."""
    noise_clip: NonNegative = 0.5
    """Largest noise of target policy smoothing."""
    updates_per_batch: Count = 8
    """Gradient steps after each step of all vehicles."""
    batch_size: Count = 1024
    """Transitions per gradient step."""
    init_random_frames: Annotated[int, Field(ge=0)] = 1024
    """Number of initial steps with random actions."""

    @property
    def options(self) -> dict[str, Any]:
        """Options of the environment among the settings."""
        return self.rules | self.model_dump(include={"objective_limit", "device"})

    @model_validator(mode="after")
    def _fits(self) -> Config:
        start, end = self.exploration_noise, self.final_exploration_noise
        if end > start:
            raise ValueError(f"final_exploration_noise {end:g} must not exceed exploration_noise {start:g}")
        if self.buffer_size < self.batch_size:
            raise ValueError(f"buffer_size {self.buffer_size} does not hold one batch of {self.batch_size}")
        if self.batch_size > math.ceil(self.total_frames / self.num_envs) * self.num_envs:
            raise ValueError(f"batch_size {self.batch_size} must not exceed total_frames: no gradient step is possible")
        return self


PRESETS = make_presets(Config, TABLES)


def rewards(base: GeomagneticNavEnv, config: Config) -> list[Transform]:
    """Return the transforms of the reward of the training, with guidance, cost of the distance, sums, and scale."""
    task = [*spl_reward(), RewardScaling(0.0, UNIT)] if config.reward == "spl" else []
    keys = ["reward", "reward_alignment"]
    alignment = {"weight": config.alignment_weight, "offset": config.alignment_offset}
    guided = guidance(base, out_keys=keys, **alignment) if config.guided else []
    terms = [*(() if task else REWARD_TERMS), *(keys[1:] if guided else ())]
    sums = [RewardSum(), *([EpisodeSum(terms)] if terms else [])]
    cost = [] if task else [DistanceCost(config.distance_cost)]
    return [*task, *guided, *sums, *cost, RewardScaling(loc=0.0, scale=config.reward_scale)]


def make_env(scenario: Scenario, config: Config) -> TransformedEnv:
    """Return the environment of the training: the task with the reward, the sensors' noise and what is observed."""
    env = NAMED_TASKS[config.task].make(
        config.num_envs,
        scenario=scenario,
        seed=config.seed,
        reward=partial(rewards, config=config),
        transforms=[SensorErrors(config.noise, seed=config.seed)] if any(config.noise) else [],
        **config.options,
        **config.model_dump(include={"observe_heading", "observe_difference"}),
    )
    return env.insert_transform(1, Shield(env.max_turn_rad)) if config.shield else env  # after the areas


def make_collection(
    env: TransformedEnv, actor: TensorDictSequential, config: Config
) -> tuple[AdditiveGaussianModule, Collector, TensorDictReplayBuffer]:
    """Return exploration noise, collector and replay buffer; a sample holds all batches of an iteration."""
    noise = AdditiveGaussianModule(
        spec=env.action_spec_unbatched,
        sigma_init=config.exploration_noise,
        sigma_end=config.final_exploration_noise,
        annealing_num_steps=math.ceil(config.total_frames / config.num_envs),
        device=env.device,
    )
    collector = make_collector(
        env,
        TensorDictSequential(actor, noise),
        frames_per_batch=config.num_envs,
        total_frames=config.total_frames,
        init_random_frames=config.init_random_frames,
    )
    storage = LazyTensorStorage(config.buffer_size, device=env.device)
    buffer = TensorDictReplayBuffer(storage=storage, batch_size=config.updates_per_batch * config.batch_size)
    return noise, collector, buffer


def train(config: Config) -> dict[str, float]:
    """Train, evaluate and write the run folder; return the content of its ``eval.json``."""
    torch.manual_seed(config.seed)
    name = f"td3_gradient_guided-{config.preset}" if config.guided else f"td3-{config.preset.removeprefix('td3-')}"
    name += f"-{config.task}" if config.task != PRESETS[config.preset].task else ""
    with Run(config, recipe=RECIPE, name=name, losses=LOSSES) as run:
        # Environments
        env = make_env(run.scenario.with_trips(None), config)
        validation, test = run.evaluation_envs(NAMED_TASKS[config.task].make, **config.options)

        # Networks
        network = PolicyConfig(env.view, config.num_cells, config.layer_norm, config.shield)
        actor = network.make_actor(env.device)
        shape = {"layer_norm": config.layer_norm, "geometry": env.view.geometry}
        critic = make_critic(env.view.size, config.num_cells, **shape, device=env.device)

        # Loss, with clipped double Q and target policy smoothing
        options = config.model_dump(include={"gamma", "policy_noise", "noise_clip"})
        loss = TD3Loss(actor, critic, **options, terminated="done" if config.time_limit_ends else "terminated")
        target_update = SoftUpdate(loss, tau=config.tau)
        critic_optimizer = Adam(loss.critic_parameters(), lr=config.learning_rate, fused=True)
        actor_optimizer = Adam(loss.actor_parameters(), lr=config.learning_rate, fused=True)

        noise, collector, buffer = make_collection(env, actor, config)
        policy = FieldPolicy(network, actor).to(env.device)
        parts = {"critic_optimizer": critic_optimizer, "actor_optimizer": actor_optimizer, "noise": noise}
        parts |= {"loss": loss, "buffer": buffer}
        run.start(policy=policy, validation=validation, env=env.base_env, collector=collector, **parts)
        stats, mirror = run.statistics, env.view.mirror
        mirror = None if mirror is None else mirror.to(env.device)
        for batch in run.batches():
            buffer.extend(batch.reshape(-1).select(*TRANSITION))
            noise.step()
            stats.losses["exploration_noise"] = noise.sigma
            rate = config.linear("learning_rate", run.remaining)
            stats.losses["learning_rate"] = torch.tensor(rate, dtype=torch.float64)
            for optimizer in (critic_optimizer, actor_optimizer):
                optimizer.param_groups[0]["lr"] = rate
            if len(buffer) < config.batch_size:
                continue
            for sample in buffer.sample().split(config.batch_size):
                transitions = mirrored(sample, mirror)
                stats.losses["loss_critic"], values = loss.value_loss(transitions)
                stats.losses["q_value"] = values["target_value"].mean()
                optimize(stats.losses["loss_critic"], critic_optimizer)
                stats.updates += 1
                if stats.updates % config.policy_delay == 0:  # delayed updates of actor and targets
                    stats.losses["loss_actor"], outputs = loss.actor_loss(transitions)
                    penalty = run.remaining * config.saturation_weight * saturation_penalty(outputs["logits"])
                    optimize(stats.losses["loss_actor"] + penalty, actor_optimizer)
                    target_update.step()  # Polyak averaging
        return run.finish(test)


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line and train."""
    train(parse_config(Config, PRESETS, RECIPE, __doc__, args))


if __name__ == "__main__":
    command(RECIPE, main)
