"""Constant offsets of the landmarks: found where the tool turns, left to the prior where it does not."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from lib.calibration import CompetingCamerasError, calibrate, estimate, with_offsets
from lib.calibration.offsets import Unsettled, carried, estimate_offsets, shown_axes, start_of_turning, tool_axes
from lib.correspondences import Correspondences
from lib.geometry import RigidTransform
from lib.simulator.rig import IMAGE_SIZE_PX, ROBOT_FROM_MICROSCOPE, reference_rig
from notebooks.studies.moved_cameras import tool_frames
from tests.calibration.rigs import LANDMARKS_MM, OFFSETS_MM, tool_sweep


def test_axes_are_those_of_the_tool():
    R = RigidTransform.from_rotation_vector((0.3, -1.2, 2.0), (5, 6, 7))
    axes = tool_axes(np.stack([R.apply(LANDMARKS_MM), LANDMARKS_MM]))
    np.testing.assert_allclose(axes @ axes.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (2, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(axes[0], R.R @ axes[1], atol=1e-12)
    np.testing.assert_allclose(axes[1, :, 1], [0, 1, 0], atol=1e-12)
    shut = LANDMARKS_MM.copy()
    shut[1:, 1] = [-0.05, 0.05]
    assert np.isnan(tool_axes(shut[None])).any()
    with pytest.raises(ValueError, match="base, tip_1 and tip_2"):
        tool_axes(np.zeros((4, 2, 3)))


def test_shown_axes_are_projected_and_those_of_jaws_that_are_always_shut_are_the_first():
    rig, turn = reference_rig(), Rotation.random(6, random_state=0).as_matrix()
    x = LANDMARKS_MM @ turn.mT
    x[4] = np.nan  # the robot is silent
    found = shown_axes(x, (rig.left, rig.right))
    length_mm = np.linalg.norm(LANDMARKS_MM[1:].mean(axis=0) - LANDMARKS_MM[0])
    assert found.shape == (6, 2, 2, 3) and np.isnan(found[4]).all() and np.isfinite(found[:4]).all()
    step = np.stack(rig.project(x[:, 0] + length_mm * tool_axes(x)[:, :, 2])) - np.stack(rig.project(x[:, 0]))
    np.testing.assert_allclose(found[..., 2], step.swapaxes(0, 1), atol=1e-8)
    shut = x.copy()
    shut[:, 1:] = x[:, 1:].mean(axis=1, keepdims=True)
    closed = shown_axes(shut, (rig.left, rig.right))
    np.testing.assert_allclose(closed[..., 0], found[..., 0], atol=1e-8)
    assert np.nanmax(np.abs(closed[..., 1:])) == 0


@pytest.mark.parametrize("width_mm", [0.25, 0.4, 1.0])
@pytest.mark.parametrize("side", [-1, 1])
def test_axes_of_a_tool_that_is_reported_off(width_mm, side):
    """Jaws that the robot reports wider or narrower, and turned, have the true tool's axes again."""
    tool = np.array([[[0.0, 0.0, 0.0], [3.0, -width_mm / 2, 0.0], [3.0, width_mm / 2, 0.0]]])
    offset = np.array([[0.02, 0.1, 0.0], [-0.1, 0.1 * side, 0.1], [0.1, -0.1 * side, -0.08]])
    R = RigidTransform.from_rotation_vector((0.3, -1.2, 2.0), (5, 6, 7))
    reported = R.apply((tool - offset).reshape(-1, 3)).reshape(1, 3, 3)
    np.testing.assert_allclose(tool_axes(reported, offset)[0], R.R, atol=1e-6)
    assert np.abs(tool_axes(reported)[0] - R.R).max() > 0.03
    assert np.isnan(tool_axes(np.zeros((1, 3, 3)), offset)).any()


#: As large as a third of a tool of 0.6 mm, and as its jaws' opening.
LARGE_MM = np.array([[0.006, -0.078, -0.184], [-0.082, -0.109, 0.146], [0.146, 0.074, -0.115]])


@pytest.mark.parametrize("width_mm", [0.25, 0.32, 0.41])
def test_axes_of_a_short_tool_that_is_reported_far_off(width_mm):
    tool = np.array([[0.0, 0.0, 0.0], [0.56, 0.1 - width_mm / 2, 0.0], [0.52, 0.1 + width_mm / 2, 0.0]])
    tool[1:] -= [0, tool[1:].mean(axis=0)[1], 0]
    R = RigidTransform.from_rotation_vector((0.3, -1.2, 2.0), (5, 6, 7))
    np.testing.assert_allclose(tool_axes(R.apply(tool - LARGE_MM)[None], LARGE_MM)[0], R.R, atol=1e-9)


def test_axes_of_shut_jaws_that_are_reported_crossed():
    """By its offsets the robot reports tip_2 where tip_1 is; jaws that were open before and after tell which is which."""
    width_mm = np.array([0.9, 0.6, 0.38, 0.05, 0.02, 0.0, 0.03, 0.37, 0.8])
    offset = np.array([[0.02, -0.15, 0.0], [-0.05, -0.1, 0.04], [0.05, 0.11, -0.03]])
    tool = np.zeros((len(width_mm), 3, 3))
    tool[:, 1:, 0], tool[:, 1, 1], tool[:, 2, 1] = 3.0, -width_mm / 2, width_mm / 2
    R = Rotation.from_rotvec(np.outer(np.arange(len(tool)), [0.3, 0.1, -0.05])).as_matrix()
    reported = (tool - offset) @ R.mT
    crossed = np.einsum("ni,ni->n", reported[:, 2] - reported[:, 1], R[:, :, 1]) < 0
    assert crossed.tolist() == 3 * [False] + 4 * [True] + 2 * [False]
    np.testing.assert_allclose(tool_axes(reported, offset), R, atol=1e-6)
    assert np.abs(tool_axes(reported[4:5], offset)[0] - R[4]).max() > 1  # that row alone does not tell


def test_large_offsets_of_a_short_tool_are_found():
    rng, (data, rig, _) = np.random.default_rng(5), tool_sweep(5)
    x, offset = data.grid("x_mm"), 0.6 * LARGE_MM
    middle = x.mean(axis=1, keepdims=True)
    x = middle + 0.3 * (x - middle)
    x[:, 1:] += (x[:, 1:].mean(axis=1, keepdims=True) - x[:, 1:]) * rng.uniform(-0.4, 0.3, (len(x), 1, 1))  # jaws that open
    reported = x - np.einsum("nij,kj->nki", tool_axes(x), offset) + rng.normal(0, 0.003, x.shape)
    u = [p + rng.normal(0, 0.5, p.shape) for p in rig.project(x.reshape(-1, 3))]
    found = calibrate(Correspondences.of_points(reported.reshape(-1, 3), *u, frame=data.frame, landmark=data.landmark))
    assert found.offsets.turns and found.reprojection_rms_px < 1.5
    apart = found.offsets.offset - offset
    assert np.abs(apart - apart.mean(axis=0)).max() < 0.02  # what all share looks like a shift of the cameras


@pytest.mark.parametrize("seed", [0, 4, 7])
def test_offsets_as_large_as_a_fifth_of_the_tool_are_found_from_far_off(seed):
    """The reported axes lead to another minimum; of a grid of turns one leads to the right one."""
    rng, (data, rig, _) = np.random.default_rng(seed), tool_sweep(seed)
    offset = rng.normal(size=(3, 3))
    offset *= 0.2 / np.linalg.norm(offset, axis=1, keepdims=True)
    x = data.grid("x_mm")
    middle = x.mean(axis=1, keepdims=True)
    x = middle + 0.3 * (x - middle)
    x[:, 1:] += (x[:, 1:].mean(axis=1, keepdims=True) - x[:, 1:]) * rng.uniform(-0.4, 0.3, (len(x), 1, 1))
    reported = x - np.einsum("nij,kj->nki", tool_axes(x), offset) + rng.normal(0, 0.003, x.shape)
    u = [p + rng.normal(0, 0.5, p.shape) for p in rig.project(x.reshape(-1, 3))]
    found = calibrate(Correspondences.of_points(reported.reshape(-1, 3), *u, frame=data.frame, landmark=data.landmark))
    apart = found.offsets.offset - offset
    assert found.offsets.turns and np.abs(apart - apart.mean(axis=0)).max() < 0.015


@pytest.mark.parametrize(("seed", "turn_rad"), [(0, 0.05), (3, 0.05), (8, 0.1)])
def test_offsets_of_jaws_that_shut_are_found_where_the_tool_hardly_turns(seed, turn_rad):
    """By the reported axes the tips' heights seem to be none: only as they turn the axes of shut jaws do they show."""
    rng, (data, rig, _) = np.random.default_rng(seed), tool_sweep(seed, frames=24, turn_rad=turn_rad)
    x, offset = data.grid("x_mm"), np.array([[0.08, -0.1, -0.02], [0.0, 0.01, -0.18], [0.02, 0.07, 0.11]])
    half = x[:, 2] - x[:, 1]
    width_mm = np.interp(np.arange(24), [0, 8, 16, 24], [2.0, 1.8, 0.4, 0.4])
    half *= (width_mm / np.linalg.norm(half, axis=1) / 2)[:, None]
    x[:, 1:] = x[:, 1:].mean(axis=1, keepdims=True) + np.stack([-half, half], axis=1)
    reported = x - np.einsum("nij,kj->nki", tool_axes(x), offset) + rng.normal(0, 0.005, x.shape)
    u = [p + rng.normal(0, 0.5, p.shape) for p in rig.project(x.reshape(-1, 3))]
    found = calibrate(Correspondences.of_points(reported.reshape(-1, 3), *u, frame=data.frame, landmark=data.landmark))
    apart = found.offsets.offset - offset
    assert found.offsets.turns and np.abs(apart - apart.mean(axis=0)).max() < 0.02


@pytest.mark.parametrize("frames", [4, 5, 6])
def test_offsets_of_few_frames_are_estimated_and_none_are_invented(frames):
    """Cameras of four to six frames are three times as good where landmarks are off, and as good where they are not."""
    corners = ROBOT_FROM_MICROSCOPE.apply(np.stack(np.meshgrid([-6, 6], [-3, 3], [-1.5, 1.5]), axis=-1).reshape(-1, 3))

    def error_px(size, options):
        errors = []
        for seed in range(6):
            offset = np.random.default_rng(seed).normal(0, size, (3, 3))
            data, rig, _ = tool_sweep(seed, frames=frames, offset_mm=offset)
            found = calibrate(data, **options)
            apart = np.hstack([a - b for a, b in zip(found.rig.project(corners), rig.project(corners), strict=True)])
            errors.append(np.median(np.abs(apart - np.median(apart, axis=0))))
        return np.median(errors)

    assert error_px(0.1, {}) < error_px(0.1, {"offsets": False}) / 3
    assert error_px(0.0, {}) < 1.1 * error_px(0.0, {"offsets": False})


@pytest.mark.parametrize("seed", [4, 7, 12, 29, 39])
def test_landmarks_that_are_off_are_no_reason_to_refuse_a_small_workspace(seed):
    rng, (data, rig, _) = np.random.default_rng(seed), tool_sweep(seed, frames=36, turn_rad=0.3)
    x = data.grid("x_mm")
    middle = x.mean(axis=1, keepdims=True)
    x = x.mean(axis=(0, 1)) + 0.12 * (middle - x.mean(axis=(0, 1))) + 0.25 * (x - middle)
    offset = rng.normal(size=(3, 3))
    offset *= 0.2 / np.linalg.norm(offset, axis=1, keepdims=True)
    reported = x - np.einsum("nij,kj->nki", tool_axes(x), offset) + rng.normal(0, 0.004, x.shape)
    u = [p + rng.normal(0, 0.4, p.shape) for p in rig.project(x.reshape(-1, 3))]
    found = calibrate(Correspondences.of_points(reported.reshape(-1, 3), *u, frame=data.frame, landmark=data.landmark))
    assert found.view_inliers.mean() > 0.95 and found.reprojection_rms_px < 1.5


def test_some_rows_of_all_landmarks_tell_where_turning_offsets_start(monkeypatch):
    rng, (data, rig, _) = np.random.default_rng(4), tool_sweep(4, frames=150)
    x, offset = data.grid("x_mm"), 0.6 * LARGE_MM
    reported = x - np.einsum("nij,kj->nki", tool_axes(x), offset)
    u = [p + rng.normal(0, 0.5, p.shape) for p in rig.project(x.reshape(-1, 3))]
    data = Correspondences.of_points(reported.reshape(-1, 3), *u, frame=data.frame, landmark=data.landmark)
    monkeypatch.setattr("lib.calibration.offsets._STARTING_ROWS", len(data) // 3)
    starts = []

    def kept(*given):
        starts.append(start_of_turning(*given))
        return starts[-1]

    monkeypatch.setattr("lib.calibration.estimate.start_of_turning", kept)
    calibrate(data)
    apart = starts[0] - offset
    assert np.abs(apart - apart.mean(axis=0)).max() < 0.02


@pytest.mark.parametrize("seed", [2, 4])
def test_landmarks_that_are_off_are_no_cameras_that_compete(seed):
    """A tool that hardly turns: base and tips agree on two cameras each, but for offsets of 0.15 mm."""
    offset = np.array([[0.02, -0.15, 0.0], [-0.05, 0.1, 0.04], [0.05, 0.11, -0.03]])
    data = tool_sweep(seed, turn_rad=0.05, offset_mm=offset, sigma_px=0.5)[0]
    with pytest.raises(CompetingCamerasError):
        calibrate(data, offsets=False)
    found = calibrate(data)
    assert found.reprojection_rms_px < 2 and found.view_inliers.all()
    apart = found.offsets.offset - offset
    assert np.abs(apart - apart.mean(axis=0)).max() < 0.03
    without = np.where(data.landmark == 1, 0.0, data.confidence.T).T  # tip_1 is never seen
    assert calibrate(replace(data, confidence=without)).view_inliers[data.landmark != 1].all()


@pytest.mark.parametrize(("seed", "share"), [(0, 0.2), (12, 0.2), (5, 0.2), (3, 0.3), (39, 0.3)])
def test_landmarks_that_are_off_are_told_from_other_cameras_beside_wrong_detections(seed, share):
    """Each landmark agrees with itself, so that wrong detections, a share of all, cannot spoil the first offsets."""
    offset = np.array([[0.02, -0.15, 0.0], [-0.05, 0.3, 0.04], [0.05, 0.11, -0.03]])
    data = tool_sweep(seed, turn_rad=0.05, offset_mm=offset, sigma_px=0.5)[0]
    rng = np.random.default_rng(seed)
    wrong = rng.random((len(data), 2)) < share
    left, right = (np.where(w[:, None], u + rng.uniform(-300, 300, u.shape), u)
                   for w, u in zip(wrong.T, (data.u_left, data.u_right), strict=True))  # fmt: skip
    found = calibrate(replace(data, u_left=left, u_right=right))
    assert found.view_inliers[~wrong].mean() > 0.95 and found.reprojection_rms_px < 2


@pytest.mark.parametrize(
    ("seed", "turn_rad", "size_mm"), [(5, 0.4, 0.2), (1, 0.2, 0.2), (2, 0.2, 0.5), (5, 0.05, 0.5)],
    ids=["a landmark left out", "cameras that compete", "far off: loose", "far off: cameras that compete"],
)  # fmt: skip
def test_a_landmark_far_from_its_report_is_no_outlier(seed, turn_rad, size_mm):
    """Offsets of 0.2 mm, as large as a robot's may be, or larger ones: no landmark is left out, and no recording refused."""
    rng = np.random.default_rng(seed)
    offset = rng.normal(size=(3, 3))
    offset *= size_mm / np.linalg.norm(offset, axis=1, keepdims=True)
    found = calibrate(tool_sweep(seed, turn_rad=turn_rad, offset_mm=offset, sigma_px=0.5)[0])
    assert found.view_inliers.all() and found.reprojection_rms_px < 2


@pytest.mark.parametrize("seed", [2, 4, 5])
def test_offsets_are_found_beside_frames_that_show_another_tool(seed):
    """Offsets of 0.2 mm spread the right detections, so that the wrong ones, in a fifth of the frames, do not stand apart."""
    rng, n = np.random.default_rng(seed), 40
    made = tool_frames(n, rng=rng, half_size_mm=(2.5, 1.5, 0.8), jaw_mm=(1.8, 2.6), opening_rad=(0.15, 0.5))
    offset = rng.normal(size=(3, 3))
    offset *= 0.2 / np.linalg.norm(offset, axis=1, keepdims=True)
    x_mm = made.x_mm - np.einsum("nij,kj->nki", tool_axes(made.x_mm.reshape(n, 3, 3)), offset).reshape(-1, 3)
    wrong = np.repeat(np.arange(n) % 5 == 2, 3)
    shift = np.repeat(rng.normal(size=(n, 2)), 3, axis=0)
    shift *= 150 * wrong[:, None] / np.linalg.norm(shift, axis=1, keepdims=True)
    data = replace(made, x_mm=x_mm, u_left=made.u_left + shift, u_right=made.u_right + shift)
    found = calibrate(data, image_size_px=IMAGE_SIZE_PX)
    assert found.inliers[~wrong].mean() > 0.9 and not found.inliers[wrong].any()
    relative = found.offsets.offset - found.offsets.offset.mean(axis=0) - (offset - offset.mean(axis=0))
    assert np.abs(relative[:, 0]).max() < 0.05  # along the tool; the others may turn its axes


@pytest.mark.parametrize("beside_mm", [0.35, 0.8])
def test_a_landmark_that_is_another_point_of_the_tool_stays_left_out(beside_mm):
    data, rig, _ = tool_sweep(0, turn_rad=0.4)
    tip = data.landmark == 1
    beside = beside_mm * tool_axes(data.grid("x_mm"))[:, :, 0] @ rig.linear.T  # along the tool
    u = data.stacked_px + np.where(tip[:, None], np.repeat(beside, 3, axis=0), 0.0)
    found = calibrate(replace(data, u_left=u[:, :2], u_right=u[:, 2:]))
    assert not found.inliers[tip].any() and found.inliers[~tip].all()


@pytest.mark.parametrize("fault", ["moved", "tips", "place"])
def test_cameras_that_compete_are_not_explained_away_by_offsets(fault):
    """The cameras moved by 30 px, all tips are exchanged, or a second tool is seen at times, of a tool that hardly turns."""
    data, rig, _ = tool_sweep(0, turn_rad=0.05)
    late, two = data.frame >= 38, np.repeat(np.random.default_rng(0).random(75) < 0.45, 3)
    u = {"moved": np.where(late[:, None], data.stacked_px + [30, 9, 30, 6], data.stacked_px)}
    u["tips"] = data.stacked_px.reshape(-1, 3, 4)[:, [0, 2, 1]].reshape(-1, 4)
    u["place"] = data.stacked_px + np.where(two[:, None], rig.linear @ [3.0, 1.0, 0.3], 0.0)
    with pytest.raises(CompetingCamerasError):
        calibrate(replace(data, u_left=u[fault][:, :2], u_right=u[fault][:, 2:]))


def test_shut_jaws_carry_the_axes_of_open_ones_along_the_shaft():
    turns = Rotation.from_rotvec(np.outer(np.arange(6), [0.0, 0.1, 0.2])).as_matrix()  # without a roll
    width_mm = np.array([0.01, 0.9, 0.02, 0.01, 0.0, 0.8])
    tool = np.zeros((6, 3, 3))
    tool[:, 1:, 0], tool[:, 1, 1], tool[:, 2, 1] = 3.0, -width_mm / 2, width_mm / 2
    x = tool @ turns.mT + [4.0, -2.0, 7.0]
    axes = tool_axes(x)
    assert np.isnan(axes).all(axis=(1, 2)).tolist() == [True, False, True, True, True, False]
    np.testing.assert_allclose(carried(axes, x), turns, atol=1e-9)
    rolled = np.where(np.arange(6)[:, None, None] < 5, axes, axes @ np.diag([1.0, -1.0, -1.0]))  # half a turn
    near = carried(rolled, x, np.array([0.0, 1.0, 9.0, 9.1, 9.2, 9.3]))
    assert (near[:, :, 1] * turns[:, :, 1]).sum(axis=1).round(6).tolist() == [1, 1, -1, -1, -1, -1]
    silent = np.full_like(x, np.nan)
    assert np.isnan(carried(tool_axes(silent), silent)).all()


@pytest.mark.parametrize(
    ("model", "distance_mm", "runs"), [("zero_skew", np.inf, 5), ("affine", np.inf, 3), ("near_affine", 200.0, 2)]
)
def test_offsets_are_found_with_honest_deviations_and_the_cameras_lose_their_bias(model, distance_mm, runs):
    normalised, offset_errors, without, claims = [], [], [], []
    for seed in range(runs):
        data, rig, true = tool_sweep(seed, distance_mm=distance_mm)
        options = {"model": model, "image_size_px": IMAGE_SIZE_PX}
        found = calibrate(data, **options)
        assert found.offsets.p_value < 1e-6 and 0.008 < found.offsets.prior_sd < 0.04
        normalised.append((found.offsets.offset - OFFSETS_MM) / found.offsets.standard_deviation)
        exact = np.hstack(rig.project(true))
        for fit, errors in ((found, offset_errors), (calibrate(data, offsets=False, **options), without)):
            errors.append(np.hstack(fit.rig.project(true)) - exact)
        # The cameras' claimed covariance has the offsets' uncertainty in it.
        claims.append(np.trace(found.projection_covariance(true), axis1=1, axis2=2).mean() / 4)
    assert np.sqrt(np.mean(np.square(normalised))) == pytest.approx(1, abs=0.3)
    assert np.mean(np.square(offset_errors)) < 0.6 * np.mean(np.square(without))
    assert np.mean(np.square(offset_errors)) / np.mean(claims) == pytest.approx(1, abs=0.6)


@pytest.mark.parametrize(("of_the_true_tool", "side"), [(True, 1), (True, -1), (False, 1)])
def test_large_offsets_turn_the_axes_of_nearly_shut_jaws(of_the_true_tool, side):
    """A robot with a wrong tool is off in the axes of the true tool; a detector that errs is in those that are reported."""
    rng, offset = np.random.default_rng(4), np.array([[0.02, 0.15, 0.13], [-0.09, -0.05, 0.17], [0.03, 0.0, -0.2]])
    offset[:, 1] *= side
    data, rig, _ = tool_sweep(4)
    x = data.grid("x_mm")
    x[:, 1:] += (x[:, 1:].mean(axis=1, keepdims=True) - x[:, 1:]) * rng.uniform(0, 0.7, (len(x), 1, 1))
    moved = x + np.einsum("nij,kj->nki", tool_axes(x), offset)
    seen, reported = (x, moved) if of_the_true_tool else (moved, x)
    u = [p + rng.normal(0, 0.8, p.shape) for p in rig.project(seen.reshape(-1, 3))]
    for part in u:  # landmarks that neither image shows
        part[rng.permutation(len(x) * 3)[: len(x) // 3]] = np.nan
        part[::5] = np.nan
    rows = Correspondences.of_points(reported.reshape(-1, 3), *u, frame=data.frame, landmark=data.landmark)
    found = calibrate(rows)
    assert found.offsets.turns == of_the_true_tool and found.reprojection_rms_px < 1.6
    where = with_offsets(rows, found.offsets).x_mm
    error = np.hstack(found.rig.project(where)) - np.hstack(rig.project(seen.reshape(-1, 3)))
    assert np.quantile(np.abs(error), 0.95) < 1.2


def test_a_tip_that_is_never_seen_does_not_hide_the_axes():
    data, _, _ = tool_sweep(0)
    seen = replace(data, confidence=np.where((data.landmark == 2)[:, None], 0.0, data.confidence))
    found = calibrate(seen)
    assert found.offsets.offset.shape == (2, 3) and found.offsets.p_value < 1e-3
    assert np.isfinite(with_offsets(seen, found.offsets).x_mm).all()


def test_without_offsets_none_are_claimed():
    p_values, priors = [], []
    for seed in range(6):
        found = calibrate(tool_sweep(seed, offset_mm=np.zeros((3, 3)))[0]).offsets
        p_values.append(found.p_value)
        priors.append(found.prior_sd)
        assert (np.abs(found.offset) < 4.5 * found.standard_deviation).all()
    assert min(p_values) > 1e-3 and 0.2 < np.mean(p_values) < 0.8
    assert np.median(priors) < 0.004


def test_errors_that_last_on_a_slow_path_are_not_taken_for_offsets():
    n, p_values = 60, []
    time = np.arange(n)[:, None] / n
    turn, base = 0.3 * np.sin(time * [9, 14, 11] + [0, 1, 2]), [3, 2, 1.5] * np.sin(time * [12, 8, 10] + [2, 0, 1])
    x = np.concatenate([ROBOT_FROM_MICROSCOPE.apply(LANDMARKS_MM @ R.T + b) for R, b in zip(
        Rotation.from_rotvec(turn).as_matrix(), base, strict=True)])  # fmt: skip
    for seed in range(5):
        noise = np.random.default_rng(seed).normal(size=(n, 3, 4))
        noise[1:] *= 0.6
        noise = lfilter([1.0], [1.0, -0.8], noise, axis=0).reshape(-1, 4)  # 0.8 from frame to frame
        u = np.hstack(reference_rig().project(x)) + noise
        of_rows = {"frame": np.repeat(np.arange(n), 3), "landmark": np.tile(np.arange(3), n)}
        p_values.append(calibrate(Correspondences.of_points(x, u[:, :2], u[:, 2:], **of_rows)).offsets.p_value)
    assert min(p_values) > 1e-3


def test_a_tool_that_never_turns_tells_only_the_difference_between_landmarks():
    data, _, true = tool_sweep(0, turn_rad=0.0)
    found = calibrate(data, offset_prior_sd=0.05)
    # What all landmarks have in common is a shift of the cameras: only the prior speaks, and the cameras say so.
    offset = found.offsets.offset
    assert (found.offsets.standard_deviation > 0.9 * 0.05 / np.sqrt(3)).all()
    difference = (offset - offset.mean(axis=0)) - (OFFSETS_MM - OFFSETS_MM.mean(axis=0))
    assert np.abs(difference).max() < 0.012
    turned = calibrate(tool_sweep(0)[0], offset_prior_sd=0.05)
    assert (turned.offsets.standard_deviation < 0.3 * 0.05).all()
    alone, both = (np.trace(f.projection_covariance(true[:1])[0]) for f in (turned, found))
    assert both > 20 * alone


def test_offsets_in_the_images_leave_their_mean_to_the_cameras():
    data, rig, true = tool_sweep(1, offset_mm=np.zeros((3, 3)))
    bias = np.array([[1.7, -0.3, 1.4, 0.2], [-1.3, 0.1, -1.2, 0.0], [0.2, 0.5, 0.1, 0.4]])
    shift = bias[data.landmark]
    data = replace(data, u_left=data.u_left + shift[:, :2], u_right=data.u_right + shift[:, 2:])
    found = calibrate(data, offsets="image", offset_prior_sd=5.0)
    offset = found.offsets.offset
    assert offset.shape == (3, 4) and found.offsets.p_value < 1e-6
    np.testing.assert_allclose(offset - offset.mean(axis=0), bias - bias.mean(axis=0), atol=0.35)
    assert (found.offsets.standard_deviation > 2.5).all()
    with_mean = np.hstack(found.rig.project(true)) - np.hstack(rig.project(true))
    np.testing.assert_allclose(with_mean.mean(axis=0), bias.mean(axis=0), atol=0.5)


def test_frames_without_axes_are_left_out_and_every_row_is_answered():
    data, _, _ = tool_sweep(3)
    x, u_right = data.x_mm.copy(), data.u_right.copy()
    x[4] = np.nan  # the robot is silent about one tip: its frame has no axes
    u_right[60] = np.nan  # one image does not show one landmark
    u_right[100] += 200
    found = calibrate(replace(data, x_mm=x, u_right=u_right))
    assert len(found.inliers) == len(data) == len(found.usable)
    np.testing.assert_array_equal(np.flatnonzero(~found.usable), [3, 4, 5])
    np.testing.assert_array_equal(np.argwhere(found.usable[:, None] & ~found.view_inliers), [[60, 1], [100, 1]])
    plain = calibrate(replace(data, x_mm=x, u_right=u_right), offsets=False)
    assert plain.offsets is None and plain.usable.sum() == len(data) - 1
    # Mostly shut jaws: no offsets unasked, and all rows count.
    shut = x.reshape(-1, 3, 3).copy()
    shut[:45, 1:] = shut[:45, 1:].mean(axis=1, keepdims=True)
    assert calibrate(replace(data, x_mm=shut.reshape(-1, 3)), checks=False, ransac_px=np.inf).offsets is None


@pytest.mark.parametrize(("kind", "told"), [(RuntimeWarning, True), (Unsettled, False)])
def test_turned_axes_hide_no_other_warning(monkeypatch, kind, told):
    def late(*arguments, start=None, **options):
        if start is not None:  # of the turned axes
            warnings.warn("numbers", kind, stacklevel=2)
        return estimate_offsets(*arguments, start=start, **options)

    monkeypatch.setattr(estimate, "estimate_offsets", late)
    rows = tool_sweep(0, offset_mm=10 * OFFSETS_MM)[0]
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        assert calibrate(rows).offsets.turns
    assert [str(w.message) for w in given] == ["numbers"] * told


def test_too_few_steps_are_told():
    data, _, _ = tool_sweep(0)
    y = np.hstack([data.u_left, data.u_right])
    axes = np.repeat(tool_axes(data.grid("x_mm")), 3, axis=0)
    with pytest.warns(Unsettled, match=r"offsets: they still move by up to .* mm after 1 steps"):
        estimate_offsets(
            lambda x, y, views: calibrate(x, [y[:, :2], y[:, 2:]]),
            data.x_mm, y, data.landmark, data.frame, axes, iterations=1,
        )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"offsets": "tools"}, "offsets: expected"),
        ({"offsets": True, "weighting": "paper"}, "weighting"),
        ({"offset_prior_sd": 0.0}, "offset_prior_sd"),
        ({"u": [np.zeros((24, 2))] * 2}, "leave u out"),
    ],
)
def test_bad_arguments_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        calibrate(tool_sweep(0, frames=8)[0], **options)


def test_offsets_that_the_data_cannot_tell_are_refused():
    data, _, _ = tool_sweep(0, frames=20)
    with pytest.raises(ValueError, match="open jaws"):
        calibrate(data.subset(data.landmark < 2), offsets="tool")
    twice = Correspondences.join([data, tool_sweep(1, frames=20)[0]])  # the same frame numbers: whose axes are they?
    with pytest.raises(ValueError, match="0 rows have the tool's axes"):
        calibrate(twice, offsets="tool")
    assert calibrate(twice).offsets is None
    with pytest.raises(ValueError, match="which landmark"):
        calibrate(data.x_mm, [data.u_left, data.u_right], offsets=True)
    with pytest.raises(ValueError, match="u: give"):
        calibrate(data.x_mm)
