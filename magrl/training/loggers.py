"""Loggers of curves: wandb, TensorBoard or CSV files, each through TorchRL's logger.

Logging is best-effort: an error in a logger (a folder that cannot be written, a full disk) is reported once and never
stops the caller. Curves have the same names in every logger (:func:`panels`), and the same axis, frames.
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

from magrl.checks import check_choice
from magrl.files import json_ready

WANDB_PROJECT = "magrl"
"""Project of the runs, unless the environment variable WANDB_PROJECT is set."""

Logger = Literal["wandb", "tensorboard", "csv"]
WandbMode = Literal["offline", "online", "disabled"]
LOGGERS, WANDB_MODES = get_args(Logger), get_args(WandbMode)


def check_logger(logger: str, wandb_mode: str = "offline") -> None:
    """Raise unless a logger and a mode of wandb are known and installed.

    Raises:
        ValueError: naming the choices, or the command that installs the logger.

    Example:
        >>> check_logger("csv")
        >>> check_logger("paper")
        Traceback (most recent call last):
        ValueError: logger must be one of 'wandb', 'tensorboard', 'csv', got 'paper'
    """
    check_choice(LOGGERS, logger=logger)
    check_choice(WANDB_MODES, wandb_mode=wandb_mode)
    if logger == "tensorboard" and importlib.util.find_spec("tensorboard") is None:
        raise ValueError("the logger tensorboard is not installed: pip install 'magrl[tensorboard]'")


def panels(row: Mapping[str, float], before: Mapping[str, float] | None = None) -> dict[str, float]:
    """Return a row of curves under the names that loggers show them by.

    Args:
        row: columns of ``train.csv``; ``seconds``, ``frames`` and ``updates`` count from the start of the run.
        before: the row before it, from which on speeds are taken; the start of the run by default.

    Returns:
        The finite values, in the groups ``train``, ``eval``, ``return`` and ``time``; ``frames`` is left out, the axis.

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
    """Return the name of a column with its group: its prefix, or ``train``."""
    for prefix in ("eval", "return"):
        if key.startswith(prefix + "_"):
            return f"{prefix}/{key.removeprefix(prefix + '_')}"
    return f"time/{key}" if key == "seconds" else f"train/{key}"


class CurveLog:
    """A best-effort logger, which may be disabled: every method can be called either way.

    Args:
        name: name of the logger in the report of an error.
        make: function that opens TorchRL's logger; None to disable logging.

    Example:
        >>> log = CurveLog("nothing", None)
        >>> log.row({"frames": 512, "return": -3.5})
        >>> log.close()
    """

    run_id = ""
    """Id of the run in wandb."""

    def __init__(self, name: str, make: Callable[[], Any] | None) -> None:
        self.name, self._before = name, dict[str, float]()
        self._logger: Any = make and self._try(make)

    def _try(self, action: Callable[[], Any]) -> Any:
        """Return the result of an action; report an error and disable the logger."""
        try:
            return action()
        except Exception as error:
            self._logger = None
            print(f"{self.name} failed and is disabled for the rest of this run: {error}", file=sys.stderr)

    def _log(self, action: Callable[[Any], Any]) -> None:
        """Call an action with TorchRL's logger, unless logging is disabled."""
        if self._logger is not None:
            self._try(lambda: action(self._logger))

    def row(self, row: Mapping[str, float]) -> None:
        """Log a row of curves; ``frames`` is the step."""
        curves, self._before = panels(row, self._before), dict(row)
        if curves:
            self._log_curves(curves, int(row["frames"]))

    def _log_curves(self, curves: dict[str, float], frames: int) -> None:
        self._log(lambda logger: logger.log_metrics(curves, step=frames))

    def summary(self, values: Mapping[str, float]) -> None:
        """Log final values, at the step of the last row."""
        final = {key: value for key, value in values.items() if math.isfinite(value)}
        self._log(lambda logger: logger.log_metrics(final, step=int(self._before.get("frames", 0))))

    def picture(self, name: str, path: Path) -> None:
        """Log an image file, if the logger shows images."""

    def table(self, name: str, rows: Sequence[Mapping[str, Any]]) -> None:
        """Log a table with the columns of its first row, if the logger shows tables."""

    def artifact(self, path: Path, metadata: Mapping[str, Any]) -> None:
        """Log a file that is a result of the run, if the logger keeps files."""

    def close(self) -> None:
        """Close the logger."""
        self._log(lambda logger: getattr(logger.experiment, "close", lambda: None)())


class WandbRun(CurveLog):
    """A run of wandb, which may be disabled.

    All files of wandb are in the folder ``wandb`` of the run folder, ready for ``wandb sync``. In the mode ``offline``
    wandb needs no login and looks up no host.

    Args:
        folder: run folder; its name is the run's name in wandb.
        mode: ``offline`` (no network, no login), ``online`` or ``disabled``.
        config: settings shown with the run.
        group: runs that belong together.
        tags: labels to filter runs by.
        entity: user or team; by default from the login.
        run_id: id of the run; an existing run is resumed.

    Example:
        >>> run = WandbRun(Path("runs/A"), "disabled", {"seed": 0})
        >>> run.row({"frames": 512, "return": -3.5})
        >>> run.close()
        >>> run.folder.exists()
        False
    """

    def __init__(
        self,
        folder: Path,
        mode: str,
        config: Mapping[str, Any],
        group: str = "",
        tags: Sequence[str] = (),
        *,
        entity: str = "",
        run_id: str = "",
    ) -> None:
        self.folder, self.run_id = folder, run_id or uuid.uuid4().hex[:8]
        options = {"id": self.run_id, "resume": "allow", "group": group, "tags": list(tags), "entity": entity or None}
        super().__init__("wandb", None if mode == "disabled" else lambda: _wandb_logger(folder, mode, config, options))

    def _try(self, action: Callable[[], Any]) -> Any:
        with _wandb_in(self.folder):
            return super()._try(action)

    def _log_curves(self, curves: dict[str, float], frames: int) -> None:
        # The step of wandb is frames too, so that rows that a resumed run logs again are the same rows.
        self._log(lambda logger: logger.experiment.log({"frames": frames, **curves}, step=frames, commit=True))

    def summary(self, values: Mapping[str, float]) -> None:
        """Log final values."""
        self._log(lambda logger: logger.experiment.summary.update(dict(values)))

    def picture(self, name: str, path: Path) -> None:
        """Log an image file."""
        self._log(lambda logger: logger.experiment.log({f"figures/{name}": _wandb().Image(str(path))}))

    def table(self, name: str, rows: Sequence[Mapping[str, Any]]) -> None:
        """Log a table with the columns of its first row; NaN is an empty cell."""
        cells = {"columns": list(rows[0]), "data": json_ready([list(row.values()) for row in rows])}
        self._log(lambda logger: logger.experiment.log({name: _wandb().Table(**cells, allow_mixed_types=True)}))

    def artifact(self, path: Path, metadata: Mapping[str, Any]) -> None:
        """Log a model, named after its file and the run folder; wandb refers to the file and keeps no copy."""

        def log(logger: Any) -> None:
            name = re.sub(r"[^\w.-]", "-", f"{path.stem}-{self.folder.name}", flags=re.ASCII)[:128]
            model = _wandb().Artifact(name, "model", metadata=json_ready(metadata))
            model.add_file(str(path.absolute()), policy="immutable", skip_cache=True)
            logger.experiment.log_artifact(model)

        self._log(log)

    def close(self) -> None:
        """Finish the run, and remove the debug logs of wandb, which hold paths of the machine."""
        self._log(lambda logger: logger.experiment.finish())
        for log in self.folder.glob("wandb/debug*.log"):
            log.unlink()
        for logs in (self.folder / "wandb" / "wandb", *self.folder.glob("wandb/*run-*/logs")):
            shutil.rmtree(logs, ignore_errors=True)


def open_log(logger: str, folder: Path, config: Mapping[str, Any], wandb_mode: str, **wandb_options: Any) -> CurveLog:
    """Return a logger of :data:`LOGGERS`.

    TensorBoard and CSV files are in a folder of the run folder that is named after the logger. An existing one is
    removed: a run that is resumed logs all its rows again.

    Args:
        logger: name of the logger.
        folder: run folder.
        config: settings shown by wandb.
        wandb_mode: ``offline``, ``online`` or ``disabled``.
        **wandb_options: ``group``, ``tags``, ``entity`` and ``run_id`` of :class:`WandbRun`.

    Raises:
        ValueError: for an unknown logger or mode, or a logger that is not installed.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     log = open_log("csv", Path(folder), {"seed": 0}, "disabled")
        ...     log.row({"frames": 512, "eval_spl": 90.0})
        ...     log.close()
        ...     (Path(folder) / "csv" / "scalars" / "eval" / "spl.csv").read_text().strip()
        '512,90.0'
    """
    check_logger(logger, wandb_mode)
    if logger == "wandb":
        return WandbRun(folder, wandb_mode, config, **wandb_options)
    return CurveLog(logger, lambda: _scalar_logger(folder, logger))


def _scalar_logger(folder: Path, logger: str) -> Any:
    from torchrl.record.loggers import get_logger

    shutil.rmtree(folder / logger, ignore_errors=True)
    return get_logger(logger, logger_name=str(folder), experiment_name=logger)


def _wandb() -> Any:
    """Return the module wandb, which reads its settings when it is imported."""
    import wandb

    return wandb


@contextlib.contextmanager
def _wandb_in(folder: Path) -> Iterator[None]:
    """Keep the staged files of wandb in the run folder, and disable crash reports, which look up a host."""
    settings = dict.fromkeys(("WANDB_DATA_DIR", "WANDB_CACHE_DIR"), str(folder.absolute() / "wandb"))
    settings["WANDB_ERROR_REPORTING"] = "false"
    before = {key: os.environ.get(key) for key in settings}
    os.environ.update(settings)
    try:
        yield
    finally:
        for key in settings:
            del os.environ[key]
        os.environ.update({key: value for key, value in before.items() if value is not None})


def _wandb_logger(folder: Path, mode: str, config: Mapping[str, Any], options: Mapping[str, Any]) -> Any:
    """Return TorchRL's wandb logger, which writes to the run folder and records nothing about the machine."""
    from torchrl.record.loggers import get_logger

    disabled = ["disable_git", "disable_code", "disable_job_creation"]
    disabled += ["x_disable_meta", "x_disable_stats", "x_disable_machine_info"]
    settings: dict[str, Any] = {"silent": True, "console": "off", "host": "private", **dict.fromkeys(disabled, True)}
    project = os.environ.get("WANDB_PROJECT", WANDB_PROJECT)
    wandb_kwargs = {"project": project, "mode": mode, "config": dict(config), "settings": _wandb().Settings(**settings)}
    wandb_kwargs |= {"log_env_packages": False, **options}
    logger = get_logger("wandb", logger_name=str(folder), experiment_name=folder.name, wandb_kwargs=wandb_kwargs)
    logger.experiment.define_metric("frames")
    logger.experiment.define_metric("*", step_metric="frames")
    return logger
