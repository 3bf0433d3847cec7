"""Sphinx configuration: `make docs` builds the documentation in build/docs, without network access."""

import inspect
import os
import re
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

from docutils import nodes  # noqa: E402
from sphinx import addnodes  # noqa: E402
from sphinx.ext.autodoc.preserve_defaults import update_defvalue  # noqa: E402
from sphinx.pycode import ModuleAnalyzer  # noqa: E402
from sphinx.util import inspect as sphinx_inspect  # noqa: E402
from sphinx.util.nodes import make_refnode  # noqa: E402

import magrl  # noqa: E402 - this tree, not an installed version
from magrl.envs.specs import KEYS  # noqa: E402

project, author, version = "magrl", "The magrl developers", magrl.__version__
project_copyright = author
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]

linked = re.findall(
    r"\((results/[\w-]+\.md)\)", "".join(page.read_text(encoding="utf-8") for page in ROOT.glob("docs/*.md"))
)
tables = {f"results/{path.name}" for path in ROOT.glob("docs/results/*.md")}
exclude_patterns = sorted(tables - set(linked))  # tables inside pages

html_theme = "furo"
html_title = f"magrl {version}"
html_static_path, html_css_files = ["_static"], ["tables.css"]

myst_heading_anchors = 3

nb_execution_mode, nb_execution_timeout = "force", 600  # a cell [s]
nb_execution_raise_on_error = nb_execution_in_temp = nb_merge_streams = True
nb_output_stderr = "remove"  # warnings of libraries
os.environ["RL_LOGGING_LEVEL"] = "ERROR"  # logs of TorchRL, which are not on stderr

autodoc_mock_imports = ["stable_baselines3"]
autodoc_default_options = {"ignore-module-all": True}  # describe a name only where it is defined
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True  # the names of constants, not their values
autodoc_inherit_docstrings = False  # do not repeat TorchRL's docstrings
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True  # attributes as fields of their class, which may also be documented by autodoc
napoleon_custom_sections = ["Source"]


def prepare(app: Any, name: str, content: list[str]) -> None:  # noqa: ARG001
    """Keep values and their intervals on one line; give a table that has a page of its own its file's name as title."""
    content[0] = content[0].replace(" ± ", "\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}")
    if name.startswith("results/"):
        content[0] = f"---\norphan: true\n---\n\n# {name.removeprefix('results/')}\n\n{content[0]}"


def describe(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:  # noqa: ARG001
    """Describe an imported constant as where it is defined; mend what napoleon takes for a type or a list."""
    lines[:] = [re.sub(r"^(\s*)([A-Z]\. )", r"\1\\\2", line) for line in lines]  # initials of authors
    if what in {"attribute", "property", "data"} and lines and lines[-1].startswith(":type: "):
        lines[0] = f"{lines.pop().removeprefix(':type: ')}: {lines[0]}"  # a sentence before its colon
    for module in [module for module in sys.modules if what == "data" and module.startswith("magrl.")]:
        lines[:] = ModuleAnalyzer.for_module(module).find_attr_docs().get(("", name.rpartition(".")[2]), lines)


def skip_numbers(*event: Any) -> bool | None:
    """Leave out fields that a tuple documents by their number alone: its class describes them."""
    return True if str(getattr(event[3], "__doc__", "")).startswith("Alias for field number") else None


def show_arguments(*event: Any) -> tuple[str, str | None] | None:
    """Show the arguments of a class whose metaclass takes any, such as TorchRL's; leave out types with validators."""
    app, what, _, obj, _, signature, returned = event
    if what != "class" or not re.search(r"^\(\*args|Annotated\[|<factory>", signature or ""):
        return None
    if signature.startswith("(*args"):
        update_defvalue(app, obj.__init__, False)
        own = sphinx_inspect.signature(obj.__init__, bound_method=True)
    else:
        own = inspect.signature(obj)
        own = own.replace(parameters=[each.replace(annotation=each.empty) for each in own.parameters.values()])
    shown = sphinx_inspect.stringify_signature(own, show_return_annotation=False, unqualified_typehints=True)
    return re.sub(r"^\(\*args.*", "()", shown).replace("<factory>", "{}"), returned


def show_types(app: Any, domain: str, kind: str, content: Any) -> None:  # noqa: ARG001
    """Show the type of a field with its range, without the code that checks it."""
    for node in content.parent.findall(addnodes.desc_annotation):
        if match := re.fullmatch(r": Annotated\[(.+?), \w+\(.*\)\]", node.astext()):
            limits = ", ".join(re.findall(r"\b[gl][te]=[^,)]+", node.astext()))
            node[:] = [nodes.Text(f": {match[1]}" + (f" ({limits})" if limits else ""))]


WORDS = {*KEYS, "step_price"}
"""Keys and options with the name of a function, which are not linked to it."""


def link_names(app: Any, doctree: nodes.document, page: str) -> None:
    """Link names of the API in inline code, with their package or without it, to their entries."""
    entries, short = app.env.domains.python_domain.objects, defaultdict(list)
    for full, entry in entries.items():
        name = full.rpartition(".")[2]
        word = name.islower() and ("_" not in name or name in WORDS) and name not in magrl.__all__
        if entry.objtype in {"class", "function", "data", "exception"} and not entry.aliased and not word:
            short[name].append(entry)
    for code in list(doctree.findall(nodes.literal)):
        text = code.astext().partition("(")[0]
        name = text.rpartition(".")[2] if text.startswith("magrl.") else text
        found = [entries[text]] if text in entries else short.get(name, [])
        if len(found) == 1 and not isinstance(code.parent, nodes.reference | nodes.title):
            code.replace_self(make_refnode(app.builder, page, found[0].docname, found[0].node_id, code.deepcopy()))


def list_names(app: Any, doctree: nodes.document, page: str) -> None:
    """List the classes and functions of a page of the API below its title, by their paths in its package."""
    entries = app.env.domains.python_domain.objects
    kinds = {"class", "function", "exception"}
    names = [name for name, entry in entries.items() if (entry.docname, entry.aliased) == (page, False)]
    names = sorted((name for name in names if entries[name].objtype in kinds), key=lambda name: name.rpartition(".")[2])
    listed = nodes.paragraph()
    for name in names if page.startswith("api/") else ():
        label = nodes.literal(text=name.removeprefix(f"magrl.{page.removeprefix('api/')}."))
        listed += [make_refnode(app.builder, page, page, entries[name].node_id, label), nodes.Text(" ")]
    if listed.children:
        doctree.next_node(nodes.section).insert(1, listed)


def setup(app: Any) -> None:
    """Connect the hooks of this project."""
    app.connect("source-read", prepare)
    app.connect("autodoc-process-docstring", describe, priority=600)  # after napoleon
    app.connect("autodoc-process-signature", show_arguments)
    app.connect("autodoc-skip-member", skip_numbers)
    app.connect("object-description-transform", show_types)
    app.connect("doctree-resolved", link_names)
    app.connect("doctree-resolved", list_names)
