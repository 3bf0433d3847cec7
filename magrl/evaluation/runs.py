"""Settings of trained agents from their run folders, so that evaluations use the same."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from magrl.evaluation.navigators import OWN, WITH_RUN, parse_navigator
from magrl.files import read_document

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
    errors: Noise = NO_NOISE
    """Standard deviations of the sensors' noise on D [deg], I [deg], B_H [nT]."""
    scenario: Path | None = None
    """Scenario file in the folder, or None for the paper's."""
    zeta: float = 0.01
    """Arrival threshold on the objective."""


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
        >>> run.kind, run.start_heading, run.errors
        ('td3', 'random', (0.0, 0.0, 0.0))
    """
    path = folder / "config.json"
    if not path.is_file():
        raise FileNotFoundError(f"there is no run at {folder}: it must hold config.json and policy.safetensors")
    try:
        settings = dict(read_document(path))
        kinds: dict[Any, str] = {True: "gg_td3", False: "td3"}
        guided = kinds.get(settings.get("guided"))
        kind = "anywhere" if settings.get("recipe") == "ppo_anywhere.py" else guided
        first, second, third = (float(level) for level in settings.get("noise", NO_NOISE))
        scenario = folder / Path(settings["scenario"]).name if settings.get("scenario") else None
        zeta = float(settings.get("zeta", 0.01))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path} is not the configuration of a run: {error}") from error
    if scenario is not None and not scenario.is_file():
        raise FileNotFoundError(f"{folder} was trained in its scenario file {scenario.name}, which is missing there")
    heading, noise = str(settings.get("start_heading", "north")), (first, second, third)
    return TrainedRun(folder, kind, heading, noise, scenario, zeta)


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
    for name, _, folder in map(parse_navigator, texts):
        if name in WITH_RUN and (Path(folder) / "config.json").is_file():
            run = read_run(Path(folder))
            if name != OWN and run.kind in WITH_RUN and run.kind != name.removesuffix("_noise"):
                raise ValueError(f"{folder} was trained as {run.kind}, not {name}: write {run.kind}={folder}")
            runs.append(run)
    return runs


def unfinished(texts: Sequence[str]) -> list[str]:
    """Return a sentence for each run folder among navigators such as ``td3=RUN`` whose training is not finished.

    Example:
        >>> unfinished(["secant", "td3=runs/nowhere"])
        ['runs/nowhere is not a finished training: it holds no eval.json']
    """
    folders = (Path(source) for name, _, source in map(parse_navigator, texts) if name in WITH_RUN and source)
    open_runs = (folder for folder in folders if not folder.is_file() and not (folder / "eval.json").is_file())
    return [f"{folder} is not a finished training: it holds no eval.json" for folder in open_runs]


def agreed(runs: Sequence[TrainedRun], setting: str, chosen: Any, default: Any) -> tuple[Any, list[str]]:
    """Return the value of a setting in an evaluation, and a sentence for each run that was trained with another.

    Scenario files agree if their content does.

    Args:
        runs: trained agents.
        setting: attribute of :class:`TrainedRun`, whose option on the command line has the same name.
        chosen: value that was chosen; None for that of the runs.
        default: value without runs.

    Raises:
        ValueError: for runs that differ if none was chosen.

    Example:
        >>> runs = [TrainedRun(Path("a"), "td3"), TrainedRun(Path("b"), "td3", "random")]
        >>> agreed(runs, "start_heading", "north", "north")
        ('north', ['b was trained with start heading random and is evaluated with north'])
    """
    name, trained = setting.replace("_", " "), [(run.folder, getattr(run, setting)) for run in runs]
    if chosen is None:
        examples: dict[object, str] = {}
        for folder, value in trained:
            examples.setdefault(_content(value), f"{_text(value)} ({folder})")
        if len(examples) > 1:
            listed, option = ", ".join(examples.values()), f"--{setting.replace('_', '-')}"
            raise ValueError(f"the runs were trained with different {name}, {listed}: choose with {option}")
        chosen = trained[0][1] if trained else default
    return chosen, [
        f"{folder} was trained with {name} {_text(value)} and is evaluated with {_text(chosen)}"
        for folder, value in trained
        if _content(value) != _content(chosen)
    ]


def _content(value: object) -> object:
    return value.read_text() if isinstance(value, Path) and value.is_file() else value


def _text(value: object) -> str:
    if isinstance(value, tuple):
        return " ".join(f"{x:g}" for x in value)
    return "of the paper" if value is None else value.name if isinstance(value, Path) else str(value)
