"""Sphinx configuration: `make docs` builds the documentation in build/docs, without network access."""

import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

import magrl  # noqa: E402 - this tree, not an installed version

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
nb_output_stderr = "remove"  # warnings and logs of libraries

autodoc_mock_imports = ["stable_baselines3"]
autodoc_default_options = {"ignore-module-all": True}  # describe a name only where it is defined
autodoc_member_order = "bysource"
autodoc_inherit_docstrings = False  # do not repeat TorchRL's docstrings
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True  # attributes as fields of their class, which may also be documented by autodoc
napoleon_custom_sections = ["Source"]


def add_title(app: Any, name: str, content: list[str]) -> None:  # noqa: ARG001
    """Give a table that has a page of its own the name of its file as a title."""
    if name.startswith("results/"):
        content[0] = f"---\norphan: true\n---\n\n# {name.removeprefix('results/')}\n\n{content[0]}"


def setup(app: Any) -> None:
    """Connect the hooks of this project."""
    app.connect("source-read", add_title)
