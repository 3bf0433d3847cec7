"""Insert measured tables into documents, so that no figure there is typed by hand.

    python docs/tables/publish.py README.md docs/reproduction.md

A document marks the place and the file of a table by `<!-- table: docs/results/NAME.md -->` and `<!-- end -->`. Names
of columns after the file, as in `<!-- table: docs/results/NAME.md | navigator | SPL % -->`, leave out the others. With
conditions, as in `| navigator = secant or Kalman |`, rows with another cell in that column are left out; a column with
a single condition is not shown. Values have no-break spaces.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from magrl.evaluation.tables import markdown_table
from magrl.files import read_text, write_text
from magrl.training import UsageError, command

import tyro

SPACE = re.compile(r"(?<=\d) (?=[±(/])|(?<=±) |(?<=\d) (?=to )|(?<=\d to) ")
BLOCK = re.compile(r"(<!-- table: ([^\s|]+)(?: \| (.*?))? -->\n).*?(<!-- end -->)", re.DOTALL)


def selected(table: str, columns: str | None) -> str:
    """Return some columns of a table, by their headings with ``|`` between them; without any, the whole table.

    Raises:
        UsageError: for a heading or a cell that the table lacks.
    """
    table = SPACE.sub("\N{NO-BREAK SPACE}", table)
    if columns is None:
        return table
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]
    columns = SPACE.sub("\N{NO-BREAK SPACE}", columns)
    heads, _, cells = zip(*([part.strip() for part in one.partition("=")] for one in columns.split("|")), strict=True)
    if missing := [head for head in heads if head not in rows[0]]:
        raise UsageError(f"the table has no column {', '.join(missing)}: choose from {', '.join(rows[0])}")
    places = [rows[0].index(head) for head in heads]
    kept = {place: wanted.split(" or ") for place, wanted in zip(places, cells, strict=True) if wanted}
    if missing := [
        cell for place, wanted in kept.items() for cell in wanted if cell not in {row[place] for row in rows}
    ]:
        raise UsageError(f"the table has no row {', '.join(missing)}")
    body = [row for row in rows[2:] if all(row[place] in wanted for place, wanted in kept.items())]
    shown = [place for place in places if len(kept.get(place, "two")) > 1]
    return markdown_table([rows[0][place] for place in shown], [[row[place] for place in shown] for row in body])


def publish(documents: Sequence[Path], root: Path = Path()) -> None:
    """Fill all documents, or none where one cannot be read or lacks a table; tables are in a folder ``root``.

    Raises:
        UsageError: for a missing document, table or column.
    """

    def block(match: re.Match[str]) -> str:
        return f"{match[1]}\n{selected(read_text(root / match[2]).strip(), match[3])}\n\n{match[4]}"

    try:
        texts = {document: BLOCK.sub(block, read_text(document)) for document in documents}
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from error
    for document, text in texts.items():
        write_text(document, text)


def main(documents: tyro.conf.Positional[tuple[Path, ...]]) -> None:
    """Fill documents, such as README.md."""
    publish(documents)


if __name__ == "__main__":
    command("publish.py", lambda: tyro.cli(main, prog="publish.py", description=__doc__))
