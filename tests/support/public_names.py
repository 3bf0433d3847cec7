"""The public names of the library: what the packages export, and what the modules that are public as a whole define."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from importlib import import_module
from types import ModuleType

PACKAGES = (
    "field",
    "transforms",
    "errors",
    "envs",
    "navigators",
    "onboard",
    "evaluation",
    "training",
)
"""Packages whose functions and classes are public."""
MODULES = (
    "checks",
    "commands",
    "files",
    "geodesy",
    "guidance",
    "sensor_std",
    "envs.gymnasium",
    "navigators.metaheuristics",
)
"""Modules whose functions and classes are public."""


def is_code(member: object) -> bool:
    return inspect.isfunction(inspect.unwrap(member)) or inspect.isclass(member)  # cached functions, too


def own_names(module: ModuleType) -> Iterator[str]:
    """Functions and classes that a module defines itself."""
    for name, member in vars(module).items():
        if is_code(member) and member.__module__ == module.__name__ and not name.startswith("_"):
            yield name


def public_members() -> dict[str, object]:
    """Public functions and classes by name, such as ``envs.Region``."""
    exported = {name: vars(import_module(f"magrl.{name}")) for name in PACKAGES}
    listed = {name: own_names(import_module(f"magrl.{name}")) for name in MODULES}
    return {
        f"{home}.{name}": member
        for home, names in (exported | listed).items()
        for name in names
        if is_code(member := getattr(import_module(f"magrl.{home}"), name))
    }
