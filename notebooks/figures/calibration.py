"""Figures of notebook 03: calibration and its uncertainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from IPython.display import HTML
from matplotlib.axis import Axis
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, NullFormatter

from lib.calibration import Calibration, LandmarkOffsets, TimeOffset
from lib.geometry import RigidTransform
from lib.workbench.results import Table
from notebooks.figures.style import COLOURS, LANDMARK_COLOURS, ON_IMAGE, figure, show_image
from notebooks.figures.style import table as html_table
from notebooks.studies.camera_models import Comparison
from notebooks.studies.dvrk import RobotFrames, SphereFit

_WHITE = {"facecolor": "white", "edgecolor": "none", "pad": 0.5}


def correspondences(x_mm: np.ndarray, u_left: np.ndarray, u_right: np.ndarray, size_px: tuple[int, int]) -> Figure:
    """Robot positions (n, 3) mm in 3D and their detections (n, 2) px in both images, coloured by the robot's height z."""
    page = plt.figure(figsize=(12, 6.0), layout="constrained")
    grid = page.add_gridspec(2, 2, width_ratios=(1.35, 1))
    axes = page.add_subplot(grid[:, 0], projection="3d")
    heights = x_mm[:, 2]
    look = {"c": heights, "s": 12, "cmap": "plasma", "vmax": heights.max() + 0.2 * np.ptp(heights)}  # no pale yellow
    axes.scatter(*x_mm.T, **look)
    axes.set(xlabel="x (mm)", ylabel="y (mm)", zlabel="z (mm)")
    axes.set_title("Robot: positions of the landmarks", loc="left")
    axes.set_box_aspect(np.ptp(x_mm, axis=0), zoom=0.95)
    axes.locator_params(nbins=4)
    for i, (u, side) in enumerate(((u_left, "Left"), (u_right, "Right"))):
        flat = page.add_subplot(grid[i, 1])
        dots = flat.scatter(*u.T, **look)
        flat.set(xlim=(0, size_px[0]), ylim=(size_px[1], 0), aspect="equal", xlabel="x (px)" if i else "", ylabel="y (px)")
        flat.set_title(f"{side} image: detections")
    page.colorbar(dots, ax=page.axes, label="height z (mm)", shrink=0.7)
    return page


def _plain_log(axis: Axis, ticks: Sequence[float] | None = None) -> None:
    """Sets the ticks of a logarithmic axis to `ticks`, or to 1, 2, 5 times powers of ten, labelled without exponents."""
    axis.set_major_locator(FixedLocator(ticks) if ticks is not None else LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def noise_errors(table: Table) -> Figure:
    """Recorded errors against detector noise, affine and perspective (the paper's figure)."""
    page, axes = figure(1, 2, width_in=11, height_in=3.8)
    c = table.columns
    for ax, key, unit, title in (
        (axes[0], "exact_pixels_um", "um", "Triangulation error (3D RMS, exact pixels)"),
        (axes[1], "reprojection_px", "px", "Reprojection error (RMS)"),
    ):
        for model, name, colour in (("affine", "affine, joint", "ours"), ("perspective", "perspective DLT", "paper")):
            ax.plot(c["sigma_u_px"], c[f"{model}_{key}"], "o-", color=COLOURS[colour], label=name)
        ax.set(xlabel="detector noise (px per coordinate)", ylabel=unit, title=title, xscale="log", yscale="log")
        _plain_log(ax.xaxis, c["sigma_u_px"])
        _plain_log(ax.yaxis)
        ax.legend()
    return page


def when_affine_wins(table: Table) -> Figure:
    """Recorded ratios of the perspective DLT's error to the affine one, by four measures, against the number of rows."""
    measures = {
        "reprojection": "Reprojection, held out",
        "exact_pixels": "Triangulation, held-out exact pixels",
        "detections": "Triangulation, held-out detections",
        "fitted_detections": "Triangulation, the fitted detections",
    }
    page, axes = figure(1, 4, width_in=14, height_in=3.6, sharey=True)
    depths = sorted(set(table.columns["half_depth_mm"]), reverse=True)
    for ax, (key, title) in zip(axes, measures.items(), strict=True):
        for depth, colour in zip(depths, ("ours", "paper", "warning"), strict=False):
            c = table.where(half_depth_mm=depth).columns
            ax.plot(c["n_rows"], c[f"ratio_{key}"], "o-", color=COLOURS[colour], label=f"sweep of +-{depth:g} mm")
        ax.axhline(1, color="black", linewidth=0.8)
        ax.set(xscale="log", xlabel="correspondences", title=title)
        ax.set_title(title, fontsize=10)
        _plain_log(ax.xaxis, sorted(set(table.columns["n_rows"])))
    axes[0].set_ylabel("perspective error / affine error")
    axes[0].legend(fontsize=8)
    return page


def focal_lengths(found_px: np.ndarray, true_px: float) -> Figure:
    """Histogram of the focal lengths that a perspective decomposition gives for a far camera."""
    page, ax = figure(width_in=8, height_in=3.0)
    bins = np.geomspace(found_px.min() * 0.8, true_px * 1.5, 40)
    ax.hist(found_px, bins=bins, color=COLOURS["paper"], label="perspective DLT, decomposed")
    ax.axvline(true_px, color=COLOURS["truth"], linewidth=2.5, label="true focal length")
    ax.set(xscale="log", xlabel="focal length (px)", ylabel="runs", title="A far camera's focal length is not determined")
    page.legend(loc="outside lower center", ncols=2)
    return page


def shallow_bias(table: Table) -> Figure:
    """Recorded depth scale of the cameras, estimated over true, against the depth that the tool covers."""
    page, ax = figure(width_in=8.5, height_in=3.8)
    styles = {
        "dlt": ("DLT", "baseline", "s-"),
        "likelihood": ("likelihood", "ours", "o-"),
        "printed_mm": ("as printed, mm", "paper", "^-"),
        "printed_um": ("as printed, um", "warning", "v-"),
    }
    c = table.columns
    for key, (name, colour, style) in styles.items():
        ax.plot(c["half_depth_mm"], c[f"{key}_depth_scale"], style, color=COLOURS[colour], label=name)
    ax.axhline(1, color="black", linewidth=0.8)
    ax.set(
        xscale="log",
        xlabel="half depth covered by the tool (mm)",
        ylabel="depth scale found / true",
        ylim=(0.7, 1.6),
        title="Weights matter if the sweep is shallow",
    )
    _plain_log(ax.xaxis, c["half_depth_mm"])
    ax.legend(ncols=2)
    return page


def ladder_table(comparison: Comparison, caption: str) -> HTML:
    """The compared models: number of parameters, chi-square, BIC minus the best one, p-value of the constraint."""
    rows = [
        [rung.model + (", chosen" if rung is comparison.best else ""), rung.parameters, f"{rung.chi_square:.1f}",
         f"{rung.bic - comparison.best.bic:.1f}", "" if rung.against is None else f"{rung.p_value:.2g}"]
        for rung in comparison.rungs
    ]  # fmt: skip
    return html_table(["model", "parameters", "chi-square", "BIC above the best", "p of its constraint"], rows, caption)


def ladder(comparisons: Mapping[str, Comparison]) -> Figure:
    """BIC of each model minus that of the best one, one panel for each data set."""
    page, axes = figure(1, len(comparisons), width_in=12, height_in=3.8, sharey=True, squeeze=False)
    most = max(rung.bic - comparison.best.bic for comparison in comparisons.values() for rung in comparison.rungs)
    for ax, (title, comparison) in zip(axes[0], comparisons.items(), strict=True):
        names = [rung.model for rung in comparison.rungs]
        delta = [rung.bic - comparison.best.bic for rung in comparison.rungs]
        colours = [COLOURS["ours"] if rung is comparison.best else COLOURS["baseline"] for rung in comparison.rungs]
        bars = ax.barh(names, delta, color=colours)
        labels = ["chosen" if above == 0 else f"{above:.0f}" for above in delta]
        ax.bar_label(bars, labels, padding=3, fontsize=8)
        ax.set(xscale="symlog", xlim=(0, 5 * (most + 1)), xlabel="BIC minus that of the best model", title=title)
        ax.xaxis.set_major_formatter("{x:g}")
    axes[0, 0].invert_yaxis()  # shared
    return page


def ellipsoids(calibration: Calibration, x_mm: np.ndarray) -> Figure:
    """Enlarged uncertainty ellipsoids of triangulated points (n, 3) mm, with and without the noise of their detections."""
    page, _ = figure(1, 2, width_in=12, height_in=4.6)
    page.clear()
    a, b = np.meshgrid(np.linspace(0, 2 * np.pi, 25), np.linspace(0, np.pi, 13))
    sphere = np.stack([np.cos(a) * np.sin(b), np.sin(a) * np.sin(b), np.cos(b)], axis=-1)
    for i, (detection, title) in enumerate(((True, "Detection and calibration"), (False, "Calibration alone"))):
        axes = page.add_subplot(1, 2, i + 1, projection="3d")
        values, vectors = np.linalg.eigh(calibration.point_covariance(x_mm, detection=detection))
        sd_mm = np.sqrt(values)
        factor = float(f"{2.0 / sd_mm.max():.1g}")  # the longest half axis is drawn about 2 mm long
        for x, sd, along in zip(x_mm, sd_mm, vectors, strict=True):
            axes.plot_surface(
                *np.moveaxis(x + factor * (sphere * sd) @ along.T, -1, 0),
                color=COLOURS["ours" if detection else "paper"], alpha=0.7, linewidth=0,
            )  # fmt: skip
        axes.set_title(
            f"{title}: 1 sd enlarged {factor:g} times\n"
            f"longest half axis {1e3 * sd_mm[:, -1].min():.0f} to {1e3 * sd_mm[:, -1].max():.0f} um"
        )
        axes.set_aspect("equal")
        axes.set(xlabel="x (mm)", ylabel="y (mm)", zlabel="z (mm)")
    return page


def advice_view(
    calibration: Calibration, robot_from_microscope: RigidTransform, half_size_mm: np.ndarray, advised_mm: np.ndarray,
    scale_um: tuple[float, float],
) -> Figure:  # fmt: skip
    """Depth sd caused by the calibration on the focal plane, the correspondences used, and the advised position (3,) mm.

    The colour scale, from `scale_um[0]` to `scale_um[1]`, is the same for all positions of a slider.
    """
    page, ax = figure(width_in=8.5, height_in=4.4)
    x, y = np.meshgrid(*(np.linspace(-h, h, 41) for h in half_size_mm[:2]))
    plane = robot_from_microscope.apply(np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]))
    depth = 1e3 * calibration.depth_sd_mm(plane).reshape(x.shape)
    extent = (-half_size_mm[0], half_size_mm[0], -half_size_mm[1], half_size_mm[1])
    norm = LogNorm(*scale_um, clip=True)
    image = ax.imshow(depth, extent=extent, origin="lower", cmap="viridis_r", norm=norm, aspect="equal")
    used, advised = (robot_from_microscope.inverse().apply(p) for p in (calibration.x_mm, advised_mm[None]))
    style = {"markeredgecolor": "black", "clip_on": False}
    ax.plot(*used[:, :2].T, "o", color="white", markersize=4, label="correspondences", **style)
    ax.plot(*advised[:, :2].T, "*", color=COLOURS["warning"], markersize=18, label="next position", **style)
    _plain_log(page.colorbar(image, ax=ax, label="depth sd from calibration (um)").ax.yaxis)
    ax.set(xlabel="x (mm)", ylabel="y (mm)")
    ax.set_title(f"{len(used)} correspondences: {depth.mean():.0f} um mean, {depth.max():.0f} um worst", pad=14)
    ax.grid(False)
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
    return page


def advice_curves(table: Table, first: int) -> Figure:
    """Recorded RMS sqrt(leverage) over the workspace against the number of added positions."""
    page, ax = figure(width_in=8, height_in=3.4)
    c = table.columns
    for name, colour in (("random", "baseline"), ("advised", "ours")):
        ax.plot(c["added"], c[f"{name}_sd"], "o-", markersize=3, color=COLOURS[colour], label=name)
    ax.set(
        xlabel=f"positions added to {first} clustered ones",
        ylabel="sd of the calibration / sd of a row",
        yscale="log",
        title="The choice of positions matters more than their number",
    )
    _plain_log(ax.yaxis)
    ax.legend()
    return page


def residuals(calibration: Calibration) -> Figure:
    """Residuals as arrows over each image, and their histogram with a Gaussian of the same standard deviation."""
    c = len(calibration.cameras)
    page, axes = figure(1, c + 1, width_in=13, height_in=3.6)
    kept = []
    # The largest factor with which nine in ten arrows stay shorter than a seventh of the landmarks' extent.
    longest = np.nanquantile(np.abs(calibration.residuals_px), 0.9)
    span_px = np.nanmax(np.nanmax(calibration.y_px, axis=0) - np.nanmin(calibration.y_px, axis=0))
    times = next((n for n in (25, 10, 5, 2) if 7 * n * longest < span_px), 1)
    for i, side in enumerate(["Left", "Right"] if c == 2 else ["Camera"]):
        u, r = calibration.y_px[:, 2 * i : 2 * i + 2], calibration.residuals_px[:, 2 * i : 2 * i + 2]
        ax, good = axes[i], calibration.view_inliers[:, i]
        outlier = np.isfinite(r).all(axis=1) & ~good
        kept.append(r[good].ravel())
        ax.quiver(*u[good].T, *r[good].T, angles="xy", scale_units="xy", scale=1 / times, color=COLOURS["ours"], width=0.003)
        ax.plot(*u[outlier].T, "x", color=COLOURS["paper"], label="outlier")
        ax.invert_yaxis()
        ax.set(aspect="equal", title=f"{side}: residuals" + (f", {times} times" if times > 1 else ""), xlabel="px")
        if outlier.any():
            ax.legend()
    r = np.concatenate(kept)
    span = np.linspace(-4 * r.std(), 4 * r.std(), 200)
    axes[-1].hist(r, bins=30, density=True, color=COLOURS["baseline"], label="residuals")
    axes[-1].plot(
        span,
        np.exp(-0.5 * (span / r.std()) ** 2) / (r.std() * np.sqrt(2 * np.pi)),
        color=COLOURS["ours"],
        label="Gaussian",
    )
    axes[-1].set(xlabel="px", title=f"{r.std():.2f} px per coordinate", yticks=[])
    axes[-1].legend()
    return page


def frame_residuals(image: np.ndarray, detected: np.ndarray, predicted: np.ndarray, title: str) -> Figure:
    """One frame: detections (3, 2) px and projections (3, 2) px of the robot's landmarks, with a magnified view."""
    page, axes = figure(1, 2, width_in=13, height_in=4.2, width_ratios=[1.6, 1])
    middle = np.nanmean(detected, axis=0)
    half = max(90.0, 0.7 * float(np.nanmax(np.nanmax(detected, 0) - np.nanmin(detected, 0))))
    for ax in axes:
        show_image(ax, image, title if ax is axes[0] else "Magnified")
        size = 5 if ax is axes[0] else 11
        for name, d, p in zip(LANDMARK_COLOURS, detected, predicted, strict=True):
            style = {"color": LANDMARK_COLOURS[name], "markersize": size, "markeredgecolor": "black"}
            ax.plot(*d, "o", label=f"{name} detected", **style)
            ax.plot(*p, "+", color="white", markersize=1.6 * size, markeredgewidth=2)
    axes[1].set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] + half, middle[1] - half))
    axes[0].plot([], [], "+", color="white", markersize=9, markeredgewidth=2, label="robot, projected")
    axes[0].legend(loc="upper right", fontsize=8, **ON_IMAGE)
    return page


def working_distance(table: Table) -> Figure:
    """Recorded 3D error of the affine and the near-affine model against the working distance."""
    page, ax = figure(width_in=8, height_in=3.6)
    c = table.columns
    labels = [f"{1e3 / inverse:.0f}" if inverse else "affine" for inverse in c["inverse_distance_per_m"]]
    at = np.arange(len(labels))
    ax.bar(at - 0.2, c["affine_um"], 0.4, color=COLOURS["paper"], label="affine (zero skew)")
    ax.bar(at + 0.2, c["near_affine_um"], 0.4, color=COLOURS["ours"], label="with 1/distance")
    top = np.maximum(c["affine_um"], c["near_affine_um"])
    for x, y, share in zip(at, top, c["distance_chosen_percent"], strict=True):
        ax.text(x, y + 3, f"1/d chosen:\n{share:.0f} %", ha="center", fontsize=8)
    ax.set(
        xticks=at,
        xticklabels=labels,
        xlabel="working distance (mm)",
        ylabel="held-out 3D RMS (um)",
        ylim=(0, 1.25 * top.max()),
        title="One more parameter removes the error of the affine model",
    )
    ax.legend()
    return page


def time_offset(found: TimeOffset, true_s: float) -> Figure:
    """Reprojection error against the assumed clock offset, with the estimated and the true offset."""
    page, ax = figure(width_in=8, height_in=3.2)
    ax.plot(1e3 * found.trial_s, found.trial_rms_px, color=COLOURS["baseline"])
    middle, sd = 1e3 * found.offset_s, 1e3 * found.sd_s
    ax.axvspan(
        middle - 3 * sd,
        middle + 3 * sd,
        color=COLOURS["ours"],
        alpha=0.4,
        label=f"estimate {middle:.2f} +- {sd:.2f} ms\n(3 sd shown)",
    )
    ax.axvline(1e3 * true_s, color=COLOURS["truth"], linewidth=1, label=f"truth {1e3 * true_s:.0f} ms")
    ax.set(
        xlabel="assumed offset between the clocks (ms)",
        ylabel="reprojection RMS (px)",
        title="The error is smallest at the right clock offset",
    )
    ax.legend(loc="lower left")
    return page


def checkerboards(table: Table, paper_um: float = 25.479) -> Figure:
    """Recorded errors of reconstructed checkerboards, RMS over the sweeps, one panel for each working distance."""
    optics = {
        inverse: table.where(inverse_distance_per_m=inverse)
        for inverse in sorted(set(table.columns["inverse_distance_per_m"]))
    }
    page, axes = figure(1, len(optics), width_in=13, height_in=4.6, sharey=True, squeeze=False)
    names = [key.removesuffix("_aligned_um") for key in table.columns if key.endswith("_aligned_um")]
    at = np.arange(len(names))
    for ax, (inverse, rows) in zip(axes[0], optics.items(), strict=True):
        for key, offset, colour, name in (
            ("aligned_um", -0.2, "ours", "after rigid alignment"),
            ("robot_um", 0.2, "baseline", "in the robot frame"),
        ):
            values = [root_mean_square(rows.columns[f"{n}_{key}"]) for n in names]
            ax.barh(at + offset, values, 0.4, color=COLOURS[colour], label=name)
            for y, value in zip(at + offset, values, strict=True):
                ax.text(value + 0.6, y, f"{value:.1f}", va="center", fontsize=8, bbox=_WHITE, zorder=3)
        ax.axvline(paper_um, color=COLOURS["paper"], linestyle="--", label="the paper, aligned")
        title = f"Working distance {1e3 / inverse:.0f} mm" if inverse else "Affine optics"
        sweeps = f"{len(rows)} sweep" + "s" * (len(rows) > 1)
        ax.set(yticks=at, xlabel="RMS 3D distance to the grid (um)", title=f"{title}: {sweeps}")
        ax.set_yticklabels([name.replace("_", " ") for name in names])
        ax.margins(x=0.1)
        ax.grid(axis="y", visible=False)
    axes[0, 0].invert_yaxis()  # shared
    axes[0, -1].legend(loc="lower right", fontsize=8)
    return page


def root_mean_square(values: np.ndarray) -> float:
    """Root mean square of the finite values."""
    values = np.asarray(values, dtype=np.float64)
    return float(np.sqrt(np.mean(values[np.isfinite(values)] ** 2)))


def estimators(chosen: Table, fresh: Table) -> Figure:
    """Recorded errors of each estimator over their bounds, on the sweeps used for the choice and on fresh ones."""
    page, axes = figure(1, 2, width_in=13, height_in=3.8, sharey=True)
    names = [
        key.removesuffix("_projection_over_bound") for key in chosen.columns if key.endswith("_projection_over_bound")
    ]
    at = np.arange(len(names))
    for ax, key, title in (
        (axes[0], "over_bound", "Triangulation error of exact pixels"),
        (axes[1], "projection_over_bound", "Projection error"),
    ):
        for table, offset, colour, name in (
            (chosen, -0.2, "baseline", "sweeps of the choice"),
            (fresh, 0.2, "ours", "fresh sweeps"),
        ):
            columns = [table.columns[f"{n}_{key}"] for n in names]
            values = [root_mean_square(column) for column in columns]
            ax.bar(at + offset, values, 0.4, color=COLOURS[colour], label=f"{name} ({len(table)})")
            for x, value, column in zip(at + offset, values, columns, strict=True):
                ax.plot(np.full(len(column), x), column, ".", color="black", markersize=3)
                ax.text(x, -0.03, f"{value:.2f}", ha="center", va="top", fontsize=8)  # below all bars and dots
        ax.axhline(1, color="black", linewidth=0.8)
        ax.set(xticks=at, title=title)
        ax.set_xticklabels([n.replace("_", "\n") for n in names])
        ax.grid(axis="x", visible=False)
    axes[0].set_ylim(bottom=-0.2)
    axes[0].set_yticks([tick for tick in axes[0].get_yticks() if 0 <= tick <= axes[0].get_ylim()[1]])
    axes[0].set_ylabel("error / Cramer-Rao bound")
    axes[0].legend(fontsize=8)
    return page


def coverage(table: Table) -> Figure:
    """Recorded shares of errors inside the reported 95 % region, and of true constraints that are rejected."""
    page, axes = figure(1, 2, width_in=11, height_in=3.2)
    c = table.columns
    axes[0].plot(c["n_rows"], c["coverage_95_percent"], "o-", color=COLOURS["ours"])
    axes[0].axhline(95, color=COLOURS["truth"], linewidth=1)
    axes[0].set(ylabel="%", title="Inside the reported 95 % region")
    for key, name, colour, style in (
        ("zero_skew", "zero skew", "ours", "o-"),
        ("square", "square pixels", "paper", "s-"),
        ("common_zoom", "common zoom", "right", "^-"),
    ):
        axes[1].plot(c["n_rows"], c[f"{key}_rejected_percent"], style, color=COLOURS[colour], label=name)
    axes[1].axhline(5, color=COLOURS["truth"], linewidth=1)
    axes[1].set(ylabel="%", ylim=(0, None), title="True constraints rejected at 5 %")
    axes[1].legend(fontsize=8)
    for ax in axes:
        ax.set(xscale="log", xlabel="correspondences")
        _plain_log(ax.xaxis, c["n_rows"])
    return page


def resolutions(table: Table) -> Figure:
    """Recorded errors of calibrations from labels and from detectors at four resolutions, as in the paper's figure."""
    page, axes = figure(1, 3, width_in=14, height_in=3.8)
    groups = {name: table.where(detector=name).columns for name in dict.fromkeys(table.columns["detector"])}
    names = [f"{name}\n{root_mean_square(c['sigma_u_px']):.1f} px" for name, c in groups.items()]
    at = np.arange(len(names))
    for ax, key, unit, title in (
        (axes[0], "detections_um", "um", "Detections triangulated (the paper's measure)"),
        (axes[1], "um", "um", "Exact pixels triangulated"),
        (axes[2], "projection_px", "px", "Projections"),
    ):
        for model, offset, colour in (("affine", -0.2, "ours"), ("perspective", 0.2, "paper")):
            values = [root_mean_square(c[f"{model}_{key}"]) for c in groups.values()]
            label = "affine" if model == "affine" else "perspective DLT"
            ax.bar(at + offset, values, 0.4, color=COLOURS[colour], label=label)
            for x, value in zip(at + offset, values, strict=True):
                ax.text(x, value, f"{value:.3g}", ha="center", va="bottom", fontsize=7)
        ax.set(xticks=at, xticklabels=names, ylabel=f"RMS ({unit})", title=title, yscale="log")
        ax.grid(axis="x", visible=False)
        ax.margins(y=0.2)
        _plain_log(ax.yaxis)
    axes[1].set_xlabel("data of the calibration, and their RMS error per coordinate")
    axes[0].legend(fontsize=8)
    return page


def offsets(names: Sequence[str], found: LandmarkOffsets, *, unit_um: float = 1e3) -> Figure:
    """Offsets of the detected from the reported landmarks in the tool's axes, with two standard deviations."""
    page, ax = figure(width_in=8.5, height_in=3.4)
    at = np.arange(3)
    for k, name in enumerate(names):
        ax.errorbar(
            at + 0.2 * (k - 1), unit_um * found.offset[k], 2 * unit_um * found.standard_deviation[k], fmt="o",
            color=LANDMARK_COLOURS[name], markeredgecolor="black", ecolor="black", capsize=4, label=name,
        )  # fmt: skip
    ax.axhline(0, color="black", linewidth=0.8)
    ax.set(
        xticks=at,
        xticklabels=["along the tool", "from tip to tip", "normal to both"],
        ylabel="detected minus reported (um)",
        title="Is a landmark where the robot says it is?",
    )
    ax.legend(loc="upper center", ncols=3)
    ax.margins(y=0.25)
    return page


def robot_frames(frames: RobotFrames, rows: Sequence[int], fits: Mapping[str, Sequence[SphereFit]]) -> Figure:
    """Frames of the real robot with the spheres found, and leave-one-out residuals of two models, enlarged 40 times."""
    page, axes = figure(1, len(rows), width_in=13, height_in=3.6)
    colours = dict(zip(fits, (COLOURS["warning"], COLOURS["ours"]), strict=True))
    for ax, row in zip(axes, rows, strict=True):
        show_image(ax, frames.image(row), f"Frame {frames.index[row]}")
        for s in range(2):
            u, radius = frames.u[row, s], frames.radius_px[row, s]
            angle = np.linspace(0, 2 * np.pi, 100)
            ax.plot(u[0] + radius * np.cos(angle), u[1] + radius * np.sin(angle), color="white", linewidth=1.2)
            for name, both in fits.items():
                ax.annotate(
                    "",
                    u + 40 * both[s].leave_one_out_px[row],
                    u,
                    arrowprops={"arrowstyle": "->", "color": colours[name], "linewidth": 2},
                )
    for name, colour in colours.items():
        axes[0].plot([], [], color=colour, label=f"{name}, 40 times")
    axes[0].legend(loc="lower right", fontsize=8, **ON_IMAGE)
    return page


def against_truth(values: np.ndarray, cameras: Mapping[str, np.ndarray], true: np.ndarray) -> Figure:
    """The seven eigenvalues of Eq. (3), and the errors of the entries of A (4, 3) for stacked cameras (4, 4)."""
    page, (left, right) = figure(1, 2, width_in=11, height_in=3.4)
    order = np.arange(1, 8)
    colours = [COLOURS["baseline"]] * 4 + [COLOURS["ours"]] * 3
    left.bar(order, values, color=colours)
    left.set(yscale="log", xlabel="eigenvalue", ylabel="squared standard deviations")
    left.set_title("Four from noise, three from motion")
    left.set_xticks(order)
    for shift, (name, matrix), colour in zip((-0.2, 0.2), cameras.items(), ("paper", "ours"), strict=True):
        right.bar(np.arange(12) + shift, (matrix - true)[:, :3].ravel(), 0.4, color=COLOURS[colour], label=name)
    right.set_xticks([1, 4, 7, 10], ["left x", "left y", "right x", "right y"])
    for border in (2.5, 5.5, 8.5):
        right.axvline(border, color="#cccccc", linewidth=0.8)
    right.axhline(0, color="black", linewidth=0.8)
    right.set(ylabel="estimated minus true (px/mm)", title="Errors of A, three entries per pixel coordinate")
    right.legend(loc="best", fontsize=9)
    return page


def residual_field(u: np.ndarray, residual_px: np.ndarray, title: str) -> Figure:
    """Residuals (n, 2) px at pixels (n, 2) as enlarged arrows; the title gives their largest length and the enlargement.

    Points at several depths lie on about the same ray; some of their residuals point outwards, others inwards.
    """
    page, ax = figure(width_in=9, height_in=5.4)
    largest = float(np.linalg.norm(residual_px, axis=1).max())
    scale = 80.0 / max(largest, 1e-9)
    ax.quiver(*u.T, *(scale * residual_px.T), color=COLOURS["paper"], angles="xy", scale_units="xy", scale=1, width=0.002)
    ax.plot(*u.T, ".", color=COLOURS["ours"], markersize=3)
    ax.plot([], [], ".", color=COLOURS["ours"], label="points, several depths on each ray")
    ax.plot([], [], "-", color=COLOURS["paper"], label="residuals, enlarged")
    ax.set(aspect="equal", xlabel="x (px)", ylabel="y (px)")
    page.legend(loc="outside lower center", ncols=2)
    ax.set_title(f"{title}: residuals up to {largest:.2f} px, enlarged {scale:.3g} times")
    ax.invert_yaxis()
    return page
