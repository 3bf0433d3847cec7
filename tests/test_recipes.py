"""The recipes as their users run them: small, but whole."""

import csv
import dataclasses
import importlib.util
import json
import math
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from magrl import td3
from magrl.env import GeomagneticNavEnv

RECIPES = Path(__file__).parent.parent / "recipes"
SMALL = {
    "num_envs": 16,
    "total_frames": 320,
    "num_cells": (16, 16),
    "batch_size": 32,
    "buffer_size": 1000,
    "init_random_frames": 32,
    "updates_per_batch": 2,
    "eval_every": 10,
    "eval_tasks_small": 4,
    "eval_tasks": 6,
    "wandb_mode": "disabled",
}


@pytest.fixture(scope="module")
def recipe():
    spec = importlib.util.spec_from_file_location("td3_gradient_guided", RECIPES / "td3_gradient_guided.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def settings(recipe, out: Path, **options):
    return dataclasses.replace(recipe.Config(), out=out, **SMALL | options)


def rows(folder: Path) -> list[dict[str, str]]:
    """The curves of a run, without their timing."""
    with (folder / "train.csv").open() as file:
        return [{key: value for key, value in row.items() if key != "seconds"} for row in csv.DictReader(file)]


@pytest.mark.parametrize("guided", [True, False])
def test_run_folder(recipe, tmp_path: Path, guided: bool) -> None:
    out = tmp_path / "run"
    result = recipe.train(settings(recipe, out), guided=guided)
    names = {".lock", "config.json", "train.csv", "policy.pt", "eval.json", "training.png", "trajectories.png"}
    assert {path.name for path in out.iterdir()} == names
    written = json.loads((out / "eval.json").read_text())
    needed = {"success_rate", "spl", "trajectory_length_m", "steps", "navigation_error_km", "num_tasks", "seed"}
    assert needed <= written.keys()
    assert (written["num_tasks"], written["seed"], written["frames"]) == (6, 0, 320)
    assert written["spl"] == result["spl"]
    assert json.loads((out / "config.json").read_text())["guided"] is guided
    assert [int(row["frames"]) for row in rows(out)] == [160, 320]
    assert [int(row["updates"]) for row in rows(out)] == [18, 38]
    aligned = [float(row["reward_alignment"]) != 0 for row in rows(out)]
    assert aligned == [guided, guided]
    env = GeomagneticNavEnv(num_envs=3, seed=0)
    assert env.rollout(2, td3.load_policy(out / "policy.pt"))["action"].isfinite().all()


def test_same_seed_same_numbers(recipe, tmp_path: Path) -> None:
    def trained(name: str, seed: int) -> tuple[dict, list]:
        recipe.train(settings(recipe, tmp_path / name, seed=seed))
        return td3.load_policy(tmp_path / name / "policy.pt").state_dict(), rows(tmp_path / name)

    (one, rows_one), (again, rows_again), (_, rows_other) = trained("a", 1), trained("b", 1), trained("c", 2)
    assert rows_one == rows_again != rows_other
    assert all(torch.equal(one[key], again[key]) for key in one)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("frames", [240, 96], ids=["after an evaluation", "before any"])
def test_stopped_training_goes_on_as_if_it_had_not(recipe, tmp_path: Path, signalled, capsys, frames, number) -> None:
    """Ctrl-C and SIGTERM: the iteration is finished, the policy and a checkpoint are kept, and --resume is exact."""
    run, whole = tmp_path / "run", tmp_path / "whole"
    with signalled(recipe, frames // 16, number), pytest.raises(SystemExit) as stop:
        recipe.train(settings(recipe, run))
    assert stop.value.code == 128 + number
    assert f"Stopped after {frames} frames" in capsys.readouterr().err
    assert td3.load_policy(run / "policy.pt").config.num_cells == (16, 16)
    assert (run / "training.png").exists() == (frames >= 160)
    assert not (run / "eval.json").exists()
    recipe.train(recipe.parse("td3_gradient_guided.py", ["--resume", str(run)]))
    recipe.train(settings(recipe, whole))
    assert rows(run) == rows(whole)
    weights, others = (td3.load_policy(folder / "policy.pt").state_dict() for folder in (run, whole))
    assert all(torch.equal(weights[key], others[key]) for key in weights)
    assert not (run / "checkpoints").exists()


def test_folder_in_use_is_refused(recipe, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").touch()
    with pytest.raises(FileExistsError, match="in use"):
        recipe.train(settings(recipe, tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize(
    "bad",
    [
        {"num_envs": 0},
        {"total_frames": -1},
        {"gamma": 1.0},
        {"gamma": math.nan},
        {"seed": -1},
        {"seed": 2_000_000_011},
        {"buffer_size": 16},
        {"init_random_frames": -1},
        {"learning_rate": 0.0},
        {"tau": 2.0},
        {"zeta": 0.0},
        {"alignment_weight": math.inf},
        {"exploration_noise": -0.1},
        {"logger": "paper"},
    ],
    ids=str,
)
def test_bad_settings_are_refused_by_name(recipe, tmp_path: Path, bad: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        settings(recipe, tmp_path / "run", **bad)
    assert not (tmp_path / "run").exists()


def test_paper_preset_is_table_1(recipe) -> None:
    config = recipe.parse("x", ["--preset", "paper", "--seed", "4"])
    table = {
        "learning_rate": 1e-3,
        "final_learning_rate": 1e-3,
        "policy_delay": 2,
        "gamma": 0.995,
        "tau": 0.005,
        "buffer_size": 50_000,
        "batch_size": 256,
        "num_cells": (512, 512, 512),
        "exploration_noise": 0.2,
        "policy_noise": 0.1,
        "num_envs": 1,
        "updates_per_batch": 1,
        "seed": 4,
        "reward_scale": 1.0,
        "saturation_weight": 0.0,
    }
    assert {key: getattr(config, key) for key in table} == table


def test_evaluation_seeds_are_out_of_reach(recipe) -> None:
    for seed in (recipe.TEST_SEED, recipe.VALIDATION_SEED):
        with pytest.raises(ValueError, match="seed"):
            dataclasses.replace(recipe.Config(), seed=seed)


@pytest.mark.parametrize("name", ["td3_gradient_guided.py", "td3.py"])
def test_help_lists_the_flags(name: str, tmp_path: Path) -> None:
    """Run from elsewhere, as a user may."""
    run = subprocess.run(
        [sys.executable, RECIPES / name, "--help"], capture_output=True, text=True, cwd=tmp_path, check=True
    )
    for flag in ("--preset", "--seed", "--out", "--device", "--num-envs", "--total-frames", "--wandb-mode"):
        assert flag in run.stdout


def test_what_cannot_run_is_said_in_a_line(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").touch()
    command = [sys.executable, RECIPES / "td3.py", "--out", tmp_path]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 1
    assert run.stderr.strip() == f"td3.py: the run folder {tmp_path} is in use: choose another --out, or move it away"


@pytest.mark.slow
@pytest.mark.parametrize("seed", [5, 6])
def test_the_agent_learns_to_navigate(recipe, tmp_path: Path, seed: int) -> None:
    """Half of the preset's frames, on seeds that it was not tuned on: the paper's figures, on 1000 unseen tasks."""
    config = dataclasses.replace(
        recipe.Config(), seed=seed, total_frames=102_400, out=tmp_path / "run", wandb_mode="disabled"
    )
    result = recipe.train(config)
    assert result["success_rate"] >= 97
    assert result["spl"] >= 88.4
