"""PPO without a map: train on random planets an agent that navigates the Earth by the estimates of its own track.

    python recipes/ppo_anywhere.py                  # preset far: destinations 150-1800 km away
    python recipes/ppo_anywhere.py --preset fast    # destinations 300-500 km away
    python recipes/ppo_anywhere.py --arrival declared --max-steps 80 --price-range 0.01 0.1
    python recipes/ppo_anywhere.py --resume RUN     # resume an interrupted run exactly
    python recipes/ppo_anywhere.py --collectors 8 --address auto    # on a Ray cluster (docs/machines.md)

The agent corrects the leg that dual control plans, so that it begins as the navigator `kalman`. The regions are
patches of planets whose magnetic fields share only the spectrum and the polarity of the Earth's. The
errors of the sensors and the price of a step are drawn for each episode. The test trips are on Earth, in regions that
no training sees. With --arrival declared, vehicles declare their arrival by the rule of `DeclareArrival`, and a false
arrival has an SPL of 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Annotated, Any, Literal

from magrl import Anywhere
from magrl.envs import GeomagneticNavEnv, Scenario, earth_scenario, planet_scenario
from magrl.envs.navigation import spl_reward
from magrl.envs.scenario import rule_settings
from magrl.errors import MotionError, SensorErrors, sensor_levels
from magrl.navigators import make_correcting_actor
from magrl.navigators.networks import Spread, make_drawn_correction, make_mlp
from magrl.pilot import Rules
from magrl.pilot.destination import RANGE_KM
from magrl.pilot.network import correction_network
from magrl.pilot.observation import OBSERVATION_SIZE
from magrl.random_numbers import TEST_SEED, VALIDATION_SEED
from magrl.training import Run, command, optimize, parse_config
from magrl.training.collectors import RemoteCollector, make_collector
from magrl.training.config import (
    Count,
    Discount,
    Noise,
    NonNegative,
    PlanetConfig,
    Positive,
    Rising,
    Widths,
    make_presets,
    read_presets,
)
from magrl.transforms import (
    DeclareArrival,
    HighestSPL,
    MinMaxNorm,
    RandomStepPrice,
    SPLReward,
    TrackField,
    TrueDisplacement,
)
from magrl.transforms.track import known_keys

import torch
from pydantic import Field
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch.optim import Adam
from torchrl.envs import Compose, ObservationNorm, RewardSum, Transform, TransformedEnv
from torchrl.modules import ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

RECIPE = "ppo_anywhere.py"
TABLES = read_presets(__file__)
LOSSES = ("loss_critic", "loss_actor", "kl_approx", "clip_fraction", "explained_variance")
OBSERVED = ("observation", "true_displacement_scaled", "highest_spl")
TRANSITION = (
    *OBSERVED,
    "correction",
    "correction_log_prob",
    *(("next", k) for k in (*OBSERVED, "reward", "done", "terminated")),
)


class Config(rule_settings("zeta", "arrival", "radius_km", "max_leg_km", "max_turn_deg", max_steps=120), PlanetConfig):
    """Settings of a training; the defaults are the preset's."""

    preset: Literal[*TABLES] = "far"  # type: ignore[valid-type]
    """Source of the defaults: destinations 150-1800 km away, or 300-500 km."""
    task: Literal["anywhere"] = "anywhere"
    """Named task (docs/tasks.md)."""

    # Own defaults of shared settings
    total_frames: Count = 2_621_440
    num_envs: Count = 4096
    eval_trips_small: Count = 1000
    gamma: Discount = 0.999
    num_regions: Count = 2048
    distance_range_km: Rising = (150.0, 1800.0)
    epochs: Count = 3
    batch_size: Count = 16_384

    drift: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Speed of a current relative to the vehicle's speed; its direction is random in each episode."""
    noise: Noise = (0.0, 0.0, 0.0)
    """Standard deviations of the sensors' noise on D [deg], I [deg], B_H [nT]; random levels by default."""
    noise_exponent: Positive = 1.0
    """Exponent of the random noise levels; larger values give more noise (magrl.errors.sensor_levels)."""
    num_cells: Widths = (128, 128, 128)
    """Width of each hidden layer."""
    range_km: Positive = RANGE_KM
    """Prior standard deviation of the displacement to the destination along each axis [km]."""
    price_range: Rising = (0.1, 30.0)
    """Range of the step price [% of SPL], which is drawn for each episode and observed by the agent."""
    critic_batches: Count = 3
    """Collected batches before the first update of the actor."""
    advantage_floor: NonNegative = 0.2
    """Constant added to the expected loss that divides advantages; it limits the weight of easy episodes."""

    @property
    def drift_km(self) -> float:
        """How much farther than its command a current may carry a vehicle [km]."""
        return self.drift * self.max_leg_km

    @property
    def reach_km(self) -> float:
        """Farthest that a leg takes a vehicle [km]."""
        return self.max_leg_km + self.drift_km


PRESETS = make_presets(Config, TABLES)


def errors(config: Config, seed: int) -> list[Transform]:
    """Return the drift and the noise of the sensors: from the settings, or levels drawn for each episode."""
    current = [MotionError(current_km_h=config.drift, speed_km_h=1.0, seed=seed)] if config.drift else []
    levels = None if any(config.noise) else partial(sensor_levels, exponent=config.noise_exponent)
    return [*current, SensorErrors(config.noise, levels=levels, seed=seed)]


def rules_of(base: GeomagneticNavEnv, config: Config) -> Rules:
    """Return what the agent knows before it starts."""
    return Rules(**base.limits, range_km=config.range_km)


def make_env(base: GeomagneticNavEnv, config: Config) -> TransformedEnv:
    """Add sensors, step price, the agent's track, and the privileged inputs of critic and reward, for training only."""
    env = TransformedEnv(base, Compose(*errors(config, base.seed), RandomStepPrice(config.price_range, seed=base.seed)))
    rules, known = rules_of(base, config), known_keys(env.observation_spec)
    declaration = [] if rules.signaled else [DeclareArrival(rules, known)]
    scaled_displacement = ObservationNorm(0.0, 1 / 200, ["true_displacement"], ["true_displacement_scaled"])
    efficiency = SPLReward(["highest_spl", "step_price"])
    privileged = [TrueDisplacement(), scaled_displacement, HighestSPL(), efficiency, RewardSum(["reward"])]
    for transform in (TrackField(rules, known), *declaration, MinMaxNorm(in_keys_inv=["action"]), *privileged):
        env.append_transform(transform)
    return env


def options_of(config: Config) -> dict[str, Any]:
    """Return the options of all environments of a training."""
    return config.rules | {"start_heading": "random", "drift_km": config.drift_km, "device": config.device}


def training_env(config: Config) -> TransformedEnv:
    """Return the environment of the training, on random planets."""
    planets = planet_scenario(config.num_regions, seed=config.seed, **config.regions)
    base = GeomagneticNavEnv(planets, num_envs=config.num_envs, seed=config.seed, **options_of(config))
    return make_env(base, config)


def evaluation_env(scenario: Scenario, num_trips: int, seed: int, config: Config, **options: Any) -> TransformedEnv:
    """Return an environment of random trips of a scenario, drawn once, with the noise of the sensors."""
    trips = scenario.random_trips(num_trips, seed)
    base = GeomagneticNavEnv(scenario.with_trips(trips), num_envs=num_trips, seed=seed, **options)
    return TransformedEnv(base, Compose(*spl_reward(), *errors(config, seed)))


def make_stochastic_actor(actor: TensorDictSequential, spread: Spread) -> TensorDictSequential:
    """Return the actor of the training: normal corrections around the ones of ``actor``, and the legs that follow."""
    network, corrected_leg = actor.module
    drawn = make_drawn_correction(TensorDictModule(network.module, ["observation"], ["mean"]), spread)
    return TensorDictSequential(drawn, corrected_leg)


def normalized(transitions: TensorDictBase, floor: float) -> TensorDictBase:
    """Divide advantages by the expected loss of the episode, which is much larger with poor sensors, and normalize."""
    relative = transitions["advantage"] / (transitions["state_value"].abs() + floor)
    transitions["advantage"] = ((relative - relative.mean()) / relative.std()).clamp(-5, 5)
    return transitions


def train(config: Config) -> dict[str, float]:
    """Train, evaluate and write the run folder; return the content of its ``eval.json``."""
    torch.manual_seed(config.seed)
    with Run(config, recipe=RECIPE, name=f"ppo_anywhere-{config.preset}", losses=LOSSES) as run:
        # Environments
        env, options = training_env(config), options_of(config)
        others = planet_scenario(256, seed=VALIDATION_SEED, **config.regions)
        validation = evaluation_env(others, config.eval_trips_small, VALIDATION_SEED, config, **options)
        earth = earth_scenario(128, seed=TEST_SEED, **config.regions)
        test = evaluation_env(earth, config.eval_trips, TEST_SEED, config, **options)
        rules = rules_of(env.base_env, config)

        # Networks: only the critic reads the true displacement and the SPL that can still be reached
        network = correction_network(config.num_cells, env.device)
        actor = make_correcting_actor(network, rules)
        spread = Spread(config.exploration).to(env.device)
        stochastic_actor = make_stochastic_actor(actor, spread)
        value = make_mlp(OBSERVATION_SIZE + 3, 1, config.critic_cells, layer_norm=True, device=env.device)
        critic = ValueOperator(value, in_keys=list(OBSERVED))

        # Advantages and loss with a clipped probability ratio
        advantage = GAE(gamma=config.gamma, lmbda=config.gae_lambda, value_network=critic, deactivate_vmap=True)
        loss = ClipPPOLoss(
            stochastic_actor[0],
            critic,
            clip_epsilon=config.clip_epsilon,
            entropy_bonus=False,
            normalize_advantage=False,
            loss_critic_type="smooth_l1",
        )
        loss.set_keys(action="correction", sample_log_prob="correction_log_prob")
        weights = [list(module.parameters()) for module in (actor, critic)]
        rates = ("learning_rate", "critic_learning_rate")
        optimizer = Adam([{"params": group, "lr": 0.0} for group in weights], fused=True)

        frames = {"frames_per_batch": config.num_envs * config.steps_per_batch, "total_frames": config.total_frames}
        if config.collectors:
            collector = RemoteCollector(training_env, config, stochastic_actor, **frames)
        else:
            collector = make_collector(env, stochastic_actor, **frames)
        run.start(
            policy=Anywhere(rules, network),
            validation=validation,
            env=env.base_env,
            collector=collector,
            loss=loss,
            optimizer=optimizer,
            spread=spread,
        )
        stats = run.statistics
        for batch in run.batches():
            spread.std.fill_(config.linear("exploration", run.remaining))
            for group, rate in zip(optimizer.param_groups, rates, strict=True):
                group["lr"] = config.linear(rate, run.remaining)
            if stats.iterations <= config.critic_batches:
                optimizer.param_groups[0]["lr"] = 0.0
            for _ in range(config.epochs):
                with torch.no_grad():
                    transitions = normalized(advantage(batch.select(*TRANSITION)).reshape(-1), config.advantage_floor)
                for indices in torch.randperm(len(transitions), device=env.device).split(config.batch_size):
                    losses = loss(transitions[indices]).rename_key_("loss_objective", "loss_actor")
                    total = losses["loss_actor"] + losses["loss_critic"]
                    optimize(total, optimizer, clip=weights[0], max_norm=config.clip_gradient)
                    stats.updates += 1
            stats.losses = losses.select(*LOSSES).to_dict()
        return run.finish(test)


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line and train."""
    train(parse_config(Config, PRESETS, RECIPE, __doc__, args))


if __name__ == "__main__":
    command(RECIPE, main, ImportError)
