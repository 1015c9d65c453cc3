"""The studies of registration and of the online system say what they should."""

from __future__ import annotations

import numpy as np

from notebooks.studies import tracked


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


def test_a_push_is_noticed_among_made_errors(run_study, monkeypatch):
    rng, n = np.random.default_rng(0), 200
    error, covariance = rng.normal(0, 0.5, (n, 3, 2, 2)), np.tile(0.25 * np.eye(2), (n, 3, 2, 1, 1))
    made = tracked.TrackedErrors(error, covariance, np.zeros(n, int), np.arange(n) < n - 1)
    monkeypatch.setattr(tracked, "tracked_errors", lambda scenes, seed: made)
    found, _ = run_study("noticed_motion", motion="push 1 mm", recordings=1, before=40, after=5)
    assert found["false_alarms_per_10000"] == 0 and found["noticed_percent"] == 100
