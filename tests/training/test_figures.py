"""Figures of recorded results, drawn from small made-up records: what is stated is what was recorded."""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch

from lib.landmarks.heatmaps import Peaks
from notebooks.figures import landmarks as plots
from notebooks.studies.detector_studies import CURVE, summary


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


def texts(figure):
    """Every text of a figure, tables included."""
    return [text.get_text() for text in figure.findobj(plt.Text)]


def scores(separator="."):
    return {
        f"pck_0{separator}01": 91.23, f"pck_0{separator}05": 98.76, f"pck_0{separator}10": 99.0, "median_px": 0.456,
        "p95_px": 2.34, "nees": 1.98, "coverage_95": 94.4, "missed": 3, "labels": 60,
    }  # fmt: skip


@pytest.fixture
def shipped():
    seen = {f"{a}_{b}": 97.25 for a in ("in_view", "visible") for b in ("precision", "recall")}
    return {
        "whole_frames": scores() | seen,
        "tracking": scores() | seen | {"median_px": 0.512},
        "by_landmark": {name: scores("_") for name in ("base", "tip_1", "tip_2")},
        "by_sequence": {"test_07": scores(), "test_08": scores()},
        "thresholds": list(CURVE),
        "curve": np.linspace(10, 100, len(CURVE)).tolist(),
    }


def test_the_shipped_table_has_a_row_for_each_landmark_and_sequence(shipped):
    cells = plots.shipped_table(shipped).axes[0].tables[0].get_celld()
    rows = max(row for row, _ in cells)
    assert rows == 2 + 3 + 2
    names = [cells[row, 0].get_text().get_text() for row in range(1, rows + 1)]
    assert names == ["all, whole frames", "all, tracking", "base", "tip_1", "tip_2", "test_07", "test_08"]
    for row in range(1, rows + 1):  # both spellings of the keys: those of scores and those of studies
        values = [cells[row, column].get_text().get_text() for column in range(1, 8)]
        assert values == ["0.51" if row == 2 else "0.46", "2.34", "91.2", "98.8", "1.98", "94.4", "3/60"]


def test_the_shipped_curve_shows_tracking_beside_whole_frames(shipped):
    full, top = plots.shipped_curve(shipped).axes
    for ax in (full, top):
        lines = {line.get_label(): line for line in ax.lines}
        np.testing.assert_allclose(lines["whole frames"].get_ydata(), shipped["curve"])
        np.testing.assert_allclose(lines["tracking"].get_xydata(), [[0.01, 91.23], [0.05, 98.76], [0.1, 99.0]])
    assert full.get_ylim()[0] == 0 and top.get_ylim()[0] > 90


def test_precision_and_recall_of_visibility(shipped):
    rows = {"easy": shipped["whole_frames"], "hard": shipped["tracking"]}
    assert texts(plots.visibility_bars(rows)).count("97.25") == 8


def test_few_labels_are_two_curves_with_error_bars():
    def row(*values):
        return {"pck_0.05": summary(values)}

    result = {
        "frames": {
            "fine-tuned": {"10": row(90, 92, 94), "100": row(95, 95, 95)},
            "from scratch": {"10": row(20.0), "100": row(60.0)},  # one seed has no standard error
        },
        "no_label": {"pck_0.05": 88.0},
    }
    ax = plots.few_labels_curves(result).axes[0]
    assert [bars.get_label() for bars in ax.containers] == ["fine-tuned", "from scratch"]
    tuned, scratch = (bars.lines for bars in ax.containers)
    np.testing.assert_allclose(tuned[0].get_xydata(), [[10, 92], [100, 95]])
    segment = tuned[2][0].get_segments()[0]
    np.testing.assert_allclose(segment[:, 1], 92 + 2 * 2 / np.sqrt(3) * np.array([-1, 1]))
    np.testing.assert_allclose(scratch[0].get_ydata(), [20, 60])


def test_the_cost_of_label_noise_is_stated_with_its_standard_error():
    exact, noisy = [0.7, 0.8, 0.75], [0.8, 0.9, 0.85]
    result = {
        "labels": {"exact": {"median_px": summary(exact)}, "noisy": {"median_px": summary(noisy)}},
        "median_cost_px": summary([0.1, 0.12, 0.08]),
    }
    ax = plots.label_noise_pairs(result).axes[0]
    assert "+0.100 ± 0.012 px" in ax.get_title(loc="left")
    np.testing.assert_allclose([line.get_ydata() for line in ax.lines], np.transpose([exact, noisy]))
    result["median_cost_px"] = {"mean": -0.1, "standard_error": None, "per_seed": [-0.1]}
    assert "-0.100 (one seed) px" in plots.label_noise_pairs(result).axes[0].get_title(loc="left")


def test_real_curves_have_a_panel_for_each_kind_of_test():
    thresholds = np.linspace(0.05, 0.5, 10)
    names = []
    for i in (1, 2):
        tests = ("first half to second", f"first half to seq{3 - i}", "simulated frames only")
        names += [f"seq{i}: {how}" for how in tests]
    figure = plots.real_curves(thresholds, {name: np.linspace(i, 90 + i, 10) for i, name in enumerate(names)})
    panels = {ax.get_title(loc="left"): [t.get_text() for t in ax.get_legend().get_texts()] for ax in figure.axes}
    assert panels == {
        "first half to second": ["seq1", "seq2"],
        "another sequence": ["seq1 to seq2", "seq2 to seq1"],
        "simulated frames only": ["seq1", "seq2"],
    }


def test_how_far_a_curve_is_in_words():
    thresholds = [0.1, 0.2, 0.3]
    assert plots.half_within(thresholds, [30, 70, 90]) == "half within 15 % of the tool's length"
    assert plots.half_within(thresholds, [60, 70, 90]) == "half within less than 10 % of the tool's length"
    assert plots.half_within(thresholds, [1, 2, 3]) == "not even half within 30 % of the tool's length"


def test_an_engine_that_failed_says_why():
    rows = {"torch": {"wall_ms": 20.0, "cpu_ms": 18.0}, "other": {"failed": "ImportError: no such engine"}}
    figure = plots.engine_bars(rows)
    assert {" 20", " 18", " ImportError: no such engine"} <= set(texts(figure))


def test_timing_stands_beside_the_papers():
    figure = plots.timing_bars({"small": 12.3, "large": 0.5, "ours": 70.0}, {"small": 140, "large": 35})
    assert {" 12.3", " 0.5", " 70", "140", "35"} <= set(texts(figure))
    low, high = figure.axes[0].get_xlim()
    assert low < 0.5 and high > 140


def test_ablation_states_its_means():
    columns = {"encoder": {"pck_0.05": summary([50, 60])}, "+ decoder": {"pck_0.05": summary([70.0])}}
    assert {"55.0", "70.0"} <= set(texts(plots.ablation_bars(columns, {"encoder": 8.4, "+ decoder": 75.1})))


def test_the_loss_figure_takes_what_it_is_given():
    at = np.linspace(0, 4, 5)
    ax = plots.loss_slopes(at, {"l2": at**2, "position": at}).axes[0]
    np.testing.assert_allclose(ax.lines[1].get_xydata(), np.column_stack([at, at]))


def test_closeups_show_what_was_expected_seen_and_believed():
    at = torch.tensor([[[20.0, 12.0]], [[16.0, 16.0]]])
    one = torch.ones(2, 1)
    peaks = Peaks(at, one, one, torch.eye(2).expand(2, 1, 2, 2))
    expected = np.full((2, 2), 16.0)
    kept = replace(peaks, u=(at + 16) / 2)
    figure = plots.closeups(np.zeros((2, 32, 32, 3), np.uint8), expected, peaks, kept, ["base", "tip_1"])
    first = figure.axes[2]  # the near view of the first
    drawn = [tuple(float(v) for v in line.get_xydata()[0]) for line in first.lines]
    assert drawn == [(16.0, 16.0), (18.0, 14.0)]
    assert tuple(first.patches[0].center) == (20.0, 12.0)
    assert {"base", "tip_1"} <= set(texts(figure))
