"""Trainings among the examples of the documentation: PPO, and recurrent PPO on raw readings."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import pytest
import torch
from support.recipes import small
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from magrl.agents import load_policy
from magrl.envs import GeomagneticNavEnv, planet_scenario
from magrl.evaluation import evaluate
from magrl.transforms import ReadingView
from magrl.transforms.sequences import features

sys.path.append(str(Path(__file__).parent.parent.parent / "docs" / "examples"))
import ppo
import ppo_recurrent as recurrent

SIZES = {"num_envs": 16, "total_frames": 320, "steps_per_batch": 4, "batch_size": 32, "eval_every": 2, "eval_tasks": 6}
SIZES |= {"sequences_per_update": 8, "memory_batches": 1, "memory_size": 8, "num_regions": 8, "eval_regions": 2}
VIEW = ReadingView(max_move_km=50.0, max_turn_rad=math.pi / 2)


@pytest.mark.usefixtures("without_figures")
def test_ppo_trains(tmp_path: Path) -> None:
    result = ppo.train(small(ppo, tmp_path / "run"))
    assert result["updates"] == 10
    policy = load_policy(tmp_path / "run" / "policy.safetensors")
    assert evaluate(policy, "paper-100", max_steps=2).shape == (100,)


def test_recurrent_ppo_trains(tmp_path: Path, monkeypatch) -> None:
    """What is to be exported acts for each vehicle, and returns its memory."""

    def checked(module, view: ReadingView, memory: dict[str, tuple[int, ...]]) -> str:
        state = [torch.zeros(3, *shape) for shape in memory.values()]
        action, *after = module(torch.rand(3, view.size), *state)
        assert action.shape == (3, 2)
        assert [value.shape for value in after] == [value.shape for value in state]
        return "secant"

    monkeypatch.setattr(recurrent, "export_policy", checked)
    monkeypatch.setattr(recurrent, "save_policy", lambda *_: None)
    result = recurrent.train(recurrent.Config(**SIZES, observe_heading=False, out=tmp_path))
    assert json.loads((tmp_path / "eval.json").read_text(encoding="utf-8"))["spl"] == result["spl"]


@pytest.mark.slow  # the export takes most of the time
@pytest.mark.parametrize("compass", [True, False])
def test_a_trained_memory_is_exported(tmp_path: Path, compass: bool) -> None:
    """The saved policy reads readings, moves and, with a compass, headings."""
    recurrent.train(recurrent.Config(**SIZES, observe_heading=compass, out=tmp_path))
    policy = load_policy(tmp_path / "policy.onnx")
    assert policy.in_keys == ["field", "target_field", "move", *["heading"] * compass, "elapsed_steps"]
    action = evaluate(f"policy={tmp_path}", "paper-100", max_steps=2, start_heading="random" if compass else "north")
    assert action.shape == (100,)


def training_env():
    """A small training environment and the memory of its agent."""
    torch.manual_seed(0)
    base = GeomagneticNavEnv(
        planet_scenario(8, seed=3, **recurrent.REGIONS), num_envs=6, start_heading="random", seed=5
    )
    return recurrent.make_env(base, VIEW, 8), recurrent.make_memory(8)


def test_specs_of_the_training_environment() -> None:
    check_env_specs(training_env()[0], break_when_any_done="both")


def test_the_estimate_of_the_true_way_has_no_loss() -> None:
    """Wherever the vehicles head; a way that is shorter than the longest move is its own length."""
    env, memory = training_env()
    sequences = env.rollout(4, break_when_any_done=False)
    sequences["true_way"][:3] /= 100

    def exact(td: TensorDict) -> None:
        way, heading = td["true_way"].double(), td["heading"].double()
        turned = torch.view_as_real(torch.view_as_complex(way) * torch.exp(1j * heading.squeeze(-1)))
        td["way_estimate"] = (turned / turned.norm(dim=-1, keepdim=True).clamp_min(50.0)).float()

    assert recurrent.loss_way(sequences, exact, VIEW) < 1e-10
    assert sequences["way_estimate"][:3].norm(dim=-1).max() < 0.2
    torch.testing.assert_close(sequences["way_estimate"][3:].norm(dim=-1), torch.ones(3, 4))
    loss = recurrent.loss_way(sequences, memory, VIEW)
    loss.backward()
    assert loss > 0.01
    assert all(weight.grad.any() for weight in memory.parameters())


def test_a_vehicle_moves_along_its_estimate() -> None:
    """Northward and eastward; a correction is added to it; what is too far or behind is cut."""
    estimate, correction = torch.tensor([[0.0, 0.5], [0.0, 0.5], [2.0, 0.0], [-1.0, 0.1]]), torch.zeros(4, 2)
    correction[1] = torch.tensor([0.5, 0.0])
    heading = torch.tensor([[0.25 * torch.pi], [0.0], [0.0], [0.0]])
    expected = torch.tensor([[0.0, 0.5], [2 * 0.5**0.5 - 1, 0.5], [1.0, 0.0], [-1.0, 1.0]])
    found = recurrent.Command(VIEW)(estimate, correction, heading)
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)


def test_the_features_are_those_of_the_library_and_the_change_of_the_reading() -> None:
    reading, degree = torch.tensor([30.0, 60.0, 25000.0]), math.degrees(1) / 25000
    target = reading + torch.tensor([1500 * degree, -750 * degree / 2, 15000.0])
    torch.testing.assert_close(recurrent.features(reading, target), features(reading, target))
    observation = torch.cat((reading, target, torch.tensor([20.0, 0.0, 0.5])))
    first, after = (recurrent.Readings()(observation, before)[0] for before in (torch.zeros(3), reading - 2 * degree))
    assert not first[12:17].any()
    assert (after[12:14] > 0).all()
    torch.testing.assert_close(first[17:], torch.tensor([math.cos(0.5), math.sin(0.5), 0.4]))
