"""Train algorithms with several seeds, score each agent on a named task, and draw the learning curves.

    python recipes/sweep.py td3_gradient_guided.py --seeds 0 1 2 3 4 --jobs 2 -- --task eddies
    python recipes/sweep.py td3_gradient_guided.py --command mine='python mine.py' -- --task box

An algorithm is a command that takes --task, --seed and --out, and leaves policy.safetensors or policy.onnx in the
folder --out. Columns `frames` and `eval_score` [%] of a file train.csv there are its learning curve. What follows -- is
given to each command. Commands have one thread each, and WANDB_RUN_GROUP is the name of the sweep.

The same command resumes a sweep: runs that have ended are not repeated, and those of magrl.training.Run go on from
their checkpoints. Prints a row for each seed, and interquartile means with 95 % intervals over seeds. Writes table.md,
curves.png, scores.csv.gz, with a row for each episode of magrl.score, and a log of each run.
"""

from __future__ import annotations

import ctypes
import itertools
import os
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from magrl.evaluation.episodes import episode_measures, episode_scores
from magrl.evaluation.scores import flown
from magrl.evaluation.tables import markdown_table, mean_of_runs
from magrl.evaluation.tracks import write_episodes
from magrl.files import check_writable, locked, read_document, write_text, write_with
from magrl.jobs import Backend, mapped
from magrl.named_tasks import task_name
from magrl.navigators.names import policy_file
from magrl.training import UsageError, command, parse
from magrl.training.curves import draw_seeds

from matplotlib.figure import Figure
from pandas import DataFrame, concat, read_csv
from tensordict import TensorDictBase
from tyro.conf import Positional, UseAppendAction

RECIPE, EPISODES = "sweep.py", 1000


@dataclass(frozen=True)
class Config:
    """Settings of a sweep."""

    recipe: Positional[str] = ""
    """Recipe in the folder of this one; a file elsewhere is a command."""
    command: UseAppendAction[tuple[str, ...]] = ()
    """Algorithm NAME='COMMAND', any number of times; `python` is the interpreter of the sweep."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds of the trainings."""
    jobs: int = 1
    """Trainings at a time, with one thread each."""
    backend: Backend = "loky"
    """Where they run: loky on this machine, ray on a cluster with a common folder."""
    address: str | None = None
    """Address of the cluster, auto or HOST:PORT; by default Ray starts one on this machine."""
    out: Path | None = None
    """Folder of the sweep, whose name is the group in wandb; runs/sweep-TASK by default."""


class Job(NamedTuple):
    """A training: task, name of the agent, seed, command without its last three options, and absolute run folder."""

    task: str
    agent: str
    seed: int
    line: str
    folder: Path

    @classmethod
    def of(cls, out: Path, task: str, agent: str, seed: int, line: str) -> Job:
        """Return a job of a sweep in a folder."""
        return cls(task, agent, seed, line, out.resolve() / f"{task}-{agent}-seed{seed}")

    def rows(self, columns: Any) -> DataFrame:
        """Return columns after task, agent and seed."""
        return DataFrame({"task": self.task, "agent": self.agent, "seed": self.seed, **columns})


def train(job: Job) -> None:
    """Run the command of a job, or resume its run, unless that is complete.

    Raises:
        UsageError: with the last line of its log, if it fails.
    """
    words, config = shlex.split(job.line), job.folder / "config.json"
    if resumes := config.is_file() and "recipe" in read_document(config):
        if (job.folder / "eval.json").is_file():
            return
        words = [*itertools.takewhile(lambda word: word[0] != "-", words), "--resume", str(job.folder)]
    else:
        shutil.rmtree(job.folder, ignore_errors=True)
        words += ["--task", job.task, "--seed", str(job.seed), "--out", str(job.folder)]
    words[0] = sys.executable if words[0] == "python" else words[0]
    own = ["env", "OMP_NUM_THREADS=1", "PYTHONUNBUFFERED=1", f"WANDB_RUN_GROUP={job.folder.parent.name}"]
    path = Path(f"{job.folder}.log")
    with path.open("ab" if resumes else "wb", buffering=0) as log:
        log.write(f"{job.line}\n".encode())
        began = os.times().children_user
        status = subprocess.call([*own, *words], stdout=log, stderr=log, preexec_fn=_end_with_parent)
        log.write(b"" if status else f"CPU time {os.times().children_user - began:.1f} s\n".encode())
    if status:
        *_, last = (text for line in path.read_text("utf-8", "replace").splitlines() if (text := line.strip(" │╰─╯╭╮")))
        raise UsageError(f"{job.folder.name}: {job.line!r} ended with status {status}: {last} (all in {path})")


def _end_with_parent() -> None:
    ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # PR_SET_PDEATHSIG


def run(job: Job) -> DataFrame:
    """Train and score a job, unless its scores exist; return its episodes.

    Raises:
        UsageError: for a command that fails or leaves no policy, or a folder of another command.
    """
    scores, log = Path(f"{job.folder}.csv.gz"), Path(f"{job.folder}.log")
    if scores.exists() or (job.folder / "config.json").exists():
        line, *_ = log.read_text("utf-8", "replace").splitlines()
        if line != job.line:
            raise UsageError(f"{job.folder} is of {line!r}, not of {job.line!r}: choose another --out")
    if not scores.exists():
        train(job)
        if not policy_file(job.folder).is_file():
            left = f"left no policy.safetensors or policy.onnx in {job.folder}: save one there"
            raise UsageError(f"{job.folder.name}: {job.line!r} {left}")
        write_episodes(scores, [job.rows(episodes_of(flown(job.folder, job.task, episodes=EPISODES)))])
    return read_csv(scores)


def episodes_of(rollout: TensorDictBase) -> DataFrame:
    """Return number, score [%], success, SPL and steps of each episode of a rollout."""
    measures = episode_measures(rollout)
    columns = {"score": episode_scores(rollout), "success": measures["success"].int(), "SPL": measures["spl"]}
    return DataFrame({"episode": range(len(rollout)), **columns, "steps": measures["steps"]})


def sweep(runs: Sequence[Job], **options: Any) -> DataFrame:
    """Train and score the jobs of a sweep, write their episodes to scores.csv.gz, and return them.

    Args:
        runs: the jobs.
        options: of :func:`magrl.jobs.mapped`.
    """
    path = runs[0].folder.with_name("scores.csv.gz")
    check_writable(path)
    with locked(path.parent):
        episodes = list(mapped(run, runs, unit="run", **options))
        write_episodes(path, episodes)
    return concat(episodes)


def curves(jobs: Sequence[Job]) -> DataFrame:
    """Return the points of learning curves: the evaluations in the train.csv of each job."""
    names = ["frames", "eval_score", "eval_success_rate", "eval_spl"]
    paths = {job: path for job in jobs if (path := job.folder / "train.csv").is_file()}
    known = [job.rows(read_csv(path).reindex(columns=names)) for job, path in paths.items()]
    return concat(known).dropna(subset=names[:2]) if known else DataFrame(columns=["agent"])


def table(episodes: DataFrame) -> str:
    """Return the Markdown table of a sweep: a row for each seed, and interquartile means with intervals over seeds."""
    labels = {"score": "score %", "success": "SR %", "SPL": "SPL %", "steps": "steps"}
    runs = episodes.groupby(["agent", "seed"], sort=False)[list(labels)].mean()
    runs[["success", "SPL"]] *= 100
    rows = []
    for agent, seeds in runs.groupby("agent", sort=False):
        rows += [[agent, seed, *(f"{x:.1f}" for x in values)] for (_, seed), *values in seeds.itertuples()]
        rows.append([agent, "IQM", *(mean_of_runs(seeds[name], form=".1f", least=2) for name in labels)])
    return markdown_table(["agent", "seed", *labels.values()], rows)


def figure(points: DataFrame) -> Figure:
    """Return the learning curves of the agents."""
    drawn = Figure(figsize=(6, 4), layout="constrained")
    axes = drawn.subplots()
    for number, (agent, runs) in enumerate(points.groupby("agent", sort=False)):
        draw_seeds(axes, runs, "frames", "eval_score", color=f"C{number}", label=agent)
    axes.set(xlabel="frames (vehicle-steps)", ylabel="score [%]", ylim=(0, 102))
    drawn.legend(loc="outside lower center", ncols=3)
    return drawn


def named_commands(texts: Sequence[str]) -> dict[str, str]:
    """Return commands by name, from NAME=COMMAND."""
    found = {name: line.strip() for name, _, line in (text.partition("=") for text in texts)}
    if len(found) < len(texts) or not all(name and line and "/" not in name for name, line in found.items()):
        raise UsageError(f"--command takes NAME='COMMAND', each with a name of its own, got {' and '.join(texts)}")
    return found


def planned(config: Config, options: Sequence[str]) -> list[Job]:
    """Return the jobs of a sweep whose commands are given some options, in the order of their seeds."""
    if "--task" not in options[:-1]:
        raise UsageError("name the task after --, as in: -- --task box")
    place, lines = options.index("--task"), named_commands(config.command)
    task, others = task_name(options[place + 1]), shlex.join([*options[:place], *options[place + 2 :]])
    if config.recipe:
        if not (path := Path(__file__).parent / config.recipe).is_file():
            raise UsageError(f"there is no recipe {path}: give another program by --command")
        lines = {path.stem: shlex.join(["python", str(path)]), **lines}
    out = config.out or Path("runs") / f"sweep-{task}"
    pairs = itertools.product(dict.fromkeys(config.seeds), lines.items())
    return [Job.of(out, task, agent, seed, f"{line} {others}".strip()) for seed, (agent, line) in pairs]


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line, train what is missing, and write table, curves and scores."""
    words = [*(sys.argv[1:] if args is None else args), "--"]
    end = words.index("--")
    config = parse(Config, RECIPE, __doc__, words[:end])
    if not (jobs := planned(config, words[end + 1 : -1])):
        raise UsageError("name a recipe, a --command or both, and at least one of the --seeds")
    shown = table(sweep(jobs, jobs=config.jobs, backend=config.backend, address=config.address))
    out = jobs[0].folder.parent
    write_text(out / "table.md", shown + "\n")
    if len(points := curves(jobs)):
        write_with(out / "curves.png", figure(points).savefig, dpi=120)
    print(shown, f"Table, curves, scores and logs are in {out}", sep="\n\n")


if __name__ == "__main__":
    command(RECIPE, main, ValueError, ImportError)
