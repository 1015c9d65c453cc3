"""Constant offsets of the landmarks: found where the tool turns, left to the prior where it does not."""

import warnings

import numpy as np
import pytest

from lib.calibration import calibrate, tool_axes
from lib.correspondences import Correspondences
from lib.geometry import RigidTransform
from lib.simulator.rig import IMAGE_SIZE_PX, ROBOT_FROM_MICROSCOPE
from notebooks.studies.calibration_studies import near_affine_rig

LANDMARKS_MM = np.array([[0.0, 0.0, 0.0], [3.0, -0.5, 0.1], [3.0, 0.5, 0.1]])
OFFSETS_MM = np.array([[0.040, 0.0, -0.010], [-0.010, 0.004, 0.006], [0.012, -0.003, 0.002]])


def tool_sweep(seed, *, frames=75, turn_rad=0.4, offset_mm=OFFSETS_MM, bias_px=0.0, distance_mm=np.inf):
    """Reported positions (n, 3), pixels, landmark (n,), axes (n, 3, 3) from the robot's report, and the true rig."""
    rng = np.random.default_rng(seed)
    rig = near_affine_rig(distance_mm)
    poses = [
        ROBOT_FROM_MICROSCOPE.compose(
            RigidTransform.from_rotation_vector(
                turn_rad * rng.uniform(-1, 1, 3), rng.uniform(-1, 1, 3) * [6, 3, 1.2] - [2, 0, 0]
            )
        )
        for _ in range(frames)
    ]
    x = np.stack([pose.apply(LANDMARKS_MM) for pose in poses])
    axes = tool_axes(x)
    seen = x + np.einsum("nij,kj->nki", axes, offset_mm)
    u = [p + bias_px + rng.normal(0, 0.8, p.shape) for p in rig.project(seen.reshape(-1, 3))]
    reported = x + rng.normal(0, 0.01, x.shape)
    return (
        reported.reshape(-1, 3),
        u,
        np.tile(np.arange(3), frames),
        np.repeat(tool_axes(reported), 3, axis=0),
        rig,
        x.reshape(-1, 3),
    )


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


@pytest.mark.parametrize(("model", "distance_mm"), [("zero_skew", np.inf), ("affine", np.inf), ("near_affine", 200.0)])
def test_offsets_are_found_with_honest_deviations_and_the_cameras_lose_their_bias(model, distance_mm):
    normalised, with_offsets, without, claims = [], [], [], []
    for seed in range(8):
        x, u, landmark, axes, rig, true = tool_sweep(seed, distance_mm=distance_mm)
        options = {"model": model, "image_size_px": IMAGE_SIZE_PX}
        found = calibrate_with_offsets(x, u, landmark, axes, **options)
        assert found.p_value < 1e-6 and 0.008 < found.prior_sd < 0.04
        normalised.append((found.offset - OFFSETS_MM) / found.standard_deviation)
        exact = np.hstack(rig.project(true))
        none = calibrate_with_offsets(x, u, landmark, axes, prior_sd=1e-9, **options)
        for fit, errors in ((found, with_offsets), (none, without)):
            errors.append(np.hstack(fit.calibration.rig.project(true)) - exact)
        # The cameras' claimed covariance has the offsets' uncertainty in it.
        claims.append(np.trace(found.calibration.projection_covariance(true), axis1=1, axis2=2).mean() / 4)
    assert np.sqrt(np.mean(np.square(normalised))) == pytest.approx(1, abs=0.3)
    assert np.mean(np.square(with_offsets)) < 0.6 * np.mean(np.square(without))
    assert np.mean(np.square(with_offsets)) / np.mean(claims) == pytest.approx(1, abs=0.6)


def test_without_offsets_none_are_claimed():
    p_values, priors = [], []
    for seed in range(12):
        x, u, landmark, axes, _, _ = tool_sweep(seed, offset_mm=np.zeros((3, 3)))
        found = calibrate_with_offsets(x, u, landmark, axes)
        p_values.append(found.p_value)
        priors.append(found.prior_sd)
        assert (np.abs(found.offset) < 4.5 * found.standard_deviation).all()
    assert min(p_values) > 1e-3 and 0.2 < np.mean(p_values) < 0.8
    assert np.median(priors) < 0.004


def test_a_tool_that_never_turns_tells_only_the_difference_between_landmarks():
    x, u, landmark, axes, _, true = tool_sweep(0, turn_rad=0.0)
    found = calibrate_with_offsets(x, u, landmark, axes, prior_sd=0.05)
    # What all landmarks have in common is a shift of the cameras: only the prior speaks, and the cameras say so.
    assert (found.standard_deviation > 0.9 * 0.05 / np.sqrt(3)).all()
    difference = (found.offset - found.offset.mean(axis=0)) - (OFFSETS_MM - OFFSETS_MM.mean(axis=0))
    assert np.abs(difference).max() < 0.012
    turned = calibrate_with_offsets(*tool_sweep(0)[:4], prior_sd=0.05)
    assert turned.learnt.min() > 0.9
    alone, both = (np.trace(f.calibration.projection_covariance(true[:1])[0]) for f in (turned, found))
    assert both > 20 * alone


def test_offsets_in_the_images_leave_their_mean_to_the_cameras():
    x, u, landmark, _, rig, true = tool_sweep(1, offset_mm=np.zeros((3, 3)))
    bias = np.array([[1.7, -0.3, 1.4, 0.2], [-1.3, 0.1, -1.2, 0.0], [0.2, 0.5, 0.1, 0.4]])
    u = [part + bias[landmark, 2 * i : 2 * i + 2] for i, part in enumerate(u)]
    found = calibrate_with_offsets(x, u, landmark, None, prior_sd=5.0)
    assert found.offset.shape == (3, 4) and found.p_value < 1e-6
    np.testing.assert_allclose(found.offset - found.offset.mean(axis=0), bias - bias.mean(axis=0), atol=0.35)
    assert (found.standard_deviation > 2.5).all()
    with_mean = np.hstack(found.calibration.rig.project(true)) - np.hstack(rig.project(true))
    np.testing.assert_allclose(with_mean.mean(axis=0), bias.mean(axis=0), atol=0.5)


def test_too_few_iterations_are_told():
    x, u, landmark, axes, _, _ = tool_sweep(0)
    with pytest.warns(RuntimeWarning, match=r"iterations: the offsets still move by up to .* mm after 1; allow more"):
        calibrate_with_offsets(x, u, landmark, axes, iterations=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        calibrate_with_offsets(x, u, landmark, axes)


def test_bad_arguments_are_named():
    x, u, landmark, axes, _, _ = tool_sweep(0, frames=8)
    with pytest.raises(ValueError, match="landmark"):
        calibrate_with_offsets(x, u, landmark[:-1], axes)
    with pytest.raises(ValueError, match="landmark"):
        calibrate_with_offsets(x, u, landmark - 1, axes)
    with pytest.raises(ValueError, match="shut jaws"):
        calibrate_with_offsets(x, u, landmark, np.full_like(axes, np.nan))
    with pytest.raises(ValueError, match="weighting"):
        calibrate_with_offsets(x, u, landmark, axes, weighting="paper")
    with pytest.raises(ValueError, match="prior_sd"):
        calibrate_with_offsets(x, u, landmark, axes, prior_sd=0.0)
    with pytest.raises(ValueError, match="iterations"):
        calibrate_with_offsets(x, u, landmark, axes, iterations=0)
    with pytest.raises(ValueError, match="too few"):
        calibrate_with_offsets(x[:0], [part[:0] for part in u], landmark[:0], axes[:0])
    x[3] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        calibrate_with_offsets(x, u, landmark, axes)
