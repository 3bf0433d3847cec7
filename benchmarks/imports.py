"""What importing magrl costs beside TorchRL: `python -m benchmarks.imports`, about a minute."""

from __future__ import annotations

import subprocess
import sys

from benchmarks.timing import Row, alternate

PARTS = ("collectors", "data", "envs", "modules", "objectives")
"""Of TorchRL, what an agent is made of; `import torchrl` alone leaves them for later."""


def fresh(code: str) -> None:
    """Runs code in a Python of its own."""
    subprocess.run([sys.executable, "-c", code], check=True)


def rows(repeats: int = 7) -> list[Row]:
    """Times of a whole process, its start included: TorchRL without and with every name of magrl.__all__.

    Args:
        repeats: pairs of times behind each row.
    """
    parts = "import " + ", ".join(f"torchrl.{part}" for part in PARTS)
    return [
        alternate(
            f"importing {name} and magrl / {name}",
            lambda code=code: fresh(code),
            lambda code=code: fresh(f"{code}; from magrl import *"),
            repeats=repeats,
            goal="≤ 1.10",
        )
        for name, code in (("torchrl", "import torchrl"), ("torchrl's parts", parts))
    ]


if __name__ == "__main__":
    print(*rows(), sep="\n")
