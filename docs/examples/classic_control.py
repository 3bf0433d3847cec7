"""MinMaxNorm on Gymnasium's classic control, where some observations have no bounds.

    python docs/examples/classic_control.py

MinMaxNorm refuses an open side: there is no line from infinity to 1. Bounds that are given take its place. Prints, in
seconds, for each number that is observed its bounds in the spec, those that are used, and how far random actions go.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import tyro
from torch import Tensor
from torchrl.data import Bounded
from torchrl.envs import GymEnv, TransformedEnv

from magrl.transforms import MinMaxNorm


@dataclass(frozen=True)
class Config:
    """Settings of the rollouts."""

    envs: tuple[str, ...] = ("MountainCarContinuous-v0", "Acrobot-v1", "CartPole-v1")
    """Names in Gymnasium."""
    steps: int = 200
    """Of each rollout."""
    open_bound: float = 3.0
    """What is scaled to 1 where the spec has no bound: larger values go on beyond 1."""
    seed: int = 0
    """Of the starts and the actions."""


def closed_bounds(spec: Bounded, open_bound: float) -> tuple[Tensor, Tensor]:
    """The bounds of a spec, with a number on its open sides."""
    return spec.space.low.nan_to_num(neginf=-open_bound), spec.space.high.nan_to_num(posinf=open_bound)


def make_env(name: str, open_bound: float | None = None) -> TransformedEnv:
    """Observations scaled, and actions where they are continuous.

    Raises:
        ValueError: by MinMaxNorm, for a spec with an open side and no ``open_bound``.
    """
    base, bounds = GymEnv(name), {}
    if open_bound is not None:
        bounds["observation"] = closed_bounds(base.observation_spec["observation"], open_bound)
    actions = ["action"] if isinstance(base.action_spec, Bounded) else []
    return TransformedEnv(base, MinMaxNorm(["observation"], ["scaled"], actions, bounds=bounds))


def refusal(name: str) -> str:
    """What MinMaxNorm says to an environment with open sides; empty for one without."""
    try:
        make_env(name)
    except ValueError as error:
        return f"{name}: {error}"
    return ""


def rows(name: str, config: Config) -> list[str]:
    """One row of the table for each number that is observed."""
    env = make_env(name, config.open_bound)
    env.set_seed(config.seed)
    spec = env.base_env.observation_spec["observation"]
    scaled = env.rollout(config.steps, break_when_any_done=False)["scaled"]
    spans = ((spec.space.low, spec.space.high), closed_bounds(spec, config.open_bound), scaled.aminmax(dim=0))
    return [
        f"| {name} | {index} | " + " | ".join(f"{low[index]:.3g} to {high[index]:.3g}" for low, high in spans) + " |"
        for index in range(*spec.shape)
    ]


def main(config: Config) -> list[str]:
    """Prints the table, then what was refused without bounds; returns the rows."""
    torch.manual_seed(config.seed)
    table = [row for name in config.envs for row in rows(name, config)]
    print("| environment | number | bounds of its spec | bounds used | scaled, random actions |\n|---|---|---|---|---|")
    print("\n".join(table) + "\n")
    print("\n".join(filter(None, map(refusal, config.envs))))
    return table


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
