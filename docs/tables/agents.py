"""Score the agents that scores.py kept again, and print a row for each.

    pip install -c constraints.txt -e '.[recipes,onnx]'
    python docs/tables/agents.py magrl/navigators/pretrained/*-*    # a minute

A file is named by its task and algorithm, as in ``box-PPO.onnx``. Intervals are over 200 episodes.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from magrl import score
from magrl.evaluation.tables import markdown_table
from magrl.files import write_atomically
from magrl.navigators.onnx import has_view, with_description
from magrl.training import command

import tyro
from pandas import DataFrame

EPISODES = 200
"""Episodes of a score."""


def keep_agents(ends: Iterable[tuple[tuple[str, str], DataFrame]], runs: Path, folder: Path) -> None:
    """Copy the agent of the run with the median score of each algorithm on each task, if it is there.

    Args:
        ends: task and algorithm, and the scores of their runs.
        runs: folder of the runs.
        folder: folder of the copies.
    """
    folder.mkdir(exist_ok=True)
    for (task, name), last in ends:
        seed = last.sort_values("score")["seed"].iloc[(len(last) - 1) // 2]
        for agent in (runs / f"{task}-{name}-seed{seed}").glob("policy.*"):
            content = agent.read_bytes()
            if agent.suffix == ".onnx" and not has_view(content):
                content = with_description(content, {"task": task})  # without paths of this machine
            write_atomically(folder / f"{task}-{name}{agent.suffix}", content)


def main(files: tyro.conf.Positional[tuple[Path, ...]]) -> None:
    """Score agents and print the table."""
    rows = []
    for file in files:
        task, _, name = file.stem.partition("-")
        found = {key: f"{value:.1f}" for key, value in score(file, task, episodes=EPISODES).items()}
        interval = f"{found['score']} ({found['score_low']}–{found['score_high']})"
        rows.append([task, name, interval, *(found[key] for key in ("SR", "SPL", "steps", "beyond_50km"))])
    print(markdown_table(["task", "agent", "score %", "SR %", "SPL %", "steps", "beyond 50 km %"], rows))


if __name__ == "__main__":
    command("agents.py", lambda: tyro.cli(main, prog="agents.py", description=__doc__), ValueError)
