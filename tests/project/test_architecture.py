"""The layout of the code: floors, cycles and sizes, as docs/architecture.md describes them."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path
from pkgutil import resolve_name

import pytest

from magrl.envs.scenario import RULES
from magrl.evaluation import Sheet
from magrl.pilot.records import EpisodeRules, Known

ROOT = Path(__file__).parent.parent.parent
PACKAGE = ROOT / "magrl"


PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
FLOOR = {name: int(floor) for floor, name in re.findall(r"^\| (\d) \| `(\w+)` \| \w", PAGE, re.MULTILINE)}
"""The floor of each part of the package."""


@cache
def sources() -> dict[str, ast.Module]:
    """The modules by name, such as ``magrl.field.igrf``; a package is that of its ``__init__.py``."""
    paths = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in sorted(PACKAGE.rglob("*.py"))}
    return {name.removesuffix(".__init__"): ast.parse(path.read_text(encoding="utf-8")) for name, path in paths.items()}


@cache
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


PRIVATE = {
    "torch._assert_async": {"magrl.checks"},
    "torch.utils._pytree": {"magrl.evaluation.arrays", "magrl.evaluation.scores"},
    "torch.utils._python_dispatch": {"magrl.pilot.harmonics"},
}
MODULES = [name for name in sources() if name != "magrl"]


def test_every_package_and_module_has_a_floor() -> None:
    packages = {path.parent.name for path in PACKAGE.glob("*/__init__.py")}
    modules = {path.stem for path in PACKAGE.glob("*.py")} - {"__init__"}
    assert packages | modules == set(FLOOR)


def test_no_import_upward_and_none_of_vehicles() -> None:
    pairs = [(top(module), top(other)) for module in MODULES for other in imported(module)]
    assert [pair for pair in pairs if FLOOR[pair[1]] > FLOOR[pair[0]]] == []
    assert {importer for importer, other in pairs if other == "onboard"} == {"onboard"}


def test_no_cycle_among_modules() -> None:
    """Neither between packages nor inside one; a package depends on all that its ``__init__.py`` imports."""
    graph = {module: imported(module) for module in MODULES}
    while graph:
        free = {module for module, needs in graph.items() if not needs & graph.keys()}
        assert free, f"a cycle among {sorted(graph)}"
        graph = {module: needs for module, needs in graph.items() if module not in free}


def test_private_names_of_torch_stand_in_known_modules() -> None:
    """Beside those of TorchRL's collector, in test_checkpoints.py, and ``_step``, which environments define."""
    pattern, found = re.compile(r"\b(?:torch|torchrl|tensordict)\b[\w.]*\._[a-z]\w*"), {}
    for module, tree in sources().items():
        for name in pattern.findall(ast.unparse(tree)):
            found.setdefault(name, set()).add(module)
    assert {name for name, modules in found.items() if modules - PRIVATE.get(name, set())} == set()
    for name, modules in found.items():
        try:
            resolve_name(name)
        except (AttributeError, ImportError) as error:
            raise AssertionError(f"{name} is gone: adapt {sorted(modules)}") from error


def test_what_an_extra_installs_is_imported_when_it_is_used() -> None:
    """By :func:`magrl.checks.library`, which names the extra; modules of magrl import without."""
    extra = r"matplotlib|PIL|tqdm|tyro|joblib|ray|onnx\w*|minari|h5py"
    extras = re.compile(rf"^ *(?:import|from) (?:{extra})\b", re.MULTILINE)
    for module, tree in sources().items():
        assert not extras.search(re.sub(r"if TYPE_CHECKING:\n(    .*\n)+", "", ast.unparse(tree) + "\n")), module


def test_files_that_the_page_names_exist() -> None:
    """A new file, NAME, stands in a folder that does."""
    paths = {ROOT / path for path in re.findall(r"`((?:magrl|docs|recipes|tests)/[\w/.]+)`", PAGE)}
    assert paths
    assert [path for path in paths if not (path.parent if path.stem == "NAME" else path).exists()] == []


# Rules of an episode, and what a vehicle knows


OTHER_MEANINGS = {"journal.Options.arrival", "tracks.Track.max_steps", "offline_dataset.Config.max_steps"}
OTHER_MEANINGS |= {"fly.Config.max_steps", "fly.Config.zeta", "fly.Config.start_heading"}
"""What a vehicle alone can do, frozen trips, and defaults that follow from a flight."""


def declarations(names: set[str]) -> set[str]:
    """Fields with some names and a default, of any class of the library, a recipe or a script."""
    found = set()
    for path in [*PACKAGE.rglob("*.py"), *(ROOT / "recipes").glob("*.py"), *(ROOT / "docs").rglob("*.py")]:
        for kind in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            for node in kind.body if isinstance(kind, ast.ClassDef) else ():
                if isinstance(node, ast.AnnAssign) and node.value and ast.unparse(node.target) in names:
                    found.add(f"{path.stem}.{kind.name}.{ast.unparse(node.target)}")
    return found


def test_a_rule_of_an_episode_is_declared_in_one_class() -> None:
    """With its default and its range: settings of any program inherit it."""
    declared = {f"records.EpisodeRules.{name}" for name in EpisodeRules.model_fields}
    declared |= {f"scenario.Scenario.{name}" for name in set(RULES) - EpisodeRules.model_fields.keys()}
    assert declarations(set(RULES)) == declared | OTHER_MEANINGS


ON_BOARD = {f"journal.Options.{name}" for name in ("model", "start_km", "north")}
ON_BOARD |= {"journal.Destination.target_std", "journal.Journal.model", "journal.Journal.start_km"}
"""Arguments of a vehicle of one's own; its options leave out what is given to its start."""


def test_what_is_known_is_declared_in_one_record() -> None:
    """A command, a table or a file of results that names one again would have to be changed with it."""
    declared = {f"records.Known.{name}" for name in Known.model_fields} | {"records.Rules.model"}
    declared |= {f"flight.Sheet.{name}" for name in set(Sheet.model_fields) - set(Known.model_fields)}
    found = declarations(set(Sheet.model_fields))
    assert found == declared | ON_BOARD | {"belief.Motion.model", "conditions.Conditions.errors"}


# Sizes


LONGEST_MODULE, LONGEST_FUNCTION = 300, 30


def code_lines(text: str, tree: ast.Module) -> set[int]:
    """Numbers of the lines that hold code: neither blank, nor a comment, nor part of a docstring."""
    values = [node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)]
    docstrings = [x for x in values if isinstance(x, ast.Constant) and isinstance(x.value, str)]
    lines = {number for number, line in enumerate(text.splitlines(), 1) if line.strip() and line.strip()[0] != "#"}
    return lines - {line for x in docstrings for line in range(x.lineno, (x.end_lineno or 0) + 1)}


def sizes(text: str) -> tuple[int, dict[str, int]]:
    """Lines of code, and those of the body of each function: with functions inside it, without its signature."""
    tree = ast.parse(text)
    code = code_lines(text, tree)
    functions = [x for x in ast.walk(tree) if isinstance(x, ast.FunctionDef)]
    bodies = {f"{x.name} in line {x.lineno}": range(x.body[0].lineno, (x.end_lineno or 0) + 1) for x in functions}
    return len(code), {name: len(code & set(lines)) for name, lines in bodies.items()}


def test_what_counts_as_code() -> None:
    text = '"""Module."""\n\n@cache\ndef add(\n    x,\n):\n    """Sum.\n"""\n    # note\n    y = [\n        x\n    ]\n'
    assert sizes(text) == (7, {"add in line 4": 3})


@pytest.mark.parametrize("folder", ["magrl", "recipes"])
def test_modules_and_functions_are_short(folder: str) -> None:
    """But for the function ``train`` of a recipe, which shows its loop. Ruff has no such limits."""
    found = {f"{path}": sizes(path.read_text(encoding="utf-8")) for path in (ROOT / folder).rglob("*.py")}
    assert {name: size for name, (size, _) in found.items() if size > LONGEST_MODULE} == {}
    functions = {f"{name}: {x}": size for name, (_, inside) in found.items() for x, size in inside.items()}
    assert [name for name, size in functions.items() if size > LONGEST_FUNCTION and ": train in" not in name] == []
