"""Markdown tables that compare navigators, with the paper's results beside them."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence

from magrl import paper
from magrl.evaluation.navigators import NAVIGATOR_NAMES, label

Summaries = Mapping[str, Sequence[Mapping[str, float]]]
"""By navigator, one summary (:func:`magrl.evaluation.summarize`) for each of its runs."""

COLUMNS = {
    "SR %": ("success_rate", ".1f"),
    "TL m": ("trajectory_length_m", ".0f"),
    "SPL %": ("spl", ".2f"),
    "TNT steps": ("steps", ".2f"),
    "NE km": ("navigation_error_km", ".1f"),
    "smoothness °": ("smoothness_deg", ".1f"),
    "MAE °": ("heading_mae_deg", ".1f"),
    "RMSE °": ("heading_rmse_deg", ".1f"),
    "within 10 km %": ("success_rate_within_10km", ".1f"),
    "within 25 km %": ("success_rate_within_25km", ".1f"),
    "readings": ("field_readings", ".0f"),
}
"""Heading, measure and number format of the columns of :func:`comparison_table`; the first four are the paper's."""

SHORT_COLUMNS = {
    "SR %": ("success_rate", ".1f"),
    "SPL %": ("spl", ".1f"),
    "TNT steps": ("steps", ".1f"),
    "NE km": ("navigation_error_km", ".1f"),
}
"""The same of :func:`short_table`."""


def spread(values: Iterable[float], form: str) -> str:
    """Return the mean of the finite values, with their standard deviation where there are several.

    Args:
        values: one value for each run; NaN where a run has none.
        form: number format.

    Example:
        >>> spread([1.0, 3.0, float("nan")], ".1f"), spread([2.0], ".0f"), spread([], ".0f")
        ('2.0 ± 1.4', '2', '—')
    """
    known = [value for value in values if math.isfinite(value)]
    if not known:
        return "—"
    text = format(statistics.fmean(known), form)
    return text if len(known) == 1 else f"{text} ± {format(statistics.stdev(known), form)}"


def row(*cells: object) -> str:
    """Return a row of a Markdown table.

    Example:
        >>> row("secant", 1, "98.0")
        '| secant | 1 | 98.0 |'
    """
    return "| " + " | ".join(map(str, cells)) + " |"


def markdown_table(head: Sequence[object], rows: Iterable[Sequence[object]]) -> str:
    """Return a Markdown table.

    Args:
        head: headings of the columns.
        rows: cells of each row.

    Example:
        >>> print(markdown_table(["navigator", "SR %"], [["secant", 98.0]]))
        | navigator | SR % |
        |---|---|
        | secant | 98.0 |
    """
    return "\n".join([row(*head), "|---" * len(head) + "|", *(row(*cells) for cells in rows)])


def comparison_table(summaries: Summaries, mode: str = "look-ahead") -> str:
    """Return the paper's Table 2 and the measures of Fig. 4-6 for navigators, below the paper's own rows.

    Several runs show mean ± standard deviation; one run shows the 95 % interval over tasks where a measure has one.

    Args:
        summaries: by navigator, one summary for each run, with ``field_readings``.
        mode: mode of metaheuristics without one in their name.

    Raises:
        ValueError: for an unknown navigator.
        KeyError: for a missing measure.

    Example:
        >>> measures = {key: 1.0 for key, _ in COLUMNS.values()}
        >>> print(comparison_table({"td3": [measures]}).splitlines()[2])
        | TD3, paper | 1 | 89.0 | 511984 | 73.63 | 22.09 | — | — | — | — | — | — | — |
    """
    rows: list[list[object]] = []
    published = set()
    for name, results in summaries.items():
        base = name.partition(":")[0]
        if base in paper.TABLE_2 and base not in published:
            published.add(base)
            rows.append([f"{NAVIGATOR_NAMES[base]}, paper", 1, *_published(base)])
        rows.append([label(name, mode), len(results), *(_cell(results, *column) for column in COLUMNS.values())])
    return markdown_table(["navigator", "runs", *COLUMNS], rows) + "\n"


def _published(name: str) -> list[str]:
    values = paper.TABLE_2[name]._asdict()
    return [format(values[key], form) if key in values else "—" for key, form in COLUMNS.values()]


def _cell(results: Sequence[Mapping[str, float]], key: str, form: str) -> str:
    text = spread([result[key] for result in results], form)
    if len(results) > 1 or f"{key}_low" not in results[0]:
        return text
    low, high = (format(results[0][f"{key}_{end}"], form) for end in ("low", "high"))
    return f"{text} ({low}–{high})"


def short_table(summaries: Summaries, mode: str = "look-ahead") -> str:
    """Return the main measures of navigators, without the paper's rows.

    Args:
        summaries: by navigator, one summary for each run.
        mode: mode of metaheuristics without one in their name.

    Raises:
        ValueError: for an unknown navigator.
        KeyError: for a missing measure.

    Example:
        >>> measures = {key: 1.0 for key, _ in SHORT_COLUMNS.values()}
        >>> print(short_table({"secant": [measures]}).splitlines()[2])
        | secant (no training, fair) | 1.0 | 1.0 | 1.0 | 1.0 |
    """
    rows = [
        [
            label(name, mode),
            *(spread([result[key] for result in results], form) for key, form in SHORT_COLUMNS.values()),
        ]
        for name, results in summaries.items()
    ]
    return markdown_table(["navigator", *SHORT_COLUMNS], rows) + "\n"
