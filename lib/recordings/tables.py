"""TOML files and CSV tables whose errors name file and line, and the column names of landmark tables."""

import csv
import io
import math
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from lib.correspondences import LANDMARKS
from lib.files import write_text


def columns(axes: Sequence[str], landmarks: Sequence[str] = LANDMARKS) -> list[str]:
    """Column names, landmark by landmark.

    >>> columns(["x_mm"])
    ['base_x_mm', 'tip_1_x_mm', 'tip_2_x_mm']
    """
    return [f"{landmark}_{axis}" for landmark in landmarks for axis in axes]


def decoded(path: Path, *, utf_16: bool = False) -> str:
    """The text of a UTF-8 file; with `utf_16` also of a UTF-16 file that starts with a byte order mark."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; check its name.")
    data = path.read_bytes()
    try:
        return data.decode("utf-16" if utf_16 and data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise ValueError(f"{path}, line {line}: the text is not UTF-8. Save the file as CSV in UTF-8.") from None


def read_toml(path: Path) -> dict:
    """The content of a TOML file."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{path}: not valid TOML ({error}). Save it as UTF-8 text.") from None


def rows_of(path: Path, text: str, separator: str = ",") -> Iterator[tuple[str, list[str]]]:
    """Yield place ("FILE, line N") and stripped cells of header and rows, equally many in each; blank lines are skipped."""
    reader, n = csv.reader(io.StringIO(text, newline=""), delimiter=separator), 0
    try:
        for cells in reader:
            place, cells = f"{path}, line {reader.line_num}", [cell.strip() for cell in cells]
            if cells in ([], [""]):
                continue
            n = n or len(cells)
            if len(cells) != n:
                raise ValueError(f"{place}: {len(cells)} cells where the header has {n}. Check separator and decimal.")
            yield place, cells
    except csv.Error as error:
        raise ValueError(f"{path}, line {reader.line_num}: not CSV ({error}). Export the table again.") from None


def number(cell: str, place: str, column: str) -> float:
    """The finite number in a cell, NaN for an empty one."""
    value = math.inf
    with suppress(ValueError):
        value = float(cell) if cell else 0.0
    if not math.isfinite(value):
        cure = "Check the decimal mark; leave the cell of a missing value empty"
        raise ValueError(f"{place}, column {column}: {cell!r} is not a finite number. {cure}.")
    return value if cell else math.nan


def read_table(path: Path, names: Sequence[str], optional: Sequence[str] = (), n_frames: int | None = None) -> np.ndarray:
    """The columns `names`, then `optional`, of a CSV file as (rows, columns) float64; an empty cell is NaN.

    A file has all of the optional columns, or none of them and they are NaN.  With `n_frames` the first column must number
    the frames from 0.  Errors name file and line.  The text "nan" is an error, since a missing value is an empty cell.
    """
    text = decoded(path)
    rows = rows_of(path, text)
    header = next(rows, ("", []))[1]
    wanted = [*names, *optional] if set(header) & set(optional) else list(names)
    if other := next((name for sign, name in ((";", "semicolons"), ("\t", "tabs")) if sign in "".join(header)), ""):
        cure = "Save it with commas between cells and points in numbers"
        raise ValueError(f"{path}, line 1: {other} separate its cells. {cure}.")
    if header != wanted:
        missing, unknown = ([n for n in one if n not in other] for one, other in ((wanted, header), (header, wanted)))
        detail = [f"{what}: {', '.join(which)}" for what, which in (("missing", missing), ("unknown", unknown)) if which]
        found = "; ".join(detail) or "order or repetition"
        raise ValueError(f"{path}, line 1: wrong columns ({found}). Expected: {','.join(wanted)}.")
    found, body = np.empty((0, 0)), text.replace("\r\n", "\n").partition("\n")[2]
    if not any(letter in body for letter in "\rnN"):  # then only empty cells can be NaN
        with suppress(ValueError):  # the fast way; if it fails, the slow one names the line
            found = np.array([[float(cell or "nan") for cell in row.split(",")] for row in body.split("\n") if row], ndmin=2)
    if found.shape[1] != len(wanted) or np.isinf(found).any():
        found = [[number(cell, place, name) for cell, name in zip(cells, wanted, strict=True)] for place, cells in rows]
    table = np.full((len(found), len(names) + len(optional)), np.nan)
    table[:, : len(wanted)] = np.array(found, dtype=np.float64).reshape(len(found), len(wanted))
    if n_frames is not None and not np.array_equal(table[:, 0], np.arange(n_frames)):
        what = f"expected one row for each of the {n_frames} frames, 0 to {n_frames - 1}"
        raise ValueError(f"{path}: {what}; got {len(table)}.")
    return table


def refuse(path: Path, bad: np.ndarray, problem: str) -> None:
    """Raise a ValueError that names the line of the first row that is `bad` (m,), if there is one."""
    if bad.any():
        raise ValueError(f"{path}, line {int(bad.argmax()) + 2}: {problem}.")


def write_table(path: Path, names: Sequence[str], values: np.ndarray, decimals: Sequence[int]) -> None:
    """Write a table that `read_table` reads: NaN as an empty cell, and in each column its number of `decimals`."""
    rows = io.StringIO()
    np.savetxt(rows, np.reshape(values, (-1, len(names))), [f"%.{places}f" for places in decimals], delimiter=",")
    write_text(path, ",".join(names) + "\n" + rows.getvalue().replace("nan", ""))
