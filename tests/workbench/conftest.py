"""Tiny notebooks for the tests of the workbench."""

from __future__ import annotations

from pathlib import Path

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

PARAMETERS = """\
profile: str = "quick"  # "quick" or "paper"
seed: int = 0  # drives every random source
noise_px: float = 0.5  # of the detections
crop: bool = False  # the images
sizes: list = [1, 2]  # of the windows
"""


@pytest.fixture(scope="session")
def write_notebook():
    return _write_notebook


def _write_notebook(folder: Path, name: str, *cells: str, title: str = "A title", parameters: str = PARAMETERS) -> Path:
    """A notebook with a title, an equation, a parameters cell and code cells."""
    prose = f"# {title}\n\nEquation $u = M x$:\n\n$$\\operatorname*{{arg\\,min}}_{{M}} \\lVert u - M x \\rVert^2$$"
    notebook = new_notebook(
        cells=[
            new_markdown_cell(prose),
            new_code_cell(parameters, metadata={"tags": ["parameters"]}),
            *(new_code_cell(cell) for cell in cells),
        ],
        metadata={"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}},
    )
    path = folder / f"{name}.ipynb"
    nbformat.write(notebook, path)
    return path
