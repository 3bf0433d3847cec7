"""The layout of the code: floors, cycles, sizes and imports, as docs/architecture.md describes them."""

from __future__ import annotations

import ast
import io
import re
import subprocess
import sys
import tokenize
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
PACKAGE = ROOT / "magrl"
FLOORS = (
    {"checks", "geodesy", "files", "paper", "counters"},
    {"field", "guidance", "tracking"},
    {"transforms"},
    {"envs"},
    {"navigators", "agents"},
    {"evaluation", "onboard"},
    {"training"},
)
FLOOR = {name: floor for floor, names in enumerate(FLOORS) for name in names}
LIGHT = ("field", "transforms", "envs", "navigators", "agents")
"""Packages that load none of :data:`HEAVY`."""
HEAVY = ("matplotlib", "pandas", "wandb", "tqdm", "tyro")


@cache
def sources() -> dict[str, ast.Module]:
    """The modules by name, such as ``magrl.field.igrf``; a package is that of its ``__init__.py``."""
    paths = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in sorted(PACKAGE.rglob("*.py"))}
    return {name.removesuffix(".__init__"): ast.parse(path.read_text()) for name, path in paths.items()}


def imported(module: str) -> set[str]:
    """Modules of magrl that a module imports, inside functions too; a name of a package is the package."""
    names: set[str] = set()
    for node in ast.walk(sources()[module]):
        if isinstance(node, ast.ImportFrom):
            assert not node.level, f"{module} has a relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names} if node.module else set()
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    names = {name if name in sources() else name.rpartition(".")[0] for name in names}
    return {name for name in names if name in sources() and name not in (module, "magrl")}


def top(module: str) -> str:
    """The part of the package that a module belongs to: ``magrl.field.igrf`` is of ``field``."""
    return module.split(".")[1]


MODULES = [name for name in sources() if name != "magrl"]


def test_every_package_and_module_has_a_floor() -> None:
    packages = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    modules = {path.stem for path in PACKAGE.glob("*.py")} - {"__init__"}
    assert len(packages) == 9
    assert len(modules) <= 6
    assert packages | modules == set(FLOOR)


@pytest.mark.parametrize("name", sorted(FLOOR))
def test_no_import_upward(name: str) -> None:
    upward = {
        f"{module} imports {other}"
        for module in MODULES
        if top(module) == name
        for other in imported(module)
        if FLOOR[top(other)] > FLOOR[name]
    }
    assert not upward


def test_no_cycle_among_modules() -> None:
    """Neither between packages nor inside one; a package depends on all that its ``__init__.py`` imports."""
    graph = {module: imported(module) for module in MODULES}
    while graph:
        free = {module for module, needs in graph.items() if not needs & graph.keys()}
        assert free, f"a cycle among {sorted(graph)}"
        graph = {module: needs for module, needs in graph.items() if module not in free}


# Sizes


LIMITS = {"magrl/**/*.py": 250, "recipes/**/*.py": 200}
"""Most lines of code of a module, by folder."""
LONGEST_FUNCTION = 30
NO_CODE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}


def code_lines(text: str) -> set[int]:
    """Numbers of the lines that hold code: neither blank, nor a comment, nor part of a docstring."""
    tokens = [x for x in tokenize.generate_tokens(io.StringIO(text).readline) if x.type not in NO_CODE]
    values = [node.value for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Expr)]
    docstrings = [x for x in values if isinstance(x, ast.Constant) and isinstance(x.value, str)]
    lines = {line for token in tokens for line in range(token.start[0], token.end[0] + 1)}
    return lines - {line for x in docstrings for line in range(x.lineno, (x.end_lineno or 0) + 1)}


def function_sizes(text: str) -> dict[str, int]:
    """Lines of code of the body of each function, with those of functions inside it; signature and decorators apart."""
    functions = [x for x in ast.walk(ast.parse(text)) if isinstance(x, (ast.FunctionDef, ast.AsyncFunctionDef))]
    code = code_lines(text)
    bodies = {f"{x.name} in line {x.lineno}": range(x.body[0].lineno, (x.end_lineno or 0) + 1) for x in functions}
    return {name: len(code & set(lines)) for name, lines in bodies.items()}


def test_what_counts_as_code() -> None:
    text = '"""Module."""\n\n@cache\ndef add(\n    x,\n):\n    """Sum.\n"""\n    # note\n    y = [\n        x\n    ]\n'
    assert code_lines(text) == {3, 4, 5, 6, 10, 11, 12}
    assert function_sizes(text) == {"add in line 4": 3}


@pytest.mark.parametrize("folder", LIMITS)
def test_modules_and_functions_are_short(folder: str) -> None:
    texts = {str(path.relative_to(ROOT)): path.read_text() for path in ROOT.glob(folder)}
    sizes = {name: len(code_lines(text)) for name, text in texts.items()}
    assert sizes
    assert {name: size for name, size in sizes.items() if size > LIMITS[folder]} == {}
    functions = {f"{name}::{x}": size for name, text in texts.items() for x, size in function_sizes(text).items()}
    functions = {name: size for name, size in functions.items() if "::train in" not in name}  # a recipe shows its loop
    assert {name: size for name, size in functions.items() if size > LONGEST_FUNCTION} == {}


# Imports


def test_importing_is_light() -> None:
    """``import magrl`` loads no torch; the packages for simulation and inference load nothing that draws or logs."""
    code = f"""
import sys, importlib
import magrl
early = "torch" in sys.modules
import torchrl.envs, torchrl.modules, torchrl.objectives
theirs = set(sys.modules)
for name in {LIGHT!r}:
    importlib.import_module(f"magrl.{{name}}")
print(early, sorted(set({HEAVY!r}) & (set(sys.modules) - theirs)), sorted(({{*{HEAVY!r}}} - {{"tqdm"}}) & theirs))
"""
    run = subprocess.run([sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True, check=False)
    assert run.stdout.strip() == "False [] []", run.stderr


# docs/architecture.md


def tables() -> list[list[list[str]]]:
    """Every table of the page, as rows of cells, without the header and the line below it."""
    found: list[list[list[str]]] = []
    inside = False
    for line in (ROOT / "docs" / "architecture.md").read_text().splitlines():
        if line.startswith("|"):
            if not inside:
                found.append([])
            found[-1].append([cell.strip() for cell in line.strip("|").split("|")])
        inside = line.startswith("|")
    return [table[2:] for table in found]


def quoted(cell: str) -> list[str]:
    return re.findall(r"`([^`]+)`", cell)


def listed(first: str) -> list[list[str]]:
    """The table with a row whose first cell starts like this."""
    return next(table for table in tables() if any(row[0].startswith(first) for row in table))


def test_the_page_lists_every_package_and_module() -> None:
    page = {quoted(row[0])[0]: set(quoted(row[1])) for row in listed("`magrl/")}
    paths = {f"{path.relative_to(ROOT).as_posix()}": set() for path in PACKAGE.glob("*.py") if path.stem != "__init__"}
    for init in PACKAGE.rglob("*/__init__.py"):
        modules = {path.stem for path in init.parent.glob("*.py")} - {"__init__"}
        paths[f"{init.parent.relative_to(ROOT).as_posix()}/"] = modules
    assert page == paths


def test_the_page_has_the_floors_of_this_test() -> None:
    floors = {int(row[0]): set(quoted(row[1])) for row in listed("1")}
    assert floors == dict(enumerate(FLOORS, start=1))
