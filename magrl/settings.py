"""The settings of a training: checked when they are made, and read back from the run that they began."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from magrl.checks import check_type

Settings = TypeVar("Settings")


def check_settings(settings: Any, ranges: Mapping[str, tuple[float, float]]) -> None:
    """Refuses settings that are not of the type of their default, not one of their choices, or out of their range.

    Args:
        settings: a dataclass whose fields have defaults; the type of one that is None is not checked.
        ranges: by name, the least and the most that a number may be.

    Raises:
        ValueError: with the name and the value.

    Example:
        >>> from dataclasses import dataclass
        >>> @dataclass
        ... class Config:
        ...     gamma: float = 0.9
        ...     mode: Literal["fast", "slow"] = "fast"
        >>> check_settings(Config(gamma=2.0), {"gamma": (0, 1)})
        Traceback (most recent call last):
            ...
        ValueError: gamma must be between 0 and 1, got 2.0
    """
    hints = get_type_hints(type(settings))
    for field in fields(settings):
        name, value, kind = field.name, getattr(settings, field.name), type(field.default)
        fits = isinstance(value, (int, float) if kind is float else kind) and (kind is bool) == isinstance(value, bool)
        if not fits and field.default is not None:
            raise ValueError(f"{name} must be of type {kind.__name__}, got {value!r}")
        if get_origin(hints[name]) is Literal and value not in get_args(hints[name]):
            raise ValueError(f"{name} must be one of {get_args(hints[name])}, got {value!r}")
    for name, (low, high) in ranges.items():
        if not low <= getattr(settings, name) <= high:
            raise ValueError(f"{name} must be between {low} and {high}, got {getattr(settings, name)}")


def resume_folder(args: Sequence[str] | None = None) -> Path | None:
    """The run that a command line asks to go on with, or None.

    Args:
        args: of the command; those of this process by default.

    Raises:
        ValueError: for any option beside ``--resume``, since the settings are those of the run.

    Example:
        >>> resume_folder(["--resume", "runs/mine"]).name
        'mine'
        >>> resume_folder(["--seed", "1"]) is None
        True
    """
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--resume", type=Path)
    known, others = parser.parse_known_args(args)
    if known.resume is None or {"-h", "--help"} & set(others):
        return None
    if others:
        raise ValueError(f"--resume takes its settings from the run: leave out {' '.join(others)}")
    return known.resume


def read_settings(folder: Path, kind: type[Settings], **marks: bool) -> Settings:
    """The settings of a run that was begun and is not complete.

    Args:
        folder: of the run.
        kind: their dataclass, which checks them; its ``out`` and ``resume`` become the folder.
        marks: what ``config.json`` holds beside them, to tell the recipes' runs apart.

    Raises:
        ValueError: naming the file and what is wrong with it.

    Example:
        >>> import tempfile
        >>> from dataclasses import dataclass
        >>> @dataclass
        ... class Config:
        ...     seed: int = 0
        ...     out: Path | None = None
        ...     resume: Path | None = None
        >>> folder = Path(tempfile.mkdtemp())
        >>> _ = (folder / "config.json").write_text('{"seed": 7}')
        >>> read_settings(folder, Config).seed
        7
    """
    check_type(Path, folder=folder)
    path, result = folder / "config.json", folder / "eval.json"
    if not path.is_file():
        raise ValueError(f"there is no run to resume in {folder}: it holds no config.json")
    if result.is_file():
        raise ValueError(f"the run in {folder} is complete: its numbers are in {result}")
    try:
        settings = json.loads(path.read_text())
        found = {name: settings.pop(name, None) for name in marks}
        if found != marks:
            raise ValueError(f"it was begun by another recipe: it must have {marks}, got {found}")
        settings = {key: tuple(x) if isinstance(x, list) else x for key, x in settings.items()}
        return kind(**settings | {"out": folder, "resume": folder})
    except (TypeError, ValueError, AttributeError, LookupError) as error:
        raise ValueError(f"cannot resume from {path}: {error}") from error
