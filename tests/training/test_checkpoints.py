"""Run folders that are never overwritten, and checkpoints: complete or absent, the previous one if one is damaged."""

import re
from pathlib import Path

import pytest
import torch
from torch import nn
from torchrl.collectors import Collector

from magrl.envs import GeomagneticNavEnv
from magrl.files import locked, save_tensors
from magrl.training import UsageError
from magrl.training import checkpoints as module
from magrl.training.checkpoints import PRIVATE, Checkpoints, RunningEpisodes, create_run_folder, read_checkpoint

# Run folders


def test_each_folder_in_use_has_its_message(tmp_path: Path) -> None:
    """A complete run, an interrupted run and a foreign folder need different actions of the user."""
    new = create_run_folder(tmp_path / "a" / "run")
    assert create_run_folder(new) == new
    foreign = tmp_path / "foreign"
    for name, files, message in (
        ("complete", ("config.json", "eval.json"), "the run in {} is complete: choose another --out"),
        ("interrupted", ("config.json",), "{0} holds a run that is not complete, which --resume {0} completes"),
        ("foreign", ("notes.txt",), "the run folder {} is not empty: choose another --out, or remove it"),
    ):
        folder = tmp_path / name
        folder.mkdir()
        for file in files:
            (folder / file).touch()
        with pytest.raises(UsageError, match=re.escape(message.format(folder))):
            create_run_folder(folder)
    with pytest.raises(UsageError, match=r"notes\.txt is not empty"):
        create_run_folder(foreign / "notes.txt")
    with pytest.raises(UsageError, match=r"notes\.txt/run cannot be made \(Not a directory\): choose another --out"):
        create_run_folder(foreign / "notes.txt" / "run")
    (new / ".lock").mkdir()  # as a folder without the right to write, which does not stop root
    with pytest.raises(UsageError, match=r"a/run cannot be written \(Is a directory\)"), locked(new):
        pass


# Checkpoints


class Part:
    """A part that keeps the state that it is given."""

    def __init__(self, state: dict | None = None) -> None:
        self.state = state or {}

    def state_dict(self) -> dict:
        return self.state

    def load_state_dict(self, state: dict) -> None:
        self.state = state


@pytest.fixture
def saved(tmp_path: Path) -> tuple[Checkpoints, Part]:
    """Return checkpoints at 10, 20 and 30 frames, of which two are kept."""
    part = Part()
    checkpoints = Checkpoints(tmp_path / "checkpoints", {"part": part})
    for frames in (10, 20, 30):
        part.state = {"value": frames, "x": torch.full((2,), frames)}
        checkpoints.save(frames)
    part.state = {}
    return checkpoints, part


def test_newest_is_loaded_and_older_ones_rotate(saved) -> None:
    checkpoints, part = saved
    assert [path.stem for path in checkpoints.files()] == ["checkpoint-000000000020", "checkpoint-000000000030"]
    assert (checkpoints.load(), part.state["value"]) == (30, 30)
    assert {path.suffix for path in checkpoints.folder.iterdir()} == {".safetensors"}
    for device in ("meta", "cpu"):  # a replay buffer keeps the tensors that it is given
        checkpoints.load(device)
        assert part.state["x"].device.type == device
    checkpoints.clear()
    assert not checkpoints.folder.exists()


def test_damaged_newest_is_reported_and_the_previous_is_used(saved) -> None:
    checkpoints, part = saved
    oldest, newest = checkpoints.files()
    content = newest.read_bytes()
    middle = content.index(b"parts")
    flipped = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
    for damaged in (content[:middle], flipped, b"no archive at all"):
        newest.write_bytes(damaged)
        with pytest.warns(UserWarning, match=f"{newest.name} is damaged.*trying the previous checkpoint"):
            assert (checkpoints.load(), part.state["value"]) == (20, 20)
    oldest.write_bytes(b"")
    with pytest.warns(UserWarning, match="damaged"), pytest.raises(FileNotFoundError, match="no valid checkpoint"):
        checkpoints.load()


def test_other_formats_and_other_parts_are_refused_by_name(saved) -> None:
    checkpoints, part = saved
    for parts, content, message in (
        ({"buffer": part}, None, r"holds \['part'\], not \['buffer'\]"),
        ({"part": nn.Linear(1, 1)}, None, "part does not fit this training"),
        ({"part": part}, {"format": 99, "frames": 1, "parts": {}}, "of format 99; this version reads 2"),
    ):
        if content:
            save_tensors(content, checkpoints.files()[-1])
        with pytest.raises(ValueError, match=message):
            Checkpoints(checkpoints.folder, parts).load()
    save_tensors({"weights": 1}, checkpoints.files()[-1])
    with pytest.raises(ValueError, match="is not a checkpoint: it must hold format, frames and parts"):
        read_checkpoint(checkpoints.files()[-1])


def test_write_that_fails_leaves_the_others(saved, monkeypatch) -> None:
    def full(*_: object) -> None:
        raise OSError("no space left")

    checkpoints, part = saved
    monkeypatch.setattr(module, "save_tensors", full)
    with pytest.raises(OSError, match=r"could not be written \(no space left\); the newest checkpoint is .*0030"):
        checkpoints.save(40)
    assert (checkpoints.load(), part.state["value"]) == (30, 30)


# Running episodes


def test_private_attributes_of_torchrl_are_there() -> None:
    """If this fails, TorchRL changed its collector, and RunningEpisodes must be adapted before any run is resumed."""
    env = GeomagneticNavEnv(num_envs=2, seed=5)
    collector = Collector(env, env.rand_action, frames_per_batch=2, total_frames=120, track_traj_ids=False)
    episodes = RunningEpisodes(collector, env)
    next(iter(collector))
    assert (collector._frames, collector._iter) == (2, 0), "they no longer count frames from 1 and batches from 0"
    for name in PRIVATE:
        value = getattr(collector, name)
        delattr(collector, name)
        with pytest.raises(AttributeError, match=name):
            episodes.state_dict()
        setattr(collector, name, value)
