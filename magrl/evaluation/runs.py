"""How agents were trained, from the settings in their run folders, so that an evaluation flies them in the same way."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from magrl.checks import check_type
from magrl.evaluation.navigators import OWN, TRAINED

Value = TypeVar("Value")
Noise = tuple[float, float, float]
NO_NOISE: Noise = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class TrainedRun:
    """Settings of a training that an evaluation shares, from ``config.json`` of its folder.

    Example:
        >>> TrainedRun(Path("runs/A"), "gg_td3").start_heading
        'north'
    """

    folder: Path
    kind: str | None
    """Name of the agent among the navigators, or None for that of another recipe."""
    start_heading: str = "north"
    noise: Noise = NO_NOISE
    """Standard deviations of the sensors' noise on D [deg], I [deg], B_H [nT]."""
    scenario: Path | None = None
    """Scenario file in the folder, or None for the paper's."""


def run_config(folder: Path) -> dict[str, Any]:
    """Return the settings that a training left in its folder.

    Raises:
        FileNotFoundError: for a folder without a run.
        ValueError: for a file that does not hold settings.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> _ = (folder / "config.json").write_text('{"zeta": 0.01}')
        >>> run_config(folder)
        {'zeta': 0.01}
    """
    check_type(Path, folder=folder)
    path = folder / "config.json"
    if not path.is_file():
        raise FileNotFoundError(f"there is no run at {folder}: it must hold config.json and policy.pt")
    try:
        return dict(json.loads(path.read_text()))
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path} is not the configuration of a run: {error}") from error


def read_run(folder: Path) -> TrainedRun:
    """Return how the agent of a run folder was trained.

    Raises:
        FileNotFoundError: for a folder without a run, or without the scenario that it names.
        ValueError: for settings that are not those of a run.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> _ = (folder / "config.json").write_text('{"guided": false, "start_heading": "random"}')
        >>> run = read_run(folder)
        >>> run.kind, run.start_heading, run.noise
        ('td3', 'random', (0.0, 0.0, 0.0))
    """
    settings = run_config(folder)
    try:
        kinds: dict[Any, str] = {True: "gg_td3", False: "td3"}
        guided = kinds.get(settings.get("guided"))
        kind = {"td3_recurrent.py": "recurrent", "td3_anywhere.py": "anywhere"}.get(settings.get("recipe", ""), guided)
        first, second, third = (float(level) for level in settings.get("noise", NO_NOISE))
        scenario = folder / Path(settings["scenario"]).name if settings.get("scenario") else None
    except (TypeError, ValueError) as error:
        raise ValueError(f"{folder / 'config.json'} is not the configuration of a run: {error}") from error
    if scenario is not None and not scenario.is_file():
        raise FileNotFoundError(f"{folder} was trained in its scenario file {scenario.name}, which is missing there")
    return TrainedRun(folder, kind, str(settings.get("start_heading", "north")), (first, second, third), scenario)


def trained_runs(texts: Sequence[str]) -> list[TrainedRun]:
    """Return the runs among navigators such as ``td3=RUN``, except folders that hold a policy and no settings.

    Raises:
        ValueError: for an agent under the name of another kind, or damaged settings.
        FileNotFoundError: as :func:`read_run`.

    Example:
        >>> trained_runs(["secant", "td3=runs/nowhere"])
        []
    """
    runs = []
    for text in texts:
        name, _, folder = text.partition("=")
        name = name.partition(":")[0]
        if name in TRAINED and (Path(folder) / "config.json").is_file():
            run = read_run(Path(folder))
            if name != OWN and run.kind in TRAINED and run.kind != name.removesuffix("_noise"):
                raise ValueError(f"{folder} was trained as {run.kind}, not {name}: write {run.kind}={folder}")
            runs.append(run)
    return runs


def agreed(
    runs: Sequence[TrainedRun],
    setting: Callable[[TrainedRun], Value],
    chosen: Value | None,
    default: Value,
    *,
    name: str,
    option: str,
) -> tuple[Value, list[str]]:
    """Return the value of a setting in an evaluation, and what a reader of its results must know about the runs.

    Args:
        runs: trained agents.
        setting: function that returns the setting of a run.
        chosen: value that was chosen; None for that of the runs.
        default: value without runs.
        name: what the setting is, in messages.
        option: option that chooses it.

    Returns:
        The value, and a sentence for each run that was trained with another.

    Raises:
        ValueError: for runs that differ if none was chosen.

    Example:
        >>> runs = [TrainedRun(Path("a"), "td3"), TrainedRun(Path("b"), "td3", "random")]
        >>> agreed(runs, lambda run: run.start_heading, "north", "north", name="heading", option="--start-heading")
        ('north', ['b was trained with heading random and is evaluated with north'])
    """
    trained = [(run.folder, setting(run)) for run in runs]
    if chosen is None:
        examples: dict[Value, Path] = {}
        for folder, value in trained:
            examples.setdefault(value, folder)
        if len(examples) > 1:
            listed = ", ".join(f"{_said(value)} ({folder})" for value, folder in examples.items())
            raise ValueError(f"the runs were trained with different {name}, {listed}: choose with {option}")
        chosen = next(iter(examples), default)
    return chosen, [
        f"{folder} was trained with {name} {_said(value)} and is evaluated with {_said(chosen)}"
        for folder, value in trained
        if value != chosen
    ]


def common_scenario(runs: Sequence[TrainedRun], chosen: Path | None = None) -> tuple[Path | None, list[str]]:
    """Return the scenario file of an evaluation, or None for the paper's scenario, and notes as :func:`agreed`.

    Args:
        runs: trained agents.
        chosen: file that was chosen; None for that of the runs.

    Raises:
        ValueError: for runs of different scenarios if none was chosen.

    Example:
        >>> common_scenario([TrainedRun(Path("a"), "td3")])
        (None, [])
    """
    content = {run.scenario: run.scenario.read_text() if run.scenario else "" for run in runs}
    if chosen is not None:
        wanted = chosen.read_text() if chosen.is_file() else None  # who reads the scenario reports a missing file
        return chosen, [
            f"{run.folder} was trained in {_place(run)}, and is evaluated in that of {chosen.name}"
            for run in runs
            if wanted is not None and content[run.scenario] != wanted
        ]
    examples = {content[run.scenario]: run for run in runs}
    if len(examples) > 1:
        listed = ", ".join(f"{run.folder} in {_place(run)}" for run in examples.values())
        raise ValueError(f"the runs were trained in different scenarios, {listed}: choose with --scenario")
    return (runs[0].scenario if runs else None), []


def _place(run: TrainedRun) -> str:
    return f"the scenario {run.scenario.name} of its folder" if run.scenario else "the paper's scenario"


def _said(value: object) -> str:
    return " ".join(f"{x:g}" for x in value) if isinstance(value, tuple) else str(value)
