"""MinMaxNorm in environments of other domains."""

import math

import pytest
import torch
from torchrl.envs import EnvBase, GymEnv, PendulumEnv, TransformedEnv

from magrl import MinMaxNorm


def rewards(env: EnvBase, actions: torch.Tensor) -> torch.Tensor:
    env.set_seed(0)
    action = iter(actions)
    return env.rollout(len(actions), lambda td: td.set("action", next(action)))["next", "reward"]


def test_a_scaled_torque_has_the_same_dynamics() -> None:
    env = TransformedEnv(PendulumEnv(), MinMaxNorm(["th"], ["th_scaled"], in_keys_inv=["action"]))
    torque = 2 * torch.rand(50, 1, generator=torch.Generator().manual_seed(0)) - 1
    plain = rewards(PendulumEnv(), 2 * torque)
    assert torch.equal(rewards(env, torque), plain)
    assert not torch.equal(rewards(env, 0.9 * torque), plain)


def test_numbers_without_bounds_need_some_and_go_on_beyond_them() -> None:
    with pytest.raises(ValueError, match="MinMaxNorm needs finite bounds"):
        TransformedEnv(GymEnv("CartPole-v1"), MinMaxNorm(["observation"]))
    high = torch.tensor([4.8, 0.01, 0.42, 0.01])
    norm = MinMaxNorm(["observation"], ["scaled"], bounds={"observation": (-high, high)})
    env = TransformedEnv(GymEnv("CartPole-v1"), norm)
    assert env.rollout(10)["scaled"].abs().max() > 1
    assert env.observation_spec["scaled"].space.high[1::2].tolist() == [math.inf] * 2
