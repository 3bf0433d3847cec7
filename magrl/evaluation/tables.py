"""Markdown tables that compare navigators, with the paper's results beside them.

Several runs of a navigator are shown by their interquartile mean, a single one by its mean over the trips. Parentheses
hold 95 % intervals: over runs for ten runs or more (stratified bootstrap), over trips for a single run. Brackets hold
the smallest and largest of two to nine runs, for which a bootstrap interval would be too narrow.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import torch

from magrl import paper
from magrl.envs.measures import MEASURES, interquartile_mean, stratified_bootstrap
from magrl.navigators.names import KINDS, Agent, Kind

Summary = Mapping[str, float | None]
"""From :func:`magrl.evaluation.summarize`; a measure without a value is NaN, or None where it was read from a file."""

Summaries = Mapping[Kind | str, Sequence[Summary]]
"""By navigator, or its name in :data:`magrl.navigators.names.KINDS`, or a label: a summary of each of its runs."""

MIN_RUNS = 10
"""Minimum number of runs for a bootstrap interval whose coverage is about nominal."""

COLUMNS = {measure.label: (measure.summary, measure.form) for measure in MEASURES if measure.label}
COLUMNS |= {"worst run, SPL %": ("worst", ".2f"), "readings": ("field_readings", ".0f")}
"""Heading, measure of :func:`cell` and number format of :func:`comparison_table`; the first four are the paper's."""

SHORT_COLUMNS = ("SR %", "SPL %", "TNT steps", "NE km", "false arrivals %", "not declared %")
"""Headings of :func:`short_table`."""

INTERVALS = ("success_rate", "spl", "path_efficiency", "steps")
"""Measures that are shown with an interval."""

ABOUT = ("navigator", "trained on", "given")
"""First columns of tables: what each navigator is."""


def known_values(values: Iterable[float | None]) -> list[float]:
    """Return the values that are neither None, NaN nor infinite.

    Example:
        >>> known_values([1.0, math.nan, None])
        [1.0]
    """
    return [value for value in values if value is not None and math.isfinite(value)]


def mean_of_runs(values: Iterable[float | None], *, form: str, interval: bool = True, least: int = MIN_RUNS) -> str:
    """Return the interquartile mean over runs with its interval, or with the range of few runs.

    Args:
        values: value of each run; NaN or None where a run has none.
        form: number format.
        interval: whether interval or range are shown.
        least: number of runs from which on the interval is shown; by default ten.

    Example:
        >>> mean_of_runs([98.0, 99.0, 99.0, 100.0, None], form=".1f"), mean_of_runs([99.0] * 10, form=".0f")
        ('99.0 [98.0–100.0]', '99 (99–99)')
        >>> mean_of_runs([99.0], form=".1f"), mean_of_runs([], form=".1f")
        ('99.0', '—')
    """
    runs = torch.tensor(known_values(values), dtype=torch.float64)
    if not len(runs):
        return "—"
    text = format(interquartile_mean(runs).item(), form)
    if len(runs) == 1 or not interval:
        return text
    if len(runs) < least:
        return f"{text} [{runs.min():{form}}–{runs.max():{form}}]"
    low, high = stratified_bootstrap([runs])
    return f"{text} ({low:{form}}–{high:{form}})"


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


def comparison_table(summaries: Summaries, *, published: bool = True) -> str:
    """Return the paper's Table 2 and further measures for navigators, below the paper's own rows.

    Args:
        summaries: by navigator, one summary for each run, with ``field_readings``.
        published: whether the paper's rows are shown; they are of its own region.

    Example:
        >>> measures = {key: 1.0 for key, _ in COLUMNS.values()}
        >>> print(comparison_table({"td3": [measures]}).splitlines()[2])
        | TD3, paper | — | — | 1 | 89.0 | 511984 | 73.63 | 22.09 | — | — | — | — | — | — | — | — | — | — | — |
    """
    rows = list[list[object]]()
    for kind, results in summaries.items():
        navigator = _known(kind)
        if published and navigator.name in paper.TABLE_2:
            published_row = [paper.TABLE_2[navigator.name]._asdict()]
            rows.append([f"{navigator.label}, paper", "—", "—", 1, *_cells(published_row)])
        rows.append([*about(kind), len(results), *_cells(results)])
    return markdown_table([*ABOUT, "runs", *COLUMNS], rows) + "\n"


def about(kind: Kind | str) -> list[str]:
    """Return the label of a navigator, what it was trained on and what it is given, for the columns :data:`ABOUT`.

    Example:
        >>> about("kalman")
        ['Kalman (dual control)', 'nothing', "the field's spectrum"]
        >>> about("PPO")
        ['PPO', 'tasks of its own', 'nothing']
    """
    navigator = _known(kind)
    return [navigator.description, navigator.trained_on, navigator.needs]


def _known(kind: Kind | str) -> Kind:
    return KINDS.get(kind, Agent(kind, kind, kind)) if isinstance(kind, str) else kind


def _cells(results: Sequence[Summary], heads: Iterable[str] = COLUMNS) -> list[str]:
    return [cell(results, *COLUMNS[head]) for head in heads]


def cell(results: Sequence[Summary], key: str, form: str) -> str:
    """Return a measure of one or several runs.

    Args:
        results: summary of each run.
        key: measure, which a run may lack; or ``"worst"``, the smallest SPL of several runs.
        form: number format.

    Example:
        >>> cell([{"spl": 98.0, "spl_low": 97.5, "spl_high": 98.5}], "spl", ".1f")
        '98.0 (97.5–98.5)'
        >>> cell([{"spl": 99.0}, {"spl": 98.5}], "worst", ".2f"), cell([{"spl": 99.0}], "worst", ".2f")
        ('98.50', '—')
    """
    if key == "worst":
        values = known_values(result.get("spl") for result in results)
        return format(min(values), form) if len(values) > 1 else "—"
    text = mean_of_runs([result.get(key) for result in results], form=form, interval=key in INTERVALS)
    ends = known_values(result.get(f"{key}_{end}") for result in results[:1] for end in ("low", "high"))
    return f"{text} ({ends[0]:{form}}–{ends[1]:{form}})" if len(results) == 1 and ends else text


def short_table(summaries: Summaries) -> str:
    """Return the main measures of navigators in nine columns, without the paper's rows.

    Args:
        summaries: by navigator, one summary for each run.

    Example:
        >>> measures = {key: 1.0 for key, _ in COLUMNS.values()}
        >>> print(short_table({"secant": [measures]}).splitlines()[2])
        | secant (quasi-Newton) | nothing | 1 | 1.0 | 1.00 | 1.00 | 1.0 | 1.0 | 1.0 |
    """
    rows = []
    for kind, runs in summaries.items():
        label, _, given = about(kind)
        rows.append([label, given, len(runs), *_cells(runs, SHORT_COLUMNS)])
    return markdown_table(["navigator", "given", "runs", *SHORT_COLUMNS], rows) + "\n"
