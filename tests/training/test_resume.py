"""Trainings that are killed, interrupted or resumed."""

import json
import multiprocessing
import multiprocessing.synchronize
import os
import random
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import td3_gradient_guided as recipe

from magrl.training import UsageError, command, loggers, parse_config
from magrl.training.checkpoints import Checkpoints, create_run_folder, locked
from magrl.training.config import resumed_config
from magrl.training.loggers import WandbRun
from magrl.training.run import StopRequest

ROOT = Path(__file__).parent.parent.parent
SMALL = shlex.split(
    "--num-envs 16 --total-frames 1600 --num-cells 16 16 --batch-size 32 --buffer-size 1000 --init-random-frames 32 "
    "--updates-per-batch 1 --eval-every 10 --eval-tasks-small 4 --eval-tasks 6 --wandb-mode disabled "
    "--checkpoint-every 0.05"
)
COMMAND = [sys.executable, str(ROOT / "recipes" / "td3_gradient_guided.py")]


def run(*args: str, kill_after: float | None = None) -> tuple[int, str]:
    """Run the recipe to its end, or until some seconds after a file appears; return exit code and stderr."""
    folder = Path(args[-1])
    options = {"stderr": subprocess.PIPE, "stdout": subprocess.DEVNULL, "text": True}
    one_thread = os.environ | {"OMP_NUM_THREADS": "1"}  # as in this process: other numbers round differently
    with subprocess.Popen([*COMMAND, *args], env=one_thread, **options) as process:
        if kill_after is not None:
            while process.poll() is None and not list(folder.glob("checkpoints/checkpoint-*.pt")):
                time.sleep(0.01)
            time.sleep(kill_after)
            process.kill()
        errors = process.communicate()[1]
    return process.returncode, errors


def parse(*args: str) -> recipe.Config:
    return parse_config(recipe.Config, recipe.PRESETS, recipe.RECIPE, recipe.__doc__, args)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """Return the folder of a training that was left alone."""
    folder = tmp_path_factory.mktemp("resume") / "whole"
    recipe.train(parse(*SMALL, "--out", str(folder)))
    return folder


def test_kill_and_resume(whole: Path, tmp_path: Path, same_outcome) -> None:
    folder = tmp_path / "killed"
    code, errors = run(*SMALL, "--out", str(folder), kill_after=0.1)
    assert code == -signal.SIGKILL, errors
    assert not (folder / "eval.json").exists()
    recipe.train(parse("--resume", str(folder)))
    assert same_outcome(folder, whole)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 9))
def test_many_kills(tmp_path: Path, same_outcome: Callable, seed: int) -> None:
    """Kill a training several times, let it end, and compare it with one that was left alone."""
    folder, whole, survived, moments = tmp_path / "killed", tmp_path / "whole", 0, random.Random(seed)
    options = (*SMALL, "--total-frames", "3200", "--out")
    assert run(*options, str(whole))[0] == 0
    code, _ = run(*options, str(folder), kill_after=moments.uniform(0, 1))
    while code == -signal.SIGKILL:
        survived += 1
        code, errors = run("--resume", str(folder), kill_after=moments.uniform(0, 5) if survived < 5 else None)
        assert code in (0, -signal.SIGKILL), errors
    assert same_outcome(folder, whole)
    assert survived >= 1


def test_run_that_ended_before_its_first_checkpoint_resumes(
    whole: Path, tmp_path: Path, same_outcome, monkeypatch
) -> None:
    """``config.json`` is there as soon as the folder is, and the seed leads to the same training."""
    folder = tmp_path / "killed"

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "save", killed)
        with pytest.raises(KeyboardInterrupt):
            recipe.train(parse(*SMALL, "--out", str(folder)))
    assert not (folder / "checkpoints").exists()
    assert json.loads((folder / "config.json").read_text())["recipe"] == "td3_gradient_guided.py"
    recipe.train(parse("--resume", str(folder)))
    assert same_outcome(folder, whole)


@pytest.mark.filterwarnings("ignore:.*trying the previous checkpoint")
def test_checkpoint_that_cannot_be_used_is_named(tmp_path: Path, signalled) -> None:
    """The curves so far stay in their file."""
    with signalled(5, signal.SIGTERM), pytest.raises(SystemExit):
        recipe.train(parse(*SMALL, "--eval-every", "2", "--out", str(tmp_path)))
    curves = (tmp_path / "train.csv").read_text()
    config = tmp_path / "config.json"
    settings = config.read_text()
    config.write_text(settings.replace("16,\n    16", "24,\n    24"))
    with pytest.raises(UsageError, match=r"cannot resume: .*checkpoint-\d+\.pt: loss does not fit this training"):
        recipe.train(parse("--resume", str(tmp_path)))
    config.write_text(settings)
    for file in tmp_path.glob("checkpoints/*.pt"):
        file.write_bytes(b"")
    with pytest.raises(UsageError, match="cannot resume: there is no valid checkpoint in"):
        recipe.train(parse("--resume", str(tmp_path)))
    assert len(curves.splitlines()) == 3
    assert (tmp_path / "train.csv").read_text() == curves


# Run folders


def test_second_process_is_kept_out(tmp_path: Path, capsys) -> None:
    folder = create_run_folder(tmp_path / "run")
    (folder / "config.json").write_text(json.dumps({"recipe": recipe.RECIPE}))
    with locked(folder), pytest.raises(SystemExit) as stop:
        command(recipe.RECIPE, lambda: recipe.main(["--resume", str(folder)]))
    said = f"td3_gradient_guided.py: another process is writing the run folder {folder}\n"
    assert (stop.value.code, capsys.readouterr().err) == (2, said)
    assert {path.name for path in folder.iterdir()} == {"config.json", ".lock"}


def hold(folder: Path, ready: multiprocessing.synchronize.Event) -> None:
    with locked(folder):
        ready.set()
        time.sleep(60)


def test_lock_ends_with_its_process(tmp_path: Path) -> None:
    context = multiprocessing.get_context("fork")
    ready = context.Event()
    process = context.Process(target=hold, args=(tmp_path, ready))
    process.start()
    assert ready.wait(10)
    with pytest.raises(UsageError, match="another process"), locked(tmp_path):
        pass
    process.kill()
    process.join()
    with locked(tmp_path):
        pass


MINE = '"recipe": "td3_gradient_guided.py"'


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "holds no config.json"),
        ("", "cannot resume"),
        ("[]", "cannot resume"),
        ("{}", "not of this version of magrl: start the training again in a new folder"),
        ('{"guided": true, "seed": 0, "world": null}', "not of this version of magrl: start the training again"),
        ('{"recipe": "td3_recurrent.py"}', r"the run was started by td3_recurrent\.py: resume it with that recipe"),
        (f'{{{MINE}, "wings": 2}}', "unknown key 'wings'"),
        (f'{{{MINE}, "gamma": 2.0}}', "gamma must be less than 1, got 2.0"),
        (f'{{{MINE}, "gamma": "0.9"}}', "gamma"),
        (f'{{{MINE}, "num_envs": 2.5}}', "num_envs"),
        (f'{{{MINE}, "num_cells": 8}}', "num_cells"),
        (f'{{{MINE}, "guided": 1}}', "guided"),
        (f'{{{MINE}, "scenario": 7}}', "cannot resume"),
        (f'{{{MINE}, "scenario": "scenario.toml"}}', "there is no scenario file at"),
        (f'{{{MINE}, "wandb_mode": "loud"}}', "wandb_mode must be 'offline', 'online' or 'disabled'"),
    ],
)
def test_what_is_not_a_run_is_not_resumed(tmp_path: Path, content: str | None, message: str) -> None:
    if content is not None:
        (tmp_path / "config.json").write_text(content)
    with pytest.raises(UsageError, match=message) as error:
        parse("--resume", str(tmp_path))
    assert str(tmp_path) in str(error.value)


def test_complete_run_and_other_options_are_refused(tmp_path: Path) -> None:
    for name in ("config.json", "eval.json"):
        (tmp_path / name).write_text("{}")
    with pytest.raises(UsageError, match=r"is complete: its results are in .*eval\.json"):
        parse("--resume", str(tmp_path))
    with pytest.raises(UsageError, match=r"leave out --gamma 0\.5$"):
        parse("--resume", str(tmp_path), "--gamma", "0.5")
    with pytest.raises(UsageError, match=r"leave out --seed 1 --preset paper$"):
        parse("--preset", "paper", "--resume", str(tmp_path), "--seed", "1")


def test_resumed_settings_are_those_of_the_run(tmp_path: Path) -> None:
    """However the folder is written; paths are those of this machine."""
    (tmp_path / "config.json").write_text(f'{{{MINE}, "seed": 7, "num_cells": [8, 8], "guided": false}}')
    for text in (f"--resume={tmp_path}", f"--resume={tmp_path}/", f"--resume {tmp_path}/."):
        config = parse(*text.split())
        assert (config.seed, config.num_cells, config.guided) == (7, (8, 8), False)
        assert config.out == config.resume == tmp_path
    assert resumed_config(tmp_path, recipe.Config, recipe.RECIPE) == config


# Signals and loggers


def test_stop_request_waits_and_a_second_one_does_not() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with StopRequest() as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.exit_code == 143
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGTERM) is before


def test_failing_wandb_is_reported_and_disabled(tmp_path: Path, monkeypatch, capsys) -> None:
    class Broken:
        @property
        def experiment(self) -> None:
            raise OSError("no space left")

    monkeypatch.setattr(loggers, "_wandb_logger", lambda *_: Broken())
    log = WandbRun(tmp_path, "offline", {})
    log.row({"frames": 1, "loss": 2.0, "return": 3.0})
    log.summary({"a": 1.0})
    log.close()
    assert capsys.readouterr().err == "wandb failed and is disabled for the rest of this run: no space left\n"


def test_wandb_that_cannot_start_is_disabled(tmp_path: Path, monkeypatch, capsys) -> None:
    def unwritable(*_: object) -> None:
        raise PermissionError("wandb folder")

    monkeypatch.setattr(loggers, "_wandb_logger", unwritable)
    log = WandbRun(tmp_path, "offline", {})
    log.row({"frames": 1, "loss": 2.0})
    log.close()
    assert "disabled for the rest of this run: wandb folder" in capsys.readouterr().err
