"""Figures of notebook 05: moved microscope, errors against frames, ICP, noise in 3D, drift, a single moved camera."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from lib.cameras import StereoRig
from lib.geometry import RigidTransform
from lib.registration import DriftMonitor
from notebooks.figures.style import COLOURS, figure
from notebooks.studies.moved_cameras import MotionErrors

#: With fewer trials, quartiles are not drawn.
_FEW = 30
_ESTIMATORS = {
    "squared norms": (COLOURS["baseline"], "s", "--"),
    "sum of norms, Eq. (7)": (COLOURS["paper"], "o", "-"),
    "images": (COLOURS["ours"], "D", "-"),
    "images, robust": (COLOURS["truth"], "^", "-"),
}


def _style(name: str) -> dict:
    colour, marker, line = _ESTIMATORS.get(name, ("black", "x", "-"))
    return {"color": colour, "marker": marker, "linestyle": line, "markersize": 5, "label": name}


def moved_tool(
    x_robot: np.ndarray,
    x_stale: np.ndarray,
    x_registered: np.ndarray,
    microscope_from_robot: RigidTransform,
) -> Figure:
    """The tool's landmarks from above and from the side: from the robot, from the old rig, and registered.

    Parameters
    ----------
    x_robot, x_stale, x_registered:
        (n, 3, 3) mm: base, tip_1, tip_2 in n frames.
    """
    sets = (
        ("robot", x_robot, COLOURS["truth"], 6.0),
        ("old rig", x_stale, COLOURS["paper"], 1.4),
        ("registered", x_registered, COLOURS["ours"], 1.4),
    )
    seen = np.concatenate([microscope_from_robot.apply(x).reshape(-1, 3) for _, x, _, _ in sets])
    low, high = seen.min(axis=0) - 0.4, seen.max(axis=0) + 0.4
    width, _, depth = high - low
    # Both panels have the same scale and share the y axis.
    page, axes = figure(1, 2, width_in=10, height_in=5.4, sharey=True, width_ratios=(width, depth))
    for ax, i, title in zip(axes, (0, 2), ("From above", "From the side"), strict=True):
        for label, x, colour, line_width in sets:
            for k, frame in enumerate(microscope_from_robot.apply(x)):
                jaws = frame[[1, 0, 2]]
                style = {"color": colour, "linewidth": line_width, "markersize": 3.5, "alpha": 0.4 if line_width > 2 else 1}
                ax.plot(jaws[:, i], jaws[:, 1], "-o", label=label if k == 0 else None, **style)
        ax.set(title=title, aspect="equal", xlim=(low[i], high[i]), ylim=(high[1], low[1]))
    axes[0].set(xlabel="x in mm", ylabel="y in mm")
    axes[1].set(xlabel="depth z in mm")
    page.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return page


def error_curves(errors: Mapping[str, MotionErrors], *, paper_um: float | None = 150.0, title: str = "") -> Figure:
    """The paper's figure "Tool Registration": RMS errors against the number of frames.

    A band shows the quartiles of the trials; fewer than `_FEW` trials are drawn one by one.
    """
    page = plt.figure(figsize=(10, 5.4), layout="constrained")
    panels = page.subplot_mosaic([["shift", "X"], ["shift", "Y"], ["shift", "Z"]], width_ratios=(1.5, 1))
    axes = list(panels.values())
    for name, error in errors.items():
        style = _style(name)
        n = np.array(error.n_frames)
        axes[0].plot(n, error.translation_rms_um, **style)
        if error.trials.max() < _FEW:
            every = np.broadcast_to(n, error.translation_mm.shape)
            axes[0].plot(every.ravel(), 1e3 * error.translation_mm.ravel(), ".", color=style["color"], alpha=0.3)
        else:
            low, high = 1e3 * np.nanpercentile(error.translation_mm, [25, 75], axis=0)
            axes[0].fill_between(n, low, high, color=style["color"], alpha=0.15, linewidth=0)
        for k in range(3):
            axes[k + 1].plot(n, error.euler_rms_deg[:, k], **style)
    if paper_um is not None:
        axes[0].axhline(paper_um, color=COLOURS["warning"], linestyle=":", label="paper: below this after 3 frames")
    ticks = list(next(iter(errors.values())).n_frames)
    shared = [value for error in errors.values() for value in error.euler_rms_deg.ravel()]
    for k, ax in enumerate(axes):
        ax.set(xscale="log", yscale="log", xlabel="frames" if k in (0, 3) else "")
        ax.set_xticks(ticks, [str(t) if t in (1, 2, 3, 5, 10) else "" for t in ticks])
        ax.minorticks_off()
        if k:
            ax.set_title(f"Rotation about {'xyz'[k - 1]}, in degrees")
            ax.set_ylim(0.8 * np.nanmin(shared), 1.25 * np.nanmax(shared))
        _plain_log_ticks(ax, (1,) if k else (1, 2, 5))
    axes[0].set_title("Translation in um")
    page.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    if title:
        page.suptitle(title, x=0.01, ha="left", fontsize=11)
    return page


def _plain_log_ticks(ax, digits: Sequence[int] = (1, 2, 5)) -> None:
    low, high = ax.get_ylim()
    ticks = [m * 10.0**e for e in range(-4, 6) for m in digits if low <= m * 10.0**e <= high]
    ax.set_yticks(ticks, [f"{t:g}" for t in ticks])


def icp_chart(shift_mm: Sequence[float], error_um: Mapping[str, np.ndarray]) -> Figure:
    """Errors (trials, k) of each method against the size of the motion (k,), with their median as a line."""
    page, ax = figure(1, 1, width_in=8, height_in=3.8)
    for (name, errors), colour in zip(error_um.items(), (COLOURS["ours"], COLOURS["paper"]), strict=True):
        ax.plot(np.broadcast_to(shift_mm, errors.shape).ravel(), errors.ravel(), ".", color=colour, alpha=0.3)
        ax.plot(shift_mm, np.median(errors, axis=0), "o-", color=colour, markersize=5, label=name)
    ax.set(xscale="log", yscale="log", xlabel="shift of the microscope in mm", ylabel="translation error in um")
    ax.set_xticks(shift_mm, [f"{shift:g}" for shift in shift_mm])
    ax.minorticks_off()
    _plain_log_ticks(ax)
    ax.legend()
    return page


def noise_ellipses(rig: StereoRig, sigma_px: float, microscope_from_robot: RigidTransform) -> Figure:
    """One-sigma ellipses of a triangulated landmark, from above and from the side, at the same scale."""
    covariance_px2 = sigma_px**2
    covariance = rig.triangulate(np.zeros((1, 2)), np.zeros((1, 2)), covariance_px2).covariance_mm2[0]
    covariance = 1e6 * microscope_from_robot.R @ covariance @ microscope_from_robot.R.T
    page, axes = figure(1, 2, width_in=8, height_in=4)
    reach = 1.25 * np.sqrt(covariance.diagonal().max())
    for ax, (i, j), title in zip(axes, ((0, 1), (0, 2)), ("From above", "From the side"), strict=True):
        values, vectors = np.linalg.eigh(covariance[np.ix_((i, j), (i, j))])
        angle = np.rad2deg(np.arctan2(vectors[1, 1], vectors[0, 1]))
        ax.add_patch(Ellipse((0, 0), *(2 * np.sqrt(values[::-1])), angle=angle, facecolor=COLOURS["ours"], alpha=0.5))
        sd = np.sqrt(covariance.diagonal())
        ax.set(
            xlim=(-reach, reach),
            ylim=(reach, -reach),
            aspect="equal",
            xlabel=f"x in um (sd {sd[0]:.0f})",
            ylabel=f"{'xyz'[j]} in um (sd {sd[j]:.0f})",
            title=title,
        )
    return page


def drift_chart(monitors: Mapping[str, DriftMonitor], shift_at: int) -> Figure:
    """Chi-square of each frame (left); cumulative sum and alarm level (right)."""
    page, axes = figure(1, 2, width_in=12, height_in=3.8)
    colours = [COLOURS["baseline"], COLOURS["right"], COLOURS["ours"], COLOURS["paper"]]
    for (name, monitor), colour in zip(monitors.items(), colours, strict=False):
        chi2, freedom, statistic = np.array(monitor.history).T
        axes[0].plot(chi2 / freedom, color=colour, linewidth=1.0, label=name)
        axes[1].plot(statistic, color=colour, label=name)
    axes[0].set(yscale="log", xlabel="frame", title="Chi-square of a frame per degree of freedom")
    axes[1].axhline(1.0, color="black", linestyle=":", linewidth=1)
    axes[1].set(ylim=(0, 3), xlabel="frame", title="Cumulative sum and alarm level")
    for ax in axes:
        ax.axvline(shift_at - 0.5, color=COLOURS["truth"], linestyle="--", linewidth=1)
    axes[1].legend(loc="upper left")
    return page


def hypotheses(bic: Mapping[str, float], error_um: Mapping[str, float]) -> Figure:
    """BIC of each hypothesis minus that of the best one (left); triangulation error after each correction (right)."""
    page, axes = figure(1, 2, width_in=11, height_in=3.4)
    names = list(bic)
    excess = np.array([bic[name] for name in names])
    excess = excess - excess.min()
    colours = [COLOURS["truth"] if value == 0 else COLOURS["baseline"] for value in excess]
    axes[0].barh(names, excess, color=colours)
    for i, value in enumerate(excess):
        axes[0].text(value, i, f" {value:.0f}" if value else " best", va="center")
    axes[0].set(xlabel="BIC above the best", xlim=(0, 1.15 * excess.max()), title="Which camera moved?")
    axes[0].invert_yaxis()
    _bars(axes[1], list(error_um), list(error_um.values()))
    axes[1].set(xlabel="RMS triangulation error in um", title="Error after each correction")
    for ax in axes:
        ax.grid(axis="y", visible=False)
    return page


def weights_view(error_um: Mapping[str, np.ndarray], off_px: np.ndarray, weights: np.ndarray, title: str) -> Figure:
    """Errors (n,) um of the landmarks after registration with each loss (left); weights (n,) that Eq. (7) gives to
    landmarks, against the larger error `off_px` (n,) of their two detections (right)."""
    page, (left, right) = figure(1, 2, width_in=11, height_in=3.6)
    looks = {"squared": ("squared norms", "paper"), "norm": ("sum of norms, Eq. (7)", "ours")}
    for loss, (name, colour) in looks.items():
        share = 100 * np.arange(1, len(error_um[loss]) + 1) / len(error_um[loss])
        left.plot(np.sort(error_um[loss]), share, color=COLOURS[colour], label=name)
    left.set(xscale="log", xlim=(5, 5e4), xlabel="error after registration (um)", ylabel="landmarks below (%)")
    left.set_title(title)
    left.legend(loc="lower right", fontsize=9)
    right.plot(off_px, weights / weights.max(), "o", color=COLOURS["ours"], markersize=5, alpha=0.7)
    right.set(xscale="log", xlim=(0.3, 200), xlabel="larger error of the two detections (px)")
    right.set(yscale="log", ylim=(1e-4, 2), ylabel="weight (largest 1)", title="Weights of the landmarks in Eq. (7)")
    for axis in (left.xaxis, right.xaxis, right.yaxis):
        axis.set_major_formatter("{x:g}")
    return page


def _bars(ax, names: Sequence[str], values: Sequence[float]) -> None:
    ax.barh(names, values, color=[COLOURS["truth"] if v == min(values) else COLOURS["paper"] for v in values])
    for i, value in enumerate(values):
        ax.text(value, i, f" {value:.0f}", va="center")
    ax.set_xlim(0, 1.15 * max(values))
    ax.invert_yaxis()
