"""Navigators by name, trained or not: as commands take them, and as tables and figures label them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from tensordict.nn import TensorDictModuleBase

from magrl.agents import load_policy
from magrl.checks import check_type
from magrl.envs import GeomagneticNavEnv
from magrl.navigators import METAHEURISTICS, NAVIGATORS

TRAINED = ("gg_td3", "td3", "recurrent")
"""Names of trained agents; each needs a run folder."""

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
