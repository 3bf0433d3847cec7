"""Tables of trained agents, from the folders of runs and the evaluations of recipes/evaluate.py."""

from __future__ import annotations

import csv
import glob
import json
import math
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from magrl import paper
from magrl.evaluation.navigators import label, needs
from magrl.evaluation.runs import Noise
from magrl.evaluation.tables import INTERVALS, Summary, known_values, markdown_table, mean_of_runs

sys.path.insert(0, str(Path(__file__).parent.parent))
import evaluate

PUBLISHED = paper.TABLE_2["gg_td3"]
RESULTS = {
    "SR %": ("success_rate", ".1f"),
    "SPL %": ("spl", ".2f"),
    "SPL, smallest–largest %": ("range", ".2f"),
    "TL m": ("trajectory_length_m", ".0f"),
    "TNT steps": ("steps", ".2f"),
    "path efficiency %": ("path_efficiency", ".2f"),
    "NE km": ("navigation_error_km", ".1f"),
    "within 10 km %": ("success_rate_within_10km", ".1f"),
    "training s": ("training_seconds", ".0f"),
    "to 97 / 88.4 s": ("seconds_to_97_sr_88_spl", ".0f"),
}
LEARNING = ("frames to SR 90 %", "frames to SR 97 %, SPL 88.4 %", "mean SR over training %", "last SPL %")
CURVES = ("moves", "episodes", "moves to SR 90 %", "highest SR %", "SR %", "SPL %", "steps", "training s")
LAST = 5
"""Number of evaluations that a row of :func:`curves` is the mean of."""
Curve = dict[str, np.ndarray]


def matching(pattern: str) -> list[str]:
    """Return the paths that a pattern names, in natural order.

    Raises:
        FileNotFoundError: for a pattern without a match.
    """
    found = sorted(glob.glob(pattern), key=lambda path: (len(path), path))
    if not found:
        raise FileNotFoundError(f"there is no {pattern}: train it by make tables")
    return found


def expanded(navigators: Sequence[str]) -> tuple[str, ...]:
    """Return navigators with each pattern of runs as one navigator for each run."""
    split = [text.partition("=") for text in navigators]
    return tuple(
        f"{name}={run}" if run else name for name, _, runs in split for run in (matching(runs) if runs else [""])
    )


# Evaluations


def evaluated(folder: Path, navigators: Sequence[str], **options: Any) -> Path:
    """Return a folder of recipes/evaluate.py, which is replaced."""
    shutil.rmtree(folder, ignore_errors=True)
    evaluate.evaluate(evaluate.Config(navigators=expanded(navigators), out=folder, **options))
    return folder


def evaluation(
    navigators: Sequence[str], *, folder: str, scenario: str | None = None, short: bool = False, **options: Any
) -> str:
    """Return the table of recipes/evaluate.py, or its short one, from results in a folder, which is replaced."""
    evaluated(Path(folder), navigators, scenario=scenario and Path(scenario), **options)
    return (Path(folder) / ("short.md" if short else "table.md")).read_text()


def short(folder: str) -> str:
    """Return the short table of an evaluation that was made before."""
    return (Path(folder) / "short.md").read_text()


def noise_levels(navigators: Sequence[str], levels: Sequence[Noise], *, folder: str, tasks: Any = None) -> str:
    """Return SR and SPL of navigators at several levels of noise, interquartile means over their runs.

    The results are in a folder for each level, which is replaced.
    """
    by_level = {}
    for noise in levels:
        folder = evaluated(Path(f"{folder}-{noise[0]:g}"), navigators, noise=tuple(map(float, noise)), tasks=tasks)
        by_level[level_name(noise)] = json.loads((folder / "summary.json").read_text())
    first = next(iter(by_level.values()))
    rows = [
        [label(name), needs(name), len(runs), *(rate_and_spl(found[name]) for found in by_level.values())]
        for name, runs in first.items()
    ]
    return markdown_table(["navigator", "needs", "runs", *by_level], rows)


def level_name(noise: Noise) -> str:
    """Return a level of noise as text."""
    return "no noise" if not any(noise) else "{:g}°, {:g}°, {:g} nT".format(*noise)


def rate_and_spl(runs: Sequence[Summary]) -> str:
    """Return SR and SPL of the runs of a navigator."""
    measures = ([run[key] for run in runs] for key in ("success_rate", "spl"))
    return " / ".join(mean_of_runs(values, form=".1f", interval=False) for values in measures)


# Runs


def results(runs: Mapping[str, str], *, together: bool = False) -> str:
    """Return a row for each group of finished runs below the paper's, and one of all of them together."""
    groups = {
        name: [json.loads((Path(run) / "eval.json").read_text()) for run in matching(pattern)]
        for name, pattern in runs.items()
    }
    rows = [
        ["paper", *result_cells([PUBLISHED._asdict()])],
        *([name, *result_cells(group)] for name, group in groups.items()),
    ]
    if together:
        rows.append(["together", *result_cells(*groups.values())])
    return markdown_table(["", "runs", *RESULTS], rows)


def result_cells(*strata: Sequence[Summary]) -> list[str]:
    """Return the number of runs and their measures; a group is resampled by itself."""
    spl = known_values(run.get("spl") for runs in strata for run in runs)
    cells = [str(sum(map(len, strata)))]
    for key, form in RESULTS.values():
        if key == "range":
            cells.append(f"{min(spl):{form}}–{max(spl):{form}}" if len(spl) > 1 else "—")
        else:
            values = ([run.get(key) for run in runs] for runs in strata)
            cells.append(mean_of_runs(*values, form=form, interval=key in INTERVALS))
    return cells


def read_curves(run: str) -> Curve:
    """Return the columns of ``train.csv`` in a run folder."""
    with (Path(run) / "train.csv").open() as file:
        rows = list(csv.DictReader(file))
    if not rows:
        raise ValueError(f"{run}/train.csv has no rows: the training did not reach its first evaluation")
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]}


def first_frames(curve: Curve, success: float, spl: float = 0.0) -> float:
    """Return the frames at which a success rate and an SPL are first reached together; NaN if never."""
    reached = (curve["eval_success_rate"] >= success) & (curve["eval_spl"] >= spl)
    return float(curve["frames"][reached.argmax()]) if reached.any() else math.nan


def mean_success(curve: Curve) -> float:
    """Return the mean success rate over a training that begins with 0 [%]."""
    frames, success = (np.concatenate(([0.0], curve[name])) for name in ("frames", "eval_success_rate"))
    return float(np.trapezoid(success, frames) / frames[-1])


def reached(values: Sequence[float], form: str) -> str:
    """Return the average of the finite values over runs, and how many runs never reached the threshold."""
    never = sum(not math.isfinite(value) for value in values)
    if never == len(values):
        return "never"
    return mean_of_runs(values, form=form) + (f", {never} of {len(values)} never" if never else "")


def learning(runs: Mapping[str, str]) -> str:
    """Return how fast trainings learn on the validation tasks, interquartile means over the runs of each name."""
    rows = []
    for name, pattern in runs.items():
        found = [read_curves(run) for run in matching(pattern)]
        columns = (
            ([first_frames(curve, 90) for curve in found], ".0f"),
            ([first_frames(curve, PUBLISHED.success_rate, round(PUBLISHED.spl, 1)) for curve in found], ".0f"),
            ([mean_success(curve) for curve in found], ".1f"),
            ([float(curve["eval_spl"][-1]) for curve in found], ".2f"),
        )
        rows.append([name.removeprefix("policy:"), len(found), *(reached(*column) for column in columns)])
    return markdown_table(["", "runs", *LEARNING], rows)


def curves(runs: Mapping[str, str], *, moves: float = math.inf) -> str:
    """Return a row for each training, complete or not; SR, SPL and steps are means over its last five evaluations.

    With ``moves``, curves are cut after so many moves, to compare trainings of different lengths.
    """
    rows = []
    for name, run in runs.items():
        whole = read_curves(run)
        curve = {key: values[whole["frames"] <= moves] for key, values in whole.items()}
        success = curve["eval_success_rate"]
        means = [float(np.nanmean(curve[f"eval_{key}"][-LAST:])) for key in ("success_rate", "spl", "steps")]
        ends = [f"{curve[key][-1]:.0f}" for key in ("frames", "episodes", "seconds")]
        cells = [*ends[:2], reached([first_frames(curve, 90)], ".0f"), f"{success.max():.1f}"]
        rows.append([name, *cells, *(f"{mean:.1f}" if math.isfinite(mean) else "—" for mean in means), ends[2]])
    return markdown_table(["", *CURVES], rows)
