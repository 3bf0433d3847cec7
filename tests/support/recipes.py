"""Recipes as modules."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

RECIPES = Path(__file__).parent.parent.parent / "recipes"


def load(name: str) -> ModuleType:
    """Return a recipe, such as ``tables/grid``, as a module."""
    spec = importlib.util.spec_from_file_location(Path(name).name, RECIPES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
