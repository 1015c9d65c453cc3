"""Recorded results: tables that ship in ``data/results``, made by studies and read by notebooks.

A table is ``NAME.csv`` (one row for each run; columns are named with their units) and its provenance, ``NAME.json``.
"""

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np

from lib import files, paths
from lib.provenance import plain


@dataclass(frozen=True)
class Table:
    """Rows with the same named columns, and their provenance.

    Attributes:
        rows: One dict for each row: numbers, truth values, texts; NaN where a number is missing.
        provenance: Command, commit, machine and date of the runs; empty if unknown.

    >>> table = Table([{"noise_px": 0.5, "error_um": 12.0}, {"noise_px": 1.0, "error_um": 24.0}])
    >>> table.columns["error_um"]
    array([12., 24.])
    >>> table.where(noise_px=1.0).rows
    [{'noise_px': 1.0, 'error_um': 24.0}]
    """

    rows: list[dict]
    provenance: dict = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.rows)

    @cached_property
    def columns(self) -> dict[str, np.ndarray | list[str]]:
        """Name -> array of numbers or truth values (n,), or list of n texts (also of lists); NaN or "" without an entry."""
        found: dict[str, np.ndarray | list[str]] = {}
        for name in dict.fromkeys(key for row in self.rows for key in row):
            values = [row.get(name) for row in self.rows]
            if any(isinstance(value, str | list) and value for value in values):
                found[name] = ["" if value is None or value != value else str(value) for value in values]
            else:
                found[name] = np.array([math.nan if value in (None, "") else value for value in values])
        return found

    def where(self, **equal: object) -> Self:
        """The rows whose entries equal those given, such as ``table.where(method="band", seed=0)``."""
        if unknown := [name for name in equal if name not in self.columns]:
            raise LookupError(f"{unknown[0]}: no such column; there are {', '.join(self.columns)}.")
        rows = [row for row in self.rows if all(row.get(name) == value for name, value in equal.items())]
        return Table(rows, self.provenance)


def read(name: str, folder: Path = paths.RESULTS) -> Table | None:
    """The recorded table `name`; None if there is none, a ValueError that names the file if one is damaged."""
    table, origin = folder / f"{name}.csv", folder / f"{name}.json"
    if not table.is_file():
        return None
    try:
        provenance = json.loads(origin.read_text(encoding="utf-8")) if origin.is_file() else {}
    except ValueError as error:
        raise ValueError(f"{origin}: not JSON ({error}); restore it.") from error
    with table.open(encoding="utf-8-sig", newline="") as stream:  # a spreadsheet may have put a mark at the start
        names, *rows = [row for row in csv.reader(stream, strict=True) if row] or [[]]
    if odd := [number for number, row in enumerate(rows, start=2) if len(row) != len(names)]:
        raise ValueError(f"{table}: row {odd[0]} does not have {len(names)} entries; restore it.")
    columns = [_typed(column) for column in zip(*rows, strict=True)]
    return Table([dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)], provenance)


def write(name: str, rows: Iterable[Mapping], provenance: Mapping, folder: Path = paths.RESULTS) -> None:
    """Write the table `name`: one mapping for each row (None and NaN become empty entries, numbers keep six digits).

    `provenance` is that of `Provenance.so_far`.  The record adds how often it was made, and so its test set was used.
    """
    folder.mkdir(parents=True, exist_ok=True)
    before = read(name, folder)
    times = 1 if before is None else before.provenance.get("times_recorded", 1) + 1
    files.write_text(folder / f"{name}.csv", csv_text(rows))
    files.write_json(folder / f"{name}.json", plain({**provenance, "times_recorded": times}))


def csv_text(rows: Iterable[Mapping]) -> str:
    """Rows as CSV; the columns are in the order in which they first appear.

    >>> print(csv_text([{"seed": 0, "error_um": 1 / 3}, {"seed": 1, "error_um": None}]), end="")
    seed,error_um
    0,0.333333
    1,
    """
    # As `plain` does it, but infinity stays, since CSV can represent it.
    rows = [{k: v if isinstance(v, float) and math.isinf(v) else plain(v) for k, v in row.items()} for row in rows]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(key for row in rows for key in row)), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _typed(texts: Sequence[str]) -> list:
    """Convert a column to the narrowest type that fits all its entries; an empty entry among numbers becomes NaN."""
    for kind in ({"True": True, "False": False}.__getitem__, int, lambda text: float(text or math.nan)):
        with suppress(KeyError, ValueError):
            return [kind(text) for text in texts]
    return list(texts)
