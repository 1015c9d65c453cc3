"""The robot's log without its noise: what is averaged out, and what must stay as it was."""

from dataclasses import replace

import numpy as np
import pytest

from lib.recordings import Kinematics, smoothed


def log(hz=100.0, seconds=8.0, noise_mm=0.01, jitter=0.0, tremor_mm=0.0):
    """A log and the true positions (n, 3, 3) at its times, which are off the beat by a share `jitter` of a step."""
    rng, n = np.random.default_rng(0), round(hz * seconds)
    time_s = (np.arange(n) + rng.uniform(-jitter, jitter, n) / 2) / hz
    rate, phase = rng.uniform(0.5, 3, 9), rng.uniform(0, 6, 9)
    true = 4 * np.sin(rate * time_s[:, None] + phase) + tremor_mm * np.sin(2 * np.pi * 10 * time_s[:, None] + phase)
    true = true.reshape(n, 3, 3)
    return Kinematics(time_s, true + rng.normal(0, noise_mm, true.shape)), true


@pytest.mark.parametrize(("how", "left"), [({}, 0.4), ({"jitter": 0.8}, 0.4), ({"tremor_mm": 0.05}, 0.65)])
def test_noise_is_averaged_out_and_motion_is_not(how, left):
    reported, true = log(**how)
    found, noise_mm = smoothed(reported, 0.01)
    error = found.x_mm - true
    assert noise_mm == pytest.approx(error.std(), rel=0.2)
    assert error.std() < left * 0.01 and np.abs(error).max() < 0.04


def test_an_error_that_changes_slowly_is_left():
    reported, true = log(noise_mm=0.002)
    slow = 0.01 * np.sqrt(2) * np.sin(0.8 * reported.time_s[:, None, None] + np.arange(9).reshape(3, 3))
    found, noise_mm = smoothed(replace(reported, x_mm=reported.x_mm + slow), 0.01)
    assert noise_mm == pytest.approx((found.x_mm - true).std(), rel=0.1)


def test_a_polynomial_is_its_own_smoothing():
    time_s = np.arange(200) / 50
    x = (time_s[:, None] ** np.arange(5) @ np.random.default_rng(0).normal(size=(5, 9))).reshape(-1, 3, 3)
    found = smoothed(Kinematics(time_s, x), 0.01)[0].x_mm
    np.testing.assert_allclose(found, x, atol=1e-8)
    assert (found != x).any()


def test_dropped_samples_stay_dropped_and_harm_no_others():
    reported, true = log()
    reported.x_mm[np.random.default_rng(1).random(len(true)) < 0.05] = np.nan
    found = smoothed(reported, 0.01)[0].x_mm
    np.testing.assert_array_equal(np.isnan(found), np.isnan(reported.x_mm))
    assert np.nanstd(found - true) < 0.005


def test_nothing_is_averaged_across_a_gap():
    reported, _ = log()
    reported.time_s[400:] += 0.4
    halves = [Kinematics(reported.time_s[part], reported.x_mm[part]) for part in (np.s_[:400], np.s_[400:])]
    inner = np.r_[0:396, 404:800]  # those beside the gap may choose other windows
    alone = np.concatenate([smoothed(half, 0.01)[0].x_mm for half in halves])
    np.testing.assert_allclose(smoothed(reported, 0.01)[0].x_mm[inner], alone[inner], atol=1e-9)


def test_a_jump_is_not_rounded():
    reported, true = log()
    reported.x_mm[400:] += 3.0
    true[400:] += 3.0
    error = smoothed(reported, 0.01)[0].x_mm - true
    assert np.abs(error).max() < 0.045 and error.std() < 0.005


def test_a_log_that_stands_still_still_repeats_itself():
    reported, _ = log()
    reported.x_mm[300:500] = reported.x_mm[300]
    found = smoothed(reported, 0.01)[0].x_mm
    assert (found[300:500] == reported.x_mm[300]).all() and (found[:300] != reported.x_mm[:300]).any()


@pytest.mark.parametrize("how", [{"hz": 25.0, "tremor_mm": 0.3}, {"seconds": 0.4}, {"noise_mm": 0.05}], ids=str)
def test_a_log_that_does_not_tell_motion_from_noise_stays_as_it_is(how):
    reported = log(**how)[0]
    found, noise_mm = smoothed(reported, 0.01)
    np.testing.assert_array_equal(found.x_mm, reported.x_mm)
    assert noise_mm == 0.01
