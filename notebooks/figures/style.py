"""The style that all figures share: colours, sizes, image panels."""

from __future__ import annotations

import html
from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from IPython.display import HTML
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lib import correspondences

#: Colours named by their meaning: safe for colour-blind readers (after Okabe and Ito), contrast at least 3:1 on white.
COLOURS = {
    "ours": "#0072B2",
    "paper": "#D55E00",
    "truth": "#009E73",
    "baseline": "#8A8A8A",
    "left": "#0072B2",
    "right": "#CC79A7",
    "warning": "#C77700",
}
#: Colours of the landmarks, legible on dark images and on white.
LANDMARK_COLOURS = {name: "#{:02X}{:02X}{:02X}".format(*colour) for name, colour in correspondences.LANDMARK_COLOURS.items()}
#: Style of a legend that lies on an image.
ON_IMAGE = {"labelcolor": "white", "frameon": True, "facecolor": "black", "framealpha": 0.55, "edgecolor": "none"}

_RC = {
    "figure.dpi": 100,
    "savefig.dpi": 100,
    "figure.facecolor": "white",
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "lines.linewidth": 1.8,
    "legend.frameon": False,
    "image.cmap": "viridis",
}
plt.rcParams.update(_RC)  # at import, so that titles and labels that a notebook sets later get the style, too


def figure(
    rows: int = 1, columns: int = 1, *, width_in: float = 10.0, height_in: float = 4.0, **subplots
) -> tuple[Figure, np.ndarray | Axes]:
    """A figure in this style, and its axes; `subplots` are further arguments of `matplotlib.pyplot.subplots`."""
    return plt.subplots(rows, columns, figsize=(width_in, height_in), layout="constrained", **subplots)


def show_image(axes: Axes, image: np.ndarray, title: str = "") -> Axes:
    """Show an image without ticks or grid; pixel centres are at integer coordinates."""
    axes.imshow(image, cmap="gray" if image.ndim == 2 else None, interpolation="antialiased")
    axes.set(xticks=[], yticks=[], title=title)
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(False)
    return axes


def table(header: Sequence[str], rows: Sequence[Sequence[str]], caption: str) -> HTML:
    """A table of text as HTML, which can be searched, copied and read on a small screen."""
    lines = [("th", header), *(("td", row) for row in rows)]
    body = "".join(
        f"<tr>{''.join(f'<{kind}>{html.escape(str(entry))}</{kind}>' for entry in row)}</tr>" for kind, row in lines
    )
    # A wide table scrolls on its own, so that the page need not.
    return HTML(f'<div style="overflow-x:auto"><table><caption>{html.escape(caption)}</caption>{body}</table></div>')
