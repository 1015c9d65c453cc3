"""Scores against ground truth, on disparity maps whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest

from lib.matching import Matches
from notebooks.studies.matching_evaluation import detection_auc, non_occluded, score_against_disparity, sparsification


def matches_of(u_left: np.ndarray, disparity: np.ndarray) -> Matches:
    u_right = u_left - np.column_stack([disparity, np.zeros(len(disparity))])
    one, covariance = np.ones(len(u_left)), np.tile(np.eye(4), (len(u_left), 1, 1))
    return Matches(u_left, u_right, one, covariance, peak_ratio=one, reciprocal=one > 0, method="made")


def step_disparity() -> np.ndarray:
    """A near square (disparity 10) before a far wall (disparity 2)."""
    disparity = np.full((40, 80), 2.0, np.float32)
    disparity[10:30, 40:60] = 10.0
    return disparity


def test_what_the_near_square_hides_is_occluded():
    visible = non_occluded(step_disparity())
    # The square lands on right columns 30 to 49, where the wall's left columns 32 to 51 land too: 32 to 39 are hidden.
    assert not visible[20, 33:39].any()
    assert visible[20, 40:60].all() and visible[20, 60:].all() and visible[20, 10:31].all()
    assert visible[5, 2:].all() and not visible[5, :2].any()
    disparity = step_disparity()
    disparity[3, 3] = np.nan
    assert not non_occluded(disparity)[3, 3]


def test_errors_are_counted():
    disparity = np.full((40, 80), 5.0, np.float32)
    u = np.column_stack([np.arange(20.0, 30.0), np.full(10, 20.0)])
    error = np.array([0, 0, 0, 0.5, 0.5, 0.5, 1.5, -1.5, 3.0, -9.0])
    score = score_against_disparity(matches_of(u, 5 + error), disparity)
    assert score.n == 10
    assert score.median_px == pytest.approx(0.5)
    assert (score.above_1, score.above_2, score.above_4) == (0.4, 0.2, 0.1)
    assert score.rms_px == pytest.approx(np.sqrt(np.mean(error[:8] ** 2)))
    assert np.allclose(score.error_px, error)


def test_truth_is_interpolated_where_flat_and_steps_are_left_out():
    ramp = np.tile(3 + 0.1 * np.arange(80, dtype=np.float32), (40, 1))
    u = np.array([[20.5, 10.0], [40.25, 11.5]])
    score = score_against_disparity(matches_of(u, 3 + 0.1 * u[:, 0]), ramp)
    assert np.abs(score.error_px).max() < 1e-5
    u = np.array([[60.0, 20.0], [70.0, 20.0], [35.0, 20.0]])  # by the step, on the wall, hidden
    step = step_disparity()
    assert score_against_disparity(matches_of(u, np.array([2.0, 2, 2])), step).n == 1
    assert score_against_disparity(matches_of(u, np.array([2.0, 2, 2])), step, flat_window_px=None).n == 2


def test_nothing_to_score():
    empty = score_against_disparity(matches_of(np.zeros((0, 2)), np.zeros(0)), step_disparity())
    assert empty.n == 0 and np.isnan(empty.median_px)
    outside = score_against_disparity(matches_of(np.array([[500.0, 3.0]]), np.zeros(1)), step_disparity())
    assert outside.n == 0
    with pytest.raises(ValueError, match="disparity_px: expected"):
        non = np.zeros(5)
        score_against_disparity(matches_of(np.zeros((0, 2)), np.zeros(0)), non)


def test_detection_of_wrong_matches_by_confidence():
    wrong = np.array([True, False, True, False, False])
    assert detection_auc([0.1, 0.9, 0.2, 0.8, 0.3], wrong) == 1
    assert detection_auc([0.9, 0.1, 0.8, 0.2, 0.3], wrong) == 0
    assert detection_auc(np.ones(5), wrong) == 0.5
    assert detection_auc([0.5, 0.9, np.nan, 0.5, 0.5], wrong) == pytest.approx((3 + 2) / 6)
    assert np.isnan(detection_auc([0.1, 0.2], [False, False]))
    kept = np.array([0.2, 0.6, 1.0])
    assert np.allclose(sparsification([0.1, 0.9, 0.2, 0.8, 0.3], wrong, kept), (0, 0, 0.4))
    assert np.allclose(sparsification(np.ones(5), wrong, kept), 0.4)
    assert np.allclose(sparsification([True, True, False, True, True], wrong, kept), (0.25, 0.25, 0.4))
