"""Clocks, rolling shutter, online calibration, tool offsets, exports."""

import cv2
import numpy as np
import pytest

from lib.calibration import (
    OnlineCalibration,
    calibrate,
    estimate_time_offset,
    pivot_calibration,
    read_json,
    read_opencv,
    read_ros,
    rolling_shutter,
    tool_offsets,
    write_json,
    write_opencv,
    write_ros,
)
from lib.cameras import AffineCamera, StereoRig
from lib.geometry import RigidTransform
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig, simulate_correspondences


def sweep(time_s, speed_mm_s=2.0):
    """Positions (n, 3) of a wandering tool of about the given speed."""
    w = speed_mm_s / np.array([3.0, 2.0, 1.0])
    phase = time_s[:, None] * w + [0.0, 0.7, 1.9]
    return ROBOT_FROM_MICROSCOPE.apply(np.sin(phase) * [3.0, 2.0, 1.0])


def video(offset_s, seed, frames=300, readout_s=0.0):
    rng = np.random.default_rng(seed)
    robot_time = np.arange(-1, 14, 0.01)
    robot_x = sweep(robot_time) + rng.normal(0, 0.01, (len(robot_time), 3))
    time = np.arange(frames) / 25
    rig = reference_rig()
    u = []
    for camera in (rig.left, rig.right):
        pixels = camera.project(sweep(time + offset_s))
        for _ in range(4):  # the row decides the time, the time the row
            rows = readout_s * (pixels[:, 1] / 1079 - 0.5)
            pixels = camera.project(sweep(time + offset_s + rows))
        u.append(pixels + rng.normal(0, 1.5, pixels.shape))
    return time, u, robot_time, robot_x


def test_time_offset_is_found_within_its_deviation():
    errors, deviations = [], []
    for seed in range(12):
        found = estimate_time_offset(*video(0.030, seed))
        errors.append(found.offset_s - 0.030)
        deviations.append(found.sd_s)
        assert found.significant
    assert np.sqrt(np.mean(np.square(errors))) < 0.5e-3
    assert 0.5 < np.std(errors) / np.mean(deviations) < 1.6
    assert not estimate_time_offset(*video(0.0, 5)).significant


def test_time_offset_with_missing_detections_and_several_landmarks():
    time, u, robot_time, robot_x = video(-0.02, 1)
    u = [np.stack([p, p], axis=1) for p in u]
    u[0][5:40, 1] = np.nan
    found = estimate_time_offset(time, u, robot_time, np.stack([robot_x, robot_x], axis=1))
    assert found.offset_s == pytest.approx(-0.02, abs=1e-3)


def test_time_offset_refuses_what_it_cannot_see():
    time, u, robot_time, robot_x = video(0, 0)
    with pytest.raises(ValueError, match="frames lie inside"):
        estimate_time_offset(time + 100, u, robot_time, robot_x)
    with pytest.raises(ValueError, match="increase"):
        estimate_time_offset(time, u, robot_time[::-1], robot_x)
    with pytest.raises(ValueError, match="finite"):
        estimate_time_offset(time, u, robot_time, robot_x * np.nan)
    with pytest.raises(ValueError, match="pixels a camera"):
        estimate_time_offset(time, [p[:-1] for p in u], robot_time, robot_x)


def test_rolling_shutter_is_undone():
    time, u, robot_time, _ = video(0.01, 3, readout_s=0.03)
    clean = sweep(robot_time)
    exact = [c.project(sweep(time)) for c in (reference_rig().left, reference_rig().right)]
    x, corrected = rolling_shutter(time, u, robot_time, clean, readout_s=0.03, height_px=1080, offset_s=0.01)
    options = {"model": "affine", "ransac_px": np.inf}
    with_it = calibrate(x, corrected, **options)
    without = calibrate(sweep(time + 0.01), u, **options)
    assert with_it.reprojection_rms_px == pytest.approx(1.5 * np.sqrt(2), rel=0.06)
    # The same detections: what is left over above the noise is the shutter (0.35 px RMS at this speed).
    excess = without.reprojection_rms_px**2 - with_it.reprojection_rms_px**2
    assert excess > 0.3**2
    error = [np.abs(a - b).max() for a, b in zip(with_it.rig.project(sweep(time)), exact, strict=True)]
    assert max(error) < 1.0


def test_global_shutter_and_landmark_axis_pass_through():
    time, u, robot_time, robot_x = video(0.0, 3)
    x, same = rolling_shutter(time, u, robot_time, robot_x, readout_s=0, height_px=1080)
    np.testing.assert_allclose(same[0], u[0])
    assert x.shape == (300, 3)
    two = [np.stack([p, p], axis=1) for p in u]
    x, same = rolling_shutter(time, two, robot_time, np.stack([robot_x] * 2, 1), readout_s=0.01, height_px=1080)
    assert x.shape == (300, 2, 3) and same[1].shape == (300, 2, 2)
    with pytest.raises(ValueError, match="readout_s"):
        rolling_shutter(time, u, robot_time, robot_x, readout_s=-1, height_px=1080)


def test_online_is_the_batch_minimum():
    c = simulate_correspondences(90, rng=np.random.default_rng(0))
    online = OnlineCalibration(sigma_u_px=1.5, sigma_x_mm=0.01)
    with pytest.raises(ValueError, match="volume"):
        online.solve()
    for rows in np.arange(90).reshape(30, 3):
        assert online.add(c.x_mm[rows], c.u_left[rows], c.u_right[rows]).all()
    batch = calibrate(c.x_mm, [c.u_left, c.u_right], model="affine", sigma_u_px=1.5, sigma_x_mm=0.01, ransac_px=np.inf)
    np.testing.assert_allclose(online.solve().linear, batch.rig.linear, rtol=1e-8, atol=1e-6)
    np.testing.assert_allclose(np.diag(online.covariance), np.diag(batch.covariance), rtol=0.02)


def test_online_drops_gaps_and_gross_errors_and_forgets():
    c = simulate_correspondences(300, rng=np.random.default_rng(0))
    online = OnlineCalibration(sigma_u_px=1.5, sigma_x_mm=0.01, forgetting=0.9)
    moved = reference_rig(image_rotation_rad=(0.04, -0.015))
    for i, rows in enumerate(np.arange(300).reshape(100, 3)):
        u_left, u_right = c.u_left[rows].copy(), c.u_right[rows].copy()
        u_left[0] = np.nan
        if i == 50:
            u_right[1] += 300
        used = online.add(c.x_mm[rows], u_left, u_right)
        assert not used[0] and used[1] == (i != 50)
    for rows in np.arange(300).reshape(100, 3)[:60]:  # a shift of a few pixels: within the gate, and followed
        online.add(c.x_mm[rows], c.u_left[rows] + 3, c.u_right[rows])
    assert np.abs(online.solve().left.project(c.x_mm) - c.true_rig.left.project(c.x_mm) - 3).mean() < 1.2
    assert moved is not None
    with pytest.raises(ValueError, match="forgetting"):
        OnlineCalibration(forgetting=0)
    with pytest.raises(ValueError, match="rows"):
        online.add(np.zeros((2, 3)), np.zeros((1, 2)), np.zeros((1, 2)))


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


@pytest.mark.parametrize("model", ["zero_skew", "near_affine", "zero_skew+distances+radial"])
def test_every_export_reads_back_to_the_same_projections(model, tmp_path):
    c = simulate_correspondences(60, rng=np.random.default_rng(0))
    found = calibrate(c.x_mm, [c.u_left, c.u_right], model=model, image_size_px=(1920, 1080))
    expected = found.rig.project(c.true_x_mm)
    write_json(found, tmp_path / "calibration.json")
    for a, b in zip(read_json(tmp_path / "calibration.json").project(c.true_x_mm), expected, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)
    for camera, u in zip(found.cameras, expected, strict=True):
        write_opencv(camera, tmp_path / "camera.yml", (1920, 1080))
        np.testing.assert_allclose(read_opencv(tmp_path / "camera.yml").project(c.true_x_mm), u, atol=1e-9)
        storage = cv2.FileStorage(str(tmp_path / "camera.yml"), cv2.FILE_STORAGE_READ)
        P = storage.getNode("projection_matrix").mat()
        assert storage.getNode("image_width").real() == 1920
        np.testing.assert_array_equal(P, camera.projection_matrix)
        if isinstance(camera, AffineCamera):
            np.testing.assert_array_equal(P[2], [0, 0, 0, 1])
        if getattr(camera, "radial_per_px2", 0):
            with pytest.raises(ValueError, match="radial"):
                write_ros(camera, tmp_path / "info.yaml", (1920, 1080))
        else:
            write_ros(camera, tmp_path / "info.yaml", (1920, 1080), "left")
            np.testing.assert_allclose(read_ros(tmp_path / "info.yaml").project(c.true_x_mm), u, atol=1e-9)


def test_ros_file_is_camera_info_yaml(tmp_path):
    yaml = pytest.importorskip("yaml")
    write_ros(reference_rig().left, tmp_path / "info.yaml", (1920, 1080), "left")
    content = yaml.safe_load((tmp_path / "info.yaml").read_text())
    assert content["camera_name"] == "left" and content["image_height"] == 1080
    for key in ("camera_matrix", "distortion_coefficients", "rectification_matrix", "projection_matrix"):
        assert len(content[key]["data"]) == content[key]["rows"] * content[key]["cols"]


def test_one_camera_json_and_bad_files(tmp_path):
    c = simulate_correspondences(60, rng=np.random.default_rng(0))
    found = calibrate(c.x_mm, [c.u_left])
    write_json(found, tmp_path / "one.json")
    (camera,) = read_json(tmp_path / "one.json")
    np.testing.assert_array_equal(camera.matrix, found.cameras[0].matrix)
    for read in (read_json, read_opencv, read_ros):
        with pytest.raises(FileNotFoundError, match="gone"):
            read(tmp_path / "gone")
        (tmp_path / "bad").write_text("{}")
        with pytest.raises(ValueError, match="bad"):
            read(tmp_path / "bad")


def test_rig_of_a_calibration_saves_and_loads(tmp_path):
    c = simulate_correspondences(60, rng=np.random.default_rng(0))
    found = calibrate(c.x_mm, [c.u_left, c.u_right], model="near_affine")
    found.rig.save(tmp_path / "rig.json")
    again = StereoRig.load(tmp_path / "rig.json")
    for a, b in zip(again.project(c.x_mm), found.rig.project(c.x_mm), strict=True):
        np.testing.assert_array_equal(a, b)
