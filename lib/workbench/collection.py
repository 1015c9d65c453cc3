"""Reads metrics and figures back from executed notebooks, and says what ran them."""

from __future__ import annotations

import base64
import os
import platform
import subprocess
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import nbformat

from lib import paths
from lib.report import FIGURE_METADATA, METRIC_MIME

__all__ = ["NamedFigure", "commit", "figures_of", "machine", "metrics_of", "versions"]

#: Packages whose version can change a figure.
_TOLD = ("numpy", "scipy", "torch", "kornia", "opencv-python-headless", "open3d-cpu", "open3d", "cvxpy", "clarabel")


@dataclass(frozen=True)
class NamedFigure:
    """A picture that a notebook showed through `lib.report.show`."""

    name: str
    caption: str
    png: bytes


def metrics_of(executed: Path) -> list[dict]:
    """What the notebook recorded, in order; a name recorded twice counts with its last value."""
    metrics: dict[str, dict] = {}
    for output in _outputs(executed):
        metric = output.get("data", {}).get(METRIC_MIME)
        if metric:
            metrics[metric["name"]] = {key: metric[key] for key in ("name", "value", "unit", "paper", "note")}
    return list(metrics.values())


def figures_of(executed: Path) -> list[NamedFigure]:
    """What the notebook showed, in order; of pictures with one name, the last."""
    figures: dict[str, NamedFigure] = {}
    for output in _outputs(executed):
        named = output.get("metadata", {}).get(FIGURE_METADATA)
        if named:
            png = base64.b64decode(output["data"]["image/png"])
            figures[named["name"]] = NamedFigure(named["name"], named["caption"], png)
    return list(figures.values())


def commit(root: Path = paths.ROOT) -> dict | None:
    """Commit of the workbench and whether its files differ from it; None outside a git checkout."""
    git = ["git", "-C", str(root)]
    try:
        head = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
        status = subprocess.run([*git, "status", "--porcelain"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return {"id": head.stdout.strip(), "modified": bool(status.stdout.strip())}


def machine() -> dict:
    """System, processor, cores that this process may use, memory and GPU."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "system": f"{platform.system()} {platform.release()}",
        "processor": _processor(),
        "cores": cores,
        "memory_gb": _memory_gb(),
        "gpu": _gpu(),
    }


def versions() -> dict[str, str]:
    """Python and the packages whose version can change a figure."""
    found = {"python": platform.python_version()}
    for package in _TOLD:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def _outputs(executed: Path):
    for cell in nbformat.read(executed, as_version=4).cells:
        yield from cell.get("outputs", [])


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _memory_gb() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1)
    except (AttributeError, ValueError, OSError):
        return None


def _gpu() -> str | None:
    try:
        command = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
        answer = subprocess.run(command, capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return answer.stdout.splitlines()[0].strip() if answer.returncode == 0 and answer.stdout.strip() else None
