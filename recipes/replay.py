"""Write a page that replays episodes: one file that opens from disk, without installation or network.

    python recipes/replay.py runs/A                                     # writes runs/A/replay.html
    python recipes/replay.py runs/A --navigators secant pso:flown --num-tasks 5 --gif episodes.gif

The run's policy comes first, then the other navigators, all on the same tasks, with the start heading and the sensor
noise of the training. The page shows the true field. Takes seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from magrl.evaluation import Flight
from magrl.evaluation.maps import write_gif
from magrl.evaluation.navigators import label
from magrl.evaluation.replay import replay_data, write_replay
from magrl.evaluation.rollout import with_true_field
from magrl.evaluation.runs import read_run
from magrl.evaluation.scenarios import TaskSet, choose_tasks, first_tasks
from magrl.files import check_writable
from magrl.training import UsageError, command, parse

import tyro
from tensordict.nn import TensorDictModuleBase
from torchrl import torchrl_logger

RECIPE = "replay.py"
DEFAULT_TASKS = 12


@dataclass(frozen=True)
class Config:
    """Settings of a replay."""

    run: tyro.conf.Positional[Path]
    """Folder of a finished training."""
    navigators: tuple[str, ...] = ("secant", "parallel")
    """Navigators beside the run's policy, as in recipes/evaluate.py."""
    num_tasks: int | None = None
    """Number of tasks, from the first of the set; 12 by default, or all if there are fewer."""
    tasks: TaskSet | None = None
    """Frozen task set; the scenario's own tasks by default, or test-1000 where it has none."""
    scenario: Path | None = None
    """Scenario file (.toml or .json, docs/data.md); the scenario of the run by default."""
    zeta: float | None = None
    """Arrival threshold on the objective; that of the training by default."""
    seed: int = 0
    """Random seed of metaheuristics, sensor noise and random start headings."""
    out: Path | None = None
    """File of the page, which is replaced; replay.html in the run folder by default."""
    gif: Path | None = None
    """Animated GIF of the run's policy on the same tasks; none by default."""


def labeled(texts: Sequence[str]) -> dict[str, str]:
    """Return navigators by label; a second trained agent of one kind is labeled with its folder too.

    Raises:
        ValueError: for a navigator that is given twice.
    """
    named: dict[str, str] = {}
    for text in texts:
        name, _, run = text.partition("=")
        title = label(name)
        title += f" ({Path(run).name})" if run and title in named else ""
        if title in named:
            raise ValueError(f"{text} is given twice: the page shows each navigator once")
        named[title] = text
    return named


def prepare(config: Config) -> tuple[Flight, dict[str, TensorDictModuleBase], str, Path]:
    """Return the flight, navigators by label, and title and path of the page.

    Raises:
        UsageError: for anything that is wrong with the settings.
    """
    try:
        run = read_run(config.run)
        path = config.scenario or run.scenario
        zeta = run.zeta if config.zeta is None else config.zeta
        scenario = choose_tasks(path, config.tasks, zeta=zeta, start_heading=run.start_heading)
        assert scenario.tasks is not None
        available = len(scenario.tasks.start)
        count = min(DEFAULT_TASKS, available) if config.num_tasks is None else config.num_tasks
        flight = Flight(first_tasks(scenario, count), errors=run.errors, seed=config.seed)
        texts = (f"{run.kind or f'policy:{config.run.name}'}={config.run}", *config.navigators)
        made = {text: flight.navigator(text) for text in texts}
        navigators = {name: made[text] for name, text in labeled(texts).items()}
        out = config.out or config.run / "replay.html"
        for file in filter(None, (out, config.gif)):
            check_writable(file)
    except (ValueError, TypeError, OSError) as error:
        raise UsageError(str(error)) from error
    title = f"{config.run.name}, tasks of {path.name if path else config.tasks or 'test-1000'}"
    return flight, navigators, title, out


def replay(config: Config) -> Path:
    """Fly the navigators, write the page and the GIF, and return the path of the page.

    Raises:
        UsageError: for anything that is wrong with the settings, before anything is flown.
    """
    torchrl_logger.setLevel("WARNING")
    flight, navigators, title, out = prepare(config)
    env = flight.base
    rollouts = {name: with_true_field(flight.fly(navigator)) for name, navigator in navigators.items()}
    data = replay_data(rollouts, env.field, env.region, zeta=env.zeta, title=title, names=env.scenario.names)
    write_replay(out, data)
    if config.gif:
        write_gif(config.gif, next(iter(rollouts.values())), env.field, env.region)
    return out


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line and write the page."""
    print(f"Open {replay(parse(Config, RECIPE, __doc__, args))} in a browser")


if __name__ == "__main__":
    command(RECIPE, main)
