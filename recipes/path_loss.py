"""Where a journey loses its way: kilometres flown that did not bring the destination nearer, by phase.

    python recipes/path_loss.py gg_td3=runs/A secant parallel

Of each move, what was flown less what the distance to the destination fell by; summed over the first two moves, the
last two, and those between, and averaged over successful journeys of the 1000 test tasks. A perfect path loses nothing.
"""

from __future__ import annotations

import os

os.environ.setdefault("GOMP_SPINCOUNT", "3000")

from dataclasses import dataclass

import torch
import tyro
from evaluate import LABELS, Config, make_env, navigator, spread
from tensordict import TensorDictBase

from magrl.geodesy import geodesic
from magrl.metrics import flown
from magrl.td3 import evaluation_rollout

PHASES = ("first two moves", "between", "last two moves")


@dataclass
class Navigators:
    """Who flies."""

    navigators: tyro.conf.Positional[tuple[str, ...]]
    """As recipes/evaluate.py takes them."""


def losses(rollout: TensorDictBase) -> dict[str, float]:
    """Mean loss of each phase over successful journeys [km]."""
    valid = flown(rollout["next", "done"])
    count = valid.sum(1, keepdim=True)
    success = rollout["next", "success"][..., -1].any(1)
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


def table(names: tuple[str, ...]) -> str:
    """A Markdown table, mean and spread over the runs of each name."""
    env = make_env(Config(navigators=names), "test-1000")
    results: dict[str, list[dict[str, float]]] = {}
    for text in names:
        name = text.partition("=")[0]
        results.setdefault(name, []).append(losses(evaluation_rollout(env, navigator(text, env, "look-ahead", 0))))
    lines = ["| navigator | runs | " + " | ".join(f"{phase}, km" for phase in PHASES) + " |", "|---" * 5 + "|"]
    for name, runs in results.items():
        cells = " | ".join(spread([run[phase] for run in runs], ".1f") for phase in PHASES)
        lines.append(f"| {LABELS[name]} | {len(runs)} | {cells} |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(tyro.cli(Navigators, description=__doc__).navigators))
