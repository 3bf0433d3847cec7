"""Results as data: a table with a row for each episode, in compressed CSV files."""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path

import pandas
import torch
from torch import Tensor

from magrl.checks import short
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
MAX_ROWS = 1_000_000
"""Most episodes that are read where a caller knows no number."""
MAX_ROW = 500
"""Longest row of a table [bytes], about four times a usual one."""


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


def read_episodes(path: Path | str, rows: int = MAX_ROWS) -> pandas.DataFrame:
    """Read a file of :func:`write_episodes`: its header first, and never more than ``rows`` short rows.

    Args:
        path: path of the file.
        rows: most episodes that it may hold.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for a file that holds no such table.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "episodes.csv.gz"
        >>> write_episodes(path, [pandas.DataFrame({name: [kind()] for name, kind in COLUMNS.items()})])
        >>> read_episodes(path)["success"].tolist()
        [False]
    """
    try:
        with gzip.open(path) as file:
            lines = _lines(file, rows)
        table = pandas.read_csv(io.BytesIO(b"".join(lines)), dtype=COLUMNS, keep_default_na=False, index_col=False)
    except (ValueError, OverflowError, EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise ValueError(f"{path} is not a table of episodes: {error}") from error
    return table


def _lines(file: gzip.GzipFile, rows: int) -> list[bytes]:
    """Return the header and the rows of a table; raise for another header, too many rows, or one that is too long."""
    header = file.readline(MAX_ROW)
    if header.split() != [",".join(COLUMNS).encode()]:
        raise ValueError(f"its header is {short(header)}, not {','.join(COLUMNS)}")
    lines = list(islice(iter(lambda: file.readline(MAX_ROW + 1), b""), rows + 1))
    if max(map(len, lines), default=0) > MAX_ROW:
        raise ValueError(f"a row has more than {MAX_ROW} bytes")
    if len(lines) > rows:
        raise ValueError(f"it holds more than {rows} rows")
    return [header, *lines]
