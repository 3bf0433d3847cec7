"""Safe files: tensors with atomic writes and a checksum, strict JSON, TOML. Reading executes no code of a file."""

from __future__ import annotations

import hashlib
import json
import math
import os
import tomllib
import uuid
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from filelock import AcquireReturnProxy, FileLock, Timeout
from torch import Tensor

from magrl.commands import UsageError


class DamagedFileError(ValueError):
    """A file that is truncated, altered, or not of the expected kind.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "notes.txt"
        >>> _ = path.write_text("no checkpoint")
        >>> try:
        ...     load_tensors(path)
        ... except DamagedFileError as error:
        ...     print(path.name in str(error))
        True
    """


def save_tensors(content: Any, path: Path) -> None:
    """Write tensors and plain data as one safetensors file, atomically.

    The metadata of the file holds the plain data as JSON, in which ``{"$tensor": name}`` stands for a tensor, and the
    SHA-256 of the file with zeros as the digest.

    Args:
        content: tensors, numbers, text, None, devices, and lists, tuples, dictionaries and state dictionaries of these.
        path: path of the file; an existing file is replaced.

    Raises:
        TypeError: for anything else in the content.
        OSError: if it cannot be written; an existing file stays unchanged.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "numbers.safetensors"
        >>> save_tensors({"speed": torch.ones(2)}, path)
        >>> load_tensors(path)
        {'speed': tensor([1., 1.])}
    """
    tensors: dict[str, Tensor] = {}
    text = json.dumps({"sha256": _NO_DIGEST, "content": _pack(content, tensors)})
    body = safetensors.torch.save(tensors, {"magrl": text})
    write_atomically(path, body.replace(_NO_DIGEST.encode(), hashlib.sha256(body).hexdigest().encode(), 1))


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file that is complete or absent, whenever the process ends; after an error the old file is left.

    Raises:
        OSError: if it cannot be written.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "file"
        >>> write_atomically(path, b"content")
        >>> path.read_bytes()
        b'content'
    """
    write_with(path, Path.write_bytes, content)


def write_with(path: Path, write: Callable[..., Any], *args: Any, **options: Any) -> None:
    """Write a file by a function of another library, complete or not at all, as :func:`write_atomically` does.

    Args:
        path: path of the file; an existing file is replaced.
        write: function that writes the file at its first argument, such as ``figure.savefig``.
        args: its further arguments.
        options: its options.

    Raises:
        OSError: naming the file and the reason.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "table.md"
        >>> write_with(path, Path.write_text, "D [°]", encoding="utf-8")
        >>> read_text(path)
        'D [°]'
    """
    aside = path.with_name(f".{uuid.uuid4().hex}{path.suffix}")  # of this call: another writer of the file has its own
    try:
        write(aside, *args, **options)
        with aside.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(aside, path)
    except OSError as error:
        raise _not_written(path, error) from error
    finally:
        aside.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text in UTF-8, atomically.

    Raises:
        OSError: naming the file and the reason.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "notes.txt"
        >>> write_text(path, "60° N")
        >>> path.read_bytes().decode("utf-8")
        '60° N'
    """
    write_atomically(path, text.encode())


def append(path: Path, record: bytes) -> None:
    """Add a record to the end of a file.

    Raises:
        OSError: naming the file and the reason.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "log.csv"
        >>> append(path, b"1,2")
        >>> path.read_bytes()
        b'1,2'
    """
    try:
        with path.open("ab") as file:
            file.write(record)
    except OSError as error:
        raise _not_written(path, error) from error


def _not_written(path: Path, error: OSError) -> OSError:
    return OSError(f"cannot write {path}: {error.strerror or error}")


def load_tensors(path: Path | str, device: torch.device | str = "cpu") -> Any:
    """Read a file of :func:`save_tensors` from any source: it runs no code, and takes memory in proportion to its size.

    Args:
        path: path of the file.
        device: device of the tensors.

    Returns:
        What was saved.

    Raises:
        DamagedFileError: naming the file and what is wrong with it.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "numbers.safetensors"
        >>> save_tensors([1, 2], path)
        >>> load_tensors(path)
        [1, 2]
        >>> _ = path.write_bytes(path.read_bytes().replace(b"2]", b"3]"))
        >>> try:
        ...     load_tensors(path)
        ... except DamagedFileError as error:
        ...     print(str(error).partition(": ")[2])
        its SHA-256 does not match its content
    """
    try:
        body = Path(path).read_bytes()
        if body[8:9] != b"{":
            raise ValueError("it is no safetensors file, in which this version keeps tensors")
        header = json.loads(body[8 : 8 + int.from_bytes(body[:8], "little")])
        plain = json.loads(header["__metadata__"]["magrl"])
        digest = plain["sha256"].encode()
        if hashlib.sha256(body.replace(digest, _NO_DIGEST.encode(), 1)).hexdigest().encode() != digest:
            raise ValueError("its SHA-256 does not match its content")
        tensors = {name: tensor.to(device) for name, tensor in safetensors.torch.load(body).items()}
        return _unpack(plain["content"], tensors)
    except Exception as error:  # whatever json, safetensors and foreign content raise
        raise DamagedFileError(f"{path} is damaged: {str(error)[:200]}") from error


_NO_DIGEST = "0" * 64


def _pack(item: Any, tensors: dict[str, Tensor], name: str = "") -> Any:
    """Return data for JSON, and collect the tensors by the path that leads to them."""
    if isinstance(item, Tensor):
        while name in tensors:  # a key may hold a slash
            name += "'"
        tensors[name] = item.detach().cpu().clone(memory_format=torch.contiguous_format)
        return {"$tensor": name}
    if isinstance(item, Mapping):
        pairs = [(key, _pack(value, tensors, f"{name}/{key}")) for key, value in item.items()]
        metadata = _pack(getattr(item, "_metadata", None), tensors, f"{name}/$")  # of a state dictionary
        plain = metadata is None and all(isinstance(key, str) and key[:1] != "$" for key in item)
        return dict(pairs) if plain else {"$dict": pairs, "metadata": metadata}
    if isinstance(item, (list, tuple)):
        parts = [_pack(part, tensors, f"{name}/{index}") for index, part in enumerate(item)]
        return {"$tuple": parts} if isinstance(item, tuple) else parts
    return {"$device": str(item)} if isinstance(item, torch.device) else item


def _unpack(item: Any, tensors: dict[str, Tensor]) -> Any:
    """Return what :func:`_pack` was given; each tensor stands in one place, so that its size bounds all work on it."""
    if isinstance(item, list):
        return [_unpack(part, tensors) for part in item]
    match item:
        case {"$tensor": name}:
            return tensors.pop(name)
        case {"$tuple": parts}:
            return tuple(_unpack(parts, tensors))
        case {"$device": name}:
            return torch.device(name)
        case {"$dict": pairs, "metadata": metadata}:
            state = OrderedDict((key, _unpack(value, tensors)) for key, value in pairs)
            state._metadata = _unpack(metadata, tensors)  # type: ignore[attr-defined]
            return state
        case dict():
            return {key: _unpack(value, tensors) for key, value in item.items()}
    return item


def json_ready(value: Any) -> Any:
    """Return numbers and texts with None for NaN and infinities, which JSON lacks, inside containers too.

    Example:
        >>> json_ready({"runs": [{"steps": 9, "spl": math.nan}]})
        {'runs': [{'steps': 9, 'spl': None}]}
    """
    if isinstance(value, Mapping):
        return {key: json_ready(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write numbers and texts as strict JSON, in their order; NaN and infinities become null.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "eval.json"
        >>> write_json(path, {"steps": 9, "spl": math.nan})
        >>> json.loads(path.read_text())
        {'steps': 9, 'spl': None}
    """
    write_atomically(path, f"{json.dumps(json_ready(content), indent=2, allow_nan=False)}\n".encode())


def check_writable(path: Path) -> None:
    """Raise unless a file can be written, before anything is computed for it; missing folders are created.

    Raises:
        OSError: naming the file and the reason.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "new" / "page.html"
        >>> check_writable(path)
        >>> path.parent.is_dir(), path.exists()
        (True, False)
    """
    path = path.resolve()  # a link stays, also one to nothing
    existed = path.exists()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab"):
            pass
    except OSError as error:
        raise _not_written(path, error) from error
    if not existed:
        path.unlink()


def read_text(path: Path) -> str:
    """Return the content of a text file, with newlines alone between its lines.

    Raises:
        ValueError: for a file that is no text in UTF-8.
        OSError: for a file that cannot be read.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "log.csv"
        >>> _ = path.write_bytes("heading [°]".encode("latin1"))
        >>> read_text(path)
        Traceback (most recent call last):
        ValueError: byte 10 is not UTF-8: save the file as text in UTF-8
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"byte {error.start + 1} is not UTF-8: save the file as text in UTF-8") from error


def read_document(path: Path) -> Any:
    """Return the content of a TOML or JSON file that a user wrote.

    Raises:
        ValueError: for another suffix, or a file that is not valid.
        OSError: for a file that cannot be read.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "mine.toml"
        >>> _ = path.write_text("speed_km_h = 15.0")
        >>> read_document(path)
        {'speed_km_h': 15.0}
    """
    parsers: dict[str, Callable[[str], Any]] = {".toml": tomllib.loads, ".json": json.loads}
    if path.suffix.lower() not in parsers:
        raise ValueError(f"the file must end in .toml or .json, got {path.suffix!r}")
    content = path.read_bytes()
    try:
        return parsers[path.suffix.lower()](content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"the file is not valid {path.suffix[1:].upper()}: {error}") from error


def locked(folder: Path) -> AcquireReturnProxy:
    """Claim a run folder for this process until the end of the block of ``with``; a kill releases it too.

    Raises:
        UsageError: if another process writes it, or it cannot be written.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder, locked(Path(folder)):
        ...     with locked(Path(folder)):  # doctest: +ELLIPSIS
        ...         pass
        Traceback (most recent call last):
        magrl.commands.UsageError: another process is writing the run folder ...
    """
    try:
        return FileLock(folder / ".lock").acquire(timeout=0)
    except Timeout as error:
        raise UsageError(f"another process is writing the run folder {folder}") from error
    except OSError as error:
        raise UsageError(f"the run folder {folder} cannot be written ({error.strerror})") from error
