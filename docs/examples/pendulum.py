"""MinMaxNorm on TorchRL's pendulum: observations and torque in [-1, 1], with unchanged dynamics.

    python docs/examples/pendulum.py

Prints the range of each entry before and after scaling, and the largest difference between the rewards of a scaled and
an unscaled rollout with the same torques. Takes a second.
"""

from __future__ import annotations

from dataclasses import dataclass

from magrl.transforms import MinMaxNorm

import torch
import tyro
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, PendulumEnv, TransformedEnv


@dataclass(frozen=True)
class Config:
    """Settings of the rollouts."""

    steps: int = 200
    """Number of steps of each rollout."""
    seed: int = 0
    """Random seed of the initial state and the torques."""


def make_env(seed: int) -> TransformedEnv:
    """Return a scaled pendulum; the bounds come from its specs, and its own keys are unchanged."""
    norm = MinMaxNorm(in_keys=["th", "thdot"], out_keys=["th_scaled", "thdot_scaled"], in_keys_inv=["action"])
    return TransformedEnv(PendulumEnv(seed=seed), norm)


def fly(env: EnvBase, actions: torch.Tensor, seed: int) -> TensorDictBase:
    """Return one rollout with given actions ``(T, 1)``."""
    env.set_seed(seed)
    action = iter(actions)
    return env.rollout(len(actions), lambda td: td.set("action", next(action)))


def main(config: Config) -> float:
    """Run both rollouts; return the largest difference of their rewards."""
    torch.manual_seed(config.seed)
    env, torque = make_env(config.seed), 2 * torch.rand(config.steps, 1) - 1
    scaled = fly(env, torque, config.seed)
    plain = fly(PendulumEnv(seed=config.seed), 2 * torque, config.seed)
    print("| entry | least | most |\n|---|---|---|")
    for key in ("th", "th_scaled", "thdot", "thdot_scaled"):
        print(f"| `{key}` | {scaled[key].min():.3f} | {scaled[key].max():.3f} |")
    print(f"| `action` | {env.action_spec.space.low.item():g} | {env.action_spec.space.high.item():g} |")
    apart = (scaled["next", "reward"] - plain["next", "reward"]).abs().max().item()
    print(f"\nlargest difference of rewards in {config.steps} steps: {apart:.1e}")
    return apart


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
