"""Make the tutorials' notebooks, with their outputs, from their sources, docs/tutorials/*.py.

    make notebooks

takes about a quarter of an hour on two CPU cores. Each runs in a Jupyter kernel of this Python, in an empty folder.
"""

import sys
import tempfile
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).resolve().parents[1] / "tutorials"


def make(source: Path) -> Path:
    """Execute a source as a notebook; returns the notebook's path.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell failed; nothing is written.
    """
    notebook = jupytext.read(source)
    notebook.metadata.kernelspec = {"display_name": "Python 3", "language": "python", "name": "python3"}
    with tempfile.TemporaryDirectory() as folder:
        NotebookClient(notebook, timeout=None, resources={"metadata": {"path": folder}}).execute()
    for place, cell in enumerate(notebook.cells):
        # The same for every run of the same source, so that a change shows as one.
        cell.id = f"cell-{place}"
        cell.metadata.pop("execution", None)
        cell.get("outputs", [])[:] = [out for out in cell.get("outputs", []) if out.get("name") != "stderr"]
    path = source.with_suffix(".ipynb")
    nbformat.write(notebook, path)
    return path


if __name__ == "__main__":
    for name in sys.argv[1:] or sorted(path.name for path in FOLDER.glob("*.py")):
        print(make(FOLDER / name), flush=True)
