"""Notebooks and parameters named on the command line."""

from __future__ import annotations

import argparse
import json
import re
import shutil

import papermill
import pytest

from lib import paths
from lib.workbench.execution import choose_notebooks, declared_grid, execute, parse_parameters, positive


@pytest.fixture(scope="module")
def books(write_notebook, tmp_path_factory):
    folder = tmp_path_factory.mktemp("notebooks")
    (folder / "studies").mkdir()
    for name in ("00_error", "02_dead", "03_good", "studies/noise"):
        write_notebook(folder, name, "1")
    return folder


def test_notebooks_are_chosen_by_number_name_or_path(books, tmp_path):
    assert [book.stem for book in choose_notebooks([], books)] == ["00_error", "02_dead", "03_good"]
    assert [book.stem for book in choose_notebooks(["03", "00_error", "00"], books)] == ["00_error", "03_good"]
    assert choose_notebooks([str(books / "03_good.ipynb")], books) == [(books / "03_good.ipynb").resolve()]
    for name in ("noise", "studies/noise", "studies/noise.ipynb"):
        assert choose_notebooks([name], books) == [books / "studies" / "noise.ipynb"]
    with pytest.raises(ValueError, match="unknown notebook: 3. There are: 00_error"):
        choose_notebooks(["3"], books)
    mine = shutil.copy(books / "03_good.ipynb", tmp_path)
    with pytest.raises(ValueError, match=r"03_good.ipynb and .*03_good.ipynb: a run has one page for each name"):
        choose_notebooks([str(mine), "03"], books)


def test_values_take_the_declared_type(books):
    pairs = [("seed", "7"), ("noise_px", "1e-3"), ("crop", "true"), ("sizes", "[3]"), ("profile", "1")]
    (values,) = parse_parameters(pairs, [books / "03_good.ipynb"]).values()
    assert values == {"seed": 7, "noise_px": 0.001, "crop": True, "sizes": [3], "profile": "1"}


def test_a_seed_below_zero_is_an_error(books):
    with pytest.raises(ValueError, match="parameter seed: -1 is below 0"):
        parse_parameters([("seed", "-1")], [books / "03_good.ipynb"])


def test_a_tuple_reaches_the_notebook_as_numbers(write_notebook, tmp_path):
    declared = "shift_mm: tuple[float, float] = (1.0, 2.0)  # mm"
    book = write_notebook(tmp_path, "06", "print(sum(shift_mm))", parameters=declared)
    (values,) = parse_parameters([("shift_mm", "0.5,0.25")], [book]).values()
    assert execute(book, tmp_path / "out.ipynb", values) is None
    assert '"0.75\\n"' in (tmp_path / "out.ipynb").read_text("utf-8")


@pytest.mark.parametrize(
    ("name", "text"), [("seed", "1.5"), ("noise_px", "much"), ("crop", "maybe"), ("sizes", "(1,)")]
)
def test_a_value_of_another_type_is_an_error(books, name, text):
    example = r", such as \[1, 2\]\.$" if name == "sizes" else r"\.$"
    with pytest.raises(ValueError, match=f"parameter {name}: .* is not of type [a-z]+{example}"):
        parse_parameters([(name, text)], [books / "03_good.ipynb"])


def test_a_parameter_reaches_only_who_declares_it(write_notebook, tmp_path):
    one = write_notebook(tmp_path, "00_one", parameters="a: int = 1  # one")
    two = write_notebook(tmp_path, "01_two", parameters="b: int = 1  # two")
    assert parse_parameters([("b", "2")], [one, two]) == {one: {}, two: {"b": 2}}
    with pytest.raises(ValueError, match=r"unknown parameter: c. Declared are: a, b\."):
        parse_parameters([("c", "2")], [one, two])
    with pytest.raises(ValueError, match=r"unknown parameter: recording\. Only other notebooks declare it: .*03_.*\. "):
        parse_parameters([("recording", "mine")], [one, two])


def test_the_grid_stands_in_the_comments(write_notebook, tmp_path):
    study = write_notebook(tmp_path, "study", parameters="""\
frames: int = 300  # of the sweep; grid: 75, 300, 1500
sizes: list = [1]  # of windows; grid: [1, 2], [3]
seed: int = 0  # drives all
""")
    assert declared_grid(study) == {"frames": ["75", "300", "1500"], "sizes": ["[1, 2]", "[3]"]}


@pytest.mark.parametrize("text", ['{"cells": [', "[]", "5", '{"cells": 3}', '{"nbformat": 4, "metadata": {}, "cells": [3]}'])
def test_a_notebook_that_is_no_notebook(text, tmp_path):
    (tmp_path / "torn.ipynb").write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match="torn.ipynb: not a notebook"):
        declared_grid(tmp_path / "torn.ipynb")


@pytest.mark.parametrize("text", ["nan", "inf", "0", "-1", "soon"])
def test_seconds_are_positive_numbers(text):
    assert positive("2.5") == 2.5
    with pytest.raises(argparse.ArgumentTypeError, match="not a number of seconds above 0"):
        positive(text)


@pytest.mark.parametrize("notebook", sorted(paths.NOTEBOOKS.rglob("[!.]*.ipynb")), ids=lambda path: path.stem)
def test_every_parameter_of_a_notebook_can_be_set(notebook):
    """Papermill passes over a line whose comment it cannot read, such as one with an equals sign."""
    cells = json.loads(notebook.read_text())["cells"]
    source = "".join(next(cell for cell in cells if cell["cell_type"] == "code")["source"])
    assert set(re.findall(r"^(\w+)\s*[:=]", source, re.M)) == set(papermill.inspect_notebook(str(notebook)))
