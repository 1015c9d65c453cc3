"""Leverage, leave-one-out, covariance of points, advice, optics."""

import numpy as np
import pytest

from lib.calibration import calibrate, dlt, optics
from lib.cameras import NearAffineCamera
from lib.correspondences import Correspondences
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig
from notebooks.studies.positions import added_error, box_grid, next_positions
from notebooks.studies.simulated_rows import simulate_correspondences
from tests.calibration.rigs import tool_sweep


def made(n=150, seed=0, model="affine", **options):
    c = simulate_correspondences(n, rng=np.random.default_rng(seed), **options)
    return c, calibrate(c.x_mm, [c.u_left, c.u_right], model=model, ransac_px=np.inf, image_size_px=(1920, 1080))


def leverage(found, x_mm):
    """(n,) covariance of a point's projection, in units of one row's noise."""
    J = found.derivatives(x_mm)[0]
    S = found.noise_px2 + found.sigma_x_mm**2 * J @ J.mT
    return np.trace(np.linalg.solve(S, found.projection_covariance(x_mm)), axis1=1, axis2=2) / S.shape[-1]


def test_leverage_is_that_of_regression():
    c, found = made()
    H = np.column_stack([c.true_x_mm, np.ones(150)])
    expected = np.einsum("ni,ij,nj->n", H, np.linalg.inv(H.T @ H), H)
    np.testing.assert_allclose(leverage(found, c.true_x_mm), expected, rtol=0.02)
    assert leverage(found, c.x_mm).mean() == pytest.approx(4 / 150, rel=0.02)


def test_leave_one_out_is_what_refitting_without_the_row_gives():
    c, found = made(40, sigma_x_mm=0.0)
    expected = []
    for i in range(40):
        keep = np.arange(40) != i
        expected.append(
            np.hstack([u[i] - dlt(c.x_mm[keep], u[keep]).project(c.x_mm[i])[0] for u in (c.u_left, c.u_right)])
        )
    np.testing.assert_allclose(found.leave_one_out_px, expected, atol=0.02)
    assert found.press_rms_px > found.reprojection_rms_px


def test_leave_one_out_of_the_near_affine_model():
    c, found = made(40, model="near_affine")
    known = {
        "sigma_u_px": found.sigma_u_px,
        "sigma_x_mm": found.sigma_x_mm,
        "ransac_px": np.inf,
        "image_size_px": (1920, 1080),
    }
    for i in (0, 7, 23):
        keep = np.arange(40) != i
        refit = calibrate(c.x_mm[keep], [c.u_left[keep], c.u_right[keep]], model="near_affine", **known)
        expected = np.hstack(
            [
                u[i] - camera.project(c.x_mm[i])[0]
                for u, camera in zip((c.u_left, c.u_right), refit.cameras, strict=True)
            ]
        )
        np.testing.assert_allclose(found.leave_one_out_px[i], expected, atol=0.25)


def test_covariance_of_points_holds_calibration_and_detection():
    """Error of a corner point over many calibrations and detections against the closed form."""
    rng = np.random.default_rng(0)
    base = simulate_correspondences(20, rng=rng)
    corner = ROBOT_FROM_MICROSCOPE.apply(np.array([[8.0, 4.5, 1.5]]))
    distances = []
    for _ in range(200):
        x = base.true_x_mm + rng.normal(0, 0.01, base.true_x_mm.shape)
        u = [p + rng.normal(0, 1.5, p.shape) for p in base.true_rig.project(base.true_x_mm)]
        found = calibrate(x, u, model="affine", sigma_u_px=1.5, sigma_x_mm=0.01, ransac_px=np.inf)
        detected = [p + rng.normal(0, 1.5, p.shape) for p in base.true_rig.project(corner)]
        x_mm = found.rig.triangulate(*detected).x_mm
        error, (covariance,) = x_mm[0] - corner[0], found.point_covariance(x_mm)
        distances.append(error @ np.linalg.solve(covariance, error))
        assert (np.linalg.eigvalsh(covariance - found.point_covariance(x_mm, detection=False)[0]) > 0).all()
    assert np.mean(distances) == pytest.approx(3, rel=0.15)


@pytest.mark.parametrize("shared", [True, False])
def test_covariance_allows_for_errors_that_the_landmarks_of_a_frame_share(shared):
    """A robot that reports poses errs alike in all landmarks of a frame."""
    rig, distances, effective = reference_rig(), [], []
    corners = ROBOT_FROM_MICROSCOPE.apply(np.random.default_rng(5).uniform(-1, 1, (12, 3)) * [6, 4, 1.5])
    for seed in range(12):
        _, _, x_mm = tool_sweep(seed, frames=40, offset_mm=np.zeros((3, 3)))
        rng = np.random.default_rng(seed)
        u = [p + rng.normal(0, 0.7, p.shape) for p in rig.project(x_mm)]
        frame, landmark = np.divmod(np.arange(120), 3)
        error_mm = rng.normal(0, 0.03, (120, 3))
        reported = x_mm + (error_mm[3 * frame] if shared else error_mm)
        rows = Correspondences.of_points(reported, *u, frame=frame, landmark=landmark)
        found = calibrate(rows, offsets=False)
        off = np.hstack(found.rig.project(corners)) - np.hstack(rig.project(corners))
        J = found.derivatives(corners)[1].reshape(-1, len(found.parameter_names))
        step = np.linalg.lstsq(J, off.ravel(), rcond=None)[0]
        distances.append(step @ np.linalg.solve(found.parameter_covariance, step) / len(step))
        effective.append(found.effective_rows)
    assert 0.6 < np.mean(distances) < 1.3  # 1.8 if shared errors are taken for independent ones
    assert np.mean(effective) < 100 if shared else np.mean(effective) > 115


@pytest.mark.parametrize("frames", [4, 6, 12])
def test_covariances_of_few_frames_with_large_shared_errors_are_covariances(frames):
    """The variance of the shared error is estimated from few products; it must not exceed that of a row."""
    for seed in range(15):
        _, rig, x_mm = tool_sweep(seed, frames=frames, offset_mm=np.zeros((3, 3)))
        rng, (frame, landmark) = np.random.default_rng(seed), np.divmod(np.arange(3 * frames), 3)
        u = [p + rng.normal(0, 0.3, p.shape) for p in rig.project(x_mm)]
        rows = Correspondences.of_points(x_mm + rng.normal(0, 0.1, (frames, 3))[frame], *u, frame=frame, landmark=landmark)
        found = calibrate(rows, offsets=False, ransac_px=np.inf)
        assert np.linalg.eigvalsh(found.parameter_covariance)[0] > 0


def test_depth_map_grows_away_from_the_data():
    c, found = made(60, half_size_mm=(3, 2, 1))
    z = ROBOT_FROM_MICROSCOPE.apply(np.array([[0, 0, 0], [6, 0, 0], [6, 4, 0], [6, 4, 3.0]]))
    depth = found.depth_sd_mm(z)
    assert (np.diff(depth) > 0).all()
    assert (found.depth_sd_mm(z, detection=True) > depth).all()
    with pytest.raises(ValueError, match="stereo pair"):
        calibrate(c.x_mm, [c.u_left]).point_covariance(z)


@pytest.mark.parametrize("model", ["affine", "zero_skew"])
def test_advised_position_is_the_best_of_the_box(model):
    _, found = made(20, model=model, half_size_mm=(2, 1, 1))
    low, high = ROBOT_FROM_MICROSCOPE.t - 5, ROBOT_FROM_MICROSCOPE.t + 5
    (position,), (gain,) = next_positions(found, box_grid(low, high, steps=2))
    everywhere = box_grid(low, high, steps=7)
    best, gains = next_positions(found, everywhere, 1)
    np.testing.assert_allclose(position, best[0])
    assert gain == pytest.approx(gains[0])
    if model == "affine":
        np.testing.assert_allclose(position, everywhere[leverage(found, everywhere).argmax()])


def test_predicted_gain_is_the_gain():
    c, found = made(30, half_size_mm=(2, 1, 1), sigma_x_mm=1e-9)
    known = {"sigma_u_px": found.sigma_u_px, "sigma_x_mm": found.sigma_x_mm}
    found = calibrate(c.x_mm, [c.u_left, c.u_right], model="affine", ransac_px=np.inf, **known)
    (x_new,), (gain,) = next_positions(found, box_grid(ROBOT_FROM_MICROSCOPE.t - 5, ROBOT_FROM_MICROSCOPE.t + 5, steps=2))
    u_new = c.true_rig.project(x_new[None])
    again = calibrate(
        np.vstack([c.x_mm, x_new]), [np.vstack(p) for p in zip((c.u_left, c.u_right), u_new, strict=True)],
        model="affine", ransac_px=np.inf, **known,
    )  # fmt: skip
    before, after = (np.linalg.slogdet(k.parameter_covariance)[1] for k in (found, again))
    assert before - after == pytest.approx(gain, rel=0.02)


def test_advice_halves_the_data():
    """From a cluster, advised positions reach with 60 % of the points what random ones reach, over the workspace."""
    rng = np.random.default_rng(0)
    rig, half = reference_rig(), np.array([8, 4.5, 1.5])
    grid = ROBOT_FROM_MICROSCOPE.apply(box_grid(-half, half))
    H_grid = np.column_stack([grid, np.ones(len(grid))])

    def spread(x):
        H = np.column_stack([x, np.ones(len(x))])
        return np.sqrt(np.einsum("ni,ij,nj->n", H_grid, np.linalg.inv(H.T @ H), H_grid).mean())

    better = 0
    for seed in range(10):
        c, found = made(12, seed, half_size_mm=(1, 0.6, 0.4))
        advised = next_positions(found, grid, 12)[0]
        random = ROBOT_FROM_MICROSCOPE.apply(rng.uniform(-1, 1, (20, 3)) * half)
        better += spread(np.vstack([c.x_mm, advised])) <= spread(np.vstack([c.x_mm, random]))
    assert better >= 9 and rig is not None


def test_the_data_are_enough_when_calibration_adds_little():
    grid = box_grid(ROBOT_FROM_MICROSCOPE.t - 3, ROBOT_FROM_MICROSCOPE.t + 3)
    few, many = (made(n)[1] for n in (8, 800))
    added = [added_error(found, grid).max() for found in (few, many)]
    assert added[0] > 0.1 > added[1]
    ratio = np.sqrt((1 + np.array(added)) ** 2 - 1)
    assert ratio[0] > 3 * ratio[1] and few.depth_sd_mm(grid).max() > 3 * many.depth_sd_mm(grid).max()
    with pytest.raises(ValueError, match="high_mm"):
        box_grid(ROBOT_FROM_MICROSCOPE.t + 3, ROBOT_FROM_MICROSCOPE.t - 3)


def test_optics_of_the_reference_rig():
    _, found = made(400)
    seen = optics(found)
    assert np.rad2deg(seen.convergence_rad) == pytest.approx(6.5, abs=0.3)
    assert seen.roll_rad == pytest.approx(-0.035, abs=0.002)
    assert seen.mirrored == "unknown"
    np.testing.assert_allclose(seen.centre_mm, ROBOT_FROM_MICROSCOPE.t, atol=0.2)
    along = found.rig.left.viewing_direction + found.rig.right.viewing_direction
    np.testing.assert_allclose(along / np.linalg.norm(along), ROBOT_FROM_MICROSCOPE.R[:, 2], atol=5e-3)


def flipped(u):
    return np.column_stack([1919 - u[:, 0], u[:, 1]])


def test_one_mirrored_channel_is_detected_by_the_pair():
    c, _ = made(200)
    options = {"ransac_px": np.inf, "image_size_px": (1920, 1080)}
    one = optics(calibrate(c.x_mm, [c.u_left, flipped(c.u_right)], **options))
    assert one.mirrored == "left or right"
    assert np.rad2deg(one.convergence_rad) == pytest.approx(6.5, abs=0.4)
    with pytest.raises(ValueError, match="single camera"):
        optics(calibrate(c.x_mm, [c.u_left]))


def test_perspective_tells_both_mirrored_channels():
    c, _ = made(200)
    rig = reference_rig()
    near = [NearAffineCamera(k.matrix, 1 / 100, (959.5, 539.5), ROBOT_FROM_MICROSCOPE.t) for k in (rig.left, rig.right)]
    u = [k.project(c.true_x_mm) + np.random.default_rng(0).normal(size=(200, 2)) for k in near]
    options = {"model": "zero_skew+distances", "image_size_px": (1920, 1080), "checks": False}
    assert optics(calibrate(c.true_x_mm, u, **options)).mirrored == "no"
    assert optics(calibrate(c.true_x_mm, [flipped(p) for p in u], **options)).mirrored == "both"
    assert optics(calibrate(c.true_x_mm, [flipped(u[0]), u[1]], **options)).mirrored == "left"
