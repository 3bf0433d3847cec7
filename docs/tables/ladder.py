"""Make the ladder of the named tasks: the same agents where a task is easier or harder.

python docs/tables/ladder.py    # docs/results/ladder.md; some minutes
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from bars import BARS, flown
from magrl.errors import SensorErrors
from magrl.evaluation.scores import scored
from magrl.evaluation.tables import markdown_table
from magrl.field.weather import weather_record
from magrl.files import write_text
from magrl.named_tasks import storm_errors
from magrl.training import command

import tyro
from tqdm import tqdm

NOGO = "nogo-TD3"
STORM = weather_record("college")
COLUMNS = ("easier", "the named task", "harder", "with noise")


class Ladder(NamedTuple):
    """A task, the agents that fly it, and the options of each level."""

    task: str
    agents: tuple[str, ...]
    levels: list[dict[str, Any]]


EDDIES = [*({"eddies_km_h": speed} for speed in (0.5, 0.9, 1.2)), {"transforms": [SensorErrors((0.02, 0.02, 2.0))]}]
DISCS = [{"discs": number} for number in (2, 4, 8)]
STORMS = [{"transforms": storm_errors(replace(STORM, variation=x * STORM.variation))} for x in (0.5, 1.0, 2.0)]
LADDERS = (
    Ladder("eddies", ("eddies", "offset", "parallel", "geodesic"), EDDIES),
    Ladder("nogo", (NOGO, "around", "detour"), DISCS),
    Ladder("storm", ("memory", "kalman", "secant"), STORMS),
)


def main(out: Path = Path("docs/results/ladder.md"), vehicles: int = 1000) -> None:
    """Fly all agents on all levels, and write the table.

    Args:
        out: File of the table, which is replaced.
        vehicles: Number of episodes.
    """
    rows = []
    for (task, _, levels), agent in tqdm([(ladder, agent) for ladder in LADDERS for agent in ladder.agents]):
        scores = [scored(flown(task, agent, vehicles, **options)[1]) for options in levels]
        cells = [f"{score['SR']:.1f} / {score['SPL']:.1f}" for score in scores]
        label = BARS.get(agent, Path(agent).stem.partition("-")[2] or agent)
        rows.append([task, label, *cells, *["—"] * (len(COLUMNS) - len(cells))])
    write_text(out, markdown_table(["task", "agent", *COLUMNS], rows) + "\n")


if __name__ == "__main__":
    command("ladder.py", lambda: tyro.cli(main, prog="ladder.py", description=__doc__))
