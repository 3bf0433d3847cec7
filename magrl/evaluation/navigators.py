"""Navigators by name, trained or not: as commands take them, and as tables and figures label them."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

from tensordict.nn import TensorDictModuleBase

from magrl.agents import load_policy
from magrl.checks import check_type
from magrl.envs import GeomagneticNavEnv
from magrl.navigators import METAHEURISTICS, NAVIGATORS

TRAINED = ("gg_td3", "td3", "recurrent")
"""Names of trained agents; each needs a run folder."""
DEFAULT_ZETA = 0.01
"""Arrival threshold of an evaluation without runs."""

NAVIGATOR_NAMES = {
    "gg_td3": "Gradient-Guided TD3",
    "td3": "TD3",
    "recurrent": "recurrent TD3",
    "ga": "GA",
    "pso": "PSO",
    "afsa": "AFSA",
    "secant": "secant",
    "parallel": "parallel",
}
"""Label of each navigator in figures."""

_DETAILED_NAMES = NAVIGATOR_NAMES | {
    "recurrent": "recurrent TD3 (the paper's eight numbers)",
    "secant": "secant (no training, fair)",
    "parallel": "parallel (true gradient, an oracle)",
}


def make_navigator(text: str, env: GeomagneticNavEnv, mode: str = "look-ahead", seed: int = 0) -> TensorDictModuleBase:
    """Return the navigator that a text such as ``secant``, ``pso:flown`` or ``gg_td3=RUN`` names.

    Args:
        text: name; after ``=`` the run folder of a trained agent; after ``:`` the mode of a metaheuristic.
        env: environment that it navigates in.
        mode: mode of a metaheuristic without one in ``text``.
        seed: random seed of a metaheuristic.

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
    if name in TRAINED and not own_mode:
        if not run:
            raise ValueError(f"{name} needs the folder of a finished run: {name}=RUN")
        policy = load_policy(Path(run) / "policy.pt", device=env.device)
        try:
            policy.check_fits(env)
        except ValueError as error:
            raise ValueError(f"{text}: {error}") from error
        return policy
    makers: dict[str, Callable[..., TensorDictModuleBase]] = {**NAVIGATORS, **METAHEURISTICS}
    if name not in makers or run or (own_mode and name not in METAHEURISTICS):
        raise ValueError(f"unknown navigator {text!r}: choose from {'=RUN, '.join(TRAINED)}=RUN, {', '.join(makers)}")
    return makers[name](env, own_mode or mode, seed)


def label(name: str, default_mode: str = "look-ahead") -> str:
    """Return the label of a navigator in tables, which says how a metaheuristic reads the field.

    Args:
        name: name without a run, for example ``pso`` or ``pso:flown``.
        default_mode: mode of a metaheuristic without one in ``name``.

    Raises:
        ValueError: for an unknown name.

    Example:
        >>> label("pso"), label("ga:flown")
        ('PSO, look-ahead (an oracle)', 'GA, flown')
    """
    base, _, mode = name.partition(":")
    if base not in NAVIGATOR_NAMES:
        raise ValueError(f"unknown navigator {name!r}: choose from {', '.join(NAVIGATOR_NAMES)}")
    if base not in METAHEURISTICS:
        return _DETAILED_NAMES[base]
    look_ahead = (mode or default_mode) == "look-ahead"
    return _DETAILED_NAMES[base] + (", look-ahead (an oracle)" if look_ahead else ", flown")


def check_distinct(texts: Sequence[str], default_mode: str = "look-ahead") -> None:
    """Raise if a navigator is given twice: the same episodes twice are no spread over runs.

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
        seen.add(key)


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
    runs = [Path(run) for name, _, run in named if name in TRAINED and run]
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
