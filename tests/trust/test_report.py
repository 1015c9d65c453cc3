"""The calibration in words, the verdict on top."""

import re
from dataclasses import replace

import numpy as np

from lib.calibration import calibrate
from lib.correspondences import Correspondences
from lib.trust import report
from notebooks.studies.simulated_rows import simulate_correspondences


def test_the_report_begins_with_the_verdict():
    c = simulate_correspondences(100, rng=np.random.default_rng(0))
    text = report(calibrate(c.x_mm, [c.u_left, c.u_right]), robot_accuracy_mm=0.01)
    assert text.startswith("Verdict: trustworthy\nCalibration: model") and "px/mm" in text and "Outliers" not in text
    assert "volume" in text and "camera" in report(calibrate(c.x_mm, [c.u_left]))


def test_outliers_are_listed():
    c = simulate_correspondences(100, rng=np.random.default_rng(0))
    u_left = c.u_left.copy()
    u_left[[3, 50]] += 400
    text = report(calibrate(c.x_mm, [u_left, c.u_right]))
    assert "2 outliers (1 %)" in text and "    50:" in text and "left" in text
    frame, landmark = np.divmod(np.arange(100), 3)
    data = Correspondences.of_points(c.x_mm, u_left, c.u_right, frame=frame, landmark=landmark)
    assert "    16 tip_2: " in report(calibrate(data, offsets=False), data=data)


def test_the_depth_of_one_detected_point_is_that_of_most():
    """Points that the detector hardly knows say nothing of the others."""
    c, told = simulate_correspondences(90, rng=np.random.default_rng(0)), []
    for vague_px in (1.5, 30.0):
        sd_px = np.where(np.arange(90) % 3 == 0, vague_px, 1.5)[:, None, None, None]
        rows = replace(c, covariance_px2=sd_px**2 * np.broadcast_to(np.eye(2), (90, 2, 2, 2)))
        told.append(float(re.search(r"depth +sd (\d+) um", report(calibrate(rows)))[1]))
    assert told[1] < 1.5 * told[0]
