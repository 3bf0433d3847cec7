"""Agents of other libraries as files, and their scores."""

from __future__ import annotations

from pathlib import Path

import pytest
from pandas import DataFrame
from support.recipes import load

from magrl import score
from magrl.envs.gymnasium import GeomagneticNavVectorEnv
from magrl.envs.sb3 import BatchedVecEnv

sb3 = pytest.importorskip("stable_baselines3")
agents = load("docs/tables/agents")


def test_a_saved_agent_has_the_score_of_its_model(tmp_path: Path) -> None:
    envs = BatchedVecEnv(GeomagneticNavVectorEnv(4, task="nogo", autoreset_mode="SameStep"))
    model = sb3.PPO("MlpPolicy", envs, policy_kwargs={"net_arch": [8]}, seed=0, device="cpu")
    agents.save_agent(tmp_path / "agent.onnx", model.policy, "nogo")
    saved, own = (score(agent, "nogo", episodes=4, max_steps=5) for agent in (tmp_path / "agent.onnx", model))
    assert saved["return"] == pytest.approx(own["return"], abs=1e-4)


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
    monkeypatch.setattr(agents, "score", lambda _, task, episodes: score("secant", task, episodes=episodes // 100))
    agents.main((Path("kept/box-GG-TD3.onnx"),))
    assert capsys.readouterr().out.splitlines()[2].startswith("| box | GG-TD3 | 100.0 | 100.0 (99.9–100.0) |")
