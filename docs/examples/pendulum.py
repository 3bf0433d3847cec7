"""MinMaxNorm on TorchRL's pendulum: observations and torque in [-1, 1], and the same physics underneath.

    python docs/examples/pendulum.py

Prints, in a second, what each entry spans before and after, and how far two flights are apart of which one is scaled.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import tyro
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, PendulumEnv, TransformedEnv

from magrl.transforms import MinMaxNorm


@dataclass(frozen=True)
class Config:
    """Settings of the flights."""

    steps: int = 200
    """Of each flight."""
    seed: int = 0
    """Of the start and the torques."""


def make_env(seed: int) -> TransformedEnv:
    """The bounds of the angle, the speed and the torque come from the specs; the env's own keys stay as they are."""
    norm = MinMaxNorm(in_keys=["th", "thdot"], out_keys=["th_scaled", "thdot_scaled"], in_keys_inv=["action"])
    return TransformedEnv(PendulumEnv(seed=seed), norm)


def fly(env: EnvBase, actions: torch.Tensor, seed: int) -> TensorDictBase:
    """One flight with given actions ``(T, 1)``."""
    env.set_seed(seed)
    action = iter(actions)
    return env.rollout(len(actions), lambda td: td.set("action", next(action)))


def main(config: Config) -> float:
    """Flies both ways; the largest difference of the rewards."""
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
