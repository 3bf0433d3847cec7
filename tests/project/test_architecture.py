"""The layout of the code: floors, cycles, sizes and imports, as docs/architecture.md describes them."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
PACKAGE = ROOT / "magrl"
FLOORS = (
    {"checks", "geodesy", "files", "paper"},
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


def dotted(path: Path) -> str:
    """The module of a file, such as ``magrl.field.igrf``; a package is that of its ``__init__.py``."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


@cache
def sources() -> dict[str, ast.Module]:
    return {dotted(path): ast.parse(path.read_text()) for path in sorted(PACKAGE.rglob("*.py"))}


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


def test_eight_packages_and_few_modules() -> None:
    packages = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    modules = {path.stem for path in PACKAGE.glob("*.py")} - {"__init__"}
    assert len(packages) == 8
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


def functions(tree: ast.AST) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    return [node for node in ast.walk(tree) if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))]


def length(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function, without its docstring and its decorators."""
    docstring = function.body[0] if ast.get_docstring(function) else None
    of_docstring = docstring.end_lineno - docstring.lineno + 1 if docstring and docstring.end_lineno else 0
    return (function.end_lineno or 0) - function.lineno + 1 - of_docstring


@pytest.mark.parametrize(
    ("folder", "lines"), [("magrl/**/*.py", 350), ("recipes/**/*.py", 350), ("recipes/td3_*.py", 250)]
)
def test_modules_are_short(folder: str, lines: int) -> None:
    found = {path: len(path.read_text().splitlines()) for path in ROOT.glob(folder)}
    assert found
    assert {str(path.relative_to(ROOT)): count for path, count in found.items() if count > lines} == {}


def test_functions_are_short() -> None:
    paths = [*PACKAGE.rglob("*.py"), *(ROOT / "recipes").rglob("*.py")]
    counts = {
        f"{path.relative_to(ROOT)}::{function.name}": length(function)
        for path in paths
        for function in functions(ast.parse(path.read_text()))
    }
    assert len(counts) > 300
    assert {name: count for name, count in counts.items() if count > 60} == {}


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


def test_no_light_module_names_a_heavy_one() -> None:
    """At the top of a file; rendering imports matplotlib inside functions."""
    for module, tree in sources().items():
        if module == "magrl" or top(module) in LIGHT:
            outside = [node for node in tree.body if isinstance(node, (ast.Import, ast.ImportFrom))]
            names = {alias.name for node in outside if isinstance(node, ast.Import) for alias in node.names}
            names |= {node.module or "" for node in outside if isinstance(node, ast.ImportFrom)}
            assert not {name.split(".")[0] for name in names} & set(HEAVY), module


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
