from types import SimpleNamespace

import numpy as np
import pytest

from lib.landmarks import Landmarks
from lib.landmarks.stereo import detect


@pytest.fixture
def recording():
    """Five frames whose images say their own number; the robot missed frame 3."""
    frames = [
        SimpleNamespace(left=np.full((4, 4, 3), i, np.uint8), right=np.full((4, 4, 3), 100 + i, np.uint8))
        for i in range(5)
    ]
    x_mm = np.arange(45.0).reshape(5, 3, 3)
    x_mm[3] = np.nan
    return type(
        "Fake",
        (),
        {
            "frames": frames,
            "__len__": lambda self: 5,
            "landmarks_mm": lambda self: x_mm,
            "landmarks_at": lambda self, i, u: x_mm[i],
        },
    )()


def detector(images):
    """Landmark k of an image of value v lies at (v, k); tip_2 is missing in left image 1."""
    value = images[:, 0, 0, 0].astype(float)
    u = np.stack(np.broadcast_arrays(value[:, None], np.arange(3.0)), axis=-1)
    confidence = np.ones((2, 3))
    if value[0] == 1:
        u[0, 2], confidence[0, 2] = np.nan, 0.0
    covariance = np.broadcast_to(np.diag([1.0, 4.0]), (2, 3, 2, 2)) * (1 + (value >= 100))[:, None, None, None]
    return Landmarks(u, covariance, confidence)


def test_only_what_both_cameras_and_the_robot_saw_corresponds(recording):
    found = detect(recording, detector)
    seen = found.correspondences()
    assert len(found) == 5
    assert sorted(zip(seen.frame.tolist(), seen.landmark.tolist(), strict=True)) == [
        (0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2), (4, 0), (4, 1), (4, 2),
    ]  # fmt: skip
    np.testing.assert_array_equal(seen.x_mm, recording.landmarks_mm()[seen.frame, seen.landmark])
    np.testing.assert_array_equal(seen.u_left, np.column_stack([seen.frame, seen.landmark]))
    np.testing.assert_array_equal(seen.u_right, np.column_stack([100 + seen.frame, seen.landmark]))
    np.testing.assert_array_equal(seen.covariance_px2[0], np.diag([1.0, 4.0, 2.0, 8.0]))


def test_some_frames_only(recording):
    found = detect(recording, detector, frames=slice(2, None, 2))
    np.testing.assert_array_equal(found.left.u[:, 0, 0], [2, 4])
    np.testing.assert_array_equal(found.x_mm, recording.landmarks_mm()[[2, 4]])


def test_a_mask_selects_rows(recording):
    seen = detect(recording, detector).correspondences()
    base = seen[seen.landmark == 0]
    assert len(base) == 4 and (base.u_left[:, 1] == 0).all()
