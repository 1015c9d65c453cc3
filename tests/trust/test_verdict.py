"""Verdicts: levels, how they join, and that the workbench knows the same levels."""

import re
from dataclasses import replace
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest

from lib import paths
from lib.calibration import CompetingCamerasError, calibrate
from lib.correspondences import TRAIN_FURTHER, Correspondences, DataError, NoDetectionError, of_recording
from lib.landmarks.shaft import ShaftEnd
from lib.recordings import Doubt, Frames, Recording, Scene
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig
from lib.trust import LEVELS, Diagnosis, Health, Hypothesis, Reason, Verdict, assess, diagnose, judge
from lib.trust import verdict as verdicts
from lib.workbench.report import VERDICT_COLOURS
from notebooks.studies import spoiling
from notebooks.studies.simulated_rows import simulate_correspondences
from tests.remembering import remembering_recordings

CLOCK = Reason("clock", "not trustworthy", "183 ms", "Set offset_s.")
FEW = Reason("few_frames", "doubtful", "5 frames", "Record more.")


def test_the_worst_reason_decides_and_stands_first():
    joined = Verdict.join([Verdict((FEW,)), Verdict((CLOCK, FEW))])
    assert joined.reasons == (CLOCK, FEW) and joined.level == LEVELS[2] and joined.is_red
    assert joined.to_json()["reasons"][0] == {"name": "clock", "level": LEVELS[2], "text": "183 ms", "cure": "Set offset_s."}
    assert "183 ms" in str(joined)
    with pytest.raises(ValueError, match="level: expected one of"):
        Reason("fine", "trustworthy", "", "")


def test_the_workbench_knows_the_same_levels():
    assert tuple(VERDICT_COLOURS) == LEVELS


# --- what is judged


def made(n, seed=0, claim_px=1.5, **options):
    c = simulate_correspondences(n, rng=np.random.default_rng(seed), **options)
    claimed = np.broadcast_to(claim_px**2 * np.eye(2), (n, 2, 2, 2))
    return Correspondences.of_points(c.x_mm, c.u_left, c.u_right, covariance_px2=claimed)


def names(data, **options):
    calibration = calibrate(data, image_size_px=(1920, 1080))
    return {reason.name: reason.level for reason in judge(data, calibration, **options).reasons}


def test_an_image_that_is_turned_against_the_other_is_named():
    data = made(40, 0)
    turned = replace(data, u_right=np.array([1919.0, 1079.0]) - data.u_right)
    assert names(data) == {} and names(turned) == {"turned_image": LEVELS[2]}
    for clockwise, quarter in ((90, [[0, -1], [1, 0]]), (270, [[0, 1], [-1, 0]])):  # y points down
        data_turned = replace(data, u_right=data.u_right @ np.transpose(quarter) + 1500.0)
        calibration = calibrate(data_turned, image_size_px=(1920, 1080))
        (reason,) = (r for r in judge(data_turned, calibration).reasons if r.name == "turned_image")
        back = f"video.rotate_right = {360 - clockwise} in the mapping", f"video.rotate_left = {clockwise} if"
        assert all(key in reason.cure for key in back)
    mirrored = replace(data, u_right=[1919.0, 0.0] + data.u_right * [-1.0, 1.0])
    assert "turned_image" not in names(mirrored) and "mirrored" in names(mirrored)


def test_images_that_were_resized_to_another_shape_are_told_with_the_factor_that_undoes_it():
    data = made(40, 0)
    squeezed = replace(data, u_left=data.u_left * [0.5, 1.0], u_right=data.u_right * [0.5, 1.0])
    calibration = calibrate(squeezed, image_size_px=(960, 1080))
    (reason,) = (r for r in judge(squeezed, calibration).reasons if "between x and y" in r.text)
    assert reason.level == LEVELS[2] and "2.00 times the present pixel_aspect" in reason.cure


@pytest.mark.parametrize("n", [6, 8, 12, 40])
def test_clean_data_of_any_size_are_never_red(n):
    levels = [level for seed in range(15) for level in names(made(n, seed)).values()]
    assert LEVELS[2] not in levels and (n < 12 or not levels)


def test_vague_detections_do_not_hide_that_the_cameras_are_the_largest_error():
    data = made(12, 0, 0.5, sigma_u_px=0.5, half_size_mm=(8.0, 4.5, 0.4))
    vague = np.arange(12) % 3 == 0
    errors = np.random.default_rng(0).normal(0, 30, (2, 12, 2)) * vague[:, None]
    covariance = data.covariance_px2 * np.where(vague, 60.0**2, 1.0)[:, None, None, None]
    unsure = replace(data, u_left=data.u_left + errors[0], u_right=data.u_right + errors[1], covariance_px2=covariance)
    assert names(data) == {} and names(unsure) == {"coverage": LEVELS[1]}


@pytest.mark.parametrize("half_depth_mm", [0.0, 0.01, 0.03])
def test_few_clean_rows_in_a_plane_are_calibrated_and_never_trusted(half_depth_mm):
    for seed in range(10):
        data = made(6, seed, half_size_mm=(8.0, 4.5, half_depth_mm))
        found = calibrate(data, image_size_px=(1920, 1080))
        reasons = {reason.name: reason for reason in judge(data, found).reasons}
        assert reasons["thin"].level == LEVELS[2 if found.extents_mm[2] < 0.02 else 1]
        assert "out of one plane" in reasons["thin"].text and "along the view" in reasons["thin"].cure
        test = simulate_correspondences(60, rng=np.random.default_rng(seed), sigma_u_px=0.0)
        x = test.true_x_mm
        error = found.pair.triangulate(*test.true_rig.project(x)).x_mm - x
        own = found.point_covariance(x, detection=False)
        assert (error**2).sum(axis=1).mean() < 16 * np.trace(own, axis1=1, axis2=2).mean()


def test_a_plane_that_the_robots_own_noise_thickens_is_not_trusted():
    """The fit finds that the robot errs by 50 um, not by the 10 um that are stated: `calibrate` refuses it if it checks."""
    for seed in range(4):
        rng = np.random.default_rng(seed)
        x_mm = ROBOT_FROM_MICROSCOPE.apply(rng.uniform(-1, 1, (60, 3)) * [6, 4, 0])
        u = [rng.normal(p, 1.0) for p in reference_rig().project(x_mm)]
        reported_mm = x_mm + rng.normal(0, 0.05, x_mm.shape)
        with pytest.raises(DataError, match="coplanar .*robot errors 0.0"):
            calibrate(reported_mm, u)
        verdict = judge(Correspondences.of_points(reported_mm, *u), calibrate(reported_mm, u, checks=False))
        assert next(reason.level for reason in verdict.reasons if reason.name == "thin") == LEVELS[2]


@pytest.mark.parametrize("eyes", [(0, 1), (1, 0)])
def test_one_mirrored_image_is_not_called_two(eyes):
    """The viewing directions of the two cameras cancel, so the tool's direction says nothing about up and down."""
    scene = spoiling.Scene(np.random.default_rng(3), frames=45)
    scene.edit_pixels.append(lambda scene, u: np.stack([u[:, :, eyes[0]] * [-1, 1] + [1919, 0], u[:, :, eyes[1]]], axis=2))
    scene = scene.take()
    found = diagnose(scene.data, kinematics=scene.kinematics, image_size_px=scene.image_size_px)
    assert not any(h.name == "mirrored_images" for h in found.hypotheses)


@pytest.mark.parametrize(("moves_mm", "expected"), [
    ((6.0, 0.0, 0.0), {"one_line": LEVELS[2]}),  # its cameras have oblong pixels, which is no fault of axes or units
    ((6.0, 3.0, 0.0), {"one_plane": LEVELS[1]}),
    ((6.0, 3.0, 1.0), {}),
])  # fmt: skip
def test_a_tool_that_does_not_turn_leaves_open_what_lies_across_its_path(moves_mm, expected):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        tool_mm = ROBOT_FROM_MICROSCOPE.t + np.array([[0.0, 0.0, 0.0], [3.0, 0.8, 0.5], [3.0, -0.8, -0.3]])
        x_mm = (rng.uniform(-1, 1, (40, 1, 3)) * moves_mm + tool_mm).reshape(-1, 3)
        u_left, u_right = (u + rng.normal(0, 1.5, u.shape) for u in reference_rig().project(x_mm))
        rows = {"frame": np.repeat(np.arange(40), 3), "landmark": np.tile(np.arange(3), 40)}
        claimed = np.broadcast_to(1.5**2 * np.eye(2), (120, 2, 2, 2))
        x_mm = x_mm + rng.normal(0, 0.01, x_mm.shape)
        assert names(Correspondences.of_points(x_mm, u_left, u_right, covariance_px2=claimed, **rows)) == expected


def test_residuals_beyond_the_claim_are_red():
    assert names(made(60, claim_px=0.2), robot_accuracy_mm=0.001)["residuals"] == LEVELS[2]
    assert names(made(60)) == {}


def test_detections_that_own_to_large_errors_do_not_condemn_the_others():
    data, shift = made(60), np.zeros((60, 2))
    shift[:3, 0] = 60.0
    claimed = data.covariance_px2.copy()
    claimed[:3] = 20.0**2 * np.eye(2)
    unsure = replace(data, u_left=data.u_left + shift, u_right=data.u_right - shift, covariance_px2=claimed)
    assert calibrate(unsure).inliers.all() and names(unsure) == {}


def test_a_minority_and_few_frames_are_told():
    data, rng = made(60), np.random.default_rng(1)
    views = (data.u_left, data.u_right)
    left, right = (np.where(rng.random((60, 1)) < 0.35, rng.uniform(0, 1000, (60, 2)), u) for u in views)
    assert names(replace(data, u_left=left, u_right=right))["minority"] == LEVELS[1]
    assert names(replace(made(12), frame=np.arange(12) // 4))["few_frames"] == LEVELS[2]


def test_witnesses_count():
    data = made(60)
    assert names(data, epipolar_px=0.5) == {} and names(data, epipolar_px=20.0) == {"epipolar": LEVELS[2]}
    bad = Health(np.arange(20), {"looks": np.full((20, 3), 3.0)}, np.ones((20, 3), bool))
    assert names(data, health=bad) == {"detector_unfit": LEVELS[2]}
    assert names(data, doubts=[Doubt("log_gap", "An hour.", "Look.")]) == {"log_gap": LEVELS[1]}
    end = [ShaftEnd(np.arange(3), *[np.zeros((3, 2, 2))] * 3, moved, 0.01, None, None) for moved in (-0.05, 0.025, 0.05)]
    assert [names(data, shaft=one) for one in end] == [{"base": LEVELS[1]}, {}, {"base": LEVELS[1]}]


def test_a_refusal_names_its_own_cure():
    data = made(60, half_size_mm=(8.0, 4.5, 0.0))
    flat = replace(data, x_mm=data.x_mm * [1, 1, 0])
    with pytest.raises(DataError, match="coplanar") as error:
        calibrate(flat)
    (reason,) = judge(flat, None, error=error.value).reasons
    assert reason.name == "refused" and reason.cure == "Correct that, then check again."
    assert "cover a few depths as well" in reason.text


def test_where_the_detector_errs_competing_cameras_may_be_its_errors():
    parts = {"looks": np.repeat([[3.0], [0.1]], [8, 12], axis=0) * np.ones(3)}
    few_bad = Health(np.arange(20), parts, np.ones((20, 3), bool))
    error = CompetingCamerasError("left: two consensuses compete.")
    (alone,) = judge(made(60), None, error=error).reasons
    assert alone.cure == "Correct that, then check again."
    reasons = judge(made(60), None, error=error, health=few_bad).reasons
    assert [reason.name for reason in reasons] == ["no_consensus", "detector_unfit"] and "lib adapt" in reasons[0].cure
    cause = Hypothesis("detector_unfit", "24 % of them lie elsewhere.", "Let it be taught.", 24.0, 0.0, "%", 0.24, 32.2)
    reasons = judge(made(60), None, error=error, diagnosis=Diagnosis((cause,))).reasons
    assert [reason.name for reason in reasons] == ["no_consensus", "detector_unfit"]


def test_a_refusal_does_not_contradict_the_diagnosis():
    cause = Hypothesis("mirrored_axis", "An axis is mirrored.", "Negate one.", 11.0, 0.1, "degrees", 1.0, 100.0)
    verdict = judge(None, None, diagnosis=Diagnosis((cause,)), error=DataError("exchange left and right."))
    assert [reason.name for reason in verdict.reasons] == ["mirrored_axis", "refused"]
    assert "exchange" not in str(verdict)


@pytest.fixture(scope="module")
def decoded_once():
    """The images of the recording that ships."""
    with remembering_recordings():
        yield


def test_careless_labels_are_looked_at_again_and_no_detector_is_taught(decoded_once):
    recording = Recording.open(paths.SHIPPED_RECORDING)
    truth, rng = recording.truth, np.random.default_rng(3)
    u = np.stack([truth.u_left, truth.u_right])
    u = u + rng.normal(0, 1.5, u.shape)
    wild = np.arange(0, len(recording), 4)
    u[:, wild] += rng.choice([-25, 25], u[:, wild].shape)
    verdict = assess(recording, of_recording(recording, *u)).verdict
    cures = " ".join(reason.cure for reason in verdict.reasons)
    assert verdict.level != LEVELS[0] and "adapt" not in cures and "detector" not in cures
    named = re.search(r"first those of frames ([\d, ]+): `python3 -m lib annotate", cures)[1]
    assert set(map(int, named.split(", "))) <= set(wild.tolist())
    blind = assess(recording, of_recording(recording, *(u * np.nan))).verdict  # of a detector that finds nothing
    assert not any("Look again at the labels" in reason.cure for reason in blind.reasons)


def test_labels_that_miss_in_one_eye_are_looked_at_after_the_images(decoded_once):
    recording = Recording.open(paths.SHIPPED_RECORDING)
    u = np.stack([recording.truth.u_left, recording.truth.u_right[::-1]])  # the right images run backwards
    reasons = assess(recording, of_recording(recording, *u)).verdict.reasons
    cure = next(reason.cure for reason in reasons if reason.name == "one_eye_unfit")
    assert "Are the right images of this recording" in cure and "If they are: Look again at the labels" in cure
    assert "adapt" not in cure


@pytest.mark.parametrize("off", [0.0, 0.08])
def test_a_base_that_the_detector_marks_along_the_shaft_is_told(decoded_once, monkeypatch, off):
    """Cameras with offsets explain it, and both images agree; only the images of the tool show it."""

    def healthy(recording, data, *rest, **more):
        frame = np.unique(data.frame)
        return Health(frame, {"looks": np.zeros((len(frame), 3))}, np.ones((len(frame), 3), bool))

    monkeypatch.setattr(verdicts, "health", healthy)
    recording = Recording.open(paths.SHIPPED_RECORDING)
    u = np.stack([recording.truth.u_left, recording.truth.u_right])
    u[:, :, 0] += off * (u[:, :, 0] - u[:, :, 1:].mean(axis=2))
    u += np.random.default_rng(2).normal(0, 0.7, u.shape)
    data = of_recording(recording, *u, covariance_px2=np.tile(0.5 * np.eye(2), (len(recording), 3, 2, 1, 1)))
    found = assess(recording, data, detector=lambda images: None).verdict
    named = {reason.name: reason.text for reason in found.reasons}
    assert ("base" in named) == (off > 0)
    if off:
        assert 7.0 < float(re.search(r"marks the base ([\d.]+) % .* behind the end", named["base"])[1]) < 9.0


@pytest.fixture
def stub(monkeypatch):
    """A near scene, a recording of it without pictures, and what the recording states."""
    monkeypatch.setattr(verdicts, "feature_matches", lambda *_: [])
    monkeypatch.setattr(verdicts, "health", lambda *_, **__: None)
    monkeypatch.setattr(verdicts, "blurred", lambda *_: [])
    monkeypatch.setattr(verdicts, "turned_images", lambda *_: None)
    scene = spoiling.Scene(np.random.default_rng([3, 0]), frames=60, inverse_distance_per_mm=1 / 200).take()
    stated = {key: getattr(scene, key) for key in ("kinematics", "offset_s", "readout_s", "image_size_px")}
    recording = MagicMock(folder=Path("stub"), doubts=(), robot_accuracy_mm=0.01, **stated)
    recording.__len__.return_value = 60
    return scene, recording, stated


def test_what_is_found_while_the_robot_holds_the_tool_outside_the_images_is_no_fault_of_the_recording(stub):
    scene, recording, _ = stub
    away = (scene.data.frame >= 20) & (scene.data.frame < 32)
    aside_mm = np.where(away[:, None], 40.0, 0.0) * ROBOT_FROM_MICROSCOPE.R[:, 0]
    found = assess(recording, replace(scene.data, x_mm=scene.data.x_mm + aside_mm))
    assert found.diagnosis.best is None and np.array_equal(found.data.seen.any(axis=1), ~away)


def test_turned_images_are_the_only_cause(stub, monkeypatch):
    scene, recording, _ = stub
    turned = Hypothesis("turned_images", "20 images are turned.", "Turn them back.", 20.0, 0.0, "images", 1.0, 100.0, (1,))
    monkeypatch.setattr(verdicts, "turned_images", lambda *_: turned)
    exchanged = replace(scene.data, u_left=scene.data.u_right, u_right=scene.data.u_left)  # another cause
    for data in (scene.data, exchanged):
        found = assess(recording, data)
        assert found.diagnosis.hypotheses == (turned,) and found.verdict.is_red
        assert "turned_images" in [reason.name for reason in found.verdict.reasons]


@pytest.mark.parametrize(("share", "outside", "told"), [(0.7, False, True), (0.3, False, False), (0.7, True, False)])
def test_a_landmark_that_is_hardly_ever_found_is_told(stub, share, outside, told):
    """The cameras hardly need it, but a tip that is never found has no distance."""
    scene, recording, _ = stub
    lost = (np.random.default_rng(0).random(len(scene.data)) < share) & (scene.data.landmark == 1)
    aside_mm = np.where(lost[:, None] & outside, 40.0, 0.0) * ROBOT_FROM_MICROSCOPE.R[:, 0]
    u_left, u_right = (np.where(lost[:, None], np.nan, u) for u in (scene.data.u_left, scene.data.u_right))
    data = replace(scene.data, u_left=u_left, u_right=u_right, x_mm=scene.data.x_mm + aside_mm)
    reasons = {reason.name: reason for reason in assess(recording, data).verdict.reasons}
    assert ("missed" in reasons) == told
    if told:
        assert reasons["missed"].level == LEVELS[1] and "finds tip_1 in only" in reasons["missed"].text
        assert "let the robot teach it" in reasons["missed"].cure


def test_a_lens_that_distorts_is_no_fault_where_the_cameras_have_it(stub):
    scene, recording, stated = stub
    centre = (np.array(scene.image_size_px) - 1) / 2
    far = [u - centre for u in (scene.data.u_left, scene.data.u_right)]
    left, right = (centre + d * (1 + 8e-8 * (d**2).sum(axis=1, keepdims=True)) for d in far)
    data = replace(scene.data, u_left=left, u_right=right)
    assert diagnose(data, near=True, **stated).best is not None
    assert assess(recording, data, model="zero_skew+distance+radial").diagnosis.best is None
    parked_mm = data.x_mm.copy()  # behind the cameras
    parked_mm[30] -= 500.0 * ROBOT_FROM_MICROSCOPE.R[:, 2]
    parked = assess(recording, replace(data, x_mm=parked_mm), model="zero_skew+distance+radial")
    assert np.flatnonzero(np.isnan(parked.data.x_mm[:, 0])).tolist() == [30] and parked.diagnosis.best is None


def test_no_detection_is_one_message():
    data = made(60)
    nothing = replace(data, u_right=np.full((60, 2), np.nan))
    text = r"detector failed on 60 frames: of 60 .* found 60 in left images and 0 in right"
    with pytest.raises(NoDetectionError, match=text) as error:
        calibrate(nothing)
    few = np.where(np.arange(60)[:, None] < 3, data.u_left, np.nan)
    by_hand = replace(data, u_left=few, covariance_px2=np.full((60, 2, 2, 2), np.nan))
    what = "data: 3 landmarks are labelled in left images and 60 in right .* Label ten"
    with pytest.raises(NoDetectionError, match=what) as told:
        calibrate(by_hand)
    assert "detector" not in judge(by_hand, None, error=told.value).reasons[0].cure
    verdict = judge(nothing, None, error=error.value)
    assert [reason.name for reason in verdict.reasons] == ["no_detection"] and verdict.is_red
    with pytest.raises(NoDetectionError, match="the robot reports a position for 0 of the 60 landmarks"):
        calibrate(replace(data, x_mm=np.full((60, 3), np.nan)))


def test_data_of_frames_that_the_recording_lacks_are_refused():
    recording = Recording.open(paths.SHIPPED_RECORDING)
    with pytest.raises(ValueError, match=r"data: frame 59 is not among the 34 of .*open_sky_eye"):
        assess(recording, made(60))


def test_fewer_frames_than_adapt_takes_are_not_sent_there(decoded_once):
    recording = Recording.open(paths.SHIPPED_RECORDING)
    data = of_recording(recording, recording.annotations.u_left, recording.annotations.u_right).of_frames(range(12))
    data = replace(data, covariance_px2=np.tile(4.0 * np.eye(2), (36, 2, 1, 1)), confidence=np.ones((36, 2)))
    spoilt = replace(data, u_left=data.u_left + np.random.default_rng(0).normal(0, 60, (36, 2)))
    sides = [lambda i, side=side: getattr(recording.frames[i], side) for side in ("left", "right")]
    few = replace(recording, frames=Frames(*sides, recording.frames.time_s[:12]))
    for own, expected in ((few, True), (recording, False)):
        cures = [r.cure for r in assess(own, spoilt).verdict.reasons if TRAIN_FURTHER.split("`")[0] in r.cure]
        assert cures and all(("record 17 frames or more, then let the robot teach it" in cure) == expected for cure in cures)


def test_a_scene_that_stands_still_tells_a_jump_of_the_log_from_moved_cameras(decoded_once, monkeypatch):
    recording = Recording.open(paths.SHIPPED_RECORDING)
    data = of_recording(recording, recording.annotations.u_left, recording.annotations.u_right)
    late = data.frame >= len(recording) // 2
    x_mm = data.x_mm + late[:, None] * np.array([0.5, 0.3, 0.2])
    (reason,) = (r for r in assess(recording, replace(data, x_mm=x_mm)).verdict.reasons if r.name == "robot_jumped")
    assert "Images and robot disagree at about frame 17" in reason.text and "moved" not in reason.text
    monkeypatch.setattr(Scene, "moved_px", lambda *_: np.array([60.0, 60.0]))
    names = [r.name for r in assess(recording, replace(data, x_mm=x_mm)).verdict.reasons]
    assert "camera_moved" in names and "robot_jumped" not in names


@pytest.mark.parametrize(("slip_gain", "named"), [(850.0, "tool_slipped"), (770.0, "robot_jumped")])
def test_where_the_scene_stands_still_a_slipped_tool_competes_with_a_jump_only(monkeypatch, decoded_once, slip_gain, named):
    """Sixteen numbers of cameras that did not move explain some of the detector's errors, too."""
    recording, when = Recording.open(paths.SHIPPED_RECORDING), "at about frame 20: the images shift by 33.0 px."
    monkeypatch.setattr(Scene, "moved_px", lambda *_: np.zeros(2))
    apart, together, slipped = (
        Hypothesis(name, f"It moved {when}", "Calibrate.", 33.0, 0.0, "px", 0.9, gain, (0, 1), (raw, 470.0, extra, 1.0))
        for name, raw, extra, gain in (
            ("camera_moved", 871.0, 19.0, 800.0), ("camera_moved", 796.0, 9.0, 740.0), ("tool_slipped", slip_gain, 6.0, 0.0))
    )  # fmt: skip
    found = verdicts.with_scene(Diagnosis((apart, together, slipped)), recording, np.arange(len(recording)))
    assert found.best.name == named and found.best.gain == 800.0
    assert len({h.name for h in found.hypotheses}) == len(found.hypotheses)


@pytest.mark.parametrize(("scene_px", "named"), [(0.0, "frame_order"), (20.0, "camera_moved")])
def test_a_scene_that_stands_still_clears_one_camera(decoded_once, monkeypatch, scene_px, named):
    recording = Recording.open(paths.SHIPPED_RECORDING)
    monkeypatch.setattr(Scene, "moved_px", lambda *_: np.array([60.0, scene_px]))
    moved = Hypothesis("camera_moved", "The right camera moved or zoomed at about frame 20: the images shift by 77.0 px.",
                       "Calibrate.", 77.0, 0.0, "px", explained=0.6, gain=40.0, images=(1,))  # fmt: skip
    best = verdicts.with_scene(Diagnosis((moved,)), recording, np.arange(len(recording))).best
    assert best.name == named
    assert scene_px or "The right images disagree with the robot from about frame 20: the images shift by 77" in best.text


def test_what_one_image_explains_accuses_no_detector():
    """The images of a pair then disagree, whatever the detector does."""
    apart = Health(np.arange(20), {"epipolar": np.full((20, 3), 3.0)}, np.ones((20, 3), bool))
    late = Hypothesis("frame_order", "Late.", "Pair them.", 50.0, 0.0, "%", explained=0.9, gain=100.0, images=(1,))
    for images, accused in (((1,), False), ((0, 1), True)):
        diagnosis = Diagnosis((replace(late, images=images),))
        verdict = judge(None, None, diagnosis=diagnosis, health=apart, error=DataError("no."))
        assert ("detector_unfit" in [reason.name for reason in verdict.reasons]) == accused


def test_a_scene_that_stands_still_tells_a_robot_that_drifts_from_cameras_that_do(decoded_once, monkeypatch):
    recording = Recording.open(paths.SHIPPED_RECORDING)
    data = of_recording(recording, recording.annotations.u_left, recording.annotations.u_right)
    drifting = replace(data, x_mm=data.x_mm + data.frame[:, None] / len(recording) * np.array([0.5, 0.3, 0.2]))
    (reason,) = (r for r in assess(recording, drifting).verdict.reasons if r.name == "robot_drifts")
    assert "disagree more and more, by" in reason.text and "cameras" not in reason.text
    assert "Check all frames" not in reason.cure
    some = assess(recording.showing(range(30)), drifting.of_frames(range(30))).verdict.reasons
    assert any(r.name == "robot_drifts" and r.cure.startswith("Check all frames first") for r in some)
    monkeypatch.setattr(Scene, "moved_px", lambda *_: np.array([60.0, 60.0]))
    names = [r.name for r in assess(recording, drifting).verdict.reasons]
    assert "drift" in names and "robot_drifts" not in names


@pytest.mark.parametrize(("moved_px", "told"), [
    ((0.2, 14.0, 20.0), "moves, too"), ((0.2, 1.0, 0.4), "stands still"), ((0.2, np.nan, 9.0), ""),
])  # fmt: skip
def test_a_robot_that_wanders_is_told_whether_the_scene_moves_meanwhile(decoded_once, monkeypatch, moved_px, told):
    """Between the first and the last frame nothing has to move."""
    recording = Recording.open(paths.SHIPPED_RECORDING)
    shifts = iter([*np.repeat(moved_px, 2).reshape(-1, 2), np.zeros(2)])
    monkeypatch.setattr(Scene, "moved_px", lambda *_: next(shifts))
    found = Hypothesis("robot_wanders", "It errs.", "Hold it.", 440.0, 0.0, "um", explained=0.9, gain=100.0)
    best = verdicts.with_scene(Diagnosis((found,)), recording, np.arange(len(recording))).best
    assert best.text.startswith("It errs.") and told in best.text and ("scene" in best.text) == bool(told)


@pytest.mark.parametrize("doubted", ["repeated_samples", "bursts"])
@pytest.mark.parametrize(("name", "mended"), [("time_stamps", True), ("robot_wanders", True), ("camera_moved", False)])
def test_a_log_that_repeats_its_positions_or_comes_in_bursts_is_mended_before_the_times(name, mended, doubted):
    cure = "Keep the first rows." if mended else "Do not round."
    found = Hypothesis(name, "It errs.", "Do not round.", 23.0, 1.0, "ms", explained=0.9, gain=100.0)
    doubt = Doubt(doubted, "It repeats.", "Keep the first rows.")
    verdict = judge(None, None, diagnosis=Diagnosis((found,)), error=DataError("no."), doubts=[doubt])
    assert next(reason.cure for reason in verdict.reasons if reason.name == name) == cure
