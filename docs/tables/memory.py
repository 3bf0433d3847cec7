"""What a memory has learned: agents of ppo_memory.py and filters, on the task of a training and under other errors.

    python docs/tables/memory.py    # five minutes

Cells are the SPL [%] of the 200 episodes of a named task (:func:`magrl.evaluation.score`). *Storm* is in the record of
its weather, and in four others; *Readings* also has the errors of a ship and of low-cost sensors. No agent was trained
with these.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bars import BARS
from magrl import paper
from magrl.envs import planet_scenario
from magrl.errors import CONDITIONS
from magrl.evaluation import score
from magrl.evaluation.tables import markdown_table
from magrl.field import WeatherRecord, weather_record
from magrl.files import write_text
from magrl.named_tasks import storm_errors
from magrl.navigators.memory import LIMITS
from magrl.training import command

import tyro
from torch import Tensor

AGENTS = {"memory": "memory (pretrained), trained on storm"}
AGENTS |= {"readings-ppo_memory": "memory, trained on readings"}
AGENTS |= {name: BARS[name] for name in ("kalman", "anywhere", "secant")}
TOLD = BARS["told"]


@dataclass(frozen=True)
class Config:
    """Episodes and result."""

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


def main(config: Config) -> None:
    """Fly all agents and write the table."""
    tasks, rows = columns(), []
    for agent, label in AGENTS.items():
        cells = [score(agent, task, episodes=config.episodes, **options)["SPL"] for task, options in tasks.values()]
        rows.append([label, *(f"{spl:.1f}" for spl in cells)])
    knows = [
        f"{score('kalman', task, episodes=config.episodes, **told(options))['SPL']:.1f}" if task == "storm" else "—"
        for task, options in tasks.values()
    ]
    write_text(config.out, markdown_table(["agent", *tasks], [*rows, [TOLD, *knows]]))


if __name__ == "__main__":
    command("memory.py", lambda: main(tyro.cli(Config, description=__doc__)))
