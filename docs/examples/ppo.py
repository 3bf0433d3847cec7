"""Proximal policy optimization (PPO) with gradient guidance: TorchRL's ClipPPOLoss and GAE on the tasks of TD3.

    python docs/examples/ppo.py                     # minutes on one core
    python docs/examples/ppo.py --seed 1 --out runs/my-ppo
    python docs/examples/ppo.py --resume RUN        # resume an interrupted run exactly
See docs/training.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from magrl.agents import FieldPolicy, PolicyConfig, optimize, saturation_penalty
from magrl.envs import GeomagneticNavEnv
from magrl.envs.scenario import rule_settings
from magrl.envs.specs import REWARD_TERMS
from magrl.training import Run, command, parse_config
from magrl.training.config import Count, NonNegative, Positive, RegionConfig, Share
from magrl.training.run import make_collector
from magrl.transforms import (
    AlignmentReward,
    DistanceCost,
    EpisodeSum,
    FieldGradient,
    GradientHeading,
    ObservationView,
    SensorErrors,
)

import torch
from pydantic import model_validator
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule, TensorDictSequential
from torch import nn
from torch.optim import Adam
from torchrl.envs import Compose, RewardScaling, RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

RECIPE = "ppo.py"
LOSSES = ("loss_critic", "loss_actor", "loss_entropy", "entropy")
LOSSES += ("kl_approx", "clip_fraction", "explained_variance")
NEXT = ("observation", "reward", "done", "terminated")
TRANSITION = ("observation", "action", "action_log_prob", *(("next", k) for k in NEXT))


class Config(rule_settings("start_heading"), RegionConfig):
    """Settings of a training."""

    # Own defaults of shared settings
    total_frames: Count = 393_216
    eval_every: Count = 8
    learning_rate: Positive = 1e-3
    final_learning_rate: Positive = 2e-5

    # Environment
    distance_cost: NonNegative = 0.1
    """Cost of a leg [1/km]."""
    alignment_weight: float = 3.0
    """Weight zeta_3 of the alignment reward (Eq. 3-6) [1/rad]."""
    alignment_offset: float = math.pi / 4
    """Heading deviation at which the alignment reward changes sign [rad]."""
    reward_scale: Positive = 0.05
    """Factor on the rewards that the critics learn from; reported rewards are unscaled."""

    # Networks
    layer_norm: bool = True
    """Layer normalization in the actor."""

    # PPO
    steps_per_batch: Count = 16
    """Steps of each vehicle in a collected batch."""
    epochs: Count = 8
    """Epochs over each collected batch."""
    batch_size: Count = 1024
    """Transitions per gradient step."""
    gae_lambda: Share = 0.95
    """Factor lambda of the generalized advantage estimate."""
    clip_epsilon: Positive = 0.2
    """Clipping range of the probability ratio."""
    clip_gradient: Positive = 1.0
    """Largest norm of the gradients."""
    entropy_weight: NonNegative = 0.0
    """Weight of the entropy of the action."""
    scale: Positive = 0.5
    """Standard deviation of the action before the tanh at the start."""

    @model_validator(mode="after")
    def _fits(self) -> Config:
        if self.batch_size > (frames := self.num_envs * self.steps_per_batch):
            raise ValueError(f"batch_size {self.batch_size} must not exceed num_envs * steps_per_batch, {frames}")
        return self


def make_env(base: GeomagneticNavEnv, view: ObservationView, config: Config) -> TransformedEnv:
    """Add guidance by the true field, the sensors' noise, the agent's view and the scaled reward to the environment."""
    keys = ["reward", "reward_alignment"]
    guidance = [
        FieldGradient(base.field),
        GradientHeading(),
        AlignmentReward(out_keys=keys, weight=config.alignment_weight, offset=config.alignment_offset),
    ]
    sensors = [SensorErrors(config.noise, seed=base.seed)] if any(config.noise) else []
    scaling = [*view.observation_transforms(), view.action_transform()]
    sums = [RewardSum(), EpisodeSum([*REWARD_TERMS, keys[1]])]
    rewards = [*sums, DistanceCost(config.distance_cost), RewardScaling(loc=0.0, scale=config.reward_scale)]
    return TransformedEnv(base, Compose(*guidance, *sensors, *scaling, *rewards))


def make_stochastic_actor(actor: TensorDictSequential, env: TransformedEnv, config: Config) -> ProbabilisticActor:
    """Return the actor of the training: a normal distribution around the mean of ``actor``, through a tanh.

    Its mean shares the weights of the deterministic ``actor``, which is evaluated and saved; its standard deviation is
    a parameter.
    """
    scale = AddStateIndependentNormalScale(2, device=env.device)
    nn.init.constant_(scale.state_independent_scale, math.log(config.scale))
    return ProbabilisticActor(
        TensorDictSequential(actor.module[0], TensorDictModule(scale, ["logits"], ["loc", "scale"])),
        in_keys=["loc", "scale"],
        spec=env.action_spec_unbatched,
        distribution_class=TanhNormal,
        return_log_prob=True,
    )


def train(config: Config) -> dict[str, float]:
    """Train, evaluate and write the run folder; return the content of its ``eval.json``."""
    torch.manual_seed(config.seed)
    with Run(config, recipe=RECIPE, name="ppo", losses=LOSSES) as run:
        # Environments
        options = config.rules | {"device": config.device}
        base = GeomagneticNavEnv(run.scenario.with_tasks(None), num_envs=config.num_envs, seed=config.seed, **options)
        validation, test = run.evaluation_envs(**options)
        view = base.observation_view()
        env = make_env(base, view, config)

        # Networks
        network = PolicyConfig(view, config.num_cells, config.layer_norm)
        actor = network.make_actor(env.device)
        stochastic_actor = make_stochastic_actor(actor, env, config)
        value = MLP(view.size, 1, num_cells=config.num_cells, activation_class=nn.ReLU, device=env.device)
        critic = ValueOperator(value, in_keys=["observation"])

        # Advantages and loss with a clipped probability ratio
        advantage = GAE(gamma=config.gamma, lmbda=config.gae_lambda, value_network=critic, deactivate_vmap=True)
        loss = ClipPPOLoss(
            stochastic_actor,
            critic,
            clip_epsilon=config.clip_epsilon,
            entropy_coeff=config.entropy_weight,
            normalize_advantage=True,
            loss_critic_type="l2",
        )
        weights = list(loss.parameters())
        optimizer = Adam(weights, lr=config.learning_rate, fused=True)

        frames = {"frames_per_batch": config.num_envs * config.steps_per_batch, "total_frames": config.total_frames}
        collector = make_collector(env, stochastic_actor, **frames)
        policy = FieldPolicy(network, actor).to(env.device)
        run.start(policy=policy, validation=validation, env=base, collector=collector, loss=loss, optimizer=optimizer)
        stats = run.statistics
        for batch in run.batches():
            optimizer.param_groups[0]["lr"] = config.linear("learning_rate", run.remaining)
            for _ in range(config.epochs):
                with torch.no_grad():
                    transitions = advantage(batch.select(*TRANSITION)).reshape(-1)
                for indices in torch.randperm(len(transitions), device=env.device).split(config.batch_size):
                    sample = transitions[indices]
                    losses = loss(sample).rename_key_("loss_objective", "loss_actor")
                    total = losses["loss_actor"] + losses["loss_critic"] + losses["loss_entropy"]
                    penalty = run.remaining * config.saturation_weight * saturation_penalty(actor(sample)["logits"])
                    optimize(total + penalty, optimizer, clip=weights, max_norm=config.clip_gradient)
                    stats.updates += 1
            stats.losses = losses.select(*LOSSES).to_dict()
        return run.finish(test)


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line and train."""
    train(parse_config(Config, {"default": Config()}, RECIPE, __doc__, args))


if __name__ == "__main__":
    command(RECIPE, main)
