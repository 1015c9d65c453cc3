from types import SimpleNamespace

import numpy as np
import pytest

from lib.landmarks import Landmarks, SharedDetector, detect, with_ground
from lib.recordings import Ground


@pytest.fixture
def recording():
    """Five frames whose images hold their own number; the robot missed frame 3."""
    x_mm = np.arange(45.0).reshape(5, 3, 3)
    x_mm[3] = np.nan

    class Frames(list):
        time_s = np.arange(5.0)

    frames = Frames(
        SimpleNamespace(left=np.full((4, 4, 3), i, np.uint8), right=np.full((4, 4, 3), 100 + i, np.uint8))
        for i in range(5)
    )
    kinematics = SimpleNamespace(at=lambda time_s: x_mm[np.round(time_s[:, 0]).astype(int)])
    return SimpleNamespace(
        frames=frames, kinematics=kinematics, x_mm=x_mm, image_size_px=(4, 4), readout_s=0.0, offset_s=0.0
    )


def detector(images):
    """Landmark k of an image of value v lies at (v, k); tip_2 is missing in left image 1."""
    value = images[:, 0, 0, 0].astype(float)
    u = np.stack(np.broadcast_arrays(value[:, None], np.arange(3.0)), axis=-1)
    confidence = np.ones((2, 3))
    if value[0] == 1:
        u[0, 2], confidence[0, 2] = np.nan, 0.0
    covariance = np.broadcast_to(np.diag([1.0, 4.0]), (2, 3, 2, 2)) * (1 + (value >= 100))[:, None, None, None]
    return Landmarks(u, covariance, confidence)


def test_only_what_both_cameras_and_the_robot_saw_is_complete(recording):
    found = detect(recording, detector)
    seen = found.complete
    assert len(found) == 15
    assert sorted(zip(seen.frame.tolist(), seen.landmark.tolist(), strict=True)) == [
        (0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2), (4, 0), (4, 1), (4, 2),
    ]  # fmt: skip
    np.testing.assert_array_equal(found.x_mm, recording.x_mm.reshape(-1, 3))
    np.testing.assert_array_equal(seen.u_left, np.column_stack([seen.frame, seen.landmark]))
    np.testing.assert_array_equal(seen.u_right, np.column_stack([100 + seen.frame, seen.landmark]))
    np.testing.assert_array_equal(seen.pair_covariance_px2[0], np.diag([1.0, 4.0, 2.0, 8.0]))
    assert found.confidence[5].tolist() == [0.0, 1.0]


def test_some_frames_only(recording):
    found = detect(recording, detector, frames=slice(2, None, 2))
    np.testing.assert_array_equal(found.frame, np.repeat([2, 4], 3))
    np.testing.assert_array_equal(found.grid("u_left")[:, 0, 0], [2, 4])
    np.testing.assert_array_equal(found.grid("x_mm"), recording.x_mm[[2, 4]])
    with pytest.raises(ValueError, match="frames: none of the 5"):
        detect(recording, detector, frames=slice(9, None))


def test_tracking_starts_from_the_frame_before(recording):
    looked = []

    class Tracker:
        def __call__(self, images):
            looked.append("whole")
            return detector(images)

        def track(self, images, previous):
            looked.append(previous.u[0, 0, 0])
            return detector(images)

    tracked = detect(recording, Tracker(), track=True)
    assert looked == ["whole", 0.0, 1.0, 2.0, 3.0]
    np.testing.assert_array_equal(tracked.u_left, detect(recording, detector).u_left)


def test_only_a_detector_is_told_the_ground(recording):
    """A stand-in is a function of images alone."""
    recording.ground = Ground(lambda: np.arange(96, dtype=np.uint8).reshape(2, 4, 4, 3), "g")
    assert with_ground(detector, recording) == {}
    shared = SharedDetector(detector)
    assert with_ground(shared, recording) == {"ground": recording.ground}
    np.testing.assert_array_equal(detect(recording, shared).u_left, detect(recording, detector).u_left)
    mirrored = with_ground(shared, recording, lambda images: images[:, :, ::-1])["ground"]
    np.testing.assert_array_equal(mirrored(), recording.ground()[:, :, ::-1])
