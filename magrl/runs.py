"""What a training leaves behind: its folder, its curves, its pictures, and its wandb run."""

from __future__ import annotations

import csv
import json
import math
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

WANDB_PROJECT = "magrl"


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


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Writes numbers and texts in their order; NaN, which JSON lacks, becomes null."""
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
    ) -> None:
        self.folder, self.rows = folder, list[dict[str, float]]()
        write_json(folder / "config.json", config)
        self._file = (folder / "train.csv").open("w", newline="")
        self._writer = csv.DictWriter(self._file, columns)
        self._writer.writeheader()
        self._wandb = WandbRun(folder, wandb_mode, config, group, tags)

    def row(self, row: Mapping[str, float]) -> None:
        """Adds a row of curves; it is in the file when this returns. ``frames`` is the step."""
        self.rows.append(dict(row))
        self._writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()})
        self._file.flush()
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

    def close(self) -> None:
        """Closes the files and the wandb run."""
        self._file.close()
        self._wandb.close()


class WandbRun:
    """A run of wandb, or nothing at all where that is disabled: every method may be called either way.

    Args:
        folder: of the run; wandb gets the folder ``wandb`` in it.
        mode: ``offline`` (no network, no login), ``online`` or ``disabled``.
        config: shown with the run.
        group: runs that belong together.
        tags: to filter runs by.
    """

    def __init__(
        self, folder: Path, mode: str, config: Mapping[str, Any], group: str = "", tags: Sequence[str] = ()
    ) -> None:
        self.folder = folder
        self._logger = None if mode == "disabled" else _wandb_logger(folder, mode, config, group, tags)

    def row(self, row: Mapping[str, float]) -> None:
        """Points of curves; ``frames`` is the step."""
        for key, value in row.items():
            if self._logger and key != "frames" and math.isfinite(value):
                self._logger.log_scalar(_panel(key), value, step=int(row["frames"]))

    def picture(self, name: str, path: Path) -> None:
        """A picture that lies in a file."""
        if self._logger:
            import wandb

            self._logger.experiment.log({f"figures/{name}": wandb.Image(str(path))})

    def table(self, name: str, rows: Sequence[Sequence[str]]) -> None:
        """A table of texts, as HTML: a wandb.Table would put the absolute path of its staging folder into the run."""
        if self._logger:
            import wandb

            lines = ("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
            self._logger.experiment.log({name: wandb.Html(f"<table>{''.join(lines)}</table>", inject=False)})

    def summary(self, values: Mapping[str, float]) -> None:
        """Final values."""
        if self._logger:
            self._logger.experiment.summary.update(dict(values))

    def close(self) -> None:
        """Ends the run, and removes wandb's own debug logs, which are full of this machine's paths."""
        if self._logger:
            self._logger.experiment.finish()
            for link in (self.folder / "wandb").glob("debug*.log"):
                link.unlink()
            for logs in (self.folder / "wandb").glob("*run-*/logs"):
                shutil.rmtree(logs)


def _panel(key: str) -> str:
    """The wandb panel of a column: what it starts with, or ``train``."""
    for prefix in ("eval", "reward", "loss"):
        if key.startswith(prefix + "_"):
            return f"{prefix}/{key.removeprefix(prefix + '_')}"
    return f"train/{key}"


def _wandb_logger(folder: Path, mode: str, config: Mapping[str, Any], group: str, tags: Sequence[str]) -> Any:
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
    options: dict[str, Any] = {"project": WANDB_PROJECT, "mode": mode, "config": dict(config), "group": group}
    options |= {"tags": list(tags), "settings": private, "log_env_packages": False}
    return get_logger("wandb", logger_name=str(folder), experiment_name=folder.name, wandb_kwargs=options)
