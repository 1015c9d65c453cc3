"""What holds for every notebook that ships: `python3 -m lib run` executes the walk, `sweep` the studies."""

from __future__ import annotations

import ast
import re
from functools import cache

import nbformat
import pytest

from lib import paths
from lib.workbench import pages, results
from lib.workbench.parameters import declared_grid, declared_parameters, parse_parameters

WALK = sorted(paths.NOTEBOOKS.glob("*.ipynb"))
STUDIES = sorted(paths.NOTEBOOKS.glob("studies/*.ipynb"))
ORDER = ["00_overview", "01_data", "02_landmark_detection", "03_affine_calibration", "04_stereo_reconstruction",
         "05_registration", "06_online_pipeline"]  # fmt: skip


def each(notebooks):
    return pytest.mark.parametrize("path", notebooks, ids=[path.stem for path in notebooks])


@cache
def read(path):
    return nbformat.read(path, as_version=4)


def code_cells(path):
    return [cell for cell in read(path).cells if cell.cell_type == "code"]


def test_they_are_all_there():
    assert [path.stem for path in WALK] == ORDER and len(STUDIES) >= 20


@each(WALK + STUDIES)
def test_valid_and_without_outputs(path):
    notebook = read(path)
    nbformat.validate(notebook)
    assert "widgets" not in notebook.metadata and "papermill" not in notebook.metadata
    assert notebook.metadata.kernelspec.name == "python3"
    for cell in code_cells(path):
        assert cell.outputs == [] and cell.execution_count is None, "clear all outputs before committing"


@each(WALK + STUDIES)
def test_cell_ids_are_stable_and_unique(path):
    start = path.stem.replace("_", "-") if path in STUDIES else path.stem[:2]
    ids = [cell.id for cell in read(path).cells]
    assert len(ids) == len(set(ids))
    assert all(re.fullmatch(rf"{start}-[a-z0-9-]+", name) for name in ids), ids


@each(WALK + STUDIES)
def test_parameters_are_typed_and_commented(path):
    first = code_cells(path)[0]
    assert first.metadata.get("tags") == ["parameters"]
    names = []
    for statement in ast.parse(first.source).body:
        assert isinstance(statement, ast.AnnAssign) and statement.value is not None, ast.unparse(statement)
        line = first.source.splitlines()[statement.lineno - 1]
        assert statement.lineno == statement.end_lineno, "papermill reads one line a parameter"
        assert re.search(r"#\s+\S+", line), f"what is it? {line}"
        names.append(statement.target.id)
    assert path in STUDIES or names[:2] == ["profile", "seed"]


@each(WALK)
def test_opens_with_a_title_and_closes_with_lessons_and_exercises(path):
    cells = read(path).cells
    assert re.match(r"# \d\. \S", cells[0].source)
    prose = "\n".join(cell.source for cell in cells if cell.cell_type == "markdown")
    assert "What we learnt" in prose and "Exercises" in prose


@each(STUDIES)
def test_a_study_asks_measures_and_says_how_to_read_its_table(path):
    cells = read(path).cells
    assert re.match(r"# Study: .*\?", cells[0].source) and cells[1].metadata.get("tags") == ["parameters"]
    assert any("report.record(" in cell.source for cell in code_cells(path))
    assert cells[-1].source.startswith("## Reading the table")


@each(STUDIES)
def test_the_grid_fits_the_parameters(path):
    for name, values in declared_grid(path).items():
        assert values, name
        for value in values:
            parse_parameters([(name, value)], [path])
    table = results.read(path.stem)
    if table is not None:
        varied = {name for name, values in declared_grid(path).items() if len(values) > 1}
        assert varied <= set(table.columns), "the recorded table lacks a parameter of the grid"
        assert {"command", "commit", "machine", "date"} <= set(table.provenance)


def test_every_recorded_table_has_its_study():
    assert {path.stem for path in paths.RESULTS.glob("*.csv")} <= {path.stem for path in STUDIES}


@each(WALK + STUDIES)
def test_names_no_folder_of_one_machine(path):
    text = path.read_text(encoding="utf-8")
    assert not re.search(r'["\'\s](/home/|/Users/|/root/|/tmp/|[A-Z]:\\\\)', text)


@each(WALK + STUDIES)
def test_equations_can_be_drawn(path):
    for cell in read(path).cells:
        if cell.cell_type == "markdown":
            html = pages.markdown_html(cell.source, folder=path.parent)
            left_as_tex = re.findall(r'<code class="tex">(.*?)</code>', html)
            assert not left_as_tex, f"{cell.id}: {left_as_tex}"


@each(WALK + STUDIES)
def test_parameters_can_be_read_by_papermill(path):
    assert all(declared_parameters(path).values())
