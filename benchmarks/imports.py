"""Cost of importing magrl beside TorchRL: `python -m benchmarks.imports`, about a minute."""

from __future__ import annotations

import subprocess
import sys

from benchmarks.timing import Row, alternate

PARTS = ("collectors", "data", "envs", "modules", "objectives")
"""Parts of TorchRL that an agent consists of; `import torchrl` alone does not load them."""


def fresh(code: str) -> None:
    """Run code in a new Python process."""
    subprocess.run([sys.executable, "-c", code], check=True)


def rows(repeats: int = 7) -> list[Row]:
    """Return the times of a whole process with its start: TorchRL with and without every name of magrl.__all__.

    Args:
        repeats: pairs of times for each row.
    """
    parts = "import " + ", ".join(f"torchrl.{part}" for part in PARTS)
    return [
        alternate(
            f"importing {name} and magrl: {name} alone",
            lambda code=code: fresh(f"{code}; from magrl import *"),
            lambda code=code: fresh(code),
            repeats=repeats,
            goal="≥ 0.91",
        )
        for name, code in (("torchrl", "import torchrl"), ("torchrl's parts", parts))
    ]


if __name__ == "__main__":
    print(*rows(), sep="\n")
