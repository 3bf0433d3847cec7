"""Cost of a step by number of vehicles, and a training: `python -m benchmarks.accelerator --device cuda --seconds 60`.

Prints a Markdown table of microseconds per vehicle, the speed of a training and the name of the device. A part that
does not fit into memory is left out. The training is Gradient-Guided TD3 by its recipe, preset fast.
"""

from __future__ import annotations

import argparse
import importlib
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from magrl import pilot
from magrl.envs import GeomagneticNavEnv
from magrl.pilot.belief import moved, read
from magrl.pilot.destination import destination, posterior
from magrl.transforms.track import reading_of

import torch

VEHICLES = (1024, 16_384, 262_144)
FRAMES = 20_480
_SHARE = 0.4  # of the seconds, in which parts are timed; the others are for first calls and the training


def microseconds(part: Callable[[], object], vehicles: int, device: torch.device, seconds: float) -> float | None:
    """Return the time of a part for each vehicle [µs], the best of some seconds after a call that is not counted; None
    for a part that does not fit into memory."""
    wait = torch.cuda.synchronize if device.type == "cuda" else lambda: None
    times: list[float] = []
    try:
        with torch.no_grad():
            part()
            while not times or sum(times) < seconds:
                wait()
                begun = time.perf_counter()
                part()
                wait()
                times.append(time.perf_counter() - begun)
    except RuntimeError as error:  # that of memory on a GPU, too
        if "memory" not in str(error).lower():
            raise
        return None
    return 1e6 * min(times) / vehicles


def parts(vehicles: int, device: torch.device) -> dict[str, Callable[[], object]]:
    """Return the parts of a step by name; what they read is made at their first call."""
    env = GeomagneticNavEnv(num_envs=vehicles, seed=0, device=device)
    state = env.rand_action(env.reset())
    rules = pilot.Rules(**env.limits)
    first = reading_of(state)
    after = reading_of(env.step(state)["next"])
    track = pilot.begin(rules, first)
    belief, std = track.state.belief, after.std.noise
    goal = destination(belief, after.target, rules.range_km)
    declared = rules.replace(arrival="declared")
    return {
        "environment: step": lambda: env.step(state),
        "environment: start of an episode": lambda: env.reset(),
        "belief: leg and reading": lambda: read(moved(belief, after.distance, after.heading), after.field, std),
        "posterior of the destination": lambda: posterior(goal),
        "track: belief, posterior and plan": lambda: pilot.advance(rules, track.state, after),
        "declaration of the arrival": lambda: pilot.declaring(declared, track, after, track.plan),
    }


def table(vehicles: Sequence[int], device: torch.device, seconds: float) -> str:
    """Return the Markdown table of all parts, measured in about some seconds."""
    lines = ["| µs per vehicle | " + " | ".join(map(str, vehicles)) + " |", "|---|" + "---|" * len(vehicles)]
    rows: dict[str, list[str]] = {}
    for number in vehicles:
        functions = parts(number, device)
        for name, part in functions.items():
            cost = microseconds(part, number, device, seconds / len(functions) / len(vehicles))
            rows.setdefault(name, []).append("–" if cost is None else f"{cost:.3g}")
    return "\n".join([*lines, *(f"| {name} | " + " | ".join(values) + " |" for name, values in rows.items())]) + "\n"


def training(device: torch.device, frames: int) -> str:
    """Return the speed of a training as a line of text."""
    sys.path.insert(0, str(Path(__file__).parent.parent / "recipes"))
    recipe = importlib.import_module("td3_gradient_guided")
    with tempfile.TemporaryDirectory() as folder:
        options = {"total_frames": frames, "eval_every": 10**6, "eval_trips": 10, "eval_trips_small": 10}
        config = recipe.PRESETS["fast"].replace(
            **options, wandb_mode="disabled", device=str(device), out=Path(folder) / "run"
        )
        seconds = recipe.train(config)["training_seconds"]
    return (
        f"training, {frames} frames of {config.num_envs} vehicles: {seconds:.1f} s, {frames / seconds:.0f} frames/s\n"
    )


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line and print the results."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.accelerator", description=__doc__)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--vehicles", type=int, nargs="+", default=VEHICLES)
    parser.add_argument("--seconds", type=float, default=60.0, help="about how long all takes on a GPU")
    parser.add_argument("--frames", type=int, default=FRAMES, help="frames of the training; 0 for none")
    chosen = parser.parse_args(args)
    device = torch.device(chosen.device)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.machine()
    print(f"{name}, torch {torch.__version__}", flush=True)
    print(table(chosen.vehicles, device, _SHARE * chosen.seconds), flush=True)
    if chosen.frames:
        print(training(device, chosen.frames))


if __name__ == "__main__":
    main()
