"""The run around a training loop: folder, lock, resume, signals, progress, curves, evaluation and best policy."""

from __future__ import annotations

import contextlib
import json
import math
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any, Self

from tensordict import TensorDictBase
from torch import nn
from torchrl import torchrl_logger
from torchrl.checkpoint import GlobalRNGState
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from magrl.checks import check_finite, library, short
from magrl.commands import UsageError
from magrl.envs import GeomagneticNavEnv, Scenario, Trips
from magrl.envs.measures import summarize
from magrl.errors import SensorErrors
from magrl.evaluation.episodes import episode_measures, episode_scores, evaluation_rollout
from magrl.files import locked, read_text, write_json
from magrl.navigators import Anywhere, FieldPolicy, save_policy
from magrl.random_numbers import TEST_SEED, VALIDATION_SEED
from magrl.sensor_std import PERFECT, Noise
from magrl.training.checkpoints import Checkpoints, RunningEpisodes, Stateful, create_run_folder
from magrl.training.collectors import LostCollectorError, RemoteCollector
from magrl.training.config import CHANGEABLE, WANDB_OPTIONS, RegionConfig, RunConfig
from magrl.training.curves import RETURN_TERMS, BestPolicy, RunLog, TrainingStatistics, training_figure
from magrl.training.wandb_run import WandbRun

EVALUATED = ("score", "success_rate", "spl", "steps", "navigation_error_km")
"""Measures of the validation trips in ``train.csv``, with the prefix ``eval_``; the policy is selected by the first."""
SHARED = ("guided", "task", "scenario", "zeta", "start_heading", "noise")
"""Settings that the file of the policy holds, for evaluations."""


class StopRequest:
    """Context that records Ctrl-C and SIGTERM until the loop can stop without losing work; a second one stops at once.

    Attributes:
        exit_code: exit status that the signal asks for, or None.

    Example:
        >>> with StopRequest() as stop:
        ...     stop.exit_code is None
        True
    """

    def __init__(self) -> None:
        self.exit_code: int | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():  # elsewhere signals cannot be handled
            self._before = {number: signal.signal(number, self._note) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, _: FrameType | None) -> None:
        if self.exit_code is not None:
            raise KeyboardInterrupt
        self.exit_code = 128 + number  # exit status that a shell reports for a process ended by a signal


class Run:
    """A training run, as a context manager around the loop of a recipe.

    ``with Run(config, ...) as run`` claims the folder, writes ``config.json`` and handles signals. :meth:`start` takes
    the parts of the training and restores them from the newest checkpoint, if there is one. :meth:`batches` iterates
    over collected batches; after each pass of the loop it checks for non-finite values, evaluates, logs and saves
    checkpoints. :meth:`finish` evaluates the best policy on the test trips and writes the results. If an error ends a
    new run before the first batch, its folder is removed.

    Args:
        config: settings of the run.
        recipe: file name of the recipe.
        name: label of the agent, and first part of the name of the default run folder; the name of a scenario file
            and the sensors' noise are added to it.
        losses: names of the losses and diagnostics that the loop puts into ``run.statistics.losses``.

    Raises:
        UsageError: on entry, for a folder that is in use, or a scenario that cannot be read.
    """

    def __init__(
        self, config: RunConfig, *, recipe: str, name: str, losses: tuple[str, ...] = ("loss_critic", "loss_actor")
    ) -> None:
        self._began = time.perf_counter()
        self.config, self.recipe, self.losses = config, recipe, losses
        self.scenario, self._file = Scenario(), None
        if isinstance(config, RegionConfig):
            self.scenario, self._file = config.load_scenario(), config.scenario
        self.noise: Noise = getattr(config, "noise", PERFECT.noise)
        self.name = f"{name}-{self._file.stem}" if self._file else name
        if any(self.noise):
            self.name += "-noise-" + "-".join(f"{level:g}" for level in self.noise)
        if config.resume:  # its scenario file has another name there
            self.name = json.loads(read_text(config.resume / "config.json")).get("name", self.name)
        self.statistics, self.best, self.stop = TrainingStatistics(), BestPolicy(), StopRequest()
        self.folder = config.out or Path("runs") / f"{self.name}-seed{config.seed}"
        self._exits = contextlib.ExitStack()
        self._scenario_env: EnvBase | None = None  # of the trips in the scenario file

    # Folder

    def __enter__(self) -> Self:
        torchrl_logger.setLevel("WARNING")
        if self.config.resume is None:
            create_run_folder(self.folder)
        with contextlib.ExitStack() as exits:
            exits.enter_context(locked(self.folder))
            if self.config.resume is None:
                exits.push(self._discard)
                if self._file:
                    shutil.copyfile(self._file, self.folder / self.settings["scenario"])
                write_json(self.folder / "config.json", self.settings)
            exits.enter_context(self.stop)
            self._exits = exits.pop_all()
        return self

    def __exit__(self, *error: Any) -> None:
        if self.statistics.frames and error[0] in (KeyboardInterrupt, LostCollectorError):
            if error[0] is LostCollectorError:  # between two batches
                self.checkpoints.save(self.statistics.frames)
            self._say_how_to_resume()
        self._exits.__exit__(*error)

    def _discard(self, kind: type[BaseException] | None, *_: object) -> None:
        """Remove the folder after an error before the first batch, so that the same command can be given again."""
        if kind is not None and not self.statistics.frames:
            shutil.rmtree(self.folder, ignore_errors=True)

    @property
    def settings(self) -> dict[str, Any]:
        """Settings as ``config.json`` holds them: no path of this machine, and the names of recipe and run."""
        settings = {"recipe": self.recipe, "name": self.name} | self.config.model_dump(mode="json")
        if self._file:
            settings["scenario"] = f"scenario{self._file.suffix}"
        return settings | {"out": self.folder.name, "resume": None}

    def evaluation_envs(self, make: Callable[..., EnvBase], **options: Any) -> tuple[EnvBase, EnvBase]:
        """Return the environments of the validation trips and of the test trips, with the sensor noise of the run.

        Args:
            make: function that makes an environment, as of a named task (:mod:`magrl.named_tasks`).
            options: its options.
        """

        def env_of(trips: Trips, seed: int) -> EnvBase:
            sensors = [SensorErrors(self.noise, seed=seed)] if any(self.noise) else []
            plain = {"observation": "dict", "scale_actions": False, "transforms": sensors, "seed": seed, **options}
            return make(len(trips.start), scenario=self.scenario.with_trips(trips), **plain)

        if self.scenario.trips is not None:
            self._scenario_env = env_of(self.scenario.trips, TEST_SEED)
        sets = (self.config.eval_trips_small, VALIDATION_SEED), (self.config.eval_trips, TEST_SEED)
        validation, test = (env_of(self.scenario.random_trips(count, seed), seed) for count, seed in sets)
        return validation, test

    # Parts

    def state_dict(self) -> dict[str, Any]:
        """Return the settings of the training, and the text of its scenario file."""
        state = {name: value for name, value in self.settings.items() if name not in CHANGEABLE}
        return state | ({"scenario": read_text(self.folder / state["scenario"])} if self._file else {})

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Raise a ValueError unless these are the settings of this training."""
        for name, value in self.state_dict().items():
            if value != state_dict.get(name):
                values = f"{short(value)} in the run folder, {short(state_dict.get(name))} in the checkpoint"
                raise ValueError(f"{name} is {values}: only {', '.join(CHANGEABLE)} may be edited")

    def start(
        self,
        *,
        policy: FieldPolicy | Anywhere,
        validation: EnvBase,
        env: GeomagneticNavEnv,
        collector: Collector | RemoteCollector,
        **parts: Stateful,
    ) -> None:
        """Take the parts of the training, and restore them from the newest checkpoint of a run that is resumed.

        Args:
            policy: agent for evaluations, which is saved.
            validation: environment of the validation trips.
            env: environment inside the collector, or like those of its actors.
            collector: source of batches.
            parts: everything else that checkpoints must hold, such as loss, optimizers and replay buffer.

        Raises:
            UsageError: if no checkpoint can be read, or it is of other settings.
            ValueError: for a policy that could not be saved.
        """
        self.policy, self.validation, self.env, self.collector = policy, validation, env, collector
        self._network = policy.actor if isinstance(policy, FieldPolicy) else policy
        if isinstance(policy, FieldPolicy):
            policy.check_actor()
            policy.training = {name: value for name, value in self.settings.items() if name in SHARED}
        self.statistics.first_cohort = env.num_envs * env.max_steps
        self._modules = {name: part for name, part in parts.items() if isinstance(part, nn.Module)}
        parts = {"configuration": self, **parts}  # restored first
        parts |= {"statistics": self.statistics, "best": self.best, "random": GlobalRNGState()}
        if isinstance(collector, Collector):
            parts["episodes"] = RunningEpisodes(collector, env)
        self._exits.callback(collector.shutdown)
        self.checkpoints = Checkpoints(self.folder / "checkpoints", parts)
        resumed = bool(self.config.resume and self.checkpoints.files())  # otherwise it starts again from its seed
        self.log = self._make_log(resumed)
        self.checkpoints.parts["run"] = self.log
        if resumed:
            try:
                self.checkpoints.load(env.device or "cpu")
            except (ValueError, FileNotFoundError) as error:
                raise UsageError(f"cannot resume: {error}") from error
        self._exits.callback(self.log.close)

    def _make_log(self, resumed: bool) -> RunLog:
        terms = ("return", *(f"return_{term}" for term in RETURN_TERMS))
        columns = ("frames", "episodes", "updates", "seconds", *terms, "success_rate", "episode_steps", *self.losses)
        columns += tuple(f"eval_{key}" for key in EVALUATED)
        entity, group, tags = (getattr(self.config, name) for name in WANDB_OPTIONS)
        opened = self.folder, self.config.wandb_mode, self.settings
        group = group or os.environ.get("WANDB_RUN_GROUP", self.name)
        labeled = partial(WandbRun, *opened, group=group, tags=(self.name, *tags), entity=entity)
        return RunLog(self.folder, columns, labeled, resumed=resumed, began=self._began)

    @property
    def remaining(self) -> float:
        """Remaining share of the training, from 1 to 0."""
        return max(0.0, 1 - self.statistics.frames / self.config.total_frames)

    # Loop

    def batches(self) -> Iterator[TensorDictBase]:
        """Yield collected batches until the training is complete or a signal asks to stop.

        Yields:
            Transitions as the collector returns them.

        Raises:
            FloatingPointError: at a non-finite value in a batch, a loss or a weight, naming it.
        """
        saved = time.perf_counter()
        counted = "episodes" if self.config.total_episodes else "frames"
        bar = {"total": getattr(self.config, f"total_{counted}"), "initial": getattr(self.statistics, counted)}
        tqdm = library("tqdm", "recipes").tqdm
        with tqdm(**bar, unit=counted[:-1], desc=self.name, mininterval=0.5, unit_scale=True) as progress:
            for batch in self.collector:
                check_finite(batch.exclude("track", ("next", "track")), f"after {self.statistics.frames} frames")
                self.statistics.add(batch.reshape(-1))
                yield batch
                self._check_weights()
                if self.complete or self.statistics.iterations % self.config.eval_every == 0:
                    progress.set_postfix_str(self._evaluate())
                elif self.statistics.iterations % self.config.log_every == 0:
                    self.log.row(self.statistics.row() | {"seconds": self.log.seconds})
                progress.update(getattr(self.statistics, counted) - progress.n)
                stopped = self.stop.exit_code is not None
                if not self.complete and (stopped or time.perf_counter() - saved >= self.config.checkpoint_every):
                    self.checkpoints.save(self.statistics.frames)
                    saved = time.perf_counter()
                if self.complete or stopped:
                    break

    @property
    def complete(self) -> bool:
        """Whether all frames or all episodes have been collected."""
        limit = self.config.total_episodes or math.inf
        return self.statistics.frames >= self.config.total_frames or self.statistics.episodes >= limit

    def _check_weights(self) -> None:
        where = f"after update {self.statistics.updates}"
        check_finite(self.statistics.losses.items(), where)
        for module in self._modules.values():
            check_finite(module.named_parameters(), where)

    def _evaluate(self) -> str:
        """Evaluate on the validation trips, keep the best policy, add a row of curves; return a short report."""
        summary = _summary(evaluation_rollout(self.validation, self.policy))
        self.best.offer(summary["score"], self._network)
        row = self.statistics.row() | {"seconds": self.log.seconds}
        self.log.row(row | {f"eval_{key}": summary[key] for key in EVALUATED})
        return f"score {summary['score']:.1f} %, SR {summary['success_rate']:.1f} %, SPL {summary['spl']:.1f} %"

    # Results

    def finish(self, test: EnvBase) -> dict[str, float]:
        """Save the best policy, evaluate it on the test trips and write figures and results.

        Args:
            test: environment of the test trips.

        Returns:
            The content of ``eval.json``.

        Raises:
            SystemExit: after a signal, with its exit code; the policy so far is saved.
        """
        from magrl.evaluation import maps  # matplotlib is slow to import

        seconds = self.log.seconds
        self._network.load_state_dict(self.best.weights or self._network.state_dict())
        save_policy(self.folder / "policy.safetensors", self.policy)
        if self.log.rows:
            self.log.figure("training", training_figure(self.log.rows))
        if not self.complete:
            self._report_stop()
        rollout = evaluation_rollout(test, self.policy)
        result = _summary(rollout) | {"seed": self.config.seed, "trips_seed": TEST_SEED}
        result |= {key: getattr(self.statistics, key) for key in ("frames", "episodes", "updates")}
        result["training_seconds"] = seconds
        if len(test.region) == 1:
            shown = rollout if self._scenario_env is None else evaluation_rollout(self._scenario_env, self.policy)
            figure = maps.trajectories_figure(shown, test.field, test.region, names=self.scenario.names)
            self.log.figure("trajectories", figure)
        self.log.result(result)
        self.checkpoints.clear()
        self._report(result)
        return result

    def _report_stop(self) -> None:
        print(
            f"\nStopped after {self.statistics.frames} frames; "
            f"the policy so far is {self.folder / 'policy.safetensors'}",
            file=sys.stderr,
        )
        self._say_how_to_resume()
        raise SystemExit(self.stop.exit_code)

    def _say_how_to_resume(self) -> None:
        print(f"To resume: --resume {self.folder}", file=sys.stderr)

    def _report(self, result: dict[str, float]) -> None:
        arrived = "no episode arrived"
        if result["success_rate"]:
            kilometers = result["trajectory_length_m"] / 1000
            arrived = f"{result['steps']:.1f} steps, {kilometers:.0f} km"
            arrived += f", navigation error {result['navigation_error_km']:.1f} km"
        print(
            f"\n{result['num_trips']} test trips: success rate {result['success_rate']:.1f} %, "
            f"SPL {result['spl']:.1f} %, {arrived}\n"
            f"Trained in {result['training_seconds']:.0f} s; results, curves and figures are in {self.folder}"
        )
        if not result["updates"]:
            print(
                f"Warning: no gradient step was made in {result['frames']} frames, so the policy is untrained: "
                "increase total_frames (and total_episodes), or reduce batch_size",
                file=sys.stderr,
            )


def _summary(rollout: TensorDictBase) -> dict[str, float]:
    return {"score": episode_scores(rollout).mean().item()} | summarize(episode_measures(rollout))
