"""Random mutants of the library, and how many of them its tests catch: `python -m benchmarks.mutants --count 40`.

A mutant changes one comparison, operation, sign, condition or number of a module. It is caught if a test of its room
(the folder of `tests/` with the name of the package), or a doctest of the module, fails or does not end. Survivors are
printed as differences. The same seed and tree give the same mutants.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
LEFT_OUT = shutil.ignore_patterns(".*", "runs", "build", "dist", "wandb", "figures", "*.egg-info", "__pycache__")
SWAPS = {ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "=="}
SWAPS |= {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.Mod: "*", ast.Pow: "*"}
SWAPS |= {ast.BitAnd: "|", ast.BitOr: "&", ast.And: "or", ast.Or: "and"}
"""Operator that takes the place of another one."""
TIMEOUT_S = 600
"""Time after which tests count as failed."""


class Sites(ast.NodeVisitor):
    """Replacements in a module: ``(start, end, text)``, in characters of its source."""

    def __init__(self, source: str) -> None:
        self.source, self.found = source, list[tuple[int, int, str]]()
        self.starts = [0]
        for line in source.splitlines(keepends=True):
            self.starts.append(self.starts[-1] + len(line))
        self.visit(ast.parse(source))

    def at(self, node: ast.AST, end: bool = False) -> int:
        """Return the place of the start or the end of a node."""
        line, column = (node.end_lineno, node.end_col_offset) if end else (node.lineno, node.col_offset)
        start = self.starts[line - 1]
        return start + len(self.source[start:].encode()[:column].decode())

    def between(self, left: ast.AST, right: ast.AST, operator: ast.AST) -> None:
        """Replace the operator between two operands, without parentheses and comments."""
        if (text := SWAPS.get(type(operator))) is None:
            return
        start, end = self.at(left, end=True), self.at(right)
        gap = self.source[start:end]
        bare = gap.strip("() \n")
        if bare and "\n" not in gap:
            at = start + gap.index(bare)
            self.found.append((at, at + len(bare), text))

    def visit_Compare(self, node: ast.Compare) -> None:
        for left, operator, right in zip([node.left, *node.comparators], node.ops, node.comparators, strict=False):
            self.between(left, right, operator)
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        self.between(node.left, node.right, node.op)
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        for left, right in zip(node.values, node.values[1:], strict=False):
            self.between(left, right, node.op)
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, (ast.USub, ast.Invert, ast.Not)):
            self.found.append((self.at(node), self.at(node.operand), ""))
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        if type(node.value) in (int, float):
            text = str(node.value + 1) if isinstance(node.value, int) else repr(node.value * 1.5 + (node.value == 0))
            self.found.append((self.at(node), self.at(node, end=True), text))
        elif isinstance(node.value, bool):
            self.found.append((self.at(node), self.at(node, end=True), str(not node.value)))

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value:
            self.visit(node.value)

    def visit_arg(self, node: ast.arg) -> None:
        """Leave annotations out."""

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        for part in (*node.args.defaults, *filter(None, node.args.kw_defaults), *node.body):
            self.visit(part)

    def visit_Raise(self, node: ast.Raise) -> None:
        """Leave messages of errors out."""


def mutants(tree: Path, parts: list[str]) -> Iterator[tuple[Path, str, str]]:
    """Yield modules with their source before and after one replacement, all that there are."""
    for part in parts:
        path = tree / "magrl" / part
        for module in sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]:
            source = module.read_text(encoding="utf-8")
            for start, end, text in Sites(source).found:
                yield module, source, source[:start] + text + source[end:]


def caught(tree: Path, module: Path, after: str) -> bool:
    """Return whether tests fail with a module replaced."""
    before, part = module.read_text(encoding="utf-8"), module.relative_to(tree / "magrl").parts[0]
    folder = tree / "tests" / part
    rooms = [folder] if folder.is_dir() else sorted((tree / "tests").glob("test_*.py"))
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", str(module), *map(str, rooms)]
    environment = os.environ | {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    module.write_text(after, encoding="utf-8")
    try:
        done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, timeout=TIMEOUT_S)
        return done.returncode != 0
    except subprocess.TimeoutExpired:
        return True
    finally:
        module.write_text(before, encoding="utf-8")


def changed(before: str, after: str) -> str:
    """Return the first line that differs, before and after."""
    pairs = zip(before.splitlines(), after.splitlines(), strict=False)
    number, (old, new) = next((n, pair) for n, pair in enumerate(pairs, 1) if pair[0] != pair[1])
    return f"{number}\n  - {old.strip()}\n  + {new.strip()}"


def main() -> None:
    """Read the command line, try the mutants, and print the survivors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", help="packages or modules of magrl; all by default")
    parser.add_argument("--count", type=int, default=40, help="number of mutants (40)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the choice (0)")
    options = parser.parse_args()
    parts = options.parts or sorted(path.name for path in (ROOT / "magrl").iterdir() if path.name[0] not in "_.")
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        shutil.copytree(ROOT, tree, ignore=LEFT_OUT)
        every = list(mutants(tree, [part for part in parts if part != "py.typed"]))
        chosen = random.Random(options.seed).sample(every, min(options.count, len(every)))
        survivors = 0
        for number, (module, before, after) in enumerate(chosen, 1):
            alive = not caught(tree, module, after)
            survivors += alive
            place = f"{module.relative_to(tree)}:{changed(before, after)}" if alive else ""
            print(f"{number}/{len(chosen)} {'survives' if alive else 'caught'} {place}", flush=True)
    print(f"{len(chosen) - survivors} of {len(chosen)} mutants are caught")


if __name__ == "__main__":
    main()
