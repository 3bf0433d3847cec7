"""Writes a page on which journeys can be watched: one file that opens from disk, with nothing to install or download.

    python recipes/replay.py runs/A                                     # writes runs/A/replay.html
    python recipes/replay.py runs/A --navigators secant pso:flown --num-tasks 5 --gif journeys.gif

The run's policy comes first, then the navigators, all over the same tasks. Takes seconds.
"""

from __future__ import annotations

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro
from evaluate import Config as Evaluation
from evaluate import env_of, first, journeys, label, navigator
from torchrl import torchrl_logger

from magrl.replay import replay_data, write_gif, write_replay
from magrl.td3 import evaluation_rollout

DEFAULT_TASKS = 12


@dataclass(frozen=True)
class Config:
    """What is flown, over what, and where the page goes."""

    run: tyro.conf.Positional[Path]
    """Folder of a finished training."""
    navigators: tuple[str, ...] = ("secant", "parallel")
    """Beside the run's policy, as recipes/evaluate.py takes them."""
    num_tasks: int | None = None
    """The first so many of the tasks; 12 by default, or all where there are fewer."""
    tasks: Literal["test-1000", "paper-100", "figure-4-1"] | None = None
    """A frozen task set; the tasks of the world, or test-1000, by default."""
    world: Path | None = None
    """TOML or JSON file of an own region (docs/own_data.md); that of the run, where it was trained in one."""
    zeta: float | None = None
    """Arrival threshold on the objective; the one that the run was trained with by default."""
    seed: int = 0
    """Of navigators that draw random numbers."""
    out: Path | None = None
    """The page; replay.html in the run's folder by default. A file that is there is replaced."""
    gif: Path | None = None
    """An animated GIF of the run's policy on the same tasks, if wanted."""


def run_config(run: Path) -> dict[str, Any]:
    """The configuration that a training left in its folder.

    Raises:
        FileNotFoundError: for a folder that is no run's.
        ValueError: for a file that holds something else.
    """
    path = run / "config.json"
    if not path.is_file():
        raise FileNotFoundError(f"there is no run at {run}: it should hold config.json and policy.pt")
    try:
        return dict(json.loads(path.read_text()))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path} is not the configuration of a run: {error}") from error


def labelled(texts: tuple[str, ...]) -> dict[str, str]:
    """Navigators by what the page calls them; of several trained agents of one kind, the later ones by folder too.

    Raises:
        ValueError: for one that is named twice.
    """
    named: dict[str, str] = {}
    for text in texts:
        name, _, run = text.partition("=")
        known = label(name, "look-ahead")
        known += f" ({Path(run).name})" if run and known in named else ""
        if known in named:
            raise ValueError(f"{text} is named twice: the page shows each navigator once")
        named[known] = text
    return named


def replay(config: Config) -> Path:
    """Flies the navigators and writes what was asked for.

    Raises:
        FileNotFoundError: for a folder that is no run's.
        ValueError: for an unknown navigator, one that is named twice, or more tasks than there are.
    """
    torchrl_logger.setLevel("WARNING")
    run = run_config(config.run)
    kind = {True: "gg_td3", False: "td3"}.get(run.get("guided"), "recurrent")
    texts = (f"{kind}={config.run}", *config.navigators)
    zeta = run.get("zeta", 0.01) if config.zeta is None else config.zeta
    trained_in = config.run / Path(run["world"]).name if isinstance(run.get("world"), str) else None
    world, tasks = journeys(config.world or trained_in, config.tasks)
    tasks = first(tasks, min(DEFAULT_TASKS, len(tasks.start)) if config.num_tasks is None else config.num_tasks)
    env = env_of(Evaluation(texts, zeta=zeta, seed=config.seed), world, tasks)
    pilots = {text: navigator(text, env, "look-ahead", config.seed) for text in texts}
    rollouts = {name: evaluation_rollout(env, pilots[text]) for name, text in labelled(texts).items()}
    of = config.world or trained_in
    title = f"{config.run.name}, tasks of {of.name if of else config.tasks or 'test-1000'}"
    out = config.out or config.run / "replay.html"
    write_replay(out, replay_data(rollouts, env.field, env.region, zeta=zeta, title=title))
    if config.gif:
        write_gif(config.gif, next(iter(rollouts.values())), env.field, env.region)
    return out


if __name__ == "__main__":
    settings = tyro.cli(Config, description=__doc__)
    try:
        print(f"open {replay(settings)} in a browser")
    except (ValueError, OSError) as error:
        sys.exit(f"replay.py: {error}")
