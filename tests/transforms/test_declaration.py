"""Arrivals that vehicles declare, and their measures."""

from __future__ import annotations

import pytest
import torch
from support.environments import near, paper_env
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import TransformedEnv

from magrl.evaluation import episode_measures, evaluation_rollout, summarize
from magrl.navigators import Declaring, Secant
from magrl.transforms import SensorErrors

STD, BIAS = (0.05, 0.05, 5.0), (0.1, 0.1, 10.0)


# Navigators that declare


def test_declarations_are_as_often_right_as_they_say_and_confidence_prevents_false_ones() -> None:
    """Of vehicles with constant errors, of which readings show only a part."""
    rates = []
    for confidence in (0.0, 0.8):
        base = paper_env(60, arrival="declared", max_steps=20)
        env = TransformedEnv(base, SensorErrors(STD, bias=BIAS, seed=1))
        navigator = Declaring(Secant(sensor_std=STD), **base.limits, confidence=confidence)
        rollout = evaluation_rollout(env, navigator)
        said = rollout["next", "declared"].squeeze(-1) & ~rollout["declared"].squeeze(-1)
        probability, right = rollout["arrival_probability"][said], rollout["next", "success"][said]
        assert probability.min() >= confidence
        assert confidence or abs(probability.mean() - right.float().mean()) < 0.12
        rates.append(summarize(episode_measures(rollout)))
    bold, careful = rates
    assert bold["success_rate"] + bold["false_arrival_rate"] == 100
    assert 0 < careful["false_arrival_rate"] < bold["false_arrival_rate"] - 5
    assert 10 < careful["success_rate"] < bold["success_rate"]


# Measures


def test_measures_by_hand() -> None:
    """Four vehicles that stay 5, 9, 20 and 30 km from their targets; the third declares falsely, the fourth never."""
    env = near(5.0, 9.0, 20.0, 30.0)
    declare = torch.tensor([1.0, 1.0, 1.0, -1.0]).unsqueeze(-1)

    def act(heading: Tensor) -> Tensor:
        return torch.cat((torch.zeros(4, 2), declare.expand_as(heading)), -1)

    policy = TensorDictModule(act, in_keys=["heading"], out_keys=["action"])
    episodes = episode_measures(evaluation_rollout(env, policy))
    assert episodes["success"].tolist() == [True, True, False, False]
    assert episodes["false_arrival"].tolist() == [False, False, True, False]
    summary = summarize(episodes)
    assert summary["success_rate"] == 50
    assert summary["false_arrival_rate"] == 25
    assert summary["false_arrival_rate_low"] == pytest.approx(4.56, abs=0.01)
    assert summary["navigation_error_km"] == pytest.approx(7.0, abs=1e-4)
    plain = episode_measures(evaluation_rollout(paper_env(), Secant()))
    assert "false_arrival" not in plain
    assert "false_arrival_rate" not in summarize(plain)
