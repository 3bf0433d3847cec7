"""Paths of a machine, which no file that the library writes or ships may hold."""

from __future__ import annotations

import re
from pathlib import Path

import torch

ROOT = Path(__file__).parent.parent.parent
MACHINE = "|".join(re.escape(str(path)) for path in (ROOT, Path(torch.__file__).parent))
PATHS = re.compile(rf"(/home|/root|/Users)/\w|site-packages|{MACHINE}".encode())


def with_paths(*folders: Path) -> list[Path]:
    """Return the files in some folders that hold one."""
    files = [path for folder in folders for path in folder.rglob("*") if path.is_file() and path.suffix != ".pyc"]
    assert files
    return [path for path in files if PATHS.search(path.read_bytes())]
