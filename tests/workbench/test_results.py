"""Recorded tables: what is written is read back with its types."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lib.workbench import results
from notebooks.figures.course import recorded_table

ROWS = [
    {"method": "band", "seed": 0, "masked": True, "error_um": np.float32(12.3456789), "note": ""},
    {"method": "1, \"2\"\n", "seed": 1, "masked": False, "error_um": math.nan, "note": "slow"},
    {"method": "sgbm", "seed": np.int64(2), "masked": np.bool_(True), "error_um": None, "extra_px": 3},
]  # fmt: skip


def test_a_table_comes_back(tmp_path):
    results.write("matching", ROWS, {"command": "python3 -m lib sweep", "seconds": np.float64(1.5)}, tmp_path)
    table = results.read("matching", tmp_path)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["matching.csv", "matching.json"]
    assert table.provenance == {"command": "python3 -m lib sweep", "seconds": 1.5, "times_recorded": 1}
    assert list(table.columns) == ["method", "seed", "masked", "error_um", "note", "extra_px"]
    assert table.columns["method"] == ["band", '1, "2"\n', "sgbm"] and table.columns["note"] == ["", "slow", ""]
    assert table.columns["seed"].dtype.kind == "i" and table.columns["masked"].dtype == bool
    np.testing.assert_array_equal(table.columns["error_um"], [12.3457, math.nan, math.nan])
    np.testing.assert_array_equal(table.columns["extra_px"], [math.nan, math.nan, 3.0])
    assert len(table.where(masked=True, seed=2)) == 1 and len(table.where(method="none")) == 0
    with pytest.raises(LookupError, match="sede: no such column; there are method, seed"):
        table.where(sede=0)
    results.write("matching", ROWS, {}, tmp_path)
    assert results.read("matching", tmp_path).provenance == {"times_recorded": 2}  # so often was a test set opened


def test_lists_are_texts_before_and_after_a_file(tmp_path):
    rows = [{"sizes": sizes, "error_um": 1.0} for sizes in ([1, 2], [3], None)]
    results.write("sizes", rows, {}, tmp_path)
    assert results.Table(rows).columns["sizes"] == ["[1, 2]", "[3]", ""] == results.read("sizes", tmp_path).columns["sizes"]


def test_a_mark_of_a_spreadsheet_is_no_part_of_a_name(tmp_path):
    (tmp_path / "saved.csv").write_text("seed,error_um\n0,1\n", encoding="utf-8-sig")
    assert results.read("saved", tmp_path).rows == [{"seed": 0, "error_um": 1}]


def test_what_is_missing_or_damaged(tmp_path):
    assert results.read("none", tmp_path) is None
    (tmp_path / "torn.csv").write_text("a,b\n1,2\n3")
    with pytest.raises(ValueError, match=r"torn\.csv: row 3 does not have 2 entries"):
        results.read("torn", tmp_path)
    (tmp_path / "torn.csv").write_text("a,b\n1,2\n")
    (tmp_path / "torn.json").write_text("{")
    with pytest.raises(ValueError, match=r"torn\.json: not JSON"):
        results.read("torn", tmp_path)


@pytest.mark.parametrize("needs", [lambda t: t.columns["depth_um"], lambda t: t.where(depth_um=1), lambda t: t.rows[9]])
def test_what_a_recorded_table_lacks_is_told_in_one_line(tmp_path, capsys, needs):
    results.write("matching", ROWS, {}, tmp_path)
    for name in ("matching", "never_swept"):
        with recorded_table(name, tmp_path) as table:
            needs(table)
        out = capsys.readouterr().out
        assert out.startswith(f"Left out: the recorded table {name} lacks ") and out.count("\n") == 1
    with recorded_table("matching", tmp_path) as table:
        assert len(table) == 3
