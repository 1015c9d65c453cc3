"""The experiments: general solvers against the closed form, boards, spheres, studies and their command."""

import json

import cv2
import numpy as np
import pytest

from lib import paths
from lib.calibration import Moments, affine_minimum
from lib.simulator.rig import reference_rig, simulate_correspondences
from notebooks.studies import calibration_evaluation as evaluation
from notebooks.studies import calibration_studies as studies
from notebooks.studies import real_robot
from notebooks.studies.checkerboard import measure_boards


def test_a_general_sparse_solver_reaches_the_closed_form_minimum():
    c = simulate_correspondences(60, rng=np.random.default_rng(0))
    y = np.hstack([c.u_left, c.u_right])
    closed = affine_minimum(Moments.of(c.x_mm, y), 1.5**2, 0.010**2)
    cost, A = evaluation.solve_with_scipy(c.x_mm, y, 1.5, 0.010)
    assert closed.cost <= cost * (1 + 1e-9)
    assert cost == pytest.approx(closed.cost, rel=1e-7)
    np.testing.assert_allclose(A, closed.matrix[:, :3], rtol=1e-3, atol=0.01)


def test_ceres_reaches_the_closed_form_minimum():
    pytest.importorskip("pyceres")
    c = simulate_correspondences(100, rng=np.random.default_rng(1))
    y = np.hstack([c.u_left, c.u_right])
    closed = affine_minimum(Moments.of(c.x_mm, y), 1.5**2, 0.010**2)
    assert evaluation.solve_with_ceres(c.x_mm, y, 1.5, 0.010)[0] == pytest.approx(closed.cost, rel=1e-9)


def test_true_cameras_find_the_checkerboard_flat_square_and_in_place():
    found = measure_boards({"true": reference_rig()}, boards=1)["true"]
    assert found.corners == 13 * 9
    assert found.aligned_um < 3 and found.robot_um < 3


def spheres_image(shaft=True):
    """Two shaded red balls on a grey ground, edges anti-aliased by drawing eight times larger."""
    centres, radii, k = np.array([[150.3, 120.7], [230.6, 240.2]]), np.array([48.4, 36.2]), 8
    big = np.full((300 * k, 400 * k, 3), 90, np.uint8)
    for centre, radius in zip(centres, radii, strict=True):
        at = tuple(int(v) for v in np.round(k * (centre + 0.5) - 0.5))
        cv2.circle(big, at, round(k * radius), (205, 40, 45), -1)
    if shaft:
        cv2.line(big, (60 * k, 0), (150 * k, 110 * k), (30, 30, 30), 24 * k)
    image = cv2.resize(big, (400, 300), interpolation=cv2.INTER_AREA)
    noise = np.random.default_rng(0).normal(0, 4, image.shape)
    return np.clip(image + noise, 0, 255).astype(np.uint8), centres, radii


def test_spheres_are_found_to_a_fraction_of_a_pixel_though_the_shaft_hides_a_part():
    image, centres, radii = spheres_image()
    found = real_robot.find_spheres(image)
    np.testing.assert_allclose(found[:, :2], centres, atol=0.15)
    np.testing.assert_allclose(found[:, 2], radii, atol=0.4)
    assert real_robot.find_spheres(np.full((300, 400, 3), 90, np.uint8)) is None


def test_robot_folder_errors_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="pos_des"):
        real_robot.read_robot_frames(tmp_path)
    (tmp_path / "pos_des.txt").write_text("1 2 3\n4 5 6\n")
    with pytest.raises(FileNotFoundError, match=r"00\.jpg"):
        real_robot.read_robot_frames(tmp_path)


@pytest.mark.slow
def test_one_over_distance_halves_the_error_on_the_real_robot():
    folder = paths.real_data("dvrk_hand_eye")
    if folder is None:
        pytest.skip(paths.missing_data_line("dvrk_hand_eye"))
    frames = real_robot.read_robot_frames(folder)
    assert len(frames.index) >= 49
    for s in (0, 1):
        error = {
            m: real_robot.calibrate_sphere(
                frames.joint_mm, frames.u[:, s], model=m, image_size_px=frames.image_size_px, along_shaft_mm=0.0
            ).leave_one_out_rms_px
            for m in ("affine", "affine+distance")
        }
        assert error["affine"] < 1.95 and error["affine+distance"] < 1.19


def test_studies_show_what_they_claim():
    noise = studies.noise_study([1.5], runs=6)
    assert np.median(noise.affine_px) < np.median(noise.perspective_px)
    found, true = studies.focal_study(runs=10)
    assert np.median(found) < 0.3 * true
    shallow = studies.shallow_study([1.5, 0.2], n=500, runs=8)
    assert abs(shallow["likelihood"] - 1).max() < 0.08 < shallow["as printed, mm"][1] - 1
    distance = studies.working_distance_study([150.0], n=150, runs=1)
    assert distance["near_affine_um"][0] < 0.5 * distance["affine_um"][0] and distance["chosen"][0] == 1
    views = studies.factorisation_study([2], n=40, runs=3)
    assert np.isfinite(views["factorisation_um"]).all()
    assert np.sqrt((studies.tool_offset_study(frames=100, runs=2) ** 2).mean()) < 0.005


def test_results_are_written_whole_with_their_circumstances(tmp_path, capsys):
    out = tmp_path / "calibration.json"
    assert evaluation.main(["bound", "--runs", "20", "--out", str(out)]) == 0
    content = json.loads(out.read_text())["bound"]
    assert content["result"]["runs"] == 20 and {"command", "commit", "machine", "date"} <= set(content)
    assert [p.name for p in tmp_path.iterdir()] == ["calibration.json"]
    with pytest.raises(SystemExit):
        evaluation.main(["bounds"])
    assert "unknown study bounds" in capsys.readouterr().err


@pytest.mark.slow
def test_bound_and_size_over_many_runs():
    bound = studies.bound_study(runs=2000)
    assert bound.ratio.mean() == pytest.approx(1, abs=0.05)
    np.testing.assert_allclose(bound.ratio, 1, atol=0.15)
    assert bound.claimed / 16 == pytest.approx(1, abs=0.02)
    assert all(0.035 <= share <= 0.065 for share in studies.nested_study(runs=2000).values())
    errors, _ = studies.time_offset_study()
    assert np.sqrt((errors**2).mean()) < 0.5e-3
