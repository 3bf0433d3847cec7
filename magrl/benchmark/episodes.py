"""Results as data: a table with a row for each episode, in compressed CSV files."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import pandas
import torch
from torch import Tensor

from magrl.files import write_atomically

COLUMNS = {
    "track": str,
    "navigator": str,
    "run": int,
    "level": str,
    "task": int,
    "region": int,
    "seed": int,
    "success": bool,
    "spl": float,
    "steps": int,
    "false_arrival": bool,
    "final_distance_km": float,
}
"""Columns and their types. ``run`` counts the trainings of a navigator; ``seed`` is that of the errors."""


def episode_table(measures: Mapping[str, Tensor], region: Tensor, **labels: str | int) -> pandas.DataFrame:
    """Return a row for each episode.

    Args:
        measures: ``(M,)`` each, of :func:`magrl.evaluation.episode_measures`, in the order of the tasks.
        region: ``(M,)`` index of the region of each task.
        labels: columns that are the same in each row, such as ``navigator`` and ``level``; empty or 0 by default.

    Example:
        >>> ends = {"success": torch.tensor([True]), "steps": torch.tensor([9])}
        >>> ends |= {"spl": torch.tensor([0.5]), "navigation_error_km": torch.tensor([4.0])}
        >>> episode_table(ends, torch.tensor([5]), navigator="secant")[["task", "region", "spl"]].values.tolist()
        [[0.0, 5.0, 0.5]]
    """
    columns = {
        **dict.fromkeys(("track", "navigator", "level"), ""),
        **dict.fromkeys(("run", "seed"), 0),
        **labels,
        "task": range(len(region)),
        "region": region.tolist(),
        "success": measures["success"].tolist(),
        "spl": measures["spl"].double().tolist(),
        "steps": measures["steps"].tolist(),
        "false_arrival": measures.get("false_arrival", torch.zeros_like(measures["success"])).tolist(),
        "final_distance_km": measures["navigation_error_km"].double().tolist(),
    }
    return pandas.DataFrame(columns)[list(COLUMNS)]


def write_episodes(path: Path | str, tables: Sequence[pandas.DataFrame]) -> None:
    """Write tables of episodes as one file, ``.csv.gz``; the same episodes give the same bytes.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "episodes.csv.gz"
        >>> write_episodes(path, [pandas.DataFrame({name: [kind()] for name, kind in COLUMNS.items()})])
        >>> len(read_episodes(path))
        1
    """
    text = pandas.concat(tables).to_csv(index=False, float_format="%.6g")
    write_atomically(Path(path), gzip.compress(text.encode(), mtime=0))


def read_episodes(path: Path | str) -> pandas.DataFrame:
    """Read a table of episodes.

    Raises:
        ValueError: for another file.
    """
    try:
        table = pandas.read_csv(path, keep_default_na=False).astype(COLUMNS)
    except (ValueError, KeyError, EOFError, zlib.error) as error:
        raise ValueError(f"{path} is not a table of episodes: {error}") from error
    return table[list(COLUMNS)]
