"""What the documents say exists."""

import importlib
import importlib.util
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
EXAMPLES = [
    (page, block)
    for page in PAGES
    for block in re.findall(r"^```python\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)
]
THEORY = (ROOT / "docs" / "theory.md").read_text()


def test_equations_have_functions_and_tests() -> None:
    rows = [line for line in THEORY.splitlines() if re.match(r"\| (\d-\d|Table|Fig)", line)]
    assert len(rows) >= 18
    for row in rows:
        assert "`" in row.split("|")[3], row
        assert re.search(r"`tests/test_\w+\.py::\w+`", row), row


@pytest.mark.parametrize("name", sorted(set(re.findall(r"`(magrl(?:\.\w+){2})`", THEORY))))
def test_named_functions_exist(name: str) -> None:
    module, _, attribute = name.rpartition(".")
    assert hasattr(importlib.import_module(module), attribute)


@pytest.mark.parametrize("name", sorted(set(re.findall(r"`(tests/test_\w+\.py(?:::\w+)?)`", THEORY))))
def test_named_tests_exist(name: str) -> None:
    path, _, test = name.partition("::")
    assert re.search(rf"^(def|class) {test}\b" if test else "", (ROOT / path).read_text(), re.MULTILINE)


def test_tests_of_promises_exist() -> None:
    rows = [line for line in (ROOT / "docs" / "reliability.md").read_text().splitlines() if line.startswith("| ")]
    for row in rows[1:]:
        named = re.findall(r"`(test_\w+\.py)?(?:::)?(test_\w+)?`", row.split("|")[2])
        assert named, row
        file = ""
        for path, test in named:
            file = path or file
            source = (ROOT / "tests" / file).read_text()
            assert re.search(rf"^ *def {test}\b" if test else "", source, re.MULTILINE), f"{file}::{test}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text()):
        assert (page.parent / target).exists(), target


@pytest.mark.parametrize(("page", "block"), EXAMPLES, ids=lambda value: getattr(value, "name", None))
def test_python_examples_run(page: Path, block: str) -> None:
    names: dict[str, object] = {}
    exec(compile(block, str(page), "exec"), names)
    assert len(names) > 1, "an example should leave something behind"


def test_every_option_of_the_environment_is_documented() -> None:
    import inspect

    from magrl.env import GeomagneticNavEnv

    text = (ROOT / "docs" / "environment.md").read_text()
    for option in set(inspect.signature(GeomagneticNavEnv.__init__).parameters) - {"self"}:
        assert f"`{option}`" in text, option


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_tables_are_those_that_were_measured(page: Path) -> None:
    spec = importlib.util.spec_from_file_location("publish", ROOT / "recipes" / "publish.py")
    publish = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = publish
    spec.loader.exec_module(publish)
    text = page.read_text()
    assert publish.filled(text, ROOT) == text
