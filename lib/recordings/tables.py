"""Numeric CSV tables whose errors name file and line, and the column names of landmark tables."""

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lib.correspondences import LANDMARKS
from lib.files import write_text

__all__ = ["columns", "read_table", "write_table"]


def columns(axes: Sequence[str], landmarks: Sequence[str] = LANDMARKS) -> list[str]:
    """Column names, landmark by landmark.

    >>> columns(["x_mm"])
    ['base_x_mm', 'tip_1_x_mm', 'tip_2_x_mm']
    """
    return [f"{landmark}_{axis}" for landmark in landmarks for axis in axes]


def read_table(path: Path, names: Sequence[str], optional: Sequence[str] = (), n_frames: int | None = None) -> np.ndarray:
    """The columns `names`, then `optional`, of a CSV file as (rows, columns) float64; an empty cell is NaN.

    A file has all of the optional columns or none of them; then they are NaN.  With `n_frames` the first column must
    number the frames from 0.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: For text that is not UTF-8; a missing, unknown or repeated column; a short, long or missing row; a
            cell that is not a finite number ("nan" included: a missing value is an empty cell).  Names file and line.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file.")
    data = path.read_bytes()
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise ValueError(f"{path}, line {line}: the text is not UTF-8. Save the file as CSV in UTF-8.") from None
    reader, rows = csv.reader(io.StringIO(text, newline="")), []
    try:
        header = [cell.strip() for cell in next(reader, [])]
        wanted = [*names, *optional] if set(header) & set(optional) else list(names)
        if header != wanted:
            missing = [name for name in wanted if name not in header]
            unknown = [name for name in header if name not in wanted]
            detail = [f"{what}: {', '.join(which)}" for what, which in (("missing", missing), ("unknown", unknown)) if which]
            found = "; ".join(detail) or "order or repetition"
            raise ValueError(f"{path}, line 1: wrong columns ({found}). Expected: {','.join(wanted)}.")
        for row in filter(None, reader):
            if len(row) != len(wanted):
                raise ValueError(f"{path}, line {reader.line_num}: {len(row)} cells where the header has {len(wanted)}.")
            rows.append([_number(cell, path, reader.line_num, name) for cell, name in zip(row, wanted, strict=True)])
    except csv.Error as error:
        raise ValueError(f"{path}, line {reader.line_num}: not CSV ({error}). Export the table again.") from None
    table = np.full((len(rows), len(names) + len(optional)), np.nan)
    table[:, : len(wanted)] = np.array(rows, dtype=np.float64).reshape(len(rows), len(wanted))
    if n_frames is not None and not np.array_equal(table[:, 0], np.arange(n_frames)):
        what = f"expected one row for each of the {n_frames} frames, 0 to {n_frames - 1}"
        raise ValueError(f"{path}: {what}; got {len(table)}.")
    return table


def _number(cell: str, path: Path, line: int, name: str) -> float:
    text = cell.strip()
    try:
        value = float(text) if text else math.nan
    except ValueError:
        value = math.inf
    if text and not math.isfinite(value):
        place = f"{path}, line {line}, column {name}"
        raise ValueError(f"{place}: {text!r} is not a finite number. Leave the cell of a missing value empty.")
    return value


def write_table(path: Path, names: Sequence[str], values: np.ndarray, decimals: Sequence[int]) -> None:
    """Write what `read_table` reads: NaN as an empty cell, `decimals` places in each column."""
    lines = [",".join(names)]
    for row in np.asarray(values, dtype=np.float64):
        cells = ("" if math.isnan(v) else f"{v:.{places}f}" for v, places in zip(row, decimals, strict=True))
        lines.append(",".join(cells))
    write_text(path, "\n".join(lines) + "\n")
