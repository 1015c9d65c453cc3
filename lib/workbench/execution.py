"""Chooses notebooks, checks their parameters before anything runs, executes them, and reads back what they stated."""

import argparse
import ast
import base64
import logging
import math
import os
import platform
import re
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import distributions
from pathlib import Path
from threading import Lock, Semaphore
from typing import NamedTuple

import nbformat
from nbclient.exceptions import CellTimeoutError, DeadKernelError
from traitlets.config import Config

from lib import paths
from lib.workbench.report import FIGURE_METADATA, METRIC_MIME, STOP_METADATA, VERDICT_COLOURS, VERDICT_MIME

#: Packages whose version can change a number.
_PACKAGES = ("numpy", "scipy", "torch", "kornia", "opencv-python-headless", "open3d-cpu", "open3d", "cvxpy", "clarabel")
#: End of the comment of a study's parameter: ``; grid: 75, 300, 1500``.
_GRID = re.compile(r";\s*grid:(.*)$")
#: A comma outside brackets.
_COMMA = re.compile(r",(?![^\[({]*[\])}])")
#: Tag of a cell during which no other notebook of the run may compute: it measures time, or trains for a limited time.
ALONE = "alone"
_LONGEST_PATH = 80  # of a folder with sockets, whose paths may have 103 characters
_NO_START = "Kernel died before replying"  # in the error of a kernel that ended before its first cell
#: Environment variables for the kernels.
_KERNEL_ENVIRONMENT = {
    "MICROSTEREO_PAGE": "1",  # controls must work in a page, without a kernel
    "JUPYTER_PREFER_ENV_PATH": "1",  # use this environment's kernel, not another one named python3
    "OPEN3D_DISABLE_WEB_VISUALIZER": "true",  # it hangs without a display
    "PYDEVD_DISABLE_FILE_VALIDATION": "1",  # suppresses a warning of the debugger on every start
}


def choose_notebooks(names: Sequence[str] = (), folder: Path = paths.NOTEBOOKS) -> list[Path]:
    """The named notebooks in the order of the paper; all of them if no name is given.

    A name is a path, a file's name, its stem, or the leading number (``03``); studies are found by their stem too.  An
    unknown name is a ValueError that lists the notebooks.
    """
    shipped = sorted(folder.glob("[0-9]*.ipynb"))
    if not names:
        return shipped
    studies = sorted(folder.glob("studies/*.ipynb"))
    chosen = []
    for name in names:
        path = Path(name)
        fits = [path.resolve()] if path.suffix == ".ipynb" and path.is_file() else []
        fits = fits or [book for book in shipped if name in (book.name, book.stem, book.stem.split("_")[0])]
        fits = fits or [book for book in studies if path.with_suffix("") in (Path(book.stem), Path("studies", book.stem))]
        if not fits:
            there = [book.stem for book in shipped] + [f"studies/{book.stem}" for book in studies]
            raise ValueError(f"unknown notebook: {name}. There are: {', '.join(there)}.")
        chosen += [book for book in fits if book not in chosen]
    if twice := [str(one) for one in chosen if [book.stem for book in chosen].count(one.stem) > 1]:
        raise ValueError(f"{' and '.join(twice)}: a run has one page for each name; run them apart, or rename one.")
    return sorted(chosen, key=lambda book: book.name)


def declared_parameters(notebook: Path) -> dict[str, str]:
    """Names and types ("int", "str", ...; "" if not declared) of the parameters in the cell tagged ``parameters``."""
    return {name: (entry["inferred_type_name"] or "").replace("None", "") for name, entry in _inspect(notebook).items()}


def declared_grid(notebook: Path) -> dict[str, list[str]]:
    """The values that a sweep tries, as texts.  Comments of the parameters list them after ``; grid:``."""
    found = {name: _GRID.search(entry["help"] or "") for name, entry in _inspect(notebook).items()}
    return {name: split_values(grid[1]) for name, grid in found.items() if grid}


def split_values(text: str) -> list[str]:
    """The values of ``75, 300`` or ``[1, 2], [3]``, as texts.

    >>> split_values("[1, 2], band")
    ['[1, 2]', 'band']
    """
    return [value.strip() for value in _COMMA.split(text) if value.strip()]


def parse_parameters(pairs: Sequence[tuple[str, str]], notebooks: Sequence[Path], profile: str = "quick") -> dict[Path, dict]:
    """The parameters of each notebook: those of the pairs that it declares, and the profile, converted to the declared type.

    Raises a ValueError if no chosen notebook declares a name, or if a text does not fit the declared type.
    """
    declared = {notebook: declared_parameters(notebook) for notebook in notebooks}
    known = {name for names in declared.values() for name in names}
    if unknown := [name for name, _ in pairs if name not in known]:
        elsewhere = ", ".join(book.stem for book in choose_notebooks() if unknown[0] in declared_parameters(book))
        hint = f" Only other notebooks declare it: {elsewhere}." if elsewhere else ""
        raise ValueError(f"unknown parameter: {unknown[0]}.{hint} Declared are: {', '.join(sorted(known)) or 'none'}.")
    if below := [text for name, text in pairs if name == "seed" and text.strip().startswith("-")]:
        raise ValueError(f"parameter seed: {below[0]} is below 0.")
    given = [("profile", profile), *pairs]
    return {book: {n: _value(n, text, names[n]) for n, text in given if n in names} for book, names in declared.items()}


def positive(text: str) -> float:
    """Parse seconds on a command line; an `argparse.ArgumentTypeError` for anything but a finite number above 0."""
    with suppress(ValueError):
        if 0 < float(text) < math.inf:
            return float(text)
    raise argparse.ArgumentTypeError(f"{text} is not a number of seconds above 0.")


def title_of(notebook: Path) -> str:
    """The first heading of the notebook, or its stem."""
    prose = (cell.source for cell in nbformat.read(notebook, as_version=4).cells if cell.cell_type == "markdown")
    heading = re.search(r"^#[# ]*(.*)", "\n".join(prose), re.MULTILINE)
    return heading[1].strip() if heading else notebook.stem


def _value(name: str, text: str, kind: str) -> object:
    """Convert `text` to the declared type; without one, to a Python literal if it is one, else leave it as text."""
    kind = kind.split("|")[0].strip().split("[")[0]
    words = {"true": True, "false": False, "1": True, "0": False}
    simple = {"str": str, "int": int, "float": float, "bool": lambda text: words[text.lower()]}
    try:
        value = simple.get(kind, ast.literal_eval)(text)
        if kind in ("list", "tuple", "dict", "set") and type(value).__name__ != kind:
            raise ValueError(f"a {type(value).__name__}")
        return list(value) if isinstance(value, tuple | set) else value  # papermill passes these as text
    except (ValueError, KeyError, SyntaxError):
        if kind in (*simple, "list", "tuple", "dict", "set"):
            example = {"list": ", such as [1, 2]", "tuple": ", such as (1, 2)"}.get(kind, "")
            raise ValueError(f"parameter {name}: {text!r} is not of type {kind}{example}.") from None
        return {"true": True, "false": False, "none": None}.get(text.lower(), text)


def _inspect(notebook: Path) -> dict[str, dict]:
    import papermill

    logging.getLogger("papermill").setLevel(logging.ERROR)  # no warnings about notebooks without a parameters cell
    try:
        return papermill.inspect_notebook(str(notebook))
    except (OSError, ValueError, TypeError, AttributeError, nbformat.ValidationError) as error:  # the first for other JSON
        raise ValueError(f"{notebook}: not a notebook ({error}).") from None


class Failure(NamedTuple):
    """Why a notebook did not complete; `cell` counts its cells from 1."""

    kind: str  # "error", "timeout" or "dead kernel"
    cell: int | None
    message: str

    def __str__(self) -> str:
        return f"{self.kind}{f' in cell {self.cell}' if self.cell else ''}: {self.message}"


class Places:
    """Places for the notebooks that run at once: each holds one of them, or all during a cell that is tagged `ALONE`."""

    def __init__(self, number: int):
        self.number, self.closed = number, False
        self._free, self._queue = Semaphore(number), Lock()

    @contextmanager
    def taken(self) -> Iterator[Callable[[nbformat.NotebookNode], None]]:
        """Hold a place during the block, and yield a function that waits for the turn of a code cell.

        Call it before each code cell.  It raises a RuntimeError once the places are `closed`.
        """
        held = 0

        def hold(number: int) -> None:
            nonlocal held
            if held:
                self._free.release(held)
            with self._queue:  # whoever waits for all places is not overtaken
                for _ in range(number):
                    self._free.acquire()
            held = number

        def begin(cell: nbformat.NotebookNode) -> None:
            hold(self.number if ALONE in cell.metadata.get("tags", []) else 1)
            if self.closed:
                raise RuntimeError("the run was stopped")

        try:
            hold(1)
            yield begin
        finally:
            hold(0)


def end_kernels() -> None:
    """Kill the kernels that this process has started; a notebook that runs in one of them then fails."""
    import psutil

    for process in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):  # it has ended
            if "ipykernel_launcher" in process.cmdline():
                process.kill()


def execute(
    notebook: Path, output: Path, parameters: dict, *, cell_timeout_s: float | None = None, label: str = "",
    begin: Callable[[nbformat.NotebookNode], None] = lambda cell: None,
) -> Failure | None:  # fmt: skip
    """Execute `notebook` into `output`, which is written after each cell; returns None if every cell completed.

    With a `label` a terminal shows the number of cells that are done.  `begin` is called before each code cell.
    """
    import papermill
    from papermill.exceptions import PapermillExecutionError, strip_color

    running = 0

    def on_cell_start(cell, cell_index):
        nonlocal running
        running += "injected-parameters" not in cell.metadata.get("tags", [])  # papermill's own does not count
        if cell.cell_type == "code":
            begin(cell)

    def attempt() -> Failure | None:
        try:
            papermill.execute_notebook(
                str(notebook), str(output), parameters, kernel_name="python3", execution_timeout=cell_timeout_s,
                progress_bar={"desc": label, "leave": False, "disable": not (label and sys.stderr.isatty())},
                start_timeout=600,  # a kernel may start slowly on a busy machine
                on_cell_start=on_cell_start,  # this and the next are passed to nbclient
                extra_arguments=["--IPKernelApp.log_level=50"],  # suppresses a warning of unencrypted TCP on every start
                config=_sockets(folder),
            )  # fmt: skip
        except PapermillExecutionError as error:  # `report.stop` does not raise it
            return Failure("error", running, f"{error.ename}: {strip_color(error.evalue)}")
        except CellTimeoutError:
            return Failure("timeout", running, f"the cell took longer than {cell_timeout_s:g} s (--cell-timeout).")
        except DeadKernelError:
            return Failure("dead kernel", running, "the kernel died; the machine may have run out of memory.")
        except (nbformat.ValidationError, OSError, ValueError, RuntimeError) as error:
            return Failure("error", running or None, f"{type(error).__name__}: {error}")
        return None

    os.environ.pop("JUPYTER_PATH", None)
    os.environ.update(_KERNEL_ENVIRONMENT)
    logging.getLogger("papermill").setLevel(logging.CRITICAL)  # the returned failure contains its messages
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        failure = attempt()
        # Of kernels that start at once, one may find its ports taken by another.
        return attempt() if failure and not running and _NO_START in failure.message else failure


def _sockets(folder: str) -> Config:
    """Configuration of a kernel that is reached by files in a folder instead of ports, where the system can."""
    if os.name != "posix" or len(folder) > _LONGEST_PATH:
        return Config()
    return Config(KernelManager={"transport": "ipc", "connection_file": f"{folder}/kernel.json"})


class Stated(NamedTuple):
    """What an executed notebook stated.  If it stated a name several times, the last counts, in the place of the first."""

    metrics: list[dict]  # each with its `cell`
    figures: list[tuple[dict, str, bytes]]  # name and caption, ".svg" or ".png", the file's content
    verdict: dict | None  # its verdicts, `joined`
    left_out: str | None  # why `report.stop` ended it before its last cell


def stated_in(executed: Path) -> Stated:
    """Read what `lib.workbench.report` wrote into an executed notebook."""
    metrics, figures, verdicts, left_out = {}, {}, [], None
    for cell in nbformat.read(executed, as_version=4).cells:
        for output in cell.get("outputs", []):
            data, metadata = output.get("data", {}), output.get("metadata", {})
            verdicts.append(data.get(VERDICT_MIME))
            left_out = left_out or metadata.get(STOP_METADATA)
            if metric := data.get(METRIC_MIME):
                metrics[metric["name"]] = dict(metric) | {"cell": cell.get("id")}
            if named := metadata.get(FIGURE_METADATA):
                drawn = data.get("image/svg+xml")
                content = drawn.encode() if drawn else base64.b64decode(data["image/png"])
                figures[named["name"]] = (named, ".svg" if drawn else ".png", content)
    return Stated(list(metrics.values()), list(figures.values()), joined(verdicts), left_out)


def joined(verdicts: Iterable[dict | None]) -> dict | None:
    """The worst of the verdicts, with the reasons of all, each once and the worst first; None if there is no verdict."""
    if not (found := [verdict for verdict in verdicts if verdict and verdict["verdict"]]):
        return None
    rank = list(VERDICT_COLOURS).index
    reasons = {(r["name"], r["level"], r["text"]): r for verdict in found for r in verdict["reasons"]}
    worst = max((verdict["verdict"] for verdict in found), key=rank)
    return {"verdict": worst, "reasons": sorted(reasons.values(), key=lambda reason: -rank(reason["level"]))}


def versions() -> dict[str, str]:
    """Python and the packages whose version can change a number."""
    return {"python": platform.python_version()} | {p.name: p.version for name in _PACKAGES for p in distributions(name=name)}
