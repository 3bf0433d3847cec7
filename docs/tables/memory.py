"""What a memory has learned: agents of ppo_memory.py and filters, on the task of a training and under other errors.

    python docs/tables/sweep.py --algorithms ppo_memory    # the agents
    python docs/tables/memory.py                           # five minutes

Cells are the SPL [%] of the 200 episodes of a named task (:func:`magrl.evaluation.score`), of several agents the mean
and the range. *Storm* is in the record of its weather, and in four others; *Readings* also has the errors of a ship and
of low-cost sensors. No agent was trained with these.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import magrl.interrupts  # noqa: F401 - before what takes seconds
from bars import BARS
from magrl import paper
from magrl.envs import planet_scenario
from magrl.envs.navigation import storm_errors
from magrl.evaluation import score
from magrl.evaluation.tables import markdown_table
from magrl.field import WeatherRecord, weather_record
from magrl.files import write_text
from magrl.navigators.memory import LIMITS
from magrl.training import UsageError, command
from magrl.transforms import CONDITIONS

import torch
import tyro
from torch import Tensor

TRAINED = {"storm": "memory, trained on storm", "readings": "memory, trained on readings"}
OTHERS = {name: BARS[name] for name in ("kalman", "anywhere", "secant")}
TOLD = BARS["told"]


@dataclass(frozen=True)
class Config:
    """Agents and results."""

    runs: Path = Path("runs/sweep")
    """Folder of the sweep."""
    episodes: int = 200
    """Episodes of a cell."""
    out: Path = Path("docs/results/memory.md")
    """Table."""


def turned(variation: Tensor) -> WeatherRecord:
    """Return a record of another variation ``(T, 3)`` on the day of *Storm*."""
    return WeatherRecord(variation.contiguous())


def columns() -> dict[str, tuple[str, dict[str, Any]]]:
    """Return task and options of each column."""
    record = weather_record("college").variation
    weathers = {
        "storm": "college",
        "reversed in time": turned(record.flip(0)),
        "sign flipped": turned(-record),
        "north and east swapped": turned(record[:, [1, 0, 2]]),
        "another station": "disturbed",
    }
    tasks = {name: ("storm", {"transforms": storm_errors(weather)}) for name, weather in weathers.items()}
    tasks["readings"] = ("readings", {})
    for name in ("ship", "low-cost"):
        vehicle = CONDITIONS[name]
        drift_km = vehicle.drift_km(LIMITS["max_leg_km"])
        planets = planet_scenario(
            256,
            seed=0,
            max_latitude=70,
            distance_range_km=paper.DISTANCE_KM,
            max_leg_km=LIMITS["max_leg_km"] + drift_km,
        )
        options = {"scenario": planets, "transforms": vehicle.transforms(), "drift_km": drift_km}
        tasks[name] = ("readings", options)
    return tasks


def told(options: dict[str, Any]) -> dict[str, Any]:
    """Return the options of a column of *Storm* with the size of each error stated."""
    return {"transforms": storm_errors(options["transforms"][0].record, stated=True)}


def cell(agents: list[str], task: str, options: dict[str, Any], episodes: int) -> str:
    """Return the mean SPL of agents, and their range."""
    found = torch.tensor([score(agent, task, episodes=episodes, **options)["SPL"] for agent in agents])
    return f"{found.mean():.1f}" + f" ({found.min():.1f}–{found.max():.1f})" * (len(agents) > 1)


def trained(runs: Path, task: str) -> list[str]:
    """Return the agents of the sweep on a task."""
    return [str(path) for path in sorted(runs.glob(f"{task}-ppo_memory-seed*/policy.safetensors"))]


def main(config: Config) -> None:
    """Fly all agents and write the table."""
    agents = {label: trained(config.runs, task) for task, label in TRAINED.items()}
    if not any(agents.values()):
        raise UsageError(f"{config.runs} has no agents: python docs/tables/sweep.py --algorithms ppo_memory")
    agents |= {label: [name] for name, label in OTHERS.items()}
    tasks = columns()
    cells = {
        label: [cell(names, *column, config.episodes) for column in tasks.values()]
        for label, names in agents.items()
        if names
    }
    cells[TOLD] = [
        cell(["kalman"], task, told(options), config.episodes) if task == "storm" else "—"
        for task, options in tasks.values()
    ]
    rows = [[label, str(len(agents.get(label, [TOLD]))), *row] for label, row in cells.items()]
    write_text(config.out, markdown_table(["agent", "seeds", *tasks], rows))


if __name__ == "__main__":
    command("memory.py", lambda: main(tyro.cli(Config, description=__doc__)))
