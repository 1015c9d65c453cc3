"""Figures of notebook 06: the run frame by frame, times of the stages, errors, and the dashboard of a frame."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from ipywidgets import IntSlider, VBox
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, MaxNLocator
from PIL import Image

from lib.online import STAGES, STATES, FrameResult
from notebooks.figures.interactive import explore
from notebooks.figures.overview import landmarks_on
from notebooks.figures.style import COLOURS, LANDMARK_COLOURS, figure, show_image

#: `MovedCameras.moved` -> what the registration found, in words.
MOVED = {
    "none": "no camera moved", "shifted": "both cameras shifted together", "together": "both cameras moved together",
    "left": "the left camera moved", "right": "the right camera moved", "apart": "the cameras moved apart",
}  # fmt: skip
_STATE_COLOURS = dict(zip(STATES, ("#f0f0f0", "white", "#dceaf7", "#b0b0b0", "#f7eec2", "#fde3c8"), strict=True))
_STAGE_COLOURS = dict(
    zip(STAGES, ("#0072B2", "#56B4E9", "#CC79A7", "#D55E00", "#E69F00", "#009E73", "#999999"), strict=True)
)


class Film(Figure):
    """An animation of pages (h, w, 3) uint8, one every `seconds`; it is saved as an animated PNG."""

    def __init__(self, pages: Sequence[np.ndarray], *, seconds: float = 0.4) -> None:
        height, width = pages[0].shape[:2]
        super().__init__(figsize=(10.0, 10.0 * height / width), layout="constrained")
        self._pages, self._seconds = pages, seconds
        axes = self.add_subplot()
        axes.axis("off")
        self._shown = axes.imshow(pages[-1])

    def savefig(self, file, **options) -> None:
        """Write the pages as an animated PNG of at most 256 colours a page."""
        drawn = []
        for page in self._pages:
            self._shown.set_data(page)
            buffer = io.BytesIO()
            super().savefig(buffer, format="png", dpi=100)
            drawn.append(Image.open(buffer).convert("RGB").quantize(256, Image.Quantize.FASTOCTREE))
        drawn[0].save(file, "PNG", save_all=True, append_images=drawn[1:], duration=round(1e3 * self._seconds))


def _shade_states(ax, results: Sequence[FrameResult]) -> None:
    for result in results:
        ax.axvspan(result.index - 0.5, result.index + 0.5, color=_STATE_COLOURS[result.state], zorder=0, linewidth=0)


def timeline(results: Sequence[FrameResult], *, bump_at: int | None = None) -> Figure:
    """Results of the pipeline, frame by frame: landmarks, drift statistic, distance of the tool to the surface."""
    page, axes = figure(3, 1, width_in=12, height_in=6.4, sharex=True, height_ratios=[1.1, 1, 1.3])
    index = [result.index for result in results]
    for ax in axes:
        _shade_states(ax, results)
        if bump_at is not None:
            ax.axvline(bump_at - 0.5, color=COLOURS["warning"], linestyle="--")
    names = [f"{side} {landmark}" for side in ("left", "right") for landmark in LANDMARK_COLOURS]
    confidence = np.array([result.landmarks.confidence.T.reshape(6) for result in results]).T
    seen = np.array([result.landmarks.seen.T.reshape(6) for result in results]).T
    for k, name in enumerate(names):
        colour = LANDMARK_COLOURS[name.split()[1]]
        axes[0].scatter(
            np.array(index)[seen[k]], np.full(seen[k].sum(), k), c=colour, s=8 + 30 * confidence[k][seen[k]]
        )
    axes[0].set_yticks(range(6), names)
    axes[0].set(title="Landmarks seen (size: confidence)", ylim=(5.6, -0.6))
    axes[1].plot(index, [result.drift for result in results], color=COLOURS["ours"], marker=".")
    axes[1].axhline(1, color="black", linestyle=":", linewidth=1)
    for result in results:
        if result.motion is not None:
            axes[1].axvline(result.index, color=COLOURS["truth"], linewidth=1, alpha=0.6)
    axes[1].set(title="Drift statistic, alarm at 1 (green: the cameras were registered)", ylim=(0, 1.6))
    distance = np.array([result.distance_mm for result in results])
    sd = np.array([result.distance_sd_mm for result in results])
    for k, (name, colour) in enumerate(LANDMARK_COLOURS.items()):
        axes[2].plot(index, distance[:, k], color=colour, marker=".", label=name)
        axes[2].fill_between(index, distance[:, k] - 2 * sd[:, k], distance[:, k] + 2 * sd[:, k], color=colour, alpha=0.2)
    axes[2].set(title="Distance of the tool to the surface along the view, in mm (band: 2 sd)", xlabel="frame")
    shown = {result.state for result in results}
    patches = [Patch(facecolor=_STATE_COLOURS[s], edgecolor="#cccccc", label=s) for s in _STATE_COLOURS if s in shown]
    handles = axes[2].get_legend_handles_labels()[0] + patches
    page.legend(handles=handles, loc="outside lower center", ncols=len(handles))  # outside, since the curves fill the axes
    return page


def stage_times(results: Sequence[FrameResult], *, paper_hz: float = 5.0) -> Figure:
    """Times of each stage and of the whole frame, one row each: a dot for each frame in which it ran, and the median.

    The scale is logarithmic.  The first two frames, which include the warm-up, are drawn as rings.
    """
    rows = {stage: [(r.index, r.seconds[stage]) for r in results if stage in r.seconds] for stage in STAGES}
    rows["whole frame"] = [(r.index, sum(r.seconds.get(stage, 0.0) for stage in STAGES)) for r in results]
    rows = {name: np.array(found) for name, found in rows.items() if found}
    page, ax = figure(width_in=10, height_in=0.5 * len(rows) + 1.1)
    rng = np.random.default_rng(0)
    for k, (name, found) in enumerate(rows.items()):
        ms, warm = np.maximum(1e3 * found[:, 1], 0.05), found[:, 0] < results[0].index + 2
        colour, y = _STAGE_COLOURS.get(name, "black"), k + rng.uniform(-0.22, 0.22, len(found))
        ax.scatter(ms[~warm], y[~warm], s=16, color=colour, alpha=0.6, linewidths=0)
        ax.scatter(ms[warm], y[warm], s=22, facecolors="none", edgecolors=colour)
        median = float(np.median(ms))
        ax.plot([median] * 2, [k - 0.38, k + 0.38], color="black", lw=2.2)
        said = f"{median:.0f} ms" if median >= 10 else f"{median:.1f} ms"
        ax.text(1.01, k, said, transform=ax.get_yaxis_transform(), va="center")
    ax.axvline(1e3 / paper_hz, color=COLOURS["paper"], linestyle="--", label=f"paper, whole frame: {1e3 / paper_hz:.0f} ms")
    ax.set_yticks(range(len(rows)), rows)
    ax.set(xscale="log", xlabel="time in a frame (ms); bar and number: median", ylim=(len(rows) - 0.4, -0.6))
    ax.xaxis.set_major_formatter("{x:g}")
    ax.grid(axis="y", visible=False)
    page.legend(loc="outside upper right")
    return page


def error_timeline(
    results: Sequence[FrameResult], errors_um: Mapping[str, np.ndarray], *, bump_at: int | None = None
) -> Figure:
    """Errors against the truth (name -> one per result, um; NaN = unknown) frame by frame, on a logarithmic scale."""
    page, ax = figure(1, 1, width_in=12, height_in=3.6)
    _shade_states(ax, results)
    colours = (COLOURS["ours"], COLOURS["truth"], COLOURS["paper"], COLOURS["baseline"])
    for (name, error), colour in zip(errors_um.items(), colours, strict=False):
        known = np.flatnonzero(np.isfinite(error))
        if not len(known):
            continue  # nothing to draw, and nothing for the legend
        # If only every third frame has a surface, a line still joins these; it is broken where more frames are missing.
        breaks = np.flatnonzero(np.diff(known) > np.diff(known).min(initial=len(error))) + 1
        for k, part in enumerate(np.split(known, breaks)):
            index = [results[i].index for i in part]
            ax.plot(index, error[part], color=colour, marker=".", label=name if k == 0 else None)
    if bump_at is not None:
        ax.axvline(bump_at - 0.5, color=COLOURS["warning"], linestyle="--", label="push")
    if any(np.isfinite(error).any() for error in errors_um.values()):
        ax.set(yscale="log")
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.set(xlabel="frame", ylabel="um", title="Errors against the truth")
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter("")
    page.legend(loc="outside lower center", ncols=4)
    return page


def dashboard(left: np.ndarray, result: FrameResult) -> Figure:
    """One frame: the left image with landmarks and matched points coloured by height, and the surface with the tool.

    A height in mm is measured along the view, towards the camera, from the lowest point of the surface.
    """
    page, axes = figure(1, 2, width_in=13, height_in=4.2, width_ratios=[1.35, 1])
    show_image(axes[0], left, f"Frame {result.index}: {result.state}")
    landmarks_on(axes[0], result.landmarks.u_left, label=False)
    axes[1].set_axis_off()
    text = "\n".join(f"{stage}: {why}" for stage, why in result.failures.items())
    if text:
        axes[0].text(0.01, 0.02, text[:160], transform=axes[0].transAxes, color="white", fontsize=8, va="bottom")
    if result.reconstruction is None or not hasattr(result.reconstruction.surface, "on_grid"):
        axes[1].text(0.5, 0.5, "no surface yet", ha="center")
        return page
    surface, camera = result.reconstruction.surface, result.reconstruction.rig.left
    x0, y0, x1, y1 = surface.grid.domain
    x = surface.on_grid(np.linspace(x0, x1, 60), np.linspace(y0, y1, 45))
    view = camera.resect().R  # x right, y down, z away from the camera
    centre = np.nanmean(x.reshape(-1, 3), axis=0)
    seen = (x - centre) @ view.T
    bottom = np.nanmax(seen[..., 2])
    height = bottom - seen[..., 2]
    if result.reconstructed_at == result.index:
        u, points = result.reconstruction.u, result.reconstruction.points.x_mm
        shown = np.arange(0, len(u), max(1, len(u) // 1500))
        h = bottom - (points[shown] - centre) @ view[2]
        dots = axes[0].scatter(*u[shown].T, c=h, s=3, vmin=0, vmax=np.nanmax(height), cmap="viridis")
        page.colorbar(dots, ax=axes[0], label="height in mm", shrink=0.8)
    axes[1].remove()
    # Drawn in the order of the calls: matplotlib's own depth order would hide the tool behind the surface below it.
    scene = page.add_subplot(axes[1].get_subplotspec(), projection="3d", computed_zorder=False)
    scene.plot_surface(seen[..., 0], -seen[..., 1], height, cmap="viridis", linewidth=0, antialiased=True, alpha=0.9)
    tool = np.where(np.isfinite(result.landmarks.x_mm), result.landmarks.x_mm, result.x_tool_mm)
    tool = (tool - centre) @ view.T
    tool = np.column_stack([tool[:, 0], -tool[:, 1], bottom - tool[:, 2]])
    for tip in (1, 2):
        scene.plot(*tool[[0, tip]].T, color="black", linewidth=2)
    for name, point in zip(LANDMARK_COLOURS, tool, strict=True):
        scene.scatter(*point, color=LANDMARK_COLOURS[name], edgecolor="black", s=25)
    scene.set(xlabel="x in mm", ylabel="y in mm", zlabel="height in mm")
    for axis in (scene.xaxis, scene.yaxis, scene.zaxis):
        axis.set_major_locator(MaxNLocator(4))
    ranges = np.nanmax(seen, axis=(0, 1)) - np.nanmin(seen, axis=(0, 1))
    scene.set_box_aspect((ranges[0], ranges[1], 0.6 * ranges[1]), zoom=0.85)  # leaves room for the labels
    scene.view_init(elev=30, azim=-70)
    distance = ", ".join(
        f"{name} {d:.2f}" for name, d in zip(LANDMARK_COLOURS, result.distance_mm, strict=True) if np.isfinite(d)
    )
    scene.set_title(f"Above the surface, mm: {distance}" if distance else "Tool outside the surface", fontsize=10)
    return page


def frame_browser(left: Callable[[int], np.ndarray], results: Sequence[FrameResult], *, start: int = 0) -> VBox:
    """A slider over the dashboards of all frames; without a browser it shows frame `start`.

    `left` returns the left image (h, w, 3) uint8 of a frame number.
    """
    slider = IntSlider(value=start, min=0, max=len(results) - 1, continuous_update=False)

    def look(frame: int) -> Figure:
        """A frame with its landmarks and matched points, and the surface with the tool above it."""
        return dashboard(left(frame), results[frame])

    return explore(look, frame=slider)
