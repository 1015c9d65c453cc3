"""Figures of notebook 02 about distribution shift: images unlike those of the training, and real ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from lib.training.evaluation import Evaluation
from lib.workbench.results import Table
from notebooks.figures.landmarks import landmark_dots
from notebooks.figures.style import COLOURS, figure, show_image


def rung_page(
    evaluation: Evaluation, images: Sequence[np.ndarray], order: Sequence[int] | None = None, *, columns: int = 6
) -> Figure:
    """Images, cut to the surroundings of the tool, in the given `order`; None = the largest error first.

    Circles are detections, crosses labels.  A title gives the largest error in per cent of the tool's length, and the lowest
    confidence.  It is red if a landmark has a confidence of 0.9 or more and an error above a fifth of the length.
    """
    relative = np.nan_to_num(evaluation.error_px / evaluation.length_px[:, None], nan=-1.0, posinf=1e9).max(axis=1)
    order = np.argsort(-relative, kind="stable") if order is None else order
    rows = -(-len(order) // columns)
    fig, axes = figure(rows, columns, width_in=12, height_in=(12 / columns + 0.5) * rows, squeeze=False)
    for ax in axes.flat[len(order) :]:
        ax.set_axis_off()
    for ax, i in zip(axes.flat, order, strict=False):
        image, found, truth = images[i], evaluation.landmarks.u[i], evaluation.u_true[i]
        error, confidence = evaluation.error_px[i] / evaluation.length_px[i], evaluation.landmarks.confidence[i]
        known = ~np.isnan(error)
        worst = "none in view" if not known.any() else "missed" if np.isinf(error[known]).any() else None
        worst = worst or f"{100 * error[known].max():.0f} % off"
        show_image(ax, image)
        landmark_dots(ax, found, size=60)
        ax.scatter(*truth.T, marker="+", s=70, c="white", linewidths=1.4)
        wrong = known & (confidence >= 0.9) & (error > 0.2)
        ax.set_title(f"{evaluation.names[i]}\n{worst}, confidence {confidence.min():.2f}", fontsize=8)
        ax.title.set_color(COLOURS["paper"] if wrong.any() else "black")
        u = truth[np.isfinite(truth).all(axis=1)]
        if len(u):
            middle, reach = (u.min(axis=0) + u.max(axis=0)) / 2, 1.3 * max(evaluation.length_px[i], 20)
            ax.set(xlim=(middle[0] - reach, middle[0] + reach), ylim=(middle[1] + reach, middle[1] - reach))
    return fig


def recorded_bars(table: Table) -> Figure:
    """PCK of each rung of `notebooks/studies/rungs` that has labels, and the share of the sure landmarks that are wrong."""
    rows = [row for row in table.rows if np.isfinite(row.get("pck_0.2_percent", np.nan))]
    fig, (a, b) = figure(1, 2, width_in=11, height_in=0.3 * len(rows) + 1.2, sharey=True, width_ratios=(2, 1))
    y = np.arange(len(rows))
    for key, shift, colour, label in (("pck_0.05", -0.2, "ours", "PCK@0.05"), ("pck_0.2", 0.2, "right", "PCK@0.2")):
        a.barh(y + shift, [row[f"{key}_percent"] for row in rows], 0.36, color=COLOURS[colour], label=label)
    wrong = [row["sure_and_wrong_percent"] for row in rows]
    b.bar_label(b.barh(y, wrong, 0.5, color=COLOURS["paper"]), fmt="%.0f", padding=3, fontsize=8)
    b.set_xlim(0, 1.25 * max(4.0, np.nanmax(wrong)))
    a.set_yticks(y, [row["rung"].replace("_", " ") for row in rows])
    a.invert_yaxis()
    a.set(xlabel="%", xlim=(0, 101), title="Found")
    b.set(xlabel="% of the sure landmarks", title="Sure and wrong")
    a.legend(loc="lower left", bbox_to_anchor=(0, 1.06), ncols=2)
    return fig


def real_curves(thresholds: Sequence[float], curves: Mapping[str, Sequence[float]]) -> Figure:
    """PCK on real frames against the threshold, one curve for each detector."""
    fig, ax = figure(width_in=7, height_in=3.5)
    for (name, curve), colour in zip(curves.items(), ("paper", "ours", "truth"), strict=False):
        ax.plot(thresholds, curve, "o-", color=COLOURS[colour], ms=4, label=name)
    ax.axvline(0.2, color=COLOURS["baseline"], lw=1)
    ax.set(xlim=(0.05, 0.5), ylim=(0, 101), title="Real frames")
    ax.set(xlabel="threshold, fraction of the tool's length", ylabel="PCK, %")
    ax.legend(loc="best")
    return fig
