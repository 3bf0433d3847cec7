"""Commands in the documents can be given: their scripts, flags and make targets exist."""

import contextlib
import importlib.util
import io
import re
import runpy
import shlex
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
MAKEFILE = (ROOT / "Makefile").read_text()
RECIPE_OF = {"train": "recipes/td3_gradient_guided.py", "replay": "recipes/replay.py", "bench": "-m benchmarks"}
RECIPE_OF |= {"fly": "recipes/fly.py", "anywhere": "recipes/td3_anywhere.py"}
TABLES = set(re.findall(r"^\[([\w-]+)\]$", (ROOT / "recipes/tables/tables.toml").read_text(), re.MULTILINE))
"""Scripts that get the ARGS of a make target; pytest and mutmut have their own."""
TOOLS = {"tensorboard", "wandb", "chromium"}
"""Other programs in the documents, whose flags are not checked."""


def shell_lines(text: str) -> list[str]:
    """Return the lines of shell blocks, continued ones joined, and commands in the text."""
    blocks = re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    prose = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    return lines + re.findall(r"`((?:make|python|pip|\.venv/bin/python) [^`]+)`", prose)


def commands(line: str) -> list[list[str]]:
    """Return the commands of a line as lists of words, without comments, loops and variables set before a command."""
    lexer = shlex.shlex(line, posix=True, punctuation_chars=";|&")
    lexer.whitespace_split = True
    listed: list[list[str]] = [[]]
    for word in lexer:
        if set(word) <= set(";|&"):
            listed.append([])
        elif word != "do" and (listed[-1] or not re.match(r"\w+=", word)):
            listed[-1].append(word)
    return [words for words in listed if words and words[0] not in ("for", "done")]


@cache
def help_text(script: str) -> str:
    """Return the --help of a script or a module."""
    said, kept = io.StringIO(), (sys.argv, sys.path[:])
    sys.argv, sys.path[:] = [script, "--help"], [str(ROOT / "recipes"), *sys.path]
    try:
        with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
            if script.startswith("-m "):
                runpy.run_module(script.removeprefix("-m "), run_name="__main__", alter_sys=True)
            else:
                runpy.run_path(str(ROOT / script), run_name="__main__")
    finally:
        sys.argv, sys.path[:] = kept
    return said.getvalue()


def has_flags(script: str, words: list[str]) -> None:
    for flag in (word.partition("=")[0] for word in words if word.startswith("--")):
        assert re.search(rf"(?<![\w-]){flag}(?![\w-])", help_text(script)), f"{script} has no {flag}"


def check_command(words: list[str]) -> None:
    program, *rest = words
    if program == "make":
        for word in rest:
            name, equals, value = word.partition("=")
            assert equals or re.search(rf"^{word}:", MAKEFILE, re.MULTILINE), f"make has no target {word}"
            assert name != "TABLES" or set(value.split()) <= TABLES, value
            if name == "ARGS" and rest[0] in RECIPE_OF:
                has_flags(RECIPE_OF[rest[0]], shlex.split(value))
    elif program in ("python", ".venv/bin/python"):
        if rest[0] == "-c":
            compile(rest[1], "a command", "exec")
            return
        script = f"-m {rest[1]}" if rest[0] == "-m" else rest[0]
        assert importlib.util.find_spec(rest[1]) if rest[0] == "-m" else (ROOT / script).is_file(), script
        has_flags(script, rest[1:])
    elif program == "pip":
        extras = re.findall(r"^(\w+) = \[", (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
        wanted = re.findall(r"\[([\w,]+)\]", " ".join(rest))
        assert {extra for text in wanted for extra in text.split(",")} <= set(extras), rest
    else:
        assert program in TOOLS, f"the documents use {program!r}, whose commands no test can check"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_can_be_given(page: Path, monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    for line in shell_lines(page.read_text()):
        for words in commands(line):
            check_command(words)


def test_flags_in_the_text_exist(monkeypatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    scripts = [str(path.relative_to(ROOT)) for path in ROOT.glob("recipes/*.py")]
    scripts += [f"recipes/tables/{name}.py" for name in ("grid", "figures", "publish")]
    modules = ["-m benchmarks", "-m magrl.field"]
    known = "".join(help_text(script) for script in [*scripts, *modules])
    for page in PAGES:
        for flag in re.findall(r"`(--[\w-]+)[^`]*`", page.read_text()):
            assert re.search(rf"(?<![\w-]){flag}(?![\w-])", known), f"{page.name} mentions {flag}, which no script has"
