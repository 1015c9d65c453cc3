"""Rows, clocks and shutters of `lib.correspondences`."""

from __future__ import annotations

import numpy as np
import pytest

from lib import paths
from lib.cameras import AffineCamera, NearAffineCamera, StereoRig
from lib.correspondences import (
    LANDMARKS,
    MIN_CONFIDENCE,
    Correspondences,
    NoDetectionError,
    of_recording,
    pair_with_robot,
)
from lib.recordings import Recording

A = np.array([[100, 3, 5], [-3, 100, 2], [99, 1, 16], [-2, 98, 3.0]])
T = np.array([960, 540, 950, 545.0])


def path(time_s):
    """A smooth path of three landmarks, mm, that reports nothing between 1.0 and 1.2 s."""
    t = np.asarray(time_s, dtype=float)[..., None]
    x = np.concatenate([2 * np.sin(t), 1.5 * np.cos(1.3 * t), 0.5 * np.sin(0.7 * t)], axis=-1)
    x = x + np.array([[0, 0, 0], [2, 0.5, -0.4], [2, -0.5, -0.4]])
    return np.where((t > 1.0) & (t < 1.2), np.nan, x)


def shutter_pixels(time_s, readout_s, height_px):
    """Pixels (m, 3, 4) of a rolling shutter: every camera sees a landmark when its own row is read."""
    y = path(np.repeat(time_s[:, None], 3, axis=1)) @ A.T + T
    for _ in range(50):
        for rows in (slice(0, 2), slice(2, 4)):
            row_time = time_s[:, None] + readout_s * (y[..., rows][..., 1] / (height_px - 1) - 0.5)
            y[..., rows] = path(row_time) @ A[rows].T + T[rows]
    return y


def test_a_landmark_that_is_not_seen_lies_where_the_robot_reports_it():
    left, right = AffineCamera(np.column_stack([A[:2], T[:2]])), AffineCamera(np.column_stack([A[2:], T[2:]]))
    rig, x = StereoRig(left, right), path([0.0])
    u = np.array(rig.project(x)) + 3.0
    u[0, 0], x[2] = np.nan, np.nan  # the left image does not show the base; of tip_2 there is no report
    rows = Correspondences.of_points(x, *u, landmark=[0, 1, 2])
    rows.confidence[1, 1] = 0.5 * MIN_CONFIDENCE
    found = np.array(rows.tool_px(rig)) - rig.project(path([0.0]))
    np.testing.assert_allclose(found[:, :, 0], [[0, 3, 3], [3, 0, 3]])
    behind = StereoRig(NearAffineCamera(left.matrix, 1.0, (0, 0), 10 * left.viewing_direction), right)
    np.testing.assert_array_equal(rows.tool_px(behind), u)


def test_each_row_has_the_robots_position_at_its_own_instant():
    time_s = np.linspace(0, 4, 60)
    y = shutter_pixels(time_s, 0.03, 1080)
    c = pair_with_robot(y[..., :2], y[..., 2:], position=path, time_s=time_s, height_px=1080, readout_s=0.03)
    assert len(c) == 180 and list(c.landmark[:3]) == [0, 1, 2] and c.frame[-1] == 59
    good = c.complete
    assert 150 < len(good) < 180  # the gap in the robot's report stops nothing else
    r = np.hstack([good.u_left, good.u_right]) - good.x_mm @ A.T - T
    assert np.abs(r).max() < 0.02
    still = pair_with_robot(y[..., :2], y[..., 2:], position=path, time_s=time_s, height_px=1080).complete
    assert np.abs(np.hstack([still.u_left, still.u_right]) - still.x_mm @ A.T - T).max() > 1


def test_landmark_in_one_image_alone_keeps_its_instant():
    time_s = np.linspace(2, 3, 8)
    y = shutter_pixels(time_s, 0.03, 1080)
    y[3, 1, 2:] = np.nan
    c = pair_with_robot(y[..., :2], y[..., 2:], position=path, time_s=time_s, height_px=1080, readout_s=0.03)
    row = 3 * 3 + 1
    assert not c.is_complete[row] and c.seen[row].tolist() == [True, False]
    assert np.allclose(c.u_left[row], y[3, 1, :2]) and np.allclose(
        c.x_mm[row] @ A[:2].T + T[:2], c.u_left[row], atol=1e-6
    )


def test_wrong_detections_hardly_spoil_the_shift():
    rng = np.random.default_rng(0)
    time_s = np.linspace(2, 5, 40)
    y = shutter_pixels(time_s, 0.03, 1080)
    wrong = rng.random(y.shape[:2]) < 0.3
    spoiled = np.where(wrong[..., None], rng.uniform(0, 1000, y.shape), y)
    c = pair_with_robot(
        spoiled[..., :2], spoiled[..., 2:], position=path, time_s=time_s, height_px=1080, readout_s=0.03
    )
    r = (np.hstack([c.u_left, c.u_right]) - c.x_mm @ A.T - T)[~wrong.ravel()]
    assert np.abs(r).max() < 0.2


def test_shipped_recording_at_its_labels():
    recording = Recording.open(paths.SHIPPED_RECORDING)
    truth = recording.truth
    c = of_recording(recording, truth.u_left, truth.u_right)
    x = truth.rig.triangulate(c.u_left, c.u_right).x_mm
    assert len(c) == len(recording) * len(LANDMARKS)
    assert np.nanmedian(np.linalg.norm(x - c.x_mm, axis=1)) < 0.03  # the robot's 10 um a coordinate
    some = of_recording(recording, truth.u_left[4:6], truth.u_right[4:6], frames=slice(4, 6))
    assert np.array_equal(np.unique(some.frame), [4, 5])
    assert np.allclose(some.x_mm, c.of_frames([4, 5]).x_mm, equal_nan=True)


def test_rows_are_chosen_and_joined():
    c = Correspondences.of_points(
        np.zeros((4, 3)), np.ones((4, 2)), np.ones((4, 2)), confidence=[[1, 1]] * 3 + [[1, 0.1]]
    )
    assert 0.1 < MIN_CONFIDENCE and len(c.complete) == 3
    assert len(Correspondences.join([c, c.subset([0]), c.subset(np.array([True, False, True, False]))])) == 7
    assert np.isnan(c.covariance_px2).all() and c.pair_covariance_px2.shape == (4, 4, 4)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"readout_s": -1}, "readout_s"),
        ({"height_px": 1}, "height_px"),
        ({"time_s": [0.0]}, "u_left"),
        ({"position": lambda t: np.zeros((2, 3))}, "position"),
    ],
)
def test_bad_arguments_are_named(change, named):
    u = np.ones((2, 3, 2))
    good = {"position": path, "time_s": [0.0, 0.1], "height_px": 1080}
    with pytest.raises(ValueError, match=named):
        pair_with_robot(u, u, **(good | change))


def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match="u_left"):
        Correspondences.of_points(np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 2)))
    with pytest.raises(ValueError, match="confidence"):
        Correspondences.of_points(np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, 2)), confidence=[1, 1])


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"frame": [0.0, 0.04]}, "frame: expected whole numbers.*time_s"),
        ({"frame": [0.0, np.nan]}, "frame: expected whole numbers"),
        ({"landmark": [0.0, np.inf]}, "landmark: expected whole numbers"),
        ({"landmark": [0, -1]}, "landmark: must not be negative"),
    ],
)
def test_frames_and_landmarks_are_numbers(change, text):
    with pytest.raises(ValueError, match=text):
        Correspondences.of_points(np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, 2)), **change)
    assert Correspondences.of_points(np.zeros((2, 3)), np.zeros((2, 2)), np.zeros((2, 2)), frame=[3.0, 4.0]).frame[1] == 4


def test_one_frame_is_no_failure_of_the_detector():
    one = Correspondences.of_points(np.eye(3), np.ones((3, 2)), np.ones((3, 2)))
    with pytest.raises(ValueError, match=r"3 landmarks in all, .* Record more frames") as error:
        one.check_detections()
    assert not isinstance(error.value, NoDetectionError)
