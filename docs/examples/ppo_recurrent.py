"""Recurrent PPO on raw readings: train an agent without a map and without a filter, and save it as ONNX.

    python docs/examples/ppo_recurrent.py                           # ten million steps: 20 minutes on one core
    python docs/examples/ppo_recurrent.py --total-frames 1998848    # two million
    python docs/examples/ppo_recurrent.py --no-observe-heading      # without a compass: the paper's state

The agent reads what its sensors measure and what it does, step by step, and estimates the way to the destination with a
gated recurrent unit (GRU). In training alone, that estimate is compared with the true way. PPO learns the moves, given
the memory, as corrections of those along the estimate. It trains on random planets as recipes/ppo_anywhere.py does,
whose agent has a Kalman filter: the difference between the two is what the filter is worth.

Writes policy.onnx, whose memory is the state of the GRU and the last reading, and eval.json.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from magrl import (
    GeomagneticNavEnv,
    earth_scenario,
    evaluate,
    export_policy,
    paper,
    planet_scenario,
    save_policy,
    summarize,
)
from magrl.agents import optimize
from magrl.agents.networks import make_mlp
from magrl.evaluation import episode_measures, evaluation_rollout
from magrl.field.elements import element_difference
from magrl.files import write_json
from magrl.geodesy import steer
from magrl.transforms import HighestSPL, RandomStepPrice, ReadingView, SensorErrors, SPLReward, TrueWay, sensor_levels

import torch
import tyro
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torch.optim import Adam
from torchrl.collectors import Collector
from torchrl.data import Unbounded
from torchrl.envs import Compose, EnvBase, InitTracker, ObservationNorm, TensorDictPrimer, TransformedEnv
from torchrl.modules import GRUModule, IndependentNormal, ProbabilisticActor, ValueOperator, set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from tqdm import tqdm

FEATURES = 20
CELLS, CRITIC_CELLS = (128,), (256, 256)
REGIONS: dict[str, Any] = {"max_latitude": 70, "distance_range_km": (300.0, 500.0)}
BELIEF = ("memory", "features", "way_estimate")
JUDGED = ("observation", "before", "true_way_scaled", "highest_spl")


@dataclass(frozen=True)
class Config:
    """Settings of a training."""

    total_frames: int = 9_994_240
    """Number of steps of all vehicles together."""
    num_envs: int = 1024
    """Number of vehicles."""
    steps_per_batch: int = 32
    """Steps of each vehicle in a collected batch."""
    epochs: int = 2
    """Epochs over each collected batch."""
    batch_size: int = 4096
    """Transitions per gradient step of the moves."""
    sequences_per_update: int = 128
    """Sequences per gradient step of the memory."""
    memory_batches: int = 20
    """Collected batches before the first update of the moves; until then, the vehicle follows its estimate."""
    memory_size: int = 128
    """Width of the GRU."""
    num_regions: int = 1024
    """Regions of random planets."""
    eval_every: int = 10
    """Batches between evaluations, of which the best policy is kept."""
    eval_regions: int = 128
    """Regions of the evaluation on Earth."""
    eval_tasks: int = 1000
    """Tasks of the evaluation on Earth; a third of them on other planets while it trains."""
    observe_heading: bool = True
    """Observe the heading; otherwise episodes start northward, and the way is in the vehicle's frame."""
    seed: int = 0
    """Random seed."""
    out: Path = field(default=Path("runs/ppo_recurrent"))
    """Folder of the results."""


# What the agent makes of a reading


class Readings(nn.Module):
    """Features of an observation and of the reading before it, which is 0 at the start; nothing is estimated.

    A single observation does not hold the direction to the destination: the agent needs a memory.
    """

    def forward(self, observation: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
        """Return features ``(..., 20)`` and the reading ``(..., 3)``, for the next step.

        The features are those of the reading and the target (:func:`features`), the change of D, I, B_H per kilometer
        of the last move, how far along it the differences would be least, and how well it fits them, cosine and sine of
        the heading, or else of the last turn, and the distance of the move.
        """
        reading, target, moved = observation[..., :3], observation[..., 3:6], observation[..., 6:7]
        angle = observation[..., -1:]  # the heading, or without it the last turn
        change = element_difference(reading, torch.where(before[..., 2:] == 0, reading, before))
        unit = per_nanotesla(reading)
        left, rate = element_difference(target, reading) / unit / 2000, change / unit / moved.clamp_min(0.5) / 1.25
        along, steep, far = ((a * b).sum(-1, keepdim=True) for a, b in ((left, rate), (rate, rate), (left, left)))
        fit = along / (steep * far + 1e-6).sqrt()
        nearest = torch.asinh(4 * along / (steep + 1e-2))
        made = torch.cos(angle), torch.sin(angle), moved / 50
        return torch.cat((features(reading, target), torch.asinh(rate), nearest, fit, *made), -1), reading


def features(reading: Tensor, target: Tensor) -> Tensor:
    """Return sine and cosine of I and D, B_H, the total intensity, and the differences to the target ``(..., 12)``."""
    declination, inclination = torch.deg2rad(reading[..., :2]).unbind(-1)
    angles = (torch.sin(inclination), torch.cos(inclination), torch.sin(declination), torch.cos(declination))
    total = reading[..., 2] / torch.cos(inclination).clamp_min(1e-3)
    strengths = (reading[..., 2] - 25_000) / 12_000, (total - 45_000) / 15_000
    difference = element_difference(target, reading) / per_nanotesla(reading) / 1500
    return torch.cat((torch.stack((*angles, *strengths), -1), difference, difference.abs()), -1).clamp(-6, 6)


def per_nanotesla(elements: Tensor) -> Tensor:
    """Return the change of D, I [deg] and B_H [nT] ``(..., 3)`` by a disturbance of 1 nT."""
    strength = elements[..., 2].clamp_min(1000)
    declination = math.degrees(1) / strength
    inclination = declination * torch.cos(torch.deg2rad(elements[..., 1])).abs()
    return torch.stack((declination, inclination, torch.ones_like(strength)), -1)


class Command(nn.Module):
    """The action in [-1, 1] of a correction of the move along the estimate.

    Both are northward and eastward where the heading is observed, and otherwise forward and to the right.
    """

    def __init__(self, view: ReadingView) -> None:
        super().__init__()
        self.limits, self.heads = (view.max_move_km, view.max_turn_rad), "heading" in view.keys

    def forward(self, estimate: Tensor, correction: Tensor, observation: Tensor) -> Tensor:
        """``(..., 2)`` in units of the longest leg."""
        move = estimate + correction
        (ahead, aside), distance = move.unbind(-1), self.limits[0] * torch.linalg.vector_norm(move, dim=-1)
        now = observation[..., -1] if self.heads else torch.zeros_like(ahead)
        distance, turn = steer(now, torch.atan2(aside, ahead), distance, *self.limits)
        return torch.stack((2 * distance / self.limits[0] - 1, turn / self.limits[1]), -1)


# Networks


class Spread(nn.Module):
    """The standard deviation of corrections: a buffer that the training sets."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("std", torch.tensor(0.3))

    def forward(self, mean: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation."""
        return mean, self.std.expand_as(mean)


def make_memory(width: int) -> TensorDictSequential:
    """Return the network from observations to its memory and the estimated way ``(..., 2)``.

    The estimate is 1 long where the destination is farther than the longest leg. It is shorter where the direction is
    not known well, so that the vehicle starts with short moves.
    """
    keys = {"in_keys": ["encoded", "hidden"], "out_keys": ["memory", ("next", "hidden")]}
    head = make_mlp(width + FEATURES, 2, CELLS, layer_norm=True)
    return TensorDictSequential(
        TensorDictModule(Readings(), ["observation", "before"], ["features", ("next", "before")]),
        TensorDictModule(nn.Sequential(nn.Linear(FEATURES, width), nn.SiLU()), ["features"], ["encoded"]),
        GRUModule(input_size=width, hidden_size=width, **keys),
        TensorDictModule(head, ["memory", "features"], ["way_estimate"]),
    )


def make_correction(width: int) -> ProbabilisticActor:
    """Return the policy of PPO: normal corrections of the estimate, given the memory, at first around zero."""
    mean = make_mlp(width + FEATURES + 2, 2, CELLS, layer_norm=True)
    for parameter in mean[-1].parameters():
        nn.init.zeros_(parameter)
    spread = TensorDictModule(Spread(), ["mean"], ["loc", "scale"])
    return ProbabilisticActor(
        TensorDictSequential(TensorDictModule(mean, list(BELIEF), ["mean"]), spread),
        in_keys=["loc", "scale"],
        out_keys=["correction"],
        distribution_class=IndependentNormal,
        distribution_kwargs={"tanh_loc": False},
        return_log_prob=True,
    )


class Judge(nn.Module):
    """The critic, which reads the true way and the SPL that can still be reached; the actor never does."""

    def __init__(self) -> None:
        super().__init__()
        self.readings, self.value = Readings(), make_mlp(FEATURES + 3, 1, CRITIC_CELLS, layer_norm=True)

    def forward(self, observation: Tensor, before: Tensor, way: Tensor, highest_spl: Tensor) -> Tensor:
        """Return the value ``(..., 1)``."""
        return self.value(self.readings(observation, before)[0], way, highest_spl)


class Flown(nn.Module):
    """The trained agent as one function of tensors, for ONNX."""

    def __init__(self, memory: TensorDictSequential, correction: ProbabilisticActor, command: Command) -> None:
        super().__init__()
        self.readings, self.encode = memory[0].module, memory[1].module
        self.layer, self.head = memory[2].gru, memory[3].module
        self.mean, self.command = correction[0][0].module, command

    def forward(self, observation: Tensor, hidden: Tensor, before: Tensor) -> tuple[Tensor, ...]:
        """Return the action, and the next state of the GRU ``(N, 1, H)`` and reading ``(N, 3)``."""
        seen, reading = self.readings(observation, before)
        output, after = self.layer(self.encode(seen).unsqueeze(1), hidden.transpose(0, 1).contiguous())
        memory = output.squeeze(1)
        estimate = self.head(memory, seen)
        correction = self.mean(memory, seen, estimate)
        return self.command(estimate, correction, observation), after.transpose(0, 1), reading


# Environments


def with_view(env: EnvBase, view: ReadingView, width: int) -> TransformedEnv:
    """Add what the agent observes, its first state, and the scaling of its action."""
    first = TensorDictPrimer({"hidden": Unbounded((1, width)), "before": Unbounded(3)}, expand_specs=True)
    parts = [InitTracker(), first, *view.observation_transforms(), view.action_transform()]
    return TransformedEnv(env, Compose(*parts), auto_unwrap=True)


def make_env(base: GeomagneticNavEnv, view: ReadingView, width: int) -> TransformedEnv:
    """Add sensors, the agent's view, and the privileged inputs of critic, estimate and reward, for training only."""
    scaled_way = ObservationNorm(0.0, 1 / 200, ["true_way"], ["true_way_scaled"])
    privileged = [RandomStepPrice((0.5, 0.5), seed=base.seed), TrueWay(), scaled_way, HighestSPL(), SPLReward()]
    return with_view(
        TransformedEnv(base, Compose(SensorErrors(levels=sensor_levels, seed=base.seed), *privileged)), view, width
    )


def loss_way(sequences: TensorDictBase, memory: TensorDictSequential, view: ReadingView) -> Tensor:
    """Return the mean squared error of the estimates of the way along sequences ``(N, T)``."""
    with set_recurrent_mode(True):
        memory(sequences)
    way = sequences["true_way"]
    if "heading" in view.keys:
        (forward, right), heading = way.unbind(-1), sequences["observation"][..., -1]
        cos, sin = torch.cos(heading), torch.sin(heading)
        way = torch.stack((forward * cos - right * sin, forward * sin + right * cos), -1)
    wanted = way / way.norm(dim=-1, keepdim=True).clamp_min(view.max_move_km)
    return (sequences["way_estimate"] - wanted).square().sum(-1).mean()


def train(config: Config) -> dict[str, float]:
    """Train, evaluate on Earth, and write the results."""
    torch.manual_seed(config.seed)

    # Environments
    options = {"start_heading": "random" if config.observe_heading else "north"}
    planets = planet_scenario(config.num_regions, seed=config.seed, **REGIONS)
    base = GeomagneticNavEnv(planets, num_envs=config.num_envs, seed=config.seed, **options)
    keys = ("field", "target_field", "move", *["heading"] * config.observe_heading)
    view = ReadingView(keys=keys, max_move_km=base.max_move_km, max_turn_rad=base.max_turn_rad)
    env = make_env(base, view, config.memory_size)
    others = planet_scenario(max(2, config.num_regions // 4), seed=paper.VALIDATION_SEED, **REGIONS)
    others = others.with_tasks(others.random_tasks(max(1, config.eval_tasks // 3), paper.VALIDATION_SEED))
    validation = GeomagneticNavEnv(others, num_envs=len(others.tasks.start), seed=paper.VALIDATION_SEED, **options)
    validation = with_view(
        TransformedEnv(validation, SensorErrors(levels=sensor_levels, seed=1)), view, config.memory_size
    )

    # Networks
    memory, correction, command = make_memory(config.memory_size), make_correction(config.memory_size), Command(view)
    moves = TensorDictModule(command, ["way_estimate", "correction", "observation"], ["action"])
    actor = TensorDictSequential(memory, correction, moves)
    critic = ValueOperator(Judge(), in_keys=list(JUDGED))

    # Advantages and loss with a clipped probability ratio
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic, deactivate_vmap=True)
    clipped = {"entropy_bonus": False, "normalize_advantage": True, "loss_critic_type": "smooth_l1"}
    loss = ClipPPOLoss(correction, critic, clip_epsilon=0.2, **clipped)
    loss.set_keys(action="correction", sample_log_prob="correction_log_prob")
    weights = [list(module.parameters()) for module in (memory, correction, critic)]
    optimizers = [Adam(group, lr=0.0, fused=True) for group in weights]
    rates = (1e-3, 3e-5), (3e-4, 1e-5), (1e-3, 3e-5)  # of memory, moves and critic, at the start and at the end

    # Training
    frames = {"frames_per_batch": config.num_envs * config.steps_per_batch, "total_frames": config.total_frames}
    collector = Collector(env, actor, auto_register_policy_transforms=False, **frames)
    best, weights_of_best, spread = -1.0, actor.state_dict(), correction[0][1].module
    after = (("next", key) for key in (*JUDGED, "reward", "done", "terminated"))
    transition = (*dict.fromkeys((*BELIEF, *JUDGED)), "correction", "correction_log_prob", *after)
    batches = math.ceil(config.total_frames / frames["frames_per_batch"])
    for number, batch in enumerate(tqdm(collector, total=batches), 1):
        remaining = 1 - number / batches
        spread.std.fill_(0.15 + 0.15 * remaining)
        for optimizer, (start, end) in zip(optimizers, rates, strict=True):
            optimizer.param_groups[0]["lr"] = end + (start - end) * remaining
        if number <= config.memory_batches:
            optimizers[1].param_groups[0]["lr"] = 0.0
        for _ in range(config.epochs):
            with torch.no_grad():
                transitions = advantage(batch.select(*transition)).reshape(-1)
            for rows in torch.randperm(len(batch)).split(config.sequences_per_update):
                sequences = batch[rows].select("observation", "before", "hidden", "is_init", "true_way")
                optimize(loss_way(sequences, memory, view), optimizers[0], clip=weights[0], max_norm=1.0)
            for rows in torch.randperm(len(transitions)).split(config.batch_size):
                losses = loss(transitions[rows])  # given the memory, as it was when the moves were made
                total = losses["loss_objective"] + losses["loss_critic"]
                optimize(total, *optimizers[1:], clip=weights[1], max_norm=1.0)
        if number % config.eval_every == 0 or number == batches:
            spl = summarize(episode_measures(evaluation_rollout(validation, actor)))["spl"]
            if spl > best:
                best, weights_of_best = spl, copy.deepcopy(actor.state_dict())
    collector.shutdown()

    # Result
    actor.load_state_dict(weights_of_best)
    shapes = {"hidden": (1, config.memory_size), "before": (3,)}
    policy = export_policy(Flown(memory, correction, command), view, memory=shapes)
    config.out.mkdir(parents=True, exist_ok=True)
    save_policy(config.out / "policy.onnx", policy)
    earth = earth_scenario(config.eval_regions, seed=paper.TEST_SEED, **REGIONS)
    tasks = earth.with_tasks(earth.random_tasks(config.eval_tasks, paper.TEST_SEED))
    result = summarize(evaluate(policy, tasks, errors=(0.05, 0.05, 5.0), start_heading=options["start_heading"]))
    write_json(config.out / "eval.json", result | {"seed": config.seed, "validation_spl": best})
    print(
        f"SR {result['success_rate']:.1f} %, SPL {result['spl']:.1f} % on Earth, with noise of 0.05 deg, 0.05 deg, 5 nT"
    )
    return result


if __name__ == "__main__":
    train(tyro.cli(Config, description=__doc__))
