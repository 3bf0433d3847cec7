"""Trainings that are killed, poisoned or run twice."""

import csv
import os
import random
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from magrl import td3
from magrl.loggers import WandbRun
from magrl.runs import StopRequest, create_run_folder, locked

ROOT = Path(__file__).parent.parent
SMALL = shlex.split(
    "--num-envs 16 --total-frames 3200 --num-cells 16 16 --batch-size 32 --buffer-size 1000 --init-random-frames 32 "
    "--updates-per-batch 1 --eval-every 10 --eval-tasks-small 4 --eval-tasks 6 --wandb-mode disabled "
    "--checkpoint-every 0.05"
)
COMMAND = [sys.executable, str(ROOT / "recipes" / "td3_gradient_guided.py")]


def run(*args: str, kill_after: float | None = None) -> tuple[int, str]:
    """Runs the recipe, to its end or until so many seconds after its first checkpoint; exit code and errors."""
    folder = Path(args[-1])
    with subprocess.Popen([*COMMAND, *args], stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
        if kill_after is not None:
            while process.poll() is None and not list((folder / "checkpoints").glob("checkpoint-*.pt")):
                time.sleep(0.01)
            time.sleep(kill_after)
            process.kill()
        errors = process.communicate()[1]
    return process.returncode, errors


def outcome(folder: Path) -> tuple[list[dict[str, str]], dict[str, torch.Tensor]]:
    """The curves without their timing, and the weights."""
    with (folder / "train.csv").open() as file:
        rows = [{key: value for key, value in row.items() if key != "seconds"} for row in csv.DictReader(file)]
    return rows, td3.load_policy(folder / "policy.pt").state_dict()


def assert_resumed_exactly(tmp_path: Path, kills: int, seed: int) -> int:
    """Kills a training again and again, lets it end, and compares it with one that was left alone."""
    folder, whole, survived = tmp_path / "killed", tmp_path / "whole", 0
    moments = random.Random(seed)
    assert run(*SMALL, "--out", str(whole))[0] == 0
    code, _ = run(*SMALL, "--out", str(folder), kill_after=moments.uniform(0, 1))
    while code == -signal.SIGKILL:
        survived += 1
        again = survived < kills
        code, errors = run("--resume", str(folder), kill_after=moments.uniform(0, 5) if again else None)
        assert code in (0, -signal.SIGKILL), errors
    (rows, weights), (expected, expected_weights) = outcome(folder), outcome(whole)
    assert rows == expected
    assert all(torch.equal(weights[key], expected_weights[key]) for key in expected_weights)
    return survived


def test_kill_and_resume(tmp_path: Path) -> None:
    assert assert_resumed_exactly(tmp_path, kills=1, seed=0) == 1


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 9))
def test_many_kills(tmp_path: Path, seed: int) -> None:
    assert assert_resumed_exactly(tmp_path, kills=5, seed=seed) >= 1


def test_two_runs_never_write_one_folder(tmp_path: Path) -> None:
    folder = create_run_folder(tmp_path / "run")
    (folder / "config.json").write_text('{"guided": true}')
    with locked(folder):
        code, errors = run("--resume", str(folder))
    assert code == 1
    assert f"another process is writing the run folder {folder}" in errors


def test_lock_ends_with_its_process(tmp_path: Path) -> None:
    script = """
import sys, time
from pathlib import Path
from magrl.runs import locked
with locked(Path(sys.argv[1])):
    print("locked", flush=True)
    time.sleep(60)
"""
    with subprocess.Popen([sys.executable, "-c", script, str(tmp_path)], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        with pytest.raises(FileExistsError, match="another process"), locked(tmp_path):
            pass
        process.kill()
    with locked(tmp_path):
        pass


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "holds no config.json"),
        ("", "cannot resume"),
        ("[]", "cannot resume"),
        ("{}", "begun by another recipe"),
        ('{"guided": false}', "begun by another recipe: it must have {'guided': True}, got {'guided': False}"),
        ('{"guided": true, "wings": 2}', "wings"),
        ('{"guided": true, "gamma": 2.0}', "gamma must be between 0 and"),
        ('{"guided": true, "gamma": "0.9"}', "gamma"),
        ('{"guided": true, "num_envs": 2.5}', "num_envs"),
        ('{"guided": true, "wandb_mode": "loud"}', "wandb_mode must be one of"),
    ],
)
def test_what_is_no_run_is_not_resumed(tmp_path: Path, content: str | None, said: str) -> None:
    sys.path.insert(0, str(ROOT / "recipes"))
    import td3_gradient_guided as recipe

    if content is not None:
        (tmp_path / "config.json").write_text(content)
    with pytest.raises(ValueError, match=said) as error:
        recipe.parse("td3_gradient_guided.py", ["--resume", str(tmp_path)])
    assert str(tmp_path) in str(error.value)


def test_complete_run_and_other_options_are_refused(tmp_path: Path) -> None:
    sys.path.insert(0, str(ROOT / "recipes"))
    import td3_gradient_guided as recipe

    for name in ("config.json", "eval.json"):
        (tmp_path / name).write_text("{}")
    with pytest.raises(ValueError, match=r"is complete: its numbers are in .*eval\.json"):
        recipe.parse("td3_gradient_guided.py", ["--resume", str(tmp_path)])
    with pytest.raises(ValueError, match=r"leave out --gamma 0\.5"):
        recipe.parse("td3_gradient_guided.py", ["--resume", str(tmp_path), "--gamma", "0.5"])


def test_stop_request_waits_and_a_second_one_does_not() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with StopRequest() as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.exit_code == 143
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGTERM) is before


def test_failing_wandb_is_told_and_left_out(tmp_path: Path, monkeypatch, capsys) -> None:
    from magrl import loggers

    class Broken:
        @property
        def experiment(self) -> None:
            raise OSError("no space left")

    monkeypatch.setattr(loggers, "_wandb_logger", lambda *_: Broken())
    log = WandbRun(tmp_path, "offline", {})
    log.row({"frames": 1, "loss": 2.0, "return": 3.0})
    log.summary({"a": 1.0})
    log.close()
    assert capsys.readouterr().err == "wandb failed and is left out from here on: no space left\n"


def test_wandb_that_cannot_start_is_left_out(tmp_path: Path, monkeypatch, capsys) -> None:
    from magrl import loggers

    def unwritable(*_: object) -> None:
        raise PermissionError("wandb folder")

    monkeypatch.setattr(loggers, "_wandb_logger", unwritable)
    log = WandbRun(tmp_path, "offline", {})
    log.row({"frames": 1, "loss": 2.0})
    log.close()
    assert "left out from here on: wandb folder" in capsys.readouterr().err
