"""Navigators by name, trained or not: as commands take them, and as tables and figures label them."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from tensordict.nn import TensorDictModuleBase

from magrl.agents import FieldPolicy, load_policy
from magrl.agents.pretrained import load_pretrained
from magrl.checks import check_type
from magrl.envs import GeomagneticNavEnv
from magrl.field import Date
from magrl.navigators import METAHEURISTICS, NAVIGATOR_CLASSES, NAVIGATORS, Navigator
from magrl.transforms import TrackView

TRAINED = ("gg_td3", "gg_td3_noise", "td3", "recurrent", "anywhere", "policy")
"""Names of trained agents, which take a run folder; ``anywhere`` without one is the pretrained policy."""
OWN = "policy"
"""Name of a policy of any algorithm, which takes its file or a folder with ``policy.pt``, and after ``:`` a label."""
PRETRAINED = ("anywhere",)
"""Names of trained agents that come with the library."""
DEFAULT_ZETA = 0.01
"""Arrival threshold of an evaluation without runs."""

NAVIGATOR_NAMES = {
    "gg_td3": "Gradient-Guided TD3",
    "gg_td3_noise": "Gradient-Guided TD3, trained with noise",
    "td3": "TD3",
    "recurrent": "recurrent TD3",
    "anywhere": "anywhere",
    "policy": "own policy",
    "ga": "GA",
    "pso": "PSO",
    "afsa": "AFSA",
    "secant": "secant",
    "parallel": "parallel",
    "kalman": "Kalman",
    "mean_jacobian": "mean Jacobian",
    "geodesic": "geodesic",
    "run_and_tumble": "run and tumble",
    "map_matching": "map matching",
}
"""Label of each navigator in figures."""

_DETAILED_NAMES = NAVIGATOR_NAMES | {
    "recurrent": "recurrent TD3 (the paper's eight numbers)",
    "anywhere": "anywhere (TD3 on random planets)",
    "secant": "secant (quasi-Newton)",
    "parallel": "parallel (true gradient, an oracle)",
    "kalman": "Kalman (dual control)",
    "mean_jacobian": "mean Jacobian (quasi-Newton)",
    "map_matching": "map matching (Kalman filter)",
    "geodesic": "geodesic (both positions, an oracle)",
}
"""Label of each navigator in tables."""


def make_navigator(
    text: str,
    env: GeomagneticNavEnv,
    mode: str = "look-ahead",
    seed: int = 0,
    noise: tuple[float, float, float] = (0.0, 0.0, 0.0),
    map_date: Date | None = None,
    bias: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> TensorDictModuleBase:
    """Return the navigator that a text such as ``secant``, ``pso:flown`` or ``gg_td3=RUN`` names.

    Args:
        text: name; after ``=`` the run folder of a trained agent, or the file of a policy; after ``:`` the mode of a
            metaheuristic, or the label of a policy, as in ``policy:SAC=sac.pt``.
        env: environment that it navigates in.
        mode: mode of a metaheuristic without one in ``text``.
        seed: random seed of a metaheuristic.
        noise: standard deviations of the sensors, D [deg], I [deg], B_H [nT], for navigators that weigh their readings.
        map_date: date of the map of ``map_matching``, from IGRF; None for the environment's own field.
        bias: standard deviations of constant and slow errors of the sensors, for navigators that tell them from noise.
            Agents read both from the TensorDict, and all others are told the root of the sum of the squares as noise.

    Raises:
        ValueError: for an unknown name, a trained agent without a run or trained in another field, a run or a mode for
            a navigator that takes none, or an unknown mode.
        FileNotFoundError: for a run without a policy.

    Example:
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> make_navigator("pso:flown", env).oracle, make_navigator("parallel", env).oracle
        (False, True)
    """
    check_type(str, text=text)
    name, _, run = text.partition("=")
    name, _, own_mode = name.partition(":")
    if name in TRAINED and (not own_mode or name == OWN):
        if not run and name not in PRETRAINED:
            file = " or the file of a policy" if name == OWN else ""
            raise ValueError(f"{name} needs the folder of a finished run{file}: {name}=RUN")
        path = Path(run) if name == OWN and not Path(run).is_dir() else Path(run) / "policy.pt"
        policy = load_policy(path, env.device) if run else load_pretrained(name, env.device)
        # one that reads its own track is told what counts as arrived
        if isinstance(policy, FieldPolicy) and isinstance(view := policy.config.view, TrackView):
            view = replace(view, zeta=env.zeta, search=env.arrival.rule == "objective")
            policy = FieldPolicy(replace(policy.config, view=view), policy.actor).to(env.device)
        try:
            policy.check_fits(env)
        except ValueError as error:
            raise ValueError(f"{text}: {error}") from error
        return policy
    if name in METAHEURISTICS and not run:
        return METAHEURISTICS[name](env, own_mode or mode, seed)
    if name in NAVIGATORS and not run and not own_mode:
        if name == "kalman":
            return NAVIGATORS[name](env, mode, seed, noise, bias=bias).to(env.device)
        options = {"map_date": map_date} if name == "map_matching" else {}
        return NAVIGATORS[name](env, mode, seed, tuple(map(math.hypot, noise, bias)), **options).to(env.device)
    trained_names = [f"{trained}=RUN" for trained in TRAINED if trained != OWN]
    known = ", ".join([*PRETRAINED, *trained_names, "policy:NAME=FILE", *NAVIGATORS, *METAHEURISTICS])
    raise ValueError(f"unknown navigator {text!r}: choose from {known}")


def needs(name: str, default_mode: str = "look-ahead") -> str:
    """Return what a navigator needs beside its readings and the sensors' data sheet, for a column of a table.

    Args:
        name: name without a run, for example ``pso`` or ``pso:flown``.
        default_mode: mode of a metaheuristic without one in ``name``.

    Raises:
        ValueError: for an unknown name.

    Example:
        >>> needs("secant"), needs("mean_jacobian"), needs("td3")
        ('nothing', 'a map of the region', 'training in the region')
        >>> needs("pso"), needs("pso:flown"), needs("policy:SAC")
        ('the field at other places', 'nothing', 'training')
    """
    base, _, mode = name.partition(":")
    label(base)  # raises for an unknown name
    if base in METAHEURISTICS:
        return "the field at other places" if (mode or default_mode) == "look-ahead" else Navigator.needs
    if base == OWN:
        return "training"
    if base in PRETRAINED:  # trained on planets that share only the spectrum of the field
        return Navigator.needs
    return "training in the region" if base in TRAINED else NAVIGATOR_CLASSES[base].needs


def label(name: str, default_mode: str = "look-ahead") -> str:
    """Return the label of a navigator in tables, which says how a metaheuristic reads the field.

    Args:
        name: name without a run, for example ``pso``, ``pso:flown`` or ``policy:SAC``.
        default_mode: mode of a metaheuristic without one in ``name``.

    Raises:
        ValueError: for an unknown name.

    Example:
        >>> label("pso"), label("ga:flown"), label("policy:SAC")
        ('PSO, look-ahead (an oracle)', 'GA, flown', 'SAC')
    """
    base, _, mode = name.partition(":")
    if base not in _DETAILED_NAMES:
        raise ValueError(f"unknown navigator {name!r}: choose from {', '.join(_DETAILED_NAMES)}")
    if base not in METAHEURISTICS:
        return mode if base == OWN and mode else _DETAILED_NAMES[base]
    look_ahead = (mode or default_mode) == "look-ahead"
    return _DETAILED_NAMES[base] + (", look-ahead (an oracle)" if look_ahead else ", flown")


def check_distinct(texts: Sequence[str], default_mode: str = "look-ahead") -> None:
    """Raise if a navigator is given twice, or the pretrained agent beside own runs under its name.

    Neither is a spread over runs.

    Args:
        texts: navigators, as :func:`make_navigator` takes them.
        default_mode: mode of metaheuristics without one in their text.

    Raises:
        ValueError: naming the text.

    Example:
        >>> check_distinct(["gg_td3=runs/A", "gg_td3=runs/B", "ga", "ga:flown"])
        >>> check_distinct(["td3=runs/A", "td3=runs/A/"])
        Traceback (most recent call last):
        ValueError: td3=runs/A/ is given twice: the same episodes again are no spread over runs
    """
    seen: set[object] = set()
    for text in texts:
        name, _, run = text.partition("=")
        base, _, mode = name.partition(":")
        key = Path(run).resolve() if run else (base, mode or (default_mode if base in METAHEURISTICS else ""))
        if key in seen:
            raise ValueError(f"{text} is given twice: the same episodes again are no spread over runs")
        if run and base in PRETRAINED and base in texts:
            raise ValueError(f"{text} has the name of the pretrained {base}: write policy:LABEL={run}")
        seen.add(key)


def check_map_date(texts: Sequence[str], map_date: Date | None) -> None:
    """Raise if the date of a map is given without the navigator that has a map.

    Args:
        texts: navigators, as :func:`make_navigator` takes them.
        map_date: date of the map, or None.

    Raises:
        ValueError: with the date.

    Example:
        >>> check_map_date(["secant", "map_matching"], "2015-01-01")
        >>> check_map_date(["secant"], "2015-01-01")
        Traceback (most recent call last):
        ValueError: --map-date 2015-01-01 is the date of the map of map_matching: add that navigator, or omit the date
    """
    if map_date is not None and "map_matching" not in texts:
        raise ValueError(
            f"--map-date {map_date} is the date of the map of map_matching: add that navigator, or omit the date"
        )


def arrival_threshold(texts: Sequence[str], zeta: float | None = None) -> tuple[float, list[str]]:
    """Return the arrival threshold of an evaluation, and what a reader of its results must know about the runs.

    Args:
        texts: navigators, as :func:`make_navigator` takes them.
        zeta: threshold that was chosen; None for that of the runs, or 0.01 where none of them states one.

    Returns:
        The threshold, and a sentence for each run that was trained with another threshold or is not finished.

    Raises:
        ValueError: for runs with different thresholds if none was chosen, or a damaged ``config.json``.

    Example:
        >>> arrival_threshold(["secant", "td3=runs/nowhere"])
        (0.01, ['runs/nowhere is not a finished training: it holds no eval.json'])
    """
    named = (text.partition("=") for text in texts)
    runs = [Path(run) for name, _, run in named if name.partition(":")[0] in TRAINED and run]
    runs = [run for run in runs if not run.is_file()]  # the file of a policy belongs to no run
    trained = {run: known for run in runs if (known := _trained_zeta(run)) is not None}
    if zeta is None:
        examples = {known: run for run, known in trained.items()}
        if len(examples) > 1:
            listed = ", ".join(f"{known:g} ({run})" for known, run in examples.items())
            raise ValueError(f"the runs were trained with different arrival thresholds, {listed}: choose with --zeta")
        zeta = next(iter(examples), DEFAULT_ZETA)
    warnings = [
        f"{run} was trained with zeta {known:g} and is evaluated with zeta {zeta:g}"
        for run, known in trained.items()
        if known != zeta
    ]
    unfinished = [run for run in runs if not (run / "eval.json").is_file()]
    return zeta, warnings + [f"{run} is not a finished training: it holds no eval.json" for run in unfinished]


def _trained_zeta(run: Path) -> float | None:
    """Return the arrival threshold with which a run was trained, or None where its folder does not state it."""
    path = run / "config.json"
    if not path.is_file():
        return None
    try:
        zeta = json.loads(path.read_text()).get("zeta")
        return None if zeta is None else float(zeta)
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is not the configuration of a run: {error}") from error
