"""Figures of notebook 02: network, heatmaps, augmentation, training, and what the detector finds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, FancyArrowPatch, FancyBboxPatch
from scipy.stats import chi2

from lib.figures.style import COLOURS, LANDMARK_COLOURS, figure, show_image
from lib.landmarks.evaluation import Evaluation
from lib.landmarks.inference import Landmarks
from lib.landmarks.metrics import PCK_THRESHOLDS, reliability
from lib.landmarks.network import HourglassConfig

__all__ = [
    "ablation_bars",
    "augmented",
    "decoder_errors",
    "detection",
    "error_groups",
    "few_labels_curves",
    "frame_explorer",
    "heatmap_grid",
    "landmark_dots",
    "learning_curves",
    "network_page",
    "pck_curves",
    "printed_equation",
    "resolution_curves",
    "stages",
    "uncertainty",
    "worst_frames",
]


def landmark_dots(axes: Axes, u: np.ndarray, *, size: float = 60.0, label: bool = False) -> None:
    """Landmarks (3, 2) as open circles in their colours; NaN is left out."""
    for (name, colour), point in zip(LANDMARK_COLOURS.items(), u, strict=True):
        axes.scatter(
            *point, s=size, facecolors="none", edgecolors=colour, linewidths=1.8, label=name if label else None
        )


def network_page(config: HourglassConfig, parameters: int) -> Figure:
    """The stacked hourglass drawn to its depth: boxes are blocks, their height the resolution, arcs the skips."""
    fig, ax = figure(width_in=11, height_in=3.2)
    ax.set_axis_off()
    ax.grid(False)
    x, centres = 0.0, []

    def box(height: float, colour: str, text: str = "") -> float:
        nonlocal x
        ax.add_patch(FancyBboxPatch((x, -height / 2), 0.5, height, boxstyle="round,pad=0.03", fc=colour, ec="white"))
        if text:
            ax.text(x + 0.25, -height / 2 - 0.12, text, ha="center", va="top", fontsize=8)
        x += 0.75
        return x - 0.5

    box(3.4, COLOURS["baseline"], "image")
    box(2.4, COLOURS["baseline"], "stem\n1/4")
    for stack in range(config.stacks):
        heights = [2.0 * 0.66**level for level in range(config.depth + 1)]
        down = [(box(h, COLOURS["ours"], f"1/{4 * 2**i}"), h) for i, h in enumerate(heights)]
        if config.decoder:
            for i, h in reversed(list(enumerate(heights[:-1]))):
                at = box(h, COLOURS["truth"], f"1/{4 * 2**i}")
                if config.skips:
                    arrow = FancyArrowPatch(
                        (down[i][0], h / 2 + 0.05), (at, h / 2 + 0.05), connectionstyle="arc3,rad=-0.25",
                        arrowstyle="-|>", mutation_scale=8, color=COLOURS["baseline"], lw=1,
                    )  # fmt: skip
                    ax.add_patch(arrow)
        centres.append(box(2.0, COLOURS["paper"], f"heatmaps {stack + 1}\nl2 loss"))
    ax.set(xlim=(-0.2, x), ylim=(-2.3, 2.3))
    ax.set_title(
        f"{config.stacks} hourglass{'es' if config.stacks > 1 else ''}, {config.features} features, "
        f"{parameters / 1e6:.2f} million parameters"
    )
    return fig


def heatmap_grid(image: np.ndarray, heatmaps: np.ndarray, u: np.ndarray, stride: int) -> Figure:
    """One image with its three heatmaps (3, h, w) laid over it; `u` (3, 2) in image pixels."""
    fig, axes = figure(1, 4, width_in=12, height_in=3.3)
    show_image(axes[0], image, "image and landmarks")
    landmark_dots(axes[0], u)
    h, w = heatmaps.shape[1:]
    extent = (-0.5, w * stride - 0.5, h * stride - 0.5, -0.5)
    grey = image.mean(axis=2)
    for ax, name, heatmap in zip(axes[1:], LANDMARK_COLOURS, heatmaps, strict=True):
        show_image(ax, grey, name)
        ax.imshow(heatmap, cmap="inferno", alpha=0.65, extent=extent, vmin=0, vmax=1)
        ax.set(xlim=(-0.5, image.shape[1] - 0.5), ylim=(image.shape[0] - 0.5, -0.5))
    return fig


def printed_equation(heatmap: np.ndarray, truth: np.ndarray, points: Mapping[str, np.ndarray]) -> Figure:
    """A heatmap (h, w) of stride 1 with what Eq. (1) gives, printed and normalised."""
    fig, ax = figure(width_in=5.2, height_in=4)
    show_image(ax, heatmap)
    ax.images[0].set_cmap("inferno")
    ax.scatter(*truth, marker="+", s=120, c="white", label="truth")
    for (name, point), colour in zip(points.items(), (COLOURS["paper"], COLOURS["ours"]), strict=False):
        ax.scatter(*point, s=110, facecolors="none", edgecolors=colour, linewidths=2, label=name)
    ax.legend(loc="lower right", labelcolor="white")
    return fig


def augmented(images: Sequence[np.ndarray], u: Sequence[np.ndarray], titles: Sequence[str]) -> Figure:
    """Images (h, w, 3) in [0, 1] or uint8 with their landmarks."""
    columns = min(6, len(images))
    rows = -(-len(images) // columns)
    fig, axes = figure(rows, columns, width_in=12, height_in=2.15 * rows, squeeze=False)
    for ax in axes.flat:
        ax.set_axis_off()
    for ax, image, points, title in zip(axes.flat, images, u, titles, strict=False):
        show_image(ax, image)
        ax.set_title(title, fontsize=9)
        h, w = image.shape[:2]
        inside = ((points > -0.5) & (points < (w - 0.5, h - 0.5))).all(axis=1)
        landmark_dots(ax, np.where(inside[:, None], points, np.nan), size=40)
    return fig


def learning_curves(logs: Mapping[str, list[dict[str, float]]]) -> Figure:
    """Loss and validation PCK against steps, one colour a training."""
    fig, (a, b, c) = figure(1, 3, width_in=12, height_in=3.2)
    for (name, log), colour in zip(logs.items(), (COLOURS["ours"], COLOURS["paper"], COLOURS["truth"]), strict=False):
        step = [row["step"] for row in log]
        a.plot(step, [row["loss"] for row in log], color=colour, label=f"{name}, training")
        a.plot(step, [row["validation_loss"] for row in log], color=colour, ls="--", label="validation")
        b.plot(step, [row["pck_0.10"] for row in log], color=colour, label="threshold 0.10")
        b.plot(step, [row["pck_0.05"] for row in log], color=colour, ls="--", label="threshold 0.05")
        c.plot(step, [row["median_px"] for row in log], color=colour, label=name)
    a.set(title="l2 loss (1 = empty heatmaps)", xlabel="step", yscale="log")
    b.set(title="validation PCK", xlabel="step", ylabel="%", ylim=(0, 100))
    c.set(title="median error", xlabel="step", ylabel="px", yscale="log")
    a.legend(fontsize=8)
    b.legend(fontsize=8)
    return fig


def pck_curves(
    curves: Mapping[str, np.ndarray], *, thresholds: np.ndarray = PCK_THRESHOLDS, paper: bool = True
) -> Figure:
    """PCK in percent against the threshold, logarithmic: the strict end is where detectors differ."""
    fig, ax = figure(width_in=8, height_in=3.8)
    colours = [COLOURS["ours"], COLOURS["truth"], COLOURS["right"], COLOURS["warning"], COLOURS["baseline"]]
    for i, (name, curve) in enumerate(curves.items()):
        ax.plot(thresholds, curve, color=colours[i % len(colours)], lw=2.4 if i == 0 else 1.4, label=name)
    if paper:
        ax.plot(0.05, 99.7, "D", color=COLOURS["paper"], label="paper, 1080p, PCK@0.05")
    ax.set(xscale="log", xlim=(thresholds[0], thresholds[-1]), ylim=(0, 101))
    ax.set(xlabel="threshold, part of the tool's length", ylabel="PCK, %", title="Correct landmarks")
    ticks = [t for t in (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5) if thresholds[0] <= t <= thresholds[-1]]
    ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
    ax.minorticks_off()
    ax.legend(loc="lower right", fontsize=9)
    return fig


def _ellipse(axes: Axes, u: np.ndarray, covariance: np.ndarray, colour: str, probability: float = 0.95) -> None:
    values, vectors = np.linalg.eigh(covariance)
    size = 2 * np.sqrt(values * chi2.ppf(probability, 2))
    angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    axes.add_patch(Ellipse(u, size[1], size[0], angle=angle, fill=False, ec=colour, lw=1.6))


def detection(image: np.ndarray, evaluation: Evaluation, index: int, *, half_px: int = 14) -> Figure:
    """A frame with its detections, and each landmark close up: 95 % ellipse, detection (dot) and label (cross)."""
    fig, axes = figure(1, 4, width_in=13, height_in=3.2, width_ratios=[2.2, 1, 1, 1])
    found, truth = evaluation.landmarks, evaluation.u_true[index]
    show_image(axes[0], image[::2, ::2], evaluation.names[index])
    landmark_dots(axes[0], found.u[index] / 2 - 0.25, label=True)
    axes[0].legend(loc="lower left", fontsize=8, labelcolor="white")
    h, w = image.shape[:2]
    for k, (ax, (name, colour)) in enumerate(zip(axes[1:], LANDMARK_COLOURS.items(), strict=True)):
        centre = found.u[index, k] if np.isfinite(found.u[index, k]).all() else truth[k]
        show_image(ax, image, f"{name}: missed")
        if not np.isfinite(centre).all():
            continue
        x, y = np.clip(np.round(centre), half_px, (w - 1 - half_px, h - 1 - half_px))
        ax.set(xlim=(x - half_px - 0.5, x + half_px + 0.5), ylim=(y + half_px + 0.5, y - half_px - 0.5))
        ax.images[0].set_interpolation("nearest")
        ax.scatter(*truth[k], marker="+", s=160, c="white", linewidths=1.6)
        if np.isfinite(found.u[index, k]).all():
            ax.scatter(*found.u[index, k], s=18, c=colour)
            _ellipse(ax, found.u[index, k], found.covariance[index, k], colour)
            ax.set_title(f"{name}: {evaluation.error_px[index, k]:.2f} px")
    return fig


def worst_frames(images: Sequence[np.ndarray], evaluation: Evaluation, indices: Sequence[int]) -> Figure:
    """The frames with the largest errors: circles are detections, crosses labels."""
    fig, axes = figure(1, len(images), width_in=12.5, height_in=3.4, squeeze=False)
    for ax, image, i in zip(axes.flat, images, indices, strict=True):
        truth, found = evaluation.u_true[i], evaluation.landmarks.u[i]
        error = evaluation.error_px[i]
        k = int(np.argmax(np.nan_to_num(error, nan=-1.0, posinf=1e9)))
        show_image(ax, image, f"{evaluation.names[i]}: {list(LANDMARK_COLOURS)[k]} {error[k]:.1f} px")
        landmark_dots(ax, found, size=90)
        ax.scatter(*truth.T, marker="+", s=90, c="white", linewidths=1.5)
        h, w = image.shape[:2]
        reach = 60 if np.isfinite(error[k]) and error[k] < 50 else 250
        x, y = np.clip(truth[k], reach, (w - 1 - reach, h - 1 - reach))
        ax.set(xlim=(x - reach, x + reach), ylim=(y + reach, y - reach))
    return fig


def uncertainty(evaluation: Evaluation, squared: np.ndarray) -> Figure:
    """Do covariance and confidence mean what they say: distribution of the squared error, and reliability."""
    fig, (a, b) = figure(1, 2, width_in=11, height_in=3.4)
    values = np.sort(squared[np.isfinite(squared)])
    grid = np.linspace(0, 12, 200)
    a.plot(grid, 100 * np.searchsorted(values, grid) / max(len(values), 1), color=COLOURS["ours"], label="detections")
    a.plot(grid, 100 * chi2.cdf(grid, 2), color=COLOURS["truth"], ls="--", label="true covariances")
    a.axvline(chi2.ppf(0.95, 2), color=COLOURS["baseline"], lw=1, label="95 % ellipse")
    a.set(title="Squared error over its covariance", xlabel="normalised squared error", ylabel="% below", ylim=(0, 101))
    a.legend()
    labelled = ~np.isnan(evaluation.error_px)
    mean, fraction, count = reliability(evaluation.landmarks.confidence[labelled], evaluation.correct[labelled])
    used = count > 0
    b.plot([0, 1], [0, 1], color=COLOURS["truth"], ls="--", label="true confidence")
    b.scatter(
        mean[used], fraction[used], s=20 + 3 * np.sqrt(count[used]) * 5, color=COLOURS["ours"], label="detections"
    )
    b.set(title="Reliability", xlabel="confidence", ylabel="fraction correct", xlim=(-0.02, 1.05), ylim=(-0.02, 1.05))
    b.legend()
    return fig


def ablation_bars(columns: Mapping[str, Mapping], paper: Mapping[str, float]) -> Figure:
    """Recorded PCK@0.05 of the five networks: a dot a seed, a bar for the mean, and the paper's value."""
    fig, ax = figure(width_in=8, height_in=3.2)
    for i, (name, row) in enumerate(columns.items()):
        values = row["pck_0.05"]["per_seed"]
        ax.bar(i, row["pck_0.05"]["mean"], 0.55, color=COLOURS["ours"], alpha=0.5, label="mean" if i == 0 else None)
        ax.plot(np.full(len(values), i), values, "o", color=COLOURS["ours"], ms=5, label="one seed" if i == 0 else None)
        ax.plot(i, paper[name], "D", color=COLOURS["paper"], ms=7, label="paper" if i == 0 else None)
    ax.set_xticks(range(len(columns)), list(columns))
    ax.set(ylabel="PCK@0.05, %", ylim=(0, 105), title="Ablation")
    ax.legend(loc="upper left", fontsize=8)
    return fig


def resolution_curves(thresholds: Sequence[float], curves: Mapping[str, Sequence[float]]) -> Figure:
    """PCK against the threshold at the paper's four resolutions."""
    fig, ax = figure(width_in=8, height_in=3.6)
    colours = [COLOURS["ours"], COLOURS["truth"], COLOURS["right"], COLOURS["warning"]]
    for (name, curve), colour in zip(curves.items(), colours, strict=True):
        ax.plot(100 * np.asarray(thresholds), curve, color=colour, marker="o", ms=3, label=name)
    ax.set(xscale="log", ylim=(0, 101), xlabel="threshold, % of the tool's length", ylabel="PCK, %", title="Resolution")
    ticks = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20)
    ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
    ax.minorticks_off()
    ax.legend(loc="upper left", fontsize=9)
    return fig


def few_labels_curves(result: Mapping) -> Figure:
    """PCK@0.05 against the number of annotated frames: recorded means with two standard errors."""
    fig, ax = figure(width_in=7.5, height_in=3.4)
    for (name, rows), colour in zip(result["frames"].items(), (COLOURS["ours"], COLOURS["paper"]), strict=False):
        n = [int(count) for count in rows]
        mean = np.array([row["pck_0.05"]["mean"] for row in rows.values()])
        error = np.array([row["pck_0.05"]["standard_error"] or 0.0 for row in rows.values()], dtype=float)
        ax.errorbar(n, mean, yerr=2 * error, color=colour, marker="o", ms=4, capsize=3, label=name)
    ax.axhline(result["no_label"]["pck_0.05"], color=COLOURS["baseline"], ls="--", label="shipped weights, no label")
    ax.set(xscale="log", ylim=(0, 101), xlabel="annotated frames", ylabel="PCK@0.05, %", title="How many labels?")
    ax.set_xticks(n, [str(count) for count in n])
    ax.minorticks_off()
    ax.legend(fontsize=8)
    return fig


def error_groups(groups: Mapping[str, Mapping]) -> Figure:
    """Median error (dot) and 95th percentile (tick) of groups of landmarks, one panel a grouping: name -> its `Scores`."""
    fig, axes = figure(1, len(groups), width_in=12, height_in=2.9, squeeze=False)
    for ax, (title, rows) in zip(axes.flat, groups.items(), strict=True):
        for i, s in enumerate(rows.values()):
            ax.plot([i, i], [s.median_px, s.p95_px], color=COLOURS["baseline"], lw=1.5)
            ax.plot(i, s.median_px, "o", color=COLOURS["ours"], label="median" if i == 0 else None)
            ax.plot(i, s.p95_px, "_", color=COLOURS["paper"], ms=14, mew=2, label="95 %" if i == 0 else None)
        ax.set_xticks(range(len(rows)), [f"{name}\n({s.labels})" for name, s in rows.items()], fontsize=8)
        ax.set(title=title, ylabel="error, px", xlim=(-0.6, len(rows) - 0.4))
        ax.set_ylim(bottom=0)
    axes.flat[0].legend(fontsize=8)
    return fig


def frame_explorer(
    image: np.ndarray, found: Landmarks, windows: np.ndarray, matrices: np.ndarray, heatmaps: np.ndarray
) -> Figure:
    """One frame with its landmarks; each landmark's window with its heatmap laid over, and its 95 % ellipse.

    `windows` (m, s, s, 3), `matrices` window_from_image (m, 2, 3) and `heatmaps` (m, h, w) of the m landmarks found.
    """
    fig, axes = figure(1, 4, width_in=13, height_in=3.1, width_ratios=[1.9, 1, 1, 1])
    show_image(axes[0], image[::2, ::2], "frame")
    landmark_dots(axes[0], found.u[0] / 2 - 0.25)
    names, seen = list(LANDMARK_COLOURS), np.flatnonzero(np.isfinite(found.u[0]).all(axis=1))
    for ax, name in zip(axes[1:], names, strict=True):
        ax.set_axis_off()
        ax.set_title(f"{name}: missed")
    for window, matrix, heatmap, k in zip(windows, matrices, heatmaps, seen, strict=False):
        ax, side = axes[1 + k], window.shape[0]
        show_image(ax, window.mean(axis=2), f"{names[k]}: confidence {found.confidence[0, k]:.2f}")
        ax.imshow(heatmap, cmap="inferno", alpha=0.45, extent=(-0.5, side - 0.5, side - 0.5, -0.5), vmin=0, vmax=1)
        u = matrix[:, :2] @ found.u[0, k] + matrix[:, 2]
        covariance = matrix[:, :2] @ found.covariance[0, k] @ matrix[:, :2].T
        _ellipse(ax, u, covariance, LANDMARK_COLOURS[names[k]])
        reach = 24
        ax.set(xlim=(u[0] - reach, u[0] + reach), ylim=(u[1] + reach, u[1] - reach))
    return fig


def decoder_errors(errors_px: Mapping[str, np.ndarray]) -> Figure:
    """Distribution of the error of several decoders on the same heatmaps."""
    fig, ax = figure(width_in=8, height_in=3.4)
    colours = plt.get_cmap("viridis")(np.linspace(0, 0.9, len(errors_px)))
    for colour, (name, error) in zip(colours, errors_px.items(), strict=True):
        error = np.sort(error[np.isfinite(error)])
        ax.plot(
            error,
            100 * np.arange(1, len(error) + 1) / len(error),
            color=colour,
            label=f"{name}: {np.median(error):.2f} px",
        )
    ax.set(
        xscale="log",
        xlim=(0.05, 20),
        ylim=(0, 101),
        xlabel="error, px",
        ylabel="% below",
        title="Decoders, trained heatmaps",
    )
    ax.legend(title="median", loc="upper left")
    return fig


def stages(image: np.ndarray, panels: Sequence[tuple[str, np.ndarray, np.ndarray]], u: np.ndarray) -> Figure:
    """Coarse to fine: the frame with its landmarks, then (title, input, heatmap) of each stage."""
    fig, axes = figure(1, 1 + len(panels), width_in=14, height_in=2.9, width_ratios=[1.8] + [1.0] * len(panels))
    show_image(axes[0], image[::3, ::3], "frame")
    landmark_dots(axes[0], (np.asarray(u) - 1) / 3)
    for ax, (title, seen, heatmap) in zip(axes[1:], panels, strict=True):
        show_image(ax, seen.mean(axis=2), title)
        h, w = seen.shape[:2]
        cells_h, cells_w = heatmap.shape
        extent = (-0.5, cells_w * w / cells_w - 0.5, cells_h * h / cells_h - 0.5, -0.5)
        ax.imshow(np.clip(heatmap, 0, 1), cmap="inferno", alpha=0.6, extent=extent, vmin=0, vmax=1)
        ax.set(xlim=(-0.5, w - 0.5), ylim=(h - 0.5, -0.5))
    return fig
