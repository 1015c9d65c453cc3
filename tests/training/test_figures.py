"""Figures of recorded results, drawn from small made-up records: what is stated is what was recorded."""


import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch

from lib.correspondences import LANDMARKS
from lib.landmarks.heatmaps import Peaks
from lib.workbench import results
from lib.workbench.results import Table
from notebooks.figures import detector_records as records
from notebooks.figures import landmarks as plots
from notebooks.figures import shift


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


def texts(figure):
    """Every text of a figure, tables included."""
    return [text.get_text() for text in figure.findobj(plt.Text)]


def scores(**changes):
    own = {
        "pck_0.010_percent": 91.23, "pck_0.050_percent": 98.76, "pck_0.100_percent": 99.0, "median_px": 0.456,
        "p95_px": 2.34, "nees": 1.98, "coverage_95_percent": 94.4,
    }  # fmt: skip
    return own | changes


@pytest.fixture
def shipped():
    whole = scores() | {f"{name}_{key}": value for name in LANDMARKS for key, value in scores().items()}
    whole |= {"tips_0.5_to_1_mm_median_px": 0.3, "tips_0.5_to_1_mm_p95_px": 0.9, "tips_0.5_to_1_mm_labels": 12}
    rows = [whole | {"recording": "all", "mode": "whole frames"}]
    rows += [scores(median_px=0.512) | {"recording": "all", "mode": "tracking"}]
    rows += [scores() | {"recording": name, "mode": "whole frames"} for name in ("test_07", "test_08")]
    return Table(rows)


def test_the_shipped_table_has_a_row_for_each_landmark_and_sequence(shipped):
    header, rows = records.shipped_rows(shipped)
    names = [row[0] for row in rows]
    assert names == ["all, whole frames", "all, tracking", "base", "tip_1", "tip_2", "test_07", "test_08"]
    for name, *values in rows:
        assert len(header) == 7
        assert values == ["0.51" if name == "all, tracking" else "0.46", "2.34", "91.2", "98.8", "1.98", "94.4"]


def test_the_shipped_curve_shows_tracking_beside_whole_frames(shipped):
    full, top = records.shipped_curve(shipped).axes
    for ax in (full, top):
        lines = {line.get_label(): line for line in ax.lines}
        np.testing.assert_allclose(lines["whole frames"].get_xydata(), [[0.01, 91.23], [0.05, 98.76], [0.1, 99.0]])
        np.testing.assert_allclose(lines["tracking"].get_xydata(), [[0.01, 91.23], [0.05, 98.76], [0.1, 99.0]])
    assert full.get_ylim()[0] == 0 and top.get_ylim()[0] > 90


def test_scores_are_grouped_by_distance_from_focus(shipped):
    (group,) = records.depth_groups(shipped).values()
    assert {name: (s.median_px, s.p95_px, s.labels) for name, s in group.items()} == {"0.5 to 1 mm": (0.3, 0.9, 12)}


def test_precision_and_recall_of_visibility():
    row = {f"{a}_{b}": 97.25 for a in ("in_view", "visible") for b in ("precision", "recall")}
    assert texts(records.visibility_bars({"easy": row, "hard": row})).count("97.25") == 8


def test_few_labels_are_a_curve_for_each_sequence():
    columns = {"frames": (0, 10, 1000), "labelled": (0, 10, 201), "pck_0.20_percent": (60, 80, 95)}
    columns |= {"elsewhere_pck_0.20_percent": (40, 45, 50), "clicks_pck_0.20_percent": (96, 96, 96)}
    rows = [dict(zip(columns, values, strict=True)) | {"sequence": "seq1"} for values in zip(*columns.values(), strict=True)]
    own, other = records.few_labels_curves(Table(rows)).axes
    np.testing.assert_allclose(own.lines[0].get_xydata(), [[0, 60], [1, 80], [2, 95]])
    np.testing.assert_allclose(other.lines[0].get_ydata(), [40, 45, 50])
    assert [label.get_text() for label in own.get_xticklabels()] == ["0", "10", "all"]
    assert records.most_labels(Table(rows)) == [rows[2]]


def test_the_cost_of_label_noise_is_that_of_pairs_of_a_seed():
    medians = {0.0: [0.7, 0.8, 0.75], 1.0: [0.8, 0.92, 0.83]}
    rows = [
        {"noise_px": noise, "seed": seed, "median_px": median}
        for noise, values in medians.items()
        for seed, median in enumerate(values)
    ]
    assert records.label_noise_cost(Table(rows)) == pytest.approx((0.1, 0.02 / np.sqrt(3)))
    ax = records.label_noise_pairs(Table(rows)).axes[0]
    assert "+0.100 ± 0.012 px" in ax.get_title(loc="left")
    np.testing.assert_allclose([line.get_ydata() for line in ax.lines], np.transpose(list(medians.values())))
    single = Table([row for row in rows if row["seed"] == 0])
    assert "+0.100 (one seed) px" in records.label_noise_pairs(single).axes[0].get_title(loc="left")


def test_differences_below_two_standard_errors_are_ties():
    values = {"a": [10, 12, 14], "b": [13, 15, 14], "c": [90, 91, 92], "d": [50, 51, 49]}
    table = Table([{"network": name, "pck": value} for name, own in values.items() for value in own])
    assert records.verdicts(table, "network", "pck") == {"a -> b": "tie", "b -> c": "better", "c -> d": "worse"}
    single = Table([{"network": name, "pck": own[0]} for name, own in values.items()])
    assert set(records.verdicts(single, "network", "pck").values()) == {"one seed: no statement"}


def test_speed_is_compared_in_one_engine_and_precision():
    rows = [
        {"network": network, "engine": engine, "size": "1920x1080", "images": 2, "threads": 2, "call_ms": ms}
        for engine, ms in (("torch float32", 100.0), ("openvino bfloat16", np.nan))
        for network in ("paper", "coarse to fine", "window stage")
    ]
    assert records.speed_rows(Table(rows)) == {"torch float32": {"paper's network": 100.0, "coarse to fine": 100.0}}


@pytest.mark.parametrize("name", ["ablation", "papers_network", "label_noise", "few_labels", "engines_and_speed"])
def test_every_recorded_table_can_be_drawn(name):
    table = results.read(name)
    draw = {
        "ablation": records.ablation_bars,
        "papers_network": records.resolution_curves,
        "label_noise": records.label_noise_pairs,
        "few_labels": records.few_labels_curves,
        "engines_and_speed": records.engine_bars,
    }[name]
    assert draw(table).axes
    assert records.recorded(table).startswith("Recorded 20")


def test_the_recorded_speeds_stand_side_by_side_in_each_engine():
    for networks in records.speed_rows(results.read("engines_and_speed")).values():
        assert {"coarse to fine", "the same while tracking", "paper's network"} <= set(networks)


def test_recorded_rungs_have_a_bar_for_each_with_labels():
    scored = {"pck_0.05_percent": 40.0, "pck_0.2_percent": 70.0, "sure_and_wrong_percent": 3.0}
    table = Table([scored | {"rung": "near"}, scored | {"rung": "all_far", "pck_0.2_percent": 60.0}, {"rung": "noise"}])
    found, wrong = shift.recorded_bars(table).axes
    assert [label.get_text() for label in found.get_yticklabels()] == ["near", "all far"]
    assert [bar.get_width() for bar in found.patches] == [40.0, 40.0, 70.0, 60.0]
    assert [bar.get_width() for bar in wrong.patches] == [3.0, 3.0]


def test_real_curves_are_named_after_their_detectors():
    (ax,) = shift.real_curves([0.1, 0.2], {"as shipped": [1, 2], "10 labelled frames": [3, 4]}).axes
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["as shipped", "10 labelled frames"]


def test_timing_stands_beside_the_papers():
    ms = {"small": 1e3 / 12.3, "large": 2e3, "ours": 1e3 / 70}
    figure = plots.timing_bars(ms, {"small": 140, "large": 35}, title="torch float32")
    assert {" 12.3", " 0.5", " 70", "140", "35"} <= set(texts(figure))
    low, high = figure.axes[0].get_xlim()
    assert low < 0.5 and high > 140


def test_the_loss_figure_takes_what_it_is_given():
    at = np.linspace(0, 4, 5)
    ax = plots.loss_slopes(at, {"l2": at**2, "position": at}).axes[0]
    np.testing.assert_allclose(ax.lines[1].get_xydata(), np.column_stack([at, at]))


def test_closeups_show_what_was_expected_seen_and_believed():
    at = torch.tensor([[[20.0, 12.0]], [[16.0, 16.0]]])
    one = torch.ones(2, 1)
    peaks = Peaks(at, one, one, torch.eye(2).expand(2, 1, 2, 2), 0 * one)
    expected = np.full((2, 2), 16.0)
    kept = peaks._replace(u=(at + 16) / 2)
    figure = plots.closeups(np.zeros((2, 32, 32, 3), np.uint8), expected, peaks, kept, ["base", "tip_1"])
    first = figure.axes[2]  # the near view of the first
    drawn = [tuple(float(v) for v in line.get_xydata()[0]) for line in first.lines]
    assert drawn == [(16.0, 16.0), (18.0, 14.0)]
    assert tuple(first.patches[0].center) == (20.0, 12.0)
    assert {"base", "tip_1"} <= set(texts(figure))
