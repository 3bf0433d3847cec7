"""Insert measured tables into documents, so that no figure there is typed by hand.

    python recipes/tables/publish.py README.md docs/reproduction.md

A document marks the place and the file of a table by `<!-- table: docs/results/NAME.md -->` and `<!-- end -->`.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import tyro

from magrl.training import UsageError, command, parse

RECIPE = "publish.py"
BLOCK = re.compile(r"(<!-- table: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)


@dataclass
class Config:
    """Documents to fill."""

    documents: tyro.conf.Positional[tuple[Path, ...]]
    """Markdown files with marked tables."""
    root: Path = Path()
    """Folder that the paths of tables start from."""


def filled(text: str, root: Path) -> str:
    """Return a document with the present content of its tables.

    Raises:
        UsageError: for a missing table.
    """

    def block(match: re.Match[str]) -> str:
        path = root / match[2]
        if not path.is_file():
            raise UsageError(f"there is no table {path}: see `make paper`")
        return match[1] + "\n" + path.read_text().strip() + "\n\n" + match[3]

    return BLOCK.sub(block, text)


def publish(config: Config) -> None:
    """Fill all documents, or none where one cannot be read or lacks a table.

    Raises:
        UsageError: for a missing document or table.
    """
    missing = [str(document) for document in config.documents if not document.is_file()]
    if missing:
        raise UsageError(f"there is no document {', '.join(missing)}")
    texts = {document: filled(document.read_text(), config.root) for document in config.documents}
    for document, text in texts.items():
        document.write_text(text)
        print(document)


if __name__ == "__main__":
    command(RECIPE, lambda: publish(parse(Config, RECIPE, __doc__)))
