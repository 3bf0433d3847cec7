"""Compare navigators on the same tasks, as in Section 4.4 of the paper.

    python recipes/evaluate.py secant parallel                                  # without training
    python recipes/evaluate.py gg_td3=runs/A gg_td3=runs/B td3=runs/C ga pso:flown --out runs/comparison
    python recipes/evaluate.py secant --scenario my.toml --export tracks.kml    # own tasks, tracks for a map

Trained agents are given with their run folders; several runs of one name are averaged, with their standard deviation.
An agent that was trained with another arrival threshold, or is not finished, is marked by a warning below the table.
Metaheuristics evaluate candidate moves in one of two modes, `--mode` or a suffix such as `ga:flown`: `look-ahead` reads
the field at the end of every candidate for free (an oracle), `flown` makes every candidate a move.

Writes episodes.csv, runs.csv, paths.csv (the paper's example task), summary.json, table.md and short.md.
"""

from __future__ import annotations

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # spinning threads slow each other down; read when torch is imported

import csv
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl import torchrl_logger
from tqdm import tqdm

from magrl.checks import check_number
from magrl.envs import GeomagneticNavEnv, Scenario, Tasks, load_scenario, named_tasks
from magrl.envs.tasks import RANDOM_SETS
from magrl.evaluation import episode_measures, evaluation_rollout, export, summarize
from magrl.evaluation.metrics import first_episode_mask
from magrl.evaluation.navigators import arrival_threshold, check_distinct, make_navigator
from magrl.evaluation.tables import comparison_table, short_table
from magrl.files import check_writable, write_json
from magrl.training import UsageError, command
from magrl.training.loggers import WandbMode, WandbRun, check_logger
from magrl.training.run_folder import create_run_folder

RECIPE = "evaluate.py"
TaskSet = Literal["test-1000", "paper-100", "figure-4-1"]
MEASURES = ("success", "steps", "shortest_km", "length_km", "navigation_error_km", "spl")
MEASURES += ("smoothness_deg", "heading_mae_deg", "heading_rmse_deg")


@dataclass(frozen=True)
class Config:
    """Settings of an evaluation."""

    navigators: tyro.conf.Positional[tuple[str, ...]]
    """Navigators: gg_td3=RUN, td3=RUN, recurrent=RUN, ga, pso, afsa, secant, parallel."""
    tasks: TaskSet | None = None
    """Frozen task set; the scenario's own tasks by default, or test-1000 where it has none."""
    scenario: Path | None = None
    """TOML or JSON file of an own region, date, altitude and tasks (docs/own_data.md); the paper's by default."""
    export: Path | None = None
    """File for the tracks of all episodes: .geojson, .gpx or .kml."""
    mode: Literal["look-ahead", "flown"] = "look-ahead"
    """How metaheuristics evaluate a candidate move."""
    zeta: float | None = None
    """Arrival threshold on the objective (Eq. 2-7); that of the runs by default, 0.01 without runs."""
    seed: int = 0
    """Random seed of metaheuristics."""
    out: Path = Path("runs/evaluation")
    """Folder of the results, new or empty."""
    wandb_mode: WandbMode = "offline"
    """Mode of wandb: offline needs no network and no login, disabled writes nothing."""


@dataclass
class Results:
    """Rows of the files that an evaluation writes."""

    summaries: dict[str, list[dict[str, float]]] = field(default_factory=dict)
    runs: list[dict[str, Any]] = field(default_factory=list)
    episodes: list[dict[str, Any]] = field(default_factory=list)
    paths: list[dict[str, Any]] = field(default_factory=list)
    tracks: list[export.Track] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


def choose_tasks(path: Path | None, tasks: str | None) -> Scenario:
    """Return a scenario with frozen tasks.

    Args:
        path: scenario file; the paper's scenario by default.
        tasks: task set; by default the scenario's own tasks, or ``test-1000`` where it has none.

    Raises:
        ValueError: for a file that is not a scenario, or the paper's example task in another scenario.
        FileNotFoundError: for a missing file.
    """
    if path is None:
        return Scenario().with_tasks(named_tasks(tasks or "test-1000"))
    if tasks == "figure-4-1":
        raise ValueError("--tasks figure-4-1 lies in the paper's region: omit it, or --scenario")
    scenario = load_scenario(path)
    if scenario.tasks is not None and tasks is None:
        return scenario
    return scenario.with_tasks(scenario.random_tasks(*RANDOM_SETS[tasks or "test-1000"]))


def first_tasks(scenario: Scenario, num_tasks: int) -> Scenario:
    """Return a scenario with its first tasks only.

    Raises:
        ValueError: for fewer than one task, or more than it has.
    """
    assert scenario.tasks is not None
    check_number(1, len(scenario.tasks.start), whole=True, num_tasks=num_tasks)
    tasks = Tasks(*(end[:num_tasks] for end in scenario.tasks))
    return scenario.replace(tasks=tasks, names=scenario.names[:num_tasks])


def make_env(scenario: Scenario, zeta: float, seed: int) -> GeomagneticNavEnv:
    """Return an environment with one vehicle for each frozen task."""
    assert scenario.tasks is not None
    return GeomagneticNavEnv(scenario, num_envs=len(scenario.tasks.start), zeta=zeta, seed=seed)


def path_rows(name: str, rollout: TensorDictBase) -> list[dict[str, float | str]]:
    """Return the first episode of a rollout, one row per step, for Figs. 4-4 and 4-5."""
    count = int(first_episode_mask(rollout["next", "done"]).sum(1)[0])
    states = [rollout[0, 0], *(rollout["next"][0, step] for step in range(count))]
    return [
        {
            "navigator": name,
            "step": step,
            **dict(zip(("latitude", "longitude"), state["position"].tolist(), strict=True)),
            **dict(zip(("D", "I", "B_H"), state["field"].tolist(), strict=True)),
            "L": state["move"][0].item(),
        }
        for step, state in enumerate(states)
    ]


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows with the columns of the first."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def prepare(
    config: Config,
) -> tuple[GeomagneticNavEnv, GeomagneticNavEnv, list[tuple[TensorDictModuleBase, ...]], list[str]]:
    """Return the environment, that of the example task, each navigator for both, and warnings; create the folder.

    Raises:
        UsageError: for anything that is wrong with the settings.
    """
    if not config.navigators:
        raise UsageError("name at least one navigator, for example: secant")
    try:
        check_logger("wandb", config.wandb_mode)
        if config.export:
            export.check_suffix(config.export)
        check_distinct(config.navigators, config.mode)
        zeta, warnings = arrival_threshold(config.navigators, config.zeta)
        scenario = choose_tasks(config.scenario, config.tasks)
        example = first_tasks(scenario, 1) if config.scenario else Scenario().with_tasks(named_tasks("figure-4-1"))
        envs = [make_env(place, zeta, config.seed) for place in (scenario, example)]
        navigators = [
            tuple(make_navigator(text, env, config.mode, config.seed) for env in envs) for text in config.navigators
        ]
        if config.export:
            check_writable(config.export)
        check_writable(create_run_folder(config.out) / "summary.json")
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from error
    return (*envs, navigators, warnings)


def evaluate(config: Config) -> dict[str, list[dict[str, float]]]:
    """Fly every navigator, write the results and return the summaries by navigator.

    Raises:
        UsageError: for anything that is wrong with the settings, before anything is flown.
    """
    torchrl_logger.setLevel("WARNING")
    env, example_env, navigators, warnings = prepare(config)
    names = env.scenario.names or tuple(f"task {number}" for number in range(env.num_envs))
    results = Results(warnings=warnings)
    for text, (navigator, example) in zip(tqdm(config.navigators, unit="navigator"), navigators, strict=True):
        name, _, run = text.partition("=")
        began = time.perf_counter()
        rollout = evaluation_rollout(env, navigator)
        measured = episode_measures(rollout)
        readings = getattr(navigator, "field_readings", torch.zeros(1)).double().mean().item()
        summary = summarize(measured) | {"field_readings": readings, "seconds": time.perf_counter() - began}
        number = len(results.summaries.setdefault(name, []))
        results.summaries[name].append(summary)
        results.runs.append({"navigator": name, "run": number, "source": Path(run).name, **summary})
        columns = {key: measured[key].tolist() for key in MEASURES}
        results.episodes += [
            {"navigator": name, "run": number, "task": task, **{key: columns[key][task] for key in MEASURES}}
            for task in range(env.num_envs)
        ]
        if config.export:
            results.tracks += export.tracks(rollout, names, navigator=name, run=number)
        if number == 0:
            results.paths += path_rows(name, evaluation_rollout(example_env, example))
    write(config, env.zeta, results)
    return results.summaries


def write(config: Config, zeta: float, results: Results) -> None:
    """Write the files of the results, and the runs as a table in wandb."""
    for name in ("episodes", "runs", "paths"):
        write_csv(config.out / f"{name}.csv", getattr(results, name))
    write_json(config.out / "summary.json", results.summaries)
    notes = "".join(f"\nWarning: {text}.\n" for text in results.warnings)
    (config.out / "table.md").write_text(comparison_table(results.summaries, config.mode) + notes)
    (config.out / "short.md").write_text(short_table(results.summaries, config.mode) + notes)
    if config.export:
        export.write_tracks(config.export, results.tracks)
    scenario = config.scenario and config.scenario.name
    settings = {"tasks": config.tasks, "scenario": scenario, "zeta": zeta, "mode": config.mode}
    settings |= {"seed": config.seed}
    run = WandbRun(config.out, config.wandb_mode, settings, "evaluation", list(results.summaries))
    run.table("eval/navigators", results.runs)
    run.close()


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line, evaluate and print the table."""
    config = tyro.cli(Config, args=args, prog=RECIPE, description=__doc__)
    evaluate(config)
    print((config.out / "table.md").read_text())
    print(f"Results are in {config.out}")


if __name__ == "__main__":
    command(RECIPE, main)
