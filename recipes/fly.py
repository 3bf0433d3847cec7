"""Fly the pretrained agent, which has no map, between two places on Earth: seconds, and no training.

    python recipes/fly.py "60.4N 5.3E" "64.1N 21.9W"                     # Bergen to Reykjavik
    python recipes/fly.py "38.7, -9.1" "40.7, -74.0" --errors 0.05 0.05 5 --navigator secant
    python recipes/fly.py "60.4N 5.3E" "64.1N 21.9W" --errors underwater         # with the errors of a real vehicle
    python recipes/fly.py "60.4N 5.3E" "64.1N 21.9W" --errors 0 0.05 5 --north magnetic  # with a compass, without D

The agent measures declination D, inclination I and horizontal intensity B_H, and knows their values at the destination.
With --model and --start-km, it carries a model of the Earth and knows its start and destination; else it never observes
a position: coordinates serve the simulation, the score and the picture only.
Writes flight.png and flight.json.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import places
from magrl.checks import check_number
from magrl.envs import GeomagneticNavEnv, Scenario, Trips
from magrl.evaluation import Flight, Sheet, episode_measures
from magrl.evaluation.maps import trajectories_figure
from magrl.field import IGRF
from magrl.files import check_writable, write_json, write_with
from magrl.geodesy import geodesic
from magrl.navigators.names import NAMES, named
from magrl.pilot.displacement import Displacement
from magrl.training import UsageError, command, parse

import torch
import tyro
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl import torchrl_logger
from torchrl.envs import EnvBase
from tqdm import tqdm
from typing_extensions import Doc

RECIPE = "fly.py"
RULES = {"with_signal": "objective", "without_signal": "declared"}
"""Rules of arrival of the two flights: with an arrival signal, and declared by the vehicle within 25 km."""
ARRIVAL_KM = 400.0
"""Distance up to which the arrival threshold is 0.01; beyond, it decreases so that the arrival radius is constant."""


@dataclass(frozen=True)
class Config:
    """Settings of a flight."""

    start: tyro.conf.Positional[str]
    """Start, such as "60.4N 5.3E", "60.4, 5.3" or "-33.9 18.4"."""
    destination: tyro.conf.Positional[str]
    """Destination, such as a start."""
    navigator: Annotated[str, Doc(f"Navigator: {', '.join(NAMES)}, or a run folder or file.")] = "anywhere"
    sheet: tyro.conf.OmitArgPrefixes[Sheet] = Sheet(confidence=0.5)
    """Errors of the vehicle, and what it knows."""
    date: str = "2025-01-01"
    """Date of the field, 1900 to 2030 (IGRF-14)."""
    zeta: float | None = None
    """Arrival threshold on the objective (Eq. (7)); by default 0.01, and beyond 400 km less, for a radius of 25 km."""
    max_steps: int | None = None
    """Maximum number of legs; by default 20 more than three times the shortest path at 50 km a leg."""
    start_heading: float | Literal["random"] = "random"
    """Heading at the start, from true north [deg]; random by default."""
    seed: int = 0
    """Random seed of the start heading and of the noise."""
    out: Path = Path("runs/fly")
    """Folder of flight.png and flight.json, which are replaced."""
    title: str | None = None
    """Title of the flight in its picture, such as "Bergen to Reykjavik"; start and destination by default."""


class Watched(TensorDictModuleBase):
    """A navigator whose progress is shown, as a share of the shortest path [km]."""

    def __init__(self, navigator: TensorDictModuleBase, distance_km: float) -> None:
        super().__init__()
        self.navigator, self.in_keys, self.out_keys = navigator, navigator.in_keys, ["action"]
        form = "{percentage:3.0f}% |{bar:25}| {n:.0f} km of {total:.0f} km{postfix}"
        self.bar = tqdm(total=distance_km, bar_format=form, mininterval=0.2)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Show the distance flown, and the estimated remaining displacement with its standard deviation."""
        displacement = Displacement(**tensordict["track", "displacement"][0].double())
        left = displacement.mean.norm()
        direction = displacement.mean / left.clamp_min(1e-6)
        error = (direction @ displacement.covariance @ direction).clamp_min(0).sqrt()
        self.bar.set_postfix_str(f"estimated {left:.0f} ± {error:.0f} km to go", refresh=False)
        self.bar.update(min(tensordict["leg"][0, 0].item(), self.bar.total - self.bar.n))
        return self.navigator(tensordict)


def ends(config: Config, field: IGRF) -> tuple[Tensor, Tensor, float]:
    """Return start and destination ``(2,)`` [deg] and their distance [km].

    Raises:
        ValueError: for a place that cannot be read or found, or ends between which no flight is possible.
    """
    start, target = map(places.parse_coordinates, (config.start, config.destination))
    distance_km = geodesic(*start, *target)[0].item()
    if math.isnan(distance_km):
        raise ValueError(f"{config.destination!r} is the antipode of the start, {config.start!r}: choose another one")
    if distance_km < 1:
        raise ValueError(f"start {config.start!r} and destination {config.destination!r} are the same place")
    places.check_declination(config.start, start, field)
    places.check_declination(config.destination, target, field)
    return start, target, distance_km


def check_files(config: Config) -> None:
    """Raise unless all files can be written."""
    for name in ("flight.png", "flight.json"):
        check_writable(config.out / name)


def prepare(config: Config) -> dict[str, tuple[Flight, EnvBase, Watched]]:
    """Return flight, environment and navigator of a vehicle with an arrival signal and without.

    Raises:
        UsageError: for anything that is wrong with the settings.
    """
    flights = {}
    try:
        if config.start_heading != "random":
            check_number(-360, 360, start_heading=config.start_heading)
        drift_km = config.sheet.conditions.drift_km(50.0)
        field = IGRF(config.date)
        start, target, distance_km = ends(config, field)
        region = places.region_around(start, target, field, 50.0 + drift_km)
        trips = Trips(start[None], target[None])
        size = {"region": region, "margin_deg": 0, "distance_range_km": (0.0, distance_km)}
        scenario = Scenario(**size, field=field, trips=trips, date=config.date)
        for name, arrival in RULES.items():
            flight = Flight(
                scenario,
                config.sheet,
                seed=config.seed,
                max_steps=round(3 * distance_km / 50) + 20 if config.max_steps is None else config.max_steps,
                zeta=0.01 * min(1, ARRIVAL_KM / distance_km) ** 2 if config.zeta is None else config.zeta,
                start_heading="random",
                arrival=arrival,
            )
            navigator = flight.navigator(config.navigator)
            flights[name] = flight, flight.env_of(navigator, track=True), Watched(navigator, distance_km)
        check_files(config)
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from error
    return flights


def rollout(env: EnvBase, navigator: Watched, start_heading: float | Literal["random"]) -> TensorDictBase:
    """Return the steps of the flight, ``(1, T)``."""
    state = env.reset()
    if start_heading != "random":
        wanted = torch.full_like(state["heading"], math.radians(math.remainder(start_heading, 360)))
        if state.get("true_heading", None) is not None:  # the measured one keeps its error
            state["heading"], state["true_heading"] = state["heading"] + wanted - state["true_heading"], wanted
        else:
            state["heading"] = wanted
    with torch.no_grad(), navigator.bar:
        return env.rollout(env.max_steps, navigator, auto_reset=False, tensordict=state)


def true_target(first: TensorDictBase) -> list[float]:
    """Return the true elements of the destination, which a compass or an error of them may hide."""
    keys = ("true_target_field", "exact_target_field", "target_field")
    return next(first[key].tolist() for key in keys if key in first)


def outcome(steps: TensorDictBase) -> str:
    """Return how a flight ended."""
    last = steps["next"][0, -1]
    declared = last.get("declared", None)
    if declared is not None and declared.item():
        return "declared its arrival" + ("" if last["success"].item() else ", falsely")
    if last["success"].item():
        return "arrived"
    if last["terminated"].item():
        return "left the region"
    return "reached the step limit" if declared is None else "not declared"


def draw(
    config: Config, steps: dict[str, TensorDictBase], measures: dict[str, dict[str, Any]], base: GeomagneticNavEnv
) -> None:
    """Write the picture and, where asked for, the tracks and the animation."""
    navigator, route = named(config.navigator).kind.name, config.title or f"{config.start} to {config.destination}"
    titles = [
        f"{rule.replace('_', ' an arrival ')}: {values['outcome']}, {values['length_km']:.0f} km"
        for rule, values in measures.items()
    ]
    titles[0] = f"{route}: {navigator} {titles[0]}"
    figure = trajectories_figure(dict(zip(titles, steps.values(), strict=True)), base.field, base.region)
    write_with(config.out / "flight.png", figure.savefig, dpi=120)


def fly(config: Config) -> dict[str, Any]:
    """Fly with and without an arrival signal, write the files and return the content of ``flight.json``.

    Raises:
        UsageError: for anything that is wrong with the settings, before anything is flown.
    """
    torchrl_logger.setLevel("WARNING")
    flights = prepare(config)
    steps = {name: rollout(env, navigator, config.start_heading) for name, (_, env, navigator) in flights.items()}
    measures = {
        name: {"outcome": outcome(flight)} | {key: value[0].item() for key, value in episode_measures(flight).items()}
        for name, flight in steps.items()
    }
    flight, first = flights["with_signal"][0], steps["with_signal"][0, 0]
    last = steps["without_signal"]["next"][0, -1]
    kind, estimated = named(config.navigator).kind, Displacement(**last["track", "displacement"])
    result = {
        **{key: value for key, value in asdict(config).items() if key not in ("sheet", "out")},
        **flight.sheet.model_dump(),
        "navigator": kind.name,
        "needs": kind.needs,
        **{key: getattr(flight.base, key) for key in ("zeta", "max_steps")},
        **{key: first[key].tolist() for key in ("start_position", "target_position")},
        "target_field": true_target(first),
        **measures["with_signal"],
        "without_signal": measures["without_signal"] | {"ellipse": estimated.ellipse()},
    }
    write_json(config.out / "flight.json", result)
    draw(config, steps, measures, flight.base)
    return result


def summary(result: dict[str, Any]) -> str:
    """Return the result of a flight as text."""
    elements = "D={:.2f} I={:.2f} BH={:.0f}".format(*result["target_field"])
    ends = ["{:.2f}, {:.2f}".format(*result[key]) for key in ("start_position", "target_position")]
    rows = {
        "outcome": result["outcome"],
        "navigator": f"{result['navigator']}, given {result['needs']} beside its readings",
        "data sheet": "; ".join(Sheet.lines(result)) or "no errors",
        "start": ends[0],
        "destination": f"{ends[1]}, {elements}",
        "steps": f"{result['steps']} of at most {result['max_steps']}",
        "path": "{length_km:.0f} km flown, {navigation_error_km:.1f} km left of {shortest_km:.0f}".format(**result),
        "without signal": "{outcome}: {steps} steps, {length_km:.0f} km, {navigation_error_km:.1f} km left, "
        "estimated to {ellipse}".format(**result["without_signal"]),
    }
    return "\n".join(f"{name:16}{text}" for name, text in rows.items())


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line, fly and print the summary."""
    words = sys.argv[1:] if args is None else args
    spaced = [f" {word}" if word[:1] == "-" and word[1:2].isdigit() else word for word in words]  # "-33.9 18.4"
    config = parse(Config, RECIPE, __doc__, spaced)
    print(summary(fly(replace(config, start=config.start.strip(), destination=config.destination.strip()))))
    print(f"The picture is {config.out / 'flight.png'}")


if __name__ == "__main__":
    command(RECIPE, main)
