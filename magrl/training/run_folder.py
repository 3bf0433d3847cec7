"""Run folders: creation and the lock that keeps a second process out."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from magrl.checks import check_type
from magrl.training.config import UsageError


def create_run_folder(path: Path | str) -> Path:
    """Create the folder of a run; a run never writes over another.

    Raises:
        UsageError: if it exists and is not empty, saying whether the run there is complete or can be resumed; or if
            it cannot be made.

    Example:
        >>> import tempfile
        >>> create_run_folder(Path(tempfile.mkdtemp()) / "run").is_dir()
        True
    """
    path = Path(path)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        if (path / "eval.json").is_file():
            raise UsageError(f"the run in {path} is complete: choose another --out, or remove it")
        if (path / "config.json").is_file():
            raise UsageError(
                f"{path} holds a run that is not complete: --resume {path}, choose another --out, or remove it"
            )
        raise UsageError(f"the run folder {path} is not empty: choose another --out")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"the run folder {path} cannot be made ({error.strerror}): choose another --out") from error
    return path


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Claim a run folder for this process while the block runs; a kill releases it too.

    Raises:
        UsageError: if another process writes it.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> with locked(folder):
        ...     try:
        ...         with locked(folder):
        ...             pass
        ...     except UsageError:
        ...         print("one writer at a time")
        one writer at a time
    """
    check_type(Path, folder=folder)
    lock = FileLock(folder / ".lock")
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise UsageError(f"another process is writing the run folder {folder}") from error
    try:
        yield
    finally:
        lock.release()
