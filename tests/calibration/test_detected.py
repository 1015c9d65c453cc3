"""Calibration from frames: what is kept, what is judged, what is compared.  A detector that knows the truth stands in."""

from dataclasses import replace

import numpy as np
import pytest

from lib import paths
from lib.calibration import calibrate
from lib.landmarks import Landmarks
from lib.landmarks.stereo import StereoLandmarks
from lib.recordings import Recording
from notebooks.studies import calibration_evaluation as evaluation
from notebooks.studies import detected


@pytest.fixture(scope="module")
def recording():
    return Recording.open(paths.SHIPPED_RECORDING)


def noisy(recording, *, sigma_px=0.5, bias_px=0.0, seed=0):
    rng = np.random.default_rng(seed)

    def side(u):
        covariance = np.broadcast_to(sigma_px**2 * np.eye(2), (*u.shape, 2))
        return Landmarks(u + bias_px + rng.normal(0, sigma_px, u.shape), covariance, np.ones(u.shape[:2]))

    left, right = side(recording.truth.u_left), side(recording.truth.u_right)
    return StereoLandmarks(left, right, recording.landmarks_mm(left.u))


def test_judgement_separates_noise_from_bias(recording):
    ratios = []
    for seed in range(6):
        rows = detected.row_timed(recording, noisy(recording, seed=seed))
        found = calibrate(rows.x_mm, [rows.u_left, rows.u_right], image_size_px=recording.image_size_px)
        judged = detected.judge(found, recording, rows)
        assert judged.sigma_u_px == pytest.approx(0.5, rel=0.2)
        assert judged.triangulation_um > judged.calibration_um
        ratios.append(judged)
    triangulation, projection = detected.pooled_over_bound(ratios)
    assert triangulation == pytest.approx(1, abs=0.35) and projection == pytest.approx(1, abs=0.35)
    off = np.array([2.0, 0.0])
    rows = detected.row_timed(recording, noisy(recording, bias_px=off))
    found = calibrate(rows.x_mm, [rows.u_left, rows.u_right], image_size_px=recording.image_size_px)
    judged = detected.judge(found, recording, rows)
    np.testing.assert_allclose(judged.bias_px, np.tile([2, 0, 2, 0], (3, 1)), atol=0.4)
    assert judged.projection_over_bound > 3 > 2 > judged.over_bound


def test_only_a_recording_with_truth_is_judged(recording):
    rows = detected.label_rows(recording, click_px=1.0)
    found = calibrate(rows.x_mm, [rows.u_left, rows.u_right])
    blind = replace(recording, truth=None)
    for judge in (
        lambda: detected.judge(found, blind, rows),
        lambda: detected.calibrate_labels(blind),
        lambda: detected.true_rig(blind),
    ):
        with pytest.raises(ValueError, match="no truth"):
            judge()


def test_detections_are_kept_by_what_made_them(recording, tmp_path, monkeypatch):
    monkeypatch.setattr(paths, "CACHE", tmp_path)
    weights, calls = tmp_path / "weights.bin", []
    short = replace(recording, frames=_First(recording.frames, 2))

    def load(path):
        calls.append(path)
        return lambda images: Landmarks(np.zeros((2, 3, 2)), np.tile(np.eye(2), (2, 3, 1, 1)), np.ones((2, 3)))

    with pytest.raises(FileNotFoundError, match="weights.bin"):
        detected.detections(short, weights, load=load)
    weights.write_bytes(b"one")
    monkeypatch.setattr(type(short), "landmarks_mm", lambda self, u: np.zeros((len(u), 3, 3)))
    for _ in range(2):
        found = detected.detections(short, weights, load=load)
        assert len(found) == 2 and (found.left.confidence == 1).all()
    assert len(calls) == 1
    weights.write_bytes(b"two")
    detected.detections(short, weights, load=load)
    assert len(calls) == 2
    monkeypatch.setattr(detected, "default_engine", lambda: "another")
    detected.detections(short, weights, load=load)
    monkeypatch.setattr(detected, "CODE_VERSION", detected.CODE_VERSION + 1)
    detected.detections(short, weights, load=load)
    assert len(calls) == 4
    assert len(list((tmp_path / "calibration" / "detections").iterdir())) == 4


class _First:
    """The first frames of a recording."""

    def __init__(self, frames, n):
        self.frames, self.n, self.time_s = frames, n, frames.time_s[:n]

    def __len__(self):
        return self.n

    def __getitem__(self, i):
        return self.frames[i]


def test_estimates_and_resolutions_of_a_recording(recording, tmp_path, monkeypatch):
    found = detected.estimates(recording, noisy(recording, bias_px=np.array([1.0, 0.0])))
    assert set(found) == {
        "detected", "own_covariances", "tool_offsets", "image_offsets", "offsets_and_covariances", "labels_1_px",
    }  # fmt: skip
    for name, (fit, rows) in found.items():
        assert fit.rig is not None and len(fit.inliers) == len(rows), name
    monkeypatch.setattr(detected, "sweep", lambda **_: recording)
    result = detected.resolution_study(tmp_path)
    assert list(result) == ["labels"]
    labels = result["labels"]
    assert labels["affine_projection_px"] < labels["perspective_projection_px"]
    assert labels["affine_calibration_um"] < labels["perspective_calibration_um"]


def test_boards_are_measured_with_every_estimate(recording, monkeypatch):
    monkeypatch.setattr(detected, "sweep", lambda *_, **__: recording)
    monkeypatch.setattr(detected, "detections", lambda *_: noisy(recording, sigma_px=0.3))
    found = detected.board_study(np.inf, boards=1, models=("zero_skew",), seeds=(0,))
    assert found["true cameras"][0].aligned_um < 3
    assert found["zero_skew, detected"][0].aligned_um < 6 and found["zero_skew, detected"][0].robot_um < 30
    assert len(found) == 7 and all(len(errors) == 1 for errors in found.values())


def test_root_mean_square():
    assert evaluation._root_mean_square([3.0, 4.0]) == pytest.approx(np.sqrt(12.5))


def test_recorded_checkerboard_stays_within_its_limits():
    """Affine optics, cameras from 75 detected frames: 6 um aligned and 12 um in the robot frame, root mean squares."""
    study = evaluation.recorded("checkerboard")
    near = study["affine optics"]
    for estimate in ("detected", "own_covariances", "offsets_and_covariances"):
        row = near[f"zero_skew, {estimate}"]
        assert row["sweeps"] >= 4
        assert row["aligned_um"] <= 6 and row["robot_um"] <= 12
