"""Gradient-Guided TD3: train an agent to navigate by the Earth's magnetic field.

    python recipes/td3_gradient_guided.py                  # preset fast, about a minute on two cores
    python recipes/td3_gradient_guided.py --preset paper   # Table 1 as printed; many hours on a CPU
    python recipes/td3_gradient_guided.py --resume RUN     # go on after a kill, exactly
    python recipes/td3_gradient_guided.py --world my.toml  # your own region, date and altitude: docs/own_data.md

Preset `fast` is expected to fly more than 99.5 % of 1000 tasks that it never saw to their destination, on paths
within 3 % of the shortest. The run folder holds the policy, the curves, the numbers and the pictures.
"""

from __future__ import annotations

import os

# A busy neighbour on the machine makes libgomp's spinning threads many times slower; this has to come before torch.
os.environ.setdefault("GOMP_SPINCOUNT", "3000")

import argparse
import math
import shutil
import sys
import time
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl import torchrl_logger
from torchrl.checkpoint import GlobalRNGState
from torchrl.collectors import BaseCollector, Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, RewardScaling, RewardSum, TransformedEnv
from torchrl.modules import AdditiveGaussianModule
from tqdm import tqdm

from magrl import plots, td3
from magrl.checkpoints import BestPolicy, Checkpoints, RunningEpisodes, check_finite
from magrl.env import GeomagneticNavEnv
from magrl.loggers import Logger, WandbMode, check_logger
from magrl.metrics import TrainingTally, episode_measures, summarise
from magrl.runs import RunLog, StopRequest, create_run_folder, locked
from magrl.settings import check_settings, read_settings, resume_folder
from magrl.tasks import FIRST_RESERVED_SEED, TEST_SEED, VALIDATION_SEED
from magrl.worlds import World, load_world

TRANSITION = ("observation", "action", *(("next", k) for k in ("observation", "reward", "done", "terminated")))
EVALUATED = ("success_rate", "spl", "steps", "navigation_error_km")
COLUMNS = ("frames", "episodes", "updates", "seconds", "return", "success_rate", "reward_destination")
COLUMNS += ("reward_proximity", "reward_alignment", "loss_critic", "loss_actor", *(f"eval_{k}" for k in EVALUATED))


@dataclass(frozen=True)
class Config:
    """Settings of a training; the defaults are those of the preset."""

    preset: Literal["fast", "paper"] = "fast"
    """Where the defaults come from: tuned for two cores, or the paper's Table 1."""
    seed: int = 0
    """Of networks, exploration and training tasks."""
    out: Path | None = None
    """Run folder; by default runs/<recipe>-<preset>-seed<seed>."""
    resume: Path | None = None
    """Run folder of a training that was cut off, to go on with: its settings are used, and no others."""
    device: str = "cpu"
    """Where everything runs: cpu, cuda, cuda:0 …"""
    logger: Logger = "wandb"
    """Where the curves go beside train.csv (docs/logging.md); tensorboard is an extra."""
    wandb_mode: WandbMode = "offline"
    """Of the logger wandb: offline needs neither network nor login, disabled writes nothing of wandb."""
    collectors: int = 1
    """Processes that collect; with more than one, runs are not repeatable to the bit."""
    collector_backend: Literal["process", "ray"] = "process"
    """Where several of them run: on this machine, or on a Ray cluster."""
    checkpoint_every: float = 30.0
    """Seconds between checkpoints, from which --resume RUN goes on."""

    # Environment
    world: Path | None = None
    """TOML or JSON file of an own region, date and altitude (docs/own_data.md); by default the paper's."""
    num_envs: int = 512
    """Vehicles that fly at the same time."""
    total_frames: int = 204_800
    """Vehicle-steps to train for."""
    total_episodes: int | None = None
    """Episodes to train for, if they end before the vehicle-steps."""
    zeta: float = 0.01
    """Arrival threshold on the objective (Eq. 2-7)."""
    start_heading: Literal["north", "random"] = "north"
    """Heading in which vehicles start."""
    alignment_weight: float = 3.0
    """zeta_3 of Eq. 3-6 [1/rad]."""
    alignment_offset: float = math.pi / 4
    """Heading deviation at which the alignment term turns into a penalty [rad]."""

    # Agent
    num_cells: tuple[int, ...] = (128, 128, 128)
    """Width of each hidden layer."""
    layer_norm: bool = True
    """Layer normalisation in actor and critics."""
    observe_heading: bool = True
    """Cosine and sine of the heading in the observation."""
    observe_difference: bool = True
    """Target elements less those here in the observation, scaled to a journey."""

    # Training
    updates_per_batch: int = 8
    """Gradient steps after each step of all vehicles."""
    batch_size: int = 1024
    """Transitions of a gradient step."""
    buffer_size: int = 200_000
    """Transitions that the replay buffer holds."""
    init_random_frames: int = 1024
    """Vehicle-steps flown at random before the policy acts."""
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
    exploration_noise: float = 0.2
    """Standard deviation of the noise on actions in [-1, 1]."""
    final_exploration_noise: float = 0.1
    """At the end; linear in between."""
    policy_noise: float = 0.1
    """Standard deviation of the noise on target actions."""
    noise_clip: float = 0.5
    """Largest noise on target actions."""
    reward_scale: float = 0.05
    """Factor on rewards, for the critics only; what is reported is unscaled."""
    saturation_weight: float = 0.05
    """Weight of the penalty that keeps the actor out of the flat ends of its tanh; falls linearly to 0."""

    # Evaluation
    eval_every: int = 20
    """Collected batches between evaluations on the small task set."""
    eval_tasks_small: int = 200
    """Tasks of the evaluations during training, which choose the policy that is kept."""
    eval_tasks: int = 1000
    """Tasks of the final evaluation."""

    def __post_init__(self) -> None:
        check_logger(self.logger, self.wandb_mode)
        counts = ("num_envs", "total_frames", "updates_per_batch", "batch_size", "buffer_size", "policy_delay")
        counts += ("eval_every", "eval_tasks_small", "eval_tasks", "collectors")
        positive = ("learning_rate", "final_learning_rate", "reward_scale", "zeta")
        ranges = dict.fromkeys(counts, (1, math.inf)) | dict.fromkeys(positive, (1e-12, math.inf))
        if self.total_episodes is not None:
            ranges["total_episodes"] = (1, math.inf)
        ranges |= {"checkpoint_every": (0, math.inf)}
        ranges |= {"tau": (1e-12, 1), "gamma": (0, 1 - 1e-12), "seed": (0, FIRST_RESERVED_SEED - 1)}
        ranges |= dict.fromkeys(("exploration_noise", "final_exploration_noise", "policy_noise"), (0, 10))
        ranges |= dict.fromkeys(("noise_clip", "saturation_weight", "init_random_frames"), (0, math.inf))
        ranges |= dict.fromkeys(("alignment_weight", "alignment_offset"), (-1e6, 1e6))
        check_settings(self, ranges)
        if self.buffer_size < self.batch_size:
            raise ValueError(f"buffer_size {self.buffer_size} does not hold one batch of {self.batch_size}")
        if self.num_envs % self.collectors:
            raise ValueError(f"{self.num_envs} vehicles cannot be shared out evenly to {self.collectors} collectors")


PRESETS = {
    "fast": Config(),
    "paper": Config(
        preset="paper",
        num_envs=1,
        total_frames=1_000_000,
        total_episodes=20_000,
        num_cells=(512, 512, 512),
        layer_norm=False,
        observe_difference=False,
        updates_per_batch=1,
        batch_size=256,
        buffer_size=50_000,
        init_random_frames=256,
        gamma=0.995,
        tau=0.005,
        learning_rate=1e-3,
        final_learning_rate=1e-3,
        final_exploration_noise=0.2,
        reward_scale=1.0,
        saturation_weight=0.0,
        eval_every=2000,
    ),
}


def parse(recipe: str, args: list[str] | None = None) -> Config:
    """Reads the command line: the preset first, then what overrides it; or the settings of the run to go on with."""
    if folder := resume_folder(args):
        config = read_settings(folder, Config, guided=recipe != "td3.py")
        return config if config.world is None else replace(config, world=folder / Path(str(config.world)).name)
    first = argparse.ArgumentParser(add_help=False)
    first.add_argument("--preset", choices=sorted(PRESETS), default="fast")
    preset = first.parse_known_args(args)[0].preset
    return tyro.cli(Config, default=PRESETS[preset], args=args, prog=recipe, description=__doc__)


def world_of(config: Config) -> World:
    """Where the journeys lie: the user's own place, or the paper's."""
    return load_world(config.world) if config.world else World()


def make_env(base: GeomagneticNavEnv, config: Config, view: td3.PolicyConfig, *, guided: bool) -> TransformedEnv:
    """The guidance, the agent's view and the scaled reward on top of the environment."""
    guidance = td3.guidance_transforms(base, config.alignment_weight, config.alignment_offset) if guided else []
    rewards = [RewardSum(), RewardScaling(loc=0.0, scale=config.reward_scale)]
    return TransformedEnv(
        base, Compose(*guidance, *td3.observation_transforms(view), td3.action_transform(view), *rewards)
    )


def worker_env(config: Config, view: td3.PolicyConfig, index: int, *, guided: bool) -> TransformedEnv:
    """The share of the vehicles that one of several collecting processes flies, on tasks of its own."""
    seed = (config.seed + 1_000_003 * (index + 1)) % FIRST_RESERVED_SEED
    options = {"zeta": config.zeta, "start_heading": config.start_heading, "device": config.device}
    options |= world_of(config).options()
    base = GeomagneticNavEnv(num_envs=config.num_envs // config.collectors, seed=seed, **options)
    return make_env(base, config, view, guided=guided)


def make_collector(
    config: Config, env: TransformedEnv, view: td3.PolicyConfig, policy: TensorDictSequential, *, guided: bool
) -> BaseCollector:
    """TorchRL's collector: one step of all vehicles at a time, here or in several processes."""
    options: dict[str, Any] = {"frames_per_batch": config.num_envs, "total_frames": config.total_frames}
    options |= {"init_random_frames": config.init_random_frames, "device": env.device}
    if config.collectors == 1:
        return Collector(env, policy, track_traj_ids=False, auto_register_policy_transforms=False, **options)
    makers = [partial(worker_env, config, view, index, guided=guided) for index in range(config.collectors)]
    if config.collector_backend == "ray":
        actor = {"num_cpus": 1, "num_gpus": int(env.device.type == "cuda")}
        path = os.pathsep.join(filter(None, (str(Path(__file__).parent), os.environ.get("PYTHONPATH"))))
        cluster = {"log_to_driver": False, "include_dashboard": False}
        cluster["runtime_env"] = {"env_vars": {"PYTHONPATH": path}}  # where the workers find this file
        options |= {"backend_options": {"remote_configs": actor, "ray_init_config": cluster}}
    return Collector(makers, policy, backend=config.collector_backend, sync=True, **options)


class Learner:
    """TD3: the networks, TorchRL's loss over them, and their optimisers."""

    def __init__(self, config: Config, view: td3.PolicyConfig, device: torch.device) -> None:
        self.config, self.updates = config, 0
        self.actor, critic = td3.make_actor(view, device), td3.make_critic(view, device)
        noise = {"policy_noise": config.policy_noise, "noise_clip": config.noise_clip}
        self.loss = td3.make_loss(self.actor, critic, gamma=config.gamma, **noise)
        self.soft_update = td3.LeanSoftUpdate(self.loss, tau=config.tau)
        self.critic_optimiser, self.actor_optimiser = (
            torch.optim.Adam(weights, lr=config.learning_rate, fused=True)
            for weights in (self.loss.critic_parameters(), self.loss.actor_network_params.parameters())
        )
        self.loss_critic, self.loss_actor = torch.zeros(()), torch.zeros(())

    def anneal(self, left: float) -> None:
        """Sets the learning rate on its line, of which the share ``left`` is still to go."""
        start, end = self.config.learning_rate, self.config.final_learning_rate
        for optimiser in (self.critic_optimiser, self.actor_optimiser):
            for group in optimiser.param_groups:
                group["lr"] = end + left * (start - end)

    def update(self, transitions: TensorDictBase, saturation_weight: float) -> None:
        """One gradient step of the critics and, every ``policy_delay`` of them, of the actor and the targets."""
        self.loss_critic, _ = self.loss.value_loss(transitions)
        step(self.critic_optimiser, self.loss_critic)
        self.updates += 1
        if self.updates % self.config.policy_delay == 0:
            self.loss_actor, outputs = self.loss.actor_loss(transitions)
            penalty = saturation_weight * td3.saturation_penalty(outputs["logits"])
            step(self.actor_optimiser, self.loss_actor + penalty)
            self.soft_update.step()

    def check(self) -> None:
        """Stops at a loss or a weight that is not a number."""
        what = f"after update {self.updates}"
        check_finite((("loss_critic", self.loss_critic), ("loss_actor", self.loss_actor)), what)
        check_finite(self.loss.named_parameters(), what)

    def state_dict(self) -> dict[str, Any]:
        """Weights, targets, moments of Adam, counts."""
        parts = {"loss": self.loss, "critic": self.critic_optimiser, "actor": self.actor_optimiser}
        state = {name: part.state_dict() for name, part in parts.items()}
        return state | {"updates": self.updates, "losses": (self.loss_critic.item(), self.loss_actor.item())}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Goes on from there."""
        self.loss.load_state_dict(state_dict["loss"])
        self.critic_optimiser.load_state_dict(state_dict["critic"])
        self.actor_optimiser.load_state_dict(state_dict["actor"])
        self.updates = state_dict["updates"]
        self.loss_critic, self.loss_actor = (torch.tensor(loss) for loss in state_dict["losses"])


def train(config: Config, *, guided: bool = True) -> dict[str, float]:
    """Trains, evaluates and writes the run folder; returns what is in its ``eval.json``."""
    name = "td3_gradient_guided" if guided else "td3"
    world_of(config).options()  # what is wrong with it is said before there is a folder
    place = f"-{config.world.stem}" if config.world else ""
    folder = config.out or Path("runs") / f"{name}-{config.preset}{place}-seed{config.seed}"
    with locked(config.resume or create_run_folder(folder)):
        if config.world and not config.resume:
            config = replace(config, world=shutil.copyfile(config.world, folder / f"world{config.world.suffix}"))
        return train_in(folder, config, name=name, guided=guided)


def train_in(folder: Path, config: Config, *, name: str, guided: bool) -> dict[str, float]:
    """The training itself, in a folder that is this process's own."""
    torchrl_logger.setLevel("WARNING")
    torch.manual_seed(config.seed)

    # Environments: physical units below, the agent's view and the guidance on top
    options = {"zeta": config.zeta, "start_heading": config.start_heading, "device": config.device}
    world = world_of(config)
    options |= world.options()
    base = GeomagneticNavEnv(num_envs=config.num_envs, seed=config.seed, **options)
    small_env, final_env = (
        GeomagneticNavEnv(num_envs=count, tasks=world.random_tasks(count, seed), seed=seed, **options)
        for count, seed in ((config.eval_tasks_small, VALIDATION_SEED), (config.eval_tasks, TEST_SEED))
    )
    view = td3.policy_config(
        base,
        config.num_cells,
        layer_norm=config.layer_norm,
        observe_heading=config.observe_heading,
        observe_difference=config.observe_difference,
    )
    env = make_env(base, config, view, guided=guided)
    alignment = env.transform[2] if guided else None

    # Learning, collection and replay
    learner = Learner(config, view, env.device)
    policy = td3.FieldPolicy(view, learner.actor).to(env.device)
    noise = AdditiveGaussianModule(
        spec=env.action_spec_unbatched,
        sigma_init=config.exploration_noise,
        sigma_end=config.final_exploration_noise,
        annealing_num_steps=math.ceil(config.total_frames / config.num_envs),
        device=env.device,
    )
    collector = make_collector(config, env, view, TensorDictSequential(learner.actor, noise), guided=guided)
    storage = LazyTensorStorage(config.buffer_size, device=env.device)
    drawn = config.updates_per_batch * config.batch_size  # at once, for all updates between two steps of the vehicles
    buffer = TensorDictReplayBuffer(storage=storage, batch_size=drawn)

    # Everything that a training is made of, so that it can be put aside and taken up again
    settings = {**asdict(config), "out": folder.name, "resume": None, "guided": guided}
    settings["world"] = config.world and config.world.name
    labels = {"group": f"{name}-{config.preset}", "tags": [name, config.preset]}
    tally, best = TrainingTally(base.destination_weight, config.reward_scale), BestPolicy()
    parts = {"learner": learner, "noise": noise, "buffer": buffer, "tally": tally, "best": best}
    parts["random"] = GlobalRNGState()
    if config.collectors == 1:  # what other processes are at is theirs: they start new episodes
        parts["episodes"] = RunningEpisodes(collector, base)
    checkpoints = Checkpoints(folder / "checkpoints", parts)
    resumed = config.resume is not None and bool(checkpoints.files())  # before the first one, the seed leads there
    labels |= {"logger": config.logger, "wandb_mode": config.wandb_mode}
    run = RunLog(folder, COLUMNS, settings, resumed=resumed, **labels)
    checkpoints.parts["run"] = run
    if resumed:
        checkpoints.load()
    saved = time.perf_counter()

    progress = tqdm(
        total=config.total_frames, initial=tally.frames, unit="frame", unit_scale=True, desc=name, mininterval=0.5
    )
    with StopRequest() as stop:
        for batch in collector:
            batch = batch.reshape(-1)
            check_finite(batch, f"after {tally.frames} frames")
            buffer.extend(batch.select(*TRANSITION))
            noise.step()
            tally.add(batch, alignment.term(batch, batch["next"]) if alignment else None)
            left = max(0.0, 1 - tally.frames / config.total_frames)
            learner.anneal(left)
            if len(buffer) >= config.batch_size:
                for transitions in buffer.sample().split(config.batch_size):
                    learner.update(transitions, left * config.saturation_weight)
            learner.check()
            if config.collectors > 1:
                collector.update_policy_weights_()

            done = tally.frames >= config.total_frames or tally.episodes >= (config.total_episodes or math.inf)
            if done or tally.frames // config.num_envs % config.eval_every == 0:
                small = summarise(episode_measures(td3.evaluation_rollout(small_env, policy)))
                best.offer(small["spl"] - small["steps_all"], learner.actor)  # short paths, in few moves
                row = {"frames": tally.frames, "episodes": tally.episodes, "updates": learner.updates}
                row |= {"seconds": run.seconds, **tally.row()}
                row |= {"loss_critic": learner.loss_critic.item(), "loss_actor": learner.loss_actor.item()}
                run.row(row | {f"eval_{key}": small[key] for key in EVALUATED})
                progress.set_postfix_str(
                    f"SR {small['success_rate']:.1f} %, SPL {small['spl']:.1f} %, return {row['return']:.0f}"
                )
            progress.update(batch.numel())
            if done:
                break
            if stop.exit_code or time.perf_counter() - saved >= config.checkpoint_every:
                checkpoints.save(tally.frames)
                saved = time.perf_counter()
            if stop.exit_code:
                break
    seconds = run.seconds
    progress.close()
    collector.shutdown()

    # What is left behind: the policy that was best on the small set, its numbers on tasks that it never saw, pictures
    learner.actor.load_state_dict(best.weights or learner.actor.state_dict())
    td3.save_policy(folder / "policy.pt", policy)
    if run.rows:
        run.figure("training", plots.training_figure(run.rows))
    if stop.exit_code:
        run.close()
        print(
            f"\nStopped after {tally.frames} frames; the policy so far is {folder / 'policy.pt'}\n"
            f"To go on: --resume {folder}",
            file=sys.stderr,
        )
        raise SystemExit(stop.exit_code)
    rollout = td3.evaluation_rollout(final_env, policy)
    result = summarise(episode_measures(rollout)) | {"seed": config.seed, "tasks_seed": TEST_SEED}
    result |= {"frames": tally.frames, "episodes": tally.episodes, "updates": learner.updates}
    result |= {"training_seconds": seconds}
    result |= {"seconds_to_97_sr_88_spl": next((r["seconds"] for r in run.rows if passes_paper(r)), math.nan)}
    run.figure("trajectories", plots.trajectories_figure(rollout, base.field, base.region))
    run.result(result, navigator=name)
    run.close()
    checkpoints.clear()
    report(folder, result)
    return result


def step(optimiser: torch.optim.Optimizer, loss: torch.Tensor) -> None:
    """One gradient step."""
    loss.backward()
    optimiser.step()
    optimiser.zero_grad()


def passes_paper(row: dict[str, float]) -> bool:
    """Whether a row of curves reaches the paper's success rate and SPL."""
    return row["eval_success_rate"] >= 97 and row["eval_spl"] >= 88.4


def report(folder: Path, result: dict[str, float]) -> None:
    """Prints what a reader wants to know first."""
    print(
        f"\n{result['num_tasks']} unseen tasks: SR {result['success_rate']:.1f} %, SPL {result['spl']:.1f} %, "
        f"{result['steps']:.1f} steps, {result['trajectory_length_m'] / 1000:.0f} km, "
        f"ends {result['navigation_error_km']:.1f} km from the destination\n"
        f"trained for {result['training_seconds']:.0f} s; numbers, curves and pictures are in {folder}"
    )


def main(recipe: str, *, guided: bool) -> None:
    """The command: what cannot be run as asked is said in a line, without a traceback."""
    try:
        train(parse(recipe), guided=guided)
    except (ValueError, OSError, FloatingPointError) as error:
        sys.exit(f"{recipe}: {error}")


if __name__ == "__main__":
    main("td3_gradient_guided.py", guided=True)
