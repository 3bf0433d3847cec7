"""Checkpoints: complete or absent, the previous one if the newest is damaged, and no code in them is executed."""

import hashlib
import inspect
import os
import pickle
import re
import resource
import signal
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.checkpoint import GlobalRNGState
from torchrl.collectors import Collector
from torchrl.envs import Compose, RewardSum, TransformedEnv

from magrl.checks import check_finite
from magrl.envs import GeomagneticNavEnv
from magrl.files import DamagedFileError, save_tensors
from magrl.training import checkpoints as module
from magrl.training.checkpoints import PRIVATE, Checkpoints, RunningEpisodes, read_checkpoint
from magrl.training.curves import BestPolicy


class Counter:
    """A part whose state is a number."""

    def __init__(self, value: int = 0) -> None:
        self.value = value

    def state_dict(self) -> dict:
        return {"value": self.value}

    def load_state_dict(self, state: dict) -> None:
        self.value = state["value"]


@pytest.fixture
def saved(tmp_path: Path) -> tuple[Checkpoints, Counter]:
    """Return checkpoints at 10, 20 and 30 frames, of which two are kept."""
    counter = Counter()
    checkpoints = Checkpoints(tmp_path / "checkpoints", {"counter": counter})
    for frames in (10, 20, 30):
        counter.value = frames
        checkpoints.save(frames)
    counter.value = -1
    return checkpoints, counter


def test_newest_is_loaded_and_older_ones_rotate(saved) -> None:
    checkpoints, counter = saved
    assert [path.name for path in checkpoints.files()] == ["checkpoint-000000000020.pt", "checkpoint-000000000030.pt"]
    assert (checkpoints.load(), counter.value) == (30, 30)
    assert {path.suffix for path in checkpoints.folder.iterdir()} == {".pt"}
    checkpoints.clear()
    assert not checkpoints.folder.exists()


@pytest.mark.parametrize("damage", ["truncate", "empty", "flip", "other"])
def test_damaged_newest_is_reported_and_the_previous_is_used(saved, damage: str) -> None:
    checkpoints, counter = saved
    newest = checkpoints.files()[-1]
    content = bytearray(newest.read_bytes())
    middle = content.index(b"parts")  # elsewhere a bit may lie in padding
    content = {
        "truncate": content[:middle],
        "empty": bytearray(),
        "flip": content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :],
        "other": bytearray(b"no archive at all"),
    }[damage]
    newest.write_bytes(content)
    with pytest.warns(UserWarning, match=f"{newest.name} is damaged.*trying the previous checkpoint"):
        assert (checkpoints.load(), counter.value) == (20, 20)


def test_every_flipped_bit_is_noticed_or_harmless(saved) -> None:
    """A flipped bit is either reported, or in padding, where it does not change the content."""
    checkpoints, _ = saved
    path = checkpoints.files()[-1]
    whole = path.read_bytes()
    for place in range(0, len(whole), 7):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x10]) + whole[place + 1 :])
        try:
            content = read_checkpoint(path)
        except ValueError:
            continue
        assert content == {"format": 1, "frames": 30, "parts": {"counter": {"value": 30}}}


def test_no_valid_checkpoint_is_an_error(saved, tmp_path: Path) -> None:
    checkpoints, _ = saved
    for path in checkpoints.files():
        path.write_bytes(b"")
    with pytest.warns(UserWarning, match="damaged"), pytest.raises(FileNotFoundError, match="no valid checkpoint"):
        checkpoints.load()
    with pytest.raises(FileNotFoundError, match="no valid checkpoint"):
        Checkpoints(tmp_path / "none", {}).load()


def test_other_format_and_other_parts_are_refused_by_name(saved) -> None:
    checkpoints, counter = saved
    newest = checkpoints.files()[-1]
    with pytest.raises(ValueError, match=r"holds \['counter'\], not \['buffer'\]"):
        Checkpoints(checkpoints.folder, {"buffer": counter}).load()
    with pytest.raises(ValueError, match="counter does not fit this training"):
        Checkpoints(checkpoints.folder, {"counter": nn.Linear(1, 1)}).load()
    save_tensors({"format": 99, "frames": 1, "parts": {}}, newest)
    with pytest.raises(ValueError, match="of format 99; this version reads 1"):
        checkpoints.load()


class Malice:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


def test_pickled_code_is_not_executed(saved, tmp_path: Path) -> None:
    checkpoints, _ = saved
    newest, trace = checkpoints.files()[-1], tmp_path / "executed"
    save_tensors({"format": 1, "frames": 1, "parts": {"counter": Malice(trace)}}, newest)
    with pytest.raises(DamagedFileError):
        read_checkpoint(newest)
    newest.write_bytes(pickle.dumps(Malice(trace)))
    with pytest.raises(DamagedFileError):
        read_checkpoint(newest)
    assert not trace.exists()


def test_compressed_archive_is_refused(saved) -> None:
    newest = saved[0].files()[-1]
    with zipfile.ZipFile(newest, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(10_000_000))
    body = newest.read_bytes()
    newest.write_bytes(body[:-2] + b"\x40\x00" + hashlib.sha256(body).hexdigest().encode())
    with pytest.raises(DamagedFileError, match="compressed"):
        read_checkpoint(newest)


def test_full_disk_is_reported_and_leaves_the_others(saved) -> None:
    """A real write that fails: the process may write no file larger than 4 KiB."""
    checkpoints, counter = saved
    before = {path: path.read_bytes() for path in checkpoints.folder.iterdir()}
    limits, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    checkpoints.parts["large"] = TensorPart(torch.zeros(100_000))
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(OSError, match=r"could not be written.*the newest checkpoint is .*0030\.pt"):
            checkpoints.save(40)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert {path: path.read_bytes() for path in checkpoints.folder.iterdir()} == before
    del checkpoints.parts["large"]
    assert (checkpoints.load(), counter.value) == (30, 30)


class TensorPart(Counter):
    """A large part."""

    def __init__(self, tensor: torch.Tensor) -> None:
        super().__init__()
        self.tensor = tensor

    def state_dict(self) -> dict:
        return {"tensor": self.tensor}


def test_kill_while_writing_leaves_complete_files(tmp_path: Path) -> None:
    """After SIGKILL at any time, every file with the name of a checkpoint is complete."""
    script = """
import sys, torch
sys.path.insert(0, sys.argv[2])
from tests.test_checkpoints import Checkpoints, TensorPart
checkpoints = Checkpoints(sys.argv[1], {"part": TensorPart(torch.zeros(300_000))})
checkpoints.save(0)
print("ready", flush=True)
for frames in range(1, 10**6):
    checkpoints.save(frames)
"""
    root = Path(__file__).parent.parent.parent
    command = [sys.executable, "-c", script, str(tmp_path / "c"), str(root)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=root) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        process.kill()
    files = sorted((tmp_path / "c").glob("checkpoint-*.pt"))
    assert files
    for file in files:
        assert read_checkpoint(file)["parts"]["part"]["tensor"].shape == (300_000,)


def test_running_episodes_continue(tmp_path: Path) -> None:
    """Half of the steps, a checkpoint, and the rest in another collector equal all steps in one."""

    def collector() -> tuple[Collector, RunningEpisodes]:
        base = GeomagneticNavEnv(num_envs=4, seed=5, max_steps=7)
        env = TransformedEnv(base, Compose(RewardSum()))
        policy = env.rand_action
        made = Collector(env, policy, frames_per_batch=4, total_frames=120, track_traj_ids=False)
        return made, RunningEpisodes(made, base)

    torch.manual_seed(0)
    expected = [batch.clone() for batch in collector()[0]]
    torch.manual_seed(0)
    first, episodes = collector()
    for _ in zip(range(15), first, strict=False):
        pass
    Checkpoints(tmp_path, {"episodes": episodes, "random": GlobalRNGState()}).save(60)
    second, episodes = collector()
    next(iter(second))
    Checkpoints(tmp_path, {"episodes": episodes, "random": GlobalRNGState()}).load()
    rest = [batch.clone() for batch in second]
    assert len(rest) == 15
    assert all((batch == other).all() for batch, other in zip(rest, expected[15:], strict=True))


def test_running_episodes_of_another_environment_are_refused(tmp_path: Path) -> None:
    def episodes(*transforms) -> RunningEpisodes:
        base = GeomagneticNavEnv(num_envs=2, seed=0)
        env = TransformedEnv(base, Compose(*transforms))
        return RunningEpisodes(Collector(env, env.rand_action, frames_per_batch=2, total_frames=4), base)

    Checkpoints(tmp_path, {"episodes": episodes()}).save(0)
    with pytest.raises(ValueError, match="episode_reward"):
        Checkpoints(tmp_path, {"episodes": episodes(RewardSum())}).load()


def test_private_attributes_of_torchrl_are_there() -> None:
    """If this fails, TorchRL changed its collector, and RunningEpisodes must be adapted before any run is resumed."""
    env = GeomagneticNavEnv(num_envs=2, seed=0)
    collector = Collector(env, env.rand_action, frames_per_batch=2, total_frames=4)
    missing = [name for name in PRIVATE if not hasattr(collector, name)]
    assert not missing, f"torchrl.collectors.Collector has no {missing} any more: see RunningEpisodes"
    batch = next(iter(collector))
    assert collector._frames == 2, "Collector._frames no longer counts the collected frames: see RunningEpisodes"
    assert collector._iter == 0, "Collector._iter no longer counts the batches from 0: see RunningEpisodes"
    carried = collector._carrier["position"]
    assert torch.equal(carried, batch["next", "position"][:, -1]), (
        "Collector._carrier no longer holds the observation from which the next batch starts: see RunningEpisodes"
    )
    collector.shutdown()


def test_only_listed_private_attributes_are_read() -> None:
    source = inspect.getsource(module)
    assert set(re.findall(r"collector\.(_\w+)", source)) == set(PRIVATE)


@pytest.mark.parametrize("name", PRIVATE)
def test_episodes_cannot_be_saved_without_a_private_attribute(name: str) -> None:
    """An attribute that vanished stops the checkpoint, naming it, instead of saving something else."""
    env = GeomagneticNavEnv(num_envs=2, seed=0)
    collector = Collector(env, env.rand_action, frames_per_batch=2, total_frames=4)
    delattr(collector, name)
    with pytest.raises(AttributeError, match=name):
        RunningEpisodes(collector, env).state_dict()


def test_best_policy_is_the_best() -> None:
    best, layer = BestPolicy(), nn.Linear(1, 1)
    for score, weight in ((1.0, 10.0), (3.0, 30.0), (2.0, 20.0)):
        nn.init.constant_(layer.weight, weight)
        best.offer(score, layer)
    other = BestPolicy()
    other.load_state_dict(best.state_dict())
    other.offer(2.9, layer)
    assert other.score == 3
    assert other.weights["weight"].item() == 30


def test_parts_get_their_state_on_the_device_of_the_training(tmp_path: Path) -> None:
    """A replay buffer keeps the tensors that it is given."""

    class Part:
        given: dict[str, torch.Tensor]

        def state_dict(self) -> dict[str, torch.Tensor]:
            return {"x": torch.ones(2)}

        def load_state_dict(self, state_dict: dict[str, torch.Tensor]) -> None:
            self.given = state_dict

    checkpoints = Checkpoints(tmp_path, {"part": (part := Part())})
    checkpoints.save(1)
    for device in ("meta", "cpu"):
        checkpoints.load(device)
        assert part.given["x"].device.type == device


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_check_finite_names_key_and_vehicles(value: float) -> None:
    batch = TensorDict(
        {"whole": torch.ones(5, dtype=torch.int64), "next": TensorDict({"field": torch.zeros(5, 3)}, [5])}, [5]
    )
    check_finite(batch, "now")
    batch["next", "field"][3, 1] = value
    batch["next", "field"][1, 0] = -value
    with pytest.raises(FloatingPointError, match=r"now: next\.field is not finite in rows \[1, 3\]"):
        check_finite(batch, "now")


def test_check_finite_accepts_large_numbers() -> None:
    check_finite([("large", torch.full((4,), 3e38))], "now")
    with pytest.raises(FloatingPointError, match=r"scalar is not finite in rows \[0\]"):
        check_finite([("scalar", torch.tensor(float("nan")))], "now")


def test_keep_must_be_positive(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="keep must be a whole number from 1 on, got 0"):
        Checkpoints(tmp_path, {}, keep=0)


def test_unwritable_folder_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError):
        Checkpoints(tmp_path / "file" / "sub", {}).save(0)
    assert os.listdir(tmp_path) == ["file"]
