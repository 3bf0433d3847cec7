"""Navigators by name, trained or not: as commands take them, and as tables and figures label them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tensordict.nn import TensorDictModuleBase

from magrl.agents import load_policy
from magrl.agents.policy import TrainingSettings
from magrl.checks import check_type, printable
from magrl.envs import GeomagneticNavEnv
from magrl.navigators import NAVIGATORS, Anywhere, Declaring, Memory, Navigator
from magrl.sensor_std import PERFECT, SensorStd
from magrl.tracking.network import policy_content


class TrainedAgent(NamedTuple):
    """Labels of a kind of trained agent in figures and tables, what it was trained on, and its ``needs``, as in
    :class:`Navigator`."""

    label: str
    description: str
    trained_on: str = "the region"
    needs: str = Navigator.needs


OWN = "policy"
"""Name of policies of any algorithm, given by a file or the folder of a run, and a label."""
SUFFIXES = (".safetensors", ".onnx")
"""Ends of the files of policies."""
TRAINED = {
    "gg_td3": TrainedAgent("Gradient-Guided TD3", "Gradient-Guided TD3"),
    "gg_td3_noise": TrainedAgent("Gradient-Guided TD3, trained with noise", "Gradient-Guided TD3, trained with noise"),
    "td3": TrainedAgent("TD3", "TD3"),
    OWN: TrainedAgent("own policy", "own policy", "tasks of its own"),
}
"""Agents of one region, which take a run folder, and policies of other algorithms."""
PRETRAINED = (Anywhere.name, Memory.name)
"""Agents that come with the library; a run folder or a file takes their place."""
WITH_RUN = (*TRAINED, *PRETRAINED)
"""Names that take a run folder or a file."""

KINDS: dict[str, TrainedAgent | type[Navigator]] = {**TRAINED, **NAVIGATORS}
NAVIGATOR_NAMES = {name: kind.label for name, kind in KINDS.items()}
"""Label of each navigator in figures."""

KEPT: dict[str, type[Anywhere | Memory]] = {"rules": Anywhere, "memory": Memory}
"""Agents by the entry that marks their files."""


class NavigatorText(NamedTuple):
    """Parts of a text that names a navigator: ``name``, ``name:option``, ``name=source`` or ``name:option=source``.

    Args:
        name: name of the navigator.
        option: label of an own policy.
        source: run folder of a trained agent, or file of a policy.
    """

    name: str
    option: str
    source: str


def parse_navigator(text: str) -> NavigatorText:
    """Return the parts of a text that names a navigator; empty where it has none. A file of a policy may stand alone.

    Example:
        >>> parse_navigator("policy:SAC=sac.onnx")
        NavigatorText(name='policy', option='SAC', source='sac.onnx')
        >>> parse_navigator("runs/sac.onnx")
        NavigatorText(name='policy', option='sac', source='runs/sac.onnx')
    """
    check_type(str, text=text)
    if "=" not in text and Path(text).suffix in SUFFIXES:
        return NavigatorText(OWN, Path(text).stem, text)
    named, _, source = text.partition("=")
    name, _, option = named.partition(":")
    return NavigatorText(name, option, source)


def make_navigator(
    text: str,
    env: GeomagneticNavEnv,
    *,
    sensor_std: SensorStd | Sequence[float] = PERFECT,
    seed: int = 0,
    **options: Any,
) -> TensorDictModuleBase:
    """Return the navigator that a text such as ``secant``, ``sac.onnx`` or ``gg_td3=RUN`` names.

    Args:
        text: name; after ``=`` the run folder of a trained agent, or the file of a policy; after ``:`` the label of a
            policy, as in ``policy:SAC=sac.onnx``; or that file alone.
        env: environment that it navigates in.
        sensor_std: accuracy of the sensors, for navigators that weigh their readings; three numbers are white noise of
            D [deg], I [deg], B_H [nT]. Agents read it from the TensorDict.
        seed: random seed of a metaheuristic.
        options: further options of the class of a navigator without training, such as ``caution`` of ``kalman``, or of
            the view of an agent without a map, such as ``step_price``.

    Raises:
        TypeError: for options that the class does not have, or of another trained agent.
        ValueError: for an unknown name, a trained agent without a run or trained in another field, or a run for a
            navigator that takes none.
        FileNotFoundError: for a run without a policy.

    Example:
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> make_navigator("secant", env).oracle, make_navigator("parallel", env).oracle
        (False, True)
    """
    name, option, source = parse_navigator(text)
    if name in TRAINED and (not option or name == OWN):
        return _load(text, env, options)
    kind = NAVIGATORS.get(name)
    if kind is None or (source and name not in PRETRAINED) or option:
        trained = [f"{agent}=RUN" for agent in WITH_RUN if agent != OWN]
        names = [*trained, "policy:NAME=FILE", *NAVIGATORS]
        raise ValueError(f"unknown navigator {text!r}: choose from {', '.join(names)}")
    options = ({"seed": seed} if "seed" in kind.options else {}) | options
    options |= {"source": policy_file(source)} if source else {}
    return kind.for_env(env, sensor_std=sensor_std, **options).to(env.device)


def policy_file(source: str) -> Path:
    """Return the file of a policy, given that or a run folder."""
    path = Path(source)
    if path.is_dir():
        path /= "policy.onnx" if (path / "policy.onnx").is_file() else "policy.safetensors"
    return path


def training_settings(texts: Sequence[str], **chosen: Any) -> tuple[dict[str, Any], list[str]]:
    """Return the settings of the trainings of navigators, and a line on each that is overridden.

    Args:
        texts: navigators, as :func:`make_navigator` takes them.
        chosen: settings that override the trainings': ``scenario``, ``zeta``, ``start_heading``, ``errors``;
            None for the trainings' settings.

    Returns:
        Settings; those without a value in ``chosen`` and in any training are left out.

    Raises:
        ValueError: for trainings that differ in a setting without a choice, or an agent under the name of another.
        FileNotFoundError: for a missing policy.

    Example:
        >>> training_settings(["secant", "anywhere"], zeta=0.02, errors=None)
        ({'zeta': 0.02}, [])
    """
    settings = {name: value for name, value in chosen.items() if value is not None}
    fixed, others = set(settings), dict[str, list[str]]()
    for text in texts:
        for name, value in _trained_with(text).items():
            if _content(settings.setdefault(name, value)) == _content(value):
                continue
            if name not in fixed:
                values = f"{settings[name]} and {value} ({text})"
                raise ValueError(f"trained with different {name}, {values}: choose with --{name.replace('_', '-')}")
            others.setdefault(name, []).append(f"{value} ({text})")
    return settings, [
        printable(f"{name} is {settings[name]}, in training {', '.join(other)}") for name, other in others.items()
    ]


def _trained_with(text: str) -> dict[str, Any]:
    """Return the settings in the file of a policy; none of a navigator without one."""
    name, _, source = parse_navigator(text)
    path = policy_file(source)
    if name not in WITH_RUN or not source or path.suffix == ".onnx":
        return {}
    content = policy_content(path)
    found = {"zeta": content["rules"]["zeta"]} if "rules" in content else _training(path, content)
    kinds = {True: "gg_td3", False: "td3"}
    kept = [kind.name for mark, kind in KEPT.items() if mark in content]
    kind = kept[0] if kept else kinds.get(found.pop("guided", None), OWN)
    if OWN not in (name, kind) and name.removesuffix("_noise") != kind:
        raise ValueError(f"{source} was trained as {kind}, not {name}: write {kind}={source}")
    if "noise" in found:
        found["errors"] = tuple(found.pop("noise"))
    if found.get("scenario"):
        found["scenario"] = path.parent / found["scenario"]
    return found


def _training(path: Path, content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a training in the file of its policy, checked."""
    try:
        return TrainingSettings(**content.get("training") or {}).model_dump(exclude_unset=True)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path} does not hold a valid policy: {error}") from error


def _content(value: Any) -> Any:
    """Return a value for comparisons: of a scenario file, its text."""
    return value.read_bytes() if isinstance(value, Path) and value.is_file() else value


def _load(text: str, env: GeomagneticNavEnv, options: Mapping[str, Any]) -> TensorDictModuleBase:
    """Return a trained agent; raise unless it fits the environment."""
    name, _, source = parse_navigator(text)
    if not source:
        file = " or the file of a policy" if name == OWN else ""
        raise ValueError(f"{name} needs the folder of a finished run{file}: {name}=RUN")
    path = policy_file(source)
    kept = {} if path.suffix == ".onnx" else policy_content(path)
    for mark, kind in KEPT.items():
        if mark in kept:
            return kind.for_env(env, source=path, **options).to(env.device)
    if options:
        raise TypeError(f"{text} is trained and takes no options, got {', '.join(options)}")
    try:
        return load_policy(path, env.device).fitted(env, {})
    except ValueError as error:
        raise ValueError(f"{text}: {error}") from error


def fitted(policy: TensorDictModuleBase, env: GeomagneticNavEnv, **rules: Any) -> TensorDictModuleBase:
    """Return a policy within the limits of an environment, which declares its arrival where it must.

    Args:
        policy: any; the library's policies say themselves how they fit (:meth:`Navigator.fitted`).
        env: environment.
        **rules: further :class:`~magrl.tracking.Rules`, such as ``confidence``.
    """
    if not isinstance(policy, Navigator):
        return policy
    policy = policy.fitted(env, rules)
    return Declaring(policy, **env.limits | rules) if env.scenario.declared and not policy.declares else policy


def _kind(name: str) -> TrainedAgent | type[Navigator]:
    if name not in KINDS:
        raise ValueError(f"unknown navigator {name!r}: choose from {', '.join(KINDS)}")
    return KINDS[name]


def needs(name: str) -> str:
    """Return what a navigator needs beside its readings and their standard deviations, for a column of a table.

    Args:
        name: name without a run, for example ``pso``.

    Raises:
        ValueError: for an unknown name.

    Example:
        >>> needs("secant"), needs("pso"), needs("kalman")
        ('nothing', 'the field at other places', "the field's spectrum")
    """
    return _kind(parse_navigator(name).name).needs


def trained_on(name: str) -> str:
    """Return what a navigator was trained on, for a column of a table.

    Raises:
        ValueError: for an unknown name.

    Example:
        >>> trained_on("td3"), trained_on("anywhere"), trained_on("kalman"), trained_on("policy:SAC")
        ('the region', 'random planets', 'nothing', 'tasks of its own')
    """
    return _kind(parse_navigator(name).name).trained_on


def label(name: str) -> str:
    """Return the label of a navigator in tables.

    Args:
        name: name without a run, for example ``pso`` or ``policy:SAC``.

    Raises:
        ValueError: for an unknown name.

    Example:
        >>> label("pso"), label("policy:SAC")
        ('PSO, look-ahead (an oracle)', 'SAC')
    """
    base, option, _ = parse_navigator(name)
    kind = _kind(base)
    return option if base == OWN and option else kind.description


def check_distinct(texts: Sequence[str]) -> None:
    """Raise if a navigator is given twice, or the pretrained agent beside own runs under its name.

    Neither is a spread over runs.

    Args:
        texts: navigators, as :func:`make_navigator` takes them.

    Raises:
        ValueError: naming the text.

    Example:
        >>> check_distinct(["gg_td3=runs/A", "gg_td3=runs/B", "ga"])
        >>> check_distinct(["td3=runs/A", "td3=runs/A/"])
        Traceback (most recent call last):
        ValueError: td3=runs/A/ is given twice: the same episodes again are no spread over runs
    """
    seen: set[object] = set()
    for text in texts:
        name, option, source = parse_navigator(text)
        key = Path(source).resolve() if source else (name, option)
        if key in seen:
            raise ValueError(f"{text} is given twice: the same episodes again are no spread over runs")
        if source and name in PRETRAINED and name in texts:
            raise ValueError(f"{text} has the name of the pretrained {name}: write policy:LABEL={source}")
        seen.add(key)
