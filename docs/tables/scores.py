"""Learning curves on the named tasks: algorithms of stable-baselines3, the recipes of this library, and your own.

    pip install -c constraints.txt -e '.[bench]'
    python docs/tables/scores.py                                     # everything: about six hours on two cores
    python docs/tables/scores.py --tasks box --algorithms PPO --seeds 0
    python docs/tables/scores.py --tasks box --algorithms --command mine='python mine.py'    # as of recipes/sweep.py
    python docs/tables/scores.py --no-train                          # table and figure of docs/results/scores.csv

algorithms.toml has the command of each algorithm for each task, which recipes/sweep.py runs, scores and resumes. The
rows of a run replace those of the same task, algorithm and seed in docs/results/scores.csv. The agent of the run with
the median score is kept in docs/results/agents, for agents.py.
"""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from agents import keep_agents
from bars import BARS, bar, bars_of
from flights import write_picture
from magrl.checks import check_choice
from magrl.evaluation.tables import markdown_table, mean_of_runs
from magrl.files import check_writable, read_document, write_text, write_with
from magrl.jobs import Backend
from magrl.named_tasks import NAMED_TASKS, task_name
from magrl.training import UsageError, command
from magrl.training.curves import draw_seeds

import tyro
from matplotlib.figure import Figure
from pandas import DataFrame, Series, concat, read_csv

sys.path.insert(0, str(Path(__file__).parents[2] / "recipes"))
from sweep import Job, curves, named_commands, sweep

ALGORITHMS = read_document(Path(__file__).with_name("algorithms.toml"))
RUN = ["task", "algorithm", "seed"]
MEASURES = {"score": "eval_score", "SR": "eval_success_rate", "SPL": "eval_spl"}
"""Measures [%], and their columns of learning curves."""
COLUMNS = [*RUN, "steps", "cpu_s", *MEASURES]
OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
COLORS = dict(zip(ALGORITHMS, OKABE_ITO, strict=False))
"""Colors of algorithms."""
STYLES = {"secant": ":", "kalman": "--", "anywhere": "-.", "memory": (0, (1, 4)), "geodesic": "-", "told": (0, (8, 2))}
STYLES |= {"around": (0, (5, 5)), "sighted": (0, (8, 2)), "detour": "-", "parallel": (0, (1, 4))}
STYLES |= {"offset": (0, (5, 5)), "estimated": (0, (8, 2)), "mapped": (0, (3, 1, 1, 1, 1, 1))}
"""Lines of references, each with one style in all panels."""


@dataclass(frozen=True)
class Config:
    """What to train, and where."""

    tasks: tuple[str, ...] = tuple(NAMED_TASKS)
    """Named tasks."""
    algorithms: tuple[str, ...] = tuple(ALGORITHMS)
    """Algorithms of algorithms.toml; each is trained on its own tasks among these."""
    command: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Algorithm of your own NAME='COMMAND', any number of times, for all these tasks."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds of weights, exploration and training tasks."""
    jobs: int = 2
    """Runs at a time, with one thread each."""
    backend: Backend = "loky"
    """Where they run: loky on this machine, ray on a cluster with a common folder."""
    address: str | None = None
    """Address of the cluster."""
    train: bool = True
    """Whether to train what is missing."""
    out: Path = Path("runs/scores")
    """Folder of the runs."""
    results: Path = Path("docs/results")
    """Folder of table, data and figure."""


def planned(config: Config) -> list[Job]:
    """Return all runs, in the order of their seeds."""
    known = {name: ALGORITHMS[name]["tasks"] for name in config.algorithms}
    lines = {(task, name): known[name][task] for name in known for task in config.tasks if task in known[name]}
    lines = {(task, name): f"{ALGORITHMS[name]['command']} {more}".strip() for (task, name), more in lines.items()}
    lines |= {(task, name): line for name, line in named_commands(config.command).items() for task in config.tasks}
    pairs = itertools.product(config.seeds, lines.items())
    return [Job.of(config.out, task, name, seed, line) for seed, ((task, name), line) in pairs]


def rows_of(job: Job, episodes: DataFrame) -> DataFrame:
    """Return the rows of a run: its learning curve, and its score as the last point."""
    points = curves([job]).rename(columns={"frames": "steps", **{there: here for here, there in MEASURES.items()}})
    mean = episodes[["score", "success", "SPL"]].mean()
    last = {"steps": points["steps"].max() if len(points) else math.nan, "cpu_s": cpu_s(job)}
    last |= {"score": mean["score"], "SR": 100 * mean["success"], "SPL": 100 * mean["SPL"]}
    rows = concat([points, DataFrame([last])]).assign(task=job.task, algorithm=job.agent, seed=job.seed)
    return rows.reindex(columns=COLUMNS).round(2)


def cpu_s(job: Job) -> float:
    """Return the CPU time of the command of a run [s]; NaN if it was resumed."""
    lines = Path(f"{job.folder}.log").read_text("utf-8", "replace").splitlines()
    return float(lines[-1].split()[2]) if lines.count(job.line) == 1 else math.nan


def results(config: Config) -> DataFrame:
    """Return the rows of all runs, known or trained now."""
    path, jobs = config.results / "scores.csv", planned(config)
    check_writable(path)
    known = read_csv(path) if path.exists() else DataFrame(columns=COLUMNS)
    if config.train and jobs:
        found = sweep(jobs, jobs=config.jobs, backend=config.backend, address=config.address)
        by_run = found.groupby(["task", "agent", "seed"])
        new = concat([rows_of(job, by_run.get_group(job[:3])) for job in jobs])
        known = concat([known[~known.set_index(RUN).index.isin(new.set_index(RUN).index)], new])
        write_with(path, known.to_csv, index=False)
        known = read_csv(path)
    if known.empty:
        raise UsageError(f"{path} has no runs, and none of the algorithms {config.algorithms} is trained now")
    return known


def ends(curves: DataFrame) -> Iterator[tuple[tuple[str, str], DataFrame]]:
    """Yield task and algorithm, and the last points of their runs."""
    last = curves.groupby(["task", "algorithm", "seed"], sort=False).last().reset_index()
    yield from last.groupby(["task", "algorithm"], sort=False)


def table(curves: DataFrame) -> str:
    """Return the Markdown table of final scores, interquartile means with intervals over seeds, and of the bars."""
    rows = []
    for (task, name), runs in ends(curves):
        about = f"{len(runs)} × {runs['steps'].max() / 1000:.0f} k", f"{runs['cpu_s'].median() / 60:.1f} min"
        about = [text.replace("nan min", "—").replace("nan", "—") for text in about]
        rows.append([task, name, *about, *(mean_of_runs(runs[key], form=".1f", least=2) for key in MEASURES)])
    for task in curves["task"].unique():
        for name in bars_of(task):
            scores = bar(task, name)
            rows.append([task, BARS[name], "—", "—", *(f"{scores[key]:.1f}" for key in MEASURES)])
    rows.sort(key=lambda row: list(NAMED_TASKS).index(row[0]))
    return markdown_table(["task", "agent", "seeds × steps", "CPU", *(f"{key} %" for key in MEASURES)], rows)


def figure(curves: DataFrame) -> Figure:
    """Return scores over steps and over CPU time: medians over seeds, bands from the least to the highest, and bars.

    The last point of a run, its score, is left out: it is of other episodes.
    """
    tasks = [task for task in NAMED_TASKS if task in set(curves["task"])]
    drawn = Figure(figsize=(12, 3.6 * math.ceil(len(tasks) / 2)), layout="constrained")
    for part, task in zip(drawn.subfigures(math.ceil(len(tasks) / 2), 2, squeeze=False).flat, tasks, strict=False):
        both = part.subplots(1, 2, sharey=True)
        for name, runs in curves[curves["task"] == task].groupby("algorithm", sort=False):
            points = runs.assign(cpu=cpu_minutes(runs))
            points = points[points.duplicated("seed", keep="last")]
            for axes, along in zip(both, ("steps", "cpu"), strict=True):
                draw_seeds(axes, points, along, "score", color=COLORS.get(name, "black"), label=name)
        for name in bars_of(task)[::-1]:  # oracle first
            look = {"color": "gray", "ls": STYLES[name], "lw": 1, "label": BARS[name].partition(" (")[0]}
            for axes in both:
                axes.axhline(bar(task, name)["score"], **look)
        for axes, text in zip(both, ("steps", "CPU time [min]"), strict=True):
            axes.set(xscale="log", xlabel=text, ylim=(0, 102))
        both[0].set_ylabel("score [%]")
        part.suptitle(task)
        part.legend(*both[0].get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=3)
    return drawn


def cpu_minutes(runs: DataFrame) -> Series:
    """Return the CPU time of each point [min]; of a recipe, which states the whole, in proportion to its steps."""
    last = runs.groupby("seed")[["steps", "cpu_s"]].transform("last")
    return (runs["cpu_s"].fillna(last["cpu_s"] * runs["steps"] / last["steps"]) / 60).clip(lower=0.01)


def main(args: Sequence[str] | None = None) -> None:
    """Train what is missing, and write table, data and figure."""
    config = tyro.cli(Config, description=__doc__, args=args)
    config = replace(config, tasks=tuple(map(task_name, config.tasks)))
    for name in config.algorithms:
        check_choice(ALGORITHMS, algorithm=name)
    curves = results(config)
    write_text(config.results / "scores.md", table(curves))
    keep_agents(ends(curves), config.out, config.results / "agents")
    write_picture(config.results / "scores.png", figure(curves), config.results / "scores.csv", dpi=130)


if __name__ == "__main__":
    command("scores.py", main, ValueError)
