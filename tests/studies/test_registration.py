"""The study of registration says what it should."""

from __future__ import annotations


def test_outliers_ruin_least_squares_and_not_the_robust_estimates(run_study):
    clean, _ = run_study("registration", n_frames=5, trials=8)
    spoilt, _ = run_study("registration", n_frames=5, trials=8, outliers=0.2)
    assert clean["image_rms_um"] < clean["norm_rms_um"] < 150
    assert clean["robust_rms_um"] < 1.5 * clean["image_rms_um"]
    for fails, holds in (("squared", "norm"), ("image", "robust")):
        assert spoilt[f"{fails}_median_um"] > 2 * spoilt[f"{holds}_median_um"]
