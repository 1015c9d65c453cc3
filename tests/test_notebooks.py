"""What holds for every notebook that ships; `python3 -m lib run` executes them."""

from __future__ import annotations

import ast
import re

import nbformat
import pytest

from lib import paths
from lib.workbench import pages

NOTEBOOKS = sorted(paths.NOTEBOOKS.glob("*.ipynb"))
ORDER = ["00_overview", "01_data", "02_landmark_detection", "03_affine_calibration", "04_stereo_reconstruction",
         "05_registration", "06_online_pipeline"]  # fmt: skip

every_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=[path.stem for path in NOTEBOOKS])


def read(path):
    return nbformat.read(path, as_version=4)


def code_cells(path):
    return [cell for cell in read(path).cells if cell.cell_type == "code"]


def test_they_are_all_there():
    assert [path.stem for path in NOTEBOOKS] == ORDER


@every_notebook
def test_valid_and_without_outputs(path):
    notebook = read(path)
    nbformat.validate(notebook)
    assert "widgets" not in notebook.metadata and "papermill" not in notebook.metadata
    for cell in code_cells(path):
        assert cell.outputs == [] and cell.execution_count is None, "clear all outputs before committing"


@every_notebook
def test_runs_in_the_workbench_kernel(path):
    assert read(path).metadata.kernelspec.name == "python3"


@every_notebook
def test_cell_ids_are_stable_and_unique(path):
    ids = [cell.id for cell in read(path).cells]
    assert len(ids) == len(set(ids))
    assert all(re.match(rf"{path.stem[:2]}-[a-z0-9-]+$", name) for name in ids), ids


@every_notebook
def test_parameters_are_typed_and_commented(path):
    first = code_cells(path)[0]
    assert first.metadata.get("tags") == ["parameters"]
    names = []
    for statement in ast.parse(first.source).body:
        assert isinstance(statement, ast.AnnAssign) and statement.value is not None, ast.unparse(statement)
        line = first.source.splitlines()[statement.end_lineno - 1]
        assert re.search(r"#\s+\S+", line), f"what is it? {line}"
        names.append(statement.target.id)
    assert names[:2] == ["profile", "seed"]


@every_notebook
def test_opens_with_a_title_and_closes_with_lessons_and_exercises(path):
    cells = read(path).cells
    assert re.match(r"# \d\. \S", cells[0].source)
    prose = "\n".join(cell.source for cell in cells if cell.cell_type == "markdown")
    assert "What we learnt" in prose and "Exercises" in prose


@every_notebook
def test_cells_call_lib_and_hold_no_algorithm(path):
    for cell in code_cells(path):
        for node in ast.walk(ast.parse(re.sub(r"^[%!].*$", "", cell.source, flags=re.MULTILINE))):
            if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.For | ast.While):
                statements = sum(isinstance(inner, ast.stmt) for inner in ast.walk(node)) - 1
                limit = 6 if isinstance(node, ast.For) else 4  # a loop may call and record, stage after stage
                assert statements <= limit, (
                    f"{cell.id}: {statements} statements in a {type(node).__name__} belong in lib"
                )


@every_notebook
def test_names_no_folder_of_one_machine(path):
    text = path.read_text(encoding="utf-8")
    assert not re.search(r'["\'\s](/home/|/Users/|/root/|/tmp/|[A-Z]:\\\\)', text)


@every_notebook
def test_equations_can_be_drawn(path):
    for cell in read(path).cells:
        if cell.cell_type == "markdown":
            left_as_tex = re.findall(
                r'<code class="tex">(.*?)</code>', pages.markdown_html(cell.source, folder=path.parent)
            )
            assert not left_as_tex, f"{cell.id}: {left_as_tex}"
