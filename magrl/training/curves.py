"""Statistics of a training, its best policy, and its curves and results: train.csv, figures, eval.json and wandb."""

from __future__ import annotations

import csv
import io
import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from magrl.checks import library
from magrl.files import append, write_json, write_text, write_with
from magrl.training.wandb_run import WandbRun

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from pandas import DataFrame

OpenLog = Callable[..., WandbRun]
COUNTS = ("frames", "episodes", "iterations", "updates")
RETURN_TERMS = ("destination", "proximity", "alignment")
"""Terms of the reward whose sums over an episode are reported beside the return."""
LINES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7")
TRAINING_PANELS = {
    "return": {"return": "return"},
    "return by term": {f"return_{term}": term for term in RETURN_TERMS},
    "score [%]": {
        "success_rate": "SR, last 200 episodes",
        "eval_score": "score, evaluation",
        "eval_success_rate": "SR, evaluation",
        "eval_spl": "SPL, evaluation",
    },
    "loss": {"loss_critic": "critics", "loss_actor": "actor"},
}
"""Curves of each panel: label by column of ``train.csv``. Returns are means over the last 200 episodes."""


class TrainingStatistics:
    """Counts of a training, and means over its last episodes.

    Args:
        window: number of episodes in ``return``, its terms and ``success_rate``, as in Figs. 6 and 7.

    Attributes:
        frames, episodes, iterations, updates: counts since the start of the training.
        losses: last value of each loss and diagnostic, by name.
        first_cohort: frames after which every vehicle has ended an episode. The means before are not known: only short
            episodes have ended.

    Example:
        >>> from tensordict import TensorDict
        >>> after = TensorDict(episode_reward=torch.tensor([[5.0], [230.0]]))
        >>> after["success"] = after["done"] = torch.tensor([[False], [True]])
        >>> statistics = TrainingStatistics()
        >>> statistics.add(TensorDict(next=after, batch_size=[2]))
        >>> statistics.frames, statistics.episodes, statistics.row()["return"]
        (2, 1, 230.0)
    """

    def __init__(self, window: int = 200) -> None:
        self.frames = self.episodes = self.iterations = self.updates = 0
        self.losses: dict[str, Tensor] = {}
        self.first_cohort = 0
        keys = ("success_rate", "episode_steps", "return", *(f"return_{term}" for term in RETURN_TERMS))
        self._windows: dict[str, deque[float]] = {key: deque(maxlen=window) for key in keys}

    def add(self, batch: TensorDictBase) -> None:
        """Count a batch of transitions.

        Args:
            batch: ``(B,)`` with ``next``: ``success``, ``done``, ``episode_reward`` and, as far as they are there,
                ``episode_reward_destination`` and the other terms, from ``RewardSum`` and ``EpisodeSum``.
        """
        after = batch["next"]
        ended = after["done"]
        self.iterations += 1
        self.frames += batch.numel()
        self.episodes += int(ended.sum())
        self._windows["success_rate"].extend((100 * after["success"][ended].double()).tolist())
        if "elapsed_steps" in after.keys():  # noqa: SIM118 - a TensorDict
            self._windows["episode_steps"].extend(after["elapsed_steps"][ended].tolist())
        for name in ("", *(f"_{term}" for term in RETURN_TERMS)):
            value = after.get(f"episode_reward{name}", None)
            if value is not None:
                self._windows[f"return{name}"].extend(value[ended].tolist())

    def row(self) -> dict[str, float]:
        """Return the counts, the means over the window (NaN before they are known) and the losses."""
        counts = {key: getattr(self, key) for key in ("frames", "episodes", "updates")}
        known = self.frames >= self.first_cohort
        means = {k: sum(values) / len(values) if values and known else math.nan for k, values in self._windows.items()}
        return {**counts, **means, **{name: loss.item() for name, loss in self.losses.items()}}

    def state_dict(self) -> dict[str, Any]:
        """Return counts, windows and losses."""
        losses = {name: loss.item() for name, loss in self.losses.items()}
        windows = {key: list(values) for key, values in self._windows.items()}
        return {**{key: getattr(self, key) for key in COUNTS}, "losses": losses, "windows": windows}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore counts, windows and losses."""
        for key in COUNTS:
            setattr(self, key, int(state_dict[key]))
        self.losses = {name: torch.tensor(loss) for name, loss in state_dict["losses"].items()}
        for key, values in state_dict["windows"].items():
            self._windows[key].clear()
            self._windows[key].extend(values)


class BestPolicy:
    """The weights with the best score so far.

    Example:
        >>> best, layer = BestPolicy(), nn.Linear(1, 1)
        >>> for score in (90.0, 95.0, 80.0):
        ...     _ = nn.init.constant_(layer.weight, score)
        ...     best.offer(score, layer)
        >>> best.score, best.weights["weight"].item()
        (95.0, 95.0)
    """

    def __init__(self) -> None:
        self.score = float("-inf")
        self.weights: dict[str, Tensor] | None = None

    def offer(self, score: float, module: nn.Module) -> None:
        """Keep the weights of ``module`` if their score is the best so far."""
        if score > self.score:
            tensors = {key: x.clone() for key, x in module.state_dict().items() if isinstance(x, Tensor)}
            self.score, self.weights = score, tensors

    def state_dict(self) -> dict[str, Any]:
        """Return the score and the weights."""
        return {"score": self.score, "weights": self.weights}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the score and the weights."""
        self.score, self.weights = state_dict["score"], state_dict["weights"]


class RunLog:
    """Curves and results of a run, written to its folder and to wandb.

    Args:
        folder: run folder.
        columns: columns of ``train.csv``, in order.
        opens: opens the run in wandb, given the ``run_id`` of one that is resumed:
            :class:`magrl.training.wandb_run.WandbRun` with its other arguments.
        resumed: whether the run is resumed; its files stay unchanged until :meth:`load_state_dict`.
        began: ``time.perf_counter()`` at the start of the run; now by default.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     log = RunLog(Path(folder), ["frames", "return"], lambda **_: WandbRun(Path(folder), "disabled", {}))
        ...     log.row({"frames": 512, "return": -3.5})
        ...     log.close()
        ...     (log.folder / "train.csv").read_text().split()
        ['frames,return', '512,-3.5']
    """

    def __init__(
        self, folder: Path, columns: Sequence[str], opens: OpenLog, *, resumed: bool = False, began: float | None = None
    ) -> None:
        self.folder, self.columns, self.rows = folder, tuple(columns), list[dict[str, float]]()
        self._open_log = opens
        self._began = time.perf_counter() if began is None else began
        if not resumed:
            self._open([])

    def _open(self, rows: Sequence[Mapping[str, float]], wandb_id: str = "") -> None:
        """Open ``train.csv`` and the run in wandb, and write some rows to both."""
        self._log = self._open_log(run_id=wandb_id)
        written = [dict(zip(self.columns, self.columns, strict=True)), *rows]
        write_text(self.folder / "train.csv", "".join(map(self._line, written)))
        self.rows += map(dict, rows)
        for row in rows:
            self._log.row(row)

    def _line(self, row: Mapping[str, Any]) -> str:
        line = io.StringIO()
        writer = csv.DictWriter(line, self.columns, restval="", extrasaction="raise")
        writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()})
        return line.getvalue()

    @property
    def seconds(self) -> float:
        """Time since the start [s], of a resumed run with the time that its checkpoint holds."""
        return time.perf_counter() - self._began

    def row(self, row: Mapping[str, float]) -> None:
        """Add a row of curves to the file. ``frames`` is the step in wandb."""
        self.rows.append(dict(row))
        append(self.folder / "train.csv", self._line(row).encode())
        self._log.row(row)

    def figure(self, name: str, figure: Figure) -> None:
        """Save a figure as ``<name>.png``."""
        path = self.folder / f"{name}.png"
        write_with(path, figure.savefig, dpi=120)
        self._log.picture(name, path)

    def result(self, result: Mapping[str, float]) -> None:
        """Write ``eval.json``; wandb also gets the final values."""
        write_json(self.folder / "eval.json", result)
        self._log.summary({f"final/{key}": value for key, value in result.items()})

    def state_dict(self) -> dict[str, Any]:
        """Return the rows so far, the training time, and the id of the run in wandb."""
        return {"rows": list(self.rows), "seconds": self.seconds, "wandb_id": self._log.run_id}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore the rows; later rows in the file are dropped."""
        self._began -= float(state_dict["seconds"])
        self._open(state_dict["rows"], str(state_dict["wandb_id"]))

    def close(self) -> None:
        """Close the run in wandb."""
        self._log.close()


def training_figure(rows: Sequence[Mapping[str, float]]) -> Figure:
    """Return the curves of one training: return, return by term, score, success rate and SPL, losses.

    Args:
        rows: rows of a ``train.csv``; missing values and NaN are left out.

    Example:
        >>> rows = [{"frames": 1000, "return": -5.0}, {"frames": 2000, "return": 20.0, "success_rate": 10.0}]
        >>> [axes.get_title() for axes in training_figure(rows).axes]
        ['return', 'return by term', 'score [%]', 'loss']
    """
    figure = library("matplotlib.figure", "plots").Figure(figsize=(10, 7), layout="constrained")
    frames = np.array([row["frames"] for row in rows])
    for axes, (title, columns) in zip(figure.subplots(2, 2, sharex=True).flat, TRAINING_PANELS.items(), strict=True):
        for color, (column, label) in zip(LINES, columns.items(), strict=False):
            values = np.array([row.get(column, np.nan) for row in rows], dtype=float)
            finite = np.isfinite(values)
            axes.plot(frames[finite], values[finite], color=color, lw=1.2, label=label)
        axes.set_title(title)
        axes.grid(alpha=0.3)
        if len(columns) > 1:
            axes.legend(fontsize=8)
    for axes in figure.axes[2:]:
        axes.set_xlabel("frames (vehicle-steps)")
        axes.xaxis.set_major_formatter(library("matplotlib.ticker", "plots").EngFormatter(sep=""))
    return figure


def draw_seeds(axes: Axes, runs: DataFrame, along: str, value: str, **look: Any) -> None:
    """Draw the learning curve of several seeds: their median, and a band from the least to the highest.

    Args:
        axes: axes of matplotlib.
        runs: points of the curves, with a column ``seed``; the n-th points of the seeds belong together.
        along: column of the horizontal axis.
        value: column of the vertical axis.
        look: options of ``axes.plot``, with ``color``.

    Example:
        >>> from matplotlib.figure import Figure
        >>> from pandas import DataFrame
        >>> runs = DataFrame({"seed": [0, 1, 2], "frames": 512, "eval_score": [90.0, 99.0, 94.0]})
        >>> draw_seeds(axes := Figure().subplots(), runs, "frames", "eval_score", color="C0")
        >>> axes.lines[0].get_xydata().tolist()
        [[512.0, 94.0]]
    """
    points = runs.groupby(runs.groupby("seed").cumcount())
    axes.plot(place := points[along].median(), points[value].median(), **look)
    axes.fill_between(place, points[value].min(), points[value].max(), color=look["color"], alpha=0.2, lw=0)
