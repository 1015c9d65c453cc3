"""Figures of notebook 00: the whole pipeline on one page."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lib.figures.style import COLOURS, LANDMARK_COLOURS, figure, show_image

__all__ = ["frame_pair", "landmarks_on", "pipeline_page"]


def landmarks_on(axes: Axes, u: np.ndarray, *, label: bool = True) -> None:
    """Mark base, tip_1 and tip_2, u (3, 2) px, and draw the jaws between them; missing landmarks are left out."""
    for tip in (1, 2):
        axes.plot(*u[[0, tip]].T, color="white", linewidth=1.0, alpha=0.8)
    for name, point in zip(LANDMARK_COLOURS, u, strict=True):
        axes.plot(*point, "o", color=LANDMARK_COLOURS[name], markersize=5, markeredgecolor="black", label=name)
    if label:
        axes.legend(loc="upper right", fontsize=8, labelcolor="white")


def frame_pair(left: np.ndarray, right: np.ndarray, u_left: np.ndarray, u_right: np.ndarray) -> Figure:
    """A stereo frame with its landmarks, (3, 2) px in each image."""
    page, axes = figure(1, 2, width_in=12, height_in=3.6)
    for ax, image, u, side in zip(axes, (left, right), (u_left, u_right), ("Left", "Right"), strict=True):
        show_image(ax, image, side)
        landmarks_on(ax, u, label=side == "Right")
    return page


def pipeline_page(
    left: np.ndarray,
    u_left: np.ndarray,
    matches_left: np.ndarray,
    inliers: np.ndarray,
    residuals_px: np.ndarray,
    surface_error_um: np.ndarray,
    surface_mm: np.ndarray,
    registration_um: dict[str, tuple[np.ndarray, np.ndarray]],
    seconds: dict[str, float],
) -> Figure:
    """Six panels, one a stage.

    Parameters
    ----------
    left, u_left:
        A left image and its landmarks (3, 2) px.
    matches_left, inliers:
        Matched points (n, 2) px of the left image, and which of them the surface kept.
    residuals_px:
        Reprojection residuals (m, 2) of the calibration.
    surface_error_um, surface_mm:
        (h, w) signed error of the reconstructed surface on a grid over the image, and its points (h, w, 3) mm.
    registration_um:
        For each method, frames used (k,) and translation error (k,) in um.
    seconds:
        Time of each stage.
    """
    page = plt.figure(figsize=(13, 7.2), layout="constrained", facecolor="white")
    grid = page.add_gridspec(2, 3)
    height, width = left.shape[:2]

    ax = show_image(page.add_subplot(grid[0, 0]), left, "1  Landmarks found in the image")
    landmarks_on(ax, u_left)

    ax = page.add_subplot(grid[0, 1])
    ax.plot(*residuals_px.T, ".", color=COLOURS["ours"], markersize=3, alpha=0.6)
    radius = 1.1 * np.nanquantile(np.abs(residuals_px), 0.995)
    ax.set(xlim=(-radius, radius), ylim=(-radius, radius), aspect="equal", xlabel="x, px", ylabel="y, px")
    ax.set_title("2  Calibration: reprojection residuals", loc="left", fontweight="bold", fontsize=11)

    ax = show_image(page.add_subplot(grid[0, 2]), left, "3  Semi-dense matches")
    ax.plot(*matches_left[inliers].T, ",", color=COLOURS["truth"])
    ax.plot(*matches_left[~inliers].T, ".", color=COLOURS["paper"], markersize=1.5)

    ax = page.add_subplot(grid[1, 0], projection="3d")
    centred = surface_mm - surface_mm.reshape(-1, 3).mean(axis=0)
    ax.plot_surface(*np.moveaxis(centred, -1, 0), cmap="viridis", linewidth=0, antialiased=True, rcount=60, ccount=60)
    ax.set_aspect("equal")
    ax.set(xlabel="mm", ylabel="mm", zlabel="mm")
    ax.set_title("4  Retina in the robot frame", loc="left", fontweight="bold", fontsize=11)

    ax = page.add_subplot(grid[1, 1])
    limit = np.nanquantile(np.abs(surface_error_um), 0.98)
    picture = ax.imshow(surface_error_um, cmap="RdBu", vmin=-limit, vmax=limit, extent=(0, width, height, 0))
    page.colorbar(picture, ax=ax, shrink=0.8, label="um")
    ax.set(xticks=[], yticks=[])
    ax.set_title("5  Its error against the truth", loc="left", fontweight="bold", fontsize=11)

    ax = page.add_subplot(grid[1, 2])
    for (method, (frames, error_um)), colour in zip(
        registration_um.items(), (COLOURS["paper"], COLOURS["ours"]), strict=False
    ):
        ax.plot(frames, error_um, "o-", color=colour, label=method)
    ax.axhline(150, color=COLOURS["baseline"], linestyle="--", label="paper: 150 um after 3 frames")
    ax.set(xlabel="frames", ylabel="translation error, um", yscale="log")
    ax.legend(fontsize=8)
    total = ", ".join(f"{stage} {value:.2f} s" for stage, value in seconds.items())
    ax.set_title("6  Registration of a moved microscope", loc="left", fontweight="bold", fontsize=11)
    page.supxlabel(total, fontsize=9, color="#555555")
    return page
