"""The documentation agrees with the code: names, links, examples, commands, and tables of keys, options and results."""

import ast
import contextlib
import importlib
import importlib.util
import inspect
import io
import json
import re
import runpy
import shlex
import sys
from functools import cache
from itertools import chain
from pathlib import Path

import gymnasium
import pytest
import torch
from support.recipes import load
from torchrl.data import Composite

import magrl
from magrl.envs import PRIVILEGED_KEYS, PUBLIC_KEYS, GeomagneticNavEnv, planet_scenario
from magrl.errors import CONDITIONS
from magrl.evaluation.tracks import read_episodes
from magrl.files import read_document
from magrl.named_tasks import NAMED_TASKS
from magrl.navigators import FieldPolicy, PolicyConfig, save_policy

bars, flights, publish = (load(f"docs/tables/{name}") for name in ("bars", "flights", "publish"))
ROOT = Path(__file__).parent.parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
TEXTS = {page: page.read_text(encoding="utf-8") for page in PAGES}
ENVIRONMENT = TEXTS[ROOT / "docs" / "environment.md"]
NOTEBOOK = ROOT / "docs" / "tutorial.ipynb"
CELLS = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
BLOCK = re.compile(r"^```(python|sh)\n(.*?)^```", re.MULTILINE | re.DOTALL)
EXAMPLES = [(page, code) for page in PAGES for language, code in BLOCK.findall(TEXTS[page]) if language == "python"]
SCRIPTS = [
    ROOT / "docs" / "examples" / f"{name}.py"
    for name in ("autopilot", "ins", "lamps", "navigator", "sac", "sb3_anywhere", "turns")
]
EXAMPLES += [(path, path.read_text(encoding="utf-8")) for path in SCRIPTS]
EXAMPLES += [(NOTEBOOK, "\n".join("".join(cell["source"]) for cell in CELLS if cell["cell_type"] == "code"))]
AMOUNT = re.compile(r"""\b(\w+)(["']?(?: = |=|: |\())([\d_]+)\b""")
MOST = {
    "num_envs": 64,
    "batch_size": 128,
    "total_frames": 512,
    "total_timesteps": 512,
    "learn": 512,
    "n_steps": 8,
    "max_steps": 4,
    "earth_scenario": 2,
    "random_trips": 2,
    "num_trips": 2,
}
"""What a test has time for of an argument, a variable, or the first argument of a function."""
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)

# Names and links


@each_page
def test_links_and_names_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", TEXTS[page]):
        assert (page.parent / target).exists(), target
    for name in re.findall(r"`(magrl(?:\.\w+){2,3})`", TEXTS[page] if page.name != "CHANGELOG.md" else ""):
        module, _, attribute = name.rpartition(".")
        assert importlib.util.find_spec(module), name
        assert hasattr(importlib.import_module(module), attribute) or importlib.util.find_spec(name), name


def test_the_api_has_the_names_that_pages_import() -> None:
    nodes = chain(*(ast.walk(ast.parse(code)) for path, code in EXAMPLES if path not in SCRIPTS))
    imports = [node for node in nodes if isinstance(node, ast.ImportFrom) and str(node.module).startswith("magrl.")]
    page = "".join(path.read_text(encoding="utf-8") for path in ROOT.glob("docs/api/*.md"))
    shown = set(re.findall(r"^\.\. auto\w+:: \S+\.(\w+)", page, re.MULTILINE))
    for name, members in re.findall(r"^\.\. automodule:: (\S+)\n   :members: *(.*)", page, re.MULTILINE):
        module = importlib.import_module(name)
        own = re.findall(r"^(?:def |class )?(\w+)", inspect.getsource(module), re.MULTILINE)
        imported = [key for key, value in vars(module).items() if callable(value)]  # of a package, without its data
        shown |= set(members.split(", ") if members else imported if hasattr(module, "__path__") else own)
    assert {name.name for node in imports for name in node.names} <= shown


def test_every_page_is_in_the_index() -> None:
    index = TEXTS[ROOT / "docs" / "index.md"].splitlines()
    for page in {*ROOT.glob("docs/*.md"), NOTEBOOK} - {ROOT / "docs" / "index.md"}:
        assert page.stem in index
    assert f"version: {magrl.__version__}" in (ROOT / "CITATION.cff").read_text(encoding="utf-8").splitlines()


# Examples and commands


@pytest.fixture(scope="module")
def reader(tmp_path_factory) -> Path:
    """Folder of a reader who has followed docs/start.md, with an untrained policy in runs/first."""
    folder = tmp_path_factory.mktemp("reader")
    (folder / "runs" / "first").mkdir(parents=True)
    policy = FieldPolicy(PolicyConfig(GeomagneticNavEnv(seed=0).observation_view(), (8,)))
    save_policy(folder / "runs" / "first" / "policy.safetensors", policy)
    return folder


def shortened(code: str) -> str:
    """Return an example with amounts that a test has time for."""
    return AMOUNT.sub(lambda x: f"{x[1]}{x[2]}{min(int(x[3]), MOST[x[1]])}" if x[1] in MOST else x[0], code)


def test_examples_are_shortened_by_the_names_of_amounts() -> None:
    long = 'f(num_envs=512, {"n_steps": 6, "max_steps": 1_000}, steps=90).learn(9_000)'
    assert shortened(long) == 'f(num_envs=64, {"n_steps": 6, "max_steps": 4}, steps=90).learn(512)'


@pytest.mark.parametrize(("page", "code"), EXAMPLES, ids=lambda value: getattr(value, "name", ""))
def test_python_examples_run_and_print_what_they_say(page: Path, code: str, reader: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(reader)
    said = re.findall(r"^ *print\(.*\)  # (?!about)(.*)", code, re.MULTILINE) if page in TEXTS else []
    before = f"{code}```\n" if page in TEXTS else f"[{page.name}](examples/{page.name}) prints:\n"
    block = "".join(TEXTS.values()).partition(f"{before}\n```text\n")[2].partition("```")[0]
    long = shortened(code) != code or "runs/first" in code
    if "stable_baselines3" in code:
        pytest.importorskip("stable_baselines3")
    exec(compile(shortened(code), str(page), "exec"), {})
    printed = capsys.readouterr().out
    assert long or printed.endswith(block)
    assert all(any(line and line in text for line in printed.splitlines()) for text in said), printed


def test_the_notebook_is_kept_with_small_outputs() -> None:
    """`make notebook` writes them, without logs, colors of a terminal and paths of a machine."""
    outputs = [cell["outputs"] for cell in CELLS if cell["cell_type"] == "code"]
    assert [number for number, output in enumerate(outputs) if not output] == [3]  # the training
    assert {output.get("name", "stdout") for output in chain(*outputs)} == {"stdout"}
    assert not re.search(r"\\u001b|/(home|root|tmp|usr)/|torchrl\]", json.dumps(outputs))
    assert NOTEBOOK.stat().st_size < 150_000


@cache
def help_text(script: str) -> str:
    """Return the --help of a script, or of a module after ``-m``."""
    run, name = (runpy.run_module, script[3:]) if script.startswith("-m ") else (runpy.run_path, str(ROOT / script))
    shown = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(shown), contextlib.suppress(SystemExit):
        patch.setattr(sys, "argv", [script, "--help"])
        patch.syspath_prepend(ROOT / "recipes")
        patch.setenv("COLUMNS", "200")
        patch.delitem(sys.modules, f"{name}.__main__", raising=False)  # runpy warns of a module that is loaded already
        run(name, run_name="__main__")
    return shown.getvalue()


def test_help_breaks_lines_between_sentences() -> None:
    """It keeps the lines of docstrings of options."""
    shared = (ROOT / "magrl" / name for name in ("training/config.py", "evaluation/options.py"))
    for path in (*ROOT.glob("recipes/**/*.py"), *shared):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef) and node.name.endswith(("Config", "Options")):
                options = [member.value.value for member in node.body[1:] if isinstance(member, ast.Expr)]
                assert [text for text in options if not all(line.endswith(".") for line in text.splitlines())] == []


def commands(text: str) -> list[list[str]]:
    """Return the commands of shell blocks and of code in a text as words, without comments and what a loop adds."""
    lines = [line for language, code in BLOCK.findall(text) if language == "sh" for line in code.splitlines()]
    joined = "\n".join(lines).replace("\\\n", " ").splitlines()
    prose = re.findall(r"`((?:make|python) [^`]+)`", BLOCK.sub("", text))
    words = [shlex.split(part, comments=True) for line in joined + prose for part in line.split(";")]
    return [[w for w in command if not re.match(r"do$|done$|[A-Z_]+=\d", w)] for command in words]


@each_page
def test_scripts_options_and_targets_exist(page: Path) -> None:
    for program, *rest in filter(None, commands(TEXTS[page])):
        if program == "make":
            assert re.search(rf"^{rest[0]}:", MAKEFILE, re.MULTILINE), rest
        elif program.endswith("python"):
            script = " ".join(rest[: 1 + (rest[0] == "-m")])
            for flag in (word.partition("=")[0] for word in rest if word.startswith("--")):
                assert re.search(rf"{flag}(?![\w-])", help_text(script)), f"{script} has no {flag}"
            assert rest[0] == "-m" or (ROOT / script).is_file(), script
    recipes = [str(path.relative_to(ROOT)) for path in ROOT.glob("recipes/*.py")]
    known = "".join(map(help_text, recipes))
    for flag in re.findall(r"`(--[\w-]+)", TEXTS[page]):
        assert re.search(rf"{flag}(?![\w-])", known), f"no script has {flag}"


# Tables


def tables(text: str, first: str) -> list[dict[str, list[str]]]:
    """Return the tables of a page whose first column has some name: their rows by the name in that column."""
    found = re.findall(rf"^\| {re.escape(first)} \|.*\n\|.*\n((?:\|.*\n)+)", text, re.MULTILINE)
    cells = [[[cell.strip() for cell in line.strip("|").split("|")] for line in body.splitlines()] for body in found]
    return [{row[0].strip("`"): row[1:] for row in body} for body in cells]


@each_page
def test_no_line_is_a_comment(page: Path) -> None:
    """In MyST, a line that begins with a percent sign is one."""
    assert not re.findall(r"^%.*", TEXTS[page], re.MULTILINE)


@each_page
def test_tables_have_a_header_and_no_hole(page: Path) -> None:
    text = re.sub(r"^( *)```.*?^\1```", "", TEXTS[page], flags=re.MULTILINE | re.DOTALL)
    for table in re.findall(r"(?:^ *\|.*\n)+", text, re.MULTILINE):
        header, rule, *body = ([cell.strip() for cell in line.split("|")] for line in table.splitlines())
        assert {cell.strip(":-") for cell in rule} == {""}, f"no header: {table}"
        assert all(rule[1:-1]), f"no header: {table}"
        assert body, f"no row: {table}"
        assert {len(row) for row in body} == {len(header)} == {len(rule)}, table


@each_page
def test_tables_are_those_that_were_measured(page: Path) -> None:
    for block in publish.BLOCK.finditer(TEXTS[page]):
        name, table = block[2], block[0].partition("\n")[2].removesuffix("<!-- end -->")
        measured = (ROOT / name).read_text(encoding="utf-8").strip()
        assert table.strip() == publish.selected(measured, block[3]).strip(), name
        lines = re.findall(r"^\| \w.*", table, re.MULTILINE)
        assert len(set(lines)) == len(lines), f"{name} has a row twice"


def test_the_verdict_of_the_reproduction_has_the_numbers_that_were_measured() -> None:
    """Rows of the paper stand before ours, and the first four are of the trained agents."""
    files = [ROOT / f"docs/results/{name}.md" for name in ("paper-run", "populations")]
    columns = "navigator | SR % | TL m | SPL % | TNT steps"
    tables = [publish.selected(file.read_text(encoding="utf-8"), columns).splitlines()[2:] for file in files]
    lines = TEXTS[ROOT / "docs/reproduction.md"].partition("| verdict |\n")[2].splitlines()[1:6]
    results = [[cell.strip() for cell in row.strip("|").split("|")] for row in (*tables[0][:4], *tables[1])]
    for line, published, measured in zip(lines, results[::2], results[1::2], strict=True):
        name, *shown = (cell.strip() for cell in line.strip("|").split("|")[:5])
        assert name.startswith(measured[0])
        pairs = zip(measured[1:], published[1:], strict=True)
        assert shown == [f"{here.split()[0]} / {there}" for here, there in pairs]


@pytest.mark.parametrize("path", sorted(ROOT.glob("docs/results/[!s]*.csv.gz")), ids=lambda path: path.name)
def test_episodes_give_the_numbers_of_their_table(path: Path) -> None:
    lines = path.with_name(f"{path.name[:-7]}.md").read_text(encoding="utf-8").splitlines()
    lines = [line.strip("| ").split(" | ") for line in lines]
    head, _, *body = lines
    about = flights.ABOUT if head[2] == "start" else ["navigator", "trained on", "given"]  # of an older table
    assert head[: len(about)] == list(about)
    titles = flights.titles_of(about, body)
    if head[2] == "given":
        titles = [title.replace("(given: ", "(") for title in titles]
    cells = {
        (title, level): cell
        for title, row in zip(titles, body, strict=True)
        for level, cell in zip(head[len(about) :], row[len(about) :], strict=True)
    }
    for key, some in read_episodes(path).groupby(["navigator", "level"]):
        region = torch.tensor(some["region"].to_numpy())
        region = region if "±" in cells[key] else None
        ends = [torch.tensor(some[name].to_numpy()).double() for name in ("success", "spl", "false_arrival")]
        success, *others = (flights.shown(100 * end.mean().item(), end, region) for end in ends)
        assert cells[key] in [f"{success} / {other}" for other in others]  # beside SPL, or beside false arrivals


@pytest.mark.parametrize("name", NAMED_TASKS)
def test_pages_have_the_scores_of_a_task(name: str) -> None:
    """All numbers of its rows are measured; the threshold is below the reference by the half of an interval."""
    scores, task = (ROOT / "docs/results/scores.md").read_text(encoding="utf-8"), NAMED_TASKS[name]
    decimals, known = r"(?<![\d.])\d+\.\d(?!\d)", re.findall(rf"^\| {name} \|.*", scores, re.MULTILINE)
    pages = TEXTS[ROOT / "README.md"] + TEXTS[ROOT / "docs/tasks.md"]
    prefix = "magrl/GeomagneticNavigation"
    rows = re.findall(rf"^\|.*`(?:{prefix})?{task.id.removeprefix(prefix)}`.*", pages, re.MULTILINE)
    shown = re.findall(decimals, "".join(rows))
    assert shown
    assert set(shown) <= set(re.findall(decimals, "".join(known)))
    agent = bars.BARS[bars.TASKS[name].reference]
    (earned,) = (re.findall(decimals, row)[0] for row in known if f"| {agent} |" in row)
    assert 0 < float(earned) / 10 - task.threshold < 0.2


@pytest.mark.parametrize("name", NAMED_TASKS)
def test_a_named_task_has_a_section_that_lists_its_observation(name: str, monkeypatch) -> None:
    """By index, without a hole, or it names the task that has the same."""
    monkeypatch.setattr("magrl.named_tasks._planets", lambda: planet_scenario(4, seed=0))
    task, page = NAMED_TASKS[name], TEXTS[ROOT / "docs/tasks.md"]
    env, text = task.make(seed=0), page.partition(f"\n## {task.title}\n\n")[2].partition("\n## ")[0]
    assert text
    assert f"{task.id.removeprefix('magrl/GeomagneticNavigation')}`" in page
    assert gymnasium.spec(task.id).reward_threshold == task.threshold
    listed = [part.split("–") for table in tables(text, "index") for row in table for part in row.split(", ")]
    indices = list(chain(*(range(int(part[0]), int(part[-1]) + 1) for part in listed)))
    size = env.observation_spec["observation"].shape[-1]
    first = indices[0] if indices else size
    assert indices == list(range(first, size))
    assert first == 0 or any(other.title in text for other in NAMED_TASKS.values() if other is not task)


def test_the_recipe_of_several_tasks_knows_none() -> None:
    """Their settings are its presets, which are data."""
    script, data = ROOT / "recipes/td3_gradient_guided.py", read_document(ROOT / "recipes/presets.toml")
    tree = ast.parse(script.read_text(encoding="utf-8"))
    tree.body = tree.body[1:]  # the examples of the command
    trained = {table.get("task") for table in data[script.stem].values()} - {None}
    assert trained
    assert re.findall("|".join({*NAMED_TASKS} | trained), ast.unparse(tree), re.IGNORECASE) == []


def test_no_code_lists_the_named_tasks_again() -> None:
    """Three of them in one literal are a list."""
    found = []
    for path in (*ROOT.glob("magrl/**/*.py"), *ROOT.glob("recipes/*.py"), *ROOT.glob("docs/tables/*.py")):
        text = path.read_text(encoding="utf-8").lower()
        for node in ast.walk(ast.parse(text)) if sum(f'"{name}' in text for name in NAMED_TASKS) > 2 else ():
            parts = [*getattr(node, "keys", []), *getattr(node, "elts", [])]
            names = {str(part.value).split("-")[0].lower() for part in parts if isinstance(part, ast.Constant)}
            found += [f"{path.name}: {ast.unparse(node)}"] * (len(names & {*NAMED_TASKS}) > 2)
    assert found == []


def test_presets_and_their_speeds() -> None:
    (documented,) = tables(TEXTS[ROOT / "docs/results.md"], "preset")
    assert {name: float(speed) for name, (speed, *_) in documented.items()} == {
        name: preset.speed_km_h for name, preset in CONDITIONS.items() if name != "laboratory"
    }


def all_specs(env) -> Composite:
    kinds = env.observation_spec, env.full_action_spec, env.full_reward_spec, env.full_done_spec
    return Composite(dict(chain(*(kind.items(True, True) for kind in kinds))), shape=env.batch_size)


def test_tables_of_keys() -> None:
    specs = all_specs(GeomagneticNavEnv(num_envs=7, seed=0))
    public, others = tables(ENVIRONMENT, "key")
    assert set(public) == {*PUBLIC_KEYS, "elapsed_steps"}
    assert others.keys() >= {*PRIVILEGED_KEYS}
    assert {*public, *others} == set(specs.keys(True, True))
    for key, (kind, _) in (public | others).items():
        spec = specs[key]
        assert kind == f"`[N, {', '.join(map(str, spec.shape[1:]))}]` {str(spec.dtype).removeprefix('torch.')}", key
