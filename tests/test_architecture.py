"""Imports run one way, as docs/architecture.md draws them."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "magrl"
LEVELS = (
    {"checks"},
    {"geodesy", "harmonics", "elements", "guidance"},
    {"fields", "regional", "tasks", "metrics", "plots", "export", "replay"},
    {"env", "transforms", "worlds"},
    {"td3", "loggers", "runs", "settings", "navigators", "checkpoints", "gymnasium_env", "recurrent"},
    {"metaheuristics"},
)
LEVEL = {module: level for level, modules in enumerate(LEVELS) for module in modules}


def imported(module: str) -> set[str]:
    """Modules of the package that a module or a folder of them imports from outside itself, inside functions too."""
    file = PACKAGE / f"{module}.py"
    files = [file] if file.exists() else sorted((PACKAGE / module).glob("*.py"))
    names: set[str] = set()
    for node in (node for path in files for node in ast.walk(ast.parse(path.read_text()))):
        if isinstance(node, ast.ImportFrom) and node.module == "magrl":
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("magrl."):
            names.add(node.module.split(".")[1])
    return names - {module}


def test_every_module_has_its_level() -> None:
    modules = {path.stem for path in PACKAGE.iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert modules - {"__init__"} == set(LEVEL)


@pytest.mark.parametrize("module", sorted(LEVEL))
def test_nothing_points_up(module: str) -> None:
    above = {name for name in imported(module) if LEVEL[name] > LEVEL[module]}
    assert not above, f"{module} imports {above}"


def test_nothing_runs_in_a_circle() -> None:
    graph = {module: imported(module) for module in LEVEL}
    while graph:
        free = {module for module, needs in graph.items() if not needs & graph.keys()}
        assert free, f"a circle among {sorted(graph)}"
        graph = {module: needs for module, needs in graph.items() if module not in free}


def test_only_pictures_need_matplotlib_and_nothing_needs_wandb_or_pandas_to_be_imported() -> None:
    names = ", ".join(f"magrl.{module}" for module in sorted(LEVEL.keys() - {"plots", "replay"}))
    code = f"import sys, {names}; print([m for m in ('matplotlib', 'pandas', 'wandb') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


def test_importing_the_package_is_light() -> None:
    code = "import sys, magrl; print(any(m in sys.modules for m in ('torch', 'wandb', 'matplotlib', 'pandas')))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "False"
