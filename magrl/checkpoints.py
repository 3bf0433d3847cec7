"""Checkpoints from which a training goes on as if it had never stopped.

A checkpoint is one file: written aside, synced, renamed, so that it is whole or not there. It holds tensors, numbers
and texts only; reading it executes nothing.
"""

from __future__ import annotations

import copy
import hashlib
import io
import os
import warnings
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.collectors import Collector

from magrl.checks import check_number
from magrl.env import GeomagneticNavEnv

CHECKPOINT_FORMAT = 1
_PATTERN = "checkpoint-*.pt"
_DIGEST_LENGTH = 64


class Stateful(Protocol):
    """What can be put aside and taken up again.

    Example:
        >>> part: Stateful = nn.Linear(2, 1)  # as are optimisers, buffers and collectors
        >>> sorted(part.state_dict())
        ['bias', 'weight']
    """

    def state_dict(self) -> dict[str, Any]:
        """All of its state, as tensors, numbers and texts."""

    def load_state_dict(self, state_dict: dict[str, Any]) -> Any:
        """Takes up that state."""


class Checkpoints:
    """The newest checkpoints of a run, and the parts that they hold.

    Args:
        folder: where the files lie; made at the first :meth:`save`.
        parts: by name, whatever has ``state_dict`` and ``load_state_dict``.
        keep: how many files are kept; more than one, so that a damaged newest one is no loss.

    Raises:
        TypeError: for a part that has no state, by its name.
        ValueError: for a number of files below one.

    Example:
        >>> import tempfile
        >>> layer, other = nn.Linear(2, 1), nn.Linear(2, 1)
        >>> folder = tempfile.mkdtemp()
        >>> Checkpoints(folder, {"layer": layer}).save(100).name
        'checkpoint-000000000100.pt'
        >>> Checkpoints(folder, {"layer": other}).load()
        100
        >>> bool((layer.weight == other.weight).all())
        True
    """

    def __init__(self, folder: Path | str, parts: dict[str, Stateful], keep: int = 2) -> None:
        check_number(1, whole=True, keep=keep)
        for name, part in parts.items():
            if not (hasattr(part, "state_dict") and hasattr(part, "load_state_dict")):
                raise TypeError(f"the part {name} must have state_dict and load_state_dict, got {part!r}")
        self.folder, self.parts, self.keep = Path(folder), dict(parts), keep

    def files(self) -> list[Path]:
        """What is there, oldest first."""
        return sorted(self.folder.glob(_PATTERN))

    def save(self, frames: int) -> Path:
        """Writes a checkpoint and removes the oldest beyond :attr:`keep`.

        Args:
            frames: how far the training is; part of the file's name.

        Raises:
            ValueError: for a number of frames that is none.
            OSError: if it cannot be written; the checkpoints that are there stay as they are.
        """
        check_number(0, whole=True, frames=frames)
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / f"checkpoint-{frames:012d}.pt"
        content = {
            "format": CHECKPOINT_FORMAT,
            "frames": frames,
            "parts": {name: part.state_dict() for name, part in self.parts.items()},
        }
        try:
            save_tensors(content, path)
        except Exception as error:
            kept = f"the newest checkpoint is {self.files()[-1]}" if self.files() else "there is no older checkpoint"
            raise OSError(f"the checkpoint {path} could not be written ({error}); {kept}") from error
        for old in self.files()[: -self.keep]:
            old.unlink()
        return path

    def load(self) -> int:
        """Restores every part from the newest file that is sound, and tells of those that are not.

        Returns:
            How far the training was [frames].

        Raises:
            FileNotFoundError: if there is no sound checkpoint.
            ValueError: for a checkpoint of another format, or whose parts are not these.
        """
        for path in reversed(self.files()):
            try:
                content = read_checkpoint(path)
            except DamagedCheckpointError as error:
                warnings.warn(f"{error}; trying the one before", stacklevel=2)
                continue
            if set(content["parts"]) != set(self.parts):
                raise ValueError(f"{path} holds {sorted(content['parts'])}, not {sorted(self.parts)}")
            for name in self.parts:
                self._restore(name, content["parts"][name], path)
            return int(content["frames"])
        raise FileNotFoundError(f"there is no sound checkpoint in {self.folder}")

    def _restore(self, name: str, state: Any, path: Path) -> None:
        try:
            self.parts[name].load_state_dict(state)
        except Exception as error:  # whatever a part raises at a state that is not its own
            raise ValueError(f"{path}: {name} does not fit this training: {error}") from error

    def clear(self) -> None:
        """Removes the checkpoints of a training that is complete."""
        for path in self.folder.glob("checkpoint-*"):
            path.unlink()
        if self.folder.is_dir() and not any(self.folder.iterdir()):
            self.folder.rmdir()


class DamagedCheckpointError(ValueError):
    """A file that is truncated, altered, or no checkpoint at all.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "notes.txt"
        >>> _ = path.write_text("no checkpoint")
        >>> try:
        ...     load_tensors(path)
        ... except DamagedCheckpointError as error:
        ...     print(path.name in str(error))
        True
    """


def read_checkpoint(path: Path | str) -> dict[str, Any]:
    """Reads a checkpoint, checking every byte of it first.

    Returns:
        ``format``, ``frames`` and ``parts``.

    Raises:
        DamagedCheckpointError: naming the file, if it is not whole.
        ValueError: if it is of another format.

    Example:
        >>> import tempfile
        >>> path = Checkpoints(tempfile.mkdtemp(), {"layer": nn.Linear(2, 1)}).save(100)
        >>> content = read_checkpoint(path)
        >>> content["frames"], list(content["parts"])
        (100, ['layer'])
    """
    content = load_tensors(path)
    if not isinstance(content, dict) or set(content) != {"format", "frames", "parts"}:
        raise DamagedCheckpointError(f"{path} is not a checkpoint: it must hold format, frames and parts")
    if content["format"] != CHECKPOINT_FORMAT:
        raise ValueError(
            f"{path} is a checkpoint of format {content['format']!r}; this version reads {CHECKPOINT_FORMAT}"
        )
    if not isinstance(content["frames"], int) or not isinstance(content["parts"], dict):
        raise DamagedCheckpointError(f"{path} is not a checkpoint: its frames must be a number, its parts named")
    return content


def save_tensors(content: Any, path: Path) -> None:
    """Writes what :func:`torch.save` can write, whole or not at all, with its SHA-256 as the comment of the archive.

    Args:
        content: tensors, numbers, texts and containers of them.
        path: of the file; one that is there is replaced.

    Raises:
        OSError: if it cannot be written; what was there stays.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "numbers.pt"
        >>> save_tensors({"speed": torch.ones(2)}, path)
        >>> load_tensors(path)
        {'speed': tensor([1., 1.])}
    """
    archive = io.BytesIO()
    torch.save(content, archive)
    body = archive.getvalue()
    aside = path.with_name(f"{path.name}.aside")
    try:
        with aside.open("wb") as file:
            file.write(body[:-2])  # the last two bytes are the length of the comment
            file.write(_DIGEST_LENGTH.to_bytes(2, "little") + hashlib.sha256(body).hexdigest().encode())
            file.flush()
            os.fsync(file.fileno())
        os.replace(aside, path)
    except Exception:
        aside.unlink(missing_ok=True)
        raise
    _sync_folder(path.parent)


def load_tensors(path: Path | str) -> Any:
    """Reads a file of :func:`save_tensors` from a stranger: no code in it runs, and it takes no more memory than disk.

    Raises:
        DamagedCheckpointError: naming the file and what is wrong with it.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "numbers.pt"
        >>> save_tensors([1, 2], path)
        >>> load_tensors(path)
        [1, 2]
        >>> _ = path.write_bytes(path.read_bytes()[:-1])  # a byte is lost
        >>> try:
        ...     load_tensors(path)
        ... except DamagedCheckpointError as error:
        ...     print(str(error).partition(": ")[2])
        its SHA-256 is not the one that it was written with
    """
    try:
        content = Path(path).read_bytes()
        body = content[: -_DIGEST_LENGTH - 2] + bytes(2)
        if hashlib.sha256(body).hexdigest().encode() != content[-_DIGEST_LENGTH:]:
            raise DamagedCheckpointError(f"{path} is damaged: its SHA-256 is not the one that it was written with")
        with zipfile.ZipFile(io.BytesIO(body)) as archive:
            if any(item.compress_type != zipfile.ZIP_STORED for item in archive.infolist()):
                raise DamagedCheckpointError(f"{path} is damaged: it holds compressed entries")
        return torch.load(io.BytesIO(body), map_location="cpu", weights_only=True)
    except DamagedCheckpointError:
        raise
    except Exception as error:  # whatever a strange archive makes zipfile and torch raise
        raise DamagedCheckpointError(f"{path} is damaged: {error}") from error


class RunningEpisodes:
    """The episodes under way inside a collector and its environment, and how much it has collected.

    TorchRL's collector keeps them to itself (``_carrier``) and leaves them out of its own state.

    Args:
        collector: whose episodes they are.
        env: the navigation environment inside it.

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
        """Tensors and numbers."""
        running = self.collector._carrier.flatten_keys(".")
        return {
            "running": {key: value for key, value in running.items() if isinstance(value, Tensor)},
            "episode": self.env.episode,
            "seed": self.env.seed,
            "frames": self.collector._frames,
            "iterations": self.collector._iter,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Puts the collector and the environment where they were."""
        collector, device = self.collector, self.env.device
        running = TensorDict(state_dict["running"], batch_size=self.env.batch_size, device=device).unflatten_keys(".")
        expected = set(collector.env.reset().keys(True, True))
        if not expected <= set(running.keys(True, True)):
            raise ValueError(f"running episodes lack {sorted(map(str, expected - set(running.keys(True, True))))}")
        collector._carrier = running
        collector._frames, collector._iter = int(state_dict["frames"]), int(state_dict["iterations"])
        self.env.seed, self.env.episode = int(state_dict["seed"]), state_dict["episode"].to(device)


class BestPolicy:
    """The weights that scored best so far.

    Example:
        >>> best, layer = BestPolicy(), nn.Linear(1, 1)
        >>> for score in (90.0, 95.0, 80.0):
        ...     _ = nn.init.constant_(layer.weight, score)
        ...     best.offer(score, layer)
        >>> best.score, best.weights["weight"].item()
        (95.0, 95.0)
    """

    def __init__(self) -> None:
        self.score = float("-inf")
        self.weights: dict[str, Any] | None = None

    def offer(self, score: float, module: nn.Module) -> None:
        """Keeps the weights of ``module`` if they score better than any before.

        Raises:
            ValueError: for a score that is NaN or infinite: no later one would ever be better or worse.
        """
        check_number(score=score)
        if score > self.score:
            self.score, self.weights = score, copy.deepcopy(module.state_dict())

    def state_dict(self) -> dict[str, Any]:
        """The score and the weights."""
        weights = None if self.weights is None else {k: v for k, v in self.weights.items() if isinstance(v, Tensor)}
        return {"score": self.score, "weights": weights}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Takes up the score and the weights."""
        self.score, self.weights = state_dict["score"], state_dict["weights"]


def check_finite(data: TensorDictBase | Iterable[tuple[str, Tensor]], what: str) -> None:
    """Stops a training at the first number that is none.

    Args:
        data: a batch ``(N, …)``, or tensors by name.
        what: said in the error before the key.

    Raises:
        FloatingPointError: naming the key and the rows (vehicles of a batch) where it is NaN or infinite.

    Example:
        >>> check_finite([("loss", torch.tensor([1.0, float("nan")]))], "update 7")
        Traceback (most recent call last):
            ...
        FloatingPointError: update 7: loss is not finite in rows [1]
    """
    items = data.items(True, True) if isinstance(data, TensorDictBase) else data
    for key, value in items:
        # A sum is finite unless an entry is not, or it overflows: one kernel in nearly all cases.
        if value.is_floating_point() and not torch.isfinite(value.detach().sum()):
            bad = ~torch.isfinite(value.detach())
            if bad.any():
                rows = bad.reshape(len(bad) if bad.ndim else 1, -1).any(1).nonzero().squeeze(-1)[:8].tolist()
                name = ".".join(key) if isinstance(key, tuple) else key
                raise FloatingPointError(f"{what}: {name} is not finite in rows {rows}")


def _sync_folder(folder: Path) -> None:
    """Makes a rename last through a power cut, where folders can be synced."""
    if os.name == "posix":
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
