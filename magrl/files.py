"""Safe files: tensors with atomic writes and a checksum, strict JSON, TOML. Reading a file executes no code from it."""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import sys
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from magrl.checks import check_type, short

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MAX_FILE_BYTES = 10_000_000
"""Largest TOML or JSON file: a scenario with about fifty thousand tasks."""


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
    """Write tensors with :func:`torch.save` atomically, with their SHA-256 as the comment of the archive.

    Args:
        content: tensors, numbers, text and containers of them.
        path: path of the file; an existing file is replaced.

    Raises:
        OSError: if it cannot be written; an existing file stays unchanged.

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


def load_tensors(path: Path | str, device: torch.device | str = "cpu") -> Any:
    """Read a file of :func:`save_tensors` from any source: it runs no code and takes no more memory than disk space.

    Args:
        path: path of the file.
        device: device of the tensors.

    Returns:
        What was saved.

    Raises:
        DamagedFileError: naming the file and what is wrong with it.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "numbers.pt"
        >>> save_tensors([1, 2], path)
        >>> load_tensors(path)
        [1, 2]
        >>> _ = path.write_bytes(path.read_bytes()[:-1])  # the last byte is missing
        >>> try:
        ...     load_tensors(path)
        ... except DamagedFileError as error:
        ...     print(str(error).partition(": ")[2])
        its SHA-256 does not match its content
    """
    try:
        content = Path(path).read_bytes()
        body = content[: -_DIGEST_LENGTH - 2] + bytes(2)
        if hashlib.sha256(body).hexdigest().encode() != content[-_DIGEST_LENGTH:]:
            raise ValueError("its SHA-256 does not match its content")
        with zipfile.ZipFile(io.BytesIO(body)) as archive:
            if any(item.compress_type != zipfile.ZIP_STORED for item in archive.infolist()):
                raise ValueError("it holds compressed entries")
        return torch.load(io.BytesIO(body), map_location=device, weights_only=True)
    except Exception as error:  # whatever zipfile and torch raise for a foreign archive
        raise DamagedFileError(f"{path} is damaged: {error}") from error


def _sync_folder(folder: Path) -> None:
    """Make a rename survive a power failure, where folders can be synchronized."""
    if os.name == "posix":
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


_DIGEST_LENGTH = 64


def json_ready(value: Any) -> Any:
    """Return numbers and texts with None in place of NaN and infinities, which JSON lacks, inside containers too.

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
    check_type(Path, path=path)
    path.write_text(json.dumps(json_ready(content), indent=2, allow_nan=False) + "\n")


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
    existed = path.exists()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab"):
            pass
    except OSError as error:
        raise OSError(f"cannot write {path}: {error.strerror}") from error
    if not existed:
        path.unlink()


def read_document(path: Path) -> Any:
    """Return the content of a TOML or JSON file that a user wrote.

    Raises:
        ValueError: for another suffix, a file that is too large or not valid, or a key that is repeated.
        OSError: for a file that cannot be read.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "mine.toml"
        >>> _ = path.write_text("speed_km_h = 15.0")
        >>> read_document(path)
        {'speed_km_h': 15.0}
    """
    parsers: dict[str, Callable[[str], Any]] = {".toml": tomllib.loads, ".json": _json}
    if path.suffix.lower() not in parsers:
        raise ValueError(f"the file must end in .toml or .json, got {path.suffix!r}")
    with path.open("rb") as file:
        content = file.read(MAX_FILE_BYTES + 1)
    if len(content) > MAX_FILE_BYTES:
        raise ValueError(f"the file holds more than {MAX_FILE_BYTES} bytes")
    try:
        return parsers[path.suffix.lower()](content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"the file is not valid {path.suffix[1:].upper()}: {error}") from error


def _json(text: str) -> Any:
    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len(dict(pairs)) < len(pairs):
            names = [key for key, _ in pairs]
            raise ValueError(f"the key {short(next(key for key in names if names.count(key) > 1))} is repeated")
        return dict(pairs)

    return json.loads(text, object_pairs_hook=unique)
