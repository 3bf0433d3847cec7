"""MinMaxNorm on Gymnasium's classic control environments, where some observations have no bounds.

    python docs/examples/classic_control.py

MinMaxNorm rejects an infinite bound, since it cannot be scaled to 1; `bounds` gives a finite one in its place. Prints
for each entry of the observation the bounds of the spec, the bounds used, and the scaled range under random actions.
Takes seconds.
"""

from __future__ import annotations

from dataclasses import dataclass

from magrl.transforms import MinMaxNorm

import torch
import tyro
from torch import Tensor
from torchrl.data import Bounded
from torchrl.envs import GymEnv, TransformedEnv


@dataclass(frozen=True)
class Config:
    """Settings of the rollouts."""

    envs: tuple[str, ...] = ("MountainCarContinuous-v0", "Acrobot-v1", "CartPole-v1")
    """Gymnasium ids."""
    steps: int = 200
    """Number of steps of each rollout."""
    open_bound: float = 3.0
    """Value scaled to 1 where the spec has no bound; larger values are scaled beyond 1."""
    seed: int = 0
    """Random seed of initial states and actions."""


def closed_bounds(spec: Bounded, open_bound: float) -> tuple[Tensor, Tensor]:
    """Return the bounds of a spec, with `open_bound` where it is infinite."""
    return spec.space.low.nan_to_num(neginf=-open_bound), spec.space.high.nan_to_num(posinf=open_bound)


def make_env(name: str, open_bound: float | None = None) -> TransformedEnv:
    """Return an environment with scaled observations, and scaled actions if they are continuous.

    Raises:
        ValueError: from MinMaxNorm, for a spec with an infinite bound and no ``open_bound``.
    """
    base, bounds = GymEnv(name), {}
    if open_bound is not None:
        bounds["observation"] = closed_bounds(base.observation_spec["observation"], open_bound)
    actions = ["action"] if isinstance(base.action_spec, Bounded) else []
    return TransformedEnv(base, MinMaxNorm(["observation"], ["scaled"], actions, bounds=bounds))


def refusal(name: str) -> str:
    """Return the error of MinMaxNorm for an environment with infinite bounds, or an empty string."""
    try:
        make_env(name)
    except ValueError as error:
        return f"{name}: {error}"
    return ""


def rows(name: str, config: Config) -> list[str]:
    """Return one row of the table for each entry of the observation."""
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
    """Print the table and the errors without `bounds`; return the rows."""
    torch.manual_seed(config.seed)
    table = [row for name in config.envs for row in rows(name, config)]
    print("| environment | number | bounds of its spec | bounds used | scaled, random actions |\n|---|---|---|---|---|")
    print("\n".join(table) + "\n")
    print("\n".join(filter(None, map(refusal, config.envs))))
    return table


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
