"""Figures with sliders and menus: the same in JupyterLab, in a headless run and in a page without a kernel."""

from __future__ import annotations

import base64
import html
import io
import json
import os
from collections.abc import Callable
from typing import TYPE_CHECKING

import cv2
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import HTML, display
from ipywidgets import HBox, Image, Layout, VBox
from ipywidgets.widgets.widget_description import DescriptionWidget
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from notebooks.figures.style import figure

if TYPE_CHECKING:
    import plotly.graph_objects as go

_DPI = 80
#: About the number of pictures that a page contains for each figure; the run draws them all.
_STILLS = 5
#: Largest width of an image that a page embeds for `swipe` and `epipolar_pointer`.
_WIDEST_PX = 960


class _Explorer(VBox):
    """Controls above a picture; if a page is made, also pictures from which the sliders of the page choose."""

    still_html = ""

    def _repr_mimebundle_(self, **options: object) -> dict:
        data = super()._repr_mimebundle_(**options)
        return data | {"text/html": self.still_html} if self.still_html else data


def explore(draw: Callable[..., Figure], **knobs: DescriptionWidget) -> VBox:
    """The figure `draw(name=value, ...)` below its controls; it is drawn again when one of them changes.

    This is not `ipywidgets.interact`, because a client that captures large widget outputs may then wait for ever.  A run that
    makes pages also draws a few values of each control, so that the sliders of the page work without a kernel.

    Args:
        draw: Makes a figure, which is closed here.  The first line of its docstring describes the picture.
        knobs: For each argument of `draw` a widget with a value, such as an `IntSlider`.  A widget without a
            description is described by the argument's name.
    """
    for name, knob in knobs.items():
        knob.description = knob.description or name.replace("_", " ")
        knob.style.description_width = "initial"  # otherwise a long description is cut off
    defaults = {name: knob.value for name, knob in knobs.items()}

    def drawn(format: str = "png", **changed: object) -> tuple[bytes, int]:
        buffer = io.BytesIO()
        page = draw(**{name: knob.value for name, knob in knobs.items()} | changed)
        page.savefig(buffer, format=format, dpi=_DPI)
        width = round(page.get_figwidth() * _DPI)
        plt.close(page)
        return buffer.getvalue(), width

    value, width = drawn()
    # At its own size: if stretched to the width of the cell, it would be blurred.
    picture = Image(value=value, format="png", layout=Layout(width=f"{width}px", max_width="100%", height="auto"))

    def redraw(_: object) -> None:
        picture.value = drawn()[0]

    for knob in knobs.values():
        knob.observe(redraw, names="value")
    box = _Explorer([HBox(list(knobs.values()), layout=Layout(flex_flow="row wrap")), picture])
    if "MICROSTEREO_PAGE" in os.environ:
        shows = (draw.__doc__ or draw.__name__.replace("_", " ").strip("<>")).strip().split("\n")[0]
        box.still_html = _stills(shows, knobs, defaults, value, lambda **changed: drawn("webp", **changed)[0])
    return box


def _stills(
    shows: str, knobs: dict[str, DescriptionWidget], defaults: dict[str, object], png: bytes, drawn: Callable[..., bytes]
) -> str:
    """HTML: pictures of a few values of each control, with the others at their defaults, and a slider for each."""
    pictures, sliders = [("default", "at the defaults", png)], []
    for name, knob in knobs.items():
        values = _some_values(knob, max(3, _STILLS // len(knobs)))
        texts = [text for text, _ in values]
        at = [value for _, value in values].index(defaults[name])
        for k, (text, value) in enumerate(values):
            if k != at:
                pictures.append((f"{name}-{k}", f"{knob.description} {text}", drawn(**{name: value})))
        sliders.append(
            f'<label>{html.escape(knob.description)} <input type="range" disabled name="{name}" min="0"'
            f' max="{len(values) - 1}" value="{at}" data-texts="{html.escape("|".join(texts))}">'
            f"<output>{html.escape(texts[at])}</output></label>"
        )
    images = "".join(
        f'<img data-at="{at}"{"" if at == "default" else " hidden"} alt="{html.escape(f"{shows} ({said})")}"'
        f' src="data:image/{"png" if at == "default" else "webp"};base64,{base64.b64encode(data).decode("ascii")}">'
        for at, said, data in pictures
    )
    told = "This page shows a few values of each control, the others at their defaults. JupyterLab shows every value."
    return f'<div class="explore">{"".join(sliders)}{images}<p class="interactive">{told}</p></div>'


def _some_values(knob: DescriptionWidget, n: int) -> list[tuple[str, object]]:
    """(text, value) of up to n values over the range of a control, in order; they include the current one."""
    if hasattr(knob, "options"):
        found = [(str(text), value) for text, value in knob._options_full]
        at = found.index(next(entry for entry in found if entry[1] == knob.value))
    else:
        low, high = np.array([knob.min, knob.max], dtype=float)
        values = np.linspace(low, high, round((high - low) / knob.step) + 1)
        values = knob.base**values if hasattr(knob, "base") else values
        kind = int if isinstance(knob.value, int) else float
        at = int(np.argmin(np.abs(values - knob.value)))
        found = [(f"{value:.4g}", kind(round(value, 9))) for value in values]
        found[at] = (f"{knob.value:.4g}", knob.value)
    chosen = {round(k) for k in np.linspace(0, len(found) - 1, n)}
    chosen = chosen - {min(chosen, key=lambda k: abs(k - at))} | {at}
    return [found[k] for k in sorted(chosen)]


def swipe(left: np.ndarray, right: np.ndarray, shows: str) -> HTML:
    """The right image over the left one, with a border that a slider moves; without scripts it stays in the middle."""
    over = "position:absolute;inset:0;width:100%;height:100%;max-width:none;margin:0"
    shows = html.escape(shows)
    return HTML(
        f'<div class="swipe" style="--at:50%;max-width:{_WIDEST_PX}px"><div style="position:relative">'
        f'<img alt="{shows}: the left image" src="{_embedded(left)}" style="display:block;width:100%;margin:0">'
        f'<img alt="{shows}: the right image over it" src="{_embedded(right)}"'
        f' style="{over};clip-path:inset(0 0 0 var(--at))">'
        '<i style="position:absolute;top:0;bottom:0;left:var(--at);width:2px;background:#fff"></i></div>'
        '<input type="range" value="50" step="0.5" aria-label="Border between the left and the right image"'
        " style=\"width:100%;margin:4px 0\" oninput=\"this.parentNode.style.setProperty('--at', this.value + '%')\"></div>"
    )


def epipolar_pointer(left: np.ndarray, right: np.ndarray, F: np.ndarray, start_px: np.ndarray, shows: str) -> HTML:
    """Two images; the right one shows the epipolar line of the pixel under the pointer, or of `start_px` without scripts.

    Args:
        F: (3, 3) fundamental matrix; F @ [x, y, 1] = [a, b, c] is the line a x + b y + c = 0 in the right image.
        start_px: (2,) the first pixel.
    """
    height, width = left.shape[:2]
    a, b, c = F @ [*start_px, 1.0]
    move = (
        "const p = new DOMPoint(event.clientX, event.clientY).matrixTransform(this.getScreenCTM().inverse()),"
        f" [a, b, c] = {json.dumps(F.tolist())}.map((r) => r[0] * p.x + r[1] * p.y + r[2]),"
        " set = (e, o) => Object.entries(o).forEach(([k, v]) => e.setAttribute(k, v));"
        " set(this.querySelector('circle'), { cx: p.x, cy: p.y });"
        f" set(this.nextElementSibling.querySelector('line'), {{ y1: -c / b, y2: -(a * {width - 1} + c) / b }});"
    )
    box = f'viewBox="-0.5 -0.5 {width} {height}" role="img"'
    image = f'<image x="-0.5" y="-0.5" width="{width}" height="{height}" href='
    thick = width / 300
    return HTML(
        '<div class="epipolar" style="display:grid;grid-template-columns:repeat(auto-fit,minmax(280px,1fr));gap:8px">'
        f'<svg {box} aria-label="{html.escape(shows)}: left" style="cursor:crosshair;touch-action:pan-y"'
        f' onpointermove="{move}">{image}"{_embedded(left)}"/><circle cx="{start_px[0]:.1f}" cy="{start_px[1]:.1f}"'
        f' r="{3 * thick:.1f}" fill="none" stroke="#fff" stroke-width="{thick:.1f}"/></svg>'
        f'<svg {box} aria-label="{html.escape(shows)}: right">{image}"{_embedded(right)}"/>'
        f'<line x1="0" x2="{width - 1}" y1="{-c / b:.2f}" y2="{-(a * (width - 1) + c) / b:.2f}" stroke="#0ff"'
        f' stroke-width="{thick:.1f}"/></svg></div>'
    )


def _embedded(image: np.ndarray) -> str:
    """An RGB image as a data URL, at most `_WIDEST_PX` wide."""
    height, width = image.shape[:2]
    if width > _WIDEST_PX:
        image = cv2.resize(image, (_WIDEST_PX, round(height * _WIDEST_PX / width)), interpolation=cv2.INTER_AREA)
    data = cv2.imencode(".webp", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_WEBP_QUALITY, 80])[1]
    return f"data:image/webp;base64,{base64.b64encode(data.tobytes()).decode('ascii')}"


def show_scene(view: go.Figure, caption: str) -> None:
    """Display a plotly scene that the mouse turns, with a picture of it for pages without scripts."""
    buffer = io.BytesIO()
    page = still(view)
    page.savefig(buffer, format="png")
    plt.close(page)
    bundle = {
        "application/vnd.plotly.v1+json": json.loads(view.to_json()),
        "image/png": base64.b64encode(buffer.getvalue()).decode("ascii"),
        "text/plain": caption,
    }
    display(bundle, metadata={"image/png": {"alt": caption}}, raw=True)


def still(view: go.Figure) -> Figure:
    """A picture of the meshes and lines of a plotly scene, in parallel projection from the direction of its camera."""
    camera = view.layout.scene.camera
    eye, up = (np.array([point.x, point.y, point.z], dtype=float) for point in (camera.eye, camera.up))
    ahead = -eye / np.linalg.norm(eye)
    right = np.cross(ahead, up) / np.linalg.norm(np.cross(ahead, up))
    axes_of_page = np.stack([right, np.cross(right, ahead), -ahead], axis=1)
    page, ax = figure(width_in=9, height_in=6)
    for trace in view.data:
        seen = np.column_stack([trace.x, trace.y, trace.z]).astype(float) @ axes_of_page  # x, y, towards the eye
        if trace.type == "mesh3d":
            faces = np.column_stack([trace.i, trace.j, trace.k])
            faces = faces[np.argsort(seen[faces, 2].mean(axis=1))]  # the nearest last
            rgb = np.array([json.loads(f"[{colour[4:-1]}]") for colour in trace.vertexcolor]) / 255
            colours = rgb[faces].mean(axis=1)
            ax.add_collection(PolyCollection(seen[faces, :2], facecolors=colours, edgecolors=colours, linewidths=0.3))
        else:
            style = "--" if trace.line.dash == "dash" else "-"
            ax.plot(*seen.T[:2], style, color=trace.line.color, lw=0.6 * trace.line.width, label=trace.name)
    ax.set_aspect("equal")
    ax.autoscale_view()
    ax.set_axis_off()
    ax.legend(fontsize=8, loc="upper left")
    return page
