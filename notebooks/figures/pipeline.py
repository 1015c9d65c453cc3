"""Figures of notebook 06: the run frame by frame, seconds of the stages, errors, and a frame's dashboard."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from ipywidgets import IntSlider, VBox
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from lib.online import STAGES, STATES, FrameResult
from lib.recordings import StereoFrame
from notebooks.figures.interactive import explore
from notebooks.figures.overview import landmarks_on
from notebooks.figures.style import COLOURS, LANDMARK_COLOURS, figure, show_image

__all__ = ["dashboard", "error_timeline", "frame_browser", "stage_times", "timeline"]

_STATE_COLOURS = dict(zip(STATES, ("#f0f0f0", "white", "#dceaf7", "#b0b0b0", "#f7eec2", "#fde3c8"), strict=True))
_STAGE_COLOURS = dict(
    zip(STAGES, ("#0072B2", "#56B4E9", "#CC79A7", "#D55E00", "#E69F00", "#009E73", "#999999"), strict=True)
)


def _shade_states(ax, results: Sequence[FrameResult]) -> None:
    for result in results:
        ax.axvspan(result.index - 0.5, result.index + 0.5, color=_STATE_COLOURS[result.state], zorder=0, linewidth=0)


def timeline(results: Sequence[FrameResult], *, bump_at: int | None = None) -> Figure:
    """What the pipeline knew, frame by frame: landmarks, drift statistic, distance of the tool to the surface."""
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
    axes[2].legend(loc="upper right", ncols=3)
    shown = {result.state for result in results}
    patches = [Patch(facecolor=_STATE_COLOURS[s], edgecolor="#cccccc", label=s) for s in _STATE_COLOURS if s in shown]
    page.legend(handles=patches, loc="outside lower center", ncols=3)
    return page


def stage_times(results: Sequence[FrameResult], *, paper_hz: float = 5.0) -> Figure:
    """Left: time of the stages of each frame, stacked, and the paper's; right: their medians where a stage ran.

    A frame that takes far longer than the others (the first, which warms up) is cut off and its time written beside it.
    """
    page, axes = figure(1, 2, width_in=12, height_in=4, width_ratios=[2.2, 1])
    index = np.array([result.index for result in results])
    below = np.zeros(len(results))
    for stage in STAGES:
        seconds = np.array([1e3 * result.seconds.get(stage, 0.0) for result in results])
        axes[0].bar(index, seconds, bottom=below, color=_STAGE_COLOURS[stage], width=0.85, label=stage)
        below += seconds
    top = 1.3 * max(float(np.quantile(below, 0.95)), 1e3 / paper_hz)
    axes[0].set_ylim(0, top)
    for i in np.flatnonzero(below > top):
        axes[0].text(index[i] + 0.6, 0.97 * top, f"{below[i] / 1e3:.1f} s", va="top", fontsize=8)
    axes[0].axhline(1e3 / paper_hz, color="black", linestyle=":", label=f"paper, {paper_hz:g} Hz")
    axes[0].set(xlabel="frame", ylabel="ms", title="Time of each frame, by stage")
    axes[0].legend(fontsize=8, ncols=2)
    medians = {
        stage: 1e3 * float(np.median([r.seconds[stage] for r in results if stage in r.seconds]))
        for stage in STAGES
        if any(stage in r.seconds for r in results)
    }
    axes[1].barh(list(medians), list(medians.values()), color=[_STAGE_COLOURS[stage] for stage in medians])
    for i, value in enumerate(medians.values()):
        axes[1].text(value, i, f" {value:.0f}" if value >= 10 else f" {value:.1f}", va="center")
    axes[1].set(xlim=(0, 1.3 * max(medians.values())), xlabel="ms", title="Median where it ran")
    axes[1].invert_yaxis()
    axes[1].grid(axis="y", visible=False)
    return page


def error_timeline(
    results: Sequence[FrameResult], errors_um: Mapping[str, np.ndarray], *, bump_at: int | None = None
) -> Figure:
    """Errors against the truth, frame by frame, on a logarithmic scale; NaN where there is none yet."""
    page, ax = figure(1, 1, width_in=12, height_in=3.6)
    _shade_states(ax, results)
    colours = (COLOURS["ours"], COLOURS["truth"], COLOURS["paper"], COLOURS["baseline"])
    for (name, error), colour in zip(errors_um.items(), colours, strict=False):
        ax.plot([result.index for result in results], error, color=colour, marker=".", label=name)
    if bump_at is not None:
        ax.axvline(bump_at - 0.5, color=COLOURS["warning"], linestyle="--", label="bump")
    if any(np.isfinite(error).any() for error in errors_um.values()):
        ax.set(yscale="log")
    ax.set(xlabel="frame", ylabel="um", title="Errors against the truth")
    ax.legend(ncols=4)
    return page


def dashboard(left: np.ndarray, result: FrameResult) -> Figure:
    """One frame: the left image with landmarks and matched points coloured by height, and the surface with the tool.

    Heights are along the view, towards the camera, above the lowest point.
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
    if result.reconstructed:
        u, points = result.reconstruction.u, result.reconstruction.points.x_mm
        shown = np.arange(0, len(u), max(1, len(u) // 1500))
        h = bottom - (points[shown] - centre) @ view[2]
        dots = axes[0].scatter(*u[shown].T, c=h, s=3, vmin=0, vmax=np.nanmax(height), cmap="viridis")
        page.colorbar(dots, ax=axes[0], label="height in mm", shrink=0.8)
    axes[1].remove()
    # Drawn in the order given: by its own depth order matplotlib hides the tool behind the surface that it is above.
    scene = page.add_subplot(axes[1].get_subplotspec(), projection="3d", computed_zorder=False)
    scene.plot_surface(seen[..., 0], -seen[..., 1], height, cmap="viridis", linewidth=0, antialiased=True, alpha=0.9)
    tool = np.where(np.isfinite(result.landmarks.x_mm), result.landmarks.x_mm, result.x_tool_mm)
    tool = (tool - centre) @ view.T
    tool = np.column_stack([tool[:, 0], -tool[:, 1], bottom - tool[:, 2]])
    for tip in (1, 2):
        scene.plot(*tool[[0, tip]].T, color="black", linewidth=2)
    for name, point in zip(LANDMARK_COLOURS, tool, strict=True):
        scene.scatter(*point, color=LANDMARK_COLOURS[name], edgecolor="black", s=25)
    scene.set(xlabel="x in mm", ylabel="y in mm", zlabel="height")
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


def frame_browser(frames: Sequence[StereoFrame], results: Sequence[FrameResult], *, start: int = 0) -> VBox:
    """A slider over the frames with their dashboards; without a browser it shows `start`."""
    slider = IntSlider(value=start, min=0, max=len(results) - 1, continuous_update=False)
    return explore(lambda frame: dashboard(frames[frame].left, results[frame]), frame=slider)
