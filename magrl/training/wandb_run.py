"""Curves of a training in wandb, through TorchRL's logger.

Logging is best-effort: an error of wandb (a folder that cannot be written, a full disk) is reported once and never
stops the caller.
"""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import sys
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

WANDB_PROJECT = "magrl"
"""Project of the runs, unless the environment variable WANDB_PROJECT is set."""

WandbMode = Literal["offline", "online", "disabled"]


def panels(row: Mapping[str, float], before: Mapping[str, float] | None = None) -> dict[str, float]:
    """Return a row of curves under the names that wandb shows them by.

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


class WandbRun:
    """A run of wandb, which may be disabled: every method can be called either way.

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
        mode: WandbMode,
        config: Mapping[str, Any],
        group: str = "",
        tags: Sequence[str] = (),
        *,
        entity: str = "",
        run_id: str = "",
    ) -> None:
        self.folder, self.run_id, self._before = folder, run_id or uuid.uuid4().hex[:8], dict[str, float]()
        options = {"id": self.run_id, "resume": "allow", "group": group, "tags": list(tags), "entity": entity or None}
        self._run: Any = None
        if mode != "disabled":
            self._run = self._try(lambda: _opened(folder, mode, config, options))

    def _try(self, action: Callable[[], Any]) -> Any:
        """Return the result of an action; report an error and disable the run."""
        try:
            with _wandb_in(self.folder):
                return action()
        except Exception as error:
            self._run = None
            print(f"wandb failed and is disabled for the rest of this run: {error}", file=sys.stderr)

    def _log(self, action: Callable[[Any], Any]) -> None:
        """Call an action with the run, unless it is disabled."""
        if self._run is not None:
            self._try(lambda: action(self._run))

    def row(self, row: Mapping[str, float]) -> None:
        """Log a row of curves; ``frames`` is the step, so that rows that a resumed run logs again are the same rows."""
        curves, self._before, frames = panels(row, self._before), dict(row), int(row["frames"])
        if curves:
            self._log(lambda run: run.log({"frames": frames, **curves}, step=frames, commit=True))

    def summary(self, values: Mapping[str, float]) -> None:
        """Log final values."""
        self._log(lambda run: run.summary.update(dict(values)))

    def picture(self, name: str, path: Path) -> None:
        """Log an image file."""
        self._log(lambda run: run.log({f"figures/{name}": _wandb().Image(str(path))}))

    def close(self) -> None:
        """Finish the run, and remove the debug logs of wandb, which hold paths of the machine."""
        self._log(lambda run: run.finish())
        for log in self.folder.glob("wandb/debug*.log"):
            log.unlink()
        for logs in (self.folder / "wandb" / "wandb", *self.folder.glob("wandb/*run-*/logs")):
            shutil.rmtree(logs, ignore_errors=True)


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


def _opened(folder: Path, mode: str, config: Mapping[str, Any], options: Mapping[str, Any]) -> Any:
    """Return a run of TorchRL's wandb logger: it writes to the run folder and records nothing about the machine."""
    from torchrl.record.loggers import get_logger

    disabled = ["disable_git", "disable_code", "disable_job_creation"]
    disabled += ["x_disable_meta", "x_disable_stats", "x_disable_machine_info"]
    settings: dict[str, Any] = {"silent": True, "console": "off", "host": "private", **dict.fromkeys(disabled, True)}
    project = os.environ.get("WANDB_PROJECT", WANDB_PROJECT)
    wandb_kwargs = {"project": project, "mode": mode, "config": dict(config), "settings": _wandb().Settings(**settings)}
    wandb_kwargs |= {"log_env_packages": False, **options}
    logger = get_logger("wandb", logger_name=str(folder), experiment_name=folder.name, wandb_kwargs=wandb_kwargs)
    run = logger.experiment
    run.define_metric("frames")
    run.define_metric("*", step_metric="frames")
    return run
