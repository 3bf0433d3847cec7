"""Trainings among the examples of the documentation: PPO."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from support.recipes import small

from magrl.agents import load_policy
from magrl.evaluation import evaluate

sys.path.append(str(Path(__file__).parent.parent.parent / "docs" / "examples"))
import ppo


@pytest.mark.usefixtures("without_figures")
def test_ppo_trains(tmp_path: Path) -> None:
    result = ppo.train(small(ppo, tmp_path / "run"))
    assert result["updates"] == 10
    policy = load_policy(tmp_path / "run" / "policy.safetensors")
    assert evaluate(policy, "paper-100", max_steps=2).shape == (100,)
