"""Flies navigators over the same tasks and measures them: the paper's Section 4.4, as a command.

    python recipes/evaluate.py secant parallel                          # no training needed
    python recipes/evaluate.py gg_td3=runs/A gg_td3=runs/B td3=runs/C ga pso:flown --out runs/comparison
    python recipes/evaluate.py secant --world my.toml --export flights.kml   # your own tasks, onto a map

A trained agent is named with its run folder; several runs of one name are averaged, and their spread is shown.
Metaheuristics take `--mode look-ahead` (the field at every candidate's end is read for free: an oracle) or
`--mode flown` (every candidate is a move), or have it behind their name. Writes episodes.csv, runs.csv, summary.json,
table.md and short.md, and paths.csv of the paper's example task.
"""

from __future__ import annotations

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")

import csv
import json
import math
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
import tyro
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl import torchrl_logger
from tqdm import tqdm

from magrl import export, recurrent, td3
from magrl.checks import check_number
from magrl.env import GeomagneticNavEnv
from magrl.loggers import WandbMode, WandbRun
from magrl.metaheuristics import METAHEURISTICS
from magrl.metrics import episode_measures, flown, summarise
from magrl.navigators import NAVIGATORS
from magrl.plots import NAVIGATOR_NAMES
from magrl.runs import create_run_folder
from magrl.tasks import RANDOM_SETS, Tasks, named_tasks
from magrl.worlds import World, load_world

TRAINED = {"gg_td3": td3.load_policy, "td3": td3.load_policy, "recurrent": recurrent.load_policy}
LABELS = NAVIGATOR_NAMES | {
    "recurrent": "recurrent TD3 (the paper's eight numbers)",
    "secant": "secant (no training, fair)",
    "parallel": "parallel (true gradient, an oracle)",
}
PAPER = {  # Table 2: SR %, TL m, SPL %, TNT steps
    "gg_td3": (97, 445564.313, 88.4119, 21.757),
    "td3": (89, 511983.904, 73.6277, 22.093),
    "ga": (51, 443360.591, 47.0986, 22.534),
    "pso": (29, 442495.161, 27.0941, 21.031),
    "afsa": (77, 515649.380, 63.6267, 35.560),
}
MEASURES = ("success", "steps", "shortest_km", "length_km", "navigation_error_km", "spl")
MEASURES += ("smoothness_deg", "heading_mae_deg", "heading_rmse_deg")


@dataclass(frozen=True)
class Config:
    """What is flown, over what, and where the results go."""

    navigators: tyro.conf.Positional[tuple[str, ...]]
    """gg_td3=RUN, td3=RUN, recurrent=RUN, ga, pso, afsa, parallel, secant; as many as wanted."""
    tasks: Literal["test-1000", "paper-100", "figure-4-1"] | None = None
    """A frozen task set; by default the world's own tasks, and test-1000 where there are none."""
    world: Path | None = None
    """TOML or JSON file of an own region, date, altitude and tasks (docs/own_data.md); by default the paper's."""
    export: Path | None = None
    """File of all journeys: .geojson, .gpx or .kml."""
    mode: Literal["look-ahead", "flown"] = "look-ahead"
    """How metaheuristics evaluate a candidate."""
    zeta: float = 0.01
    """Arrival threshold on the objective."""
    seed: int = 0
    """Of navigators that draw random numbers."""
    out: Path = Path("runs/evaluation")
    """Folder of the results; refused if it holds anything."""
    wandb_mode: WandbMode = "offline"
    """offline needs neither network nor login, disabled writes nothing of wandb."""


def navigator(text: str, env: GeomagneticNavEnv, mode: str, seed: int) -> TensorDictModuleBase:
    """A navigator from its name on the command line.

    Raises:
        ValueError: for an unknown name, a trained agent without a run, one that was trained in another place, or a run
            where none belongs.
    """
    name, _, run = text.partition("=")
    name, _, own_mode = name.partition(":")
    makers: dict[str, Callable[..., TensorDictModuleBase]] = {**NAVIGATORS, **METAHEURISTICS}
    if name in TRAINED:
        if not run:
            raise ValueError(f"{name} needs the folder of a finished run: {name}=RUN")
        policy = TRAINED[name](Path(run) / "policy.pt")
        try:
            td3.check_fits(policy.config, env)
        except ValueError as error:
            raise ValueError(f"{text}: {error}") from error
        return policy
    if name not in makers or run or (own_mode and name not in METAHEURISTICS):
        raise ValueError(f"unknown navigator {text!r}: choose from {'=RUN, '.join(TRAINED)}=RUN, {', '.join(makers)}")
    return makers[name](env, own_mode or mode, seed)


def make_env(config: Config, tasks: str) -> GeomagneticNavEnv:
    """The environment of a task set: one vehicle for each task."""
    return env_of(config, World(), named_tasks(tasks))


def env_of(config: Config, world: World, tasks: Tasks) -> GeomagneticNavEnv:
    """An environment with one vehicle for each task."""
    options = world.options()
    return GeomagneticNavEnv(num_envs=len(tasks.start), tasks=tasks, zeta=config.zeta, seed=config.seed, **options)


def first(tasks: Tasks, count: int) -> Tasks:
    """The first so many of a list of tasks.

    Raises:
        ValueError: for a number of tasks that the list does not hold.
    """
    check_number(1, len(tasks.start), whole=True, num_tasks=count)
    return Tasks(*(end[:count] for end in tasks))


def journeys(world_file: Path | None, tasks: str | None) -> tuple[World, Tasks]:
    """Where to fly, and what: the world's tasks, else 1000 random ones there; or a named set of the paper's region.

    Raises:
        ValueError: for a world that is none, or the paper's one task in it.
    """
    if world_file is None:
        return World(), named_tasks(tasks or "test-1000")
    if tasks == "figure-4-1":
        raise ValueError("--tasks figure-4-1 lies in the paper's region: leave it out, or --world")
    world = load_world(world_file)
    own = world.tasks if tasks is None else None
    return world, own or world.random_tasks(*RANDOM_SETS[tasks or "test-1000"])


def envs(config: Config) -> tuple[GeomagneticNavEnv, GeomagneticNavEnv, Sequence[str]]:
    """Where all navigators fly, where they fly one example, and the names of the tasks.

    Raises:
        ValueError: see :func:`journeys`.
    """
    world, tasks = journeys(config.world, config.tasks)
    example = first(tasks, 1) if config.world else named_tasks("figure-4-1")
    names = world.names if tasks is world.tasks else [f"task {number}" for number in range(len(tasks.start))]
    return env_of(config, world, tasks), env_of(config, world, example), names


def path_rows(label: str, rollout: TensorDictBase) -> list[dict[str, float | str]]:
    """The first journey of a rollout, a row a step, for Figs. 4-4 and 4-5."""
    count = int(flown(rollout["next", "done"]).sum(1)[0])
    states = [rollout[0, 0], *(rollout["next"][0, step] for step in range(count))]
    return [
        {
            "navigator": label,
            "step": step,
            "latitude": state["position"][0].item(),
            "longitude": state["position"][1].item(),
            "D": state["field"][0].item(),
            "I": state["field"][1].item(),
            "B_H": state["field"][2].item(),
            "L": state["move"][0].item(),
        }
        for step, state in enumerate(states)
    ]


def write_csv(path: Path, rows: list[dict]) -> None:
    """Rows with the columns of the first."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def spread(values: list[float], form: str) -> str:
    """A mean, with the standard deviation over runs where there are several; a dash where no run has a value."""
    known = [value for value in values if math.isfinite(value)]
    if not known:
        return "—"
    text = format(statistics.fmean(known), form)
    return text if len(known) == 1 else f"{text} ± {format(statistics.stdev(known), form)}"


def cell(results: list[dict[str, float]], key: str, form: str) -> str:
    """A measure: its spread over runs, or, of one run, its 95 % interval over tasks where the measure has one."""
    text = spread([result[key] for result in results], form)
    if len(results) > 1 or f"{key}_low" not in results[0]:
        return text
    low, high = (format(results[0][f"{key}_{end}"], form) for end in ("low", "high"))
    return f"{text} ({low}–{high})"


def label(name: str, default_mode: str) -> str:
    """A navigator as a reader should know it: a metaheuristic with its mode, an oracle called one."""
    base, _, mode = name.partition(":")
    if base not in METAHEURISTICS:
        return LABELS[base]
    return LABELS[base] + (", look-ahead (an oracle)" if (mode or default_mode) == "look-ahead" else ", flown")


def table(summaries: dict[str, list[dict[str, float]]], mode: str) -> str:
    """The paper's Table 2, its row beside ours, and the measures of Fig. 4-6."""
    lines = [
        "| navigator | runs | SR % | TL m | SPL % | TNT steps | NE km | smoothness ° | MAE ° | RMSE ° "
        "| within 10 km % | within 25 km % | readings |",
        "|---" * 13 + "|",
    ]
    for name, results in summaries.items():
        base = name.partition(":")[0]
        if base in PAPER and not any(f"{LABELS[base]}, paper" in line for line in lines):
            sr, tl, spl, tnt = PAPER[base]
            lines.append(f"| {LABELS[base]}, paper | 1 | {sr} | {tl:.0f} | {spl:.1f} | {tnt:.1f} |" + " — |" * 7)
        columns = {"success_rate": ".1f", "trajectory_length_m": ".0f", "spl": ".2f", "steps": ".2f"}
        columns |= {"navigation_error_km": ".1f", "smoothness_deg": ".1f", "heading_mae_deg": ".1f"}
        columns |= {"heading_rmse_deg": ".1f", "success_rate_within_10km": ".1f", "success_rate_within_25km": ".1f"}
        columns["field_readings"] = ".0f"
        cells = (cell(results, key, form) for key, form in columns.items())
        lines.append(f"| {label(name, mode)} | {len(results)} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def short_table(summaries: dict[str, list[dict[str, float]]], mode: str) -> str:
    """What a reader wants first, without the paper's rows."""
    columns = {"SR %": ("success_rate", ".1f"), "SPL %": ("spl", ".1f"), "TNT steps": ("steps", ".1f")}
    columns |= {"NE km": ("navigation_error_km", ".1f")}
    lines = ["| navigator | " + " | ".join(columns) + " |", "|---" * (1 + len(columns)) + "|"]
    for name, results in summaries.items():
        cells = (spread([result[key] for result in results], form) for key, form in columns.values())
        lines.append(f"| {label(name, mode)} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def evaluate(config: Config) -> dict[str, list[dict[str, float]]]:
    """Flies every navigator and writes the results.

    Raises:
        ValueError: for an unknown navigator, or none.
    """
    torchrl_logger.setLevel("WARNING")
    if not config.navigators:
        raise ValueError("name at least one navigator, for example: secant")
    if config.export:
        export.check_suffix(config.export)
    env, example, names = envs(config)
    makers = [(text.partition("=")[0], text) for text in config.navigators]
    pairs = [[navigator(text, e, config.mode, config.seed) for e in (env, example)] for _, text in makers]
    folder = create_run_folder(config.out)
    summaries: dict[str, list[dict[str, float]]] = {}
    episodes, runs, paths, flights = [], [], [], []
    for (name, text), (pilot, example_pilot) in zip(tqdm(makers, unit="navigator"), pairs, strict=True):
        began = time.perf_counter()
        rollout = td3.evaluation_rollout(env, pilot)
        measured = episode_measures(rollout)
        readings = getattr(pilot, "field_readings", torch.zeros(1)).double().mean().item()
        summary = summarise(measured) | {"field_readings": readings, "seconds": time.perf_counter() - began}
        number = len(summaries.setdefault(name, []))
        summaries[name].append(summary)
        runs.append({"navigator": name, "run": number, "source": Path(text.partition("=")[2]).name, **summary})
        columns = {key: measured[key].tolist() for key in MEASURES}
        episodes += [
            {"navigator": name, "run": number, "task": task, **{key: columns[key][task] for key in MEASURES}}
            for task in range(env.num_envs)
        ]
        if config.export:
            flights += export.flights(rollout, names, navigator=name, run=number)
        if number == 0:
            paths += path_rows(name, td3.evaluation_rollout(example, example_pilot))
    for file, rows in (("episodes", episodes), ("runs", runs), ("paths", paths)):
        write_csv(folder / f"{file}.csv", rows)
    (folder / "summary.json").write_text(json.dumps(summaries, indent=2) + "\n")
    text = table(summaries, config.mode)
    (folder / "table.md").write_text(text)
    (folder / "short.md").write_text(short_table(summaries, config.mode))
    if config.export:
        export.write_flights(config.export, flights)
    place = {"tasks": config.tasks, "world": config.world and config.world.name}
    settings = {**place, "zeta": config.zeta, "mode": config.mode, "seed": config.seed}
    run = WandbRun(folder, config.wandb_mode, settings, "evaluation", list(summaries))
    run.table("eval/navigators", runs)
    run.close()
    return summaries


if __name__ == "__main__":
    settings = tyro.cli(Config, description=__doc__)
    try:
        print(table(evaluate(settings), settings.mode))
    except (ValueError, FileNotFoundError, FileExistsError) as error:
        sys.exit(f"evaluate.py: {error}")
    print(f"the results are in {settings.out}")
