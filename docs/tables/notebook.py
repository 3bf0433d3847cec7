"""Run the tutorial and keep its outputs in its file, which the documentation shows.

python docs/tables/notebook.py    # docs/tutorial.ipynb; two minutes on one core
"""

from __future__ import annotations

import base64
import io
import os
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from PIL import Image

NOTEBOOK = Path(__file__).parent.parent / "tutorial.ipynb"
COLORS = 64


def smaller(png: str) -> str:
    """Return a picture with few colors."""
    picture, shown = Image.open(io.BytesIO(base64.b64decode(png))), io.BytesIO()
    picture.convert("RGB").quantize(COLORS).save(shown, "PNG", optimize=True)
    return base64.b64encode(shown.getvalue()).decode()


def main() -> None:
    """Write the outputs of all cells, without warnings and logs of libraries, and without what names the machine."""
    os.environ["RL_LOGGING_LEVEL"] = "ERROR"
    notebook = nbformat.read(NOTEBOOK, 4)
    about = notebook.metadata.copy()
    with tempfile.TemporaryDirectory() as folder:
        where = {"metadata": {"path": folder}}
        NotebookClient(notebook, timeout=600, record_timing=False, coalesce_streams=True, resources=where).execute()
    notebook.metadata = about
    for cell in (cell for cell in notebook.cells if cell.cell_type == "code"):
        cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
        for output in cell.outputs:
            if "image/png" in output.get("data", {}):
                output.data["image/png"] = smaller(output.data["image/png"])
    nbformat.write(notebook, NOTEBOOK)


if __name__ == "__main__":
    main()
