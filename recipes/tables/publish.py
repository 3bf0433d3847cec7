"""Insert measured tables into documents, so that no figure there is typed by hand.

    python recipes/tables/publish.py README.md docs/reproduction.md

A document marks the place and the file of a table by `<!-- table: docs/results/NAME.md -->` and `<!-- end -->`.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path

from magrl.training import UsageError, command

BLOCK = re.compile(r"(<!-- table: (\S+) -->\n).*?(<!-- end -->)", re.DOTALL)


def publish(documents: Sequence[Path], root: Path = Path()) -> None:
    """Fill all documents, or none where one cannot be read or lacks a table; tables are in a folder ``root``.

    Raises:
        UsageError: for a missing document or table.
    """

    def block(match: re.Match[str]) -> str:
        return f"{match[1]}\n{(root / match[2]).read_text().strip()}\n\n{match[3]}"

    try:
        texts = {document: BLOCK.sub(block, document.read_text()) for document in documents}
    except OSError as error:
        raise UsageError(str(error)) from error
    for document, text in texts.items():
        document.write_text(text)


if __name__ == "__main__":
    command("publish.py", lambda: publish([Path(name) for name in sys.argv[1:]]))
