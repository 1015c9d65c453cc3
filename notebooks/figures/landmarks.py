"""Figures of notebook 02: network, heatmaps, augmentation, training, and what the detector finds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, FancyArrowPatch, FancyBboxPatch, Patch
from matplotlib.ticker import LogLocator
from scipy.stats import chi2

from lib.landmarks import Landmarks
from lib.landmarks.heatmaps import Peaks
from lib.landmarks.metrics import PCK_THRESHOLDS, reliability
from lib.landmarks.network import HourglassConfig
from lib.training.evaluation import Evaluation
from notebooks.figures.style import COLOURS, LANDMARK_COLOURS, figure, show_image

__all__ = [
    "ablation_bars",
    "augmented",
    "decoder_errors",
    "detection",
    "engine_bars",
    "error_groups",
    "few_labels_curves",
    "frame_explorer",
    "half_within",
    "heatmap_grid",
    "label_noise_pairs",
    "landmark_dots",
    "learning_curves",
    "loss_slopes",
    "network_page",
    "pck_curves",
    "printed_equation",
    "real_curves",
    "real_frames",
    "resolution_curves",
    "shipped_curve",
    "shipped_table",
    "stages",
    "timing_bars",
    "uncertainty",
    "visibility_bars",
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
    fig, ax = figure(width_in=10, height_in=3.4)
    ax.set_axis_off()
    ax.grid(False)
    x = 0.0

    def box(height: float, colour: str, text: str = "") -> float:
        nonlocal x
        ax.add_patch(FancyBboxPatch((x, -height / 2), 0.5, height, boxstyle="round,pad=0.03", fc=colour, ec="white"))
        if text:
            ax.text(x + 0.25, -height / 2 - 0.12, text, ha="center", va="top", fontsize=10)
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
        box(2.0, COLOURS["paper"], f"\nheatmaps\n+ loss {stack + 1}")
        x += 0.35
    ax.set(xlim=(-0.2, x), ylim=(-2.3, 2.3))
    ax.set_title(
        f"{config.stacks} hourglass{'es' if config.stacks > 1 else ''}, {config.features} features, "
        f"{parameters / 1e6:.2f} million parameters"
    )
    return fig


def heatmap_grid(image: np.ndarray, heatmaps: np.ndarray, u: np.ndarray, stride: int) -> Figure:
    """One image with its three heatmaps (3, h, w) laid over it; `u` (3, 2) in image pixels."""
    fig, axes = figure(1, 4, width_in=10.5, height_in=2.9)
    show_image(axes[0], image, "image and landmarks")
    landmark_dots(axes[0], u, size=90)
    h, w = heatmaps.shape[1:]
    axes[0].set(xlim=(-0.5, image.shape[1] - 0.5), ylim=(image.shape[0] - 0.5, -0.5))
    extent = (-0.5, w * stride - 0.5, h * stride - 0.5, -0.5)
    grey = image.mean(axis=2)
    for ax, name, heatmap in zip(axes[1:], LANDMARK_COLOURS, heatmaps, strict=True):
        show_image(ax, grey, name)
        ax.imshow(heatmap, cmap="inferno", alpha=0.65, extent=extent, vmin=0, vmax=1)
        ax.set(xlim=(-0.5, image.shape[1] - 0.5), ylim=(image.shape[0] - 0.5, -0.5))
    return fig


def printed_equation(heatmap: np.ndarray, truth: np.ndarray, points: Mapping[str, np.ndarray]) -> Figure:
    """A heatmap (h, w) of stride 1 with what Eq. (1) gives, printed and normalised."""
    fig, ax = figure(width_in=4.6, height_in=4.2)
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
    fig, axes = figure(rows, columns, width_in=10, height_in=1.8 * rows, squeeze=False)
    for ax in axes.flat:
        ax.set_axis_off()
    for ax, image, points, title in zip(axes.flat, images, u, titles, strict=False):
        show_image(ax, image)
        ax.set_title(title)
        h, w = image.shape[:2]
        inside = ((points > -0.5) & (points < (w - 0.5, h - 0.5))).all(axis=1)
        landmark_dots(ax, np.where(inside[:, None], points, np.nan), size=40)
    return fig


def learning_curves(logs: Mapping[str, list[dict[str, float]]]) -> Figure:
    """Loss and validation PCK against steps, one colour a training."""
    fig, (a, b, c) = figure(1, 3, width_in=11, height_in=3.4)
    for (name, log), colour in zip(logs.items(), (COLOURS["ours"], COLOURS["paper"], COLOURS["truth"]), strict=False):
        step = [row["step"] for row in log]
        a.plot(step, [row["loss"] for row in log], color=colour, label=f"{name}, training")
        a.plot(step, [row["validation_loss"] for row in log], color=colour, ls="--", label="validation")
        b.plot(step, [row["pck_0.10"] for row in log], color=colour, marker="o", ms=4, label="PCK@0.10")
        b.plot(step, [row["pck_0.05"] for row in log], color=colour, ls="--", marker="o", ms=4, label="PCK@0.05")
        c.plot(step, [row["median_px"] for row in log], color=colour, marker="o", ms=4, label=name)
    a.set(title="loss (1 = empty heatmaps)", xlabel="step")
    b.set(title="validation PCK", xlabel="step", ylabel="%", ylim=(0, 100))
    c.set(title="median error", xlabel="step", ylabel="px", yscale="log")
    a.set_ylim(bottom=0)
    c.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    c.yaxis.set_major_formatter("{x:g}")
    c.yaxis.set_minor_formatter("")
    a.legend()
    b.legend()
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
    ax.legend(loc="lower right")
    return fig


def _ellipse(axes: Axes, u: np.ndarray, covariance: np.ndarray, colour: str, probability: float = 0.95) -> None:
    values, vectors = np.linalg.eigh(covariance)
    size = 2 * np.sqrt(values * chi2.ppf(probability, 2))
    angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    axes.add_patch(Ellipse(u, size[1], size[0], angle=angle, fill=False, ec=colour, lw=1.6))


def detection(image: np.ndarray, evaluation: Evaluation, index: int, *, half_px: int = 14) -> Figure:
    """A frame with its detections, and each landmark close up: 95 % ellipse, detection (dot) and label (cross)."""
    fig, axes = figure(1, 4, width_in=11, height_in=2.9, width_ratios=[1.8, 1, 1, 1])
    found, truth = evaluation.landmarks, evaluation.u_true[index]
    show_image(axes[0], image[::2, ::2], evaluation.names[index])
    landmark_dots(axes[0], found.u[index] / 2 - 0.25, label=True)
    axes[0].legend(loc="lower left", labelcolor="white")
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
    fig, axes = figure(1, len(images), width_in=11, height_in=3.1, squeeze=False)
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


def real_frames(images: Sequence[np.ndarray], evaluation: Evaluation, indices: Sequence[int]) -> Figure:
    """Real frames with the detections (circles) and the clicked labels (crosses)."""
    fig, axes = figure(1, len(images), width_in=11, height_in=11.6 / max(1, len(images)), squeeze=False)
    for ax, image, i in zip(axes.flat, images, indices, strict=True):
        error = evaluation.error_px[i] / evaluation.length_px[i]
        show_image(ax, image, f"{evaluation.names[i]}: {100 * np.nanmax(error):.0f} % of the length off")
        landmark_dots(ax, evaluation.landmarks.u[i], size=110)
        ax.scatter(*evaluation.u_true[i].T, marker="+", s=110, c="white", linewidths=1.8)
        both = np.concatenate([evaluation.u_true[i], evaluation.landmarks.u[i]])
        low, high = np.nanmin(both, axis=0), np.nanmax(both, axis=0)
        reach = 0.5 * (high - low).max() + evaluation.length_px[i]
        x, y = (low + high) / 2
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
        ax.bar(i, row["pck_0.05"]["mean"], 0.55, color=COLOURS["ours"], alpha=0.4, label="mean" if i == 0 else None)
        ax.text(
            i, row["pck_0.05"]["mean"] / 2, f"{row['pck_0.05']['mean']:.1f}", ha="center", fontsize=13, weight="bold"
        )
        ax.plot(np.full(len(values), i), values, "o", color=COLOURS["ours"], ms=5, label="one seed" if i == 0 else None)
        ax.plot(i, paper[name], "D", color=COLOURS["paper"], ms=7, label="paper" if i == 0 else None)
    ax.set_xticks(range(len(columns)), list(columns))
    ax.set(ylabel="PCK@0.05, %", ylim=(0, 105), title="Ablation")
    ax.legend(loc="upper left")
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
    ax.legend(loc="upper left")
    return fig


def few_labels_curves(result: Mapping) -> Figure:
    """PCK@0.05 against the number of annotated frames: recorded means with two standard errors."""
    fig, ax = figure(width_in=8, height_in=3.8)
    for (name, rows), colour in zip(result["frames"].items(), (COLOURS["ours"], COLOURS["paper"]), strict=False):
        n = [int(count) for count in rows]
        mean = np.array([row["pck_0.05"]["mean"] for row in rows.values()])
        error = np.array([row["pck_0.05"]["standard_error"] or 0.0 for row in rows.values()], dtype=float)
        ax.errorbar(n, mean, yerr=2 * error, color=colour, marker="o", ms=6, capsize=4, label=name)
    ax.axhline(result["no_label"]["pck_0.05"], color=COLOURS["baseline"], ls="--", label="shipped weights, no label")
    ax.set(xscale="log", ylim=(0, 101), xlabel="annotated frames", ylabel="PCK@0.05, %", title="How many labels?")
    ax.set_xticks(n, [str(count) for count in n])
    ax.minorticks_off()
    ax.legend(title="bars: two standard errors")
    return fig


def label_noise_pairs(result: Mapping) -> Figure:
    """Recorded median error of networks trained with exact and with noisy labels; a line joins those of one seed."""
    fig, ax = figure(width_in=5.5, height_in=3.4)
    medians = np.array([result["labels"][name]["median_px"]["per_seed"] for name in ("exact", "noisy")])
    ax.plot([0, 1], medians, "o-", color=COLOURS["ours"], ms=7)
    ax.set_xticks([0, 1], ["exact labels", "noisy labels"])
    ax.set(xlim=(-0.4, 1.4), ylabel="median error, px", title=f"What noise costs: {_cost(result)} px")
    ax.set_ylim(0, 1.25 * medians.max())
    return fig


def _cost(result: Mapping) -> str:
    cost = result["median_cost_px"]
    error = cost["standard_error"]
    return f"{cost['mean']:+.3f}" + (" (one seed)" if error is None else f" ± {error:.3f}")


def _table(header: Sequence[str], rows: Sequence[Sequence[str]], *, width_in: float, first: float) -> Figure:
    """Rows of text under a bold header; the first column, `first` of the width, stands to the left."""
    fig, ax = figure(width_in=width_in, height_in=0.34 * (len(rows) + 1))
    ax.axis("off")
    rest = (1 - first) / (len(header) - 1)
    drawn = ax.table(
        [list(row) for row in rows], colLabels=list(header), edges="horizontal", cellLoc="center",
        colWidths=[first] + [rest] * (len(header) - 1), bbox=(0, 0, 1, 1),
    )  # fmt: skip
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(12)
    for (row, column), cell in drawn.get_celld().items():
        cell.set_edgecolor(COLOURS["baseline"])
        if row == 0:
            cell.set_text_props(weight="bold")
        if column == 0:
            cell.set_text_props(ha="left")
    return fig


def shipped_curve(result: Mapping) -> Figure:
    """Recorded PCK of the shipped detector: whole frames with tracking beside them, and the top enlarged."""
    fig, axes = figure(1, 2, width_in=11, height_in=3.8)
    at = np.array([0.01, 0.05, 0.10])
    for ax, lowest in zip(axes, (0.0, 95.0), strict=True):
        ax.plot(result["thresholds"], result["curve"], "o-", color=COLOURS["ours"], ms=4, label="whole frames")
        tracking = [result["tracking"][f"pck_{t:.2f}"] for t in at]
        ax.plot(at, tracking, "s", color=COLOURS["right"], ms=8, mfc="none", mew=2, label="tracking")
        ax.plot(0.05, 99.7, "D", color=COLOURS["paper"], ms=7, label="paper, 1080p")
        thresholds = np.array(result["thresholds"])
        first = thresholds[0] if lowest == 0 else 0.0075
        ax.set(xscale="log", xlim=(first, 1.05 * thresholds[-1]), ylim=(lowest, 100 + (100 - lowest) / 50))
        ticks = [t for t in (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2) if first <= t <= thresholds[-1]]
        ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
        ax.minorticks_off()
        ax.set(xlabel="threshold, part of the tool's length", ylabel="PCK, %")
    axes[0].set_title("Correct landmarks")
    axes[1].set_title("The top of it, enlarged")
    axes[0].legend(loc="lower right")
    return fig


def shipped_table(result: Mapping) -> Figure:
    """Recorded figures of the shipped detector: all whole frames, tracking, by landmark, by sequence."""
    rows: dict[str, Mapping] = {"all, whole frames": result["whole_frames"], "all, tracking": result["tracking"]}
    rows |= result["by_landmark"] | result["by_sequence"]

    def cells(row: Mapping) -> list[str]:
        pck = [row.get(f"pck_{t}", row.get(f"pck_{t.replace('.', '_')}")) for t in ("0.01", "0.05")]
        numbers = [f"{row['median_px']:.2f}", f"{row['p95_px']:.2f}", *(f"{p:.1f}" for p in pck)]
        return [*numbers, f"{row['nees']:.2f}", f"{row['coverage_95']:.1f}", f"{row['missed']}/{row['labels']}"]

    header = [
        "", "median, px", "95 %, px", "PCK@0.01", "PCK@0.05", "NEES (2)", "in 95 % ellipse", "missed",
    ]  # fmt: skip
    return _table(header, [[name, *cells(row)] for name, row in rows.items()], width_in=11.5, first=0.24)


def visibility_bars(rows: Mapping[str, Mapping[str, float]]) -> Figure:
    """Precision and recall of "seen" (`Evaluation.detection`) of each row, in two kinds of frames."""
    fig, ax = figure(width_in=9, height_in=3.2)
    names = [f"{there}_{what}" for there in ("in_view", "visible") for what in ("precision", "recall")]
    for i, ((label, row), colour) in enumerate(zip(rows.items(), (COLOURS["ours"], COLOURS["right"]), strict=True)):
        values = [row[name] for name in names]
        x = np.arange(len(names)) + 0.4 * i - 0.2
        ax.bar(x, values, 0.36, color=colour, alpha=0.7, label=label)
        for at, value in zip(x, values, strict=True):
            ax.text(at, value / 2, f"{value:.2f}", ha="center", va="center", fontsize=11, weight="bold")
    ax.set_xticks(
        range(len(names)),
        [name.replace("_", " ").replace("view ", "view\n").replace("ble ", "ble\n") for name in names],
    )
    ax.set(ylabel="%", ylim=(0, 119), title="Does it know what is there?")
    ax.legend(loc="upper right", ncols=2)
    return fig


def real_curves(thresholds: Sequence[float], curves: Mapping[str, Sequence[float]]) -> Figure:
    """PCK on real frames, a panel a kind of test; names are "sequence: what was trained on and tested on"."""
    panels: dict[str, dict[str, Sequence[float]]] = {}
    for name, curve in curves.items():
        sequence, how = name.split(": ", 1)
        kind = "another sequence" if how.startswith("first half to ") and how != "first half to second" else how
        label = f"{sequence} to {how.removeprefix('first half to ')}" if kind == "another sequence" else sequence
        panels.setdefault(kind, {})[label] = curve
    fig, axes = figure(1, max(1, len(panels)), width_in=11, height_in=3.5, sharey=True, squeeze=False)
    for ax, (kind, rows) in zip(axes.flat, panels.items(), strict=False):
        for (name, curve), colour in zip(
            rows.items(), (COLOURS["ours"], COLOURS["paper"], COLOURS["truth"]), strict=False
        ):
            ax.plot(thresholds, curve, "o-", color=colour, ms=4, label=name)
        ax.axvline(0.2, color=COLOURS["baseline"], lw=1)
        ax.set(xlim=(0.05, 0.5), ylim=(0, 101), xlabel="threshold, part of the tool's length", title=kind)
        ax.set_xticks([0.1, 0.2, 0.3, 0.4, 0.5])
        ax.legend(loc="best")
    axes.flat[0].set_ylabel("PCK, %")
    return fig


def half_within(thresholds: Sequence[float], curve: Sequence[float]) -> str:
    """How far a PCK curve is, in words: the part of the tool's length within which half of all landmarks lie."""
    curve = np.asarray(curve, dtype=float)
    reached = np.flatnonzero(curve >= 50)
    if not len(reached):
        return f"not even half within {100 * thresholds[-1]:.0f} % of the tool's length"
    end = reached[0]
    if end == 0:
        return f"half within less than {100 * thresholds[0]:.0f} % of the tool's length"
    at = np.interp(50, curve[end - 1 : end + 1], thresholds[end - 1 : end + 1])
    return f"half within {100 * at:.0f} % of the tool's length"


def engine_bars(rows: Mapping[str, Mapping]) -> Figure:
    """Recorded milliseconds of six windows on each engine: wall and CPU time, or why it failed."""
    fig, ax = figure(width_in=9, height_in=0.42 * len(rows) + 1.1)
    for i, row in enumerate(rows.values()):
        if "failed" in row:
            ax.text(0, i, " " + row["failed"][:70], va="center", color=COLOURS["warning"])
            continue
        for at, key, colour in ((i - 0.19, "cpu_ms", COLOURS["ours"]), (i + 0.19, "wall_ms", COLOURS["baseline"])):
            ax.barh(at, row[key], 0.36, color=colour, label=key.split("_")[0] if i == 0 else None)
            ax.text(row[key], at, f" {row[key]:.0f}", va="center")
    ax.set_yticks(range(len(rows)), list(rows))
    ax.set_ylim(len(rows) - 0.4, -0.6)
    ax.margins(x=0.1)
    handles = [Patch(color=COLOURS["ours"], label="CPU time"), Patch(color=COLOURS["baseline"], label="wall time")]
    ax.legend(handles=handles, loc="lower right")
    ax.set(xlabel="ms", title="Six windows of a stereo pair")
    return fig


def timing_bars(pairs_per_s: Mapping[str, float], paper_hz: Mapping[str, float]) -> Figure:
    """Stereo pairs a second of each row here, and the paper's on its graphics card; logarithmic."""
    fig, ax = figure(width_in=9, height_in=0.5 * len(pairs_per_s) + 1.1)
    for i, (name, rate) in enumerate(pairs_per_s.items()):
        ax.barh(i, rate, 0.6, color=COLOURS["baseline" if name.startswith("paper") else "ours"])
        ax.text(rate, i, f" {rate:.3g}", va="center", fontsize=11, weight="bold")
        if name in paper_hz:
            ax.plot(paper_hz[name], i, "D", color=COLOURS["paper"], ms=8)
            ax.text(1.15 * paper_hz[name], i, f"{paper_hz[name]:g}", va="center", color=COLOURS["paper"])
    ax.plot([], [], "D", color=COLOURS["paper"], label="paper, Titan X")
    ax.set_yticks(range(len(pairs_per_s)), list(pairs_per_s))
    ax.invert_yaxis()
    ax.set(xscale="log", xlabel="stereo pairs a second", title="Speed, decoding included")
    ax.set_xlim(0.5 * min(pairs_per_s.values()), 2 * max(*pairs_per_s.values(), *paper_hz.values()))
    ax.xaxis.set_major_formatter("{x:g}")
    ax.legend(loc="lower right", bbox_to_anchor=(1, 1))
    return fig


def loss_slopes(displacement_px: np.ndarray, losses: Mapping[str, Sequence[float]]) -> Figure:
    """What a heatmap costs that is a perfect Gaussian at a wrong place: each loss against the displacement."""
    fig, ax = figure(width_in=7.5, height_in=3.6)
    for (name, values), colour in zip(
        losses.items(), (COLOURS["baseline"], COLOURS["paper"], COLOURS["ours"]), strict=False
    ):
        ax.plot(displacement_px, values, color=colour, lw=2.5, label=name)
    ax.set(xlabel="the peak is displaced by, px", ylabel="loss", title="The last pixel", ylim=(0, None))
    ax.set_xlim(0, displacement_px[-1])
    ax.legend(loc="upper left")
    return fig


def error_groups(groups: Mapping[str, Mapping]) -> Figure:
    """Median error (dot) and 95th percentile (tick) of groups of landmarks, one panel a grouping: name -> its `Scores`."""
    fig, axes = figure(
        1,
        len(groups),
        width_in=11,
        height_in=3.2,
        squeeze=False,
        width_ratios=[max(2, len(r)) for r in groups.values()],
    )
    for ax, (title, rows) in zip(axes.flat, groups.items(), strict=True):
        for i, s in enumerate(rows.values()):
            ax.plot([i, i], [s.median_px, s.p95_px], color=COLOURS["baseline"], lw=1.5)
            ax.plot(i, s.median_px, "o", color=COLOURS["ours"], label="median" if i == 0 else None)
            ax.plot(i, s.p95_px, "_", color=COLOURS["paper"], ms=14, mew=2, label="95 %" if i == 0 else None)
        ax.set_xticks(range(len(rows)), [f"{name}\n({s.labels})" for name, s in rows.items()])
        ax.set(title=title, ylabel="error, px", xlim=(-0.6, len(rows) - 0.4))
        ax.set_ylim(bottom=0)
    axes.flat[0].legend()
    return fig


def frame_explorer(
    image: np.ndarray, found: Landmarks, windows: np.ndarray, matrices: np.ndarray, heatmaps: np.ndarray
) -> Figure:
    """One frame with its landmarks; each landmark's window with its heatmap laid over, and its 95 % ellipse.

    `windows` (m, s, s, 3), `matrices` window_from_image (m, 2, 3) and `heatmaps` (m, h, w) of the m landmarks found.
    """
    fig, axes = figure(1, 4, width_in=11, height_in=2.7, width_ratios=[1.8, 1, 1, 1])
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
        reach = 16
        ax.set(xlim=(u[0] - reach, u[0] + reach), ylim=(u[1] + reach, u[1] - reach))
    return fig


def closeups(windows: np.ndarray, expected: np.ndarray, seen: Peaks, kept: Peaks, names: Sequence[str]) -> Figure:
    """Closeups (n, s, s, 3): where the windows said the landmark lies (cross, `expected` (n, 2)), where the network sees
    it with its 95 % ellipse (`seen`, (n, 1)), and what is believed (dot, `kept`, (n, 1)); below, 12 px of each."""
    fig, axes = figure(2, len(windows), width_in=9, height_in=6.2, squeeze=False)
    for i, (whole, ax, name) in enumerate(zip(*axes, names, strict=True)):
        show_image(whole, windows[i], name)
        whole.plot(*expected[i], "+", ms=14, mew=1.5, color="white")
        show_image(ax, windows[i], "")
        x, y = expected[i]
        ax.set(xlim=(x - 6, x + 6), ylim=(y + 6, y - 6))
        deviation = np.sqrt(np.diag(seen.covariance[i, 0].numpy()))
        ax.plot(*expected[i], "+", ms=18, mew=2, color="white", label="windows")
        size = 2 * np.sqrt(chi2.ppf(0.95, 2)) * deviation
        ax.add_patch(Ellipse(seen.u[i, 0].numpy(), *size, fill=False, ec="yellow", lw=2, label="closeup, 95 %"))
        ax.plot(*kept.u[i, 0].numpy(), "o", ms=7, color=COLOURS["ours"], label="believed")
    axes[1, 0].legend(loc="lower left")
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
    ax.xaxis.set_major_formatter("{x:g}")
    ax.legend(title="median", loc="upper left")
    return fig


def stages(image: np.ndarray, panels: Sequence[tuple[str, np.ndarray, np.ndarray]], u: np.ndarray) -> Figure:
    """Coarse to fine: the frame with its landmarks, then (title, input, heatmap) of each stage."""
    fig, axes = figure(
        1, 1 + len(panels), width_in=11.5, height_in=2.0, width_ratios=[1.7, 1.7] + [1.0] * (len(panels) - 1)
    )
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
