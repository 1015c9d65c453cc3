"""Reads metrics and figures back from executed notebooks, and the versions of what ran them."""

import base64
import platform
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import nbformat

from lib.workbench.report import FIGURE_METADATA, METRIC_MIME, STOP_METADATA, VERDICT_COLOURS, VERDICT_MIME

__all__ = ["NamedFigure", "figures_of", "joined", "left_out_of", "metrics_of", "outputs", "verdict_of", "versions"]

#: Packages whose version can change a figure.
_TOLD = ("numpy", "scipy", "torch", "kornia", "opencv-python-headless", "open3d-cpu", "open3d", "cvxpy", "clarabel")


@dataclass(frozen=True)
class NamedFigure:
    """A picture that a notebook showed through `lib.workbench.report.show`."""

    name: str
    caption: str
    png: bytes


def metrics_of(executed: Path) -> list[dict]:
    """What the notebook recorded, in order; a name recorded twice counts with its last value."""
    metrics: dict[str, dict] = {}
    for output in outputs(executed):
        metric = output.get("data", {}).get(METRIC_MIME)
        if metric:
            metrics[metric["name"]] = {key: metric[key] for key in ("name", "value", "unit", "paper", "note")}
    return list(metrics.values())


def left_out_of(executed: Path) -> str | None:
    """Why `report.stop` ended the notebook before its last cell; None if it did not."""
    return next((o["metadata"][STOP_METADATA] for o in outputs(executed) if STOP_METADATA in o.get("metadata", {})), None)


def verdict_of(executed: Path) -> dict | None:
    """`verdict` and `reasons` that the notebook stated, joined; None if it stated none."""
    return joined(output.get("data", {}).get(VERDICT_MIME) for output in outputs(executed))


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


def figures_of(executed: Path) -> list[NamedFigure]:
    """What the notebook showed, in order; of pictures with one name, the last."""
    figures: dict[str, NamedFigure] = {}
    for output in outputs(executed):
        named = output.get("metadata", {}).get(FIGURE_METADATA)
        if named:
            png = base64.b64decode(output["data"]["image/png"])
            figures[named["name"]] = NamedFigure(named["name"], named["caption"], png)
    return list(figures.values())


def versions() -> dict[str, str]:
    """Python and the packages whose version can change a figure."""
    found = {"python": platform.python_version()}
    for package in _TOLD:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def outputs(executed: Path) -> Iterator[dict]:
    """The outputs of all cells, in order."""
    for cell in nbformat.read(executed, as_version=4).cells:
        yield from cell.get("outputs", [])
