"""Figures of notebook 02 drawn from recorded tables (``data/results``): the studies of the detector."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from lib import paths
from lib.correspondences import LANDMARKS
from lib.files import digest
from lib.workbench.results import Table
from notebooks.figures.style import COLOURS, figure

#: PCK@0.05 in percent of the five networks in the paper.
PAPER_ABLATION = {"encoder": 8.4, "+ decoder": 75.1, "+ skips": 95.2, "+ stack": 99.6, "+ residual": 99.7}


def recorded(table: Table) -> str:
    """The beginning of a caption: "Recorded", the date, and how often the table was recorded so far."""
    times = table.provenance.get("times_recorded", 1)
    often = f" (the last of {times} times)" if times > 1 else ""
    return f"Recorded {table.provenance.get('date', 'at an unknown date')}{often}"


def weights(table: Table) -> str:
    """Part of a caption: the weights (those that ship now, or others) and the commit with which a table was recorded."""
    same = table.provenance.get("weights") == digest(paths.MODELS / "default.safetensors")
    commit = table.provenance.get("commit", {}).get("id", "an unknown commit")[:7]
    return f"with {'the weights that ship' if same else 'other weights than those that ship now'}, by the code of {commit}"


def mean_and_error(values: Sequence[float]) -> tuple[float, float]:
    """Mean over the seeds, and its standard error; NaN for one seed.

    >>> mean_and_error([1.0, 3.0])
    (2.0, 1.0)
    """
    v = np.asarray(values, dtype=float)
    return float(v.mean()), float(v.std(ddof=1) / np.sqrt(len(v))) if len(v) > 1 else np.nan


def groups(table: Table, column: str) -> dict[object, Table]:
    """Value of a column -> the rows with this value, in their order."""
    return {value: table.where(**{column: value}) for value in dict.fromkeys(row[column] for row in table.rows)}


def verdicts(table: Table, column: str, metric: str) -> dict[str, str]:
    """Compare each value of a column with the one before: "better", "worse", or "tie" if they differ by less than two
    standard errors.  A single seed gives no statement.
    """
    means = {name: mean_and_error(rows.columns[metric]) for name, rows in groups(table, column).items()}
    result = {}
    for (before, (a, error_a)), (name, (b, error_b)) in pairwise(means.items()):
        error = np.hypot(error_a, error_b)
        tie = "tie" if abs(b - a) < 2 * error else "better" if b > a else "worse"
        result[f"{before} -> {name}"] = tie if np.isfinite(error) else "one seed: no statement"
    return result


def curve(table: Table) -> tuple[np.ndarray, np.ndarray]:
    """Thresholds, and PCK in percent as a mean over the rows."""
    found = {float(m[1]): m[0] for m in (re.fullmatch(r"pck_([\d.]+)_percent", name) for name in table.columns) if m}
    thresholds = np.array(sorted(found))
    return thresholds, np.array([np.mean(table.columns[found[t]]) for t in thresholds])


def ablation_bars(table: Table) -> Figure:
    """PCK@0.05 of the five networks: a dot for each seed, a bar for the mean, and the paper's value."""
    fig, ax = figure(width_in=8, height_in=3.2)
    for i, (name, rows) in enumerate(groups(table, "network").items()):
        values = rows.columns["pck_0.05_percent"]
        first = i == 0
        ax.bar(i, values.mean(), 0.55, color=COLOURS["ours"], alpha=0.4, label="mean" if first else None)
        ax.text(i, values.mean() / 2, f"{values.mean():.1f}", ha="center", fontsize=13, weight="bold")
        ax.plot(np.full(len(values), i), values, "o", color=COLOURS["ours"], ms=5, label="one seed" if first else None)
        ax.plot(i, PAPER_ABLATION[name], "D", color=COLOURS["paper"], ms=7, label="paper, 1080p" if first else None)
    ax.set_xticks(range(len(groups(table, "network"))), list(groups(table, "network")))
    ax.set(ylabel="PCK@0.05, %", ylim=(0, 105), title="Ablation")
    ax.legend(loc="upper left")
    return fig


def resolution_curves(table: Table) -> Figure:
    """PCK against the threshold at each resolution of the table."""
    fig, ax = figure(width_in=8, height_in=3.6)
    colours = [COLOURS["ours"], COLOURS["truth"], COLOURS["right"], COLOURS["warning"]]
    for (name, rows), colour in zip(groups(table, "resolution").items(), colours, strict=False):
        thresholds, pck = curve(rows)
        ax.plot(100 * thresholds, pck, color=colour, marker="o", ms=3, label=name)
    ax.set(xscale="log", ylim=(0, 101), xlabel="threshold, % of the tool's length", ylabel="PCK, %")
    ax.set_title("The paper's network")
    ticks = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20)
    ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
    ax.minorticks_off()
    ax.legend(loc="upper left")
    return fig


def papers_network_curves(table: Table, shipped: Table) -> Figure:
    """PCK against the threshold: the paper's network at each resolution, and a coarse-to-fine one on the same sequences."""
    fig = resolution_curves(table)
    rows = [row for row in shipped.where(mode="whole frames").rows if row["recording"].startswith("test_")]
    thresholds, pck = curve(Table(rows))
    fig.axes[0].plot(100 * thresholds, pck, "k--", label="coarse to fine, full HD")
    fig.axes[0].legend(loc="upper left", bbox_to_anchor=(1, 1))
    return fig


def papers_network_rows(table: Table) -> tuple[list[str], list[list[str]]]:
    """Header and rows: training time of the paper's network, its accuracy, and the error of a calibration from it."""
    columns = {
        "epochs": ("epochs_done", ".1f"),
        "steps": ("steps", ".0f"),
        "minutes": ("training_min", ".0f"),
        "on a GPU": ("on_gpu", ".0f"),
        **{f"PCK@{t}": (f"pck_{t:.3f}_percent", ".1f") for t in (0.01, 0.05, 0.1, 0.2)},
        "median, px": ("median_px", ".1f"),
        "calibration, um": ("calibration_from_detections_um", ".0f"),
        "from labels, um": ("calibration_from_labels_um", ".0f"),
    }
    cells = [[row["resolution"], *(format(row[key], form) for key, form in columns.values())] for row in table.rows]
    return ["resolution", *columns], cells


def few_labels_curves(table: Table) -> Figure:
    """PCK@0.2 on real frames against the number of labelled frames: in the same sequence, and in the other one."""
    fig, axes = figure(1, 2, width_in=10, height_in=3.6, sharey=True)
    counts = sorted({row["frames"] for row in table.rows})
    for (name, rows), colour in zip(groups(table, "sequence").items(), ("ours", "paper"), strict=False):
        x, own = [counts.index(row["frames"]) for row in rows.rows], rows.columns["pck_0.20_percent"]
        axes[0].plot(x, own, "o-", color=COLOURS[colour], label=f"{name}, second half")
        axes[0].axhline(rows.rows[0]["clicks_pck_0.20_percent"], color=COLOURS[colour], ls=":", label="limit of the clicks")
        axes[1].plot(x, rows.columns["elsewhere_pck_0.20_percent"], "o-", color=COLOURS[colour], label=f"labels of {name}")
    for ax, title in zip(axes, ("The same sequence", "The other sequence"), strict=True):
        ticks = ["all" if count > max(row["labelled"] for row in table.rows) else f"{count:g}" for count in counts]
        ax.set_xticks(range(len(counts)), ticks)
        ax.set(ylim=(0, 101), xlabel="labelled frames", title=title)
        ax.legend(loc="best")
    axes[0].set_ylabel("PCK@0.2, %")
    return fig


def most_labels(table: Table) -> list[dict]:
    """The row with the most labelled frames of each sequence."""
    return [max(rows.rows, key=lambda row: row["labelled"]) for rows in groups(table, "sequence").values()]


def label_noise_cost(table: Table) -> tuple[float, float]:
    """Increase of the median error (px) by noisy labels: mean over the seeds, and its standard error."""
    exact, noisy = (
        {row["seed"]: row["median_px"] for row in table.rows if bool(row["noise_px"]) == is_noisy}
        for is_noisy in (False, True)
    )
    return mean_and_error([noisy[seed] - exact[seed] for seed in exact])


def label_noise_pairs(table: Table) -> Figure:
    """Median error of networks trained with exact and with noisy labels; a line joins the two of one seed."""
    fig, ax = figure(width_in=5.5, height_in=3.4)
    medians = np.array([rows.columns["median_px"] for rows in groups(table, "noise_px").values()])
    ax.plot([0, 1], medians, "o-", color=COLOURS["ours"], ms=7)
    ax.set_xticks([0, 1], ["exact labels", "noisy labels"])
    mean, error = label_noise_cost(table)
    cost = f"{mean:+.3f}" + (f" ± {error:.3f}" if np.isfinite(error) else " (one seed)")
    ax.set(xlim=(-0.4, 1.4), ylabel="median error, px", title=f"Cost of label noise: {cost} px")
    ax.set_ylim(0, 1.25 * medians.max())
    return fig


def shipped_curve(table: Table) -> Figure:
    """PCK of the shipped detector on the test sequences, for whole frames and tracking; right, the upper end enlarged."""
    fig, axes = figure(1, 2, width_in=11, height_in=3.8)
    everything = table.where(recording="all")
    thresholds, pck = curve(everything.where(mode="whole frames"))
    (tracking,) = everything.where(mode="tracking").rows
    at = np.array([0.01, 0.05, 0.10])
    for ax, lowest in zip(axes, (0.0, 95.0), strict=True):
        ax.plot(thresholds, pck, "o-", color=COLOURS["ours"], ms=4, label="whole frames")
        values = [tracking[f"pck_{t:.3f}_percent"] for t in at]
        ax.plot(at, values, "s", color=COLOURS["right"], ms=8, mfc="none", mew=2, label="tracking")
        first = thresholds[0] if lowest == 0 else 0.0075
        ax.set(xscale="log", xlim=(first, 1.05 * thresholds[-1]), ylim=(lowest, 100 + (100 - lowest) / 50))
        ticks = [t for t in (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2) if first <= t <= thresholds[-1]]
        ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
        ax.minorticks_off()
        ax.set(xlabel="threshold, fraction of the tool's length", ylabel="PCK, %")
    axes[0].set_title("Correct landmarks")
    axes[1].set_title("Upper end, enlarged")
    axes[0].legend(loc="lower right")
    return fig


def shipped_rows(table: Table) -> tuple[list[str], list[list[str]]]:
    """Header and rows: scores of the shipped detector on whole frames and while tracking, by landmark, and by sequence."""
    everything = {row["mode"]: row for row in table.where(recording="all").rows}
    rows = {f"all, {mode}": row for mode, row in everything.items()}
    whole = everything["whole frames"]
    rows |= {k: {n.removeprefix(f"{k}_"): v for n, v in whole.items() if n.startswith(f"{k}_")} for k in LANDMARKS}
    rows |= {row["recording"]: row for row in table.where(mode="whole frames").rows if row["recording"] != "all"}
    columns = {
        "median, px": ("median_px", ".2f"),
        "95 %, px": ("p95_px", ".2f"),
        "PCK@0.01": ("pck_0.010_percent", ".1f"),
        "PCK@0.05": ("pck_0.050_percent", ".1f"),
        "NEES (2)": ("nees", ".2f"),
        "in 95 % ellipse": ("coverage_95_percent", ".1f"),
    }
    cells = [[name, *(format(row[key], form) for key, form in columns.values())] for name, row in rows.items()]
    return ["", *columns], cells


def depth_groups(table: Table) -> dict[str, dict[str, SimpleNamespace]]:
    """Scores of bases and tips by their distance from focus, for `landmarks.error_groups`."""
    (row,) = table.where(recording="all", mode="whole frames").rows
    result: dict[str, dict[str, SimpleNamespace]] = {}
    for name in row:
        found = re.fullmatch(r"(base|tips)_([\d.]+)_to_([\d.]+)_mm_median_px", name)
        if found and np.isfinite(row[name]):
            stem = name.removesuffix("_median_px")
            scores = SimpleNamespace(**{key: row[f"{stem}_{key}"] for key in ("median_px", "p95_px", "labels")})
            scores.labels = int(scores.labels)
            result.setdefault(f"{found[1]}, by distance from focus", {})[f"{found[2]} to {found[3]} mm"] = scores
    return result


def visibility_bars(rows: Mapping[str, Mapping[str, float]]) -> Figure:
    """Precision and recall of detections (`Evaluation.detection`) in two kinds of frames."""
    fig, ax = figure(width_in=9, height_in=3.2)
    names = [f"{there}_{what}" for there in ("in_view", "visible") for what in ("precision", "recall")]
    for i, ((label, row), colour) in enumerate(zip(rows.items(), (COLOURS["ours"], COLOURS["right"]), strict=True)):
        values = [row[name] for name in names]
        x = np.arange(len(names)) + 0.4 * i - 0.2
        ax.bar(x, values, 0.36, color=colour, alpha=0.7, label=label)
        for at, value in zip(x, values, strict=True):
            ax.text(at, value / 2, f"{value:.2f}", ha="center", va="center", fontsize=11, weight="bold")
    labels = [name.replace("in_view_", "in view\n").replace("visible_", "visible\n") for name in names]
    ax.set_xticks(range(len(names)), labels)
    ax.set(ylabel="%", ylim=(0, 119), title="Precision and recall, confidence above 0.5")
    ax.legend(loc="upper right", ncols=2)
    return fig


def engine_bars(table: Table) -> Figure:
    """Milliseconds of the window stage (six windows, one thread) on each engine: wall and CPU time."""
    rows = table.where(network="window stage", images=2, threads=1).rows
    fig, ax = figure(width_in=9, height_in=0.42 * len(rows) + 1.1)
    for i, row in enumerate(rows):
        for at, key, colour in ((i - 0.19, "cpu_ms", COLOURS["ours"]), (i + 0.19, "call_ms", COLOURS["baseline"])):
            ax.barh(at, row[key], 0.36, color=colour)
            ax.text(row[key], at, f" {row[key]:.0f}", va="center")
    ax.set_yticks(range(len(rows)), [row["engine"] for row in rows])
    ax.set_ylim(len(rows) - 0.4, -0.6)
    ax.margins(x=0.1)
    handles = [Patch(color=COLOURS["ours"], label="CPU time"), Patch(color=COLOURS["baseline"], label="wall time")]
    ax.legend(handles=handles, loc="lower right")
    ax.set(xlabel="ms", title="Six windows: three in each image of a pair")
    return fig


def speed_rows(table: Table, threads: int = 2) -> dict[str, dict[str, float]]:
    """Engine and precision -> network -> milliseconds per stereo pair in full HD."""
    full_hd = "1920x1080"  # also where the sweep left the size at its default
    pairs = [row for row in table.rows if (row["images"], row["threads"]) == (2, threads)]
    pairs = [row for row in pairs if row["network"] != "window stage" and row.get("size", full_hd) == full_hd]
    pairs = [row for row in pairs if np.isfinite(row["call_ms"])]
    names = {"paper": "paper's network", "coarse to fine": "coarse to fine", "tracking": "the same while tracking"}
    found: dict[str, dict[str, float]] = {}
    for row in pairs:
        found.setdefault(row["engine"], {})[names[row["network"]]] = row["call_ms"]
    return found
