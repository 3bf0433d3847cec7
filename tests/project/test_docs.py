"""The documentation agrees with the code: names, tests, links, examples, tables of keys, options and results."""

import importlib
import importlib.util
import inspect
import json
import math
import re
import sys
from itertools import chain
from pathlib import Path

import pytest
import torch
from torchrl.data import Binary, Bounded, Composite
from torchrl.envs import Compose, TransformedEnv

from magrl.agents import FieldPolicy, PolicyConfig, save_policy
from magrl.envs import PRIVILEGED_KEYS, PUBLIC_KEYS, GeomagneticNavEnv, Scenario
from magrl.transforms import AlignmentReward, FieldGradient, GradientHeading

ROOT = Path(__file__).parent.parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
EXAMPLES = [
    (page, block)
    for page in PAGES
    for block in re.findall(r"^```python\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)
]
NOTEBOOK = ROOT / "docs" / "tutorial.ipynb"
CELLS = ["".join(c["source"]) for c in json.loads(NOTEBOOK.read_text())["cells"] if c["cell_type"] == "code"]
EXAMPLES += [(NOTEBOOK, "\n".join(CELLS))]
BUDGET = {"total_frames = 60_000": "total_frames = 512", "= 512, 1024, 8": "= 64, 64, 1"}
"""Settings of trainings in examples, and those of their tests."""
THEORY, ENVIRONMENT, OWN_DATA, RELIABILITY = (
    (ROOT / "docs" / f"{name}.md").read_text() for name in ("theory", "environment", "own_data", "reliability")
)


def table_rows(text: str, header: str, first: str) -> dict[str, list[str]]:
    """Return the rows of the first table after ``header`` whose first column is ``first``, by their name in it."""
    assert header in text, header
    text = text.partition(header)[2]
    table = text[text.index(f"| {first} |") :].partition("\n\n")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]
    return {row[0].strip("`"): row[1:] for row in rows}


# Names


def test_equations_have_functions_and_tests() -> None:
    rows = [line for line in THEORY.splitlines() if re.match(r"\| (\d-\d|Table|Fig)", line)]
    assert len(rows) >= 18
    for row in rows:
        assert "`" in row.split("|")[3], row
        assert re.search(r"`tests/test_\w+\.py::\w+`", row), row


@pytest.mark.parametrize("name", sorted(set(re.findall(r"`(magrl(?:\.\w+){2,3})`", THEORY))))
def test_named_functions_exist(name: str) -> None:
    module, _, attribute = name.rpartition(".")
    assert hasattr(importlib.import_module(module), attribute)


@pytest.mark.parametrize("name", sorted(set(re.findall(r"`(tests/test_\w+\.py(?:::\w+)?)`", THEORY))))
def test_named_tests_exist(name: str) -> None:
    path, _, test = name.partition("::")
    assert re.search(rf"^(def|class) {test}\b" if test else "", (ROOT / path).read_text(), re.MULTILINE)


def test_tests_of_guarantees_exist() -> None:
    guarantees = RELIABILITY.partition("\n## ")[0]
    rows = [line for line in guarantees.splitlines() if line.startswith("| ")]
    assert len(rows) >= 20
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


def test_every_page_is_in_the_list_of_the_readme() -> None:
    readme = (ROOT / "README.md").read_text()
    for page in [*ROOT.glob("docs/*.md"), NOTEBOOK]:
        assert page.name == "index.md" or f"(docs/{page.name})" in readme, page.name


def test_citation_names_the_version_the_license_and_the_paper() -> None:
    import magrl

    citation = (ROOT / "CITATION.cff").read_text()
    assert f"version: {magrl.__version__}\n" in citation
    assert "license: MIT\n" in citation
    for text in (citation, THEORY, (ROOT / "README.md").read_text()):
        assert re.search(r"arxiv[\s:]2410\.15837", text, re.IGNORECASE)


# Examples


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory) -> Path:
    """Folder of a reader who has followed docs/start.md, with an untrained policy in runs/first."""
    folder = tmp_path_factory.mktemp("reader")
    (folder / "runs" / "first").mkdir(parents=True)
    policy = FieldPolicy(PolicyConfig(GeomagneticNavEnv(seed=0).observation_view(), (8,)))
    save_policy(folder / "runs" / "first" / "policy.pt", policy)
    return folder


@pytest.mark.parametrize(("page", "block"), EXAMPLES, ids=lambda value: getattr(value, "name", None))
def test_python_examples_run(page: Path, block: str, run_folder: Path, monkeypatch) -> None:
    monkeypatch.chdir(run_folder)
    for setting, small in BUDGET.items():
        block = block.replace(setting, small)
    names: dict[str, object] = {}
    exec(compile(block, str(page), "exec"), names)
    assert len(names) > 1, "an example should leave something behind"


def test_the_notebook_is_kept_without_outputs() -> None:
    """The build of the documentation executes it."""
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in cells)
    assert all(setting in EXAMPLES[-1][1] for setting in BUDGET)


def test_a_training_of_another_algorithm_is_short() -> None:
    block = next(block for page, block in EXAMPLES if page.name == "training_your_own.md")
    assert len(block.splitlines()) <= 80
    assert all(setting in block for setting in BUDGET)


# Tables of options


def documented_default(text: str) -> object:
    """Return the value that a cell of a table gives as a default; None for the word "random"."""
    text = text.strip("`").replace("π", "math.pi")
    if text == "random":
        return None
    try:
        return eval(text, {"math": math, "Scenario": Scenario})
    except (SyntaxError, NameError):
        return text


def test_options_of_the_environment_are_documented() -> None:
    options = dict(inspect.signature(GeomagneticNavEnv.__init__).parameters)
    rows = table_rows(ENVIRONMENT, "## Options", "option")
    for name in options.keys() - {"self", "scenario", "device", "changes"}:
        assert documented_default(rows[name][0]) == pytest.approx(options[name].default), name
    assert documented_default(rows["scenario"][0]) == Scenario()


def test_fields_of_a_scenario_are_documented() -> None:
    rows = table_rows(ENVIRONMENT, "## Scenario", "field")
    assert list(rows) == list(Scenario.model_fields)
    for name in rows.keys() - {"region", "date"}:
        assert documented_default(rows[name][0]) == getattr(Scenario(), name), name
    assert rows["date"][0] == Scenario().date.date().isoformat()


def test_keys_of_a_scenario_file_are_documented() -> None:
    rows = table_rows(OWN_DATA, "## File format", "key")
    keys = {name.partition(".")[0].partition("`")[0] for name in rows}
    assert keys == Scenario.model_fields.keys() - {"field", "names"}


# Tables of results


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_tables_are_those_that_were_measured(page: Path) -> None:
    spec = importlib.util.spec_from_file_location("publish", ROOT / "recipes" / "tables" / "publish.py")
    assert spec is not None
    assert spec.loader is not None
    publish = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = publish
    spec.loader.exec_module(publish)
    text = page.read_text()
    assert publish.filled(text, ROOT) == text


# Tables of keys


def bounds_of(spec) -> str | list[list[float]]:
    if isinstance(spec, Binary):
        return "0 or 1"
    if not isinstance(spec, Bounded):
        return "none"
    return torch.stack((spec.space.low[0], spec.space.high[0]), -1).double().flatten(0, -2).tolist()


def written_bounds(text: str) -> str | list[list[float]]:
    if not text.startswith("["):
        return text
    plain = text.replace("−", "-").replace("π", "math.pi")
    return [[float(eval(number, {"math": math})) for number in pair.split(",")] for pair in plain[1:-1].split("], [")]


def check_rows(rows: dict[str, list[str]], specs: Composite) -> None:
    for key, (shape, dtype, _, bounds, _) in rows.items():
        spec = specs[key]
        assert shape.strip("`") == f"[N, {', '.join(map(str, spec.shape[1:]))}]", key
        assert dtype == str(spec.dtype).removeprefix("torch."), key
        expected, written = bounds_of(spec), written_bounds(bounds)
        if isinstance(expected, str) or isinstance(written, str):
            assert written == expected, key
        else:
            for numbers in zip(chain(*written), chain(*expected), strict=True):
                assert numbers[0] == pytest.approx(numbers[1], abs=0.051 if abs(numbers[1]) < 1000 else 0.51), key


@pytest.fixture(scope="module")
def env() -> GeomagneticNavEnv:
    return GeomagneticNavEnv(num_envs=7, seed=0)


def all_specs(env) -> Composite:
    parts = env.observation_spec, env.full_action_spec, env.full_reward_spec, env.full_done_spec
    return Composite({key: part[key] for part in parts for key in part.keys(True, True)}, shape=env.batch_size)


def test_table_of_keys_is_that_of_the_environment(env) -> None:
    rows = table_rows(ENVIRONMENT, "## Keys", "key")
    assert set(rows) == set(all_specs(env).keys(True, True))
    check_rows(rows, all_specs(env))
    readers = {key: row[-1] for key, row in rows.items()}
    public = {key for key, reader in readers.items() if reader == "all policies"}
    assert public == {*PUBLIC_KEYS, "step_count"}
    others = {"training", "written by policies"}
    assert {key for key in readers if readers[key] not in others} - public == set(PRIVILEGED_KEYS)


def test_table_of_keys_that_transforms_add(env) -> None:
    guidance = [FieldGradient(env.field), GradientHeading(), AlignmentReward(out_keys=["reward", "reward_alignment"])]
    steps = [*guidance, *env.observation_view().observation_transforms()]
    specs = all_specs(TransformedEnv(GeomagneticNavEnv(num_envs=7, seed=0), Compose(*steps)))
    rows = table_rows(ENVIRONMENT, "transforms of the guided agent", "key")
    added = {key for key in specs.keys(True, True) if not key.endswith("_scaled")} - set(
        all_specs(env).keys(True, True)
    )
    assert set(rows) == added
    check_rows(rows, specs)
    privileged = {key for key in added if "gradient" in key or key.startswith("reward")}
    assert {key for key, row in rows.items() if row[-1] != "all policies"} == privileged
