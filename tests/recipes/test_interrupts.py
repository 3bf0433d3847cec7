"""Ctrl-C while a command imports its modules."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.recipes import ROOT

SCRIPTS = sorted(path for folder in ("recipes", "docs/tables") for path in (ROOT / folder).glob("*.py"))
COMMANDS = [path for path in SCRIPTS if "\n    command(" in path.read_text(encoding="utf-8")]


@pytest.mark.parametrize("path", COMMANDS, ids=lambda path: path.stem)
def test_an_interrupt_during_the_imports_is_one_line(path: Path, tmp_path: Path) -> None:
    """A torch that interrupts the program stands for the one that takes seconds to load."""
    stub = "import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n"
    (tmp_path / "torch.py").write_text(stub, encoding="utf-8")
    environ = os.environ | {"PYTHONPATH": os.pathsep.join((str(tmp_path), str(ROOT)))}
    ended = subprocess.run([sys.executable, path], env=environ, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr, ended.stdout) == (130, f"{path.name}: interrupted\n", "")
