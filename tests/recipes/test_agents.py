"""Agents of other libraries as files, and their scores."""

from __future__ import annotations

from pathlib import Path

import pytest
from pandas import DataFrame
from support.recipes import load

from magrl import score

agents = load("docs/tables/agents")


def test_the_agent_of_the_median_is_kept(tmp_path: Path) -> None:
    for seed in range(3):
        (tmp_path / f"box-PPO-seed{seed}").mkdir()
        (tmp_path / f"box-PPO-seed{seed}" / "policy.safetensors").write_text(f"agent {seed}", encoding="utf-8")
    (tmp_path / "box-GG-TD3-seed0").mkdir()
    (tmp_path / "box-GG-TD3-seed0" / "policy.safetensors").write_text("policy", encoding="utf-8")
    one = DataFrame({"seed": [0], "score": [1.0]})
    ends = [(("box", "PPO"), DataFrame({"seed": [0, 1, 2], "score": [3.0, 1.0, 2.0]}))]
    ends += [(("box", "GG-TD3"), one), (("box", "SAC"), one)]  # the last of an old sweep
    agents.keep_agents(ends, tmp_path, tmp_path / "kept")
    kept = {path.name: path.read_text("utf-8") for path in (tmp_path / "kept").iterdir()}
    assert kept == {"box-PPO.safetensors": "agent 2", "box-GG-TD3.safetensors": "policy"}


def test_a_row_is_printed_for_each_agent(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(agents, "score", lambda _, task, episodes: score("secant", task, episodes=episodes // 100))
    agents.main((Path("kept/box-GG-TD3.onnx"),))
    assert capsys.readouterr().out.splitlines()[2].startswith("| box | GG-TD3 | 100.0 (99.9–100.0) | 100.0 | 100.0 |")
