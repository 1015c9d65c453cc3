"""Seconds of calibration: `python3 -m lib bench`, or pytest on this folder."""

from __future__ import annotations

import numpy as np
import pytest

from lib.calibration import OnlineCalibration, affine_minimum, calibrate
from lib.correspondences import Correspondences
from lib.trust import report
from notebooks.studies.simulated_rows import simulate_correspondences


def stacked(n):
    c = simulate_correspondences(n, rng=np.random.default_rng(0))
    return c, np.hstack([c.u_left, c.u_right])


@pytest.mark.parametrize("n", [300, 3000, 30000])
def test_closed_form_minimum(benchmark, n):
    c, y = stacked(n)
    assert benchmark(lambda: affine_minimum(c.x_mm, y, 2.25, 1e-4)).cost > 0


@pytest.mark.parametrize("model", ["affine", "zero_skew", "near_affine"])
def test_calibration_with_outliers_and_report(benchmark, model):
    c, _ = stacked(1500)
    rng = np.random.default_rng(1)
    wrong = rng.random(1500) < 0.3
    u_left = c.u_left.copy()
    u_left[wrong] = rng.uniform(0, 1900, (wrong.sum(), 2))
    text = benchmark(lambda: report(calibrate(c.x_mm, [u_left, c.u_right], model=model)))
    assert "outliers" in text


def test_online_frame(benchmark):
    c, _ = stacked(3000)
    online = OnlineCalibration(calibrate(c.x_mm[:300], [c.u_left[:300], c.u_right[:300]], model="affine"))
    rows = Correspondences.of_points(c.x_mm[300:303], c.u_left[300:303], c.u_right[300:303])

    def frame():
        online.add(rows)
        return online.solve()

    assert benchmark(frame).linear.shape == (4, 3)
