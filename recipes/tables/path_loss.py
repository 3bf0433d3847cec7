"""Print where episodes lose path length: kilometers that do not reduce the distance to the destination, by phase.

    python recipes/tables/path_loss.py gg_td3=runs/A secant parallel

The loss of a move is its length minus the decrease of the distance to the destination. It is summed over the first two
moves, the last two, and those between, and averaged over the successful episodes of the 1000 test tasks. A perfect path
has no loss.
"""

from __future__ import annotations

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")  # spinning threads slow each other down; read when torch is imported

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import tyro
from tensordict import TensorDictBase

from magrl.envs import GeomagneticNavEnv, Scenario, named_tasks
from magrl.evaluation import evaluation_rollout
from magrl.evaluation.metrics import first_episode_mask
from magrl.evaluation.navigators import check_distinct, label, make_navigator
from magrl.evaluation.tables import markdown_table, mean_of_runs
from magrl.geodesy import geodesic
from magrl.training import UsageError, command

RECIPE = "path_loss.py"
PHASES = ("first two moves", "between", "last two moves")


@dataclass
class Config:
    """Navigators to compare."""

    navigators: tyro.conf.Positional[tuple[str, ...]]
    """Navigators, as in recipes/evaluate.py."""


def losses(rollout: TensorDictBase) -> dict[str, float]:
    """Return the mean loss of each phase over successful episodes [km]."""
    valid = first_episode_mask(rollout["next", "done"])
    count = valid.sum(1, keepdim=True)
    success = (rollout["next", "success"][..., -1] & valid).any(1)
    before, after = (
        geodesic(*position.unbind(-1), *rollout["target_position"].unbind(-1))[0]
        for position in (rollout["position"], rollout["next", "position"])
    )
    lost = rollout["next", "move"][..., 0].double() - (before - after)
    move = torch.arange(valid.shape[1]).expand_as(valid)
    first = move < 2
    last = (move >= count - 2) & ~first
    masks = dict(zip(PHASES, (first, ~first & ~last, last), strict=True))
    return {name: (lost * (mask & valid)).sum(1)[success].mean().item() for name, mask in masks.items()}


def table(texts: Sequence[str]) -> str:
    """Return the table: the interquartile mean over the runs of each navigator, with its interval or range.

    Raises:
        UsageError: for no navigator, an unknown one, or one that is given twice.
    """
    if not texts:
        raise UsageError("name at least one navigator, for example: secant")
    tasks = named_tasks("test-1000")
    env = GeomagneticNavEnv(Scenario(tasks=tasks), num_envs=len(tasks.start), seed=0)
    try:
        check_distinct(texts)
        navigators = [make_navigator(text, env) for text in texts]
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from error
    results: dict[str, list[dict[str, float]]] = {}
    for text, navigator in zip(texts, navigators, strict=True):
        results.setdefault(text.partition("=")[0], []).append(losses(evaluation_rollout(env, navigator)))
    rows = (
        [label(name), len(runs), *(mean_of_runs([run[phase] for run in runs], form=".1f") for phase in PHASES)]
        for name, runs in results.items()
    )
    return markdown_table(["navigator", "runs", *(f"{phase}, km" for phase in PHASES)], rows)


if __name__ == "__main__":
    command(RECIPE, lambda: print(table(tyro.cli(Config, prog=RECIPE, description=__doc__).navigators)))
