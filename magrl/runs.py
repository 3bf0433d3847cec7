"""What a training leaves behind: its folder, its curves, its pictures, and its run in a logger."""

from __future__ import annotations

import contextlib
import csv
import json
import math
import signal
import threading
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Any

from filelock import FileLock, Timeout

from magrl.checks import check_type
from magrl.loggers import check_logger, open_log

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def create_run_folder(path: Path | str) -> Path:
    """Makes the folder of a run.

    Raises:
        FileExistsError: if it exists and holds anything, or is a file: a run never writes over another.

    Example:
        >>> import tempfile
        >>> create_run_folder(Path(tempfile.mkdtemp()) / "run").is_dir()
        True
    """
    path = Path(path)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise FileExistsError(f"the run folder {path} is in use: choose another --out, or move it away")
    path.mkdir(parents=True, exist_ok=True)
    return path


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Claims a run folder for this process while the block runs; a kill releases it too.

    Raises:
        FileExistsError: if another process writes it.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> with locked(folder):
        ...     try:
        ...         with locked(folder):
        ...             pass
        ...     except FileExistsError:
        ...         print("one writer at a time")
        one writer at a time
    """
    check_type(Path, folder=folder)
    lock = FileLock(folder / ".lock")
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise FileExistsError(f"another process is writing the run folder {folder}") from error
    try:
        yield
    finally:
        lock.release()


class StopRequest:
    """Ctrl-C and SIGTERM, kept until the loop asks, so that it ends where nothing is lost; a second one ends at once.

    Example:
        >>> with StopRequest() as stop:
        ...     stop.exit_code is None
        True
    """

    def __init__(self) -> None:
        self.exit_code: int | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():  # elsewhere signals cannot be handled
            self._before = {number: signal.signal(number, self._note) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, _: FrameType | None) -> None:
        if self.exit_code is not None:
            raise KeyboardInterrupt
        self.exit_code = 128 + number  # what a shell reports for a process that a signal ended


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Writes numbers and texts in their order; NaN, which JSON lacks, becomes null.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "eval.json"
        >>> write_json(path, {"steps": 9, "spl": math.nan})
        >>> json.loads(path.read_text())
        {'steps': 9, 'spl': None}
    """
    check_type(Path, path=path)
    clean = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in content.items()}
    path.write_text(json.dumps(clean, indent=2, allow_nan=False) + "\n")


class RunLog:
    """Writes a run to its folder and, unless that is disabled, to a logger (:mod:`magrl.loggers`).

    Args:
        folder: from :func:`create_run_folder`.
        columns: of ``train.csv``, in order.
        config: written to ``config.json`` and shown by wandb.
        logger: ``wandb``, ``tensorboard`` or ``csv``.
        wandb_mode: ``offline`` (no network, no login), ``online``, or ``disabled`` (nothing of wandb is written).
        group: runs that belong together.
        tags: to filter runs by.
        resumed: whether the run goes on; its files stay as they are until :meth:`load_state_dict`.

    Raises:
        ValueError: for another logger or mode, or a logger that is not installed.

    Example:
        >>> import tempfile
        >>> log = RunLog(Path(tempfile.mkdtemp()), ["frames", "return"], {"seed": 0})
        >>> log.row({"frames": 512, "return": -3.5})
        >>> log.close()
        >>> (log.folder / "train.csv").read_text().split()
        ['frames,return', '512,-3.5']
    """

    def __init__(
        self,
        folder: Path,
        columns: Sequence[str],
        config: Mapping[str, Any],
        *,
        logger: str = "wandb",
        wandb_mode: str = "disabled",
        group: str = "",
        tags: Sequence[str] = (),
        resumed: bool = False,
    ) -> None:
        check_type(Path, folder=folder)
        check_logger(logger, wandb_mode)
        self.folder, self.columns, self.rows = folder, tuple(columns), list[dict[str, float]]()
        self._open_log = partial(open_log, logger, folder, config, wandb_mode=wandb_mode, group=group, tags=tuple(tags))
        self._began = time.perf_counter()
        if not resumed:
            write_json(folder / "config.json", config)
            self._open([], uuid.uuid4().hex[:8])

    def _open(self, rows: Sequence[Mapping[str, float]], wandb_id: str) -> None:
        """Starts ``train.csv`` and the logger, both with some rows."""
        aside = self.folder / "train.csv.aside"
        self._file = aside.open("w", newline="")
        self._writer = csv.DictWriter(self._file, self.columns)
        self._writer.writeheader()
        for row in rows:
            self._write(row)
        aside.replace(self.folder / "train.csv")
        self._log = self._open_log(run_id=wandb_id)
        for row in rows:
            self._log.row(row)

    def _write(self, row: Mapping[str, float]) -> None:
        self.rows.append(dict(row))
        self._writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()})
        self._file.flush()

    @property
    def seconds(self) -> float:
        """Time since the run began; where it was resumed, the time between is left out."""
        return time.perf_counter() - self._began

    def row(self, row: Mapping[str, float]) -> None:
        """Adds a row of curves; it is in the file when this returns. ``frames`` is the step."""
        self._write(row)
        self._log.row(row)

    def figure(self, name: str, figure: Figure) -> None:
        """Saves a picture as ``<name>.png``."""
        path = self.folder / f"{name}.png"
        figure.savefig(path, dpi=120)
        self._log.picture(name, path)

    def result(self, result: Mapping[str, float], navigator: str = "") -> None:
        """Writes ``eval.json``; wandb also gets a row of its table of navigators, final values, and ``policy.pt``."""
        write_json(self.folder / "eval.json", result)
        self._log.table("eval/navigators", [{"navigator": navigator, **result}])
        self._log.summary({f"final/{key}": value for key, value in result.items()})
        if (self.folder / "policy.pt").is_file():
            self._log.artifact(self.folder / "policy.pt", {"navigator": navigator, **result})

    def state_dict(self) -> dict[str, Any]:
        """The rows so far, the time that they took, and the run of wandb that they went to."""
        return {"rows": list(self.rows), "seconds": self.seconds, "wandb_id": self._log.run_id}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Goes on from those rows; later ones that are in the file are dropped."""
        self._began = time.perf_counter() - float(state_dict["seconds"])
        self._open(state_dict["rows"], str(state_dict["wandb_id"]))

    def close(self) -> None:
        """Closes the files and the logger."""
        self._file.close()
        self._log.close()
