"""Figures of notebook 04: matching, epipolar geometry, triangulation, surfaces and their errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import matplotlib.pyplot as plt
import numpy as np
import torch
from IPython.display import HTML
from ipywidgets import SelectionSlider, VBox
from matplotlib.axes import Axes
from matplotlib.colors import LightSource, LogNorm, PowerNorm
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import LogLocator
from scipy.ndimage import label
from scipy.spatial import KDTree

from lib.cameras import StereoRig
from lib.matching import Matches
from lib.matching.deepmatching import correlation_maps, unit_patches, unit_windows
from lib.matching.descriptors import PATCH
from lib.surface import BSplineSurface, Mesh, ToolDistance
from lib.workbench.results import Table
from notebooks.figures.detector_records import recorded as when
from notebooks.figures.detector_records import weights
from notebooks.figures.interactive import explore
from notebooks.figures.style import COLOURS, LANDMARK_COLOURS, ON_IMAGE, figure, show_image, table
from notebooks.studies.matching_evaluation import DisparityScore

if TYPE_CHECKING:
    import plotly.graph_objects as go

    from notebooks.studies.surface_evaluation import Case

_SIGNED = "RdBu_r"
_ERROR = "magma"


def stereo_pair(left: np.ndarray, right: np.ndarray, u_tool: tuple[np.ndarray, np.ndarray]) -> Figure:
    """The stereo pair with the landmarks of the tool, (3, 2) px in each image, NaN = missing."""
    page, axes = figure(1, 2, width_in=13, height_in=3.9)
    for ax, image, u, side in zip(axes, (left, right), u_tool, ("Left", "Right"), strict=True):
        show_image(ax, image, side)
        for (name, colour), point in zip(LANDMARK_COLOURS.items(), u, strict=True):
            ax.plot(*point, "o", color=colour, markeredgecolor="black", label=name)
        ax.legend(loc="upper right", fontsize=8, **ON_IMAGE)
    return page


def descriptor_channels(image: np.ndarray, channels: np.ndarray) -> Figure:
    """An image and its pixel descriptors (h, w, c) of DeepMatching, one panel for each gradient direction."""
    page, axes = figure(3, 3, width_in=11, height_in=6.9)
    limit = float(np.quantile(channels[..., :8], 0.999))
    where = ("upper left", "top", "upper right", "left", "right", "lower left", "bottom", "lower right")
    for ax, name, channel in zip(np.delete(axes.ravel(), 4), where, (5, 6, 7, 4, 0, 3, 2, 1), strict=True):
        show_image(ax, channels[..., channel], f"brighter to the {name}")
        ax.images[0].set(cmap="magma_r", clim=(0, limit))
    show_image(axes[1, 1], image, "the image")
    page.colorbar(axes[0, 0].images[0], ax=axes, label="strength", shrink=0.5, aspect=30)
    return page


@dataclass(frozen=True, eq=False)
class ResponseMap:
    """Response of one patch of the left image at all places of the right one, at one level of the pyramid.

    `centre_px` (2,) and `size_px` describe the left patch.  `response` (h, w) at [y, x] belongs to the right pixel
    (x, y) * stride_px - 1/2.
    """

    centre_px: np.ndarray
    size_px: int
    response: np.ndarray
    stride_px: int

    @property
    def peak_px(self) -> np.ndarray:
        """Right pixel (2,) of the largest response."""
        y, x = np.unravel_index(np.argmax(self.response), self.response.shape)
        return np.array([x, y]) * self.stride_px - 0.5

    @property
    def extent_px(self) -> tuple[float, float, float, float]:
        """(left, right, bottom, top) px of the map in the right image, for imshow."""
        height, width = self.response.shape
        half = self.stride_px / 2
        return (-0.5 - half, width * self.stride_px - 0.5 - half, height * self.stride_px - 0.5 - half, -0.5 - half)


def response_map(
    responses: torch.Tensor, level: int, u_left: np.ndarray, *, cell_px: int = 2, stride_px: int | None = None
) -> ResponseMap:
    """The response map of the patch nearest to the left pixel u_left (2,), from the responses (gy, gx, h, w) of one level.

    `stride_px` is the distance of neighbouring places; None means that of an unpooled map.  Atomic patches tile the image.
    The centres of larger patches lie on the corners of atomic ones.
    """
    width = PATCH * cell_px
    at = (u_left + 0.5) / width - (0.5 if level == 0 else 0.0)
    x, y = np.clip(np.rint(at).astype(int), 0, np.array(responses.shape[1::-1]) - 1)
    centre = (np.array([x, y]) + (0.5 if level == 0 else 0.0)) * width - 0.5
    return ResponseMap(centre, width << level, responses[y, x].numpy(), stride_px or cell_px << level)


def response_pyramid(left: np.ndarray, right: np.ndarray, maps: list[ResponseMap]) -> Figure:
    """One patch of the left image at growing sizes, and below each its response at all places of the right image."""
    page, axes = figure(2, len(maps), width_in=3.2 * len(maps), height_in=4.4)
    for (top, bottom), level in zip(axes.T, maps, strict=True):
        show_image(top, left, f"{level.size_px} px patch")
        corner = level.centre_px - level.size_px / 2
        for colour, line_width in (("black", 3.5), ("white", 1.8)):
            box = Rectangle(corner, level.size_px, level.size_px, fill=False, color=colour, lw=line_width, clip_on=False)
            top.add_patch(box)
        show_image(bottom, np.full_like(right, 255))
        x0, x1, y1, y0 = level.extent_px
        # Subtract the median: the background of a correlation map is high, and the peak matters.
        shown = np.clip((level.response - np.median(level.response)) / np.ptp(level.response), 0, 1)
        bottom.imshow(shown, extent=(x0, x1, y1, y0), cmap="magma_r", norm=PowerNorm(0.8))
        regions, share = _high(level.response)
        bottom.plot(*level.peak_px, "o", mfc="none", mec=COLOURS["ours"], markersize=13, markeredgewidth=2)
        bottom.set_title(f"{regions} regions, {100 * share:.2g} % of the places,\nabove 80 % of the peak", fontsize=9)
        bottom.set(xlim=(-0.5, right.shape[1] - 0.5), ylim=(right.shape[0] - 0.5, -0.5))
    return page


def _high(response: np.ndarray) -> tuple[int, float]:
    """Number of separate regions of a response map above 80 % of its peak, and their share of its places."""
    high = response > 0.8 * response.max()
    _, regions = label(high, structure=np.ones((3, 3)))
    return regions, float(high.mean())


def neighbourhood(left: np.ndarray, right: np.ndarray, alone: ResponseMap, judged: ResponseMap) -> Figure:
    """A patch of the left image, and the places in the right one that fit it alone and with its neighbourhood."""
    page, axes = figure(1, 3, width_in=11, height_in=2.9)
    show_image(axes[0], left, f"Left: one {alone.size_px} px patch")
    corner = alone.centre_px - alone.size_px / 2
    axes[0].add_patch(Rectangle(corner, alone.size_px, alone.size_px, fill=False, color="white", lw=2))
    for ax, one, name in zip(axes[1:], (alone, judged), ("alone", "with its neighbourhood"), strict=True):
        show_image(ax, 0.5 * _grey(right) + 110)
        ax.images[0].set_clim(0, 255)
        share = one.response / one.response.max()
        y, x = np.nonzero(share > 0.5)
        order = np.argsort(share[y, x])
        u = np.stack([x, y])[:, order] * one.stride_px - 0.5
        dots = ax.scatter(*u, c=share[y, x][order], s=14, marker="s", cmap="magma_r", vmin=0.5, vmax=1, linewidths=0)
        ax.plot(*one.peak_px, "o", markersize=13, markerfacecolor="none", markeredgecolor=COLOURS["ours"], markeredgewidth=2)
        ax.set_title(f"Right, {name}: {int((share > 0.8).sum())} places")
    page.colorbar(dots, ax=axes[1:].tolist(), label="response / peak", shrink=0.8)
    return page


def match_fields(left: np.ndarray, fields: dict[str, Matches], *, direction: np.ndarray | None = None) -> Figure:
    """Matches on the left image, coloured by their displacement along `direction` (2,); None means the x axis."""
    direction = np.array([1.0, 0.0]) if direction is None else direction
    shifts = {name: (m.u_right - m.u_left) @ direction for name, m in fields.items()}
    low, high = np.percentile(np.concatenate(list(shifts.values())), (3, 97))
    page, axes = figure(1, len(fields), width_in=5.6 * len(fields), height_in=3.1, squeeze=False)
    for ax, (name, matches) in zip(axes[0], fields.items(), strict=True):
        show_image(ax, _grey(left), f"{name}: {len(matches)} matches")
        size = 12 * max(1.0, 2000 / max(len(matches), 1)) ** 0.5
        dots = ax.scatter(*matches.u_left.T, c=shifts[name], s=min(size, 30), vmin=low, vmax=high, linewidths=0)
    page.colorbar(dots, ax=axes[0].tolist(), label="displacement (px)", shrink=0.8)
    return page


def epipolar_geometry(
    left: np.ndarray, right: np.ndarray, rig: StereoRig, u_left: np.ndarray, distance_px: np.ndarray, kept: np.ndarray
) -> Figure:
    """Left points (k, 2) px, their epipolar lines in the right image; distances (n,) px of matches, `kept` (n,) or not."""
    height, width = right.shape[:2]
    page = plt.figure(figsize=(12, 6.6 * height / width + 2.9), layout="constrained")
    panels = page.subplot_mosaic([["left", "right"], ["filter", "filter"]], height_ratios=(6 * height / width, 2.4))
    for name, image, title in (("left", left, "Left: points"), ("right", right, "Right: their epipolar lines are parallel")):
        show_image(panels[name], image, title)
        panels[name].set(xlim=(-0.5, image.shape[1] - 0.5), ylim=(image.shape[0] - 0.5, -0.5))
    dark = {"facecolor": "black", "alpha": 0.55, "edgecolor": "none", "pad": 1.5}
    for k, point in enumerate(u_left):
        colour = ("white", "cyan", "yellow")[k % 3]  # neighbours differ; all are legible on a retina
        panels["left"].plot(*point, "o", color=colour, markeredgecolor="black", markersize=8)
        a, b, c = rig.fundamental @ [*point, 1.0]
        x = np.array([0.0, width - 1.0])
        panels["right"].plot(x, -(a * x + c) / b, color=colour, lw=1.6)
        beside = (point[0], -(a * point[0] + c) / b)  # not at the border, where the numbers would overlap
        for side, place, apart in (("left", point, (6, 4)), ("right", beside, (0, 3))):
            panels[side].annotate(f"{k + 1}", place, apart, textcoords="offset points", color=colour, fontsize=9, bbox=dark)
    span = float(np.abs(distance_px).max()) + 1e-6
    panels["filter"].hist(
        [distance_px[kept], distance_px[~kept]],
        bins=np.linspace(-span, span, 82),
        stacked=True,
        color=[COLOURS["ours"], COLOURS["warning"]],
        label=[f"kept: {kept.mean():.0%}", "dropped: beyond two of their standard deviations"],
    )
    panels["filter"].set(xlabel="distance of a match from its line (px)", ylabel="matches", yscale="log")
    panels["filter"].set_title("Epipolar filter")
    panels["filter"].legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, fontsize=9)
    return page


def point_errors(errors_mm: dict[str, np.ndarray], sigma_um: dict[str, float]) -> Figure:
    """Histograms of the errors of triangulated points along named directions, and the predicted standard deviations."""
    page, axes = figure(1, len(errors_mm), width_in=5.2 * len(errors_mm), height_in=3.0)
    for ax, (name, error) in zip(axes, errors_mm.items(), strict=True):
        error = error[np.isfinite(error)] * 1000
        spread = 1.4826 * np.median(np.abs(error - np.median(error)))
        span = 8 * max(sigma_um[name], spread)
        bins = np.linspace(-span, span, 91)
        density = ax.hist(np.clip(error, -span, span), bins=bins, density=True, color=COLOURS["ours"])[0]
        x = np.linspace(-span, span, 400)
        gauss = np.exp(-0.5 * (x / sigma_um[name]) ** 2) / (sigma_um[name] * np.sqrt(2 * np.pi))
        ax.plot(x, gauss, color=COLOURS["paper"], label=f"predicted sigma {sigma_um[name]:.1f} um")
        ax.set(xlabel="error (um)", title=f"{name}: robust sigma {spread:.1f} um", yscale="log")
        ax.set_ylim(2e-3 / span, 3 * max(density.max(), gauss.max()))
        ax.legend(loc="upper left", fontsize=9)
    axes[0].set_ylabel("density per um")
    return page


def profiles(
    position_mm: np.ndarray,
    points: tuple[np.ndarray, np.ndarray],
    curves: dict[str, tuple[np.ndarray, str]],
    *,
    title: str = "",
) -> Figure:
    """A section relative to a reference: points near it, and named curves (um behind the reference, colour)."""
    page, ax = figure(width_in=9, height_in=3.6)
    _section(ax, position_mm, points, curves)
    ax.set(ylabel="depth behind the reference (um)", title=title)
    page.legend(loc="outside lower center", fontsize=9, ncols=4)
    return page


def _section(
    ax: Axes, position_mm: np.ndarray, points: tuple[np.ndarray, np.ndarray], curves: dict[str, tuple[np.ndarray, str]]
) -> None:
    for name, (depth, colour) in curves.items():
        ax.plot(position_mm, depth, color=COLOURS[colour], label=name, lw=2.6 if colour == "truth" else 1.6)
    depths = np.concatenate([depth for depth, _ in curves.values()])
    margin = 0.25 * np.ptp(depths[np.isfinite(depths)])
    near, far = np.nanmin(depths) - margin, np.nanmax(depths) + margin
    x, beyond = points
    ax.plot(x, np.where((beyond >= near) & (beyond <= far), beyond, np.nan), ".", color=COLOURS["baseline"], markersize=3,
            alpha=0.6, label="triangulated points")  # fmt: skip
    for outside, border, marker in ((beyond < near, near, "^"), (beyond > far, far, "v")):
        label = "points outside the figure" if marker == "^" or not (beyond < near).any() else None
        if outside.any():
            ax.plot(x[outside], np.full(outside.sum(), border), marker, color=COLOURS["baseline"], markersize=4,
                    alpha=0.6, clip_on=False, label=label)  # fmt: skip
    ax.set(xlabel="along the image row (mm)", ylim=(far, near))


def held_out_curve(
    held_out: np.ndarray, chosen: float, smoothness: np.ndarray | None = None, error_um: np.ndarray | None = None
) -> Figure:
    """Held-out errors of the candidates (m, 2) in percent above the smallest, the choice, and the true errors if known."""
    page, ax = figure(width_in=7, height_in=3.4)
    excess = (held_out[:, 1] / held_out[:, 1].min() - 1) * 100
    side = "" if error_um is None else " (left axis)"
    ax.plot(held_out[:, 0], excess, "o-", color=COLOURS["ours"], label=f"held-out error{side}")
    ax.axvline(chosen, color=COLOURS["ours"], ls=":", label="chosen")
    ax.set(xscale="log", xlabel="smoothness mu (px²/mm)", ylabel="held-out error above the least (%)")
    ax.set_yscale("symlog", linthresh=0.1)
    ax.set_ylim(-0.02, 3 * excess.max() + 0.1)
    ax.yaxis.set_major_formatter("{x:g}")
    if error_um is not None:
        true = ax.twinx()
        true.plot(smoothness, error_um, "s--", color=COLOURS["truth"], label="true surface error (right axis)")
        true.set(ylabel="RMS surface error (um)", yscale="log")
        true.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        true.yaxis.set_major_formatter("{x:g}")
        true.yaxis.set_minor_formatter("")
        true.grid(False)
        true.spines["right"].set_visible(True)
        handles = ax.get_legend_handles_labels()[0] + true.get_legend_handles_labels()[0]
        page.legend(handles=handles, fontsize=8, loc="outside lower center", ncols=3)
    else:
        ax.legend(fontsize=8)
    return page


def smoothness_slider(
    smoothness: np.ndarray,
    depths_mm: list[np.ndarray],
    position_mm: np.ndarray,
    points: tuple[np.ndarray, np.ndarray],
    reference: dict[str, tuple[np.ndarray, str]],
) -> VBox:
    """A slider over sections through surfaces of increasing smoothness."""

    def draw(mu: int) -> Figure:
        """A section through the surface at one smoothness, with the points."""
        page, ax = figure(width_in=11, height_in=3.4)
        _relative_section(ax, mu, depths_mm, position_mm, points, reference)
        ax.set(title=f"mu = {smoothness[mu]:.2g} px²/mm", ylabel="depth behind a smooth bowl (um)")
        ax.legend(loc="upper right", fontsize=8, ncols=3)
        return page

    labels = [(f"{mu:.1e}", k) for k, mu in enumerate(smoothness)]
    return explore(draw, mu=SelectionSlider(options=labels, value=len(labels) // 2))


def smoothness_sections(
    smoothness: np.ndarray,
    depths_mm: list[np.ndarray],
    position_mm: np.ndarray,
    points: tuple[np.ndarray, np.ndarray],
    reference: dict[str, tuple[np.ndarray, str]],
) -> Figure:
    """Sections through three of the surfaces: the roughest, the middle one, the smoothest."""
    page, axes = figure(1, 3, width_in=14, height_in=3.4, sharey=True)
    for ax, step in zip(axes, (0, len(smoothness) // 2, -1), strict=True):
        _relative_section(ax, step, depths_mm, position_mm, points, reference)
        ax.set_title(f"mu = {smoothness[step]:.2g} px²/mm")
    axes[0].set_ylabel("depth behind a smooth bowl (um)")
    page.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", fontsize=8, ncols=3)
    return page


def _relative_section(
    ax: Axes,
    step: int,
    depths_mm: list[np.ndarray],
    position_mm: np.ndarray,
    points: tuple[np.ndarray, np.ndarray],
    reference: dict[str, tuple[np.ndarray, str]],
    limit_um: float = 120.0,
) -> None:
    """A section minus a polynomial fitted to the middle surface, since a bowl of millimetres would hide micrometres."""
    bowl = np.polynomial.Polynomial.fit(position_mm, depths_mm[len(depths_mm) // 2], 6)
    apart = 1e3 * (points[1] - bowl(points[0]))
    ax.plot(points[0], apart, ".", color=COLOURS["baseline"], markersize=3, alpha=0.6, label="triangulated points")
    for name, (depth, colour) in (reference | {"surface": (depths_mm[step], "ours")}).items():
        width = 2.6 if colour == "truth" else 1.6
        ax.plot(position_mm, 1e3 * (depth - bowl(position_mm)), color=COLOURS[colour], label=name, lw=width)
    ax.set(xlabel="along the image row (mm)", ylim=(limit_um, -limit_um))


def score_table(
    scores: dict[str, dict[str, tuple[Matches, DisparityScore, float]]], caption: str
) -> HTML:
    """Matchers on real pairs: number of matches, median error, shares of errors above 1 and 2 px, seconds."""
    header = ["pair", "method", "matches", "median (px)", "> 1 px", "> 2 px", "seconds"]
    rows = [
        [pair, method, f"{len(m)}", f"{s.median_px:.3f}", f"{s.above_1:.1%}", f"{s.above_2:.1%}", f"{seconds:.2f}"]
        for pair, found in scores.items()
        for method, (m, s, seconds) in found.items()
    ]
    return table(header, rows, caption)


def error_maps(maps_um: dict[str, np.ndarray], *, limit_um: float | None = None, signed: bool = True) -> Figure:
    """Maps (h, w) of errors over the image, NaN where unknown, on the same colour scale.

    The scale ends at `limit_um`; None = at the 98th percentile of all errors.  The colour bar states its end.
    """
    if limit_um is None:
        limit_um = float(np.nanpercentile(np.abs(np.concatenate([m.ravel() for m in maps_um.values()])), 98))
    page, axes = figure(1, len(maps_um), width_in=4.6 * len(maps_um), height_in=2.9, squeeze=False)
    for ax, (name, values) in zip(axes[0], maps_um.items(), strict=True):
        rms = np.sqrt(np.nanmean(values**2))
        show_image(ax, values, f"{name}: {rms:.1f} um RMS")
        ax.images[0].set(cmap=_SIGNED if signed else _ERROR, clim=(-limit_um if signed else 0, limit_um))
        ax.set_facecolor("#dddddd")
    ends = f"depth error (um), colours end at ±{limit_um:.2g}" if signed else f"error (um), colours end at {limit_um:.2g}"
    page.colorbar(axes[0][-1].images[0], ax=axes[0].tolist(), label=ends, extend="both" if signed else "max", shrink=0.85)
    return page


def predicted_error(sigma_um: np.ndarray, error_um: np.ndarray | None = None) -> Figure:
    """Map (h, w) of the predicted standard deviation of the depth, and the RMS of the true errors against it."""
    page, axes = figure(1, 2 if error_um is not None else 1, width_in=10, height_in=3.4, squeeze=False)
    show_image(axes[0, 0], sigma_um, "Predicted standard deviation (um)")
    axes[0, 0].images[0].set(cmap=_ERROR, clim=(0, float(np.nanpercentile(sigma_um, 99))))
    axes[0, 0].set_facecolor("#dddddd")
    page.colorbar(axes[0, 0].images[0], ax=axes[0, 0], label="um", shrink=0.8)
    if error_um is None:
        return page
    known = np.isfinite(sigma_um) & np.isfinite(error_um)
    sigma, error = sigma_um[known], error_um[known]
    groups = np.array_split(np.argsort(sigma), min(8, max(1, len(sigma) // 20)))
    x, rms = ([np.sqrt(np.mean(v[group] ** 2)) for group in groups] for v in (sigma, error))
    axes[0, 1].plot(x, rms, "o-", color=COLOURS["ours"], label=f"RMS of {len(groups[0])} places each")
    end = 1.1 * max(*x, *rms)
    axes[0, 1].plot([0, end], [0, end], color=COLOURS["baseline"], ls="--", label="as predicted")
    axes[0, 1].set(xlabel="predicted standard deviation (um)", ylabel="true depth error, RMS (um)", xlim=(0, 1.1 * max(x)))
    axes[0, 1].set(title="Predicted and true error", ylim=(0, end))
    axes[0, 1].legend(fontsize=9)
    return page


def mesh_still(axes: Axes, surface_mm: np.ndarray, image: np.ndarray, *, zoom: float = 1.12) -> Axes:
    """Draw the surface (h, w, 3) mm, textured with the image (h, w, 3), on 3D axes; depth is enlarged twice."""
    light = LightSource(azdeg=300, altdeg=50)
    x, y, z = np.moveaxis(surface_mm, 2, 0)
    shade = light.hillshade(np.nan_to_num(-z, nan=np.nanmean(-z)), vert_exag=3)[..., None]
    skin = np.clip(image / 255 * (0.55 + 0.6 * shade), 0, 1)
    axes.plot_surface(x, y, z, facecolors=skin, rstride=1, cstride=1, shade=False, antialiased=False)
    size = [np.nanmax(v) - np.nanmin(v) for v in (x, y, z)]
    axes.set_box_aspect((size[0], size[1], 2 * size[2]), zoom=zoom)
    axes.set(xlabel="x (mm)", ylabel="y (mm)", zlabel="depth (mm)")
    axes.invert_zaxis()
    axes.invert_yaxis()
    axes.view_init(elev=42, azim=-70)
    axes.tick_params(labelsize=7, pad=-1)
    return axes


def reconstruction(
    image: np.ndarray, surface: BSplineSurface, rig: StereoRig, *, mask: np.ndarray | None = None
) -> Figure:
    """The left image with lines of equal depth, and an oblique view of the surface.

    The surface is not drawn where `mask` (h, w) is True.
    """
    page = plt.figure(figsize=(14, 4.4), layout="constrained")
    left, right = page.add_subplot(1, 2, 1), page.add_subplot(1, 2, 2, projection="3d")
    step_mm = _surface_views(left, right, image, surface, rig, mask)
    left.set_title(f"Lines of equal depth, every {step_mm:g} mm")
    right.set_title("The surface, depth enlarged twice")
    return page


def _surface_views(
    flat: Axes,
    oblique: Axes,
    image: np.ndarray,
    surface: BSplineSurface,
    rig: StereoRig,
    mask: np.ndarray | None = None,
    *,
    zoom: float = 1.12,
    every: int = 1,
) -> float:
    """Draw lines of equal depth on the image, and `every` n-th point of the surface; return the lines' spacing in mm."""
    h, w = image.shape[:2]
    step = max(1, w // 128)
    y, x = np.arange(0, h, step), np.arange(0, w, step)
    axes_mm = np.stack([*_across(rig), rig.left.viewing_direction])
    points = surface.on_grid(x, y) @ axes_mm.T
    points -= np.nanmean(points, axis=(0, 1))
    if mask is not None:
        points[mask[np.ix_(y, x)]] = np.nan
    depth = points[..., 2]
    step_mm = 0.1 if np.nanmax(depth) - np.nanmin(depth) < 2.5 else 0.2
    levels = np.arange(np.floor(np.nanmin(depth) / step_mm), np.nanmax(depth) / step_mm + 1) * step_mm
    show_image(flat, image)
    flat.contour(x, y, np.ma.masked_invalid(depth), levels=levels, cmap="viridis_r", linewidths=1.1)
    mesh_still(oblique, points[::every, ::every], image[np.ix_(y[::every], x[::every])], zoom=zoom)
    return step_mm


def cases(found: Sequence[Case], *, limit_um: float = 60.0) -> Figure:
    """A row for each simulated scene: the left image, the surface as lines and in 3D, the error along the view.

    If the scene is an eye, the last panel shows the error of the sphere prior.
    """
    with_sphere = any(one.sphere_error_mm is not None for one in found)
    columns = 5 if with_sphere else 4
    page = plt.figure(figsize=(3.7 * columns, 2.55 * len(found)), layout="constrained")
    maps: dict[str, list[Axes]] = {"surface": [], "sphere prior": []}
    spheres = [1e3 * one.sphere_error_mm[one.seen] for one in found if one.sphere_error_mm is not None]
    wide_um = 50 * np.ceil(max((np.nanquantile(np.abs(off), 0.98) for off in spheres), default=limit_um) / 50)
    limits_um = {"surface": limit_um, "sphere prior": wide_um}
    for row, one in enumerate(found):
        axes = [
            page.add_subplot(len(found), columns, row * columns + k + 1, projection="3d" if k == 2 else None)
            for k in range(columns)
        ]
        pair, view = one.pair, one.pair.rig.left.viewing_direction
        show_image(axes[0], pair.left, f"{pair.name}: left image")
        step_mm = _surface_views(axes[1], axes[2], pair.left, one.found.surface, pair.rig, zoom=1.25, every=2)
        axes[2].set(xlabel="", ylabel="", zlabel="", xticklabels=[], yticklabels=[], zticklabels=[])
        axes[2].set_title("Depth enlarged twice", y=0.98)
        axes[1].set_title(f"Lines of equal depth, every {step_mm:g} mm")
        for ax, error, rms, name in zip(
            axes[3:],
            (one.error_mm, one.sphere_error_mm),
            (one.rms_um, one.sphere_rms_um),
            ("surface", "sphere prior"),
            strict=False,
        ):
            if error is None:
                continue
            show_image(ax, np.where(one.seen, 1e3 * error @ view, np.nan), f"{name}: {rms:.1f} um RMS")
            ax.images[0].set(cmap=_SIGNED, clim=(-limits_um[name], limits_um[name]))
            ax.set_facecolor("#dddddd")
            maps[name].append(ax)
    for name, panels in maps.items():
        if panels:
            page.colorbar(panels[0].images[0], ax=panels, label=f"depth error (um), {name}", shrink=0.8)
    return page


def sparsification(curves: dict[str, dict[str, tuple[float, np.ndarray]]], kept: np.ndarray) -> Figure:
    """Share of wrong matches among the share `kept` (k,) of the most confident ones, for each set and confidence."""
    page, axes = figure(1, len(curves), width_in=4.6 * len(curves), height_in=3.3, squeeze=False)
    colours = {"score": "ours", "peak_ratio": "warning", "reciprocal": "truth"}
    for ax, (name, measures) in zip(axes[0], curves.items(), strict=True):
        for measure, (auc, share) in measures.items():
            label = f"{measure.replace('_', ' ')} (AUC {auc:.2f})"
            ax.plot(100 * kept, 100 * share, color=COLOURS[colours[measure]], label=label)
        nothing, highest = 100 * next(iter(measures.values()))[1][-1], max(share.max() for _, share in measures.values())
        ax.axhline(nothing, color=COLOURS["baseline"], ls="--", label="all matches")
        ax.set(xlabel="most confident matches kept (%)", title=name, ylim=(0, 1.5 * max(nothing, 100 * highest)))
        ax.legend(fontsize=8, loc="upper right")
    axes[0, 0].set_ylabel("wrong by more than 2 px (%)")
    return page


def recorded_errors(recorded: Mapping[str, Table], caption: str) -> HTML:
    """Recorded surface errors with true cameras (`surfaces`) and with calibrated ones (`calibrated_surfaces`)."""
    def numbers(values) -> list[str]:
        return [f"{value:.1f}" if np.isfinite(value) else "" for value in values]

    tables = []
    if "surfaces" in recorded:
        columns = {"surface_rms_um": "20 x 20", "surface_fine_rms_um": "40 x 40", "surface_fast_rms_um": "fast"}
        columns |= {"sphere_rms_um": "sphere"}
        rows = [[e["scene"], *numbers(e.get(key, np.nan) for key in columns)] for e in recorded["surfaces"].rows]
        header = ["scene, true cameras", *(f"{name}, RMS (um)" for name in columns.values())]
        tables.append(table(header, rows, f"{when(recorded['surfaces'])}: {caption} True cameras.").data)
    rows = []
    calibrated = recorded.get("calibrated_surfaces")
    for name in ("true", "plain", "plain_refined", "recommended", "recommended_refined") if calibrated else ():
        for setting in ("quality", "fast"):
            found = calibrated.where(setting=setting).columns
            if f"{name}_robot_frame_um" in found:
                rms = (np.sqrt(np.mean(found[f"{name}_{key}_um"] ** 2)) for key in ("robot_frame", "rigid", "affine"))
                rows.append([f"{setting}: {name.replace('_', ', ')} cameras", *numbers(rms)])
    if rows:
        header = ["75 frames", "RMS (um)", "after a rigid map (um)", "after an affine map (um)"]
        made = f"{when(calibrated)} {weights(calibrated)}"
        tables.append(table(header, rows, f"{made}: {caption} Cameras calibrated from 75 detected frames.").data)
    return HTML("".join(tables))


def recorded_speeds(recorded: Mapping[str, Table], caption: str) -> HTML:
    """Recorded CPU seconds, wall seconds and errors of `l1_solver`, `reconstruction_speed` and `matching`.

    CPU seconds are also valid on a busy machine, wall seconds only on an idle one.
    """
    names = ("l1_solver", "reconstruction_speed", "matching")
    rows = [
        [
            f"Eq. 6, {e['control']:.0f} x {e['control']:.0f}, n = {e['n_points']:.0f}",
            f"{e['cpu_s']:.3f}",
            "",
            f"objective differs from CLARABEL's by {abs(e['relative_difference']):.0e}",
            f"CLARABEL {e['clarabel_cpu_s']:.2f} s, {e['clarabel_over_ours']:.0f} times ours",
        ]
        for e in (recorded["l1_solver"].rows if "l1_solver" in recorded else ())
    ]
    rows += [
        [
            f"full-HD pair, {e['setting']}, {'depth' if e['depth_only'] else 'three splines'}",
            f"{e['cpu_s']:.2f}",
            f"{e['total_s']:.2f}",
            f"{e['surface_rms_um']:.1f} um RMS",
            f"{e['points']:.0f} points; {e['match_s']:.2f} s to match, {e['surface_s']:.2f} s to fit",
        ]
        for e in (recorded["reconstruction_speed"].rows if "reconstruction_speed" in recorded else ())
    ]
    rows += [
        [
            f"{e['scene']}, {e['method']}, {e['width_px']:.0f} px",
            f"{e['cpu_s']:.2f}",
            f"{e['wall_s']:.2f}",
            f"median {e['all_median_px']:.2f} px, {e['all_above_2px_percent']:.1f} % above 2 px",
            f"{e['matches']:.0f} matches; where flat {e['flat_median_px']:.2f} px, {e['flat_above_2px_percent']:.1f} %",
        ]
        for e in (recorded["matching"].rows if "matching" in recorded else ())
        if e["width_px"] and np.isfinite(e.get("all_median_px", np.nan))
    ]
    dates = ", ".join(f"{name} {recorded[name].provenance['date']}" for name in names if name in recorded)
    return table(["measured", "CPU (s)", "wall (s)", "error", "details"], rows, f"{caption} ({dates or 'no record'})")


def tool_over_surface(
    image: np.ndarray, surface: BSplineSurface, rig: StereoRig, x_tool_mm: np.ndarray, distance: ToolDistance
) -> Figure:
    """The image with a line along the tool, and the heights of the landmarks (3, 3) mm above the surface along it."""
    page, (left, right) = figure(1, 2, width_in=11, height_in=3.8, width_ratios=(1, 1.3))
    u, mm_per_px = rig.left.project(x_tool_mm), 1 / np.linalg.norm(rig.left.linear[0])
    show_image(left, image, "Left image, and the line along the tool")
    known = np.isfinite(u).all(axis=1)
    if not known.any():
        return page
    tip = u[1:][known[1:]].mean(axis=0) if known[1:].any() else u[0]
    along = tip - u[0] if known[0] and known[1:].any() else np.array([1.0, 0.0])
    along = along / np.linalg.norm(along)
    reach = np.arange(-4.0, 4.01, 0.05) / mm_per_px
    line = tip + reach[:, None] * along
    line = line[surface.grid.inside(line)]
    left.plot(*line.T, color="white", lw=1, ls="--")
    along_mm = (line - tip) @ along * mm_per_px
    height_mm = -surface(line) @ rig.left.viewing_direction
    height_mm -= np.nanmin(height_mm)
    right.plot(along_mm, height_mm, color="#a4502c", lw=2, label="surface")
    right.fill_between(along_mm, height_mm, -0.3, color="#e9b08a", alpha=0.6, lw=0)
    ends = []
    for k, (name, colour) in enumerate(LANDMARK_COLOURS.items()):
        if not known[k]:
            continue
        far, place = distance.along_view_mm[k], (u[k] - tip) @ along * mm_per_px
        label = f"{name}: {1e3 * far:.0f} um above the surface" if np.isfinite(far) else f"{name}: outside the surface"
        left.plot(*u[k], "o", color=colour, markeredgecolor="black")
        # A landmark beside the line is drawn at its own height above the surface, added to that of the line.
        ground = np.interp(place, along_mm, height_mm)
        nudge = (0.0, -0.09, 0.09)[k]  # both tips are about equally far along the tool: draw them side by side
        right.plot([place + nudge] * 2, [ground, ground + far], color=colour, lw=3)
        right.plot(place + nudge, ground + far, "o", color=colour, markeredgecolor="black", zorder=3, label=label)
        ends.append((place + nudge, ground + far))
    for end in ends[1:] if known[0] else ():
        right.plot(*zip(ends[0], end, strict=True), color=COLOURS["baseline"], lw=1.2, zorder=1)
    right.set(xlabel="along the tool (mm)", ylabel="height (mm)", title="Distance of the tool from the surface")
    right.set_ylim(bottom=-0.3)
    right.legend(fontsize=9)
    return page


def case_table(found: Sequence[Case], caption: str) -> HTML:
    """Surface errors of simulated scenes, and of the sphere prior for eyes."""
    header = ["scene", "matches used", "surface RMS (um)", "depth RMS (um)", "sphere prior RMS (um)", "sphere / surface"]
    rows = []
    for one in found:
        depth = 1e3 * one.error_mm[one.seen] @ one.pair.rig.left.viewing_direction
        sphere = one.sphere_error_mm is not None
        rows.append(
            [
                one.pair.name,
                f"{one.found.surface.fit.inliers.sum()}",
                f"{one.rms_um:.1f}",
                f"{np.sqrt(np.nanmean(depth**2)):.1f}",
                f"{one.sphere_rms_um:.0f}" if sphere else "",
                f"{one.sphere_rms_um / one.rms_um:.0f}" if sphere else "",
            ]
        )
    return table(header, rows, caption)


def atomic_maps(left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    """Correlation (gy, gx, h + 1, w + 1) of every atomic patch of a grid (H, W, C) with every place of another (h, w, C)."""
    return correlation_maps(unit_patches(left), unit_windows(right))


def vertex_colours(mesh: Mesh) -> np.ndarray:
    """Colours (n, 3) uint8 of the vertices from the mesh's texture; grey without one."""
    if mesh.texture is None:
        return np.full((len(mesh.u), 3), 160, dtype=np.uint8)
    h, w = mesh.texture.shape[:2]
    x, y = np.clip(np.rint(mesh.u), 0, (w - 1, h - 1)).astype(int).T
    return mesh.texture[y, x]


def scene_view(
    mesh: Mesh, rig: StereoRig, x_tool_mm: np.ndarray, distance: ToolDistance, sd_um: float, *, height_px: int = 560
) -> go.Figure:
    """A plotly scene: surface, forceps (3, 3) mm, rays of both cameras, and the first tip's distance along the view."""
    import plotly.graph_objects as go

    colours = [f"rgb({r},{g},{b})" for r, g, b in vertex_colours(mesh).tolist()]
    i, j, k = mesh.faces.T
    x, y, z = np.round(mesh.vertices_mm, 3).T
    view = go.Figure(go.Mesh3d(x=x, y=y, z=z, i=i, j=j, k=k, vertexcolor=colours, flatshading=False, hoverinfo="x+y+z"))
    view.update_traces(lighting={"ambient": 0.65, "diffuse": 0.6, "specular": 0.05})

    def line(points: np.ndarray, name: str, colour: str, width: float, dash: str = "solid") -> None:
        style = {"color": colour, "width": width, "dash": dash}
        view.add_scatter3d(**dict(zip("xyz", points.T, strict=True)), mode="lines", name=name, line=style)

    if np.isfinite(x_tool_mm).all():
        base, *tips = x_tool_mm
        behind = base + 2.5 * (base - np.mean(tips, axis=0)) / np.linalg.norm(base - np.mean(tips, axis=0))
        line(np.array([behind, base]), "shaft", "#8a8f98", 16)
        for name, tip in zip(("tip_1", "tip_2"), tips, strict=True):
            line(np.array([base, tip]), f"jaw to {name}", LANDMARK_COLOURS[name], 9)
        for name, camera in (("left", rig.left), ("right", rig.right)):
            ray = tips[0] - np.array([[8.0], [0.0]]) * camera.viewing_direction
            line(ray, f"ray of the {name} camera", COLOURS[name], 3, "dash")
        if np.isfinite(distance.along_view_mm[1]):
            below = tips[0] + distance.along_view_mm[1] * rig.left.viewing_direction
            said = f"{1e3 * distance.along_view_mm[1]:.0f} um (sd {sd_um:.0f}) along the view"
            line(np.array([tips[0], below]), said, "#111111", 8)
    axes = {f"{axis}axis": {"title": f"{axis} (mm)", "nticks": 4 if axis == "z" else 6} for axis in "xyz"}
    up, (right, down) = -rig.left.viewing_direction, _across(rig)
    eye = 1.1 * up + 1.4 * down + 0.3 * right  # as if sitting in front of the image
    camera = {name: dict(zip("xyz", v.tolist(), strict=True)) for name, v in (("up", up), ("eye", eye))}
    view.update_layout(
        scene={"aspectmode": "data", "camera": camera, **axes}, margin={"l": 0, "r": 0, "t": 0, "b": 0},
        height=height_px, legend={"orientation": "h", "x": 0, "y": 0, "yanchor": "top"},  # below the scene, for small screens
    )  # fmt: skip
    return view


def growing(responses: Mapping[str, np.ndarray]) -> Figure:
    """Response maps of one patch at growing sizes, each divided by its peak."""
    page, axes = figure(1, len(responses), width_in=3.6 * len(responses), height_in=2.9)
    for ax, (name, response) in zip(axes, responses.items(), strict=True):
        regions, _ = _high(response)
        show_image(ax, response / response.max(), f"{name}: {regions} regions above 80 %")
        ax.images[0].set(cmap="magma_r", clim=(0, 1), interpolation="nearest")
        row, column = np.unravel_index(response.argmax(), response.shape)
        ax.plot(column, row, "o", mfc="none", mec=COLOURS["ours"], markersize=13, markeredgewidth=2)
    page.colorbar(axes[-1].images[0], ax=list(axes), label="response / peak", shrink=0.8)
    return page


def spline_1d(t: np.ndarray, data: np.ndarray, wrong: np.ndarray, curves: Mapping[str, np.ndarray]) -> Figure:
    """Data points over t, the wrong ones as crosses, and named curves."""
    page, ax = figure(width_in=8, height_in=3.4)
    ax.plot(t[~wrong], data[~wrong], ".", color=COLOURS["baseline"], label="points")
    ax.plot(t[wrong], data[wrong], "x", color=COLOURS["warning"], label="wrong points")
    for (name, curve), colour in zip(curves.items(), ("truth", "paper", "ours"), strict=True):
        ax.plot(t, curve, color=COLOURS[colour], label=name)
    ax.set(xlabel="t", ylabel="mm")
    ax.legend(ncols=2)
    return page


def epipolar_line(left: np.ndarray, right: np.ndarray, rig: StereoRig, pixel: np.ndarray, matches: Matches) -> Figure:
    """A pixel of the left image, its epipolar line in the right one with ticks every 500 um of depth, the nearest match."""
    n, e = rig.epipolar_normal, -rig.epipolar_normal @ rig.offset_px
    along = np.array([n[3], -n[2]]) / np.hypot(n[2], n[3])
    foot = -(n[:2] @ pixel + e) * n[2:] / (n[2:] @ n[2:])
    near = int(np.argmin(np.linalg.norm(matches.u_left - pixel, axis=1)))
    centre = foot + along * ((matches.u_right[near] - foot) @ along)
    step = np.linalg.norm(rig.right.linear @ rig.left.viewing_direction) / 2  # px for 500 um of depth
    page, axes = figure(1, 2, width_in=10, height_in=3.4)
    show_image(axes[0], left, "Left: the pixel")
    axes[0].plot(*pixel, "o", color="white", markeredgecolor="black", markersize=8)
    show_image(axes[1], right, "Right: its epipolar line near the match")
    ends = centre + np.array([[-400.0], [400.0]]) * along
    axes[1].plot(*ends.T, color="cyan", lw=1.2)
    ticks = centre + step * np.arange(-12, 13)[:, None] * along
    axes[1].plot(*ticks.T, "|", color="cyan", markersize=7)
    axes[1].plot(*matches.u_right[near], "o", color=COLOURS["warning"], markeredgecolor="black")
    axes[1].set(xlim=(centre[0] - 120, centre[0] + 120), ylim=(centre[1] + 70, centre[1] - 70))
    return page


def error_budget(rms_um: dict[str, float], *, highlight: str | None = None, paper_um: float | None = None) -> Figure:
    """RMS surface errors of variants of the pipeline, as bars."""
    page, ax = figure(width_in=9, height_in=0.42 * len(rms_um) + 1.1)
    names = list(rms_um)[::-1]
    values = [rms_um[name] for name in names]
    colours = [COLOURS["ours"] if name == highlight else COLOURS["baseline"] for name in names]
    bars = ax.barh(names, values, color=colours)
    ax.bar_label(bars, fmt="%.1f", padding=3, fontsize=9)
    if paper_um is not None:
        ax.axvline(paper_um, color=COLOURS["paper"], ls="--", label=f"paper, flat checkerboard: {paper_um:.1f} um")
        ax.legend(fontsize=8, loc="lower right")
    ax.set(xlabel="RMS surface error (um)", xscale="log", xlim=(0.7 * min(values), 1.6 * max(values)))
    ax.grid(axis="y", visible=False)
    return page


def disparity_errors(
    image: np.ndarray,
    truth_px: np.ndarray,
    errors_px: dict[str, tuple[np.ndarray, np.ndarray]],
    *,
    low_px: float = 0.1,
    limit_px: float = 4.0,
) -> Figure:
    """A real image, its measured disparity (h, w) px, and each matcher's errors (n,) px at its points (n, 2) px."""
    columns = (3 + len(errors_px)) // 2
    page, axes = figure(2, columns, width_in=4.3 * columns, height_in=5.6)
    panels = axes.ravel()
    show_image(panels[0], _grey(image), "Left image")
    show_image(panels[1], truth_px, "Measured disparity")
    panels[1].images[0].set_cmap("viridis")
    for ax, (name, (u, error)) in zip(panels[2:], errors_px.items(), strict=False):
        show_image(ax, np.full_like(_grey(image), 255), f"{name}: median {np.median(np.abs(error)):.2f} px")
        ax.images[0].set(cmap="gray", clim=(0, 255))
        # Squares as wide as the lattice's step, so that the map has holes only where nothing is scored.
        step_px = float(np.median(KDTree(u).query(u, k=2)[0][:, 1])) if len(u) > 1 else 1.0
        size_pt = 72 * 3.9 * step_px / image.shape[1]  # a panel is about 3.9 in wide
        errors = np.clip(np.abs(error), low_px, limit_px)
        colours = {"cmap": "YlGnBu", "norm": LogNorm(low_px, limit_px)}
        dots = ax.scatter(*u.T, c=errors, s=size_pt**2, marker="s", linewidths=0, **colours)
    for ax in panels[2 + len(errors_px) :]:
        ax.axis("off")
    bar = page.colorbar(dots, ax=panels.tolist(), label="|error| (px), logarithmic", shrink=0.75)
    ticks = [tick for tick in (0.1, 0.25, 0.5, 1, 2, 4) if low_px <= tick <= limit_px]
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.minorticks_off()
    return page


def _grey(image: np.ndarray) -> np.ndarray:
    return image if image.ndim == 2 else image.mean(axis=2)


def _across(rig: StereoRig) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (3,) orthogonal to the left view: to the right and down in the image."""
    camera = rig.left.resect()
    return camera.R[0], camera.R[1]
