"""What the documents say exists."""

import importlib
import importlib.util
import math
import re
import sys
from itertools import chain
from pathlib import Path

import pytest
import torch
from torchrl.data import Binary, Bounded, Composite
from torchrl.envs import Compose, TransformedEnv

from magrl import td3
from magrl.env import PRIVILEGED_KEYS, GeomagneticNavEnv

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
    promises = (ROOT / "docs" / "reliability.md").read_text().partition("\n## ")[0]
    rows = [line for line in promises.splitlines() if line.startswith("| ")]
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


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory) -> Path:
    """Where a reader stands who has done what docs/start.md says: with a policy, if not a good one, in runs/first."""
    folder = tmp_path_factory.mktemp("reader")
    (folder / "runs" / "first").mkdir(parents=True)
    policy = td3.FieldPolicy(td3.policy_config(GeomagneticNavEnv(seed=0), (8,), layer_norm=True))
    td3.save_policy(folder / "runs" / "first" / "policy.pt", policy)
    return folder


@pytest.mark.parametrize(("page", "block"), EXAMPLES, ids=lambda value: getattr(value, "name", None))
def test_python_examples_run(page: Path, block: str, run_folder: Path, monkeypatch) -> None:
    monkeypatch.chdir(run_folder)
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


# The table of keys is that of the specs


def key_rows(header: str) -> dict[str, list[str]]:
    """The cells of a table of keys in docs/environment.md, the one after some words."""
    text = (ROOT / "docs" / "environment.md").read_text().partition(header)[2]
    table = text[text.index("| key ") :].partition("\n\n")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[2:]]
    return {row[0].strip("`"): row[1:] for row in rows}


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
    rows = key_rows("## Keys")
    assert set(rows) == set(all_specs(env).keys(True, True))
    check_rows(rows, all_specs(env))
    readers = {key: row[-1] for key, row in rows.items()}
    public = {key for key, reader in readers.items() if reader == "everyone"}
    assert public == {*td3.PUBLIC_KEYS, "step_count"}
    others = {"the trainer", "written by policies"}
    assert {key for key in readers if readers[key] not in others} - public == set(PRIVILEGED_KEYS)


def test_table_of_keys_that_transforms_add(env) -> None:
    view = td3.policy_config(env, (8,), layer_norm=True)
    steps = [*td3.guidance_transforms(env, 3.0, 0.0), *td3.observation_transforms(view)]
    specs = all_specs(TransformedEnv(GeomagneticNavEnv(num_envs=7, seed=0), Compose(*steps)))
    rows = key_rows("transforms of the guided agent")
    added = {key for key in specs.keys(True, True) if not key.endswith("_scaled")} - set(
        all_specs(env).keys(True, True)
    )
    assert set(rows) == added
    check_rows(rows, specs)
    assert {key for key, row in rows.items() if row[-1] != "everyone"} == {key for key in added if "gradient" in key}
