"""Compare navigators on the same trips, as in Section 4.4 of the paper.

    python recipes/evaluate.py secant parallel                                  # without training
    python recipes/evaluate.py runs/A runs/B runs/C ga pso --out runs/comparison    # agents by their run folders
    python recipes/evaluate.py secant --scenario my.toml                            # own trips
    python recipes/evaluate.py secant runs/A --trips 300 --trips-seed 7 --errors 0.05 0.05 5
    python recipes/evaluate.py kalman parallel --errors ship                    # errors of a real vehicle
    python recipes/evaluate.py kalman --errors 0.05 0.05 5 --north magnetic     # without a true-north reference
    python recipes/evaluate.py secant kalman --arrival distance --radius-km 25 --max-steps 80 --altitude-km -3
    python recipes/evaluate.py SAC=sac.onnx secant                              # a policy of another algorithm

A file or run folder says what its agent is, and runs of the same are one row. By default, scenario, arrival threshold,
start heading and sensor noise are as in the training, from the file of the policy. If the runs differ in one of these,
give its option. A line below the table names the settings that an option overrides. Metaheuristics read the field at
the end of every candidate leg for free (an oracle).

Prints the main measures. Writes episodes.csv, runs.csv, paths.csv (the paper's example trip), summary.json,
settings.json, table.md (all measures) and trajectories.png (the first trips of each navigator).
"""

from __future__ import annotations

import csv
import io
import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from magrl.envs import load_scenario, named_trips
from magrl.envs.scenario import RULES
from magrl.evaluation import Flight, Sheet, episode_measures, summarize
from magrl.evaluation.episodes import first_episode_mask, with_true_field
from magrl.evaluation.maps import trajectories_figure
from magrl.evaluation.options import ScenarioOptions, TripSet, choose_trips, first_trips
from magrl.evaluation.tables import comparison_table, short_table
from magrl.files import check_writable, write_json, write_text, write_with
from magrl.navigators.names import NAMES, Kind, check_distinct, named, training_settings
from magrl.training import UsageError, command, parse
from magrl.training.checkpoints import create_run_folder

import tyro
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl import torchrl_logger
from tqdm import tqdm
from typing_extensions import Doc

RECIPE = "evaluate.py"
SHOWN = 24
"""Number of trips in trajectories.png."""
FILES = "Trained agents and policies of any algorithm by run folder or file: PATH, or LABEL=PATH for one's own label."
Pair = tuple[TensorDictModuleBase, ...]


def free_folder() -> Path:
    """Return the first of runs/evaluation, runs/evaluation-2, ... that is not there."""
    names = itertools.chain(("evaluation",), (f"evaluation-{number}" for number in itertools.count(2)))
    return next(path for path in map(Path("runs").joinpath, names) if not path.exists())


@dataclass(frozen=True)
class Config:
    """Settings of an evaluation."""

    navigators: tyro.conf.Positional[Annotated[tuple[str, ...], Doc(f"Navigators: {', '.join(NAMES)}. {FILES}")]]
    trips: TripSet | int | None = None
    """Frozen trip set, or number of random trips; by default the scenario's own trips, or test-1000."""
    trips_seed: int | None = None
    """Seed of random trips, disjoint from the trips of trainings and of frozen sets; 0 by default."""
    scenario: Path | None = None
    """Scenario file (.toml or .json) of region, date and trips (docs/data.md); by default the runs' or the paper's."""
    rules: tyro.conf.OmitArgPrefixes[ScenarioOptions] = ScenarioOptions()
    """Rules of the episodes and altitude; by default those of the scenario's file or of the trainings."""
    sheet: tyro.conf.OmitArgPrefixes[Sheet] = Sheet(errors=None, confidence=0.5)
    """Errors of the vehicles, and what they know."""
    seed: int = 0
    """Random seed of metaheuristics, sensor noise and random start headings."""
    device: str = "cpu"
    """Device of the flights: cpu, cuda, cuda:0, ..."""
    out: Path = field(default_factory=free_folder)
    """Folder of the results, new or empty; by default the first free one of runs/evaluation, runs/evaluation-2, ..."""


@dataclass
class Results:
    """Rows of the files that an evaluation writes."""

    summaries: dict[Kind, list[dict[str, float]]] = field(default_factory=dict)
    runs: list[dict[str, Any]] = field(default_factory=list)
    episodes: list[dict[str, Any]] = field(default_factory=list)
    paths: list[dict[str, Any]] = field(default_factory=list)
    rollouts: dict[str, TensorDictBase] = field(default_factory=dict)


def path_rows(name: str, rollout: TensorDictBase) -> list[dict[str, float | str]]:
    """Return the first episode of a rollout, one row per step with the true field, for Figs. 8 and 9."""
    rollout = with_true_field(rollout)
    count = int(first_episode_mask(rollout["next", "done"]).sum(1)[0])
    states = [rollout[0, 0], *(rollout["next"][0, step] for step in range(count))]
    values = ([*state["position"].tolist(), *state["field"].tolist(), state["leg"][0].item()] for state in states)
    names = ("latitude", "longitude", "D", "I", "B_H", "L")
    return [{"navigator": name, "step": step} | dict(zip(names, row, strict=True)) for step, row in enumerate(values)]


def with_training_settings(config: Config) -> tuple[Config, list[str]]:
    """Return the settings, where none were chosen the scenario's or else the trainings', and notes.

    Raises:
        ValueError: for trainings that differ in a setting that was not chosen.
        FileNotFoundError: for a missing file.
    """
    changes = config.rules.model_dump(exclude_none=True)
    chosen = {name: changes.get(name) for name in ("zeta", "start_heading")}
    chosen |= {"scenario": config.scenario, "errors": config.sheet.errors}
    if config.scenario:
        own = load_scenario(config.scenario, **changes)
        chosen |= {name: own.given(name) for name in ("zeta", "start_heading")}
    settings, notes = training_settings(config.navigators, **chosen)
    if config.trips == "paper-example":  # which lies in the paper's region
        settings["scenario"] = config.scenario
    known = {"rules": config.rules.taking(settings), "sheet": config.sheet.taking(settings)}
    return replace(config, **known, **settings), notes


def prepare(config: Config) -> tuple[Config, list[Flight], list[Pair], list[str]]:
    """Make environments and navigators, and the folder of the results.

    Returns:
        Settings with the trainings'; flights of the trips and of the example trip; each navigator for both;
        notes.

    Raises:
        UsageError: for anything that is wrong with the settings.
    """
    if not config.navigators:
        raise UsageError("name at least one navigator, for example: secant")
    try:
        check_distinct(config.navigators)
        config, notes = with_training_settings(config)
        changes = config.rules.model_dump(exclude_none=True)
        scenario = choose_trips(config.scenario, config.trips, config.trips_seed, **changes)
        example = first_trips(scenario, 1) if config.scenario else scenario.with_trips(named_trips("paper-example"))
        options = {"seed": config.seed, "device": config.device}
        flights = [Flight(trips, config.sheet, **options) for trips in (scenario, example)]
        navigators = [tuple(flight.navigator(text) for flight in flights) for text in config.navigators]
        check_writable(create_run_folder(config.out) / "summary.json")
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from error
    return config, flights, navigators, notes


def evaluate(config: Config) -> str:
    """Fly every navigator, write the results and return the main measures as a table, with notes below it.

    Raises:
        UsageError: for anything that is wrong with the settings, before anything is flown.
    """
    torchrl_logger.setLevel("WARNING")
    config, (flight, example_flight), navigators, notes = prepare(config)
    results = Results()
    for text, (navigator, example) in zip(tqdm(config.navigators, unit="navigator"), navigators, strict=True):
        kind, source, _ = named(text)
        name, run = kind.name, source.name if source else ""
        began = time.perf_counter()
        rollout = flight.fly(navigator).cpu()
        measured = episode_measures(rollout)
        readings = getattr(navigator, "readings_per_step", 0) * measured["steps"].double().mean().item()
        summary = summarize(measured) | {"field_readings": readings, "seconds": time.perf_counter() - began}
        number = len(results.summaries.setdefault(kind, []))
        results.summaries[kind].append(summary)
        results.runs.append({"navigator": name, "run": number, "source": run, **summary})
        columns = {key: values.tolist() for key, values in measured.items()}
        results.episodes += [
            {"navigator": name, "run": number, "trip": trip, **{key: column[trip] for key, column in columns.items()}}
            for trip in range(flight.base.num_envs)
        ]
        if number == 0:
            results.rollouts[kind.description] = rollout[:SHOWN].clone()
            results.paths += path_rows(name, example_flight.fly(example).cpu())
    below = text_below(flight, notes)
    write(config, flight, results, below)
    return short_table(results.summaries) + below


def settings(config: Config, flight: Flight) -> dict[str, Any]:
    """Return what was flown and how, without a path of this machine."""
    given, env = map(named, config.navigators), flight.base
    return {
        "navigators": [f"{kind.name}={source.name}" if source else kind.name for kind, source, _ in given],
        "num_trips": env.num_envs,
        "trips_seed": (config.trips_seed or 0) if isinstance(config.trips, int) else None,
        "scenario": config.scenario and config.scenario.name,
        "trips": config.trips,
        "seed": config.seed,
        **flight.sheet.model_dump(),
        **env.scenario.model_dump(include={*RULES, "altitude_km"}),
    }


def text_below(flight: Flight, notes: Sequence[str]) -> str:
    """Return what is written below a table: the vehicles' rule of arrival, their data sheet, and notes."""
    rules, known = flight.base.scenario, Sheet.lines(flight.sheet.model_dump())
    sure = f", at a probability of {flight.sheet.confidence:g}" * rules.declared
    arrival = [f"Arrival: {rules.arrival}, within {rules.radius_km:g} km{sure}"] * (rules.arrival != "objective")
    return "".join(f"\n{line}.\n" for line in (*arrival, *known, *(f"Note: {note}" for note in notes)))


def write(config: Config, flight: Flight, results: Results, below: str) -> None:
    """Write the files of the results; the text below is of the table."""
    env = flight.base.to("cpu")
    for name, rows in (("episodes", results.episodes), ("runs", results.runs), ("paths", results.paths)):
        text = io.StringIO()
        writer = csv.DictWriter(text, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
        write_text(config.out / f"{name}.csv", text.getvalue())
    write_json(config.out / "summary.json", {kind.name: runs for kind, runs in results.summaries.items()})
    write_json(config.out / "settings.json", settings(config, flight))
    whole = comparison_table(results.summaries, published=not config.scenario)
    write_text(config.out / "table.md", whole + below)
    figure = trajectories_figure(results.rollouts, env.field, env.region, names=env.scenario.names)
    write_with(config.out / "trajectories.png", figure.savefig, dpi=120)


def main(args: Sequence[str] | None = None) -> None:
    """Read the command line, evaluate and print the table."""
    config = parse(Config, RECIPE, __doc__, args)
    print(evaluate(config), f"Results, and a table of all measures, are in {config.out}", sep="\n")


if __name__ == "__main__":
    command(RECIPE, main)
