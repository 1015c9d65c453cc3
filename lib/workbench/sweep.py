"""``python3 -m lib sweep``: one notebook over a grid of parameters, several at a time, and a table of its metrics."""

from __future__ import annotations

import argparse
import csv
import hashlib
import io
import itertools
import json
import os
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tqdm import tqdm

from lib import paths
from lib.workbench import collection
from lib.workbench.execution import execute, kernel_environment
from lib.workbench.parameters import UsageError, choose_notebooks, declared_parameters, parse_parameters

__all__ = ["main", "sweep"]


def main(argv: Sequence[str]) -> int:
    """Parse the command line and sweep; 1 if a point of the grid failed, 2 for a misspelt command."""
    parser = argparse.ArgumentParser(
        prog="python3 -m lib sweep",
        description="Run one notebook over every combination of values; run again, it goes on where it was stopped.",
        epilog="example: python3 -m lib sweep 05 -p seed 0,1,2 -p sigma_u_px 0.5,1.0,2.0",
    )
    parser.add_argument("notebook", metavar="NOTEBOOK", help="path, name or number")
    parser.add_argument("-p", dest="pairs", nargs=2, action="append", default=[], metavar=("NAME", "VALUE,VALUE,..."))
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="notebooks at a time")
    parser.add_argument("--cell-timeout", type=float, metavar="S", help="longest time of one cell")
    parser.add_argument("--runs", type=Path, default=paths.RUNS, metavar="FOLDER")
    options = parser.parse_args(argv)
    try:
        table, failures = sweep(
            options.notebook,
            {name: values.split(",") for name, values in options.pairs},
            workers=options.workers,
            cell_timeout_s=options.cell_timeout,
            runs=options.runs,
        )
    except UsageError as error:
        print(f"python3 -m lib sweep: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nStopped; run again to go on.")
        return 130
    for point, failure in failures.items():
        print(f"FAILED {point}: {failure}", file=sys.stderr)
    print(f"Table: {table}")
    return 1 if failures else 0


def sweep(
    name: str,
    grid: dict[str, list[str]],
    *,
    workers: int = 1,
    cell_timeout_s: float | None = None,
    runs: Path = paths.RUNS,
    notebooks: Path = paths.NOTEBOOKS,
) -> tuple[Path, dict[str, str]]:
    """Execute a notebook at every point of a grid, `workers` at a time.

    Points that a former sweep of the same notebook finished are taken over; failed ones are tried again.

    Parameters
    ----------
    grid:
        Values as texts for each parameter.

    Returns
    -------
    tuple
        ``results.csv`` (a row a point: its parameters, then the metrics), and what failed at which point.

    Raises
    ------
    UsageError
        For an unknown notebook or parameter, a value of the wrong type, or an empty grid.
    """
    chosen = choose_notebooks([name], notebooks)
    if len(chosen) != 1 or not grid or not all(grid.values()):
        raise UsageError("a sweep takes one notebook and at least one parameter: -p NAME VALUE,VALUE,...")
    book = chosen[0]
    points = [dict(zip(grid, values, strict=True)) for values in itertools.product(*grid.values())]
    given = [parse_parameters(list(point.items()), [book])[book] for point in points]
    if "profile" in declared_parameters(book):
        for values in given:
            values.setdefault("profile", "quick")
    version = hashlib.sha256(book.read_bytes()).hexdigest()[:8]  # an edited notebook starts a sweep of its own
    folder = runs / "sweeps" / f"{book.stem}-{version}"
    folder.mkdir(parents=True, exist_ok=True)
    kernel_environment(cpu_threads=max(1, (os.cpu_count() or 1) // workers))
    failures: dict[str, str] = {}
    rows: dict[int, dict] = {}
    guard = threading.Lock()

    def work(number: int) -> None:
        label = ",".join(f"{key}={value}" for key, value in points[number].items())
        stem = hashlib.sha256(json.dumps(given[number], sort_keys=True, default=str).encode()).hexdigest()[:12]
        executed = folder / f"{stem}.ipynb"
        if not executed.exists():
            partial = folder / f"{stem}.{os.getpid()}.partial.ipynb"
            failure = execute(book, partial, given[number], cell_timeout_s=cell_timeout_s)
            if failure:
                with guard:
                    failures[label] = f"{failure} ({partial.name})"
                return
            os.replace(partial, executed)
        metrics = {metric["name"]: metric["value"] for metric in collection.metrics_of(executed)}
        with guard:
            rows[number] = {**points[number], **metrics, "notebook": executed.name}
            _write_table(folder / "results.csv", [rows[key] for key in sorted(rows)])

    pool = ThreadPoolExecutor(workers)  # each notebook has a process of its own: its kernel
    try:
        list(tqdm(pool.map(work, range(len(points))), total=len(points), desc=book.stem, unit="run"))
    finally:
        pool.shutdown(cancel_futures=True)
    return folder / "results.csv", failures


def _write_table(path: Path, rows: list[dict]) -> None:
    columns = list(dict.fromkeys(key for row in rows for key in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text.getvalue(), encoding="utf-8")
    os.replace(partial, path)
