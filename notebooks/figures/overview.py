"""Figures of notebook 00: the whole pipeline on one page."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator

from lib.online import FrameResult
from notebooks.figures.style import COLOURS, LANDMARK_COLOURS, ON_IMAGE, figure, show_image


def landmarks_on(axes: Axes, u: np.ndarray, *, label: bool = True) -> None:
    """Mark base, tip_1 and tip_2, u (3, 2) px, and draw the jaws between them.  Missing landmarks have no legend entry."""
    for tip in (1, 2):
        axes.plot(*u[[0, tip]].T, color="white", linewidth=1.0, alpha=0.8)
    for name, point in zip(LANDMARK_COLOURS, u, strict=True):
        if np.isfinite(point).all():
            axes.plot(*point, "o", color=LANDMARK_COLOURS[name], markersize=5, markeredgecolor="black", label=name)
    if label and axes.get_legend_handles_labels()[0]:
        axes.legend(loc="upper right", fontsize=8, **ON_IMAGE)


def frame_pair(left: np.ndarray, right: np.ndarray, u_left: np.ndarray, u_right: np.ndarray) -> Figure:
    """A stereo frame with its landmarks, (3, 2) px in each image."""
    page, axes = figure(1, 2, width_in=12, height_in=3.6)
    for ax, image, u, side in zip(axes, (left, right), (u_left, u_right), ("Left", "Right"), strict=True):
        show_image(ax, image, side)
        landmarks_on(ax, u, label=side == "Right")
    return page


def pixel_grid(domain: tuple[float, float, float, float], columns: int = 96) -> np.ndarray:
    """A grid of pixels (rows, columns, 2) over the domain (x0, y0, x1, y1); its cells are about square."""
    x0, y0, x1, y1 = domain
    rows = max(round(columns * (y1 - y0) / (x1 - x0)), 2)
    return np.stack(np.meshgrid(np.linspace(x0, x1, columns), np.linspace(y0, y1, rows)), axis=-1)


def pipeline_page(
    left: np.ndarray,
    u_left: np.ndarray,
    result: FrameResult,
    residuals_px: np.ndarray,
    surface_mm: np.ndarray,
    error_um: np.ndarray | None,
    registration_um: dict[str, tuple[np.ndarray, np.ndarray]],
) -> Figure:
    """Six panels: landmarks, calibration residuals, matches, the retina, its error or height, and the registration error.

    Parameters
    ----------
    left, u_left:
        A left image and its landmarks (3, 2) px.
    result:
        The online pipeline's result for this frame; it must have a reconstruction.
    residuals_px:
        Reprojection residuals (m, 4) of the calibration, left and right.
    surface_mm, error_um:
        Points (h, w, 3) mm of the surface over a `pixel_grid`, in the robot frame, and its error (h, w); None = no truth.
    registration_um:
        Method -> numbers of frames (k,) and translation errors (k,) in um; empty without a calibration of half the frames.
    """
    page = plt.figure(figsize=(13, 6.8), layout="constrained", facecolor="white")
    grid = page.add_gridspec(2, 3, height_ratios=(3, 4))
    title = {"loc": "left", "fontweight": "bold", "fontsize": 11}

    ax = show_image(page.add_subplot(grid[0, 0]), left)
    ax.set_title("1  Landmarks", **title)
    landmarks_on(ax, u_left)

    ax = page.add_subplot(grid[0, 1])
    for columns, side in ((slice(0, 2), "left"), (slice(2, 4), "right")):
        ax.plot(*residuals_px[:, columns].T, ".", color=COLOURS[side], markersize=4, alpha=0.6, label=side)
    radius = 1.1 * np.nanquantile(np.abs(residuals_px), 0.995)
    ax.set(xlim=(-radius, radius), ylim=(-radius, radius), xlabel="x, px", ylabel="y, px")
    ax.set_aspect("equal", adjustable="datalim")  # fills its place
    ax.legend(fontsize=8)
    ax.set_title("2  Calibration residuals", **title)

    ax = show_image(page.add_subplot(grid[0, 2]), left)
    ax.plot(*result.reconstruction.u.T, ".", color=COLOURS["truth"], markersize=1.0)
    ax.set(xlim=(0, left.shape[1]), ylim=(left.shape[0], 0))
    ax.set_title(f"3  {len(result.reconstruction.u)} matches", **title)

    ax = page.add_subplot(grid[1, 0], projection="3d")
    x, y, height = _upright(surface_mm, result.reconstruction.rig.left.resect().R)
    ax.plot_surface(x, y, height, cmap="viridis", linewidth=0, antialiased=True, rcount=60, ccount=60)
    ax.set_box_aspect((np.ptp(x), np.ptp(y), 2.5 * max(np.ptp(height), 0.2)))
    ax.view_init(elev=35, azim=-65)
    ax.set(xlabel="x (mm)", ylabel="y (mm)", zlabel="height (mm)")
    for axis in "yz":  # their ticks would overlap
        ax.locator_params(axis=axis, nbins=3)
    ax.set_title("4  The retina, heights x 2.5", **title)

    ax = page.add_subplot(grid[1, 1])
    if error_um is None:
        picture = ax.imshow(height, cmap="viridis", aspect="equal")
    else:
        limit = np.nanquantile(np.abs(error_um), 0.98)
        picture = ax.imshow(error_um, cmap="RdBu_r", vmin=-limit, vmax=limit, aspect="equal")
    page.colorbar(picture, ax=ax, shrink=0.7, label="height (mm)" if error_um is None else "um")
    ax.set(xticks=[], yticks=[])
    rms = "" if error_um is None else f", {np.sqrt(np.nanmean(error_um**2)):.0f} um RMS"
    ax.set_title(("5  Height" if error_um is None else "5  Error against the truth") + rms, **title)

    ax = page.add_subplot(grid[1, 2])
    ax.set_title("6  A moved microscope, registered", **title)
    for panel in page.axes[:3]:
        panel.set_anchor("NW")  # images and squares of one row begin at one height
    if not registration_um:
        ax.set_axis_off()
        ax.text(0.0, 0.9, "Left out: half of the frames\ndo not give a calibration.", va="top", transform=ax.transAxes)
        return page
    for (method, (frames, error)), colour in zip(
        registration_um.items(), (COLOURS["paper"], COLOURS["ours"]), strict=False
    ):
        ax.plot(frames, error, "o-", color=colour, label=method)
    ax.axhline(150, color=COLOURS["baseline"], linestyle="--", label="paper: below 150 um after 3 frames")
    ax.set(xlabel="frames of the tool", ylabel="translation error, um", yscale="log")
    ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter("")
    ax.grid(True, color="#e6e6e6", linewidth=0.6)
    ax.legend(fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(0, -0.16))  # outside, clear of curves
    return page


def _upright(surface_mm: np.ndarray, camera_from_robot: np.ndarray) -> np.ndarray:
    """Points (3, h, w) mm relative to the surface's mean: right and up in the image, and height towards the camera."""
    seen = (surface_mm - np.nanmean(surface_mm.reshape(-1, 3), axis=0)) @ camera_from_robot.T
    return np.moveaxis(seen * (1.0, -1.0, -1.0), -1, 0)
