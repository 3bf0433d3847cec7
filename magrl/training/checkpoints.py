"""Run folders, and checkpoints that resume a training exactly where it stopped.

A checkpoint is one file, written under another name, synchronized and renamed, so that it is either complete or absent.
It holds tensors, numbers and text only.
"""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path
from typing import Any, Protocol

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.collectors import Collector

from magrl.checks import short
from magrl.commands import UsageError
from magrl.envs.geomagnetic import GeomagneticNavEnv
from magrl.files import DamagedFileError, load_tensors, save_tensors

CHECKPOINT_FORMAT = 2
_PATTERN = "checkpoint-*.safetensors"
PRIVATE = ("_carrier", "_frames", "_iter")
"""Private attributes of TorchRL's ``Collector`` that :class:`RunningEpisodes` saves and restores."""


def create_run_folder(path: Path | str) -> Path:
    """Create the folder of a run; a run never writes over another.

    Raises:
        UsageError: if it exists and is not empty, saying whether the run there is complete or can be resumed; or if
            it cannot be made.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     create_run_folder(Path(folder) / "run").name
        'run'
    """
    path = Path(path)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        state = f"the run folder {path} is not empty"
        if (path / "eval.json").is_file():
            state = f"the run in {path} is complete"
        elif (path / "config.json").is_file():
            state = f"{path} holds a run that is not complete, which --resume {path} completes"
        raise UsageError(f"{state}: choose another --out, or remove it")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"the run folder {path} cannot be made ({error.strerror}): choose another --out") from error
    return path


class Stateful(Protocol):
    """An object whose state can be saved and restored.

    Example:
        >>> from torch import nn
        >>> part: Stateful = nn.Linear(2, 1)  # as are optimizers, buffers and collectors
        >>> sorted(part.state_dict())
        ['bias', 'weight']
    """

    def state_dict(self) -> dict[str, Any]:
        """Return the whole state, as tensors, numbers and text."""

    def load_state_dict(self, state_dict: dict[str, Any]) -> Any:
        """Restore that state."""


class Checkpoints:
    """The newest checkpoints of a run, and the parts that they hold.

    Args:
        folder: folder of the files, created by the first :meth:`save`.
        parts: objects with ``state_dict`` and ``load_state_dict``, by name.

    Example:
        >>> import tempfile
        >>> from torch import nn
        >>> layer, other = nn.Linear(2, 1), nn.Linear(2, 1)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     print(Checkpoints(folder, {"layer": layer}).save(100).name)
        ...     Checkpoints(folder, {"layer": other}).load()
        checkpoint-000000000100.safetensors
        100
        >>> bool((layer.weight == other.weight).all())
        True
    """

    def __init__(self, folder: Path | str, parts: dict[str, Stateful]) -> None:
        self.folder, self.parts = Path(folder), dict(parts)

    def files(self) -> list[Path]:
        """Return the files of the checkpoints, oldest first."""
        return sorted(self.folder.glob(_PATTERN))

    def save(self, frames: int) -> Path:
        """Write a checkpoint and remove those before the last two.

        Args:
            frames: frames collected so far; part of the file name.

        Returns:
            The path of the file.

        Raises:
            OSError: if it cannot be written; existing checkpoints stay unchanged.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / f"checkpoint-{frames:012d}.safetensors"
        parts = {name: part.state_dict() for name, part in self.parts.items()}
        try:
            save_tensors({"format": CHECKPOINT_FORMAT, "frames": frames, "parts": parts}, path)
        except Exception as error:
            newest = f"the newest checkpoint is {self.files()[-1]}" if self.files() else "there is no older checkpoint"
            raise OSError(f"the checkpoint {path} could not be written ({error}); {newest}") from error
        for old in self.files()[:-2]:  # with two, one damaged file does not lose the training
            old.unlink()
        return path

    def load(self, device: torch.device | str = "cpu") -> int:
        """Restore every part from the newest valid file, and warn of damaged ones.

        Args:
            device: device of the tensors that the parts are given; a replay buffer keeps them.

        Returns:
            Frames collected when the checkpoint was saved.

        Raises:
            FileNotFoundError: if there is no valid checkpoint.
            ValueError: for a checkpoint of another format, or with other parts.
        """
        for path in reversed(self.files()):
            try:
                content = read_checkpoint(path, device)
            except DamagedFileError as error:
                warnings.warn(f"{error}; trying the previous checkpoint", stacklevel=2)
                continue
            if set(content["parts"]) != set(self.parts):
                raise ValueError(f"{path} holds {sorted(content['parts'])}, not {sorted(self.parts)}")
            try:
                for name, part in self.parts.items():
                    part.load_state_dict(content["parts"][name])
            except Exception as error:  # whatever a part raises for the state of another
                raise ValueError(f"{path}: {name} does not fit this training: {error}") from error
            return int(content["frames"])
        raise FileNotFoundError(f"there is no valid checkpoint in {self.folder}")

    def clear(self) -> None:
        """Remove all checkpoints, once a training is complete."""
        shutil.rmtree(self.folder, ignore_errors=True)


def read_checkpoint(path: Path | str, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read a checkpoint, after verifying the checksum of the file.

    Args:
        path: path of the file.
        device: device of the tensors.

    Returns:
        ``format``, ``frames`` and ``parts``.

    Raises:
        DamagedFileError: naming the file, if it is damaged or not a checkpoint.
        ValueError: for another format.

    Example:
        >>> import tempfile
        >>> from torch import nn
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     content = read_checkpoint(Checkpoints(folder, {"layer": nn.Linear(2, 1)}).save(100))
        >>> content["frames"], list(content["parts"])
        (100, ['layer'])
    """
    content = load_tensors(path, device)
    if not isinstance(content, dict) or set(content) != {"format", "frames", "parts"}:
        raise DamagedFileError(f"{path} is not a checkpoint: it must hold format, frames and parts")
    if content["format"] != CHECKPOINT_FORMAT:
        version = short(content["format"])
        raise ValueError(f"{path} is a checkpoint of format {version}; this version reads {CHECKPOINT_FORMAT}")
    return content


class RunningEpisodes:
    """State of the running episodes of a collector, its environment and its transforms, and the collector's counts.

    TorchRL's collector leaves them out of its own ``state_dict``, so this class reads its private attributes
    :data:`PRIVATE`, which ``tests/training/test_checkpoints.py`` guards against a change of TorchRL.

    Args:
        collector: collector in this process.
        env: navigation environment inside the collector.

    Example:
        >>> env = GeomagneticNavEnv(num_envs=2, seed=0)
        >>> collector = Collector(env, frames_per_batch=4, total_frames=8)
        >>> first = next(iter(collector))
        >>> RunningEpisodes(collector, env).state_dict()["frames"]
        4
        >>> collector.shutdown()
    """

    def __init__(self, collector: Collector, env: GeomagneticNavEnv) -> None:
        self.collector, self.env = collector, env

    def state_dict(self) -> dict[str, Any]:
        """Return the last observations, the counts of episodes and frames, the seed, and what the transforms hold."""
        running = self.collector._carrier.flatten_keys(".")
        return {
            "running": {key: value for key, value in running.items() if isinstance(value, Tensor)},
            "episode": self.env.episode,
            "seed": self.env.seed,
            "transforms": self.collector.env.state_dict(),
            "frames": self.collector._frames,
            "iterations": self.collector._iter,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore collector and environment.

        Raises:
            ValueError: naming the keys that the episodes of another environment lack.
        """
        collector, device = self.collector, self.env.device
        running = TensorDict(state_dict["running"], batch_size=self.env.batch_size, device=device).unflatten_keys(".")
        if missing := set(collector.env.reset().keys(True, True)) - set(running.keys(True, True)):
            raise ValueError(f"running episodes lack {sorted(map(str, missing))}")
        collector._carrier = running
        collector._frames, collector._iter = int(state_dict["frames"]), int(state_dict["iterations"])
        self.env.seed, self.env.episode = int(state_dict["seed"]), state_dict["episode"].to(device)
        collector.env.load_state_dict(state_dict["transforms"])
