"""A plot for each metric of a sweep."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from lib import files
from lib.workbench.results import Table

__all__ = ["save_plots"]


def save_plots(rows: Sequence[dict], parameters: Sequence[str], folder: Path) -> list[Path]:
    """Write ``METRIC.png`` for each column of numbers that is no parameter.

    The horizontal axis is the first parameter with several values; the others but `seed` make lines.  A line joins
    medians over what is left, such as seeds; dots are the runs.
    """
    table = Table(list(rows))
    varied = [name for name in parameters if len({str(row[name]) for row in rows}) > 1]
    axis = next((name for name in varied if name != "seed"), "seed" if "seed" in varied else None)
    if axis is None:
        return []
    lines = [name for name in varied if name not in (axis, "seed")]
    written = []
    for metric, values in table.columns.items():
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
        written.append(folder / f"{metric}.png")
    return written
