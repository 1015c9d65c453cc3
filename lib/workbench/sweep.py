"""``python3 -m lib sweep``: runs one notebook over a grid of parameters, on Dask; makes a table, and a plot of each metric.

Each point of the grid is one run of the notebook, and each run is one row of the table.
"""

import argparse
import contextvars
import itertools
import json
import re
import shlex
import shutil
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import nbformat
import numpy as np
from matplotlib.figure import Figure

from lib import files, paths
from lib.parallel import run_jobs
from lib.provenance import Provenance, machine
from lib.workbench import execution, results


def main(argv: Sequence[str]) -> int:
    """Parse the command line and sweep; 1 if a run failed."""
    parser = argparse.ArgumentParser(
        "python3 -m lib sweep",
        description="Run one notebook at every point of a grid of parameters and make a table of its metrics.",
        epilog=(Path(__file__).with_name("templates") / "sweep.txt").read_text(encoding="utf-8"),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("name", metavar="NOTEBOOK", help="path, name or number, such as studies/NAME or 05")
    add("-p", dest="grid", nargs=2, action="append", default=[], metavar=("NAME", "VALUE,VALUE,..."),
        help="a parameter and its values (default: the grid in the comments of the parameters)")  # fmt: skip
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--workers", type=int, metavar="N", help="parallel runs on this machine (default: one per core)")
    where.add_argument("--scheduler", metavar="ADDRESS", help="a running Dask scheduler, such as tcp://10.0.0.1:8786")
    add("--record", action="store_true", help="also write data/results/NOTEBOOK.csv and .json")
    add("--cell-timeout", dest="cell_timeout_s", type=execution.positive, metavar="S", help="longest time of one cell")
    add("--runs", type=Path, default=paths.RUNS, metavar="FOLDER", help="folder for sweeps/")
    options = parser.parse_args(argv)
    if options.workers is not None and options.workers < 1:
        parser.error("--workers: at least 1.")
    options.grid = {name: execution.split_values(values) for name, values in options.grid}
    table, failures = sweep(**vars(options))
    for point, failure in failures.items():
        print(f"FAILED {point or 'the run'}: {failure}", file=sys.stderr)
    print(f"Table: {paths.shown(table)}")
    return 1 if failures else 0


def sweep(
    name: str, grid: dict[str, list[str]] | None = None, *, workers: int | None = None, scheduler: str | None = None,
    record: bool = False, cell_timeout_s: float | None = None, runs: Path = paths.RUNS,
    notebooks: Path = paths.NOTEBOOKS, recorded: Path = paths.RESULTS,
) -> tuple[Path, dict[str, str]]:  # fmt: skip
    """Execute a notebook at every point of a grid; earlier runs of the same notebook and code are kept.

    Args:
        grid: Values as texts for each parameter; None is the grid that the notebook declares.
        workers, scheduler: As in `lib.parallel.run_jobs`.
        record: Also write the table to the folder `recorded`, if no run failed and each stated a number.

    Returns the path of ``results.csv`` (each row: a run's parameters, then its metrics), and the failure at each point.
    """
    book, *more = execution.choose_notebooks([name], notebooks)
    grid = grid or execution.declared_grid(book)
    if more or not all(grid.values()):
        raise ValueError("a sweep takes one notebook, and values for each parameter: -p NAME VALUE,VALUE,...")
    parse = execution.parse_parameters
    profile = parse([], [book])[book]
    parsed = {key: [parse([(key, text)], [book])[book][key] for text in texts] for key, texts in grid.items()}
    folder = runs.resolve() / "sweeps" / f"{book.stem}-{_code_digest(book)}"
    folder.mkdir(parents=True, exist_ok=True)
    words = ["sweep", name, *itertools.chain(*(("-p", key, ",".join(values)) for key, values in grid.items()))]
    provenance = Provenance(shlex.join(["python3", "-m", "lib", *words]))
    points = [dict(zip(parsed, values, strict=True)) for values in itertools.product(*parsed.values())]
    digests = [files.digest(json.dumps(point, sort_keys=True, default=str).encode()) for point in points]
    of_file = {folder / f"{digest}.ipynb": point for digest, point in zip(digests, points, strict=True)}
    jobs = {executed: (book, profile | point, cell_timeout_s) for executed, point in of_file.items()}
    rows = {executed: _row(executed, point) for executed, point in of_file.items() if executed.exists()}
    for executed in [executed for executed, row in rows.items() if row == of_file[executed]]:
        del rows[executed]
        executed.unlink()  # it stated no number and runs again, since missing data may be available now
    failures: dict[str, str] = {}
    table = folder / "results.csv"
    for executed, error in run_jobs(run_point, jobs, workers=workers, scheduler=scheduler, title=book.stem, unit="run"):
        point = of_file[executed]
        if error:
            log, why = executed.with_suffix(".log"), str(error).partition("\n")[0]
            files.write_text(log, f"{book.name} with {_label(jobs[executed][1])}\n{error}\n")
            failures[_label(point)] = f"{why} (log: {paths.shown(log)})"
            continue
        rows[executed] = _row(executed, point)
        files.write_text(table, results.csv_text(rows[path] for path in of_file if path in rows))
    in_order = [rows[path] for path in of_file if path in rows]
    files.write_text(table, results.csv_text(in_order))
    save_plots(in_order, list(grid), folder)
    blank = {_label(point): "it stated no number, so nothing is recorded" for point in of_file.values() if point in in_order}
    failures |= blank if record else {}
    if record and not failures:
        results.write(book.stem, in_order, provenance.so_far() | _cost(rows), recorded)
    return table, failures


def save_plots(rows: Sequence[dict], parameters: Sequence[str], folder: Path) -> None:
    """Write ``METRIC.png`` for each column of numbers that is not a parameter.

    The horizontal axis is the first parameter with several values.  There is a line for each combination of the others
    except `seed`.  It joins the medians over the remaining runs, such as seeds; dots are single runs.
    """
    varied = [name for name in parameters if len({str(row[name]) for row in rows}) > 1]
    axis = next((name for name in varied if name != "seed"), "seed" if "seed" in varied else None)
    if axis is None:
        return
    lines = [name for name in varied if name not in (axis, "seed")]
    for metric, values in results.Table(list(rows)).columns.items():
        if metric in parameters or isinstance(values, list) or not np.isfinite(values).any():
            continue
        figure = Figure(figsize=(6.4, 4.0), layout="constrained")
        ax = figure.subplots()
        groups: dict[str, dict] = {}
        for row, value in zip(rows, values, strict=True):
            label = ", ".join(f"{name} = {row[name]}" for name in lines)
            x = row[axis] if isinstance(row[axis], int | float) else str(row[axis])
            groups.setdefault(label, {}).setdefault(x, []).append(value)
        for label, points in groups.items():
            (line,) = ax.plot(points.keys(), [np.nanmedian(v) if np.isfinite(v).any() else np.nan for v in points.values()],
                              "-", label=label)  # fmt: skip
            ax.plot([x for x, v in points.items() for _ in v], [y for v in points.values() for y in v], ".",
                    color=line.get_color())  # fmt: skip
        ax.set(xlabel=axis, ylabel=metric)
        if lines:
            ax.legend(fontsize="small")
        with files.whole(folder / f"{metric}.png") as partial:
            figure.savefig(partial, dpi=150)


def run_point(executed: Path, book: Path, values: dict, cell_timeout_s: float | None) -> None:
    """Run the notebook in a worker, into `executed`; a failure leaves the notebook beside it and raises a RuntimeError."""
    log, failed = executed.with_suffix(".log"), executed.with_suffix(".failed.ipynb")
    with files.whole(executed) as partial:
        # In a separate context, since Jupyter keeps its event loop there and two threads cannot run the same one.
        failure = contextvars.Context().run(execution.execute, book, partial, values, cell_timeout_s=cell_timeout_s)
        if failure:
            text = [str(failure)]
            if partial.exists():
                shutil.copy(partial, failed)
                outputs = [out for cell in nbformat.read(failed, as_version=4).cells for out in cell.get("outputs", [])]
                text += [output.get("text") or "\n".join(output.get("traceback", [])) for output in outputs]
            raise RuntimeError("\n".join(text))
        notebook = nbformat.read(partial, as_version=4)
        notebook.metadata["microstereo"] = {"machine": machine()}
        nbformat.write(notebook, partial)
    for left in (log, failed, *executed.parent.glob(f"{executed.stem}.*.partial.ipynb")):  # of earlier attempts
        left.unlink(missing_ok=True)


def column_name(metric: str, unit: str) -> str:
    """The column of a metric: its name, with its unit at the end.

    >>> column_name("depth_error", "um"), column_name("depth_error_um", "um"), column_name("pck_0.05", "%")
    ('depth_error_um', 'depth_error_um', 'pck_0.05_percent')
    """
    word = re.sub(r"[^A-Za-z0-9]+", "_", unit.replace("%", "percent").replace("/", "_per_").replace("^", ""))
    return metric if not word or metric.endswith(f"_{word}") else f"{metric}_{word.strip('_')}"


def _row(executed: Path, point: dict) -> dict:
    return point | {column_name(m["name"], m["unit"]): m["value"] for m in execution.stated_in(executed).metrics}


def _cost(executed: Iterable[Path]) -> dict:
    """The time that all runs of a table took, including those of earlier calls, and the machines that ran them."""
    kept = [nbformat.read(path, as_version=4).metadata for path in executed]
    machines = {json.dumps(metadata.microstereo.machine): metadata.microstereo.machine for metadata in kept}
    where = machines.popitem()[1] if len(machines) == 1 else list(machines.values())
    seconds = sum(metadata.papermill.duration for metadata in kept)
    return {"machine": where, "runs": len(kept), "seconds": seconds, "cpu_seconds": None}


def _code_digest(book: Path) -> str:
    """Digest of all that determines the rows: the notebook, the helpers of all notebooks, lib and the weights that ship."""
    own = (file for file in (paths.ROOT / "lib").rglob("*") if file.is_file() and file.suffix != ".pyc")
    code = {*book.parent.glob("*.py"), *paths.NOTEBOOKS.rglob("*.py"), *paths.MODELS.glob("*.safetensors"), *own}
    return files.digest(book, *sorted(code), length=8)


def _label(point: dict) -> str:
    return ", ".join(f"{key}={value}" for key, value in point.items())
