"""What a training leaves behind: its folder, its curves, its pictures, and its wandb run."""

from __future__ import annotations

import contextlib
import csv
import json
import math
import shutil
import signal
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

from filelock import FileLock, Timeout
from matplotlib.figure import Figure

from magrl.geodesy import check_type

WANDB_PROJECT = "magrl"
WANDB_MODES = ("offline", "online", "disabled")


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
    """Writes numbers and texts in their order; NaN, which JSON lacks, becomes null."""
    check_type(Path, path=path)
    clean = {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in content.items()}
    path.write_text(json.dumps(clean, indent=2, allow_nan=False) + "\n")


class RunLog:
    """Writes a run to its folder and, unless that is disabled, to wandb, through TorchRL's logger.

    Args:
        folder: from :func:`create_run_folder`.
        columns: of ``train.csv``, in order.
        config: written to ``config.json`` and shown by wandb.
        wandb_mode: ``offline`` (no network, no login), ``online``, or ``disabled`` (nothing of wandb is written).
        group: runs that belong together.
        tags: to filter runs by.
        resumed: whether the run goes on; its files stay as they are until :meth:`load_state_dict`.

    Raises:
        ValueError: for another mode.
    """

    def __init__(
        self,
        folder: Path,
        columns: Sequence[str],
        config: Mapping[str, Any],
        *,
        wandb_mode: str = "disabled",
        group: str = "",
        tags: Sequence[str] = (),
        resumed: bool = False,
    ) -> None:
        check_type(Path, folder=folder)
        _check_mode(wandb_mode)
        self.folder, self.columns, self.rows = folder, tuple(columns), list[dict[str, float]]()
        self._wandb_options = (folder, wandb_mode, config, group, tags)
        self._began = time.perf_counter()
        if not resumed:
            write_json(folder / "config.json", config)
            self._open([], uuid.uuid4().hex[:8])

    def _open(self, rows: Sequence[Mapping[str, float]], wandb_id: str) -> None:
        """Starts ``train.csv`` with some rows, and the wandb run."""
        aside = self.folder / "train.csv.aside"
        self._file = aside.open("w", newline="")
        self._writer = csv.DictWriter(self._file, self.columns)
        self._writer.writeheader()
        for row in rows:
            self._write(row)
        aside.replace(self.folder / "train.csv")
        self._wandb = WandbRun(*self._wandb_options, run_id=wandb_id)

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
        self._wandb.row(row)

    def figure(self, name: str, figure: Figure) -> None:
        """Saves a picture as ``<name>.png``."""
        path = self.folder / f"{name}.png"
        figure.savefig(path, dpi=120)
        self._wandb.picture(name, path)

    def result(self, result: Mapping[str, float]) -> None:
        """Writes ``eval.json``; wandb gets a table and its summary."""
        write_json(self.folder / "eval.json", result)
        self._wandb.table("final/table", [["measure", "value"], *([key, f"{x:.6g}"] for key, x in result.items())])
        self._wandb.summary({f"final/{key}": value for key, value in result.items()})

    def state_dict(self) -> dict[str, Any]:
        """The rows so far, the time that they took, and the wandb run that they went to."""
        return {"rows": list(self.rows), "seconds": self.seconds, "wandb_id": self._wandb.run_id}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Goes on from those rows; later ones that are in the file are dropped."""
        self._began = time.perf_counter() - float(state_dict["seconds"])
        self._open(state_dict["rows"], str(state_dict["wandb_id"]))

    def close(self) -> None:
        """Closes the files and the wandb run."""
        self._file.close()
        self._wandb.close()


class WandbRun:
    """A run of wandb, or nothing at all where that is disabled: every method may be called either way.

    What goes wrong in wandb (a folder that cannot be written, a full disk) is said once and never stops the caller.

    Args:
        folder: of the run; wandb gets the folder ``wandb`` in it.
        mode: ``offline`` (no network, no login), ``online`` or ``disabled``.
        config: shown with the run.
        group: runs that belong together.
        tags: to filter runs by.
        run_id: of the run; one that exists is gone on with.

    Raises:
        ValueError: for another mode.
    """

    def __init__(
        self,
        folder: Path,
        mode: str,
        config: Mapping[str, Any],
        group: str = "",
        tags: Sequence[str] = (),
        *,
        run_id: str = "",
    ) -> None:
        check_type(Path, folder=folder)
        _check_mode(mode)
        self.folder, self.run_id = folder, run_id or uuid.uuid4().hex[:8]
        self._logger: Any = None
        if mode != "disabled":
            options = {"id": self.run_id, "resume": "allow", "group": group, "tags": list(tags)}
            self._try(lambda: setattr(self, "_logger", _wandb_logger(folder, mode, config, options)))

    def _try(self, action: Callable[[], Any]) -> None:
        try:
            action()
        except Exception as error:
            self._logger = None
            print(f"wandb failed and is left out from here on: {error}", file=sys.stderr)

    def row(self, row: Mapping[str, float]) -> None:
        """Points of curves; ``frames`` is the step."""
        for key, value in row.items():
            if self._logger and key != "frames" and math.isfinite(value):
                self._try(lambda: self._logger.log_scalar(_panel(key), value, step=int(row["frames"])))  # noqa: B023

    def picture(self, name: str, path: Path) -> None:
        """A picture that lies in a file."""
        if self._logger:
            import wandb

            self._try(lambda: self._logger.experiment.log({f"figures/{name}": wandb.Image(str(path))}))

    def table(self, name: str, rows: Sequence[Sequence[str]]) -> None:
        """A table of texts, as HTML: a wandb.Table would put the absolute path of its staging folder into the run."""
        if self._logger:
            import wandb

            lines = ("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
            html = f"<table>{''.join(lines)}</table>"
            self._try(lambda: self._logger.experiment.log({name: wandb.Html(html, inject=False)}))

    def summary(self, values: Mapping[str, float]) -> None:
        """Final values."""
        if self._logger:
            self._try(lambda: self._logger.experiment.summary.update(dict(values)))

    def close(self) -> None:
        """Ends the run, and removes wandb's own debug logs, which are full of this machine's paths."""
        if self._logger:
            self._try(lambda: self._logger.experiment.finish())
            for link in (self.folder / "wandb").glob("debug*.log"):
                link.unlink()
            for logs in (self.folder / "wandb").glob("*run-*/logs"):
                shutil.rmtree(logs)


def _check_mode(mode: str) -> None:
    if mode not in WANDB_MODES:
        raise ValueError(f"the mode of wandb must be one of {', '.join(WANDB_MODES)}, got {mode!r}")


def _panel(key: str) -> str:
    """The wandb panel of a column: what it starts with, or ``train``."""
    for prefix in ("eval", "reward", "loss"):
        if key.startswith(prefix + "_"):
            return f"{prefix}/{key.removeprefix(prefix + '_')}"
    return f"train/{key}"


def _wandb_logger(folder: Path, mode: str, config: Mapping[str, Any], options: Mapping[str, Any]) -> Any:
    """TorchRL's wandb logger, writing under the run folder and telling nothing of the machine."""
    import wandb
    from torchrl.record.loggers import get_logger

    private = wandb.Settings(
        silent=True,
        console="off",
        host="private",
        disable_git=True,
        disable_code=True,
        disable_job_creation=True,
        x_disable_meta=True,
        x_disable_stats=True,
        x_disable_machine_info=True,
    )
    wandb_kwargs = {"project": WANDB_PROJECT, "mode": mode, "config": dict(config), "settings": private}
    wandb_kwargs |= {"log_env_packages": False, **options}
    return get_logger("wandb", logger_name=str(folder), experiment_name=folder.name, wandb_kwargs=wandb_kwargs)
