"""Gradient guidance in another domain: TD3 on the plume environment, with magrl's guidance and without.

    python docs/examples/plume.py

Trains five seeds of each, one after the other: under three minutes on one free core. Writes docs/results/plume.md,
docs/figures/plume.png and docs/figures/plume-tracks.png. Expected: nine journeys in ten arrive after less than half the
moves of training where there is guidance.
"""

from __future__ import annotations

import os

# A busy neighbour on the machine makes libgomp's spinning threads many times slower; this has to come before torch.
os.environ.setdefault("GOMP_SPINCOUNT", "3000")

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro
from matplotlib.figure import Figure
from plume_env import HIGH_KM, LOW_KM, PlumeEnv, concentration
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Bounded, LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import CatTensors, Compose, RewardScaling, StepCounter, Transform, TransformedEnv
from torchrl.modules import MLP, AdditiveGaussianModule, TanhModule, ValueOperator

from magrl import plots, td3
from magrl.transforms import AlignmentReward, AngleVector, FieldGradient, GradientHeading, MinMaxNorm, TargetDifference

TRANSITION = ("observation", "action", *(("next", k) for k in ("observation", "reward", "done", "terminated")))
EVALUATION_SEED = 1_000_000


@dataclass(frozen=True)
class Config:
    """Settings of the comparison."""

    seeds: int = 5
    """Trainings of each kind."""
    total_frames: int = 25_600
    """Moves of all vehicles in each training."""
    num_envs: int = 64
    """Vehicles that move at the same time."""
    init_random_frames: int = 1024
    """Moves made at random first."""
    updates_per_batch: int = 4
    """Gradient steps after each step of all vehicles."""
    batch_size: int = 256
    """Transitions of a gradient step."""
    eval_every: int = 20
    """Batches between evaluations."""
    eval_tasks: int = 256
    """Journeys of an evaluation, which no training meets."""
    max_steps: int = 30
    """Moves after which a journey is over."""
    out: Path = Path("docs")
    """Where the folders `results` and `figures` are."""


@dataclass(frozen=True)
class Training:
    """What one training left behind."""

    actor: TensorDictSequential
    frames: list[int]
    success: list[float]
    """Journeys that arrived in the evaluation after so many frames [%]."""


# What magrl adds


def guidance() -> list[Transform]:
    """The way to the target by the gradients of two tracers, in the place of two magnetic elements."""
    return [
        FieldGradient(concentration, ["position"], ["tracer_gradient"]),
        GradientHeading(["tracers", "target_tracers", "tracer_gradient"], ["way", "way_valid"], pair=(0, 1)),
        AlignmentReward(["heading", "way", "way_valid"], weight=1.0, offset=0.0),
    ]


def view() -> list[Transform]:
    """What the networks read: tracers, what is left of them, and the heading; and actions in [-1, 1]."""
    keys = ["tracers", "target_tracers", "tracers_left"]
    scaled = [f"{key}_scaled" for key in keys]
    return [
        TargetDifference(["tracers", "target_tracers"], ["tracers_left"]),
        MinMaxNorm(keys, scaled, in_keys_inv=["action"], bounds={"tracers_left": (-2.0, 2.0)}),
        AngleVector(["heading"], ["course"]),
        CatTensors([*scaled, "course"], "observation", del_keys=False, sort=False),
    ]


def make_env(num_envs: int, max_steps: int, seed: int, *, guided: bool) -> TransformedEnv:
    """Both agents see and do the same; the guided one is also paid for its heading."""
    steps = [StepCounter(max_steps), *(guidance() if guided else []), *view(), RewardScaling(loc=0.0, scale=0.2)]
    return TransformedEnv(PlumeEnv(num_envs, seed), Compose(*steps))


# TD3


def make_networks(inputs: int = 8, width: int = 128) -> tuple[TensorDictSequential, ValueOperator]:
    """Actor, ``observation`` to ``action`` in [-1, 1], and critic."""
    layers = {"num_cells": [width] * 2, "activation_class": nn.ReLU}
    layers |= {"norm_class": nn.LayerNorm, "norm_kwargs": [{"normalized_shape": width}] * 2}
    actor = TensorDictSequential(
        TensorDictModule(MLP(inputs, 2, **layers), in_keys=["observation"], out_keys=["logits"]),
        TanhModule(in_keys=["logits"], out_keys=["action"], spec=Bounded(-1.0, 1.0, (2,))),
    )
    return actor, ValueOperator(MLP(inputs + 2, 1, **layers), in_keys=["observation", "action"])


class Learner:
    """TD3 from the parts of :mod:`magrl.td3`."""

    def __init__(self) -> None:
        self.actor, critic = make_networks()
        self.loss = td3.make_loss(self.actor, critic, gamma=0.9, policy_noise=0.1, noise_clip=0.3)
        self.targets, self.updates = td3.LeanSoftUpdate(self.loss, tau=0.01), 0
        self.critic_optimiser, self.actor_optimiser = (
            torch.optim.Adam(weights, lr=1e-3, fused=True)
            for weights in (self.loss.critic_parameters(), self.loss.actor_network_params.parameters())
        )

    def update(self, transitions: TensorDictBase) -> None:
        """One gradient step of the critics and, every second time, of the actor and the targets."""
        self.updates += 1
        step(self.critic_optimiser, self.loss.value_loss(transitions)[0])
        if self.updates % 2 == 0:
            loss, outputs = self.loss.actor_loss(transitions)
            step(self.actor_optimiser, loss + 0.01 * td3.saturation_penalty(outputs["logits"]))
            self.targets.step()


def step(optimiser: torch.optim.Optimizer, loss: torch.Tensor) -> None:
    """One gradient step."""
    loss.backward()
    optimiser.step()
    optimiser.zero_grad()


def train(config: Config, seed: int, *, guided: bool) -> Training:
    """One training, with an evaluation now and then."""
    torch.manual_seed(seed)
    learner = Learner()
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(config.total_frames), batch_size=config.batch_size)
    training = Training(learner.actor, [], [])
    noise = AdditiveGaussianModule(Bounded(-1.0, 1.0, (2,)), sigma_init=0.2, sigma_end=0.2)
    collector = Collector(
        make_env(config.num_envs, config.max_steps, seed, guided=guided),
        TensorDictSequential(learner.actor, noise),
        frames_per_batch=config.num_envs,
        total_frames=config.total_frames,
        init_random_frames=config.init_random_frames,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
    for number, batch in enumerate(collector, 1):
        buffer.extend(batch.reshape(-1).select(*TRANSITION))
        frames = number * config.num_envs
        for _ in range(config.updates_per_batch if frames >= config.init_random_frames else 0):
            learner.update(buffer.sample())
        if number % config.eval_every == 0:
            arrived = journeys(config, learner.actor)["next", "terminated"].any(1)
            training.frames.append(frames)
            training.success.append(100 * arrived.double().mean().item())
    collector.shutdown()
    return training


@torch.no_grad()
def journeys(config: Config, actor: TensorDictSequential) -> TensorDictBase:
    """Each journey of the evaluation once, ``(eval_tasks, T)``: vehicles that have arrived stay where they are."""
    env = make_env(config.eval_tasks, config.max_steps, EVALUATION_SEED, guided=False)
    return env.rollout(config.max_steps, actor, break_when_any_done=False, break_when_all_done=True)


# Results


def frames_to(training: Training, success: float) -> int | None:
    """Frames at the first evaluation with such a success rate [%]."""
    return next((f for f, s in zip(training.frames, training.success, strict=True) if s >= success), None)


def table(trainings: Mapping[str, Sequence[Training]], success: float = 90.0) -> str:
    """Mean, and in brackets the least and the most of all seeds."""

    def spread(values: Sequence[float | None]) -> str:
        known = [value for value in values if value is not None]
        if len(known) < len(values):
            return f"{len(values) - len(known)} of {len(values)} never"
        return f"{statistics.fmean(known):.0f} ({min(known):.0f}–{max(known):.0f})"

    lines = [
        f"| | seeds | frames to {success:.0f} % | success % halfway | success % at the end |",
        "|---|---|---|---|---|",
    ]
    for name, runs in trainings.items():
        columns = (
            [frames_to(run, success) for run in runs],
            [run.success[len(run.success) // 2 - 1] for run in runs],
            [run.success[-1] for run in runs],
        )
        lines.append(" | ".join((f"| {plots.NAVIGATOR_NAMES[name]}", str(len(runs)), *map(spread, columns))) + " |")
    return "\n".join(lines) + "\n"


def tracks_figure(config: Config, actor: TensorDictSequential, count: int = 10) -> Figure:
    """Journeys of the evaluation over the contours of both tracers."""
    figure = Figure(figsize=(6.5, 6.9), layout="constrained")
    axes = figure.subplots()
    grid = torch.cartesian_prod(*(torch.linspace(low, high, 101) for low, high in zip(LOW_KM, HIGH_KM, strict=True)))
    values, (north, east) = concentration(grid).unflatten(0, (101, 101)), grid.unflatten(0, (101, 101)).unbind(-1)
    for index, (bank, colour) in enumerate((("west", "#E69F00"), ("east", "#0072B2"))):
        axes.contour(east, north, values[..., index], 14, colors=colour, linewidths=0.5, linestyles="solid")
        axes.plot([], color=colour, lw=1, label=f"tracer of the {bank} bank")
    rollout = journeys(config, actor)[:count]
    for path in torch.cat((rollout["position"], rollout["next", "position"][:, -1:]), 1):
        axes.plot(*path.flip(-1).T, "o-", color=plots.PATH, ms=2.5, lw=1.2)
    ends = (("position", "s", plots.START, "start"), ("target_position", "^", plots.TARGET, "target"))
    for key, mark, colour, label in ends:
        axes.plot(*rollout[key][:, 0].flip(-1).T, mark, color=colour, ms=7, label=label)
    axes.set(xlabel="east [km]", ylabel="north [km]", aspect="equal")
    figure.legend(loc="outside upper center", ncols=4)
    return figure


def main(config: Config) -> dict[str, list[Training]]:
    """Trains every seed of both kinds, and writes the table and the pictures."""
    trainings: dict[str, list[Training]] = {"gg_td3": [], "td3": []}
    for seed in range(config.seeds):
        for name, runs in trainings.items():
            runs.append(train(config, seed, guided=name == "gg_td3"))
            print(f"{plots.NAVIGATOR_NAMES[name]}, seed {seed}: {runs[-1].success[-1]:.1f} % arrive", flush=True)
    for folder in ("results", "figures"):
        (config.out / folder).mkdir(parents=True, exist_ok=True)
    (config.out / "results" / "plume.md").write_text(table(trainings))
    curves = {name: [(run.frames, run.success) for run in runs] for name, runs in trainings.items()}
    plots.learning_curves(curves, "journeys that arrive [%]").savefig(config.out / "figures" / "plume.png", dpi=80)
    tracks = tracks_figure(config, trainings["gg_td3"][0].actor)
    tracks.savefig(config.out / "figures" / "plume-tracks.png", dpi=80)
    print(table(trainings), end="")
    return trainings


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
