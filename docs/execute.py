"""Executes docs/tour.ipynb anew and keeps its outputs: `python docs/execute.py`. The test runs it, too, and keeps nothing."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

# The kernel warns of itself as it ends.
WARNINGS = "error,ignore::PendingDeprecationWarning"
NOTEBOOK = Path(__file__).with_name("tour.ipynb")


def executed(path: Path = NOTEBOOK) -> Any:
    """The notebook with fresh outputs; an error, or a warning, in a cell is an error. Runs are written to an empty folder."""
    notebook = nbformat.read(path, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        before = {name: os.environ.get(name) for name in ("PYTHONWARNINGS", "PYDEVD_DISABLE_FILE_VALIDATION", "IPYTHONDIR")}
        os.environ |= {"PYTHONWARNINGS": WARNINGS, "PYDEVD_DISABLE_FILE_VALIDATION": "1", "IPYTHONDIR": f"{folder}/ipython"}
        try:
            NotebookClient(notebook, timeout=300, resources={"metadata": {"path": folder}}, record_timing=False).execute()
        finally:
            for name, value in before.items():
                os.environ.pop(name) if value is None else os.environ.__setitem__(name, value)
    return notebook


if __name__ == "__main__":
    nbformat.write(executed(), NOTEBOOK)
