"""Where the curves of a run are shown: wandb, TensorBoard, or CSV files, each through TorchRL's logger.

A logger is a guest. What goes wrong in it (a folder that cannot be written, a full disk) is said once and never stops
the caller. Curves have one name everywhere, :func:`panels`, and one axis, the frames.
"""

from __future__ import annotations

import contextlib
import importlib.util
import math
import os
import re
import shutil
import sys
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

from magrl.checks import check_type

WANDB_PROJECT = "magrl"
"""Where runs go unless WANDB_PROJECT says otherwise."""
Logger = Literal["wandb", "tensorboard", "csv"]
WandbMode = Literal["offline", "online", "disabled"]
LOGGERS, WANDB_MODES = get_args(Logger), get_args(WandbMode)


def check_logger(logger: str, wandb_mode: str = "offline") -> None:
    """Refuses a logger that is unknown or not installed, before anything is written.

    Raises:
        ValueError: naming the choices, or what to install.

    Example:
        >>> check_logger("csv")
        >>> check_logger("paper")
        Traceback (most recent call last):
        ValueError: logger must be one of wandb, tensorboard, csv, got 'paper'
    """
    if logger not in LOGGERS:
        raise ValueError(f"logger must be one of {', '.join(LOGGERS)}, got {logger!r}")
    if wandb_mode not in WANDB_MODES:
        raise ValueError(f"wandb_mode must be one of {', '.join(WANDB_MODES)}, got {wandb_mode!r}")
    if logger == "tensorboard" and importlib.util.find_spec("tensorboard") is None:
        raise ValueError("the logger tensorboard is not installed: pip install 'magrl[tensorboard]'")


def panels(row: Mapping[str, float], before: Mapping[str, float] | None = None) -> dict[str, float]:
    """A row of curves under the names that loggers show them by.

    Args:
        row: columns of ``train.csv``; ``seconds``, ``frames`` and ``updates`` count from the start of the run.
        before: the row before it, from which on speeds are taken; the start of the run by default.

    Returns:
        The finite values, in the groups ``train``, ``eval``, ``reward`` and ``time``; ``frames`` is left out, the axis.

    Example:
        >>> panels({"frames": 200, "seconds": 4.0, "return": 1.5, "eval_spl": 90.0})
        {'time/seconds': 4.0, 'train/return': 1.5, 'eval/spl': 90.0, 'time/frames_per_second': 50.0}
    """
    before = before or {}
    curves = {_panel(key): float(value) for key, value in row.items() if key != "frames"}
    seconds = row.get("seconds", 0.0) - before.get("seconds", 0.0)
    for what in ("frames", "updates") if seconds > 0 else ():
        if what in row:
            curves[f"time/{what}_per_second"] = (row[what] - before.get(what, 0)) / seconds
    return {key: value for key, value in curves.items() if math.isfinite(value)}


def _panel(key: str) -> str:
    """The panel of a column: what it starts with, or ``train``."""
    for prefix in ("eval", "reward"):
        if key.startswith(prefix + "_"):
            return f"{prefix}/{key.removeprefix(prefix + '_')}"
    return f"time/{key}" if key == "seconds" else f"train/{key}"


class CurveLog:
    """A logger, or nothing at all: every method may be called either way.

    Args:
        name: what is said to have failed, when something does.
        make: opens TorchRL's logger; None for nothing at all.

    Example:
        >>> log = CurveLog("nothing", None)
        >>> log.row({"frames": 512, "return": -3.5})
        >>> log.close()
    """

    run_id = ""
    """Of the run in wandb."""

    def __init__(self, name: str, make: Callable[[], Any] | None) -> None:
        self.name = name
        self._before: dict[str, float] = {}
        self._logger: Any = None
        if make is not None:
            self._logger = self._try(make)

    def _try(self, action: Callable[[], Any]) -> Any:
        try:
            return action()
        except Exception as error:
            self._logger = None
            print(f"{self.name} failed and is left out from here on: {error}", file=sys.stderr)

    def row(self, row: Mapping[str, float]) -> None:
        """Points of curves; ``frames`` is the step."""
        curves, self._before = panels(row, self._before), dict(row)
        if self._logger and curves:
            self._try(lambda: self._log(curves, int(row["frames"])))

    def _log(self, curves: dict[str, float], frames: int) -> None:
        self._logger.log_metrics(curves, step=frames)

    def summary(self, values: Mapping[str, float]) -> None:
        """Final values, at the frames of the last row."""
        if self._logger:
            final = {key: value for key, value in values.items() if math.isfinite(value)}
            self._try(lambda: self._logger.log_metrics(final, step=int(self._before.get("frames", 0))))

    def picture(self, name: str, path: Path) -> None:
        """A picture that lies in a file, where the logger shows pictures."""

    def table(self, name: str, rows: Sequence[Mapping[str, Any]]) -> None:
        """A table with the columns of its first row, where the logger shows tables."""

    def artifact(self, path: Path, metadata: Mapping[str, Any]) -> None:
        """A file that is a result of the run, where the logger keeps such."""

    def close(self) -> None:
        """Ends the run."""
        if self._logger and hasattr(self._logger.experiment, "close"):
            self._try(lambda: self._logger.experiment.close())


class ScalarLog(CurveLog):
    """Curves in TensorBoard's or in CSV files, in a folder of the run folder that is named after the logger.

    What an earlier part of the same run left there is removed: a run that goes on hands in all of its rows again.

    Raises:
        ValueError: for a logger that is unknown or not installed.

    Example:
        >>> import tempfile
        >>> log = ScalarLog(Path(tempfile.mkdtemp()), "csv")
        >>> log.row({"frames": 512, "eval_spl": 90.0})
        >>> log.close()
    """

    def __init__(self, folder: Path, logger: str) -> None:
        check_type(Path, folder=folder)
        check_logger(logger)
        super().__init__(logger, lambda: self._open(folder, logger))

    def _open(self, folder: Path, logger: str) -> Any:
        from torchrl.record.loggers import get_logger

        shutil.rmtree(folder / logger, ignore_errors=True)
        return get_logger(logger, logger_name=str(folder), experiment_name=logger)


class WandbRun(CurveLog):
    """A run of wandb, or nothing at all where that is disabled.

    Everything that wandb writes lies in the folder ``wandb`` of the run folder, ready for ``wandb sync``. In the mode
    ``offline`` it asks nothing and looks up no host.

    Args:
        folder: of the run; its name is that of the run in wandb.
        mode: ``offline`` (no network, no login), ``online`` or ``disabled``.
        config: shown with the run.
        group: runs that belong together.
        tags: to filter runs by.
        run_id: of the run; one that exists is gone on with.

    Raises:
        ValueError: for another mode.

    Example:
        >>> import tempfile
        >>> run = WandbRun(Path(tempfile.mkdtemp()), "disabled", {"seed": 0})
        >>> run.row({"frames": 512, "return": -3.5})
        >>> run.close()
        >>> list(run.folder.iterdir())
        []
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
        check_logger("wandb", mode)
        self.folder, self.run_id = folder, run_id or uuid.uuid4().hex[:8]
        options = {"id": self.run_id, "resume": "allow", "group": group, "tags": list(tags)}
        super().__init__("wandb", None if mode == "disabled" else lambda: _wandb_logger(folder, mode, config, options))

    def _try(self, action: Callable[[], Any]) -> Any:
        with _wandb_in(self.folder):
            return super()._try(action)

    def _log(self, curves: dict[str, float], frames: int) -> None:
        # wandb's own step is the frames too: rows that a resumed run hands in again are then the same rows.
        self._logger.experiment.log({"frames": frames, **curves}, step=frames, commit=True)

    def summary(self, values: Mapping[str, float]) -> None:
        """Final values."""
        if self._logger:
            self._try(lambda: self._logger.experiment.summary.update(dict(values)))

    def picture(self, name: str, path: Path) -> None:
        """A picture that lies in a file."""
        if self._logger:
            import wandb

            self._try(lambda: self._logger.experiment.log({f"figures/{name}": wandb.Image(str(path))}))

    def table(self, name: str, rows: Sequence[Mapping[str, Any]]) -> None:
        """A table with the columns of its first row; NaN is an empty cell."""
        if self._logger:
            import wandb

            def log() -> None:
                cells = [[_plain(row[column]) for column in rows[0]] for row in rows]
                table = wandb.Table(columns=list(rows[0]), data=cells, allow_mixed_types=True)
                self._logger.experiment.log({name: table})

            self._try(log)

    def artifact(self, path: Path, metadata: Mapping[str, Any]) -> None:
        """A model, named after its file and the run folder; the file itself is kept, not a copy."""
        if self._logger:
            import wandb

            def log() -> None:
                name = re.sub(r"[^\w.-]", "-", f"{path.stem}-{self.folder.name}", flags=re.ASCII)[:128]
                model = wandb.Artifact(name, "model", metadata={key: _plain(x) for key, x in metadata.items()})
                model.add_file(str(path.absolute()), policy="immutable", skip_cache=True)
                self._logger.experiment.log_artifact(model)

            self._try(log)

    def close(self) -> None:
        """Ends the run, and removes wandb's own debug logs, which are full of this machine's paths."""
        if self._logger:
            self._try(lambda: self._logger.experiment.finish())
            for link in (self.folder / "wandb").glob("debug*.log"):
                link.unlink()
            for logs in ((self.folder / "wandb" / "wandb"), *(self.folder / "wandb").glob("*run-*/logs")):
                shutil.rmtree(logs, ignore_errors=True)


def open_log(
    logger: str,
    folder: Path,
    config: Mapping[str, Any],
    *,
    wandb_mode: str = "offline",
    group: str = "",
    tags: Sequence[str] = (),
    run_id: str = "",
) -> CurveLog:
    """The logger of a name, one of :data:`LOGGERS`.

    Raises:
        ValueError: for another name, one that is not installed, or another mode of wandb.

    Example:
        >>> import tempfile
        >>> log = open_log("wandb", Path(tempfile.mkdtemp()), {"seed": 0}, wandb_mode="disabled")
        >>> type(log).__name__
        'WandbRun'
    """
    check_logger(logger, wandb_mode)
    if logger == "wandb":
        return WandbRun(folder, wandb_mode, config, group, tags, run_id=run_id)
    return ScalarLog(folder, logger)


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


@contextlib.contextmanager
def _wandb_in(folder: Path) -> Iterator[None]:
    """Keeps wandb's staged files and logs in the run folder, not the home folder, and its crash reports at home.

    Those reports look up their host when wandb starts, even offline.
    """
    own = dict.fromkeys(("WANDB_DATA_DIR", "WANDB_CACHE_DIR"), str(folder.absolute() / "wandb"))
    own["WANDB_ERROR_REPORTING"] = "false"
    before = {key: os.environ.get(key) for key in own}
    os.environ.update(own)
    try:
        yield
    finally:
        for key, value in before.items():
            if value is None:
                del os.environ[key]
            else:
                os.environ[key] = value


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
    project = os.environ.get("WANDB_PROJECT", WANDB_PROJECT)
    wandb_kwargs = {"project": project, "mode": mode, "config": dict(config), "settings": private}
    wandb_kwargs |= {"log_env_packages": False, **options}
    logger = get_logger("wandb", logger_name=str(folder), experiment_name=folder.name, wandb_kwargs=wandb_kwargs)
    logger.experiment.define_metric("frames")
    logger.experiment.define_metric("*", step_metric="frames")
    return logger
