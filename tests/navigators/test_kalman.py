"""Navigators by a belief of the field: declarations, and files of pilots."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torchrl.envs import TransformedEnv

import magrl
from magrl.envs import GeomagneticNavEnv
from magrl.errors import SensorErrors
from magrl.evaluation import evaluate, evaluation_rollout, summarize
from magrl.evaluation.options import choose_trips, first_trips
from magrl.navigators import Anywhere, Kalman, policy_env
from magrl.pilot import Rules
from magrl.pilot.network import correction_network, pretrained


def test_an_untrained_correction_is_the_leg_of_kalman() -> None:
    base = GeomagneticNavEnv(num_envs=10, seed=0, start_heading="random")
    env = TransformedEnv(base, SensorErrors((0.05, 0.05, 5.0), bias=(0.1, 0.1, 10.0), seed=0))
    agents = Kalman(step_price=2.0), Anywhere(source=correction_network((8,)), step_price=2.0)
    plain, corrected = (env.set_seed(0) and policy_env(env, agent).rollout(4, agent)["action"] for agent in agents)
    torch.testing.assert_close(corrected, plain)


@pytest.mark.parametrize("name", ["anywhere", "kalman", "secant"])
def test_every_navigator_declares(name: str) -> None:
    summary = summarize(evaluate(name, first_trips(choose_trips(None, "paper-100"), 3), arrival="declared"))
    assert summary["success_rate"] == 100
    assert summary["spl"] > 80


def test_legs_stay_within_the_limits_of_its_rules() -> None:
    env = GeomagneticNavEnv(num_envs=20, seed=0, start_heading="random")
    agent = Anywhere(max_leg_km=10.0, max_turn_deg=math.degrees(0.5))
    action = policy_env(env, agent).rollout(2, agent)["action"]
    assert 5 < action[..., 0].max() <= 10 + 1e-4
    assert 0.45 < action[..., 1].abs().max() <= 0.5 + 1e-4


def test_actions_are_alike_by_any_default_type_of_floating_point_numbers() -> None:
    def actions() -> Tensor:
        return evaluation_rollout(GeomagneticNavEnv(num_envs=2, seed=0, max_steps=3), Anywhere())["action"]

    expected = actions()
    torch.set_default_dtype(torch.float64)
    try:
        torch.testing.assert_close(actions(), expected, rtol=0, atol=1e-3)
    finally:
        torch.set_default_dtype(torch.float32)


# Files


def test_a_pilot_flies_alike_after_saving(tmp_path: Path) -> None:
    path, network = tmp_path / "mine.safetensors", correction_network((8, 4))
    torch.nn.init.normal_(network[-1].weight)
    agent = Anywhere(Rules(step_price=2.0, range_km=500.0), network)
    magrl.save_policy(path, agent)
    loaded = magrl.load_policy(path)
    assert loaded.rules == agent.rules
    state = policy_env(GeomagneticNavEnv(num_envs=5, seed=3, start_heading="random"), agent).rollout(3)[:, -1]
    wanted, found = (one(state.clone())["action"] for one in (agent, loaded))
    assert torch.equal(found, wanted)


def test_every_pretrained_pilot_is_small_and_has_a_card() -> None:
    for file in map(pretrained, ("anywhere", "eddies-TD3", "memory")):
        assert file.stat().st_size < 1_000_000
        card = file.with_suffix(".md").read_text(encoding="utf-8")
        assert all(f"## {part}\n" in card for part in ("Training", "Data", "Limits"))
    with pytest.raises(ValueError, match=r"pretrained_policy must be one of .*'anywhere', .*, got 'nowhere'"):
        pretrained("nowhere")
