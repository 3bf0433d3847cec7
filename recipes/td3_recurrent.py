"""Recurrent TD3: train an agent that reads the paper's eight numbers and no heading.

    python recipes/td3_recurrent.py                # about four minutes on one core
    python recipes/td3_recurrent.py --resume RUN   # go on after a kill, exactly

The state of Eq. 3-1 does not hold the heading that turns are counted from, so the memoryless agent of
td3_gradient_guided.py stands still on it. This one remembers: an LSTM adds up the turns (magrl/recurrent.py). The true
heading is used in training, by the critics, and never by the policy that flies. Expected: 95 to 100 % of 1000 tasks
that it never saw, SPL 87 to 97 %. The run folder is that of the other recipes.
"""

from __future__ import annotations

import os

# A busy neighbour on the machine makes libgomp's spinning threads many times slower; this has to come before torch.
os.environ.setdefault("GOMP_SPINCOUNT", "3000")

import math
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from td3_gradient_guided import passes_paper, report
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl import torchrl_logger
from torchrl.checkpoint import GlobalRNGState
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.envs import Compose, RewardScaling, RewardSum, TransformedEnv
from torchrl.modules import AdditiveGaussianModule, EGreedyModule
from torchrl.objectives import SoftUpdate
from tqdm import tqdm

from magrl import plots, recurrent, td3
from magrl.checkpoints import BestPolicy, Checkpoints, RunningEpisodes, check_finite
from magrl.env import GeomagneticNavEnv
from magrl.loggers import Logger, WandbMode, check_logger
from magrl.metrics import TrainingTally, episode_measures, summarise
from magrl.runs import RunLog, StopRequest, create_run_folder, locked
from magrl.settings import check_settings, read_settings, resume_folder
from magrl.tasks import FIRST_RESERVED_SEED, PAPER_DISTANCE_KM, TEST_SEED, VALIDATION_SEED, task_set

SEEN = ("observation", "heading_vector", *recurrent.STATE_KEYS)
TRANSITION = (*SEEN, "is_init", "action", *(("next", key) for key in (*SEEN, "reward", "done", "terminated")))
EVALUATED = ("success_rate", "spl", "steps", "navigation_error_km")
COLUMNS = ("frames", "episodes", "updates", "seconds", "return", "success_rate", "reward_destination")
COLUMNS += ("reward_proximity", "reward_alignment", "loss_critic", "loss_actor", "loss_heading")
COLUMNS += tuple(f"eval_{key}" for key in EVALUATED)


@dataclass(frozen=True)
class Config:
    """Settings of a training."""

    seed: int = 0
    """Of networks, exploration and training tasks."""
    out: Path | None = None
    """Run folder; by default runs/td3_recurrent-seed<seed>."""
    resume: Path | None = None
    """Run folder of a training that was cut off, to go on with: its settings are used, and no others."""
    device: str = "cpu"
    """Where everything runs: cpu, cuda, cuda:0 …"""
    logger: Logger = "wandb"
    """Where the curves go beside train.csv (docs/logging.md); tensorboard is an extra."""
    wandb_mode: WandbMode = "offline"
    """Of the logger wandb: offline needs neither network nor login, disabled writes nothing of wandb."""
    checkpoint_every: float = 30.0
    """Seconds between checkpoints, from which --resume RUN goes on."""

    # Environment
    num_envs: int = 512
    """Vehicles that fly at the same time."""
    total_frames: int = 163_840
    """Vehicle-steps to train for."""
    train_steps: int = 24
    """Moves after which a journey in training is cut off; the evaluation allows the paper's 50. Short journeys are
    replayed whole, so that the memory always starts where it really starts."""
    shortest_task_km: float = 100.0
    """Shortest journey in training [km]; the longest, and those of the evaluation, are the paper's 300 to 500 km. Near
    destinations are found by chance, and until some are the critics know nothing of the reward for arriving."""
    zeta: float = 0.01
    """Arrival threshold on the objective (Eq. 2-7)."""
    alignment_weight: float = 3.0
    """zeta_3 of Eq. 3-6 [1/rad]."""
    alignment_offset: float = 0.0
    """Heading deviation at which the alignment term turns into a penalty [rad]. With the paper's pi / 4 a step that is
    well aligned pays, however short it is, and a vehicle that dawdles does not arrive within ``train_steps``."""

    # Agent
    num_cells: tuple[int, ...] = (128, 128, 128)
    """Width of each hidden layer."""
    memory_size: int = 64
    """Width of the LSTM."""

    # Training
    steps_per_batch: int = 4
    """Steps of all vehicles between rounds of updates."""
    updates_per_step: int = 16
    """Gradient steps for each step of all vehicles."""
    num_slices: int = 43
    """Journeys, or pieces of them, in a gradient step."""
    slice_length: int = 24
    """Longest piece of a journey in a gradient step."""
    buffer_size: int = 163_840
    """Transitions that the replay buffer holds."""
    gamma: float = 0.9
    """Discount factor."""
    tau: float = 0.01
    """Share of the networks that enters the targets at each soft update."""
    policy_delay: int = 2
    """Critic updates for each update of actor and targets."""
    learning_rate: float = 2e-3
    """Of actor and critics at the start."""
    final_learning_rate: float = 4e-5
    """At the end; linear in between."""
    memory_rate: float = 5.0
    """Learning rate of the memory, in units of that of the actor."""
    heading_weight: float = 0.0
    """Weight of the error of the estimated heading in the loss of the actor, which teaches the memory what it should
    be; 0 leaves that to the critics."""
    exploration_noise: float = 0.5
    """Standard deviation of the noise on actions in [-1, 1]. It has to be large at first, while the policy is the same
    everywhere: critics that have seen few actions mislead the actor for long."""
    final_exploration_noise: float = 0.1
    """After noise_share of the training; linear until then."""
    noise_share: float = 0.3
    """Share of the training in which the noise falls."""
    random_share: float = 0.1
    """Share of the actions in training that are drawn at random."""
    policy_noise: float = 0.1
    """Standard deviation of the noise on target actions."""
    noise_clip: float = 0.5
    """Largest noise on target actions."""
    reward_scale: float = 0.05
    """Factor on rewards, for the critics only; what is reported is unscaled."""
    saturation_weight: float = 0.05
    """Weight of the penalty that keeps the actor out of the flat ends of its tanh; falls linearly to 0."""
    clip_memory: float = 1.0
    """Largest norm of the gradient of the memory."""

    # Evaluation
    eval_every: int = 10
    """Collected batches between evaluations on the small task set."""
    eval_tasks_small: int = 200
    """Tasks of the evaluations during training, which choose the policy that is kept."""
    eval_tasks: int = 1000
    """Tasks of the final evaluation."""

    def __post_init__(self) -> None:
        check_logger(self.logger, self.wandb_mode)
        counts = ("num_envs", "total_frames", "train_steps", "memory_size", "updates_per_step", "num_slices")
        counts += ("slice_length", "policy_delay", "eval_every", "eval_tasks_small", "eval_tasks")
        positive = ("learning_rate", "final_learning_rate", "memory_rate", "reward_scale", "zeta", "clip_memory")
        positive += ("shortest_task_km",)
        ranges = dict.fromkeys(counts, (1, math.inf)) | dict.fromkeys(positive, (1e-12, math.inf))
        ranges |= {"tau": (1e-12, 1), "gamma": (0, 1 - 1e-12), "seed": (0, FIRST_RESERVED_SEED - 1)}
        ranges |= {"noise_share": (1e-12, 1), "random_share": (0, 1)}
        ranges["steps_per_batch"] = (2, math.inf)  # TorchRL's buffer fails to add single steps of several vehicles
        ranges |= dict.fromkeys(("exploration_noise", "final_exploration_noise", "policy_noise"), (0, 10))
        ranges |= dict.fromkeys(("noise_clip", "saturation_weight", "heading_weight"), (0, math.inf))
        ranges |= dict.fromkeys(("alignment_weight", "alignment_offset"), (-1e6, 1e6))
        ranges["buffer_size"] = (self.num_envs * self.steps_per_batch, math.inf)
        ranges["checkpoint_every"] = (0, math.inf)
        check_settings(self, ranges)


def parse(args: list[str] | None = None) -> Config:
    """Reads the command line, or the settings of the run to go on with."""
    if folder := resume_folder(args):
        return read_settings(folder, Config, recurrent=True)
    return tyro.cli(Config, args=args, prog="td3_recurrent.py", description=__doc__)


def make_envs(config: Config) -> tuple[GeomagneticNavEnv, GeomagneticNavEnv, GeomagneticNavEnv]:
    """Environments in physical units: for training, for the evaluations during it, and for the final one."""
    options: dict[str, Any] = {"zeta": config.zeta, "device": config.device}
    base = GeomagneticNavEnv(
        num_envs=config.num_envs,
        distance_range_km=(config.shortest_task_km, PAPER_DISTANCE_KM[1]),
        max_steps=config.train_steps,
        seed=config.seed,
        **options,
    )
    small, final = (
        GeomagneticNavEnv(num_envs=count, tasks=task_set(count, seed), field=base.field, seed=seed, **options)
        for count, seed in ((config.eval_tasks_small, VALIDATION_SEED), (config.eval_tasks, TEST_SEED))
    )
    return base, small, final


class Learner:
    """TD3 with a memory: the networks, TorchRL's loss over them, and their optimisers."""

    def __init__(self, config: Config, view: td3.PolicyConfig, device: torch.device) -> None:
        self.config, self.updates = config, 0
        self.actor = recurrent.make_actor(view, config.memory_size, device)
        noise = {"policy_noise": config.policy_noise, "noise_clip": config.noise_clip}
        self.loss = recurrent.make_loss(self.actor, recurrent.make_critic(view, device), gamma=config.gamma, **noise)
        self.soft_update = SoftUpdate(self.loss, tau=config.tau)
        self.memory, others = recurrent.parameter_groups(self.loss)
        self.rates = (1.0, 1.0, config.memory_rate)
        weights = (list(self.loss.qvalue_network_params.flatten_keys().values()), others, self.memory)
        self.critic_optimiser, self.actor_optimiser, self.memory_optimiser = self.optimisers = tuple(
            torch.optim.Adam(group, lr=rate * config.learning_rate, fused=True)
            for group, rate in zip(weights, self.rates, strict=True)
        )
        self.losses = dict.fromkeys(("critic", "value", "heading", "saturation"), torch.zeros(()))

    def anneal(self, left: float) -> None:
        """Sets the learning rates on their lines, of which the share ``left`` is still to go."""
        for optimiser, rate in zip(self.optimisers, self.rates, strict=True):
            start, end = rate * self.config.learning_rate, rate * self.config.final_learning_rate
            for group in optimiser.param_groups:
                group["lr"] = end + left * (start - end)

    def update(self, slices: TensorDictBase, saturation_weight: float) -> None:
        """One gradient step of the critics and, every ``policy_delay`` of them, of the actor and the targets."""
        self.losses["critic"] = recurrent.value_loss(self.loss, slices)
        self.losses["critic"].backward()
        step(self.critic_optimiser)
        self.updates += 1
        if self.updates % self.config.policy_delay == 0:
            self.losses |= recurrent.actor_losses(self.loss, slices)
            total = self.losses["value"] + self.config.heading_weight * self.losses["heading"]
            (total + saturation_weight * self.losses["saturation"]).backward()
            torch.nn.utils.clip_grad_norm_(self.memory, self.config.clip_memory)
            step(self.actor_optimiser, self.memory_optimiser)
            self.soft_update.step()

    def check(self) -> None:
        """Stops at a loss or a weight that is not a number."""
        what = f"after update {self.updates}"
        check_finite(((f"loss_{name}", loss) for name, loss in self.losses.items()), what)
        check_finite(self.loss.named_parameters(), what)

    def state_dict(self) -> dict[str, Any]:
        """Weights, targets, moments of Adam, counts."""
        optimisers = [optimiser.state_dict() for optimiser in self.optimisers]
        losses = {name: loss.item() for name, loss in self.losses.items()}
        return {"loss": self.loss.state_dict(), "optimisers": optimisers, "updates": self.updates, "losses": losses}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Goes on from there."""
        self.loss.load_state_dict(state_dict["loss"])
        for optimiser, state in zip(self.optimisers, state_dict["optimisers"], strict=True):
            optimiser.load_state_dict(state)
        self.updates = state_dict["updates"]
        self.losses = {name: torch.tensor(loss) for name, loss in state_dict["losses"].items()}


class Training:
    """Everything that a training is made of, so that it can be put aside and taken up again."""

    def __init__(self, folder: Path, config: Config) -> None:
        self.folder, self.config = folder, config
        self.base, self.small_env, self.final_env = make_envs(config)
        view = td3.policy_config(self.base, config.num_cells, layer_norm=True, observe_heading=False)
        self.learner = Learner(config, view, self.base.device)
        guidance = td3.guidance_transforms(self.base, config.alignment_weight, config.alignment_offset)
        self.alignment = guidance[-1]
        sight = recurrent.training_transforms(view, self.learner.actor)
        rewards = [RewardSum(), RewardScaling(loc=0.0, scale=config.reward_scale)]
        self.env = TransformedEnv(self.base, Compose(*guidance, *sight, td3.action_transform(view), *rewards))
        self.policy = recurrent.RecurrentPolicy(view, config.memory_size, self.learner.actor).to(self.env.device)
        self.noise, self.collector = self._collection()
        self.buffer = self._buffer()
        self.tally, self.best = TrainingTally(self.base.destination_weight, config.reward_scale), BestPolicy()
        parts = {"learner": self.learner, "noise": self.noise, "buffer": self.buffer, "tally": self.tally}
        parts |= {"best": self.best, "random": GlobalRNGState(), "episodes": RunningEpisodes(self.collector, self.base)}
        self.checkpoints = Checkpoints(folder / "checkpoints", parts)
        resumed = config.resume is not None and bool(self.checkpoints.files())  # before the first one, the seed leads
        self.run_log = self._run_log(resumed=resumed)
        self.checkpoints.parts["run"] = self.run_log
        if resumed:
            self.checkpoints.load()

    def _collection(self) -> tuple[AdditiveGaussianModule, Collector]:
        """The noise on actions, and what collects with it."""
        config, spec, device = self.config, self.env.action_spec_unbatched, self.env.device
        noise = AdditiveGaussianModule(
            spec=spec,
            sigma_init=config.exploration_noise,
            sigma_end=config.final_exploration_noise,
            annealing_num_steps=int(config.noise_share * config.total_frames),
            device=device,
        )
        random = EGreedyModule(spec=spec, eps_init=config.random_share, eps_end=config.random_share, device=device)
        collector = Collector(
            self.env,
            TensorDictSequential(self.learner.actor, noise, random),
            frames_per_batch=config.steps_per_batch * config.num_envs,
            total_frames=config.total_frames,
            device=device,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
        )
        return noise, collector

    def _buffer(self) -> TensorDictReplayBuffer:
        """Replay in [time, vehicle], so that a vehicle's steps follow each other."""
        length = self.config.slice_length
        return TensorDictReplayBuffer(
            storage=LazyTensorStorage(self.config.buffer_size, ndim=2, device=self.env.device),
            sampler=SliceSampler(slice_len=length, end_key=("next", "done"), strict_length=False, cache_values=True),
            batch_size=self.config.num_slices * length,
        )

    def _run_log(self, *, resumed: bool) -> RunLog:
        settings = {**asdict(self.config), "out": self.folder.name, "resume": None, "recurrent": True}
        labels: dict[str, Any] = {"group": "td3_recurrent", "tags": ["td3_recurrent"]}
        where: dict[str, Any] = {"logger": self.config.logger, "wandb_mode": self.config.wandb_mode}
        return RunLog(self.folder, COLUMNS, settings, resumed=resumed, **where, **labels)

    def run(self) -> int | None:
        """Trains to the end, or until a signal asks to stop; the exit code that it asks for."""
        frames, done, saved = self.config.total_frames, False, time.perf_counter()
        batch_frames = self.config.steps_per_batch * self.config.num_envs
        bar = {"initial": self.tally.frames, "desc": "td3_recurrent", "mininterval": 0.5}
        progress = tqdm(total=frames, unit="frame", unit_scale=True, **bar)
        with StopRequest() as stop, progress:
            for batch in self.collector:
                self.learn(batch)
                done = self.tally.frames >= frames
                if done or self.tally.frames // batch_frames % self.config.eval_every == 0:
                    progress.set_postfix_str(self.evaluate())
                progress.update(batch.numel())
                if done:
                    break
                if stop.exit_code or time.perf_counter() - saved >= self.config.checkpoint_every:
                    self.checkpoints.save(self.tally.frames)
                    saved = time.perf_counter()
                if stop.exit_code:
                    break
        self.collector.shutdown()
        return None if done else stop.exit_code

    def learn(self, batch: TensorDictBase) -> None:
        """Stores some steps of all vehicles, ``(N, T)``, and learns from what is stored."""
        check_finite(batch, f"after {self.tally.frames} frames")
        self.buffer.extend(batch.select(*TRANSITION))
        batch = batch.reshape(-1)
        self.noise.step(batch.numel())
        self.tally.add(batch, self.alignment.term(batch, batch["next"]))
        left = max(0.0, 1 - self.tally.frames / self.config.total_frames)
        self.learner.anneal(left)
        for _ in range(self.config.steps_per_batch * self.config.updates_per_step):
            self.learner.update(self.buffer.sample(), left * self.config.saturation_weight)
        self.learner.check()

    def evaluate(self) -> str:
        """Flies the small task set, keeps the policy if it is the best so far, and adds a row of curves; in short."""
        small = summarise(episode_measures(td3.evaluation_rollout(self.small_env, self.policy)))
        self.best.offer(small["spl"], self.learner.actor)
        row = {"frames": self.tally.frames, "episodes": self.tally.episodes, "updates": self.learner.updates}
        row |= {"seconds": self.run_log.seconds, **self.tally.row()}
        for column, name in (("loss_critic", "critic"), ("loss_actor", "value"), ("loss_heading", "heading")):
            row[column] = self.learner.losses[name].item()
        self.run_log.row(row | {f"eval_{key}": small[key] for key in EVALUATED})
        return f"SR {small['success_rate']:.1f} %, SPL {small['spl']:.1f} %"

    def save_policy(self) -> None:
        """Writes the policy that was best on the small set, and the curves."""
        self.learner.actor.load_state_dict(self.best.weights or self.learner.actor.state_dict())
        recurrent.save_policy(self.folder / "policy.pt", self.policy)
        if self.run_log.rows:
            self.run_log.figure("training", plots.training_figure(self.run_log.rows))

    def conclude(self, seconds: float) -> dict[str, float]:
        """Flies tasks that the policy never saw, and writes its numbers and pictures."""
        rollout = td3.evaluation_rollout(self.final_env, self.policy)
        result = summarise(episode_measures(rollout)) | {"seed": self.config.seed, "tasks_seed": TEST_SEED}
        result |= {"frames": self.tally.frames, "episodes": self.tally.episodes, "updates": self.learner.updates}
        reached = (row["seconds"] for row in self.run_log.rows if passes_paper(row))
        result |= {"training_seconds": seconds, "seconds_to_97_sr_88_spl": next(reached, math.nan)}
        self.run_log.figure("trajectories", plots.trajectories_figure(rollout, self.base.field, self.base.region))
        self.run_log.result(result, navigator="td3_recurrent")
        self.checkpoints.clear()
        return result


def train(config: Config) -> dict[str, float]:
    """Trains, evaluates and writes the run folder; returns what is in its ``eval.json``."""
    folder = config.out or Path("runs") / f"td3_recurrent-seed{config.seed}"
    with locked(config.resume or create_run_folder(folder)):
        return train_in(folder, config)


def train_in(folder: Path, config: Config) -> dict[str, float]:
    """The training itself, in a folder that is this process's own."""
    torchrl_logger.setLevel("WARNING")
    torch.manual_seed(config.seed)
    training = Training(folder, config)
    exit_code = training.run()
    seconds = training.run_log.seconds
    training.save_policy()
    if exit_code:
        training.run_log.close()
        print(
            f"\nStopped after {training.tally.frames} frames; the policy so far is {folder / 'policy.pt'}\n"
            f"To go on: --resume {folder}",
            file=sys.stderr,
        )
        raise SystemExit(exit_code)
    result = training.conclude(seconds)
    training.run_log.close()
    report(folder, result)
    return result


def step(*optimisers: torch.optim.Optimizer) -> None:
    """Moves the weights, and forgets the gradients."""
    for optimiser in optimisers:
        optimiser.step()
        optimiser.zero_grad()


def main() -> None:
    """The command: what cannot be run as asked is said in a line, without a traceback."""
    try:
        train(parse())
    except (ValueError, OSError, FloatingPointError) as error:
        sys.exit(f"td3_recurrent.py: {error}")


if __name__ == "__main__":
    main()
