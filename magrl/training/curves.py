"""Curves and results of a run: train.csv, figures and eval.json, and the same data in a logger."""

from __future__ import annotations

import csv
import time
import uuid
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magrl.checks import check_type
from magrl.files import write_json
from magrl.training.loggers import check_logger, open_log

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class RunLog:
    """Curves and results of a run, written to its folder and to a logger (:mod:`magrl.training.loggers`).

    Args:
        folder: run folder.
        columns: columns of ``train.csv``, in order.
        config: settings of the run, shown by wandb.
        logger: ``wandb``, ``tensorboard`` or ``csv``.
        wandb_mode: ``offline`` (no network, no login), ``online``, or ``disabled`` (nothing of wandb is written).
        group: runs that belong together.
        tags: labels to filter runs by.
        resumed: whether the run is resumed; its files stay unchanged until :meth:`load_state_dict`.

    Raises:
        ValueError: for an unknown logger or mode, or a logger that is not installed.

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
            self._open([], uuid.uuid4().hex[:8])

    def _open(self, rows: Sequence[Mapping[str, float]], wandb_id: str) -> None:
        """Open ``train.csv`` and the logger, and write some rows to both."""
        aside = self.folder / "train.csv.aside"
        self._file = aside.open("w", newline="")
        self._writer = csv.DictWriter(self._file, self.columns, restval="", extrasaction="raise")
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
        """Training time [s]; the pause before a run was resumed does not count."""
        return time.perf_counter() - self._began

    def row(self, row: Mapping[str, float]) -> None:
        """Add a row of curves and flush the file. ``frames`` is the step of the logger."""
        self._write(row)
        self._log.row(row)

    def figure(self, name: str, figure: Figure) -> None:
        """Save a figure as ``<name>.png``."""
        path = self.folder / f"{name}.png"
        figure.savefig(path, dpi=120)
        self._log.picture(name, path)

    def result(self, result: Mapping[str, float], navigator: str = "") -> None:
        """Write ``eval.json``; wandb also gets a row of its table of navigators, final values and ``policy.pt``."""
        write_json(self.folder / "eval.json", result)
        self._log.table("eval/navigators", [{"navigator": navigator, **result}])
        self._log.summary({f"final/{key}": value for key, value in result.items()})
        if (self.folder / "policy.pt").is_file():
            self._log.artifact(self.folder / "policy.pt", {"navigator": navigator, **result})

    def state_dict(self) -> dict[str, Any]:
        """Return the rows so far, the training time, and the id of the run in wandb."""
        return {"rows": list(self.rows), "seconds": self.seconds, "wandb_id": self._log.run_id}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore the rows; later rows in the file are dropped."""
        self._began = time.perf_counter() - float(state_dict["seconds"])
        self._open(state_dict["rows"], str(state_dict["wandb_id"]))

    def close(self) -> None:
        """Close the file and the logger."""
        self._file.close()
        self._log.close()
