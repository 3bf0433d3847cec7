"""Recurrent PPO on raw readings: train an agent without a map and without a filter.

    python recipes/ppo_recurrent.py                          # ten million steps
    python recipes/ppo_recurrent.py --total-frames 2000000   # two million
    python recipes/ppo_recurrent.py --no-observe-heading     # without a compass: the eight numbers of the paper's state
    python recipes/ppo_recurrent.py --resume RUN             # resume an interrupted run exactly

The agent reads what its sensors measure and what it does, step by step, and estimates the way to the destination with a
gated recurrent unit (GRU). In training alone, that estimate is compared with the true way. PPO learns the moves, given
the memory, as corrections of those along the estimate. It trains on random planets as ppo_anywhere.py does, whose agent
is given a Kalman filter: the difference between the two is what the filter is worth.
"""

from __future__ import annotations

from collections.abc import Sequence

from magrl import paper
from magrl.agents import optimize
from magrl.agents.networks import make_mlp
from magrl.envs import GeomagneticNavEnv, earth_scenario, planet_scenario
from magrl.geodesy import steer
from magrl.training import Run, command, parse_config
from magrl.training.collectors import make_collector
from magrl.training.config import Count, Discount, PlanetConfig, Positive, Widths
from magrl.transforms import HighestSPL, MinMaxNorm, RandomStepPrice, ReadingObservation, SPLReward, TrueWay
from ppo_anywhere import Spread, errors, evaluation_env

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torch.optim import Adam
from torchrl.envs import Compose, EnvBase, InitTracker, ObservationNorm, RewardSum, TransformedEnv
from torchrl.modules import GRUModule, IndependentNormal, ProbabilisticActor, ValueOperator, set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

RECIPE = "ppo_recurrent.py"
LOSSES = ("loss_way", "loss_critic", "loss_actor")
REMEMBERED = ("observation", "hidden", "is_init", "true_way", "heading")
BELIEF = ("memory", "observation", "way_estimate")
JUDGED = ("observation", "true_way_scaled", "highest_spl")
TRANSITION = (
    *dict.fromkeys((*BELIEF, *JUDGED)),
    "correction",
    "correction_log_prob",
    *(("next", k) for k in (*JUDGED, "reward", "done", "terminated")),
)


class Config(PlanetConfig):
    """Settings of a training."""

    # Own defaults of shared settings
    total_frames: Count = 9_994_240
    num_envs: Count = 1024
    num_cells: Widths = (128,)
    gamma: Discount = 0.99
    epochs: Count = 2
    batch_size: Count = 4096
    exploration: Positive = 0.3
    final_critic_learning_rate: Positive = 3e-5

    observe_heading: bool = True
    """Observe the heading; otherwise episodes start northward, and the way is in the vehicle's frame."""
    step_price: Positive = 0.5
    """Price of a step [% of SPL]."""

    # Memory
    memory_size: Count = 128
    """Width of the GRU."""
    sequences_per_update: Count = 128
    """Sequences per gradient step of the memory."""
    memory_batches: Count = 20
    """Collected batches before the first update of the moves; until then, the vehicle follows its estimate."""
    memory_learning_rate: Positive = 1e-3
    """Learning rate of the memory at the start."""
    final_memory_learning_rate: Positive = 3e-5
    """Learning rate of the memory at the end; linear in between."""


class Command(nn.Module):
    """The action, scaled to [-1, 1], of a correction of the move along the estimate.

    Both are northward and eastward where the heading is given, and otherwise forward and to the right.
    """

    def __init__(self, max_move_km: float, max_turn_rad: float) -> None:
        super().__init__()
        self.limits = max_move_km, max_turn_rad

    def forward(self, estimate: Tensor, correction: Tensor, heading: Tensor | None = None) -> Tensor:
        """``(..., 2)`` in units of the longest move, and heading ``(..., 1)`` [rad]."""
        ahead, aside = (estimate + correction).unbind(-1)
        now = torch.zeros_like(ahead) if heading is None else heading.squeeze(-1)
        distance, turn = steer(now, torch.atan2(aside, ahead), self.limits[0] * torch.hypot(ahead, aside), *self.limits)
        return torch.stack((2 * distance / self.limits[0] - 1, turn / self.limits[1]), -1)


def make_memory(size: int, config: Config) -> TensorDictSequential:
    """Return the network from readings to its memory and the estimated way ``(..., 2)``.

    The estimate is 1 long where the destination is farther than the longest move. It is shorter where the direction is
    not known well, so that the vehicle starts with short moves.
    """
    width, device = config.memory_size, config.device
    encoder = nn.Sequential(nn.Linear(size, width, device=device), nn.SiLU())
    keys = {"in_keys": ["encoded", "hidden"], "out_keys": ["memory", ("next", "hidden")]}
    head = make_mlp(width + size, 2, config.num_cells, layer_norm=True, device=device)
    return TensorDictSequential(
        TensorDictModule(encoder, ["observation"], ["encoded"]),
        GRUModule(input_size=width, hidden_size=width, device=device, **keys),
        TensorDictModule(head, ["memory", "observation"], ["way_estimate"]),
    )


def make_correction(size: int, spread: Spread, config: Config) -> ProbabilisticActor:
    """Return the policy of PPO: normal corrections of the estimate, given the memory, at first around zero."""
    mean = make_mlp(config.memory_size + size + 2, 2, config.num_cells, layer_norm=True, device=config.device)
    for parameter in mean[-1].parameters():
        nn.init.zeros_(parameter)
    return ProbabilisticActor(
        TensorDictSequential(
            TensorDictModule(mean, list(BELIEF), ["mean"]), TensorDictModule(spread, ["mean"], ["loc", "scale"])
        ),
        in_keys=["loc", "scale"],
        out_keys=["correction"],
        distribution_class=IndependentNormal,
        distribution_kwargs={"tanh_loc": False},
        return_log_prob=True,
    )


def with_view(env: EnvBase, memory: TensorDictSequential, config: Config) -> TransformedEnv:
    """Add what the agent observes, its first state, and the scaling of its action."""
    observed = ReadingObservation(ReadingObservation.default_in_keys[: 3 + config.observe_heading])
    view = [InitTracker(), memory[1].make_tensordict_primer(), observed, MinMaxNorm(in_keys_inv=["action"])]
    return TransformedEnv(env, Compose(*view), auto_unwrap=True)


def make_env(base: GeomagneticNavEnv, memory: TensorDictSequential, config: Config) -> TransformedEnv:
    """Add sensors, the agent's view, and the privileged inputs of critic, estimate and reward, for training only."""
    price = RandomStepPrice((config.step_price, config.step_price), seed=base.seed)
    scaled_way = ObservationNorm(0.0, 1 / 200, ["true_way"], ["true_way_scaled"])
    highest = HighestSPL({"move": "true_move"} if config.drift else None)
    privileged = [price, TrueWay(), scaled_way, highest, SPLReward(), RewardSum(["reward"])]
    return with_view(TransformedEnv(base, Compose(*errors(config, base.seed), *privileged)), memory, config)


def loss_way(sequences: TensorDictBase, memory: TensorDictSequential, max_move_km: float) -> Tensor:
    """Return the mean squared error of the estimates of the way along sequences ``(N, T)``."""
    with set_recurrent_mode(True):
        memory(sequences)
    way = sequences["true_way"]
    if "heading" in sequences:
        (forward, right), heading = way.unbind(-1), sequences["heading"].squeeze(-1)
        cos, sin = torch.cos(heading), torch.sin(heading)
        way = torch.stack((forward * cos - right * sin, forward * sin + right * cos), -1)
    wanted = way / way.norm(dim=-1, keepdim=True).clamp_min(max_move_km)
    return (sequences["way_estimate"] - wanted).square().sum(-1).mean()


def train(config: Config) -> dict[str, float]:
    """Train, evaluate and write the run folder; return the content of its ``eval.json``."""
    torch.manual_seed(config.seed)
    with Run(config, recipe=RECIPE, name="ppo_recurrent", losses=LOSSES) as run:
        # Environments
        heading = "random" if config.observe_heading else "north"
        options = {"zeta": config.zeta, "max_steps": config.max_steps, "start_heading": heading}
        options |= {"device": config.device, **config.limits}
        planets = planet_scenario(config.num_regions, seed=config.seed, **config.regions)
        base = GeomagneticNavEnv(planets, num_envs=config.num_envs, seed=config.seed, **options)
        others = planet_scenario(256, seed=paper.VALIDATION_SEED, **config.regions)
        earth = earth_scenario(128, seed=paper.TEST_SEED, **config.regions)
        tasks = (others, config.eval_tasks_small, paper.VALIDATION_SEED), (earth, config.eval_tasks, paper.TEST_SEED)

        # Networks: the critic reads the true way and the SPL that can still be reached, the actor never does
        size = ReadingObservation.out_sizes[0][0]
        spread = Spread(config.exploration).to(base.device)
        memory, correction = make_memory(size, config), make_correction(size, spread, config)
        limits = Command(base.max_move_km, base.max_turn_rad)
        command_keys = ["way_estimate", "correction", *["heading"] * config.observe_heading]
        remembered = REMEMBERED if config.observe_heading else REMEMBERED[:-1]
        actor = TensorDictSequential(memory, correction, TensorDictModule(limits, command_keys, ["action"]))
        value = make_mlp(size + 3, 1, config.critic_cells, layer_norm=True, device=base.device)
        critic = ValueOperator(value, in_keys=list(JUDGED))
        validation, test = (with_view(evaluation_env(*group, config, **options), memory, config) for group in tasks)

        # Advantages and loss with a clipped probability ratio
        advantage = GAE(gamma=config.gamma, lmbda=config.gae_lambda, value_network=critic, deactivate_vmap=True)
        loss = ClipPPOLoss(
            correction,
            critic,
            clip_epsilon=config.clip_epsilon,
            entropy_bonus=False,
            normalize_advantage=True,
            loss_critic_type="smooth_l1",
        )
        loss.set_keys(action="correction", sample_log_prob="correction_log_prob")
        weights = [list(module.parameters()) for module in (memory, correction, critic)]
        rates = ("memory_learning_rate", "learning_rate", "critic_learning_rate")
        optimizers = [Adam(group, lr=0.0, fused=True) for group in weights]

        frames = {"frames_per_batch": config.num_envs * config.steps_per_batch, "total_frames": config.total_frames}
        env = make_env(base, memory, config)
        run.start(
            policy=actor,
            validation=validation,
            env=base,
            collector=make_collector(env, actor, **frames),
            memory=memory,
            loss=loss,
            spread=spread,
            **dict(zip(("memory_optimizer", "actor_optimizer", "critic_optimizer"), optimizers, strict=True)),
        )
        stats = run.statistics
        for batch in run.batches():
            spread.std.fill_(config.linear("exploration", run.remaining))
            for optimizer, rate in zip(optimizers, rates, strict=True):
                optimizer.param_groups[0]["lr"] = config.linear(rate, run.remaining)
            if stats.iterations <= config.memory_batches:
                optimizers[1].param_groups[0]["lr"] = 0.0
            for _ in range(config.epochs):
                with torch.no_grad():
                    transitions = advantage(batch.select(*TRANSITION)).reshape(-1)
                for rows in torch.randperm(len(batch), device=base.device).split(config.sequences_per_update):
                    error = loss_way(batch[rows].select(*remembered), memory, base.max_move_km)
                    optimize(error, optimizers[0], clip=weights[0], max_norm=config.clip_gradient)
                for rows in torch.randperm(len(transitions), device=base.device).split(config.batch_size):
                    losses = loss(transitions[rows])  # given the memory, as it was when the moves were made
                    total = losses["loss_objective"] + losses["loss_critic"]
                    optimize(total, *optimizers[1:], clip=weights[1], max_norm=config.clip_gradient)
                    stats.updates += 1
            values = error, losses["loss_critic"], losses["loss_objective"]
            stats.losses = dict(zip(LOSSES, values, strict=True))
        return run.finish(test)


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line and train."""
    train(parse_config(Config, {"default": Config()}, RECIPE, __doc__, args))


if __name__ == "__main__":
    command(RECIPE, main)
