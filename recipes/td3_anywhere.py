"""TD3 without a map: train on random planets an agent that finds its way on Earth by the estimates of its own track.

    python recipes/td3_anywhere.py                  # preset fast: destinations 300-500 km away
    python recipes/td3_anywhere.py --preset far     # destinations 150-1800 km away
    python recipes/td3_anywhere.py --resume RUN     # resume an interrupted run exactly

The regions are patches of planets whose magnetic fields have the spectrum and the polarity of the Earth's and nothing
else of it, and the noise of the sensors is drawn for each episode. The test tasks are on Earth, in regions that no
training sees.
"""

from __future__ import annotations

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # spinning threads slow each other down; read when torch is imported

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, Literal

import torch
from pydantic import Field, model_validator
from tensordict.nn import TensorDictSequential
from torch.optim import Adam
from torchrl.collectors import BaseCollector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, ObservationNorm, RewardSum, TransformedEnv
from torchrl.modules import AdditiveGaussianModule

from magrl import paper
from magrl.agents import FieldPolicy, PolicyConfig, SoftUpdate, TD3Loss, make_critic, optimize, saturation_penalty
from magrl.envs import GeomagneticNavEnv, Scenario, earth_scenario, planet_scenario
from magrl.training import Run, command, parse_config
from magrl.training.collectors import make_collector
from magrl.training.config import Count, Discount, NonNegative, Positive, Rising, TransitionConfig
from magrl.transforms import DetourReward, RandomSensorNoise, SensorNoise, TrackView, TrueWay, sensor_levels

RECIPE = "td3_anywhere.py"
LONGEST_KM = 4400.0
OBSERVED = ("observation", "true_way_scaled")
TRANSITION = (*OBSERVED, "action", *(("next", k) for k in (*OBSERVED, "reward", "done", "terminated")))


class Config(TransitionConfig):
    """Settings of a training; the defaults are those of the preset."""

    preset: Literal["fast", "far"] = "fast"
    """Source of the defaults: destinations 300-500 km away, or 150-1800 km."""

    # Own defaults of shared settings
    total_frames: Count = 1_228_800
    eval_every: Count = 200
    eval_tasks_small: Count = 500
    buffer_size: Count = 400_000
    init_random_frames: Annotated[int, Field(ge=0)] = 4096
    gamma: Discount = 0.99
    learning_rate: Positive = 1e-3
    final_learning_rate: Positive = 2e-5
    final_exploration_noise: NonNegative = 0.02
    noise_clip: NonNegative = 0.3
    saturation_weight: NonNegative = 0.02

    # Environment
    num_regions: Count = 2048
    """Number of training regions, two on each random planet."""
    distance_range_km: Rising = (300.0, 500.0)
    """Shortest and longest distance of a task [km]."""
    max_steps: Count = 50
    """Moves after which an episode is truncated."""
    range_km: Positive = 300.0
    """Prior standard deviation of the way to the destination along each axis [km]."""
    step_cost: NonNegative = 0.02
    """Penalty for each move; arriving is worth 10, and a detour as long as the task costs 10."""
    noise_exponent: Positive = 1.5
    """Exponent of the random levels of noise; the larger, the more noise (magrl.transforms.sensor_levels)."""

    @model_validator(mode="after")
    def _fits(self) -> Config:
        if self.scenario is not None:
            raise ValueError(f"scenario must be left out, got {self.scenario}: this agent trains on random planets")
        if self.distance_range_km[1] > LONGEST_KM:
            message = f"must end at {LONGEST_KM:g} km or below, the side of a region"
            raise ValueError(f"distance_range_km {message}, got {self.distance_range_km}")
        return self

    @property
    def regions(self) -> dict[str, Any]:
        """Options of the regions: large enough for the longest task, and how the distances are drawn."""
        if self.distance_range_km[1] > 500:
            size = {"half_size_deg": 20, "degree": 16, "max_latitude": 75, "distance_law": "log"}
        else:
            size = {"half_size_deg": 10, "degree": 12, "max_latitude": 70}
        return {"distance_range_km": self.distance_range_km, **size}


FAST = Config()
_LONG: dict[str, Any] = {"distance_range_km": (150.0, 1800.0), "range_km": 1000.0, "max_steps": 120}
FAR = Config(preset="far", **_LONG, total_frames=2_048_000, step_cost=0.08, noise_exponent=1.0, gamma=0.985)
PRESETS = {"fast": FAST, "far": FAR}


def sensors(config: Config, seed: int) -> SensorNoise:
    """Return the noise of the sensors: that of the settings, or by default levels drawn for each episode."""
    levels = partial(sensor_levels, exponent=config.noise_exponent)
    return SensorNoise(config.noise, seed=seed) if any(config.noise) else RandomSensorNoise(levels, seed=seed)


def make_view(base: GeomagneticNavEnv, range_km: float) -> TrackView:
    """Return what the agent observes: the estimates of its own track, with the limits of the environment."""
    limits = {name: getattr(base, name) for name in ("zeta", "max_steps", "max_move_km", "max_turn_rad")}
    return TrackView(**limits, range_km=range_km)


def make_env(base: GeomagneticNavEnv, view: TrackView, config: Config) -> TransformedEnv:
    """Add the sensors, the agent's view, and for training only the true way and the reward for a short path."""
    scaled_way = ObservationNorm(0.0, 1 / 200, ["true_way"], ["true_way_scaled"])
    privileged = [TrueWay(), scaled_way, DetourReward(step=config.step_cost), RewardSum(["reward"])]
    observed = [sensors(config, base.seed), *view.observation_transforms(), view.action_transform()]
    return TransformedEnv(base, Compose(*observed, *privileged))


def evaluation_env(scenario: Scenario, num_tasks: int, seed: int, config: Config, **options: Any) -> TransformedEnv:
    """Return an environment of random tasks of a scenario, drawn once, with the noise of the sensors."""
    tasks = scenario.random_tasks(num_tasks, seed)
    base = GeomagneticNavEnv(scenario.with_tasks(tasks), num_envs=num_tasks, seed=seed, **options)
    return TransformedEnv(base, sensors(config, seed))


def make_collection(
    env: TransformedEnv, actor: TensorDictSequential, config: Config
) -> tuple[AdditiveGaussianModule, BaseCollector, TensorDictReplayBuffer]:
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
    with Run(config, recipe=RECIPE, name=f"td3_anywhere-{config.preset}") as run:
        # Environments
        options = {"zeta": config.zeta, "max_steps": config.max_steps, "start_heading": "random"}
        options |= {"device": config.device}
        planets = planet_scenario(config.num_regions, seed=config.seed, **config.regions)
        base = GeomagneticNavEnv(planets, num_envs=config.num_envs, seed=config.seed, **options)
        others = planet_scenario(256, seed=paper.VALIDATION_SEED, **config.regions)
        validation = evaluation_env(others, config.eval_tasks_small, paper.VALIDATION_SEED, config, **options)
        earth = earth_scenario(128, seed=paper.TEST_SEED, **config.regions)
        test = evaluation_env(earth, config.eval_tasks, paper.TEST_SEED, config, **options)
        view = make_view(base, config.range_km)
        env = make_env(base, replace(view, search=False), config)  # trained for the way, flown with the search

        # Networks: the critics also read the true way, the actor never does
        network = PolicyConfig(view, config.num_cells)
        actor = network.make_actor(env.device)
        critic = make_critic(view.size + 2, config.num_cells, observation_keys=OBSERVED, device=env.device)

        # Loss, with clipped double Q and target policy smoothing
        loss = TD3Loss(
            actor, critic, gamma=config.gamma, policy_noise=config.policy_noise, noise_clip=config.noise_clip
        )
        target_update = SoftUpdate(loss, tau=config.tau)
        critic_optimizer = Adam(loss.critic_parameters(), lr=config.learning_rate, fused=True)
        actor_optimizer = Adam(loss.actor_parameters(), lr=config.learning_rate, fused=True)

        noise, collector, buffer = make_collection(env, actor, config)
        run.start(
            policy=FieldPolicy(network, actor).to(env.device),
            validation=validation,
            env=base,
            collector=collector,
            loss=loss,
            critic_optimizer=critic_optimizer,
            actor_optimizer=actor_optimizer,
            noise=noise,
            buffer=buffer,
        )
        stats = run.statistics
        for batch in run.batches():
            buffer.extend(batch.reshape(-1).select(*TRANSITION))
            noise.step()
            rate = config.linear("learning_rate", run.remaining)
            for optimizer in (critic_optimizer, actor_optimizer):
                optimizer.param_groups[0]["lr"] = rate
            if len(buffer) < config.batch_size:
                continue
            for transitions in buffer.sample().split(config.batch_size):
                stats.losses["loss_critic"], _ = loss.value_loss(transitions)
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
