import json
from dataclasses import asdict

import numpy as np
import pytest

from lib.landmarks import metrics


def frames(n=4):
    return np.tile([[[0.0, 0.0], [100.0, 0.0], [0.0, 200.0]]], (n, 1, 1))


def test_a_tool_without_length_does_not_count():
    labels = np.array([[[0.0, 0.0], [100.0, 0.0], [0.0, 100.0]], [[5.0, 5.0]] * 3])
    for off in (0.0, 3.0):
        assert metrics.pck(labels + [off, 0.0], labels, 0.05) == 100.0
    assert np.isnan(metrics.pck(labels, labels, 0.05, length_px=[-5.0, 0.0]))
    with pytest.raises(ValueError, match=r"length_px: expected \(2,\)"):
        metrics.pck(labels, labels, 0.05, length_px=100.0)


def test_pck_is_normalised_by_the_mean_base_to_tip_distance():
    truth = frames(1)
    found = truth + [[[7.4, 0], [7.6, 0], [0, 15.1]]]
    assert metrics.tool_length_px(truth)[0] == 150
    assert metrics.pck(found, truth, 0.05) == pytest.approx(100 / 3)
    assert metrics.pck(found, truth, 0.1) == pytest.approx(200 / 3)
    assert np.allclose(metrics.pck(found, truth, [0.05, 0.2]), [100 / 3, 100])


def test_missing_detections_are_wrong_and_missing_labels_do_not_count():
    truth, found = frames(2), frames(2)
    found[0, 1] = np.nan
    truth[1, 2] = np.nan
    assert metrics.pck(found, truth, 0.05) == pytest.approx(100 * 4 / 5)
    assert np.isinf(metrics.errors_px(found, truth)[0, 1])
    scores = metrics.score(found, truth)
    assert (scores.labels, scores.missed, scores.gross) == (5, 1, 0)
    assert scores.median_px == 0


def test_a_swap_of_the_tips_is_an_error():
    truth = frames(1)
    assert metrics.pck(truth[:, [0, 2, 1]], truth, 0.2) == pytest.approx(100 / 3)


def test_nothing_labelled_is_nan_not_100():
    nothing = np.full((2, 3, 2), np.nan)
    assert np.isnan(metrics.pck(frames(2), nothing, 0.1))


def test_nees_and_coverage_of_true_covariances():
    rng = np.random.default_rng(0)
    L = rng.normal(0, 1, (3000, 3, 2, 2)) + 2 * np.eye(2)
    truth = np.zeros((3000, 3, 2))
    u = (L @ rng.normal(0, 1, (3000, 3, 2, 1)))[..., 0]
    values = metrics.nees(u, truth, L @ L.mT)
    assert values.mean() == pytest.approx(2, abs=0.06)
    scores = metrics.score(u, truth, L @ L.mT, length_px=np.full(3000, 100.0))
    assert scores.gross == 0 and scores.nees == pytest.approx(values.mean())
    assert scores.coverage_95 == pytest.approx(95, abs=0.7)
    assert metrics.nees(u, truth, 4 * L @ L.mT).mean() == pytest.approx(0.5, abs=0.02)


def test_confidence_that_is_true_has_no_calibration_error():
    rng = np.random.default_rng(0)
    confidence = rng.random(20_000)
    correct = rng.random(20_000) < confidence
    assert metrics.calibration_error(confidence, correct) < 0.02
    assert metrics.calibration_error(np.ones(20_000), correct) == pytest.approx(0.5, abs=0.02)
    mean, fraction, count = metrics.reliability(confidence, correct)
    assert count.sum() == 20_000
    assert np.abs(mean - fraction).max() < 0.05


def test_scores_are_json():
    json.dumps(asdict(metrics.score(frames(), frames(), np.broadcast_to(np.eye(2), (4, 3, 2, 2)))))


def test_shapes_are_named():
    with pytest.raises(ValueError, match="u and u_true"):
        metrics.errors_px(np.zeros((2, 2)), np.zeros((2, 2)))
