"""Navigators by name, trained or not: as commands take them, and as tables and figures label them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any, NamedTuple

from tensordict.nn import TensorDictModuleBase

from magrl.agents import kalman, load_policy
from magrl.agents.pretrained import load_pretrained
from magrl.checks import check_type
from magrl.envs import GeomagneticNavEnv
from magrl.field import Date
from magrl.navigators import NAVIGATORS, Navigator
from magrl.sensor_std import PERFECT, SensorStd
from magrl.transforms import TrackView


class TrainedAgent(NamedTuple):
    """Labels of a kind of trained agent in figures and tables, what it was trained on, and its ``needs``, as in
    :class:`Navigator`."""

    label: str
    description: str
    trained_on: str = "the region"
    needs: str = Navigator.needs
    options: tuple[str, ...] = ()


OWN = "policy"
"""Name of policies of any algorithm, given by a file or a folder with ``policy.safetensors``, and a label."""
PRETRAINED = ("anywhere", "kalman")
"""Names of the agents in the library; ``kalman`` has no network."""
SPECTRUM = "the field's spectrum"
"""What agents without a map need: their belief has the spectrum of the Earth's field as its prior."""
UNTRAINED = "nothing"
"""What a navigator without training was trained on."""
TRAINED = {
    "gg_td3": TrainedAgent("Gradient-Guided TD3", "Gradient-Guided TD3"),
    "gg_td3_noise": TrainedAgent("Gradient-Guided TD3, trained with noise", "Gradient-Guided TD3, trained with noise"),
    "td3": TrainedAgent("TD3", "TD3"),
    "anywhere": TrainedAgent("anywhere", "anywhere (PPO)", "random planets", SPECTRUM),
    OWN: TrainedAgent("own policy", "own policy", "tasks of its own"),
    "kalman": TrainedAgent("Kalman", "Kalman (dual control)", UNTRAINED, SPECTRUM),
}
"""Trained agents, which take a run folder; ``anywhere`` without one is the pretrained policy."""

KINDS: dict[str, TrainedAgent | type[Navigator]] = {**TRAINED, **NAVIGATORS}
NAVIGATOR_NAMES = {name: kind.label for name, kind in KINDS.items()}
"""Label of each navigator in figures."""
_COLORS = ["#D55E00", "#0072B2", "#999999", "#009E73", "#CC79A7", "#44AA99", "#E69F00", "#56B4E9", "#000000"]
_COLORS += ["#882255", "#332288", "#999933", "#AA4499", "#6699CC", "#661100", "#117733"]
NAVIGATOR_COLORS = dict(zip(KINDS, cycle(_COLORS), strict=False))
"""Color of each navigator in every figure, and in files for maps."""


class NavigatorText(NamedTuple):
    """Parts of a text that names a navigator: ``name``, ``name:option``, ``name=source`` or ``name:option=source``.

    Args:
        name: name of the navigator.
        option: mode of a metaheuristic, or label of an own policy.
        source: run folder of a trained agent, or file of a policy.
    """

    name: str
    option: str
    source: str


def parse_navigator(text: str) -> NavigatorText:
    """Return the parts of a text that names a navigator; empty where it has none.

    Example:
        >>> parse_navigator("policy:SAC=sac.safetensors")
        NavigatorText(name='policy', option='SAC', source='sac.safetensors')
    """
    check_type(str, text=text)
    named, _, source = text.partition("=")
    name, _, option = named.partition(":")
    return NavigatorText(name, option, source)


def make_navigator(
    text: str,
    env: GeomagneticNavEnv,
    *,
    sensor_std: SensorStd | Sequence[float] = PERFECT,
    mode: str = "look-ahead",
    seed: int = 0,
    map_date: Date | None = None,
    **options: Any,
) -> TensorDictModuleBase:
    """Return the navigator that a text such as ``secant``, ``pso:flown`` or ``gg_td3=RUN`` names.

    Args:
        text: name; after ``=`` the run folder of a trained agent, or the file of a policy; after ``:`` the mode of a
            metaheuristic, or the label of a policy, as in ``policy:SAC=sac.safetensors``.
        env: environment that it navigates in.
        sensor_std: accuracy of the sensors, for navigators that weigh their readings; three numbers are white noise of
            D [deg], I [deg], B_H [nT]. Agents read it from the TensorDict.
        mode: mode of a metaheuristic without one in ``text``.
        seed: random seed of a metaheuristic.
        map_date: date of the map of ``map_matching``, from IGRF; None for the environment's own field.
        options: further options of the class of a navigator without training, such as ``caution`` of ``kalman``, or of
            the view of an agent without a map, such as ``step_price``.

    Raises:
        TypeError: for options that the class does not have, or of another trained agent.
        ValueError: for an unknown name, a trained agent without a run or trained in another field, a run or a mode for
            a navigator that takes none, or an unknown mode.
        FileNotFoundError: for a run without a policy.

    Example:
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> make_navigator("pso:flown", env).oracle, make_navigator("parallel", env).oracle
        (False, True)
    """
    name, option, source = parse_navigator(text)
    if name in TRAINED and (not option or name == OWN):
        return _load(text, env, options)
    kind = NAVIGATORS.get(name)
    if kind is None or source or (option and "mode" not in kind.options):
        trained = [f"{agent}=RUN" for agent in TRAINED if agent not in (OWN, "kalman")]
        names = [*PRETRAINED, *trained, "policy:NAME=FILE", *NAVIGATORS]
        raise ValueError(f"unknown navigator {text!r}: choose from {', '.join(names)}")
    shared = {"mode": option or mode, "seed": seed, "map_date": map_date}
    options = {key: value for key, value in shared.items() if key in kind.options} | options
    return kind.for_env(env, sensor_std=sensor_std, **options).to(env.device)


def _load(text: str, env: GeomagneticNavEnv, options: Mapping[str, Any]) -> TensorDictModuleBase:
    """Return a trained agent; raise unless it fits the environment."""
    name, _, source = parse_navigator(text)
    if not source and name not in PRETRAINED:
        file = " or the file of a policy" if name == OWN else ""
        raise ValueError(f"{name} needs the folder of a finished run{file}: {name}=RUN")
    path = Path(source) if name == OWN and not Path(source).is_dir() else Path(source) / "policy.safetensors"
    policy: Any = load_policy(path, env.device) if source else kalman() if name == "kalman" else load_pretrained(name)
    if options and not isinstance(policy.view, TrackView):
        raise TypeError(f"{text} is trained and takes no options, got {', '.join(options)}")
    try:
        return (policy.adapted(**options) if options else policy).for_env(env)
    except ValueError as error:
        raise ValueError(f"{text}: {error}") from error


def _kind(name: str) -> TrainedAgent | type[Navigator]:
    if name not in KINDS:
        raise ValueError(f"unknown navigator {name!r}: choose from {', '.join(KINDS)}")
    return KINDS[name]


def needs(name: str, default_mode: str = "look-ahead") -> str:
    """Return what a navigator needs beside its readings and their standard deviations, for a column of a table.

    Args:
        name: name without a run, for example ``pso`` or ``pso:flown``.
        default_mode: mode of a metaheuristic without one in ``name``.

    Raises:
        ValueError: for an unknown name.

    Example:
        >>> needs("secant"), needs("mean_jacobian"), needs("td3")
        ('nothing', 'a map of the region', 'nothing')
        >>> needs("pso"), needs("pso:flown"), needs("kalman")
        ('the field at other places', 'nothing', "the field's spectrum")
    """
    base, option, _ = parse_navigator(name)
    kind = _kind(base)
    flown = "mode" in kind.options and (option or default_mode) == "flown"
    return Navigator.needs if flown else kind.needs


def trained_on(name: str) -> str:
    """Return what a navigator was trained on, for a column of a table.

    Raises:
        ValueError: for an unknown name.

    Example:
        >>> trained_on("td3"), trained_on("anywhere"), trained_on("kalman"), trained_on("policy:SAC")
        ('the region', 'random planets', 'nothing', 'tasks of its own')
    """
    return getattr(_kind(parse_navigator(name).name), "trained_on", UNTRAINED)


def label(name: str, default_mode: str = "look-ahead") -> str:
    """Return the label of a navigator in tables, which states how a metaheuristic reads the field.

    Args:
        name: name without a run, for example ``pso``, ``pso:flown`` or ``policy:SAC``.
        default_mode: mode of a metaheuristic without one in ``name``.

    Raises:
        ValueError: for an unknown name.

    Example:
        >>> label("pso"), label("ga:flown"), label("policy:SAC")
        ('PSO, look-ahead (an oracle)', 'GA, flown', 'SAC')
    """
    base, option, _ = parse_navigator(name)
    kind = _kind(base)
    if "mode" not in kind.options:
        return option if base == OWN and option else kind.description
    flown = (option or default_mode) == "flown"
    return kind.description + (", flown" if flown else ", look-ahead (an oracle)")


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
        name, option, source = parse_navigator(text)
        key = Path(source).resolve() if source else (name, option or default_mode)
        if key in seen:
            raise ValueError(f"{text} is given twice: the same episodes again are no spread over runs")
        if source and name in PRETRAINED and name in texts:
            raise ValueError(f"{text} has the name of the pretrained {name}: write policy:LABEL={source}")
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
