"""The health of a detector without labels, on stand-ins for detector and recording."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from lib import paths
from lib.calibration import calibrate
from lib.correspondences import LANDMARKS, Correspondences
from lib.recordings import Recording
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig
from lib.trust import health
from lib.trust.health import LIMITS, affine_epipolar, feature_matches, unfamiliar

TOOL_MM = np.array([[0.0, 0.0, 0.0], [3.0, -0.5, 0.0], [3.0, 0.5, 0.0]])


def sweep(frames=30, seed=0, wrong=0.0):
    """Rows of a tool that moves and turns, a share of the detections wrong by 100 px, and which."""
    rng, rig = np.random.default_rng(seed), reference_rig()
    angle, place = rng.uniform(-np.pi, np.pi, frames), rng.uniform(-1, 1, (frames, 1, 3)) * [5, 2.5, 1]
    c, s, o, i = np.cos(angle), np.sin(angle), np.zeros(frames), np.ones(frames)
    turn = np.array([[c, -s, 0.3 * i], [s, c, o], [-0.3 * i, o, i]]).transpose(2, 0, 1)
    x = ROBOT_FROM_MICROSCOPE.apply((place + TOOL_MM @ turn.transpose(0, 2, 1)).reshape(-1, 3))
    u = np.stack(rig.project(x), axis=1) + rng.normal(0, 0.7, (len(x), 2, 2))
    off = rng.random((len(x), 2)) < wrong
    u[off] += 100.0 * rng.normal(size=(int(off.sum()), 2))
    covariance = np.broadcast_to(0.5 * np.eye(2), (len(x), 2, 2, 2))
    data = Correspondences.of_points(
        x + rng.normal(0, 0.005, x.shape), u[:, 0], u[:, 1], covariance_px2=covariance, frame=np.repeat(np.arange(frames), 3),
        landmark=np.tile(np.arange(3), frames), time_s=np.repeat(np.arange(frames) * 0.04, 3),
    )  # fmt: skip
    return data, off.any(axis=1).reshape(-1, 3)


def test_right_detections_are_healthy():
    data, _ = sweep()
    found = health(None, data, calibrate(data))
    assert found.unhealthy == 0.0 and (found.score < 1).all() and set(found.parts) >= {"epipolar", "robot", "smoothness"}


def test_wrong_detections_are_found_one_by_one():
    data, wrong = sweep(wrong=0.15)
    found = health(None, data, calibrate(data))
    assert found.bad[wrong].mean() > 0.9 and found.bad[~wrong].mean() < 0.05
    assert ((found.score > 1) == wrong.any(axis=1)).mean() > 0.9
    alone = health(None, data)  # without cameras only the two images speak
    assert list(alone.parts) == ["epipolar"] and alone.bad[~wrong].mean() < 0.05 < alone.bad[wrong].mean()


def test_nothing_found_is_wholly_unhealthy():
    data, _ = sweep(6)
    nothing = np.full((18, 2), np.nan)
    rows = {"frame": data.frame, "landmark": data.landmark, "time_s": data.time_s}
    empty = Correspondences.of_points(data.x_mm, nothing, nothing, **rows)
    assert health(None, empty).unhealthy == 1.0 and np.isnan(health(None, empty).score).all()


def test_a_detector_that_changes_its_mind_is_told():
    data, _ = sweep(6)
    picture = np.zeros((1080, 1920, 3), np.uint8)
    recording = SimpleNamespace(frames=[SimpleNamespace(left=picture, right=picture)] * 6)
    calls = []

    def fixed(images):  # mirrored, then shifted, for one frame after the other: answers as if it saw the picture so moved
        i, mirrored = divmod(len(calls), 2)
        calls.append(images.shape)
        u = np.stack([side.reshape(6, 3, 2)[i] for side in (data.u_left, data.u_right)])
        moved = u + (37, 21) if mirrored else np.stack([1919 - u[..., 0], u[..., 1]], axis=-1)[:, [0, 2, 1]]
        return SimpleNamespace(u=moved + (400.0 if i == 3 and mirrored else 0.0))

    looks = health(recording, data, detector=fixed).parts["looks"]
    assert calls == [(2, 1080, 1920, 3)] * 12 and (looks[3] > 1).all() and (looks[[0, 1, 2, 4, 5]] < 1e-6).all()
    assert len(LANDMARKS) == looks.shape[1]


def test_epipolar_geometry_of_most_matches():
    data, wrong = sweep(60, wrong=0.2)
    y = np.hstack([data.u_left, data.u_right])
    distance, agree = affine_epipolar(y)
    assert np.median(distance[agree]) < 1.5 and agree.mean() > 0.6 and np.median(distance[wrong.ravel()]) > 10
    assert np.isnan(affine_epipolar(y[:8])[0]).all()


@pytest.mark.parametrize("shuffled", [False, True])
def test_matches_that_share_no_geometry_are_no_witness(shuffled):
    """As of a pattern that repeats: each feature has a partner, in any place."""
    rng = np.random.default_rng(0)
    left = cv2.resize(rng.integers(0, 255, (108, 192, 3), dtype=np.uint8), (960, 540), interpolation=cv2.INTER_CUBIC)
    tiles = left.reshape(9, 60, 16, 60, 3).swapaxes(1, 2).reshape(144, 60, 60, 3)
    order = rng.permutation(144) if shuffled else np.roll(np.arange(144), 1)
    right = tiles[order].reshape(9, 16, 60, 60, 3).swapaxes(1, 2).reshape(540, 960, 3)
    found = feature_matches(SimpleNamespace(frames=[SimpleNamespace(left=left, right=right)]), np.array([0]))
    assert (len(found) == 0) == shuffled


def test_an_unlit_picture_and_a_chessboard_are_unfamiliar_and_the_shipped_recording_is_not():
    frame = Recording.open(paths.SHIPPED_RECORDING).frames[3]
    assert unfamiliar(frame.left) < LIMITS["unfamiliar"] and unfamiliar(frame.right) < LIMITS["unfamiliar"]
    board = np.kron(np.indices((9, 16)).sum(axis=0) % 2, np.ones((120, 120)))[..., None] * np.full(3, 255)
    assert min(unfamiliar(picture.astype(np.uint8)) for picture in (0 * board, board)) > LIMITS["unfamiliar"]
