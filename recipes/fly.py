"""Fly the pretrained agent, which has no map, between two places on Earth: seconds, and no training.

    python recipes/fly.py "60.4N 5.3E" "64.1N 21.9W"                     # Bergen to Reykjavik
    python recipes/fly.py "60.4N 5.3E" "D=-11.1 I=75.2 BH=13000"         # a destination by its magnetic elements
    python recipes/fly.py "38.7, -9.1" "40.7, -74.0" --noise 0.05 0.05 5 --navigator secant --export track.geojson
    python recipes/fly.py "60.4N 5.3E" "64.1N 21.9W" --conditions underwater     # with the errors of a real vehicle

The agent measures declination D, inclination I and horizontal intensity B_H, and knows their values at the destination.
It never observes a position: coordinates serve the simulation, the score and the picture only.
Writes flight.png and flight.json.
"""

from __future__ import annotations

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # spinning threads slow each other down; read when torch is imported

import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl import torchrl_logger
from torchrl.envs import Compose, TransformedEnv
from tqdm import tqdm

from magrl.checks import check_number
from magrl.envs import GeomagneticNavEnv, Scenario, Tasks
from magrl.evaluation import episode_measures, export
from magrl.evaluation.maps import trajectories_figure, write_gif
from magrl.evaluation.navigators import make_navigator, needs
from magrl.evaluation.places import (
    check_declination,
    elements_text,
    find_elements,
    parse_coordinates,
    parse_elements,
    region_around,
)
from magrl.field import IGRF
from magrl.files import check_writable, write_json
from magrl.geodesy import geodesic
from magrl.training import UsageError, command
from magrl.transforms import SensorNoise, TrackGradient, conditions_named
from magrl.transforms.track import STD_KEYS

RECIPE = "fly.py"
ARRIVAL_KM = 400.0
"""Distance up to which the arrival threshold is 0.01; beyond, it falls so that arrival means as many kilometers."""


@dataclass(frozen=True)
class Config:
    """Settings of a flight."""

    start: tyro.conf.Positional[str]
    """Start, such as "60.4N 5.3E", "60.4, 5.3" or "-33.9 18.4"."""
    destination: tyro.conf.Positional[str]
    """Destination, such as a start, or by its magnetic elements: "D=-11.1 I=75.2 BH=13000" (deg, deg, nT)."""
    navigator: str = "anywhere"
    """Navigator: anywhere (the pretrained agent), anywhere=RUN (an own training), kalman, secant, or another one of
    recipes/evaluate.py."""
    noise: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Standard deviations of the noise on D [deg], I [deg], B_H [nT]."""
    conditions: str | None = None
    """Errors of a real vehicle instead of noise: laboratory, aircraft, ship, underwater or low-cost."""
    date: str = "2025-01-01"
    """Date of the field, 1900 to 2030 (IGRF-14)."""
    zeta: float | None = None
    """Arrival threshold on the objective (Eq. 2-7); by default 0.01, and less beyond 400 km: about 25 km around it."""
    max_steps: int | None = None
    """Moves after which the flight ends; by default three times the shortest path, and 20."""
    start_heading: float | Literal["random"] = "random"
    """Heading at the start, degrees from true north."""
    seed: int = 0
    """Random seed of the start heading and of the noise."""
    out: Path = Path("runs/fly")
    """Folder of flight.png and flight.json, which are replaced."""
    export: Path | None = None
    """File for the track: .geojson, .gpx or .kml."""
    animate: Path | None = None
    """File for an animation of the flight: .gif."""


class Watched(TensorDictModuleBase):
    """A navigator whose progress is shown, as a share of the shortest path [km]."""

    def __init__(self, navigator: TensorDictModuleBase, distance_km: float) -> None:
        super().__init__()
        self.navigator, self.in_keys, self.out_keys = navigator, navigator.in_keys, ["action"]
        form = "{percentage:3.0f}% |{bar:25}| {n:.0f} km of {total:.0f} km{postfix}"
        self.bar = tqdm(total=distance_km, bar_format=form, mininterval=0.2)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Show the distance flown, and the estimate of the way that is left with its standard deviation."""
        way, covariance = tensordict["way"][0].double(), tensordict["way_covariance"][0].double()
        left = way.norm()
        direction = way / left.clamp_min(1e-6)
        error = (direction @ covariance @ direction).clamp_min(0).sqrt()
        self.bar.set_postfix_str(f"estimated {left:.0f} ± {error:.0f} km to go", refresh=False)
        self.bar.update(min(tensordict["move"][0, 0].item(), self.bar.total - self.bar.n))
        return self.navigator(tensordict)


def places(config: Config, field: IGRF) -> tuple[Tensor, Tensor, float]:
    """Return start and destination ``(2,)`` [deg] and their distance [km].

    Raises:
        ValueError: for a place that cannot be read or found, or ends between which no flight is possible.
    """
    start, elements = parse_coordinates(config.start), parse_elements(config.destination)
    target = parse_coordinates(config.destination) if elements is None else find_elements(field, elements, start)
    distance_km = geodesic(*start, *target)[0].item()
    if math.isnan(distance_km):
        raise ValueError(f"{config.destination!r} is the antipode of the start, {config.start!r}: choose another one")
    if distance_km < 1:
        raise ValueError(f"start {config.start!r} and destination {config.destination!r} are the same place")
    check_declination(config.start, start, field)
    check_declination(config.destination, target, field)
    return start, target, distance_km


def check_settings(config: Config) -> None:
    """Raise unless noise, conditions and heading can be flown."""
    for level in config.noise:
        check_number(0, noise=level)
    if config.conditions and any(config.noise):
        raise ValueError(f"--conditions {config.conditions} hold the noise of the sensors: omit --noise")
    if config.start_heading != "random":
        check_number(-360, 360, start_heading=config.start_heading)


def check_files(config: Config) -> None:
    """Raise unless all files can be written."""
    if config.export:
        export.check_suffix(config.export)
    if config.animate and config.animate.suffix != ".gif":
        raise ValueError(f"an animation must end in .gif, got {config.animate}")
    for file in (config.out / "flight.png", config.out / "flight.json", config.export, config.animate):
        if file:
            check_writable(file)


def prepare(config: Config) -> tuple[TransformedEnv, Watched]:
    """Return the environment and the navigator, and check the files.

    Raises:
        UsageError: for anything that is wrong with the settings.
    """
    try:
        check_settings(config)
        conditions = conditions_named(config.conditions or "laboratory")
        drift_km = conditions.drift_km(50.0)
        field = IGRF(config.date)
        start, target, distance_km = places(config, field)
        region = region_around(start, target, field, 50.0 + drift_km)
        scenario = Scenario(region=region, margin_deg=0, field=field, tasks=Tasks(start[None], target[None]))
        base = GeomagneticNavEnv(
            scenario,
            max_steps=round(3 * distance_km / 50) + 20 if config.max_steps is None else config.max_steps,
            zeta=0.01 * min(1, ARRIVAL_KM / distance_km) ** 2 if config.zeta is None else config.zeta,
            start_heading="random",
            drift_km=drift_km,
            seed=config.seed,
        )
        track = TrackGradient(("field", "target_field", "move", "heading", *STD_KEYS), range_km=1000.0)
        noise, errors = config.noise, [SensorNoise(config.noise, seed=config.seed)]
        if config.conditions:
            noise, errors = conditions.sensor_std, conditions.transforms(config.seed)
        env = TransformedEnv(base, Compose(*errors, track))
        std = {"sensor_std": noise, "bias_std": conditions.bias_std}
        navigator = make_navigator(config.navigator, base, seed=config.seed, **std)
        check_files(config)
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from error
    return env, Watched(navigator, distance_km)


def rollout(env: TransformedEnv, navigator: Watched, start_heading: float | Literal["random"]) -> TensorDictBase:
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


def fly(config: Config) -> dict[str, Any]:
    """Fly, write the files and return the content of ``flight.json``.

    Raises:
        UsageError: for anything that is wrong with the settings, before anything is flown.
    """
    torchrl_logger.setLevel("WARNING")
    env, navigator = prepare(config)
    steps, base = rollout(env, navigator, config.start_heading), env.base_env
    measures = {key: value[0].item() for key, value in episode_measures(steps).items()}
    first, last = steps[0, 0], steps["next"][0, -1]
    failure = "left the region" if last["terminated"].item() else "reached the step limit"
    outcome = "arrived" if last["success"].item() else failure
    name = config.navigator.partition("=")[0]
    result = {
        **{key: value for key, value in asdict(config).items() if key not in ("out", "export", "animate")},
        "navigator": name,
        "needs": needs(name),
        "zeta": base.zeta,
        "max_steps": base.max_steps,
        **{key: first[key].tolist() for key in ("start_position", "target_position", "target_field")},
        "outcome": outcome,
        **measures,
    }
    write_json(config.out / "flight.json", result)
    title = f"{config.start} to {config.destination}: {name}, {outcome}, {measures['length_km']:.0f} km"
    trajectories_figure({title: steps}, base.field, base.region).savefig(config.out / "flight.png", dpi=120)
    if config.export:
        export.write_tracks(config.export, export.tracks(steps, [title], navigator=name))
    if config.animate:
        write_gif(config.animate, steps, base.field, base.region, title)
    return result


def summary(result: dict[str, Any]) -> str:
    """Return the result of a flight as text."""
    noise = "{:g} deg, {:g} deg, {:g} nT".format(*result["noise"]) if any(result["noise"]) else "none"
    noise = f"conditions {result['conditions']}" if result["conditions"] else noise
    ends = ["{:.2f}, {:.2f}".format(*result[key]) for key in ("start_position", "target_position")]
    rows = {
        "outcome": result["outcome"],
        "navigator": f"{result['navigator']}, which needs {result['needs']} beside its readings",
        "noise": noise,
        "start": ends[0],
        "destination": f"{ends[1]}, {elements_text(torch.tensor(result['target_field']))}",
        "steps": f"{result['steps']} of at most {result['max_steps']}",
        "path": f"{result['length_km']:.0f} km; the shortest is {result['shortest_km']:.0f} km",
        "efficiency": f"{100 * result['path_efficiency']:.1f} %",
        "distance left": f"{result['navigation_error_km']:.1f} km",
    }
    return "\n".join(f"{name:14}{text}" for name, text in rows.items())


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line, fly and print the summary."""
    words = sys.argv[1:] if args is None else args
    spaced = [f" {word}" if word[:1] == "-" and word[1:2].isdigit() else word for word in words]  # "-33.9 18.4"
    config = tyro.cli(Config, args=spaced, prog=RECIPE, description=__doc__)
    config = replace(config, start=config.start.strip(), destination=config.destination.strip())
    print(summary(fly(config)))
    print(f"The picture is {config.out / 'flight.png'}")


if __name__ == "__main__":
    command(RECIPE, main)
