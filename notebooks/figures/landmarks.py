"""Figures of notebook 02 with results of its own run: network, heatmaps, augmentation, training, detections."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, FancyArrowPatch, FancyBboxPatch
from matplotlib.ticker import LogLocator
from scipy.special import chdtr, chdtri

from lib.landmarks import Landmarks
from lib.landmarks.heatmaps import Peaks
from lib.landmarks.metrics import PCK_THRESHOLDS, reliability
from lib.landmarks.network import HourglassConfig
from lib.recordings import Recording
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE
from lib.training.evaluation import Evaluation
from notebooks.figures.style import COLOURS, LANDMARK_COLOURS, ON_IMAGE, figure, show_image


def landmark_dots(axes: Axes, u: np.ndarray, *, size: float = 60.0, label: bool = False) -> None:
    """Draw landmarks (3, 2) px as open circles in their colours; NaN is left out."""
    for (name, colour), point in zip(LANDMARK_COLOURS.items(), u, strict=True):
        axes.scatter(
            *point, s=size, facecolors="none", edgecolors=colour, linewidths=1.8, label=name if label else None
        )


def network_page(config: HourglassConfig, parameters: int) -> Figure:
    """The stacked hourglass: boxes are blocks, their heights show the resolution, arcs are skip connections."""
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


def _pale(image: np.ndarray) -> np.ndarray:
    """Light grey values of an image (h, w, 3), uint8 or in [0, 1], as a background for a heatmap."""
    grey = image.mean(axis=2)
    low, high = np.percentile(grey, (1, 99))
    return np.repeat(0.45 + 0.5 * np.clip((grey - low) / max(high - low, 1e-9), 0, 1)[..., None], 3, axis=2)


def _lay_over(ax: Axes, heatmap: np.ndarray, extent: tuple[float, float, float, float]) -> None:
    """Draw a heatmap in [0, 1] over an image; it is transparent where it is 0."""
    shown = np.clip(heatmap, 0, 1)
    ax.imshow(shown, cmap="magma_r", alpha=np.minimum(1.6 * shown, 0.9), extent=extent, vmin=0, vmax=1)


def heatmap_grid(image: np.ndarray, heatmaps: np.ndarray, u: np.ndarray, stride: int) -> Figure:
    """An image with landmarks `u` (3, 2) px, then with each of its heatmaps (3, h, w), divided by the peak, over it."""
    fig, axes = figure(1, 4, width_in=10.5, height_in=2.9)
    show_image(axes[0], image, "image and landmarks")
    landmark_dots(axes[0], u, size=90)
    h, w = heatmaps.shape[1:]
    axes[0].set(xlim=(-0.5, image.shape[1] - 0.5), ylim=(image.shape[0] - 0.5, -0.5))
    extent = (-0.5, w * stride - 0.5, h * stride - 0.5, -0.5)
    for k, (ax, name, heatmap) in enumerate(zip(axes[1:], LANDMARK_COLOURS, heatmaps, strict=True)):
        show_image(ax, _pale(image), f"{name}: peak {heatmap.max():.2f}")
        _lay_over(ax, heatmap / heatmap.max(), extent)
        landmark_dots(ax, np.where(np.arange(3)[:, None] == k, u, np.nan), size=90)
        ax.set(xlim=(-0.5, image.shape[1] - 0.5), ylim=(image.shape[0] - 0.5, -0.5))
    return fig


def printed_equation(truths: np.ndarray, printed: np.ndarray, normalised: np.ndarray, size: tuple[int, int]) -> Figure:
    """Positions (n, 2) that both forms of Eq. (1) give for peaks at `truths` in an image of `size` (rows, columns)."""
    fig, (a, b) = figure(1, 2, width_in=11, height_in=4.2, width_ratios=(1.15, 1))
    for i, (truth, wrong, right) in enumerate(zip(truths, printed, normalised, strict=True)):
        a.annotate("", wrong, truth, arrowprops={"arrowstyle": "-", "color": "#cccccc"})
        a.plot(*truth, "+", color="black", ms=11, label="truth" if i == 0 else None)
        a.plot(*wrong, "o", color=COLOURS["paper"], ms=5, label="as printed" if i == 0 else None)
        a.plot(*right, "o", mfc="none", color=COLOURS["ours"], ms=9, mew=1.5, label="normalised" if i == 0 else None)
    a.set(xlim=(-10, size[1]), ylim=(size[0], -10), aspect="equal", xlabel="x, px", ylabel="y, px", title="In the image")
    a.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=3)
    distance = np.linalg.norm(truths, axis=1)
    for found, name, colour in ((printed, "as printed", "paper"), (normalised, "normalised", "ours")):
        b.plot(distance, np.linalg.norm(found - truths, axis=1), "o", color=COLOURS[colour], label=name)
    b.set(yscale="log", xlabel="distance from the origin, px", ylabel="error, px", title="Error")
    b.yaxis.set_major_formatter("{x:g}")
    b.legend(loc="center right")
    return fig


def disc_page(p: np.ndarray, truth: np.ndarray, found: Mapping[str, np.ndarray], radius: float) -> Figure:
    """A heatmap (h, w) with the disc of Eq. (1) and the decoded positions, and a section through the peak's row."""
    fig, (a, b) = figure(1, 2, width_in=9.5, height_in=3.6, width_ratios=(1, 1.3))
    show_image(a, p, "heatmap")
    a.images[0].set_cmap("inferno")
    row, column = np.unravel_index(p.argmax(), p.shape)
    a.add_patch(plt.Circle((column, row), radius, fill=False, ec="white", lw=1.5))
    a.plot(*truth, "+", color="white", ms=14, mew=2)
    b.plot(p[row], color=COLOURS["baseline"], label="heatmap")
    b.axvspan(column - radius, column + radius, color="#e8f1f8", zorder=0, label="disc")
    b.axvline(truth[0], color=COLOURS["truth"], lw=1.2, label="truth")
    for (name, u), colour in zip(found.items(), ("paper", "ours"), strict=False):
        a.plot(*u, "o", color=COLOURS[colour], ms=6)
        b.axvline(u[0], color=COLOURS[colour], ls="--", label=f"{name}: {np.linalg.norm(u - truth):.2f} px off")
    b.set(xlabel="x, px", title="Row of the peak", xlim=(0, p.shape[1] - 1))
    b.legend(fontsize=9)
    return fig


def augmented(images: Sequence[np.ndarray], u: Sequence[np.ndarray], titles: Sequence[str]) -> Figure:
    """Images (h, w, 3) in [0, 1] or uint8 with their landmarks; one row for each title, which stands over its first image."""
    rows, columns = len(titles), len(images) // len(titles)
    fig, axes = figure(rows, columns, width_in=10, height_in=1.8 * rows, squeeze=False)
    for ax in axes.flat:
        ax.set_axis_off()
    for k, (ax, image, points) in enumerate(zip(axes.flat, images, u, strict=True)):
        show_image(ax, image, "" if k % columns else titles[k // columns])
        h, w = image.shape[:2]
        inside = ((points > -0.5) & (points < (w - 0.5, h - 0.5))).all(axis=1)
        landmark_dots(ax, np.where(inside[:, None], points, np.nan), size=40)
    return fig


def learning_curves(logs: Mapping[str, list[dict[str, float]]]) -> Figure:
    """Loss, validation PCK and median error against the steps, one colour for each training."""
    fig, (a, b, c) = figure(1, 3, width_in=11, height_in=3.4)
    for (name, log), colour in zip(logs.items(), (COLOURS["ours"], COLOURS["paper"], COLOURS["truth"]), strict=False):
        step = [row["step"] for row in log]
        a.plot(step, [row["loss"] for row in log], color=colour, marker="o", ms=4, label=f"{name}, training")
        a.plot(step, [row["validation_loss"] for row in log], color=colour, ls="--", marker="o", ms=4, label="validation")
        b.plot(step, [row["pck_0.10"] for row in log], color=colour, marker="o", ms=4, label="PCK@0.10")
        b.plot(step, [row["pck_0.05"] for row in log], color=colour, ls="--", marker="o", ms=4, label="PCK@0.05")
        c.plot(step, [row["median_px"] for row in log], color=colour, marker="o", ms=4, label=name)
    a.set(title="Loss (1 = empty heatmaps)", xlabel="step")
    b.set(title="Validation PCK", xlabel="step", ylabel="%", ylim=(0, 100))
    c.set(title="Validation median error", xlabel="step", ylabel="px", yscale="log")
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
    """PCK in percent against the threshold.  The axis is logarithmic, since detectors differ at strict thresholds."""
    fig, ax = figure(width_in=8, height_in=3.8)
    for name, curve in curves.items():
        colour = LANDMARK_COLOURS.get(name, "black")
        ax.plot(thresholds, curve, color=colour, lw=1.8 if name in LANDMARK_COLOURS else 2.6, label=name)
    if paper:
        ax.plot(0.05, 99.7, "D", color=COLOURS["paper"], label="paper, 1080p, PCK@0.05")
    ax.set(xscale="log", xlim=(thresholds[0], thresholds[-1]), ylim=(0, 101))
    ax.set(xlabel="threshold, fraction of the tool's length", ylabel="PCK, %", title="Correct landmarks")
    ticks = [t for t in (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5) if thresholds[0] <= t <= thresholds[-1]]
    ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
    ax.minorticks_off()
    ax.legend(loc="lower right")
    return fig


def worst(result: Evaluation, n: int) -> np.ndarray:
    """Indices of the n images with the largest error."""
    return np.argsort(-np.nan_to_num(result.error_px, nan=-1.0, posinf=1e9).max(1), kind="stable")[:n]


def _ellipse(axes: Axes, u: np.ndarray, covariance: np.ndarray, colour: str, probability: float = 0.95) -> None:
    values, vectors = np.linalg.eigh(covariance)
    size = 2 * np.sqrt(values * chdtri(2, 1 - probability))
    angle = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    axes.add_patch(Ellipse(u, size[1], size[0], angle=angle, fill=False, ec=colour, lw=1.6))


def detection(image: np.ndarray, evaluation: Evaluation, index: int, *, half_px: int = 14) -> Figure:
    """A frame with its detections, and each landmark enlarged: 95 % ellipse, detection (dot) and label (cross)."""
    fig, axes = figure(1, 4, width_in=11, height_in=2.9, width_ratios=[1.8, 1, 1, 1])
    found, truth = evaluation.landmarks, evaluation.u_true[index]
    show_image(axes[0], image[::2, ::2], evaluation.names[index])
    landmark_dots(axes[0], found.u[index] / 2 - 0.25, label=True)
    axes[0].legend(loc="lower left", **ON_IMAGE)
    h, w = image.shape[:2]
    for k, (ax, (name, colour)) in enumerate(zip(axes[1:], LANDMARK_COLOURS.items(), strict=True)):
        centre = found.u[index, k] if np.isfinite(found.u[index, k]).all() else truth[k]
        show_image(ax, image, f"{name}: missed")
        if not np.isfinite(centre).all():
            continue
        x, y = np.clip(np.round(centre), half_px, (w - 1 - half_px, h - 1 - half_px))
        ax.set(xlim=(x - half_px - 0.5, x + half_px + 0.5), ylim=(y + half_px + 0.5, y - half_px - 0.5))
        ax.images[0].set_interpolation("nearest")
        for size, width, colour_of_label in ((200, 3.6, "black"), (160, 1.6, "white")):  # visible on metal, too
            ax.scatter(*truth[k], marker="+", s=size, c=colour_of_label, linewidths=width)
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


def uncertainty(evaluation: Evaluation, squared: np.ndarray) -> Figure:
    """Are covariance and confidence right?  Distribution of normalised squared errors, and reliability."""
    fig, (a, b) = figure(1, 2, width_in=11, height_in=3.4)
    values = np.sort(squared[np.isfinite(squared)])
    grid = np.linspace(0, 12, 200)
    a.plot(grid, 100 * np.searchsorted(values, grid) / max(len(values), 1), color=COLOURS["ours"], label="detections")
    a.plot(grid, 100 * chdtr(2, grid), color=COLOURS["truth"], ls="--", label="if covariances are right")
    a.axvline(chdtri(2, 0.05), color=COLOURS["baseline"], lw=1, label="95 % ellipse")
    a.set(title="Squared error over covariance", xlabel="normalised squared error", ylabel="% below", ylim=(0, 101))
    a.legend()
    labelled = ~np.isnan(evaluation.error_px)
    mean, fraction, count = reliability(evaluation.landmarks.confidence[labelled], evaluation.correct[labelled])
    used = count > 0
    b.plot([0, 1], [0, 1], color=COLOURS["truth"], ls="--", label="if confidence is right")
    b.scatter(
        mean[used], fraction[used], s=20 + 3 * np.sqrt(count[used]) * 5, color=COLOURS["ours"], label="detections"
    )
    for at, share, n in zip(mean[used], fraction[used], count[used], strict=True):
        b.annotate(f"{n:.0f}", (at, share), (0, -16), textcoords="offset points", ha="center", fontsize=9)
    # The dots of a good detector lie in the upper right corner, so the axes show no more than the dots need.
    low = max(min(mean[used].min(initial=1), fraction[used].min(initial=1)) - 0.15, -0.02)
    b.set(title="Reliability", xlabel="confidence", ylabel="fraction correct", xlim=(low, 1.03), ylim=(low, 1.03))
    b.legend(loc="lower right")
    return fig


def timing_bars(ms: Mapping[str, float], paper_hz: Mapping[str, float], *, title: str) -> Figure:
    """Stereo pairs per second, from milliseconds per pair, and the paper's on its graphics card; logarithmic."""
    pairs_per_s = {name: 1e3 / value for name, value in ms.items()}
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
    ax.set(xscale="log", xlabel="stereo pairs per second", title=title)
    ax.set_xlim(0.5 * min(pairs_per_s.values()), 2 * max(*pairs_per_s.values(), *paper_hz.values()))
    ax.xaxis.set_major_formatter("{x:g}")
    ax.legend(loc="lower right", bbox_to_anchor=(1, 1))
    return fig


def loss_slopes(displacement_px: np.ndarray, losses: Mapping[str, Sequence[float]]) -> Figure:
    """Each loss of a heatmap that is a perfect Gaussian, against the displacement of the Gaussian."""
    fig, ax = figure(width_in=7.5, height_in=3.6)
    for (name, values), colour in zip(
        losses.items(), (COLOURS["baseline"], COLOURS["paper"], COLOURS["ours"]), strict=False
    ):
        ax.plot(displacement_px, values, color=colour, lw=2.5, label=name)
    ax.set(xlabel="displacement of the peak, px", ylabel="loss", title="Loss against displacement", ylim=(0, None))
    ax.set_xlim(0, displacement_px[-1])
    ax.legend(loc="upper left")
    return fig


def focus_distance_mm(recording: Recording, *, every: int = 1) -> np.ndarray:
    """Depth (n, 3) mm of the landmarks beyond the focal plane, in the order of `lib.training.samples.labelled_images`.

    Raises
    ------
    ValueError
        If the recording is not simulated.
    """
    if recording.truth is None:
        raise ValueError(f"{recording.name}: has no truth/, so the distance from focus is unknown; give a simulated one.")
    x = recording.truth.landmarks_mm[: len(recording.frames) : every]
    z = ROBOT_FROM_MICROSCOPE.inverse().apply(x.reshape(-1, 3))[:, 2].reshape(-1, 3)
    return np.repeat(z, 2, axis=0)


def error_groups(groups: Mapping[str, Mapping]) -> Figure:
    """Median error (dot) and 95th percentile (tick) of groups of landmarks; `groups`: panel -> name -> `Scores`."""
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
    """One frame with its landmarks; for each landmark the window with the heatmap over it, and the 95 % ellipse.

    `windows` (m, s, s, 3), `matrices` (m, 2, 3), window_from_image, and `heatmaps` (m, h, w) belong to the m landmarks found.
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
        show_image(ax, _pale(window), f"{names[k]}: confidence {found.confidence[0, k]:.2f}")
        _lay_over(ax, heatmap, (-0.5, side - 0.5, side - 0.5, -0.5))
        u = matrix[:, :2] @ found.u[0, k] + matrix[:, 2]
        covariance = matrix[:, :2] @ found.covariance[0, k] @ matrix[:, :2].T
        _ellipse(ax, u, covariance, LANDMARK_COLOURS[names[k]])
        reach = 16
        ax.set(xlim=(u[0] - reach, u[0] + reach), ylim=(u[1] + reach, u[1] - reach))
    return fig


def closeups(windows: np.ndarray, expected: np.ndarray, seen: Peaks, kept: Peaks, names: Sequence[str]) -> Figure:
    """Closeups (n, s, s, 3), and 12 px of each below.

    A cross is the position `expected` (n, 2) from the tool's window, an ellipse the closeup's 95 % ellipse (`seen`, peaks
    (n, 1)), a dot the corrected position (`kept`, peaks (n, 1)).
    """
    fig, axes = figure(2, len(windows), width_in=9, height_in=6.2, squeeze=False)
    for i, (whole, ax, name) in enumerate(zip(*axes, names, strict=True)):
        show_image(whole, windows[i], name)
        whole.plot(*expected[i], "+", ms=14, mew=1.5, color="white")
        show_image(ax, windows[i], "")
        x, y = expected[i]
        ax.set(xlim=(x - 6, x + 6), ylim=(y + 6, y - 6))
        deviation = np.sqrt(np.diag(seen.covariance[i, 0].numpy()))
        ax.plot(*expected[i], "+", ms=18, mew=2, color="white", label="tool's window")
        size = 2 * np.sqrt(chdtri(2, 0.05)) * deviation
        ax.add_patch(Ellipse(seen.u[i, 0].numpy(), *size, fill=False, ec="yellow", lw=2, label="closeup, 95 %"))
        ax.plot(*kept.u[i, 0].numpy(), "o", ms=7, color=COLOURS["ours"], label="corrected")
    axes[1, 0].legend(loc="lower left", fontsize=8, **ON_IMAGE)
    return fig


def decoder_errors(errors_px: Mapping[str, np.ndarray]) -> Figure:
    """Distribution of the errors of several decoders on the same heatmaps."""
    fig, ax = figure(width_in=8, height_in=3.4)
    looks = zip(("baseline", "paper", "right", "truth", "ours"), ("-", "-", "--", "-.", "-"), strict=True)
    for (colour, line), (name, error) in zip(looks, errors_px.items(), strict=False):
        error = np.sort(error[np.isfinite(error)])
        share = 100 * np.arange(1, len(error) + 1) / len(error)
        ax.plot(error, share, line, color=COLOURS[colour], label=f"{name.replace('_', '-')}: {np.median(error):.2f} px")
    ax.set(
        xscale="log",
        xlim=(0.05, 20),
        ylim=(0, 101),
        xlabel="error, px",
        ylabel="% below",
        title="Decoders on trained heatmaps",
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
        show_image(ax, _pale(seen), title)
        h, w = seen.shape[:2]
        _lay_over(ax, heatmap, (-0.5, w - 0.5, h - 0.5, -0.5))
        ax.set(xlim=(-0.5, w - 0.5), ylim=(h - 0.5, -0.5))
    return fig
