"""Agents of other libraries as files, and their scores."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from pandas import DataFrame
from support.recipes import load

from magrl import score
from magrl.envs.gymnasium import GeomagneticNavVectorEnv
from magrl.envs.sb3 import BatchedVecEnv

contrib = pytest.importorskip("sb3_contrib")
agents = load("tables/agents")


def test_an_agent_with_a_memory_acts_as_its_model() -> None:
    envs = BatchedVecEnv(GeomagneticNavVectorEnv(4, task="nogo", autoreset_mode="SameStep"))
    shape = {"net_arch": [8], "lstm_hidden_size": 8, "log_std_init": 0}
    model = contrib.RecurrentPPO("MlpLstmPolicy", envs, policy_kwargs=shape, seed=0, device="cpu")
    observation, memory, state = envs.reset(), (torch.zeros(4, 8), torch.zeros(4, 8)), None
    for first in (np.ones(4), np.zeros(4)):
        with torch.no_grad():
            action, *memory = agents.Acting(model.policy)(torch.from_numpy(observation), *memory)
        wanted, state = model.predict(observation, state, first, deterministic=True)
        assert action.clamp(-1, 1).numpy() == pytest.approx(wanted, abs=1e-6)


def test_the_agent_of_the_median_is_kept(tmp_path: Path) -> None:
    for seed in range(3):
        (tmp_path / f"box-PPO-seed{seed}.onnx").write_text(f"agent {seed}", encoding="utf-8")
    (tmp_path / "box-GG-TD3-seed0").mkdir()
    (tmp_path / "box-GG-TD3-seed0" / "policy.safetensors").write_text("policy", encoding="utf-8")
    one = DataFrame({"seed": [0], "SPL": [1.0]})
    ends = [(("box", "PPO"), DataFrame({"seed": [0, 1, 2], "SPL": [3.0, 1.0, 2.0]}))]
    ends += [(("box", "GG-TD3"), one), (("box", "SAC"), one)]  # the last of an old sweep
    agents.keep_agents(ends, tmp_path, tmp_path / "kept")
    kept = {path.name: path.read_text("utf-8") for path in (tmp_path / "kept").iterdir()}
    assert kept == {"box-PPO.onnx": "agent 2", "box-GG-TD3.safetensors": "policy"}


def test_a_row_is_printed_for_each_agent(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(agents, "score", lambda agent, task: score("secant", task, episodes=2))  # noqa: ARG005
    agents.main((Path("kept/box-GG-TD3.onnx"),))
    assert capsys.readouterr().out.splitlines()[2].startswith("| box | GG-TD3 | 100.0 | 100.0 (99.9–100.0) |")
