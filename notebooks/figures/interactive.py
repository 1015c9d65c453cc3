"""Figures with sliders and menus: the same in JupyterLab, in a headless run and in a page without a kernel."""

from __future__ import annotations

import io
from collections.abc import Callable

import matplotlib.pyplot as plt
from ipywidgets import HBox, Image, Layout, VBox
from ipywidgets.widgets.widget_description import DescriptionWidget
from matplotlib.figure import Figure

__all__ = ["explore"]

_DPI = 80


def explore(draw: Callable[..., Figure], **knobs: DescriptionWidget) -> VBox:
    """The figure `draw(name=value, ...)` below its controls, drawn anew when one of them changes.

    Not `ipywidgets.interact`: an executing client that captures large outputs of a widget may wait for ever.

    Parameters
    ----------
    draw:
        Makes a figure; it is closed here.
    knobs:
        For each argument of `draw` a widget with a value, such as an `IntSlider`.  A widget without a description is
        described by the argument's name.
    """
    for name, knob in knobs.items():
        knob.description = knob.description or name.replace("_", " ")

    def draw_png() -> tuple[bytes, int]:
        buffer = io.BytesIO()
        page = draw(**{name: knob.value for name, knob in knobs.items()})
        page.savefig(buffer, format="png", dpi=_DPI)
        width = round(page.get_figwidth() * _DPI)
        plt.close(page)
        return buffer.getvalue(), width

    value, width = draw_png()
    # In its own size: stretched to the width of the cell it would be blurred.
    picture = Image(value=value, format="png", layout=Layout(width=f"{width}px", max_width="100%", height="auto"))

    def redraw(_: object) -> None:
        picture.value = draw_png()[0]

    for knob in knobs.values():
        knob.observe(redraw, names="value")
    return VBox([HBox(list(knobs.values())), picture])
