"""Make the ladder of the named tasks: the same agents where a task is easier or harder, and where none was trained.

python docs/tables/ladder.py    # docs/results/ladder.md and elsewhere.md; some minutes
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from bars import BARS, flown
from magrl.envs import Region
from magrl.errors import SensorErrors
from magrl.evaluation import evaluation_rollout
from magrl.evaluation.scores import SEED, scored
from magrl.evaluation.tables import markdown_table
from magrl.field import SphericalHarmonicField, random_planets
from magrl.field.weather import weather_record
from magrl.files import write_text
from magrl.named_tasks import NAMED_TASKS, storm_errors
from magrl.navigators import FieldPolicy, load_policy
from magrl.navigators.names import named
from magrl.training import command

import tyro
from tqdm import tqdm

NOGO = "nogo-TD3"
STORM = weather_record("college")
COLUMNS = ("easier", "the named task", "harder", "with noise")


class Ladder(NamedTuple):
    """A task, its levels in words, the agents that fly it, and the options of each level."""

    task: str
    about: str
    agents: tuple[str, ...]
    levels: list[dict[str, Any]]


EDDIES = [*({"eddies_km_h": speed} for speed in (0.5, 0.9, 1.2)), {"transforms": [SensorErrors((0.02, 0.02, 2.0))]}]
DISCS = [{"discs": number} for number in (2, 4, 8)]
STORMS = [{"transforms": storm_errors(replace(STORM, variation=x * STORM.variation))} for x in (0.5, 1.0, 2.0)]
LADDERS = (
    Ladder("eddies", "0.5, 0.9, 1.2 km/h", ("eddies", "offset", "parallel", "geodesic"), EDDIES),
    Ladder("nogo", "2, 4, 8 discs", (NOGO, "shielded", "around", "detour"), DISCS),
    Ladder("storm", "weather × 0.5, 1, 2", ("memory", "kalman", "secant"), STORMS),
)


REGIONS = {
    "the task's region": {},
    "Azores": {"region": Region((35, 45), (-35, -25))},
    "a random planet": {"field": SphericalHarmonicField(random_planets(1, seed=1)[0])},
}
"""Regions of agents of one region, by their columns."""
TRAINED = (("box", "box-TD3"), ("box", "box-GG-TD3"), ("nogo", "nogo-TD3"), ("eddies", "eddies-TD3"))


def elsewhere(task: str, agent: str, vehicles: int, options: dict[str, Any]) -> str:
    """Return success rate and SPL of an agent in a region, without training there, behind the scaling of the region."""
    env = NAMED_TASKS[task].make(vehicles, seed=SEED, **options)
    policy = load_policy(named(agent).file)
    moved = FieldPolicy(replace(policy.config, view=env.base_env.view), policy.actor)
    dictionary = NAMED_TASKS[task].make(vehicles, observation="dict", scale_actions=False, seed=SEED, **options)
    score = scored(evaluation_rollout(dictionary, moved))
    return f"{score['SR']:.1f} / {score['SPL']:.1f}"


def main(out: Path = Path("docs/results"), vehicles: int = 1000) -> None:
    """Fly all agents on all levels, and write the tables.

    Args:
        out: Folder of the tables.
        vehicles: Number of episodes.
    """
    rows = []
    for (task, about, _, levels), agent in tqdm([(ladder, agent) for ladder in LADDERS for agent in ladder.agents]):
        scores = [scored(flown(task, agent, vehicles, **options)[1]) for options in levels]
        cells = [f"{score['SR']:.1f} / {score['SPL']:.1f}" for score in scores]
        label = BARS.get(agent, Path(agent).stem.partition("-")[2] or agent)
        rows.append([f"{task}: {about}", label, *cells, *["—"] * (len(COLUMNS) - len(cells))])
    write_text(out / "ladder.md", markdown_table(["task", "agent", *COLUMNS], rows) + "\n")
    rows = [[task, agent, *(elsewhere(task, agent, vehicles, o) for o in REGIONS.values())] for task, agent in TRAINED]
    write_text(out / "elsewhere.md", markdown_table(["task", "agent", *REGIONS], rows) + "\n")


if __name__ == "__main__":
    command("ladder.py", lambda: tyro.cli(main, prog="ladder.py", description=__doc__))
