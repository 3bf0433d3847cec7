"""Learning curves on the named tasks: algorithms of stable-baselines3, the recipes of this library, and your own.

    pip install -c constraints.txt -e '.[bench]'
    python docs/tables/scores.py                                     # everything: some hours on two cores
    python docs/tables/scores.py --tasks box --algorithms PPO --seeds 0
    python docs/tables/scores.py --tasks box --algorithms --command mine='python mine.py'    # as of recipes/sweep.py
    python docs/tables/scores.py --no-train                          # tables and figure of what is known

algorithms.toml has the command of each algorithm for each task, which recipes/sweep.py runs, scores and resumes. The
rows of a run replace those of the same task, algorithm and seed in docs/results/scores.csv, the learning curves, and
scores.csv.gz, all episodes, with those of references, which are flown if they are missing. The agent of the run with
the median score is shipped with magrl, by the name TASK-ALGORITHM.
"""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from agents import keep_agents
from bars import BARS, bars_of, flown
from flights import write_picture
from magrl.checks import check_choice
from magrl.evaluation.tables import interquartile_mean, markdown_table
from magrl.evaluation.tracks import write_episodes
from magrl.files import check_writable, read_document, write_text, write_with
from magrl.jobs import Backend
from magrl.named_tasks import NAMED_TASKS, task_name
from magrl.training import UsageError, command
from magrl.training.curves import draw_seeds

import numpy as np
import torch
import tyro
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from pandas import DataFrame, Series, concat, read_csv

sys.path.insert(0, str(Path(__file__).parents[2] / "recipes"))
from sweep import Job, curves, episodes_of, named_commands, sweep

ALGORITHMS = read_document(Path(__file__).with_name("algorithms.toml"))
RUN = ["task", "algorithm", "seed"]
MEASURES = {"eval_score": "score", "eval_success_rate": "SR", "eval_spl": "SPL"}
"""Measures [%], and their columns of learning curves."""
COLUMNS = [*RUN, "steps", "cpu_s", "score", "SR", "SPL"]
HEADS = ["task", "agent", "seeds × steps", "CPU", "score %", "less the best reference", "SR %", "SPL %", "steps"]
"""Columns of the learning curves, and of the table."""
DRAWS = 2000
"""Bootstrap samples of an interval."""
OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
COLORS = dict(zip(ALGORITHMS, OKABE_ITO, strict=False))
"""Colors of algorithms."""
LEVELS = {"strongest reference": "--", "oracle": ":"}
"""Levels in each panel, and their lines."""
SOURCE = "python docs/tables/scores.py --no-train"
"""Command that draws the figure."""


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
    agents: Path = Path("magrl/navigators/pretrained")
    """Folder of the agents."""


def planned(config: Config) -> list[Job]:
    """Return all runs, in the order of their seeds."""
    known = {name: ALGORITHMS[name]["tasks"] for name in config.algorithms}
    lines = {(task, name): known[name][task] for name in known for task in config.tasks if task in known[name]}
    lines = {(task, name): f"{ALGORITHMS[name]['command']} {more}".strip() for (task, name), more in lines.items()}
    lines |= {(task, name): line for name, line in named_commands(config.command).items() for task in config.tasks}
    pairs = itertools.product(config.seeds, lines.items())
    return [Job.of(config.out, task, name, seed, line) for seed, ((task, name), line) in pairs]


def points_of(job: Job) -> DataFrame:
    """Return the learning curve of a run; the last point has its CPU time."""
    points = curves([job]).rename(columns={"agent": "algorithm", "frames": "steps", **MEASURES})
    last = DataFrame([{"task": job.task, "algorithm": job.agent, "seed": job.seed, "cpu_s": cpu_s(job)}])
    last["steps"] = points["steps"].max() if len(points) else math.nan
    return concat([points, last]).reindex(columns=COLUMNS).round(2)


def cpu_s(job: Job) -> float:
    """Return the CPU time of the command of a run [s]; NaN if it was resumed."""
    lines = Path(f"{job.folder}.log").read_text("utf-8", "replace").splitlines()
    return float(lines[-1].split()[2]) if lines.count(job.line) == 1 else math.nan


def results(config: Config) -> tuple[DataFrame, DataFrame]:
    """Return learning curves and episodes of all runs, known or trained now, and the episodes of the references."""
    paths, jobs = [config.results / name for name in ("scores.csv", "scores.csv.gz")], planned(config)
    for path in paths:
        check_writable(path)
    points, episodes = (read_csv(path) if path.exists() else DataFrame(columns=RUN) for path in paths)
    if config.train and jobs:
        found = sweep(jobs, jobs=config.jobs, backend=config.backend, address=config.address)
        episodes = replaced(episodes, found.rename(columns={"agent": "algorithm"}))
        points = replaced(points, concat(map(points_of, jobs)))
    if points.empty:
        raise UsageError(f"{paths[0]} has no runs, and none of the algorithms {config.algorithms} is trained now")
    known = set(episodes[RUN[:2]].itertuples(index=False, name=None))
    pairs = [(task, name) for task in points["task"].unique() for name in bars_of(task) if (task, name) not in known]
    new = [episodes_of(flown(*pair)[1]).assign(task=pair[0], algorithm=pair[1], seed=0) for pair in pairs]
    episodes = concat([episodes, *new])
    write_with(paths[0], points.to_csv, index=False)
    write_episodes(paths[1], [episodes])
    return points, episodes


def replaced(known: DataFrame, new: DataFrame) -> DataFrame:
    """Return rows, of which those of new runs replace the known ones."""
    return concat([known[~known.set_index(RUN).index.isin(new.set_index(RUN).index)], new])


def ends(points: DataFrame) -> Iterator[tuple[tuple[str, str], DataFrame]]:
    """Yield task and algorithm, and the last points of their runs."""
    last = points.groupby(RUN, sort=False).last().reset_index()
    yield from last.groupby(RUN[:2], sort=False)


def cells(runs: DataFrame, column: str) -> np.ndarray:
    """Return a column of episodes ``(S, E)``, by seed and number."""
    return runs.pivot(index="seed", columns="episode", values=column).to_numpy()


def interval(values: np.ndarray) -> tuple[float, float]:
    """Return a 95 % bootstrap interval of the interquartile mean over seeds, of episodes ``(S, E)`` that they share.

    Seeds and episodes are drawn anew.
    """
    draw, (seeds, count) = np.random.default_rng(0), values.shape
    means = values @ draw.multinomial(count, np.full(count, 1 / count), size=DRAWS).T / count  # (S, DRAWS)
    drawn = np.take_along_axis(means, draw.integers(seeds, size=(seeds, DRAWS)), 0)
    low, high = np.quantile([interquartile_mean(torch.from_numpy(column)) for column in drawn.T], (0.025, 0.975))
    return float(low), float(high)


def middle(values: np.ndarray) -> float:
    """Return the interquartile mean over seeds of episodes ``(S, E)``."""
    return interquartile_mean(torch.from_numpy(values.mean(1))).item()


def spread(values: np.ndarray, form: str = ".1f") -> str:
    """Return the interquartile mean of episodes and its interval."""
    low, high = interval(values)
    return f"{middle(values):{form}} ({low:{form}} to {high:{form}})"


def table(points: DataFrame, episodes: DataFrame) -> str:
    """Return the Markdown table of scores, with references: interquartile means over seeds, intervals over both."""
    known, rows = dict(ends(points)), []
    for task, name in sorted(set(episodes[RUN[:2]].itertuples(index=False, name=None)), key=place_of(episodes)):
        flights = episodes[episodes["task"] == task]
        runs, last = flights[flights["algorithm"] == name], known.get((task, name))
        about = ["—", "—", "—"]
        if last is not None:
            steps = f"{len(last)} × {last['steps'].max() / 1000:.0f} k"
            about = [steps, f"{last['cpu_s'].median() / 60:.1f} min", behind(flights, name)]
        means = middle(100 * cells(runs, "success")), middle(100 * cells(runs, "SPL")), middle(cells(runs, "steps"))
        label = name if last is not None else BARS[name]
        rows.append([task, label, *about[:2], spread(cells(runs, "score")), about[2], *(f"{x:.1f}" for x in means)])
    return markdown_table(HEADS, rows)


def behind(flights: DataFrame, name: str) -> str:
    """Return the score of an agent less that of the strongest reference but oracles, episode by episode."""
    scores = {one: cells(runs, "score") for one, runs in flights.groupby("algorithm", sort=False)}
    rules = [rule for rule in scores if rule in BARS and "oracle" not in BARS[rule]]
    if not rules:
        return "—"
    best = scores[max(rules, key=lambda rule: scores[rule].mean())]
    return spread(scores[name] - best, "+.1f")


def place_of(episodes: DataFrame) -> Callable[[tuple[str, str]], tuple[int, int]]:
    """Return the order of the rows of a table: tasks, in them algorithms, then references."""
    names = [*ALGORITHMS, *(name for name in episodes["algorithm"].unique() if name not in BARS), *BARS]
    return lambda pair: (list(NAMED_TASKS).index(pair[0]), names.index(pair[1]))


def figure(curves: DataFrame, episodes: DataFrame) -> Figure:
    """Return scores over steps and over CPU time: medians over seeds, bands from the least to the highest, and the
    levels of the strongest reference and of the oracle.

    The last point of a run, its score, is left out: it is of other episodes.
    """
    points = curves.assign(cpu=cpu_minutes(curves))
    points = points[points.duplicated(RUN, keep="last")]
    tasks = [task for task in NAMED_TASKS if task in set(curves["task"])]
    drawn = Figure(figsize=(9, 3.3 * math.ceil(len(tasks) / 2) + 0.6), dpi=130, layout="constrained")
    parts = drawn.subfigures(math.ceil(len(tasks) / 2), 2, squeeze=False, wspace=0.02)
    labels: dict[str, Any] = {}
    for part, task in zip(parts.flat, tasks, strict=False):
        both = part.subplots(1, 2, sharey=True)
        part.suptitle(task, fontsize=11)
        for axes, (along, text) in zip(both, (("steps", "steps"), ("cpu", "CPU time [min]")), strict=True):
            for name, runs in points[points["task"] == task].groupby("algorithm", sort=False):
                draw_seeds(axes, runs, along, "score", color=COLORS.get(name, "black"), label=name)
            for (label, style), level in zip(LEVELS.items(), levels(task, episodes), strict=True):
                axes.axhline(level, color="gray", ls=style, lw=1.5, label=label)
            axes.set(xscale="log", xlabel=text, xlim=(points[along].min(), 1.3 * points[along].max()), ylim=(0, 102))
            axes.xaxis.set_minor_formatter(NullFormatter())
        both[0].set_ylabel("score [%]")
        handles, names = both[0].get_legend_handles_labels()
        labels |= dict(zip(names, handles, strict=True))
    drawn.legend(labels.values(), labels, fontsize=9, loc="outside lower center", ncols=4)
    return drawn


def levels(task: str, episodes: DataFrame) -> tuple[float, float]:
    """Return the scores of the strongest reference but oracles, and of the oracle."""
    score, bars = episodes[episodes["task"] == task].groupby("algorithm")["score"].mean(), bars_of(task)
    return score[[name for name in bars if "oracle" not in BARS[name]]].max(), score[bars[-1:]].max()


def cpu_minutes(runs: DataFrame) -> Series:
    """Return the CPU time of each point [min]; of a recipe, which states the whole, in proportion to its steps."""
    last = runs.groupby(RUN)[["steps", "cpu_s"]].transform("last")
    return (runs["cpu_s"].fillna(last["cpu_s"] * runs["steps"] / last["steps"]) / 60).clip(lower=0.01)


def main(args: Sequence[str] | None = None) -> None:
    """Train what is missing, and write table, data and figure."""
    config = tyro.cli(Config, description=__doc__, args=args)
    config = replace(config, tasks=tuple(map(task_name, config.tasks)))
    for name in config.algorithms:
        check_choice(ALGORITHMS, algorithm=name)
    points, episodes = results(config)
    write_text(config.results / "scores.md", table(points, episodes))
    runs = episodes[~episodes["algorithm"].isin(BARS)].groupby(RUN, sort=False)["score"].mean().reset_index()
    keep_agents(runs.groupby(RUN[:2], sort=False), config.out, config.agents)
    write_picture(config.results / "scores.png", figure(points, episodes), SOURCE, config.results / "scores.csv")


if __name__ == "__main__":
    command("scores.py", main, ValueError)
