"""Scenario files: TOML or JSON, with the keys of :class:`magrl.envs.Scenario`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import BeforeValidator, Field

from magrl.checks import CheckedModel, check_type, short
from magrl.envs.scenario import Scenario, numbers_validator
from magrl.envs.tasks import Tasks
from magrl.files import read_document


def _name(value: object) -> object:
    if not isinstance(value, str) or not value.isprintable() or not 0 < len(value) <= 200:
        raise ValueError(f"name must be a text of 1 to 200 printable characters, got {short(value)}")
    return value


class TaskEntry(CheckedModel):
    """A task in a file."""

    start: Annotated[tuple[float, float], numbers_validator("start", 2)]
    target: Annotated[tuple[float, float], numbers_validator("target", 2)]
    name: Annotated[str | None, BeforeValidator(_name)] = Field(None, validate_default=False)


class TaskEntries(CheckedModel):
    """The tasks in a file."""

    tasks: list[TaskEntry]


def load_scenario(path: Path | str, **changes: Any) -> Scenario:
    """Read a scenario from a TOML or JSON file, whose keys are the fields of :class:`Scenario`.

    ``region`` and ``date`` are required. ``generation`` is 14 and ``objective_floors`` follow the region unless given.
    ``tasks`` is a list of tables with ``start`` and ``target`` (latitude, longitude in degrees) and perhaps ``name``.

    Args:
        path: file that ends in ``.toml`` or ``.json``.
        **changes: fields of :class:`Scenario` that replace those of the file.

    Raises:
        FileNotFoundError: if it does not exist.
        ValueError: naming the file, the key, the value and what would be right.

    Example:
        >>> import tempfile
        >>> lines = "date = 2026-07-01", "region = {latitude = [40, 50], longitude = [-30, -20]}"
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = (Path(folder) / "azores.toml").write_text(chr(10).join(lines))
        ...     load_scenario(Path(folder) / "azores.toml").region
        Regions(Region(latitude=(40.0, 50.0), longitude=(-30.0, -20.0)))
    """
    check_type((Path, str), path=path)
    path = Path(path)
    try:
        scenario = _scenario(read_document(path), changes)
        scenario.build_field()
        return scenario
    except FileNotFoundError:
        raise FileNotFoundError(f"there is no scenario file at {path}") from None
    except (ValueError, TypeError, OSError, RecursionError, OverflowError) as error:
        raise ValueError(f"{path}: {error or type(error).__name__}") from error


def _scenario(content: Any, changes: dict[str, Any]) -> Scenario:
    if not isinstance(content, dict):
        raise ValueError(f"a scenario file must hold a table, got {short(content)}")
    keys = [name for name in Scenario.model_fields if name not in ("field", "names")]
    if unknown := [key for key in content if key not in keys]:
        raise ValueError(f"unknown key {short(unknown[0])}: choose from {', '.join(keys)}")
    if missing := [name for name in ("region", "date") if name not in content]:
        raise ValueError(f"{missing[0]} is missing: a scenario file must hold region and date")
    values: dict[str, Any] = {"generation": 14, "objective_floors": None} | content
    if "tasks" in content:
        values["names"], values["tasks"] = _listed_tasks(content["tasks"])
    return Scenario(**(values | changes))


def _listed_tasks(listed: Any) -> tuple[tuple[str, ...], Tasks | None]:
    """Return names and ends of a list of tables."""
    entries = TaskEntries(tasks=listed).tasks
    if not entries:
        return (), None
    start, target = torch.tensor([(e.start, e.target) for e in entries], dtype=torch.float64).unbind(1)
    return tuple(e.name or f"task {number}" for number, e in enumerate(entries, 1)), Tasks(start, target)
