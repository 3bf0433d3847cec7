"""Navigators by the texts that commands take, trained or not, and as tables and figures label them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from tensordict.nn import TensorDictModuleBase

from magrl.checks import check_type, printable, short
from magrl.envs import GeomagneticNavEnv
from magrl.navigators import NAVIGATORS, Anywhere, Memory, Navigator, load_policy
from magrl.navigators.trained import TrainingSettings
from magrl.pilot.network import pretrained
from magrl.policy_files import PolicyFile, read_policy, reading
from magrl.sensor_std import PERFECT, SensorStd


class Agent(NamedTuple):
    """What tables and figures say of a trained agent, as :class:`Navigator` says it of itself.

    Example:
        >>> Agent("PPO", "PPO", "PPO").trained_on
        'tasks of its own'
    """

    name: str
    label: str
    description: str
    trained_on: str = "tasks of its own"
    needs: str = Navigator.needs


Kind = Agent | type[Navigator]
_GUIDED = Agent("gg_td3", "Gradient-Guided TD3", "Gradient-Guided TD3", "the region")
_PLAIN = Agent("td3", "TD3", "TD3", "the region")
_EDDIES = Agent("eddies", "eddies (TD3)", "eddies (TD3)", "eddies in the paper's region", "a map of the field")
PRETRAINED = {"eddies": _EDDIES}
"""Agents of the table of scores with a name of their own; the others are named as in ``"nogo-TD3"``."""
KINDS: dict[str, Kind] = {"gg_td3": _GUIDED, "td3": _PLAIN, **NAVIGATORS, **PRETRAINED}
"""What navigators are, by their names in results: the paper's agents, and navigators that commands name."""
NAMES = (*NAVIGATORS, *PRETRAINED)
"""Navigators that commands name."""


class Named(NamedTuple):
    """What a text names.

    Args:
        kind: what it is.
        source: file or run folder of a trained agent, as it was given.
        file: file of its policy.
    """

    kind: Kind
    source: Path | None = None
    file: Path | None = None


def named(text: str) -> Named:
    """Return what a text names: a navigator by its name, or the agent in a file or run folder, ``[LABEL=]PATH``.

    Args:
        text: ``secant``, ``nogo-TD3``, ``sac.onnx``, ``runs/first``, ``SAC=sac.onnx``. The label replaces the one that
            follows from the file.

    Raises:
        ValueError: for an unknown name, or a file that holds no policy.
        FileNotFoundError: for a folder or a file that holds none.

    Example:
        >>> named("pso").kind.description, named("anywhere").kind.trained_on
        ('PSO, look-ahead (an oracle)', 'random planets')
    """
    check_type(str, text=text)
    if text in NAVIGATORS:
        return Named(NAVIGATORS[text])
    if text in PRETRAINED:
        return Named(PRETRAINED[text], file := pretrained("eddies-TD3"), file)
    if text in scored_agents():
        return Named(_agent_of(file := pretrained(text))[0], file, file)
    label, _, path = ("", "", text) if _exists(text) or "=" not in text else text.partition("=")
    if label in KINDS:
        raise ValueError(f"{short(text)}: the name {label} follows from a file: leave it out, or choose another label")
    if path == text and not (_exists(path) or "/" in path or path.endswith((".safetensors", ".onnx"))):
        raise ValueError(f"unknown navigator {short(text)}: choose from {', '.join(NAMES)}, or [LABEL=]PATH")
    kind, _ = _agent_of(file := policy_file(path))
    if label:
        kind = Agent(label, label, label, kind.trained_on, kind.needs)
    return Named(kind, Path(path), file)


@cache
def scored_agents() -> list[str]:
    """Return the names of the agents of the table of scores, each of its task: ``"nogo-TD3"``.

    Example:
        >>> "eddies-TD3" in scored_agents()
        True
    """
    names = [path.stem for path in pretrained("anywhere").parent.iterdir() if path.suffix in (".onnx", ".safetensors")]
    return sorted(name for name in names if "-" in name)


def _exists(path: str) -> bool:
    """Return whether there is a file or a folder; no text that is too long for a path is one."""
    try:
        return Path(path).exists()
    except OSError:
        return False


def policy_file(source: Path | str) -> Path:
    """Return the file of a policy, given that or a run folder."""
    path = Path(source)
    if _exists(str(path)) and path.is_dir():
        path /= "policy.onnx" if (path / "policy.onnx").is_file() else "policy.safetensors"
    return path


def _agent_of(file: Path) -> tuple[Kind, dict[str, Any]]:
    """Return what the file of a policy says of its agent, and of its training, which evaluations share.

    ONNX files say nothing of their training.
    """
    if not _exists(str(file)):
        raise FileNotFoundError(f"there is no policy file at {printable(str(file))[:200]}")
    if file.suffix == ".zip":
        raise ValueError(f"{file} is a model of stable-baselines3: load it, as PPO.load(path), and pass the model")
    content = PolicyFile("onnx", {}, {}) if file.suffix == ".onnx" else read_policy(file)
    if content.kind == "pilot":
        return Anywhere, {"zeta": content.config["rules"]["zeta"]}
    with reading(file):
        training = TrainingSettings(**content.training).model_dump(exclude_unset=True)
    guided, noise = training.pop("guided", None), training.pop("noise", None)
    training |= {} if noise is None else {"errors": noise}
    training |= {"scenario": file.parent / training["scenario"]} if training.get("scenario") else {}
    agent = Agent(*[file.parent.name if file.stem == "policy" else file.stem] * 3)
    if guided is not None:
        agent = _GUIDED if guided else _PLAIN
        text = f"{agent.label}, trained with noise"
        agent = agent._replace(name=f"{agent.name}_noise", label=text, description=text) if any(noise or ()) else agent
    return Memory if content.kind == "memory" else agent, training


def make_navigator(
    text: str,
    env: GeomagneticNavEnv,
    *,
    sensor_std: SensorStd | Sequence[float] = PERFECT,
    seed: int = 0,
    **options: Any,
) -> TensorDictModuleBase:
    """Return the navigator that a text such as ``secant``, ``sac.onnx`` or ``SAC=runs/sac`` names.

    Args:
        text: as of :func:`named`.
        env: environment that it navigates in.
        sensor_std: accuracy of the sensors, for navigators that weigh their readings; three numbers are white noise of
            D [deg], I [deg], B_H [nT]. Agents read it from the TensorDict.
        seed: random seed of a metaheuristic.
        options: further options of the class of a navigator without training, such as ``caution`` of ``kalman``, or of
            the view of an agent without a map, such as ``step_price``.

    Raises:
        TypeError: for options that the class does not have, or of another trained agent.
        ValueError: for an unknown name, or an agent that was trained in another field.
        FileNotFoundError: for a run without a policy.

    Example:
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> make_navigator("secant", env).oracle, make_navigator("parallel", env).oracle
        (False, True)
    """
    kind, _, file = named(text)
    if file is None:
        assert not isinstance(kind, Agent)
        options = ({"seed": seed} if "seed" in kind.options else {}) | options
        return kind.for_env(env, sensor_std=sensor_std, **options).to(env.device)
    policy = load_policy(file, env.device)
    if isinstance(policy, Anywhere | Memory):
        return type(policy).for_env(env, sensor_std=sensor_std, source=file, **options).to(env.device)
    if options:
        raise TypeError(f"{text} is trained and takes no options, got {', '.join(options)}")
    try:
        return policy.fitted(env, {})
    except ValueError as error:
        raise ValueError(f"{text}: {error}") from error


def training_settings(texts: Sequence[str], **chosen: Any) -> tuple[dict[str, Any], list[str]]:
    """Return the settings of the trainings of navigators, and a line on each that is overridden.

    Args:
        texts: navigators, as :func:`named` takes them.
        chosen: settings that override the trainings': ``scenario``, ``zeta``, ``start_heading``, ``errors``;
            None for the trainings' settings.

    Returns:
        Settings; those without a value in ``chosen`` and in any training are left out.

    Raises:
        ValueError: for trainings that differ in a setting without a choice.
        FileNotFoundError: for a missing policy.

    Example:
        >>> training_settings(["secant", "anywhere"], zeta=0.02, errors=None)
        ({'zeta': 0.02}, [])
    """
    settings = {name: value for name, value in chosen.items() if value is not None}
    fixed, others, notes = set(settings), dict[str, list[str]](), list[str]()
    for text in texts:
        file = named(text).file
        for name, value in (_agent_of(file)[1] if file else {}).items():
            if name == "task":
                if value != "box":
                    notes.append(f"{text} was trained for {value}, and flies other tasks here: score it there")
                continue
            if _content(settings.setdefault(name, value)) == _content(value):
                continue
            if name not in fixed:
                values = f"{settings[name]} and {value} ({text})"
                raise ValueError(f"trained with different {name}, {values}: choose with --{name.replace('_', '-')}")
            others.setdefault(name, []).append(f"{value} ({text})")
    notes += [f"{name} is {settings[name]}, in training {', '.join(other)}" for name, other in others.items()]
    return settings, list(map(printable, notes))


def _content(value: Any) -> Any:
    """Return a value for comparisons: of a scenario file, its text."""
    return value.read_bytes() if isinstance(value, Path) and value.is_file() else value


def check_distinct(texts: Sequence[str]) -> None:
    """Raise if a navigator is given twice, or different agents have one name: neither is a spread over runs.

    Args:
        texts: navigators, as :func:`named` takes them.

    Raises:
        ValueError: naming the text.

    Example:
        >>> check_distinct(["secant", "ga", "secant"])
        Traceback (most recent call last):
        ValueError: secant is given twice: the same episodes again are no spread over runs
    """
    seen, kinds = set[object](), dict[str, tuple[Kind, bool]]()
    for text in texts:
        kind, _, file = named(text)
        key = file.resolve() if file else kind
        if key in seen:
            raise ValueError(f"{text} is given twice: the same episodes again are no spread over runs")
        if kinds.setdefault(kind.name, (kind, file is None)) != (kind, file is None):
            raise ValueError(f"{text} has the name of another navigator, {kind.name}: write LABEL=PATH")
        seen.add(key)
