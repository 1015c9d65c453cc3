"""Real photographs with measured disparity (Middlebury), against the published implementation's scores.

DeepMatching 1.2.2 on motorcycle, 512 x 384: 2653 matches, median 0.633 px, 8.4 % above 2 px.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from lib.matching import RECTIFIED, match
from notebooks import real_data
from notebooks.studies.matching_evaluation import CONFIDENCES, detection_auc, score_against_disparity
from notebooks.studies.surface_evaluation import real_pair

FOLDER = real_data.folder("stereo_pairs")
pytestmark = pytest.mark.skipif(FOLDER is None, reason=real_data.missing_line("stereo_pairs"))


@cache
def load(name: str):
    """Left and right RGB images and disparity at 512 x 384 px; motorcycle is cropped to its left 4:3."""
    pair = real_pair(FOLDER / name).left_part(512, 384)
    return pair.left, pair.right, pair.disparity_px


@cache
def matched(name: str):
    """The matches of the rectified pair as they are by default."""
    left, right, _ = load(name)
    return match(left, right, rig=RECTIFIED)


@pytest.mark.parametrize("flat_window_px", [3, None])
@pytest.mark.parametrize("name", ["motorcycle", "cones"])
def test_band_is_twice_as_accurate_as_the_published_implementation(name, flat_window_px):
    score = score_against_disparity(matched(name), load(name)[2], flat_window_px=flat_window_px)
    assert score.n > 1700
    assert score.median_px <= 0.32
    assert score.above_2 <= 0.095


def test_surer_matches_are_better():
    left, right, disparity = load("motorcycle")
    every = score_against_disparity(match(left, right, rig=RECTIFIED, min_score=0), disparity, flat_window_px=None)
    some = score_against_disparity(matched("motorcycle"), disparity, flat_window_px=None)
    sure = score_against_disparity(match(left, right, rig=RECTIFIED, min_score=0.9), disparity, flat_window_px=None)
    assert every.n > some.n > sure.n > 1500
    assert every.above_2 > 1.4 * some.above_2 > 1.4 * sure.above_2


def test_confidences_tell_the_wrong_matches():
    left, right, disparity = load("motorcycle")
    matches = match(left, right, rig=RECTIFIED, min_score=0, reciprocal=False)
    x, y = np.rint(matches.u_left).astype(int).T
    error = np.abs(matches.u_left[:, 0] - matches.u_right[:, 0] - disparity[y, x])
    known, wrong = np.isfinite(error), error > 2
    auc = {name: detection_auc(getattr(matches, name)[known], wrong[known]) for name in CONFIDENCES}
    assert auc["score"] > 0.8 and auc["peak_ratio"] > 0.58 and auc["reciprocal"] > 0.6
    passed = matches.reciprocal
    assert wrong[known & ~passed].mean() > 4 * wrong[known & passed].mean()


def test_free_deepmatching_equals_the_published_implementation():
    left, right, disparity = load("motorcycle")
    matches = match(left, right, method="deepmatching", downscale=1)
    assert len(matches) >= 2600
    for flat_window_px in (3, None):
        score = score_against_disparity(matches, disparity, flat_window_px=flat_window_px)
        assert score.median_px <= 0.64
        assert score.above_2 <= 0.09


@pytest.mark.parametrize("method", ["sgbm", "dis"])
def test_opencv_matchers_on_a_real_pair(method):
    left, right, disparity = load("motorcycle")
    score = score_against_disparity(match(left, right, method=method, rig=RECTIFIED), disparity)
    assert score.n > 1800
    assert score.median_px <= 0.3
    assert score.above_2 <= 0.07
