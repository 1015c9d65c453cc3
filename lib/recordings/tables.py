"""Numeric CSV tables with errors that name file and line, and the column names of the landmark tables."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

__all__ = ["LANDMARKS", "columns", "read_table", "write_table", "write_text"]

#: The tool's landmarks, in the order of every array.
LANDMARKS = ("base", "tip_1", "tip_2")


def columns(axes: Sequence[str]) -> list[str]:
    """Column names landmark by landmark: ``columns(["x_mm"])`` is ``["base_x_mm", "tip_1_x_mm", "tip_2_x_mm"]``."""
    return [f"{landmark}_{axis}" for landmark in LANDMARKS for axis in axes]


def read_table(path: Path, names: Sequence[str], optional: Sequence[str] = ()) -> np.ndarray:
    """The columns `names`, then `optional`, of a CSV file as (rows, columns) float64; an empty cell is NaN.

    A file has all of the optional columns or none; then they are NaN.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        For a missing, unknown or repeated column, a short or long row, or a cell that is not a finite number
        ("nan" included: a missing value is an empty cell).  The text names file and line.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file.")
    with path.open(encoding="utf-8-sig", newline="") as stream:
        reader = csv.reader(stream)
        header = [cell.strip() for cell in next(reader, [])]
        wanted = [*names, *optional] if set(header) & set(optional) else list(names)
        if header != wanted:
            missing = [name for name in wanted if name not in header]
            unknown = [name for name in header if name not in wanted]
            detail = "; ".join(
                f"{what}: {', '.join(which)}" for what, which in (("missing", missing), ("unknown", unknown)) if which
            )
            raise ValueError(
                f"{path}, line 1: wrong columns ({detail or 'order or repetition'}). Expected: {','.join(wanted)}."
            )
        rows = []
        for row in reader:
            line = reader.line_num
            if not row:
                continue
            if len(row) != len(wanted):
                raise ValueError(f"{path}, line {line}: {len(row)} cells where the header has {len(wanted)}.")
            rows.append([_number(cell, path, line, name) for cell, name in zip(row, wanted, strict=True)])
    table = np.full((len(rows), len(names) + len(optional)), np.nan)
    table[:, : len(wanted)] = np.array(rows, dtype=np.float64).reshape(len(rows), len(wanted))
    return table


def _number(cell: str, path: Path, line: int, name: str) -> float:
    text = cell.strip()
    if not text:
        return math.nan
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(
            f"{path}, line {line}, column {name}: {text!r} is not a finite number. Leave the cell empty where a "
            "value is missing."
        )
    return value


def write_table(path: Path, names: Sequence[str], values: np.ndarray, decimals: Sequence[int]) -> None:
    """Write what `read_table` reads: NaN as an empty cell, `decimals` places per column."""
    lines = [",".join(names)]
    for row in np.asarray(values, dtype=np.float64):
        cells = ("" if math.isnan(v) else f"{v:.{places}f}" for v, places in zip(row, decimals, strict=True))
        lines.append(",".join(cells))
    write_text(path, "\n".join(lines) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, path)
