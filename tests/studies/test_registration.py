"""The studies of registration and of the online system say what they should."""

from __future__ import annotations


def test_outliers_ruin_least_squares_and_not_the_robust_estimates(run_study):
    clean, _ = run_study("registration", n_frames=5, trials=8, sigma_u_px=1.5)
    spoilt, _ = run_study("registration", n_frames=5, trials=8, sigma_u_px=1.5, outliers=0.2)
    assert clean["image_rms_um"] < clean["norm_rms_um"] < 150
    assert clean["robust_rms_um"] < 1.5 * clean["image_rms_um"]
    for fails, holds in (("squared", "norm"), ("image", "robust")):
        assert spoilt[f"{fails}_median_um"] > 2 * spoilt[f"{holds}_median_um"]


def test_distances_of_the_recording_that_ships(run_study):
    found, _ = run_study("tip_distance", frames=20, surface_every=6)
    assert found["tips_distances"] == 12 and found["tips_rms_um"] < 100 and found["tips_covered_percent"] > 80
    assert run_study("tip_distance", recording="nowhere")[0] == {}
