"""Measure how often a vehicle that says it has arrived is right, all over the Earth.

    python recipes/tables/onboard_table.py anywhere > docs/results/onboard.md
    python recipes/tables/onboard_table.py anywhere kalman --conditions aircraft ship --arrival-km 25

Each task is flown by `magrl.onboard.Onboard`, which reads plain numbers, with noise of the sensors or under the
conditions of a real vehicle; regions and tasks are as in `earth_table.py`. One flight serves all levels of confidence,
as nothing that the vehicle does depends on them before it stops. Prints a Markdown table: at each level the share of
the flights that the vehicle declared as arrived, the share of these that were, and the median distance to the
destination [km] where it declared.
"""

from __future__ import annotations

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # spinning threads slow each other down; read when torch is imported

import math
from dataclasses import dataclass
from statistics import median

import torch
import tyro
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from tqdm import tqdm

from magrl import paper
from magrl.envs import GeomagneticNavEnv, earth_scenario
from magrl.evaluation.navigators import label
from magrl.evaluation.tables import markdown_table
from magrl.geodesy import geodesic
from magrl.onboard import Command, Onboard
from magrl.training import UsageError, command
from magrl.transforms import Conditions, conditions_named, with_conditions

RECIPE = "onboard_table.py"
LEVELS = (0.5, 0.8, 0.95)
"""Levels of confidence."""
NOISE = ((0.02, 0.02, 2.0), (0.05, 0.05, 5.0), (0.1, 0.1, 10.0))
"""Standard deviations of the noise on D [deg], I [deg], B_H [nT]."""


@dataclass
class Config:
    """Navigators and extent of the measurement."""

    navigators: tyro.conf.Positional[tuple[str, ...]]
    """Navigators on board: anywhere, secant, kalman or run_and_tumble."""
    conditions: tuple[str, ...] = ()
    """Conditions of real vehicles in place of noise: laboratory, aircraft, ship, underwater or low-cost."""
    tasks: int = 100
    """Number of tasks."""
    distance_km: tuple[float, float] = (300.0, 500.0)
    """Shortest and longest distance of a task [km]."""
    max_steps: int = 50
    """Moves after which a flight ends."""
    zeta: float = 0.01
    """Arrival threshold on the objective F (Eq. 2-7)."""
    arrival_km: float | None = None
    """Distance that counts as arrived, in place of the threshold [km]."""
    seed: int = 0
    """Random seed of regions, tasks, start headings and errors; no training uses it."""


def errors(config: Config) -> dict[str, Conditions]:
    """Return the errors of the vehicle, by the name of the row."""
    if config.conditions:
        return {name: conditions_named(name) for name in config.conditions}
    noise = {
        f"{d:g}°, {i:g}°, {h:g} nT": Conditions("noise", 100.0, sensors={"sensor_std": (d, i, h)}) for d, i, h in NOISE
    }
    return {"none": conditions_named("laboratory"), **noise}


@dataclass
class Flight:
    """Of each level that was reached: whether the vehicle had arrived, and its distance to the destination [km]."""

    declared: dict[float, tuple[bool, float]]
    end: str


def environment(config: Config, conditions: Conditions) -> EnvBase:
    """Return an environment of one vehicle that flies one task after the other; it never ends an episode by itself."""
    seed = 3 * paper.FIRST_RESERVED_SEED + config.seed  # as in earth_table.py
    drift_km = max(
        conditions.drift_km(50.0), conditions_named("aircraft").drift_km(50.0)
    )  # the same regions in each row
    size = {"half_size_deg": 10, "max_latitude": 70, "max_move_km": 50.0 + drift_km}
    scenario = earth_scenario(128, seed, "2025-01-01", distance_range_km=config.distance_km, **size)
    base = GeomagneticNavEnv(
        scenario.with_tasks(scenario.random_tasks(config.tasks, seed)),
        max_steps=config.max_steps + 1,
        arrival="declared",
        drift_km=conditions.drift_km(50.0),
        start_heading="random",
        seed=config.seed,
    )
    return with_conditions(base, conditions, config.seed)


def fly(vehicle: Onboard, env: EnvBase, state: TensorDictBase, config: Config) -> Flight:
    """Return the next flight of a vehicle."""
    vehicle.start(state["target_field"][0].tolist())
    flight = Flight({}, "")
    while True:
        reading = state["field"][0].tolist()
        told = vehicle.step(*reading, math.degrees(state["heading"].item()), state["move"][0, 0].item())
        note(flight, told, state, config)
        if told.stop or state["done"].item():
            flight.end = told.stop or "left the region"
            return flight
        turn = math.radians(told.turn_deg)
        state["action"] = torch.tensor([[told.distance_km, turn, -1.0]])
        state = env.step(state)["next"]


def note(flight: Flight, told: Command, state: TensorDictBase, config: Config) -> None:
    """Add the levels that a command reaches for the first time in a flight."""
    way_km, _ = geodesic(*state["position"].unbind(-1), *state["target_position"].unbind(-1))
    near = state["objective"].item() < config.zeta if config.arrival_km is None else way_km.item() <= config.arrival_km
    for level in LEVELS:
        if told.confidence >= level and told.stop != "lost":
            flight.declared.setdefault(level, (near, way_km.item()))


def measure(name: str, conditions: Conditions, config: Config) -> list[Flight]:
    """Return the flights of a navigator."""
    options = {"max_steps": config.max_steps, "zeta": config.zeta, "arrival_km": config.arrival_km}
    sheet = {"sensor_std": conditions.sensor_std, "bias_std": conditions.bias_std}
    vehicle = Onboard(name, confidence=max(LEVELS), **options, **sheet)
    env = environment(config, conditions)
    return [fly(vehicle, env, env.reset(), config) for _ in range(config.tasks)]


def row(name: str, said: str, flights: list[Flight]) -> list[object]:
    """Return the cells of a row."""
    cells = []
    for level in LEVELS:
        found = [flight.declared[level] for flight in flights if level in flight.declared]
        right = f"{100 * sum(near for near, _ in found) / len(found):.1f}" if found else "—"
        distance = f"{median(km for _, km in found):.1f}" if found else "—"
        cells.append(f"{100 * len(found) / len(flights):.1f} / {right} / {distance}")
    return [label(name), said, *cells]


def table(config: Config) -> str:
    """Return the table.

    Raises:
        UsageError: for a navigator or a setting that is wrong.
    """
    if not config.navigators:
        raise UsageError("name at least one navigator, for example: anywhere")
    rows = []
    try:
        for name in config.navigators:
            Onboard(name)  # raises for an unknown name before anything is flown
        cases = [(name, said) for name in config.navigators for said in errors(config)]
        for name, said in tqdm(cases, unit="row"):
            rows.append(row(name, said, measure(name, errors(config)[said], config)))
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from error
    return markdown_table(["navigator", "errors", *(f"confidence {level:g}" for level in LEVELS)], rows)


if __name__ == "__main__":
    command(RECIPE, lambda: print(table(tyro.cli(Config, prog=RECIPE, description=__doc__))))
