"""Recipes as modules."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

from magrl.training import RunConfig

ROOT = Path(__file__).parents[2]
TABLES = ROOT / "docs" / "tables"


def load(name: str) -> ModuleType:
    """Return a script, such as ``docs/tables/grid``, as a module; one that was imported is the same for all."""
    spec = importlib.util.spec_from_file_location(Path(name).name, ROOT / f"{name}.py")
    if getattr(sys.modules.get(spec.name), "__file__", None) == spec.origin:
        return sys.modules[spec.name]
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


SMALL = {
    "num_envs": 16,
    "total_frames": 320,
    "num_cells": (16, 16),
    "batch_size": 32,
    "buffer_size": 1000,
    "init_random_frames": 32,
    "updates_per_batch": 2,
    "updates_per_step": 1,
    "epochs": 1,
    "steps_per_batch": 2,
    "critic_batches": 1,
    "num_regions": 8,
    "max_steps": 5,
    "eval_every": 10,
    "eval_trips_small": 4,
    "eval_trips": 6,
    "wandb_mode": "disabled",
}
"""Settings of a small training, as far as a recipe has them."""


def small(module: ModuleType, out: Path, **options: object) -> RunConfig:
    """Return the configuration of a small training of a recipe."""
    settings = {key: value for key, value in (SMALL | options).items() if key in module.Config.model_fields}
    return module.Config(out=out, **settings)
