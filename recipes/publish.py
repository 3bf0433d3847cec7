"""Puts measured tables into the documents, so that no figure there is typed by hand.

    python recipes/publish.py README.md docs/reproduction.md

A document marks where a table goes, and from which file, by `<!-- table: docs/results/NAME.md -->` and `<!-- end -->`.
"""

import re
import sys
from dataclasses import dataclass
from pathlib import Path

import tyro

BLOCK = re.compile(r"(<!-- table: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)


@dataclass
class Documents:
    """Which documents to fill."""

    documents: tyro.conf.Positional[tuple[Path, ...]]
    """Markdown files with marked tables."""
    root: Path = Path()
    """What the paths of the tables start from."""


def filled(text: str, root: Path) -> str:
    """A document with the present content of its tables.

    Raises:
        SystemExit: for a table that is not there, by name.
    """

    def block(match: re.Match[str]) -> str:
        path = root / match[2]
        if not path.is_file():
            sys.exit(f"there is no table {path}: see `make paper`")
        return match[1] + "\n" + path.read_text().strip() + "\n\n" + match[3]

    return BLOCK.sub(block, text)


if __name__ == "__main__":
    config = tyro.cli(Documents, description=__doc__)
    for document in config.documents:
        document.write_text(filled(document.read_text(), config.root))
        print(document)
