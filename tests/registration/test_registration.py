"""Registration: exact data give the motion, noisy data the minimum, and the cameras that moved are named."""

from __future__ import annotations

import warnings
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation

from lib.calibration import calibrate_as_shown, with_offsets
from lib.cameras import StereoRig
from lib.correspondences import MIN_CONFIDENCE, Correspondences
from lib.geometry import RigidTransform
from lib.registration import (
    DriftMonitor,
    Registration,
    identify_motion,
    register,
    register_images,
)
from lib.registration.rigid import motion_jacobian
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig
from notebooks.studies.moved_cameras import (
    by_points,
    motion_error,
    pushed_images,
    random_motion,
    recorded_errors,
    simulated_errors,
    tool_frames,
)
from tests.calibration.rigs import tool_sweep

CENTRE_MM = ROBOT_FROM_MICROSCOPE.t
RIG = reference_rig()
SIGMA_PX, SIGMA_MM = 1.5, 0.010


def scene(seed: int, n: int = 10, noise: float = 1.0, motion: RigidTransform | None = None, **moved):
    """(motion, x (3 n, 3), u_left, u_right) of a tool seen by the moved reference rig."""
    rng = np.random.default_rng(seed)
    motion = motion or random_motion(rng, centre_mm=CENTRE_MM)
    frames = tool_frames(
        n, rng=rng, rig=RIG.moved(motion, **moved), sigma_u_px=noise * SIGMA_PX, sigma_x_mm=noise * SIGMA_MM
    )
    return motion, frames.x_mm, frames.u_left, frames.u_right


def assert_same(estimate: RigidTransform, truth: RigidTransform, tolerance: float = 1e-9) -> None:
    np.testing.assert_allclose(estimate.R, truth.R, atol=tolerance)
    np.testing.assert_allclose(estimate.t, truth.t, atol=100 * tolerance)


def mahalanobis2(fit: Registration, truth: RigidTransform) -> float:
    """Squared error in units of the claimed covariance; its mean is 6 if the claim is right."""
    error = fit.transform.compose(truth.inverse())
    twist = np.concatenate([Rotation.from_matrix(error.R).as_rotvec(), error.apply(fit.centre_mm) - fit.centre_mm])
    return float(twist @ np.linalg.solve(fit.covariance, twist))


# --- point sets, Eq. (7) -----------------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(3, 20), loss=st.sampled_from(["norm", "squared"]))
def test_exact_points_give_the_motion(seed, n, loss):
    rng = np.random.default_rng(seed)
    truth = RigidTransform(Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 50, 3))
    x = rng.normal(0, 3, (n, 3))
    fit = register(x, truth.apply(x), loss=loss)
    assert_same(fit.transform, truth)
    np.testing.assert_allclose(fit.residuals, 0, atol=1e-9)


def test_half_the_points_may_be_wrong():
    """The sum of norms recovers exactly what the sum of squares cannot."""
    rng = np.random.default_rng(3)
    truth = random_motion(rng, centre_mm=CENTRE_MM)
    x = rng.normal(0, 3, (30, 3))
    y = truth.apply(x)
    y[:12] += rng.uniform(-5, 5, (12, 3))
    assert_same(register(x, y).transform, truth, 1e-6)
    assert motion_error(register(x, y, loss="squared").transform, truth, CENTRE_MM)[0] > 0.1
    assert register(x, y).weights[:12].max() < 1e-3 < register(x, y).weights[12:].min()


@pytest.mark.parametrize("loss", ["norm", "squared"])
def test_minimum_is_that_of_a_general_solver(loss):
    power = {"norm": 1, "squared": 2}[loss]
    for seed in range(3):
        _, x, u_left, u_right = scene(seed, 5)
        source = RIG.triangulate(u_left, u_right).x_mm
        fit = register(source, x, loss=loss)

        def cost(p, source=source, x=x, fit=fit):
            turn = Rotation.from_rotvec(p[:3]).as_matrix()
            moved = (fit.transform.apply(source) - fit.centre_mm) @ turn.T + fit.centre_mm + p[3:]
            return (np.linalg.norm(moved - x, axis=1) ** power).sum()

        assert cost(np.zeros(6)) == pytest.approx(fit.cost, rel=1e-12)
        best = min(
            minimize(cost, start, method="Nelder-Mead", options={"maxfev": 3000, "xatol": 1e-10, "fatol": 1e-13}).fun
            for start in (np.zeros(6), np.full(6, 0.02))
        )
        assert fit.cost <= best * (1 + 1e-9)


def test_mirrored_points_are_not_matched_by_a_reflection():
    x = np.random.default_rng(0).normal(size=(10, 3))
    fit = register(x, x * [1, 1, -1])
    assert np.linalg.det(fit.transform.R) == pytest.approx(1)
    assert fit.cost > 1


@pytest.mark.parametrize(
    ("source", "target", "text"),
    [
        (np.zeros((2, 3)), np.zeros((2, 3)), "x_source: 2 points"),
        (
            np.arange(12.0).reshape(4, 3),
            np.random.default_rng(0).normal(size=(4, 3)),
            "x_source: the points lie on one line",
        ),
        (np.random.default_rng(0).normal(size=(4, 3)), np.ones((4, 3)), "x_target: the points lie on one line"),
        (np.full((4, 3), np.nan), np.zeros((4, 3)), "x_source: 4 of 4 rows are not finite"),
        (np.eye(3), np.eye(4)[:, :3], "3 and 4 points"),
        (np.eye(4), np.eye(4), r"x_source: expected one point a row, \(n, 3\)"),
    ],
)
def test_bad_point_sets(source, target, text):
    with pytest.raises(ValueError, match=text):
        register(source, target)


def test_unknown_losses():
    with pytest.raises(ValueError, match="loss: 'norm' or 'squared'"):
        register(np.eye(3), np.eye(3), loss="huber")
    with pytest.raises(ValueError, match="loss: 'squared' or 'robust'"):
        register_images(RIG, *scene(0)[1:], loss="norm")


def test_motion_jacobian():
    offset = np.random.default_rng(0).normal(size=(5, 3))
    step = 1e-6
    numeric = np.stack(
        [(RigidTransform.from_rotation_vector(p[:3], p[3:]).apply(offset) - offset) / step for p in np.eye(6) * step],
        axis=2,
    )
    np.testing.assert_allclose(motion_jacobian(offset), numeric, atol=1e-5)


# --- images --------------------------------------------------------------------------------------------------------


def test_perturb_moves_what_is_triangulated():
    motion, x, u_left, u_right = scene(0, noise=0)
    np.testing.assert_allclose(motion.apply(RIG.triangulate(u_left, u_right).x_mm), x, atol=1e-9)
    back = RIG.moved(motion).moved(motion.inverse())
    np.testing.assert_allclose(back.linear, RIG.linear, atol=1e-10)
    np.testing.assert_allclose(back.offset_px, RIG.offset_px, atol=1e-8)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 8), loss=st.sampled_from(["squared", "robust"]))
def test_exact_images_give_the_motion(seed, n, loss):
    motion, *data = scene(seed, n, noise=0)
    assert_same(register_images(RIG, *data, covariance_px2=1.0, loss=loss).transform, motion, 1e-7)


def test_image_minimum_is_that_of_a_general_solver():
    for seed in range(3):
        motion, x, u_left, u_right = scene(seed, 4)
        fit = register_images(RIG, x, u_left, u_right, covariance_px2=SIGMA_PX**2, sigma_x_mm=SIGMA_MM)
        whiten = np.linalg.cholesky(np.linalg.inv(SIGMA_PX**2 * np.eye(4) + SIGMA_MM**2 * RIG.linear @ RIG.linear.T)).T
        y = np.hstack([u_left, u_right])

        def residual(p, x=x, y=y, motion=motion, whiten=whiten):
            moved = RigidTransform.from_rotation_vector(p[:3], p[3:]).compose(motion.inverse())
            return ((y - np.hstack(RIG.project(moved.apply(x)))) @ whiten.T).ravel()

        best = least_squares(residual, np.zeros(6), x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14)
        assert fit.cost == pytest.approx(2 * best.cost, rel=1e-9)
        np.testing.assert_allclose(fit.residuals**2 @ np.ones(12), fit.cost, rtol=1e-9)


def test_covariances_hold():
    """Errors over repeated noise are as large as claimed (Monte Carlo against the closed form)."""
    scores = {"norm": [], "squared": [], "image": [], "unknown": [], "robust": []}
    known = {"covariance_px2": SIGMA_PX**2, "sigma_x_mm": SIGMA_MM}
    for seed in range(60):
        motion, x, *u = scene(seed, 30)
        source = RIG.triangulate(*u).x_mm
        scores["norm"].append(mahalanobis2(register(source, x), motion))
        scores["squared"].append(mahalanobis2(register(source, x, loss="squared"), motion))
        scores["image"].append(mahalanobis2(register_images(RIG, x, *u, **known), motion))
        scores["unknown"].append(mahalanobis2(register_images(RIG, x, *u), motion))
        scores["robust"].append(mahalanobis2(register_images(RIG, x, *u, loss="robust", **known), motion))
    mean = {name: np.mean(values) for name, values in scores.items()}
    # 6 +- 0.45 where the model is right; more room where the sandwich is estimated from the residuals.
    assert 4.6 < mean["image"] < 7.4
    assert 4.6 < mean["unknown"] < 8.5
    assert 4.6 < mean["squared"] < 8.5
    assert 4.6 < mean["robust"] < 8.5
    assert 3.0 < mean["norm"] < 10.0


def test_robust_covariances_of_few_rows_hold():
    """The robust weights of the small residuals of few rows exceed 1; they are no information."""
    scores = []
    for seed in range(50):
        motion, *data = scene(seed, 2)
        fit = register_images(RIG, *data, covariance_px2=SIGMA_PX**2, sigma_x_mm=SIGMA_MM, loss="robust")
        scores.append(mahalanobis2(fit, motion))
    assert 4.6 < np.mean(scores) < 7.4


@pytest.mark.parametrize("distance_mm", [np.inf, 400.0, 150.0])
def test_covariances_allow_for_the_calibration_with_its_offsets_and_an_unknown_distance(distance_mm):
    """Calibrated from a tool that hardly moves; then the microscope moves so far that it sees the tool along other rays."""
    scores = {"alone": [], "with calibration": []}
    for seed in range(12):
        rng = np.random.default_rng(seed)
        how = {"distance_mm": distance_mm, "offset_mm": rng.normal(0, 0.03, (3, 3)), "span_mm": (1.2, 1.0, 0.5)}
        found = calibrate_as_shown(tool_sweep(seed, frames=40, **how)[0])
        motion = random_motion(rng, centre_mm=CENTRE_MM, translation_mm=5.0)
        later = tool_sweep(seed + 500, frames=20, motion=motion, **how)[0]
        varied = [(rig, with_offsets(later, offsets)) for rig, offsets in found.variations]
        seen = with_offsets(later, found.offsets)
        for name, variations in (("alone", ()), ("with calibration", varied)):
            fit = register_images(found.rig, seen, covariance_px2=0.64, sigma_x_mm=0.01, variations=variations)
            scores[name].append(mahalanobis2(fit, motion))
    assert 4.0 < np.mean(scores["with calibration"]) < 8.5  # 6; at 400 mm it is 23 if an unknown distance is taken for none
    assert np.mean(scores["alone"]) > 50


def test_a_tool_that_no_camera_sees_may_be_anywhere():
    """Behind near cameras, too, as a retracted tool."""
    rows = tool_sweep(0, frames=20, distance_mm=150.0)[0]
    found, gone = calibrate_as_shown(rows), rows.frame >= 17
    u = [np.where(gone[:, None], np.nan, u) for u in (rows.u_left, rows.u_right)]
    away = -400 * found.rig.left.viewing_direction * gone[:, None]
    later = replace(rows, x_mm=rows.x_mm + away, u_left=u[0], u_right=u[1])
    varied = [(rig, with_offsets(later, offsets)) for rig, offsets in found.variations]
    fit = register_images(found.rig, with_offsets(later, found.offsets), variations=varied, sigma_x_mm=0.01)
    assert np.isfinite(fit.covariance).all()


def test_covariance_at_grows_with_distance():
    _, *data = scene(1)
    fit = register_images(RIG, *data)
    near, far = fit.covariance_at(fit.transform.inverse().apply(fit.centre_mm + np.array([[0, 0, 0], [20.0, 0, 0]])))
    np.testing.assert_allclose(near, fit.covariance[3:, 3:], rtol=1e-9)
    assert np.trace(far) > 2 * np.trace(near)
    np.testing.assert_allclose(fit.translation_sd_mm, np.sqrt(np.diag(near)))


@pytest.mark.parametrize("loss", ["squared", "robust"])
def test_one_frame_with_shut_jaws_does_not_show_the_rotation(loss):
    """It may be wrong by tens of degrees, since the three landmarks lie nearly on a line: a warning says so."""
    noise = {"covariance_px2": SIGMA_PX**2, "sigma_x_mm": SIGMA_MM, "loss": loss}
    shut, opened = (
        tool_frames(1, rng=np.random.default_rng(3), rig=RIG, opening_rad=(rad, rad), sigma_u_px=SIGMA_PX)
        for rad in (0.005, 0.5)
    )
    with pytest.warns(UserWarning, match="x_mm: the rotation about an axis .* use more frames, or frames with open jaws"):
        register_images(RIG, shut, **noise)
    with warnings.catch_warnings(action="error"):
        register_images(RIG, opened, **noise)


def test_one_image_of_a_landmark_still_counts():
    motion, x, u_left, u_right = scene(5, 6, noise=0)
    u_left[::3], u_right[1::3] = np.nan, np.nan
    u_left[4] = u_right[4] = np.nan
    fit = register_images(RIG, x, u_left, u_right)
    assert_same(fit.transform, motion, 1e-7)
    assert np.isnan(fit.residuals).sum() == 1


def test_per_landmark_covariances_steer_the_fit():
    motion, x, u_left, u_right = scene(2, 6, noise=0)
    u_left[:3] += 30.0
    covariance = np.tile(np.eye(4), (len(x), 1, 1))
    plain = register_images(RIG, x, u_left, u_right, covariance_px2=covariance)
    covariance[:3] *= 1e8
    steered = register_images(RIG, x, u_left, u_right, covariance_px2=covariance)
    assert (
        motion_error(steered.transform, motion, CENTRE_MM)[0]
        < 1e-4
        < motion_error(plain.transform, motion, CENTRE_MM)[0]
    )


def test_gross_outliers_lose_their_weight():
    motion, x, u_left, u_right = scene(7)
    u_left[[2, 9, 20]] += [[80.0, -60.0]]
    fit = register_images(RIG, x, u_left, u_right, covariance_px2=SIGMA_PX**2, loss="robust")
    plain = register_images(RIG, x, u_left, u_right, covariance_px2=SIGMA_PX**2)
    assert motion_error(fit.transform, motion, CENTRE_MM)[0] < 0.1 < motion_error(plain.transform, motion, CENTRE_MM)[0]
    assert fit.weights[[2, 9, 20]].max() < 0.05
    assert np.delete(fit.weights, [2, 9, 20]).min() > 0.1


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda x, ul, ur: (x[:2], ul[:2], ur[:2]), "2 points"),
        (lambda x, ul, ur: (x, ul[:-1], ur), "30, 29 and 30 rows"),
        (lambda x, ul, ur: (x * np.nan, ul, ur), "0 points"),
        (lambda x, ul, ur: (x, ul * np.nan, ur * np.nan), "0 points"),
        (lambda x, ul, ur: (np.linspace(0, 1, 30)[:, None] * [1, 2, 3] + CENTRE_MM, ul, ur), "on one line"),
        (lambda x, ul, ur: (x, ul, ur * np.nan), "do not determine the motion. Both cameras must see the tool"),
    ],
)
def test_bad_images(change, text):
    with pytest.raises(ValueError, match=text):
        register_images(RIG, *change(*scene(0)[1:]))


def test_bad_noise():
    data = scene(0)[1:]
    with pytest.raises(ValueError, match="covariance_px2"):
        register_images(RIG, *data, covariance_px2=np.eye(3))
    for sigma_x_mm in (-1, np.inf):
        with pytest.raises(ValueError, match="sigma_x_mm"):
            register_images(RIG, *data, sigma_x_mm=sigma_x_mm)
    unknown = np.tile(np.eye(4), (len(data[0]), 1, 1))
    unknown[2, :2, :2] = np.nan
    with pytest.raises(ValueError, match="covariance_px2: must be finite where an image shows a landmark"):
        register_images(RIG, *data, covariance_px2=unknown)
    data[1][2] = np.nan  # not seen: its noise does not matter
    assert np.isfinite(register_images(RIG, *data, covariance_px2=unknown).covariance).all()


# --- cameras that move apart -----------------------------------------------------------------------------------------


def grid_error_mm(rig: StereoRig, truth: StereoRig) -> float:
    """Root mean square triangulation error of `rig` over the workspace when `truth` took the pictures."""
    x = tool_frames(40, rng=np.random.default_rng(99)).true_x_mm
    return float(np.sqrt(((rig.triangulate(*truth.project(x)).x_mm - x) ** 2).sum(axis=1).mean()))


def test_cameras_moved_apart_are_recovered_exactly():
    rng = np.random.default_rng(4)
    left, right = (random_motion(rng, centre_mm=CENTRE_MM) for _ in range(2))
    truth = RIG.moved(left, right)
    _, *data = scene(0, 4, noise=0, motion=left, right=right)
    found = identify_motion(RIG, *data, covariance_px2=1.0)
    assert found.moved == "apart"
    np.testing.assert_allclose(found.rig.linear, truth.linear, atol=1e-6)
    assert grid_error_mm(found.rig, truth) < 1e-6


def test_one_camera_alone_breaks_the_rigid_copy():
    """1 degree of one camera: triangulated points are no rigid copy, Eq. (7) cannot mend it, the images can."""
    turn = RigidTransform.from_rotation_vector(np.deg2rad(1.0) * RIG.left.viewing_direction)
    motion = RigidTransform(turn.R, CENTRE_MM - turn.R @ CENTRE_MM)
    stay = RigidTransform.identity()
    truth = RIG.moved(motion, stay)
    _, *data = scene(0, 20, noise=0, motion=motion, right=stay)
    rigid = register(RIG.triangulate(*data[1:]).x_mm, data[0], loss="squared")
    assert np.sqrt((rigid.residuals**2).mean()) > 0.02
    found = identify_motion(RIG, *data, covariance_px2=1.0)
    assert found.moved == "left"
    assert found.right is None
    assert grid_error_mm(found.rig, truth) < 1e-4 < 0.02 < grid_error_mm(RIG.moved(rigid.transform), truth)


@pytest.mark.parametrize("moved", ["none", "together", "left", "right", "apart"])
def test_the_camera_that_moved_is_named(moved):
    rng = np.random.default_rng(8)
    stay = RigidTransform.identity()
    a, b = (random_motion(rng, centre_mm=CENTRE_MM, rotation_rad=0.05, translation_mm=0.3) for _ in range(2))
    pair = {"none": (stay, stay), "together": (a, a), "left": (a, stay), "right": (stay, b), "apart": (a, b)}[moved]
    _, x, u_left, u_right = scene(11, 8, motion=pair[0], right=pair[1])
    u_left[3] += 70.0  # one gross error must not decide
    found = identify_motion(RIG, x, u_left, u_right, covariance_px2=SIGMA_PX**2, sigma_x_mm=SIGMA_MM)
    assert found.moved == moved
    assert min(found.bic, key=found.bic.get) == moved
    assert grid_error_mm(found.rig, RIG.moved(*pair)) < 0.15


@pytest.mark.parametrize("moved", ["left", "right"])
def test_the_image_of_the_camera_that_stayed_shows_the_robots_errors(moved):
    """A detector ten times as exact as the robot: the other camera has not moved as well."""
    stay, errors_mm = RigidTransform.identity(), []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        motion = random_motion(rng, centre_mm=CENTRE_MM, rotation_rad=0.02, translation_mm=0.05)
        rig = RIG.moved(*((motion, stay) if moved == "left" else (stay, motion)))
        data = tool_frames(10, rng=rng, rig=rig, sigma_u_px=0.1, sigma_x_mm=SIGMA_MM)
        found = identify_motion(RIG, data, covariance_px2=0.01, sigma_x_mm=SIGMA_MM)
        assert found.moved == moved
        errors_mm.append(grid_error_mm(found.rig, rig))
    assert np.median(errors_mm) < 0.012


# --- near-affine cameras -----------------------------------------------------------------------------------------------

NEAR = reference_rig(inverse_distance_per_mm=1 / 150.0)


def test_near_affine_rigs_are_moved_exactly():
    motion, x, *_ = scene(1)
    for u, expected in zip(NEAR.moved(motion).project(motion.apply(x)), NEAR.project(x), strict=True):
        np.testing.assert_allclose(u, expected, atol=1e-8)
    assert np.abs(np.hstack(NEAR.project(x)) - np.hstack(RIG.project(x))).max() > 5.0


@pytest.mark.parametrize("loss", ["squared", "robust"])
def test_near_affine_rigs_are_registered_exactly(loss):
    motion = random_motion(np.random.default_rng(3), centre_mm=CENTRE_MM)
    data = tool_frames(5, rng=np.random.default_rng(3), rig=NEAR.moved(motion), sigma_u_px=0, sigma_x_mm=0)
    assert_same(register_images(NEAR, data, covariance_px2=1.0, loss=loss).transform, motion, 1e-7)


@pytest.mark.parametrize("moved", ["none", "together", "left", "apart"])
def test_the_near_affine_camera_that_moved_is_named(moved):
    rng = np.random.default_rng(8)
    stay = RigidTransform.identity()
    a, b = (random_motion(rng, centre_mm=CENTRE_MM, rotation_rad=0.05, translation_mm=0.3) for _ in range(2))
    pair = {"none": (stay, stay), "together": (a, a), "left": (a, stay), "apart": (a, b)}[moved]
    now = NEAR.moved(*pair)
    data = tool_frames(12, rng=rng, rig=now)
    found = identify_motion(NEAR, data, covariance_px2=SIGMA_PX**2, sigma_x_mm=SIGMA_MM)
    assert found.moved == moved
    assert grid_error_mm(found.rig, now) < 0.15


# --- correspondences ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("along_mm", [-160, 160])
def test_cameras_that_moved_to_behind_the_tool_are_named(along_mm):
    """As seen from where they were."""
    rig = reference_rig(inverse_distance_per_mm=1 / 150)
    x = np.random.default_rng(0).normal(0, 2, (30, 3)) + CENTRE_MM
    shift_mm = along_mm * rig.left.viewing_direction
    moved = rig.moved(RigidTransform(np.eye(3), shift_mm))
    with pytest.raises(ValueError, match="x_mm: landmarks lie behind the rig's cameras") if along_mm < 0 else nullcontext():
        found = identify_motion(rig, x + shift_mm, *moved.project(x + shift_mm), covariance_px2=1.0)
        assert np.abs(found.left.transform.t - shift_mm).max() < 1


def with_covariance(data: Correspondences, variance_px2: np.ndarray) -> Correspondences:
    plain = data.subset(slice(None))
    return replace(plain, covariance_px2=variance_px2[:, None, None, None] * np.eye(2) + np.zeros((len(data), 2, 1, 1)))


def test_correspondences_bring_their_own_noise():
    motion = random_motion(np.random.default_rng(5))
    data = tool_frames(6, rng=np.random.default_rng(5), rig=RIG.moved(motion))
    data.u_left[:3] += 30.0
    data.u_right[7] = np.nan
    stated = with_covariance(data, np.where(np.arange(len(data)) < 3, 1e6, SIGMA_PX**2))
    arrays = (data.x_mm, data.u_left, data.u_right)
    given = register_images(RIG, *arrays, covariance_px2=stated.pair_covariance_px2)
    assert_same(register_images(RIG, stated).transform, given.transform, 1e-12)
    assert motion_error(given.transform, motion, CENTRE_MM)[0] < 0.1
    assert identify_motion(RIG, stated).moved == "together"
    with pytest.raises(ValueError, match="covariance_px2: give the noise"):
        identify_motion(RIG, *arrays)


def test_landmarks_of_low_confidence_and_without_the_robot_do_not_count():
    motion, *arrays = scene(6, 8, noise=0)
    x, u_left, u_right = (values.copy() for values in arrays)
    x[4] = np.nan
    u_left[7] += 50.0
    confidence = np.ones((len(x), 2))
    confidence[7, 0] = 0.5 * MIN_CONFIDENCE
    data = Correspondences.of_points(x, u_left, u_right, confidence=confidence)
    fit = register_images(RIG, data, covariance_px2=1.0)
    assert_same(fit.transform, motion, 1e-7)
    assert np.flatnonzero(np.isnan(fit.residuals)).tolist() == [4]
    monitor = DriftMonitor(RIG.moved(motion), covariance_px2=1.0)
    monitor.update(data)
    assert monitor.history[-1][1] == 4 * (len(x) - 2)


@pytest.mark.parametrize("bad", [-1.0, 0.0, -np.eye(4), np.diag([1.0, 1, 1, -1])])
def test_what_is_no_covariance_is_refused(bad):
    """A negative variance would turn a large residual into a small statistic, and no drift would ever be noticed."""
    _, *data = scene(0)
    with pytest.raises(ValueError, match="covariance_px2"):
        register_images(RIG, *data, covariance_px2=bad)
    with pytest.raises(ValueError, match="covariance_px2"):
        DriftMonitor(RIG, covariance_px2=bad)
    monitor = DriftMonitor(RIG, covariance_px2=1.0)
    with pytest.raises(ValueError, match="covariance_px2"):
        monitor.update(*data, covariance_px2=bad)
    with pytest.raises(ValueError, match="covariance_px2: must be finite"):
        monitor.update(*data, covariance_px2=np.full((len(data[0]), 4, 4), np.nan))


# --- drift -----------------------------------------------------------------------------------------------------------


def monitor_frames(rig: StereoRig, n: int, seed: int = 0):
    frames = tool_frames(n, rng=np.random.default_rng(seed), rig=rig)
    return [frames.of_frames(i) for i in range(n)]


def test_drift_is_noticed_and_noise_is_not():
    monitor = DriftMonitor(RIG, covariance_px2=SIGMA_PX**2, sigma_x_mm=SIGMA_MM)
    assert not any(monitor.update(frame) for frame in monitor_frames(RIG, 500))
    chi2 = np.array([entry[0] for entry in monitor.history])
    assert chi2.mean() == pytest.approx(12, abs=0.7)  # 12 +- 0.22
    for shift_mm, within in ((0.05, 5), (0.1, 3), (1.0, 3)):
        moved = RIG.moved(RigidTransform.from_rotation_vector((0, 0, 0), (shift_mm, 0, 0)))
        monitor.reset(RIG)
        alarms = [monitor.update(frame) for frame in monitor_frames(moved, 6, seed=1)]
        assert alarms.index(True) < within
        assert monitor.statistic > 1.0
        monitor.reset(moved)
        assert not any(monitor.update(frame) for frame in monitor_frames(moved, 100, seed=2))


def test_one_bad_frame_raises_no_alarm():
    monitor = DriftMonitor(RIG, covariance_px2=SIGMA_PX**2)
    for i, frame in enumerate(monitor_frames(RIG, 20)):
        assert not monitor.update(frame.x_mm, frame.u_left + 500.0 * (i == 10), frame.u_right)


def test_missing_landmarks_do_not_count():
    monitor = DriftMonitor(RIG, covariance_px2=SIGMA_PX**2)
    (frame,) = monitor_frames(RIG, 1)
    x, u_left, u_right = frame.x_mm, frame.u_left, frame.u_right
    u_left[0] = np.nan
    monitor.update(x, u_left, u_right)
    assert monitor.history[-1][1] == 8
    before = monitor.statistic
    monitor.update(x, u_left * np.nan, u_right)
    assert monitor.history[-1] == (0.0, 0, before)
    with pytest.raises(ValueError, match="sigma_x_mm"):
        DriftMonitor(RIG, covariance_px2=1.0, sigma_x_mm=-0.01)


# --- the paper's experiment ------------------------------------------------------------------------------------------


def test_the_papers_experiment():
    """Below 150 um after 3 frames, and the image-space estimate is the better one (Sec. V, Fig. Tool Registration)."""
    estimators = {"norm": by_points, "image": register_images}
    errors = simulated_errors(estimators, [1, 3, 10], trials=40, rng=np.random.default_rng(0))
    rms_um = {name: error.translation_rms_um for name, error in errors.items()}
    assert errors["norm"].euler_rad.shape == (40, 3, 3)
    assert (np.diff(rms_um["norm"]) < 0).all()
    assert (np.diff(errors["image"].euler_rms_deg.max(axis=1)) < 0).all()
    assert rms_um["norm"][1] < 150
    assert (rms_um["image"] < 0.85 * rms_um["norm"]).all()


def test_the_experiment_on_a_recording():
    """Each window of frames is one trial; exact landmarks give no error, missing ones are left out."""
    data = tool_frames(12, rng=np.random.default_rng(0), sigma_u_px=0, sigma_x_mm=0)
    data.u_left[3 * 3 + 1] = np.nan
    data.x_mm[15:18] = np.nan
    rng = np.random.default_rng(1)
    found = recorded_errors({"image": register_images}, [2, 4], rig=RIG, data=data, rng=rng)["image"]
    assert found.trials.tolist() == [11, 9]
    assert np.nanmax(found.translation_mm[:, 1]) < 1e-6
    with pytest.raises(ValueError, match="n_frames: up to 20"):
        recorded_errors({"image": register_images}, [20], rig=RIG, data=data, rng=rng)


def test_pushed_images_show_what_moved_cameras_see():
    """A bright dot on black lands where the moved rig projects its point."""
    small = reference_rig(pixels_per_mm=(10.0, 9.0), image_size_px=(192, 108))
    x = ROBOT_FROM_MICROSCOPE.apply(np.array([[1.0, -0.5, 0.3]]))
    images = []
    for u in small.project(x):
        grid = np.stack(np.meshgrid(np.arange(192), np.arange(108)), axis=-1)
        images.append(np.uint8(255 * np.exp(-((grid - u[0]) ** 2).sum(axis=2) / 18))[:, :, None].repeat(3, axis=2))
    motion = RigidTransform(np.eye(3), np.array([0.8, -0.4, 0.7]))
    moved = small.moved(motion).project(x)
    assert np.linalg.norm(np.subtract(moved, small.project(x))) > 5
    for image, u in zip(pushed_images(*images, small, motion), moved, strict=True):
        weight = image[:, :, 0].astype(float)
        centroid = (grid * weight[:, :, None]).sum(axis=(0, 1)) / weight.sum()
        np.testing.assert_allclose(centroid, u[0], atol=0.05)


def test_tool_frames_have_the_tools_size():
    frames = tool_frames(50, rng=np.random.default_rng(0))
    x = frames.true_x_mm.reshape(-1, 3, 3)
    jaw = np.linalg.norm(x[:, 1:] - x[:, :1], axis=2)
    assert jaw == pytest.approx(jaw[0, 0])
    assert 2 <= jaw[0, 0] <= 4
    for u in (frames.u_left, frames.u_right):
        assert ((u > -200) & (u < [2120, 1280])).all()


def test_angles_of_a_motion_are_about_the_fixed_axes_in_the_order_x_y_z():
    turns = [RigidTransform.from_rotation_vector(angle * np.eye(3)[i]) for i, angle in enumerate((0.1, -0.2, 0.3))]
    combined = turns[2].compose(turns[1]).compose(turns[0])
    angles = motion_error(combined, RigidTransform.identity(), np.zeros(3))[1]
    np.testing.assert_allclose(angles, (0.1, -0.2, 0.3), atol=1e-14)


def test_errors_that_last_sideways_are_no_move():
    """A detector that errs alike for some twenty frames: what the frames surely show of that widens the noise."""
    alarms, shifts, rig = 0, [], reference_rig()
    for seed in range(3):
        rng, slow, monitor = np.random.default_rng(seed), np.zeros(2), DriftMonitor(rig, covariance_px2=1.0, sigma_x_mm=0.0)
        for i in range(640):
            slow = 0.9 * slow + rng.normal(0, 0.65, 2)
            x = rng.uniform(-3, 3, (3, 3))
            moved = 12.0 * (i >= 600)
            if monitor.update(x, *(v + slow + moved + rng.normal(0, 0.7, v.shape) for v in rig.project(x))):
                alarms += 100 < i < 600
                shifts += [i - 600] * (i >= 600)
                monitor.forget()
    assert alarms < 10 and len(shifts) >= 3 and min(shifts) < 10
