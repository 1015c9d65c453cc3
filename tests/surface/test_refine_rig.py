"""A calibration brought to agree with the epipolar geometry of matches whose every error is known."""

from __future__ import annotations

import numpy as np
import pytest

from lib.calibration import calibrate
from lib.cameras import NearAffineCamera, StereoRig
from lib.matching import Matches
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig
from lib.surface import refine_rig
from notebooks.studies.simulated_rows import simulate_correspondences

NOISE_PX = 0.3


def bowl_mm(n: int, rng: np.random.Generator, *, depth: float = 1.0) -> np.ndarray:
    """Points (n, 3) of a bowl in the robot frame."""
    x, y = rng.uniform((-8, -4.5), (8, 4.5), (n, 2)).T
    return ROBOT_FROM_MICROSCOPE.apply(np.column_stack([x, y, 0.5 - depth * (x**2 + y**2) / 40]))


def matches_of(rig, x_mm: np.ndarray, rng: np.random.Generator, *, outliers: float = 0.0) -> Matches:
    u_left, u_right = rig.project(x_mm)
    u_right = u_right + rng.normal(0, NOISE_PX, u_right.shape)
    wrong = rng.random(len(x_mm)) < outliers
    u_right[wrong] += rng.uniform(-15, 25, (wrong.sum(), 2))
    covariance = np.tile(np.diag([1e-4, 1e-4, NOISE_PX**2, NOISE_PX**2]), (len(x_mm), 1, 1))
    one = np.ones(len(x_mm))
    return Matches(u_left, u_right, one, covariance, peak_ratio=one, reciprocal=one > 0, method="made")


def calibrated(seed: int, rig: StereoRig | None = None, **options):
    rng = np.random.default_rng(seed)
    c = simulate_correspondences(225, rng=rng, rig=rig, sigma_u_px=1.2)
    return calibrate(c.x_mm, [c.u_left, c.u_right], **options), c.true_rig, rng


def epipolar_rms_px(rig, true_rig) -> float:
    x = bowl_mm(2000, np.random.default_rng(99))
    return float(np.sqrt(np.mean(rig.epipolar_distance(*true_rig.project(x)) ** 2)))


@pytest.mark.parametrize("seed", range(4))
def test_the_matches_epipolar_geometry_is_taken_over(seed):
    calibration, true_rig, rng = calibrated(seed)
    refined = refine_rig(calibration, matches_of(true_rig, bowl_mm(4000, rng), rng, outliers=0.15))
    before, after = epipolar_rms_px(calibration.rig, true_rig), epipolar_rms_px(refined, true_rig)
    assert after < 0.03 < before
    # What the matches cannot know stays: points move by far less than the calibration is unsure of.
    x = bowl_mm(500, rng)
    moved = refined.triangulate(*true_rig.project(x)).x_mm - calibration.rig.triangulate(*true_rig.project(x)).x_mm
    assert np.sqrt((moved**2).sum(axis=1).mean()) < 0.5 * np.sqrt(
        np.trace(calibration.point_covariance(x, detection=False), axis1=1, axis2=2).mean()
    )


def test_cameras_of_a_finite_distance_are_refined_too():
    affine, centre_px = reference_rig(), (959.5, 539.5)
    near = (NearAffineCamera(one.matrix, 1 / 120, centre_px, ROBOT_FROM_MICROSCOPE.t) for one in (affine.left, affine.right))
    calibration, true_rig, rng = calibrated(8, rig=StereoRig(*near), model="near_affine", image_size_px=(1920, 1080))
    refined = refine_rig(calibration, matches_of(true_rig, bowl_mm(4000, rng), rng, outliers=0.15))
    before, after = epipolar_rms_px(calibration.rig, true_rig), epipolar_rms_px(refined, true_rig)
    assert isinstance(refined.left, NearAffineCamera) and after < 0.25 * before


def test_little_is_learnt_from_little():
    calibration, true_rig, rng = calibrated(5)
    every = matches_of(true_rig, bowl_mm(4000, rng), rng)
    few = refine_rig(calibration, every.keep(slice(6)))
    much = refine_rig(calibration, every)
    moved = [np.abs(rig.left.matrix - calibration.rig.left.matrix).max() for rig in (few, much)]
    assert moved[0] < moved[1]
    assert np.array_equal(refine_rig(calibration, every.keep(slice(3))).left.matrix, calibration.rig.left.matrix)


def test_a_flat_scene_leaves_open_what_it_does_not_show():
    calibration, true_rig, rng = calibrated(6)
    flat = ROBOT_FROM_MICROSCOPE.apply(np.column_stack([rng.uniform((-8, -4.5), (8, 4.5), (3000, 2)), np.zeros(3000)]))
    refined = refine_rig(calibration, matches_of(true_rig, flat, rng))
    assert np.isfinite(refined.linear).all()
    on_plane = np.sqrt(np.mean(refined.epipolar_distance(*true_rig.project(flat)) ** 2))
    assert on_plane < 0.03


def test_cameras_that_agree_are_left_alone():
    calibration, _, rng = calibrated(7)
    x = bowl_mm(4000, rng)
    matches = matches_of(calibration.rig, x, rng)
    refined = refine_rig(calibration, matches)
    for u, v in zip(refined.project(x), calibration.rig.project(x), strict=True):
        assert np.abs(u - v).max() < 0.03


def test_one_camera_is_refused():
    c = simulate_correspondences(60, rng=np.random.default_rng(0))
    single = calibrate(c.x_mm, [c.u_left])
    with pytest.raises(ValueError, match="calibration: this needs a stereo pair"):
        refine_rig(single, matches_of(c.true_rig, c.true_x_mm, np.random.default_rng(0)))
