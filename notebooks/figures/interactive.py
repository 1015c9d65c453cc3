"""Pictures to turn knobs at: the same in JupyterLab, in a headless run and in a page without a kernel."""

from __future__ import annotations

import io
from collections.abc import Callable

import matplotlib.pyplot as plt
from ipywidgets import HBox, Image, VBox
from ipywidgets.widgets.widget_description import DescriptionWidget
from matplotlib.figure import Figure

__all__ = ["explore"]


def explore(draw: Callable[..., Figure], **knobs: DescriptionWidget) -> VBox:
    """The figure `draw(name=value, ...)` below its knobs, drawn anew when one is turned.

    Not `ipywidgets.interact`: an executing client that captures large outputs of a widget may wait for ever.

    Parameters
    ----------
    draw:
        Makes a figure; it is closed here.
    knobs:
        For each argument of `draw` a widget with a value, such as an `IntSlider`; its name is its description, where it
        has none.
    """
    for name, knob in knobs.items():
        knob.description = knob.description or name.replace("_", " ")

    def png() -> bytes:
        buffer = io.BytesIO()
        page = draw(**{name: knob.value for name, knob in knobs.items()})
        page.savefig(buffer, format="png", dpi=80)
        plt.close(page)
        return buffer.getvalue()

    picture = Image(value=png(), format="png")

    def redraw(_: object) -> None:
        picture.value = png()

    for knob in knobs.values():
        knob.observe(redraw, names="value")
    return VBox([HBox(list(knobs.values())), picture])
