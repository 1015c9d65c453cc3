"""Heavy contamination, competing cameras, errors that last: what is found, what is refused, what is claimed."""

import pickle

import numpy as np
import pytest
from scipy.special import chdtri

from lib.calibration import NoConsensusError, calibrate, estimate_time_offset
from lib.calibration.robust import LooseCameraError
from lib.correspondences import Correspondences
from notebooks.studies.spoiling import Scene
from tests.calibration.rigs import data, tool_sweep
from tests.calibration.test_instruments import video


def contaminated(n, right, seed):
    """A sweep, its pixels (right to 2 px, else 35 or 180 px wrong, each view on its own), and which are right (n, 2)."""
    c, rng = data(n, seed, sigma_u_px=0.0), np.random.default_rng(seed)
    is_right = np.column_stack([rng.permutation(n) < round(right * n) for _ in range(2)])
    u = []
    for exact, fine in zip(c.true_rig.project(c.true_x_mm), is_right.T, strict=True):
        scale = np.where(fine, 2.0, np.where(rng.random(n) < 0.5, 35.0, 180.0))
        u.append(exact + rng.normal(size=exact.shape) * scale[:, None])
    return c, u, is_right


def error_px(found, c):
    return np.sqrt(np.mean((np.hstack(found.rig.project(c.true_x_mm)) - np.hstack(c.true_rig.project(c.true_x_mm))) ** 2))


@pytest.mark.parametrize(("n", "right"), [(60, 0.35), (120, 0.5)])
def test_the_right_detections_are_found_among_wrong_ones_of_two_scales(n, right):
    found, alone = [], []
    for seed in range(6):
        c, u, is_right = contaminated(n, right, seed)
        calibration = calibrate(c.x_mm, u)
        found.append(error_px(calibration, c))
        known = [np.where(fine[:, None], pixels, np.nan) for fine, pixels in zip(is_right.T, u, strict=True)]
        alone.append(error_px(calibrate(Correspondences.of_points(c.x_mm, *known), ransac_px=np.inf), c))
        assert (calibration.view_inliers & is_right).sum() > 0.9 * is_right.sum()
        assert calibration.inliers.sum() > calibration.view_inliers.all(axis=1).sum()  # one view of a row may be right
    assert np.median(found) < 1.5 * np.median(alone) and max(found) < 4 * np.median(alone)


@pytest.mark.parametrize("n", [60, 120])
def test_ten_percent_of_right_detections_are_refused(n):
    for seed in range(5):
        c, u, _ = contaminated(n, 0.1, seed)
        with pytest.raises(NoConsensusError, match=r"u_(left|right): no consensus, .* of \d+ rows.*; check that"):
            calibrate(c.x_mm, u)


def test_a_camera_that_moved_halfway_leaves_two_that_compete():
    c = data(120, 0)
    u_left = c.u_left + np.where(np.arange(120) < 60, 0.0, 40.0)[:, None]
    with pytest.raises(NoConsensusError, match=r"u_left: two consensuses compete, 60 and 60 of 120 rows .* up to 59"):
        calibrate(c.x_mm, [u_left, c.u_right])
    u_left = c.u_left + np.where(np.arange(120) < 100, 0.0, 40.0)[:, None]  # a minority is left out
    assert calibrate(c.x_mm, [u_left, c.u_right]).view_inliers.sum(axis=0).tolist() == [100, 120]


@pytest.mark.parametrize("n", [8, 9, 12, 15, 30])
def test_valid_data_with_one_gross_row_are_not_refused(n):
    for seed in range(4):
        c = data(n, 50 + seed)
        u_left = c.u_left.copy()
        u_left[0] = [5e5, -4e5]
        assert calibrate(c.x_mm, [u_left, c.u_right]).view_inliers[:, 0].tolist() == [False] + [True] * (n - 1)


def test_a_detector_that_claims_too_little_is_scaled_up():
    c = data(80, 3, sigma_u_px=2.0)
    rows = Correspondences.of_points(c.x_mm, c.u_left, c.u_right, covariance_px2=np.tile(0.25 * np.eye(2), (80, 2, 1, 1)))
    found = calibrate(rows)
    assert found.detector_scale == pytest.approx(4.0, rel=0.25) and found.sigma_u_px == pytest.approx(2.0, rel=0.25)
    assert found.chi_square[0] == pytest.approx(found.chi_square[1], rel=0.25)
    covariance = np.tile(16.0 * np.eye(2), (80, 2, 1, 1))
    modest = calibrate(Correspondences.of_points(c.x_mm, c.u_left, c.u_right, covariance_px2=covariance))
    assert modest.detector_scale == 1.0


def lasting(rng, shape, correlation):
    """Standard normal errors, the first axis of `shape` correlated in time."""
    e = rng.normal(size=shape)
    for i in range(1, len(e)):
        e[i] = correlation * e[i - 1] + np.sqrt(1 - correlation**2) * e[i]
    return e


@pytest.mark.parametrize("kind", ["gauss", "heavy", "lasting"])
def test_regions_of_the_projections_hold_what_they_claim(kind):
    inside, effective = [], []
    for seed in range(25):
        rows, rig, true = tool_sweep(seed, frames=16, offset_mm=np.zeros((3, 3)), sigma_px=0.0)
        rng = np.random.default_rng(seed)
        shape = (16, 3, 2, 2)
        noise = rng.normal(size=shape)
        if kind == "heavy":
            noise /= np.sqrt(rng.chisquare(4, (16, 3, 2, 1)) / 4)
        elif kind == "lasting":
            noise = lasting(rng, shape, 0.8)
        left, right = np.moveaxis(2.0 * noise.reshape(48, 2, 2), 1, 0)
        u = [rows.u_left + left, rows.u_right + right]
        found = calibrate(Correspondences.of_points(rows.x_mm, *u, frame=rows.frame, landmark=rows.landmark))
        error = np.hstack(found.rig.project(true)) - np.hstack(rig.project(true))
        d2 = np.einsum("ni,ni->n", error, np.linalg.solve(found.projection_covariance(true), error[:, :, None])[:, :, 0])
        inside.append((d2 < chdtri(4, 0.05)).mean())
        effective.append(found.effective_rows)
    assert 0.88 < np.mean(inside) <= 1.0
    assert np.median(effective) < 35 if kind == "lasting" else np.median(effective) > 40


def test_rows_that_err_alike_for_some_frames_are_no_consensus_of_their_own():
    for seed in range(20):
        scene = Scene(np.random.default_rng([900, seed]), frames=12, fps=5.0, speed_mm_s=6.0, memory=0.8)
        assert calibrate(scene.take().data, offsets=False).view_inliers.mean() > 0.6


def test_the_clock_is_found_among_wrong_detections():
    (time, u), robot = video(0.08, 3)
    rng, spoiled = np.random.default_rng(0), []
    for pixels in u:
        wrong = rng.random(len(pixels)) < 0.4
        scale = np.where(rng.random(len(pixels)) < 0.5, 35.0, 180.0)
        spoiled.append(pixels + wrong[:, None] * rng.normal(size=pixels.shape) * scale[:, None])
    found = estimate_time_offset((time, spoiled), robot)
    assert found.offset_s == pytest.approx(0.08, abs=2e-3) and found.sd_s < 1e-3 and found.rms_px < 4


@pytest.mark.parametrize("places", [3, 4, 5, 8])
def test_positions_that_repeat_calibrate_or_are_named(places):
    """A robot that stops at a few places reports each many times; sets of four rows with a repeated one span nothing."""
    rng = np.random.default_rng(places)
    x = np.repeat(rng.uniform(-4, 4, (places, 3)), 20, axis=0)
    y = x @ np.array([[99.0, 0, -9], [0, 99, 0], [99, 0, 9], [0, 99, 0]]).T + rng.normal(0, 1, (len(x), 4))
    try:
        found = calibrate(x, [y[:, :2], y[:, 2:]])
    except ValueError as error:
        assert places == 3 and "coplanar" in str(error)
    else:
        assert found.inliers.mean() > 0.95


@pytest.mark.parametrize("share", [0.45, 0.5, 0.55])
def test_a_glint_that_stands_still_is_no_tool(share):
    for seed in range(4):
        rows, rig, x_mm = tool_sweep(seed, frames=60)
        rng = np.random.default_rng(seed)
        u = [np.where(rng.random((180, 1)) < share, [700.0, 300.0] + rng.normal(0, 2, p.shape), p) for p in rig.project(x_mm)]
        try:
            found = calibrate(rows.x_mm, u)
        except NoConsensusError as error:
            assert "stand still in the image" in str(error) or "compete" in str(error)
        else:
            off = np.hstack(found.rig.project(x_mm)) - np.hstack(rig.project(x_mm))
            assert np.sqrt(np.mean(off**2)) < 3.0


@pytest.mark.parametrize("model", ["affine", "zero_skew"])
def test_pixels_on_a_line_belong_to_no_camera(model):
    """Wrong detections may lie so."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-4, 4, (60, 3))
    shown = [np.column_stack([100 * x[:, 0] + side * x[:, 2], np.full(60, 500.0)]) for side in (-9, 9)]
    u = [exact + rng.normal(0, 1, (60, 2)) for exact in shown]
    with pytest.raises(NoConsensusError, match="shows all positions on a line; check that"):
        calibrate(x, u, model=model)


def test_a_loose_camera_is_told_by_another_process_too():
    told = pickle.loads(pickle.dumps(LooseCameraError("u_left: no consensus", 7.0)))
    assert str(told) == "u_left: no consensus" and told.sigma_px == 7.0
