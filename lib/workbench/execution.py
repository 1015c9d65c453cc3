"""Executes one notebook with papermill, judges by its outputs whether it went well, and reads back what it stated."""

import base64
import logging
import os
import platform
import re
from collections.abc import Callable, Iterable
from importlib.metadata import distributions
from pathlib import Path
from typing import NamedTuple

import nbformat
from nbclient.exceptions import CellTimeoutError, DeadKernelError

from lib.workbench.report import FIGURE_METADATA, METRIC_MIME, STOP_METADATA, VERDICT_COLOURS, VERDICT_MIME

#: Packages whose version can change a figure.
_TOLD = ("numpy", "scipy", "torch", "kornia", "opencv-python-headless", "open3d-cpu", "open3d", "cvxpy", "clarabel")
_ADDED = {"injected-parameters", "papermill-error-cell-tag"}
#: What kernels inherit: this interpreter's own kernel, quiet libraries, and that nobody answers what they show.
_KERNEL_ENVIRONMENT = {
    "MICROSTEREO_PAGE": "1",
    "JUPYTER_PREFER_ENV_PATH": "1",  # a kernel named python3 elsewhere on the machine must not win
    "OPEN3D_DISABLE_WEB_VISUALIZER": "true",  # it hangs without a display
    "PYDEVD_DISABLE_FILE_VALIDATION": "1",  # a warning of the debugger on every start
}


class Failure(NamedTuple):
    """Why a notebook did not get to its end: `cell` counts its cells from 1."""

    kind: str  # "error", "timeout" or "dead kernel"
    cell: int | None
    message: str

    def __str__(self) -> str:
        where = f" in cell {self.cell}" if self.cell else ""
        return f"{self.kind}{where}: {self.message}"


def execute(
    notebook: Path, output: Path, parameters: dict, *, cell_timeout_s: float | None = None,
    on_cell: Callable[[int, int], None] = lambda cell, n_cells: None,
) -> Failure | None:  # fmt: skip
    """Execute `notebook` into `output` (written after each cell); None if every cell came to its end.

    `on_cell` is called with the cell that starts (from 1) and the number of cells.
    """
    import papermill
    from papermill.exceptions import PapermillExecutionError

    running, cells = 0, len(nbformat.read(notebook, as_version=4).cells)

    def on_cell_start(cell, cell_index):
        nonlocal running
        running += not _is_added(cell)
        on_cell(running, cells)

    os.environ.pop("JUPYTER_PATH", None)
    os.environ.update(_KERNEL_ENVIRONMENT)
    logging.getLogger("papermill").setLevel(logging.CRITICAL)  # what it says is told by the failure returned
    try:
        papermill.execute_notebook(
            str(notebook), str(output), parameters, kernel_name="python3", progress_bar=False,
            execution_timeout=cell_timeout_s,
            start_timeout=600,  # of the kernel: a busy machine takes its time
            on_cell_start=on_cell_start,  # this and the next are for nbclient
            extra_arguments=["--IPKernelApp.log_level=50"],  # its warning of unencrypted TCP on every start
        )  # fmt: skip
    except PapermillExecutionError:
        pass  # told by the outputs, below
    except CellTimeoutError:
        return Failure("timeout", running, f"the cell took longer than {cell_timeout_s:g} s (--cell-timeout).")
    except DeadKernelError:
        return Failure("dead kernel", running, "the kernel died; the machine may have run out of memory.")
    except (nbformat.ValidationError, OSError, ValueError, RuntimeError) as error:
        return Failure("error", running or None, f"{type(error).__name__}: {error}")
    return _failure_of(output)


def _failure_of(executed: Path) -> Failure | None:
    """Judge an executed notebook by its outputs; one that `report.stop` ended went well."""
    cells = [cell for cell in nbformat.read(executed, as_version=4).cells if not _is_added(cell)]
    for number, cell in enumerate(cells, start=1):
        if cell.cell_type != "code" or "raises-exception" in cell.metadata.get("tags", []):
            continue
        for output in cell.outputs:
            if output.output_type == "error" and output.ename == "SystemExit" and not output.evalue:
                return None  # `report.stop`
            if output.output_type == "error":
                message = re.sub(r"\x1b\[[0-9;]*m", "", output.evalue)  # colours of a terminal
                return Failure("error", number, f"{output.ename}: {message}")
        status = cell.metadata.get("papermill", {}).get("status")
        if cell.source.strip() and status not in (None, "completed"):
            return Failure("error", number, f"the cell is {status}.")
    return None


def _is_added(cell) -> bool:
    """papermill's own cells (values given, error marks), which the author does not count."""
    return bool(_ADDED & set(cell.metadata.get("tags", [])))


class Stated(NamedTuple):
    """What an executed notebook stated: of metrics and pictures with one name the last, in the order of the first."""

    metrics: list[dict]  # each with its `cell`
    figures: list[tuple[dict, str, bytes]]  # name and caption, ".svg" or ".png", the file's content
    verdict: dict | None  # `verdict` and `reasons` of all that it stated, joined
    left_out: str | None  # why `report.stop` ended it before its last cell


def stated_in(executed: Path) -> Stated:
    """Read back what `lib.workbench.report` put into an executed notebook."""
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
    """The worst verdict with the reasons of all, each once and the worst first; None if there is none."""
    found = [verdict for verdict in verdicts if verdict and verdict["verdict"]]
    if not found:
        return None
    rank = list(VERDICT_COLOURS).index
    reasons = {(r["name"], r["level"], r["text"]): r for verdict in found for r in verdict["reasons"]}
    return {
        "verdict": max((verdict["verdict"] for verdict in found), key=rank),
        "reasons": sorted(reasons.values(), key=lambda reason: -rank(reason["level"])),
    }


def versions() -> dict[str, str]:
    """Python and the packages whose version can change a figure."""
    installed = {package.name: package.version for package in distributions()}
    return {"python": platform.python_version()} | {name: installed[name] for name in _TOLD if name in installed}
