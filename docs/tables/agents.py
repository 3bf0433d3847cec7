"""Score the agents that sweep.py kept again, and print a row for each.

    pip install -c constraints.txt -e '.[recipes,onnx]'
    python docs/tables/agents.py docs/results/agents/*    # a minute

A file is named by its task and algorithm, as in ``box-PPO.onnx``. Intervals are over 200 episodes.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

from magrl import score
from magrl.evaluation.tables import markdown_table
from magrl.files import write_atomically, write_with
from magrl.navigators.onnx import exported, with_description
from magrl.training import command

import tyro
from pandas import DataFrame
from torch import Tensor, nn

EPISODES = 200
"""Episodes of a score."""


class Acting(nn.Module):
    """What a policy of stable-baselines3 does without exploration."""

    def __init__(self, policy: Any) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, observation: Tensor) -> Tensor:
        """Return the action."""
        return self.policy._predict(observation, deterministic=True)


def save_agent(path: Path, policy: Any, task: str) -> None:
    """Write a policy of stable-baselines3 with vectors as observations as ONNX, for :func:`score`."""
    network = exported(Acting(policy), policy.observation_space.shape[0])
    write_atomically(path, with_description(network.content, {"task": task}))


def keep_agents(ends: Iterable[tuple[tuple[str, str], DataFrame]], runs: Path, folder: Path) -> None:
    """Copy the agent of the run with the median SPL of each algorithm on each task; runs of old sweeps have none.

    Args:
        ends: task and algorithm, and the last points of their runs.
        runs: folder of the runs.
        folder: folder of the copies.
    """
    folder.mkdir(exist_ok=True)
    for (task, name), last in ends:
        seed = last.sort_values("SPL")["seed"].iloc[(len(last) - 1) // 2]
        run = runs / f"{task}-{name}-seed{seed}"
        for agent in (*runs.glob(f"{run.name}.onnx"), *run.glob("policy.*")):
            write_with(folder / f"{task}-{name}{agent.suffix}", partial(shutil.copy, agent))


def main(files: tyro.conf.Positional[tuple[Path, ...]]) -> None:
    """Score agents and print the table."""
    rows = []
    for file in files:
        task, _, name = file.stem.partition("-")
        found = {key: f"{value:.1f}" for key, value in score(file, task, episodes=EPISODES).items()}
        interval = f"{found['SPL']} ({found['SPL_low']}–{found['SPL_high']})"
        rows.append([task, name, found["SR"], interval, found["return"], found["steps"], found["beyond_50km"]])
    print(markdown_table(["task", "agent", "SR %", "SPL %", "return", "steps", "beyond 50 km %"], rows))


if __name__ == "__main__":
    command("agents.py", lambda: tyro.cli(main, prog="agents.py", description=__doc__), ValueError)
