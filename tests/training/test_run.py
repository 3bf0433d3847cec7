"""Runs around a training: folder, settings, noise, and resume after any end."""

import csv
import errno
import json
import math
import shutil
import signal
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from torch import nn
from torchrl.collectors import Collector

from magrl.envs import GeomagneticNavEnv
from magrl.envs.navigation import navigation_env
from magrl.files import locked
from magrl.navigators import FieldPolicy, PolicyConfig
from magrl.training import RegionConfig, Run, UsageError, command, curves, run
from magrl.training.checkpoints import Checkpoints, read_checkpoint
from magrl.training.config import CHANGEABLE, resumed_config
from magrl.training.curves import TrainingStatistics
from magrl.training.run import StopRequest
from magrl.training.wandb_run import WandbRun

ROOT = Path(__file__).parent.parent.parent
AZORES = ROOT / "docs" / "examples" / "azores.toml"
NOISE = (0.05, 0.05, 5.0)


def in_run(config: RegionConfig) -> Run:
    return Run(config, recipe="mine.py", name="mine")


def train(folder: Path, width: int = 1, **options: object) -> None:
    """A training whose agent flies at random and learns nothing."""
    options = {"total_frames": 12, "eval_every": 2, "log_every": 2, "eval_trips_small": 2, "eval_trips": 2} | options
    with in_run(RegionConfig(out=folder, wandb_mode="disabled", **options)) as run:
        torch.manual_seed(run.config.seed)
        base = GeomagneticNavEnv(run.scenario.with_trips(None), num_envs=2, seed=0, max_steps=2)
        validation, test = run.evaluation_envs(navigation_env, max_steps=2, zeta=2.9)
        policy = FieldPolicy(PolicyConfig(base.observation_view(), (8,)))
        collector = Collector(base, base.rand_action, frames_per_batch=2, total_frames=12, track_traj_ids=False)
        run.start(policy=policy, validation=validation, env=base, collector=collector, part=nn.Linear(width, 1))
        for _ in run.batches():
            pass
        run.finish(test)


# The folder


def test_config_and_scenario_are_written_with_the_folder(tmp_path: Path) -> None:
    config = RegionConfig(out=tmp_path / "run", seed=4, wandb_mode="disabled", scenario=AZORES)
    with in_run(config) as run:
        assert {path.name for path in run.folder.iterdir()} == {".lock", "config.json", "scenario.toml"}
        written = json.loads((run.folder / "config.json").read_text(encoding="utf-8"))
        assert (written["recipe"], written["seed"]) == ("mine.py", 4)
        assert (written["out"], written["resume"], written["scenario"]) == ("run", None, "scenario.toml")
        assert (run.folder / "scenario.toml").read_text(encoding="utf-8") == AZORES.read_text(encoding="utf-8")
        with pytest.raises(UsageError, match="another process"), locked(run.folder):
            pass
    with locked(run.folder):
        pass
    assert in_run(resumed_config(run.folder, RegionConfig, "mine.py")).name == run.name == "mine-azores"


def test_only_a_start_that_fails_removes_the_folder(tmp_path: Path) -> None:
    """So the same command can be given again; what was collected, another's folder and a resumed run stay."""
    config = RegionConfig(out=tmp_path / "run")
    with pytest.raises(MemoryError), in_run(config):
        raise MemoryError
    assert not (tmp_path / "run").exists()
    run = in_run(config)
    run.statistics.frames = 1
    with pytest.raises(RuntimeError), run:
        raise RuntimeError
    with pytest.raises(RuntimeError), in_run(config.replace(resume=tmp_path / "run")):
        raise RuntimeError
    with locked(run.folder), pytest.raises(UsageError, match=f"another process is writing the run folder {run.folder}"):
        in_run(config.replace(resume=tmp_path / "run")).__enter__()
    with pytest.raises(UsageError), in_run(config):
        pass
    assert (tmp_path / "run" / "config.json").is_file()


def test_run_is_named_after_its_scenario_and_noise() -> None:
    for options, name in (({}, "mine"), ({"scenario": AZORES, "noise": (0.05, 0, 1)}, "mine-azores-noise-0.05-0-1")):
        run = in_run(RegionConfig(seed=2, **options))
        assert (run.name, run.folder) == (name, Path("runs") / f"{name}-seed2")


@pytest.mark.parametrize(
    ("given", "environment", "group"), [("", "", "mine"), ("", "sweep-box", "sweep-box"), ("own", "sweep-box", "own")]
)
def test_a_group_in_wandb_is_chosen_or_of_the_sweep(tmp_path: Path, monkeypatch, given, environment, group) -> None:
    groups = []

    def opened(*args: object, **options: object) -> WandbRun:
        groups.append(options["group"])
        return WandbRun(*args, **options)

    monkeypatch.delenv("WANDB_RUN_GROUP", raising=False)
    if environment:
        monkeypatch.setenv("WANDB_RUN_GROUP", environment)
    monkeypatch.setattr(run, "WandbRun", opened)
    config = RegionConfig(out=tmp_path / "run", wandb_mode="disabled", wandb_group=given)
    in_run(config)._make_log(resumed=True)._open_log(run_id="")
    assert groups == [group]


def test_validation_and_test_have_the_noise_of_the_run(tmp_path: Path) -> None:
    for noise, share in ((NOISE, 1.0), ((0.0, 0.0, 0.0), 0.0)):
        with in_run(RegionConfig(out=tmp_path / f"run{share}", noise=noise, eval_trips=6, eval_trips_small=4)) as run:
            states = [env.reset() for env in run.evaluation_envs(navigation_env, zeta=0.01)]
        errors = [state["field"] - state.get("true_field", state["field"]) for state in states]
        assert [(error != 0).double().mean().item() for error in errors] == [share, share]
        assert not share or not torch.equal(errors[0], errors[1][:4])


# Resume


def test_stop_request_waits_and_a_second_one_does_not() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with StopRequest() as stop:
        signal.raise_signal(signal.SIGTERM)
        assert stop.exit_code == 143
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.usefixtures("without_figures")
def test_run_that_ended_before_its_first_checkpoint_starts_again(tmp_path: Path, same_outcome, monkeypatch) -> None:
    """``config.json`` is there as soon as the folder is, and the seed leads to the same training."""

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    folder, whole = tmp_path / "killed", tmp_path / "whole"
    train(whole, scenario=AZORES, total_frames=4)
    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "save", killed)
        with pytest.raises(KeyboardInterrupt):
            train(folder, scenario=AZORES, total_frames=4, checkpoint_every=0)
    assert not (folder / "checkpoints").exists()
    train(folder, scenario=AZORES, total_frames=4, resume=folder)
    assert same_outcome(folder, whole)


@pytest.mark.usefixtures("without_figures")
def test_training_seconds_count_from_the_start_of_the_run(tmp_path: Path, signalled, monkeypatch) -> None:
    """Collectors, which may take long to start, and what went before a run was resumed; not the pause."""
    clock = SimpleNamespace(perf_counter=lambda: clock.now, now=500.0)
    for module in (curves, run):
        monkeypatch.setattr(module, "time", clock)

    def slow(*args: object, **options: object) -> None:
        clock.now += 100.0
        make(*args, **options)

    make = Collector.__init__
    monkeypatch.setattr(Collector, "__init__", slow)
    with signalled(3, signal.SIGTERM), pytest.raises(SystemExit):
        train(tmp_path)
    clock.now += 10_000.0
    train(tmp_path, resume=tmp_path)
    assert json.loads((tmp_path / "eval.json").read_text(encoding="utf-8"))["training_seconds"] == 200.0
    with (tmp_path / "train.csv").open(encoding="utf-8") as file:
        assert [row["seconds"] for row in csv.DictReader(file)] == ["100", "200", "200"]


@pytest.mark.usefixtures("without_figures")
def test_a_second_ctrl_c_says_how_to_resume(tmp_path: Path, signalled, capsys) -> None:
    """It ends the training at once, without a new checkpoint."""
    with signalled(3, signal.SIGINT), signalled(3, signal.SIGINT), pytest.raises(KeyboardInterrupt):
        train(tmp_path)
    assert f"To resume: --resume {tmp_path}\n" in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore:.*trying the previous checkpoint")
@pytest.mark.usefixtures("without_figures")
def test_checkpoint_that_cannot_be_used_is_named(tmp_path: Path, signalled) -> None:
    """The curves so far stay in their file."""
    with signalled(5, signal.SIGTERM), pytest.raises(SystemExit):
        train(tmp_path)
    curves = (tmp_path / "train.csv").read_text(encoding="utf-8")
    with pytest.raises(UsageError, match=r"cannot resume: .*checkpoint-\d+\.\w+: part does not fit this training"):
        train(tmp_path, width=2, resume=tmp_path)
    for file in tmp_path.glob("checkpoints/*.safetensors"):
        file.write_bytes(b"")
    with pytest.raises(UsageError, match="cannot resume: there is no valid checkpoint in"):
        train(tmp_path, resume=tmp_path)
    assert len(curves.splitlines()) == 3
    assert (tmp_path / "train.csv").read_text(encoding="utf-8") == curves


@pytest.mark.usefixtures("without_figures")
def test_a_run_is_resumed_with_the_settings_of_its_checkpoint(tmp_path: Path, signalled) -> None:
    """Another value is refused by its name and both values, but for settings that are not of the training."""
    with signalled(3, signal.SIGTERM), pytest.raises(SystemExit):
        train(tmp_path, scenario=AZORES)
    scenario = tmp_path / "scenario.toml"
    written, text = json.loads((tmp_path / "config.json").read_text("utf-8")), scenario.read_text("utf-8")
    other = {"recipe": "other.py", "name": "other", "noise": (0.1, 0.0, 0.0), "num_cells": (8,), "total_episodes": 7}
    other |= {"scenario": text}
    other |= {name: value * 2 + 1 for name, value in written.items() if name not in other and name not in CHANGEABLE}
    assert other.keys() == written.keys() - set(CHANGEABLE)
    with in_run(resumed_config(tmp_path, RegionConfig, "mine.py")) as resumed:
        saved = resumed.state_dict()
    for name, value in other.items():
        before = saved | {name: value if name != "scenario" else text + "# edited"}
        with pytest.raises(ValueError, match=f"^{name} is .* in the run folder, .* in the checkpoint: only device, "):
            resumed.load_state_dict(before)
    with pytest.raises(UsageError, match=r"configuration does not fit .*: zeta is 0\.5 in the run folder, 0\.01 in"):
        train(tmp_path, zeta=0.5, scenario=scenario, resume=tmp_path)
    train(tmp_path, scenario=scenario, resume=tmp_path, checkpoint_every=5.0)


@pytest.mark.usefixtures("without_figures")
def test_a_training_stops_at_the_first_loss_that_is_not_finite(tmp_path: Path, monkeypatch) -> None:
    """Before it reaches a checkpoint."""
    add = TrainingStatistics.add

    def spoiled(self, batch) -> None:
        add(self, batch)
        self.losses = {"loss_critic": torch.tensor(math.nan if self.iterations == 3 else 1.0)}

    monkeypatch.setattr(TrainingStatistics, "add", spoiled)
    with pytest.raises(FloatingPointError, match=r"after update 0: loss_critic is not finite in rows \[0\]"):
        train(tmp_path, checkpoint_every=0)
    assert [read_checkpoint(path)["frames"] for path in sorted(tmp_path.glob("checkpoints/*.safetensors"))] == [2, 4]


@pytest.mark.parametrize("fault", ["full disk", "folder removed"])
def test_a_training_that_cannot_write_ends_in_one_line(tmp_path: Path, monkeypatch, capsys, fault: str) -> None:
    folder, add = tmp_path / "run", TrainingStatistics.add

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    def spoiled(self, batch) -> None:
        add(self, batch)
        if fault == "full disk":
            monkeypatch.setattr("os.fsync", full)
        else:
            shutil.rmtree(folder)

    monkeypatch.setattr(TrainingStatistics, "add", spoiled)
    with pytest.raises(SystemExit) as stop:
        command("mine.py", lambda: train(folder, checkpoint_every=0))
    *_, line = capsys.readouterr().err.splitlines()
    assert (stop.value.code, line[:9]) == (2, "mine.py: ")
    assert ("No space left on device" if fault == "full disk" else "No such file or directory") in line
