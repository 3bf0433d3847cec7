"""PPO with a memory: train on random planets an agent without a map, a filter or a model of its sensors' errors.

    python recipes/ppo_memory.py                     # task storm, preset standard: ten million steps, half an hour
    python recipes/ppo_memory.py --task readings
    python recipes/ppo_memory.py --preset fast       # one million steps, four minutes
    python recipes/ppo_memory.py --preset large --device cuda
    python recipes/ppo_memory.py --resume RUN        # resume an interrupted run exactly
    python recipes/ppo_memory.py --collectors 8 --address auto    # on a Ray cluster (docs/machines.md)

The agent observes what its sensors measure and its own legs, step by step. A gated recurrent unit (GRU) estimates the
displacement to the destination, and is trained to predict the true one. PPO learns the legs, given the memory, as
corrections of that estimate. The test trips are on Earth, in regions that no training sees. On *Storm* their weather is
the record, which no training sees either.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from magrl.envs import Scenario, earth_scenario, planet_scenario
from magrl.named_tasks import NAMED_TASKS
from magrl.navigators.memory import LIMITS, Memory, MemoryNetwork, action_of
from magrl.navigators.networks import Spread, make_drawn_correction, make_mlp
from magrl.random_numbers import FIRST_RESERVED_SEED, TEST_SEED, VALIDATION_SEED
from magrl.training import Run, command, optimize, parse_config
from magrl.training.collectors import RemoteCollector, make_collector
from magrl.training.config import Count, PlanetConfig, Positive, Widths, make_presets, read_presets
from magrl.transforms.areas import turned
from magrl.transforms.sequences import ACCURACY_KEYS, READING_SIZE

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torch.optim import Adam
from torchrl.data import Unbounded
from torchrl.envs import EnvBase, InitTracker, ObservationNorm, RewardSum, TensorDictPrimer, TransformedEnv
from torchrl.modules import GRUModule, ValueOperator, set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

RECIPE = "ppo_memory.py"
TABLES = read_presets(__file__)
LOSSES = ("loss_memory", "loss_critic", "loss_actor", "kl_approx", "clip_fraction", "explained_variance")
KNOWN = ("memory", "observation", "estimate")
JUDGED = ("observation", "true_displacement_scaled", "highest_spl")
TRANSITION = (*KNOWN, *JUDGED[1:], "correction", "correction_log_prob")
TRANSITION += tuple(("next", key) for key in (*JUDGED, "reward", "done", "terminated"))
SEQUENCE = ("observation", "hidden", "is_init", "true_displacement", "heading")


class Config(PlanetConfig):
    """Settings of a training; the defaults are the preset's."""

    preset: Literal[*TABLES] = "standard"  # type: ignore[valid-type]
    """Source of the defaults: ten million steps, one million, or a hundred million for a GPU."""
    task: Literal["storm", "readings"] = "storm"
    """Named task, which sets the errors of the sensors."""

    # Own defaults of shared settings
    total_frames: Count = 9_994_240
    num_envs: Count = 1024
    epochs: Count = 2
    batch_size: Count = 4096
    gamma: float = 0.99
    exploration: Positive = 0.3
    critic_cells: Widths = (128, 128)
    eval_trips_small: Count = 500

    memory_size: Count = 128
    """Width of the memory."""
    memory_batches: Count = 20
    """Collected batches before the first update of the legs; until then, the vehicle follows its estimate."""
    sequences: Count = 128
    """Sequences per gradient step of the memory."""


PRESETS = make_presets(Config, TABLES)


def make_env(config: Config) -> TransformedEnv:
    """Return the task on random planets with an empty memory, and the privileged inputs of critic and reward."""
    planets = planet_scenario(config.num_regions, seed=config.seed, **config.regions)
    env = task_env(planets, config, num_envs=config.num_envs, seed=config.seed)
    scaled_displacement = ObservationNorm(0.0, 1 / 200, ["true_displacement"], ["true_displacement_scaled"])
    memory = TensorDictPrimer({"hidden": Unbounded((1, config.memory_size))}, expand_specs=True)
    for transform in (InitTracker(), memory, scaled_displacement, RewardSum(["reward"])):
        env.append_transform(transform)
    return env


def task_env(scenario: Scenario, config: Config, **options: Any) -> TransformedEnv:
    """Return the environment of the task over the regions of a scenario."""
    make = NAMED_TASKS[config.task].make
    return make(scenario=scenario, max_steps=config.max_steps, device=config.device, **options)


def evaluation_env(scenario: Scenario, num_trips: int, trips_seed: int, seed: int, config: Config) -> EnvBase:
    """Return an environment of random trips of a scenario, drawn once, in physical units."""
    trips = scenario.with_trips(scenario.random_trips(num_trips, trips_seed))
    return task_env(trips, config, num_envs=num_trips, seed=seed, observation="dict", scale_actions=False)


def accuracy_range(seen: TensorDictBase) -> list[list[float]]:
    """Return the least and the largest accuracy of the sensors in a batch, as :class:`Memory` takes it."""
    stds = torch.cat([seen.get(key, torch.zeros_like(seen["field"])) for key in ACCURACY_KEYS], -1)
    return [stds.amin(0).tolist(), stds.amax(0).tolist()]


class Leg(nn.Module):
    """The action in [-1, 1] of an estimate and its correction."""

    def forward(self, estimate: Tensor, correction: Tensor, heading: Tensor) -> Tensor:
        """Return ``(..., 2)``."""
        distance, turn = action_of(estimate + correction, heading, **LIMITS).unbind(-1)
        return torch.stack((2 * distance / LIMITS["max_leg_km"] - 1, turn / LIMITS["max_turn_rad"]), -1)


class Joined(nn.Module):
    """A network that is fed with several values, joined."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, *values: Tensor) -> Tensor:
        """Return what the network makes of them."""
        return self.network(torch.cat(values, -1))


def make_memory(network: MemoryNetwork) -> TensorDictSequential:
    """Return the part of the network from observations to its memory and the estimate ``(..., 2)``."""
    return TensorDictSequential(
        TensorDictModule(network.encode, ["observation"], ["encoded"]),
        GRUModule(gru=network.gru, in_keys=["encoded", "hidden"], out_keys=["memory", ("next", "hidden")]),
        TensorDictModule(Joined(network.estimate), ["memory", "observation"], ["estimate"]),
    )


def loss_memory(sequences: TensorDictBase, memory: TensorDictSequential) -> Tensor:
    """Return the mean squared error of the estimates along sequences ``(N, T)``: of directions where the destination is
    farther than the longest leg."""
    with set_recurrent_mode(True):
        memory(sequences)
    displacement = turned(sequences["true_displacement"], sequences["heading"])
    wanted = displacement / displacement.norm(dim=-1, keepdim=True).clamp_min(LIMITS["max_leg_km"])
    return (sequences["estimate"] - wanted).square().sum(-1).mean()


def train(config: Config) -> dict[str, float]:
    """Train, evaluate and write the run folder; return the content of its ``eval.json``."""
    torch.manual_seed(config.seed)
    with Run(config, recipe=RECIPE, name=f"ppo_memory-{config.task}-{config.preset}", losses=LOSSES) as run:
        # Environments: the validation has storms of the training, not the record
        env = make_env(config)
        others = planet_scenario(256, seed=VALIDATION_SEED, **config.regions)
        seeds = VALIDATION_SEED, VALIDATION_SEED - FIRST_RESERVED_SEED
        validation = evaluation_env(others, config.eval_trips_small, *seeds, config)
        earth = earth_scenario(128, seed=TEST_SEED, **config.regions)
        test = evaluation_env(earth, config.eval_trips, TEST_SEED, TEST_SEED, config)

        # Networks: only the critic reads the true displacement and the SPL that can still be reached
        network, spread = MemoryNetwork(config.memory_size, config.device), Spread(config.exploration).to(env.device)
        memory = make_memory(network)
        mean = TensorDictModule(Joined(network.correct), list(KNOWN), ["mean"])
        correction = make_drawn_correction(mean, spread)
        leg = TensorDictModule(Leg(), ["estimate", "correction", "heading"], ["action"])
        value = make_mlp(READING_SIZE + 3, 1, config.critic_cells, layer_norm=True, device=env.device)
        critic = ValueOperator(value, in_keys=list(JUDGED))

        # Advantages and loss with a clipped probability ratio
        advantage = GAE(gamma=config.gamma, lmbda=config.gae_lambda, value_network=critic, deactivate_vmap=True)
        clipped = {"entropy_bonus": False, "normalize_advantage": True, "loss_critic_type": "smooth_l1"}
        loss = ClipPPOLoss(correction, critic, clip_epsilon=config.clip_epsilon, **clipped)
        loss.set_keys(action="correction", sample_log_prob="correction_log_prob")
        corrects = list(network.correct.parameters())
        remembers = list(memory.parameters())
        memory_optimizer = Adam(remembers, lr=0.0, fused=True)
        optimizer = Adam([{"params": group, "lr": 0.0} for group in (corrects, critic.parameters())], fused=True)

        frames = {"frames_per_batch": config.num_envs * config.steps_per_batch, "total_frames": config.total_frames}
        agent = TensorDictSequential(memory, correction, leg)
        if config.collectors:
            collector = RemoteCollector(make_env, config, agent, **frames)
        else:
            collector = make_collector(env, agent, **frames)
        parts = {"loss": loss, "optimizer": optimizer, "memory_optimizer": memory_optimizer, "spread": spread}
        policy = Memory(network, accuracy_range(validation.reset()))
        run.start(policy=policy, validation=validation, env=env.base_env, collector=collector, memory=memory, **parts)
        stats, clip = run.statistics, config.clip_gradient
        for batch in run.batches():
            spread.std.fill_(config.linear("exploration", run.remaining))
            rates = [config.linear(name, run.remaining) for name in ("learning_rate", "critic_learning_rate")]
            rates[0] *= stats.iterations > config.memory_batches
            groups = optimizer.param_groups + memory_optimizer.param_groups
            for group, rate in zip(groups, (*rates, rates[1]), strict=True):
                group["lr"] = rate
            with torch.no_grad():
                transitions = advantage(batch.select(*TRANSITION)).reshape(-1)
            for _ in range(config.epochs):
                for rows in torch.randperm(len(batch), device=env.device).split(config.sequences):
                    stats.losses["loss_memory"] = loss_memory(batch[rows].select(*SEQUENCE), memory)
                    optimize(stats.losses["loss_memory"], memory_optimizer, clip=remembers, max_norm=clip)
                for rows in torch.randperm(len(transitions), device=env.device).split(config.batch_size):
                    losses = loss(transitions[rows]).rename_key_("loss_objective", "loss_actor")
                    optimize(losses["loss_actor"] + losses["loss_critic"], optimizer, clip=corrects, max_norm=clip)
                    stats.updates += 1
            stats.losses |= losses.select(*LOSSES[1:]).to_dict()
        return run.finish(test)


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line and train."""
    train(parse_config(Config, PRESETS, RECIPE, __doc__, args))


if __name__ == "__main__":
    command(RECIPE, main, ImportError)
