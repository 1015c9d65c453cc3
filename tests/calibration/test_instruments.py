"""Clocks, online calibration, tool offsets, exports."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lib.calibration import (
    OnlineCalibration,
    Tool,
    calibrate,
    estimate_time_offset,
    pivot_calibration,
    tool_offsets,
    write_opencv,
    write_ros,
)
from lib.calibration.timing import clock_error
from lib.cameras import AffineCamera, StereoRig
from lib.correspondences import Correspondences, pair_with_robot
from lib.geometry import RigidTransform
from lib.recordings import Kinematics
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig
from lib.trust import report
from notebooks.studies.camera_models import compare_models
from notebooks.studies.simulated_rows import simulate_correspondences
from tests.calibration.rigs import LANDMARKS_MM, data, tool_sweep


def sweep(time_s, speed_mm_s=2.0):
    """Positions (n, 3) of a wandering tool of about the given speed."""
    w = speed_mm_s / np.array([3.0, 2.0, 1.0])
    phase = time_s[:, None] * w + [0.0, 0.7, 1.9]
    return ROBOT_FROM_MICROSCOPE.apply(np.sin(phase) * [3.0, 2.0, 1.0])


def video(offset_s, seed, frames=300, readout_s=0.0):
    """(times, pixels) of the frames and (times, positions) of the robot."""
    rng = np.random.default_rng(seed)
    robot_time = np.arange(-1, 14, 0.01)
    robot_x = sweep(robot_time) + rng.normal(0, 0.01, (len(robot_time), 3))
    time = np.arange(frames) / 25
    u = []
    for camera in (reference_rig().left, reference_rig().right):
        pixels = camera.project(sweep(time + offset_s))
        for _ in range(4):  # the row decides the time, the time the row
            rows = readout_s * (pixels[:, 1] / 1079 - 0.5)
            pixels = camera.project(sweep(time + offset_s + rows))
        u.append(pixels + rng.normal(0, 1.5, pixels.shape))
    return (time, u), (robot_time, robot_x)


def test_time_offset_is_found_within_its_deviation():
    errors, deviations = [], []
    for seed in range(12):
        found = estimate_time_offset(*video(0.030, seed))
        errors.append(found.offset_s - 0.030)
        deviations.append(found.sd_s)
        assert found.offset_s > 3 * found.sd_s
    assert np.sqrt(np.mean(np.square(errors))) < 0.5e-3
    assert 0.5 < np.std(errors) / np.mean(deviations) < 1.6
    assert abs(found.trial_s[found.trial_rms_px.argmin()] - 0.030) <= 0.01
    none = estimate_time_offset(*video(0.0, 5))
    assert abs(none.offset_s) < 3 * none.sd_s


@pytest.mark.parametrize("motion", [0.0, 0.01, 0.1])
def test_time_offset_of_a_tool_that_hardly_moves_is_refused_or_vague(motion):
    """The noise of the log looks like a velocity, but it does not determine the offset."""
    distances, refused = [], 0
    for seed in range(8):
        rng, robot_time, time = np.random.default_rng(seed), np.arange(-1, 6, 0.01), np.arange(100) / 25

        def at(t):
            middle = sweep(np.zeros(1)) + motion * (sweep(t) - sweep(np.zeros(1)))
            return middle[:, None] + np.array([[0, 0, 0], [1.5, 0.4, 2], [1.5, -0.4, 2]])

        u = [rng.normal(p, 1.5).reshape(-1, 3, 2) for p in reference_rig().project(at(time + 0.03).reshape(-1, 3))]
        try:
            found = estimate_time_offset((time, u), (robot_time, rng.normal(at(robot_time), 0.01)))
            distances.append((found.offset_s - 0.03) / found.sd_s)
        except ValueError as error:
            refused += "hardly moves" in str(error) or "edge" in str(error)
    assert refused + len(distances) == 8 and (refused >= 7 if motion < 0.1 else refused == 0)
    if motion == 0.1:
        assert 0.4 < np.sqrt(np.mean(np.square(distances))) < 2.0


def test_time_offset_with_missing_detections_and_several_landmarks():
    (time, u), (robot_time, robot_x) = video(-0.02, 1)
    u = [np.stack([p, p], axis=1) for p in u]
    u[0][5:40, 1] = np.nan
    found = estimate_time_offset((time, u), (robot_time, np.stack([robot_x, robot_x], axis=1)))
    assert found.offset_s == pytest.approx(-0.02, abs=1e-3)


def test_time_offset_is_found_where_a_detector_sees_an_unknown_tool_elsewhere():
    """Landmarks are off by 20 px in the axes of a turning tool, and a fifth is anywhere: no two cameras leave 1 %."""
    (time, u), (robot_time, robot_x) = video(0.15, 4)
    rng, n = np.random.default_rng(4), len(time)
    turn = np.linspace(0, 9, n)[:, None, None] + np.array([0.0, 2.1, 4.2])[:, None]
    off = 20 * np.concatenate([np.cos(turn), np.sin(turn)], axis=2)
    u = [np.where(rng.random((n, 3, 1)) < 0.2, rng.uniform(0, 1000, (n, 3, 2)), p[:, None] + off) for p in u]
    found = estimate_time_offset((time, u), (robot_time, np.repeat(robot_x[:, None], 3, axis=1)))
    assert abs(found.offset_s - 0.15) < min(4 * found.sd_s, 0.01)
    with pytest.raises(ValueError, match="no consensus"):
        anywhere = [rng.uniform(0, 1000, p.shape) for p in u]
        estimate_time_offset((time, anywhere), (robot_time, np.repeat(robot_x[:, None], 3, axis=1)))


def test_the_clock_along_with_cameras_and_offsets():
    """A turning tool whose landmarks are 0.2 mm off: the offset of the clocks alone takes that for a part of the time."""
    alone, together = [], []
    for seed in range(8):
        rng, robot_time, time = np.random.default_rng(seed), np.arange(-1, 10, 0.01), np.arange(40) / 5
        offset = rng.normal(size=(3, 3))
        offset *= 0.2 / np.linalg.norm(offset, axis=1, keepdims=True)

        def seen(t, offset=offset):
            turn = Rotation.from_rotvec(np.sin(np.outer(t, [0.9, 1.3, 0.7])) * [0.4, 0.3, 0.5]).as_matrix()
            return (LANDMARKS_MM + offset) @ turn.mT + sweep(t, speed_mm_s=4.0)[:, None]

        reported = seen(robot_time, 0 * offset)
        kinematics = Kinematics(robot_time, reported + rng.normal(0, 0.01, reported.shape))
        u = reference_rig().project(seen(time + 0.03).reshape(-1, 3))
        u = [rng.normal(p, 1.0).reshape(-1, 3, 2) for p in u]
        first = estimate_time_offset(pair_with_robot(*u, position=kinematics.at, time_s=time, height_px=1080), kinematics)
        rows = pair_with_robot(*u, position=kinematics.at, time_s=time, height_px=1080, offset_s=first.offset_s)
        step_s, sd_s = clock_error(calibrate(rows), rows, kinematics, first.offset_s)
        alone.append(first.offset_s - 0.03)
        together.append([first.offset_s + step_s - 0.03, sd_s])
    bursts = np.repeat(time, 2) + np.tile([0.0, 0.02], len(time)) + 0.03  # too sparse for a velocity
    sparse = Kinematics(bursts, seen(bursts, 0 * offset))
    assert clock_error(calibrate(rows), rows, sparse, first.offset_s) == (0.0, np.inf)
    errors, deviations = np.transpose(together)
    assert np.sqrt(np.mean(errors**2)) < 0.5 * np.sqrt(np.mean(np.square(alone)))
    assert 0.5 < np.sqrt(np.mean((errors / deviations) ** 2)) < 1.6


def test_time_offset_of_correspondences_with_gaps_in_the_kinematics():
    """One blank row is bridged; rows that fall into a longer silence are left out; a shutter's rows have their own times."""
    (time, u), (robot_time, robot_x) = video(0.03, 2, readout_s=0.03)
    robot_x[200] = np.nan
    robot_x[700:760] = np.nan
    kinematics = Kinematics(robot_time, np.repeat(robot_x[:, None], 3, axis=1))
    u = [np.repeat(p[:, None], 3, axis=1) for p in u]
    rows = pair_with_robot(*u, position=kinematics.at, time_s=time, height_px=1080, readout_s=0.03, offset_s=0.03)
    assert not rows.is_complete.all()
    assert estimate_time_offset(rows, kinematics).offset_s == pytest.approx(0.03, abs=1e-3)
    robot_x[120:] = np.nan
    with pytest.raises(ValueError, match="away from gaps"):
        estimate_time_offset((time, [p[:, 0] for p in u]), (robot_time, robot_x))


def test_time_offset_at_the_edge_of_its_search_is_refused_with_the_cure():
    frames, robot = video(0.5, 0)
    for search_s in (-1, np.inf):
        with pytest.raises(ValueError, match="search_s: half the width of the search must be positive and finite"):
            estimate_time_offset(frames, robot, search_s=search_s)
    with pytest.raises(ValueError, match="^search_s: the search ends at its upper edge; widen search_s.$"):
        estimate_time_offset(frames, robot)
    assert estimate_time_offset(frames, robot, search_s=0.7).offset_s == pytest.approx(0.5, abs=1e-3)


def test_time_offset_refuses_the_best_of_a_search_that_does_not_fit():
    """A path that comes back to nearly where it was has minima at other offsets too."""

    def path(t):
        return np.stack([3 * np.sin(6 * t), 2 * np.cos(6 * t) + 3 * np.sin(1.9 * t), 2 * np.sin(9 * t)], axis=1)

    time, robot_time = np.arange(60) / 15, np.arange(-2, 7, 0.01)
    u = [np.random.default_rng(0).normal(pixels, 1.0) for pixels in reference_rig().project(path(time + 1.0))]
    with pytest.raises(ValueError, match=r"the best offset has an error of \d+ px RMS; widen search_s\.$"):
        estimate_time_offset((time, u), (robot_time, path(robot_time)), search_s=0.5)
    found = estimate_time_offset((time, u), (robot_time, path(robot_time)), search_s=1.5)
    assert found.offset_s == pytest.approx(1.0, abs=1e-3)


def test_time_offset_refuses_what_it_cannot_see():
    (time, u), (robot_time, robot_x) = video(0, 0)
    for late_s, search_s, x in ((100, 0.2, robot_x), (100, 5.0, robot_x), (0, 5.0, np.full_like(robot_x, np.nan))):
        with pytest.raises(ValueError, match="frames lie inside"):
            estimate_time_offset((time + late_s, u), (robot_time, x), search_s=search_s)
    far = estimate_time_offset((time + 100, u), (robot_time, robot_x), search_s=101)
    assert far.offset_s == pytest.approx(-100, abs=1e-3)
    with pytest.raises(ValueError, match="increase"):
        estimate_time_offset((time, u), (robot_time[::-1], robot_x))
    with pytest.raises(ValueError, match="frames lie inside"):
        estimate_time_offset((time, u), (robot_time, robot_x * np.nan))
    with pytest.raises(ValueError, match="pixels a camera"):
        estimate_time_offset((time, [p[:-1] for p in u]), (robot_time, robot_x))


def test_a_rolling_shutter_paired_row_by_row_calibrates_to_the_noise():
    (time, u), (robot_time, _) = video(0.01, 3, readout_s=0.03)
    kinematics = Kinematics(robot_time, np.repeat(sweep(robot_time)[:, None], 3, axis=1))
    pixels = [np.repeat(p[:, None], 3, axis=1) for p in u]
    rows = pair_with_robot(*pixels, position=kinematics.at, time_s=time, height_px=1080, readout_s=0.03, offset_s=0.01)
    rows = rows.subset(rows.landmark == 0)
    options = {"model": "affine", "ransac_px": np.inf}
    with_it = calibrate(rows, **options)
    without = calibrate(sweep(time + 0.01), u, **options)
    assert with_it.reprojection_rms_px == pytest.approx(1.5 * np.sqrt(2), rel=0.06)
    # The same detections: what is left over above the noise is the shutter (0.35 px RMS at this speed).
    assert without.reprojection_rms_px**2 - with_it.reprojection_rms_px**2 > 0.3**2


def started(c, rows, **options):
    """An online calibration of these rows of data without errors in the noise levels."""
    known = {"model": "affine", "sigma_u_px": 1.5, "sigma_x_mm": 0.01, "ransac_px": np.inf} | options
    return OnlineCalibration(calibrate(c.x_mm[rows], [c.u_left[rows], c.u_right[rows]], **known)), known


@pytest.mark.parametrize("model", ["affine", "zero_skew", "near_affine"])
def test_online_is_the_batch_minimum_within_a_small_part_of_its_doubt(model):
    c = simulate_correspondences(120, rng=np.random.default_rng(0))
    online, known = started(c, slice(0, 60), model=model)
    rows = Correspondences.of_points(c.x_mm, c.u_left, c.u_right, frame=np.arange(120) // 3)
    for frame in range(20, 40):
        assert online.add(rows.of_frames(frame)).all()
    batch = calibrate(c.x_mm, [c.u_left, c.u_right], **known)
    off = np.hstack(online.solve().project(c.x_mm)) - np.hstack(batch.rig.project(c.x_mm))
    sd = np.sqrt(np.einsum("nii->ni", batch.projection_covariance(c.x_mm)))
    assert np.abs(off / sd).max() < 0.1
    assert type(online.solve().left) is type(batch.rig.left)
    first = calibrate(c.x_mm[:60], [c.u_left[:60], c.u_right[:60]], **known)
    parts = (np.einsum("nii->n", k.projection_covariance(c.x_mm)) for k in (batch, first))
    np.testing.assert_allclose(online.remains(c.x_mm), np.divide(*parts), rtol=0.15)


def test_an_inaccurate_robot_in_a_shallow_volume_does_not_flatten_the_depth():
    c = data(1500, 5, sigma_x_mm=0.1, half_size_mm=(4, 3, 0.5))
    online, known = started(c, slice(0, 150), sigma_x_mm=0.1)
    for i in range(150, 1500, 3):
        rows = slice(i, i + 3)
        online.add(Correspondences.of_points(c.x_mm[rows], c.u_left[rows], c.u_right[rows]))
    batch = calibrate(c.x_mm, [c.u_left, c.u_right], **known)

    def disparity_px(rig):
        return np.diff([camera.project(c.true_x_mm)[:, 0] for camera in (rig.left, rig.right)], axis=0)[0]

    true = disparity_px(c.true_rig)
    slopes = [np.polyfit(true, disparity_px(rig), 1)[0] for rig in (online.solve(), batch.rig)]
    assert slopes[0] == pytest.approx(slopes[1], abs=0.003)


def test_online_starts_where_the_calibration_ended_and_weighs_rows_by_their_covariance():
    c = data(300, 3)
    rng, n = np.random.default_rng(4), len(c.x_mm)
    poor = rng.random(n) < 0.3  # a third of the rows is poor, and says so
    noise = np.where(poor, 12.0, 0.3)[:, None]
    u = [camera.project(c.true_x_mm) + noise * rng.normal(size=(n, 2)) for camera in (c.true_rig.left, c.true_rig.right)]
    covariance = np.broadcast_to((noise**2)[:, None, :, None] * np.eye(2), (n, 2, 2, 2))
    rows = Correspondences.of_points(c.x_mm, *u, covariance_px2=covariance, frame=np.arange(n) // 3)
    calibration = calibrate(rows.of_frames(range(50)), model="affine")
    online = OnlineCalibration(calibration)
    np.testing.assert_array_equal(online.solve().linear, calibration.rig.linear)

    def error(rig):
        return np.sqrt(np.mean((np.hstack(rig.project(c.true_x_mm)) - np.hstack(c.true_rig.project(c.true_x_mm))) ** 2))

    errors = [error(calibration.rig)]
    for frame in range(50, 100):
        online.add(rows.of_frames(frame))
        errors.append(error(online.solve()))
    assert max(errors) < 1.5 * errors[0]
    assert errors[-1] < 1.2 * error(calibrate(rows, model="affine").rig) + 0.01


def test_online_drops_gaps_and_gross_errors():
    c = data(300, 0)
    online, _ = started(c, slice(0, 30))
    for i in range(10, 100):
        rows = slice(3 * i, 3 * i + 3)
        u_left, u_right = c.u_left[rows].copy(), c.u_right[rows].copy()
        u_left[0] = np.nan
        u_right[1] += 300 * (i % 10 == 0)
        used = online.add(Correspondences.of_points(c.x_mm[rows], u_left, u_right))
        assert used.tolist() == [[False, True], [True, i % 10 > 0], [True, True]]
    assert online.add(c.subset(slice(0))).shape == (0, 2)
    assert np.abs(online.solve().left.project(c.true_x_mm) - c.true_rig.left.project(c.true_x_mm)).max() < 2.0


def poses(n, seed, angle_rad=0.5):
    rng = np.random.default_rng(seed)
    return [
        RigidTransform.from_rotation_vector(
            rng.uniform(-angle_rad, angle_rad, 3), ROBOT_FROM_MICROSCOPE.t + rng.uniform(-3, 3, 3)
        )
        for _ in range(n)
    ]


OFFSETS = np.array([[0.0, 0.0, 12.0], [0.6, 0.1, 15.0], [-0.6, 0.1, 15.0]])


def test_tool_offsets_from_poses_and_images():
    rig, errors = reference_rig(), []
    for seed in range(4):
        tool = poses(300, seed)
        rng = np.random.default_rng(seed)
        x = np.stack([p.apply(OFFSETS) for p in tool])
        u = [np.stack([c.project(row) for row in x]) + rng.normal(0, 1.5, (300, 3, 2)) for c in (rig.left, rig.right)]
        u[0][4, 1] = np.nan
        found = tool_offsets(tool, u)
        error = found.offset_mm - OFFSETS
        errors.append(error)
        mahalanobis = np.einsum("ki,kij,kj->k", error, np.linalg.inv(found.covariance_mm2), error)
        assert mahalanobis.mean() < 10
        assert found.rms_px == pytest.approx(1.5 * np.sqrt(2), rel=0.1)
        assert found.positions_mm(tool).shape == (300, 3, 3)
    assert np.sqrt(np.mean(np.square(errors))) < 0.005


def test_the_covariance_of_tool_offsets_holds_the_noise_of_the_poses():
    distances = []
    for seed in range(12):
        tool, rng = poses(40, seed), np.random.default_rng(seed)
        cameras = reference_rig().left, reference_rig().right
        u = [rng.normal([camera.project(p.apply(OFFSETS)) for p in tool], 1.5) for camera in cameras]
        reported = [RigidTransform(p.R, p.t + rng.normal(0, 0.03, 3)) for p in tool]
        found = tool_offsets(reported, u)
        error = found.offset_mm - OFFSETS
        distances.append(np.einsum("ki,kij,kj->k", error, np.linalg.inv(found.covariance_mm2), error).mean() / 3)
    assert 0.6 < np.mean(distances) < 1.6  # 6 if the errors of the poses are taken for independent errors of pixels


def test_tool_offsets_of_a_hinged_tool_and_a_robot_that_errs_by_100_um():
    """The first step overshoots: without damping the search ended where the offsets seem undetermined."""
    rng = np.random.default_rng(9)
    hinge = Tool.hinged(np.tile([0.0, 0, 12], (3, 1)), [0, 1, -1], [0, 0, 12], [1, 0, 0], [0, 0, 3])
    tool, opening = poses(30, 9, 0.4), rng.uniform(0.2, 0.8, 30)
    x = hinge.positions_mm(tool, opening)
    u = [rng.normal([c.project(row) for row in x], 1.0) for c in (reference_rig().left, reference_rig().right)]
    reported = [RigidTransform(p.R, p.t + rng.normal(0, 0.1, 3)) for p in tool]
    found = tool_offsets(reported, u, opening_rad=opening)
    assert np.abs(found.positions_mm(tool, opening) - x).max() < 0.3


def test_tool_offsets_name_what_is_wrong():
    tool = poses(30, 0)
    u = [np.stack([c.project(p.apply(OFFSETS)) for p in tool]) for c in (reference_rig().left, reference_rig().right)]
    with pytest.raises(ValueError, match=r"opening_rad: expected \(30,\) angles"):
        tool_offsets(tool, u, opening_rad=np.full(20, 0.3))
    with pytest.raises(ValueError, match="in radians"):
        tool_offsets(tool, u, opening_rad=np.linspace(5, 35, 30))
    with pytest.raises(ValueError, match=r"turning: expected \(3,\)"):
        tool_offsets(tool, u, turning=[0, 1])
    with pytest.raises(ValueError, match="landmark 1 is in no frame"):
        tool_offsets(tool, [np.where(np.arange(3)[:, None] == 1, np.nan, p) for p in u])
    with pytest.raises(ValueError, match="turns about one point .* move it through the volume as well"):
        tool_offsets([RigidTransform(p.R, np.zeros(3)) for p in tool], u)


def test_pivot_calibration():
    rng = np.random.default_rng(0)
    tip, rest = np.array([1.0, -2.0, 14.0]), np.array([20.0, 5.0, 3.0])
    tool = []
    for _ in range(300):
        R = RigidTransform.from_rotation_vector(rng.uniform(-0.5, 0.5, 3)).R
        tool.append(RigidTransform(R, rest - R @ tip + rng.normal(0, 0.01, 3)))
    found = pivot_calibration(tool)
    np.testing.assert_allclose(found.offset_mm, tip, atol=0.01)
    np.testing.assert_allclose(found.point_mm, rest, atol=0.01)
    assert found.rms_mm == pytest.approx(0.01 * np.sqrt(3), rel=0.1)
    error = np.concatenate([found.offset_mm - tip, found.point_mm - rest])
    assert error @ np.linalg.solve(found.covariance_mm2, error) < 22


def test_tool_offsets_need_rotation():
    for bad in (poses(50, 0, 0.0), poses(2, 0)):
        with pytest.raises(ValueError, match="robot_from_tool"):
            pivot_calibration(bad)
    one_axis = [RigidTransform.from_rotation_vector((0, 0, a)) for a in np.linspace(-1, 1, 20)]
    with pytest.raises(ValueError, match="one axis"):
        tool_offsets(one_axis, [np.zeros((20, 1, 2))])
    with pytest.raises(ValueError, match="pixels a camera"):
        tool_offsets(poses(10, 0), [np.zeros((9, 1, 2))])


def test_motion_that_determines_nothing_is_refused():
    with pytest.raises(ValueError, match="did not rest"):
        pivot_calibration(poses(50, 0))
    with pytest.raises(ValueError, match="hardly turns"):
        pivot_calibration(poses(50, 0, 0.002))
    noise = np.random.default_rng(0).uniform(0, 1000, (5, 3, 2))
    with pytest.raises(ValueError, match="does not determine the offsets|too few"):
        tool_offsets(poses(5, 0), [noise, noise[::-1]])


@pytest.mark.parametrize("model", ["zero_skew", "near_affine", "zero_skew+distances+radial"])
def test_exports_hold_the_cameras(model, tmp_path):
    c = simulate_correspondences(60, rng=np.random.default_rng(0))
    found = calibrate(c.x_mm, [c.u_left, c.u_right], model=model, image_size_px=(1920, 1080))
    yaml = pytest.importorskip("yaml")
    for camera in found.cameras:
        write_opencv(camera, tmp_path / "camera.yml", (1920, 1080))
        storage = cv2.FileStorage(str(tmp_path / "camera.yml"), cv2.FILE_STORAGE_READ)
        P = storage.getNode("projection_matrix").mat()
        assert storage.getNode("image_width").real() == 1920 and storage.getNode("unit_of_points").string() == "mm"
        np.testing.assert_array_equal(P, camera.projection_matrix)
        if isinstance(camera, AffineCamera):
            np.testing.assert_array_equal(P[2], [0, 0, 0, 1])
        if getattr(camera, "radial_per_px2", 0):
            assert storage.getNode("radial_per_px2").real() == camera.radial_per_px2
            np.testing.assert_array_equal(storage.getNode("distortion_centre").mat().ravel(), camera.centre_px)
            with pytest.raises(ValueError, match="radial"):
                write_ros(camera, tmp_path / "info.yaml", (1920, 1080))
            continue
        write_ros(camera, tmp_path / "info.yaml", (1920, 1080), "left")
        content = yaml.safe_load((tmp_path / "info.yaml").read_text())
        assert content["camera_name"] == "left" and content["image_height"] == 1080
        for key in ("camera_matrix", "distortion_coefficients", "rectification_matrix", "projection_matrix"):
            assert len(content[key]["data"]) == content[key]["rows"] * content[key]["cols"]
        np.testing.assert_array_equal(np.reshape(content["projection_matrix"]["data"], (3, 4)), camera.projection_matrix)
    found.rig.save(tmp_path / "rig.json")
    for a, b in zip(StereoRig.load(tmp_path / "rig.json").project(c.x_mm), found.rig.project(c.x_mm), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_full_disk_leaves_the_cameras_of_before(tmp_path):
    resource = pytest.importorskip("resource")
    write_opencv(reference_rig().left, tmp_path / "camera.yml", (1920, 1080))
    before, limit = (tmp_path / "camera.yml").read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limit[1]))
    try:
        with pytest.raises(OSError):
            write_opencv(reference_rig().right, tmp_path / "camera.yml", (1920, 1080))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert (tmp_path / "camera.yml").read_bytes() == before


def test_exports_refuse_names_that_are_yaml_and_unknown_formats(tmp_path):
    camera = reference_rig().left
    for name in ("left\nprojection_matrix: 1", "a: b", "", "{}"):
        with pytest.raises(ValueError, match="name"):
            write_ros(camera, tmp_path / "info.yaml", (1920, 1080), name)
    with pytest.raises(ValueError, match="OpenCV writes"):
        write_opencv(camera, tmp_path / "camera.txt", (1920, 1080))
    assert not list(tmp_path.iterdir())


def test_report_and_ladder_take_correspondences_with_offsets():
    rows, _, _ = tool_sweep(0)
    text = report(calibrate(rows), robot_accuracy_mm=0.010)
    assert "offsets" in text and "tip_2" in text 
    best = compare_models(rows, models=("square", "affine", "square+distance")).best
    assert best.model == "square" or best.p_value > 0.001
