"""The online pipeline on components whose answers are known: what it does with good, bad and missing input."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lib import paths
from lib.calibration import calibrate
from lib.calibration.offsets import tool_axes
from lib.correspondences import Correspondences, of_recording, pair_with_robot
from lib.geometry import RigidTransform
from lib.landmarks import Detector, Landmarks, SharedDetector
from lib.online import STAGES, OnlinePipeline, Settings
from lib.recordings import Recording
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig
from notebooks.studies.moved_cameras import random_motion
from tests.online.world import BLACK, CENTRE_MM, DEPTH_MM, RIG, SELDOM, World, make, rig_error_mm, run, started

IMAGE = np.random.default_rng(0).integers(0, 255, BLACK.shape, dtype=np.uint8)


def test_from_nothing_to_distances():
    world = World()
    pipeline = make(world)
    results = run(pipeline, world, 40)
    assert [r.state for r in results] == ["calibrating"] * 7 + ["tracking"] * 33
    assert not any(r.failures for r in results)
    assert [r.index for r in results] == list(range(40))
    first, last = results[7], results[-1]
    assert rig_error_mm(first.rig, world) < 0.2
    assert rig_error_mm(last.rig, world) < 0.05
    assert pipeline.calibration.sigma_x_mm == pytest.approx(0.01, rel=0.25)
    assert last.reconstructed_at == last.index
    assert set(last.seconds) <= set(STAGES)
    assert min(last.seconds.values()) >= 0
    # The plane is DEPTH_MM below the focal plane; tools are above it by what their own depth says.
    view = (RIG.left.viewing_direction, ROBOT_FROM_MICROSCOPE.R[:, 2])
    depth = ROBOT_FROM_MICROSCOPE.inverse().apply(world.x_mm[world.frame])[:, 2]
    np.testing.assert_allclose(last.distance_mm * (view[0] @ view[1]), DEPTH_MM - depth, atol=0.1)
    np.testing.assert_allclose(last.x_tool_mm, world.x_mm[world.frame], atol=0.6)


def test_nothing_unusual_raises_no_alarm():
    world = World(3)
    assert all(r.motion is None for r in run(make(world, settings=SELDOM), world, 100))


@pytest.mark.parametrize("moved", ["together", "left", "right", "apart"])
def test_moved_cameras_are_noticed_and_registered(moved):
    world, pipeline, _ = started(30)
    stay = RigidTransform.identity()
    a, b = (random_motion(world.rng, centre_mm=CENTRE_MM, rotation_rad=0.05, translation_mm=0.4) for _ in range(2))
    pair = {"together": (a, a), "left": (a, stay), "right": (stay, b), "apart": (a, b)}[moved]
    world.rig = RIG.moved(*pair)
    assert rig_error_mm(pipeline.rig, world) > 0.1
    results = run(pipeline, world, 15)
    noticed = next(i for i, r in enumerate(results) if r.drift > 1)
    registered = next(i for i, r in enumerate(results) if r.motion is not None)
    assert noticed <= 2
    assert registered <= 3  # the paper: about 3 frames
    assert results[-1].state == "tracking"
    assert [r.motion for r in results if r.motion][-1].moved == moved
    assert rig_error_mm(pipeline.rig, world) < 0.12
    # A camera alone shows no shift along its own view, and what it shows becomes depth.
    assert (np.abs(results[-1].distance_mm - world.true_distance_mm()) < 4 * results[-1].distance_sd_mm).all()
    # And it goes on: the next hundred frames hold still, the next motion is noticed again.
    assert all(r.state == "tracking" for r in run(pipeline, world, 30))
    world.rig = world.rig.moved(a)
    assert any(r.motion for r in run(pipeline, world, 5))
    assert rig_error_mm(pipeline.rig, world) < 0.3


def test_the_sd_of_the_distance_is_that_of_the_surface_far_below_the_tool():
    world = World(1)
    world.depth_mm = 8.0  # the first calibration puts it 0.3 mm too deep
    last = run(make(world), world, 9)[-1]
    assert (np.abs(last.distance_mm - world.true_distance_mm()) < 3 * last.distance_sd_mm).all()
    np.testing.assert_allclose(last.normal_sd_mm, last.distance_sd_mm, rtol=0.05)  # the plane is nearly across the view


def test_changed_optics_are_calibrated_afresh():
    """No motion explains a turned zoom."""
    world, pipeline, _ = started(30)
    world.rig = reference_rig(pixels_per_mm=(150.0, 120.0))
    results = run(pipeline, world, 30)
    told = next(r.cause for r in results if "the optics changed" in r.cause)
    assert [float(word) for word in told.replace(",", " ").split() if word[0] == "1"] == pytest.approx([1.5, 1.2], abs=0.05)
    assert "calibrating" in [r.state for r in results]
    assert results[-1].state == "tracking"
    assert rig_error_mm(pipeline.rig, world) < 0.1


def test_cameras_of_a_finite_distance_are_taken_for_such_as_soon_as_that_shows():
    """And no affine ones are."""
    near, far = World(4), World(4)
    near.rig = reference_rig(inverse_distance_per_mm=1 / 190)
    results = run(pipeline := make(near, settings=SELDOM), near, 60)
    assert [r.state for r in results] == ["calibrating"] * 7 + ["tracking"] * 53
    distances_mm = np.array([r.working_distance_mm for r in results])
    assert np.isinf(distances_mm[:7]).all() and np.isfinite(distances_mm[20:]).all()
    assert distances_mm[-1] == pytest.approx(190, abs=30)
    assert pipeline.calibration.model == "near_affine" and rig_error_mm(pipeline.rig, near) < 0.05
    assert {r.working_distance_mm for r in run(make(far, settings=SELDOM), far, 60)[7:]} == {np.inf}


def test_a_given_rig_is_used_from_the_first_frame_and_kept():
    world = World()
    pipeline = make(world, rig=RIG, noise_px=1.5)
    results = run(pipeline, world, 30)
    assert results[0].state == "tracking"
    assert np.isfinite(results[0].distance_mm).all()
    assert pipeline.rig is RIG


def test_without_kinematics_the_rig_still_measures():
    world = World()
    pipeline = make(world, rig=RIG)
    world.advance()
    result = pipeline.step(*world.images)
    assert np.isfinite(result.x_tool_mm).all()
    assert np.isfinite(result.distance_mm).all()
    assert result.failures == {"calibrate": "the calibration is doubtful: no_covariance"}  # of the rig that was given


@pytest.mark.parametrize(
    ("left", "right", "kinematics"),
    [
        (IMAGE[:, :, 0], IMAGE, np.zeros((3, 3))),
        (IMAGE, IMAGE[:10], np.zeros((3, 3))),
        (IMAGE / 255.0, IMAGE / 255.0, np.zeros((3, 3))),
        (None, None, None),
        (IMAGE, IMAGE, np.zeros((2, 3))),
        (IMAGE, IMAGE, "soon"),
    ],
)
def test_bad_input_is_a_failed_frame(left, right, kinematics):
    world, pipeline, _ = started(10)
    result = pipeline.step(left, right, kinematics)
    assert set(result.failures) == {"detect"}
    assert result.state in ("blind", "unseen")
    assert result.reconstructed_at != result.index or result.state == "unseen"
    assert np.isnan(result.landmarks.u_left).all()
    assert not run(pipeline, world, 1)[0].failures


def test_missing_landmarks():
    world = World()

    def detect(images):
        found = world.detect(images)
        found.u[0, 0] = np.nan  # the left base is never seen
        found.confidence[0, 0] = 0.0
        if world.frame % 3 == 0:
            found.confidence[1, 2] = 0.01  # too unsure to count
        if world.frame % 5 == 0:
            found.u[:], found.confidence[:] = np.nan, 0.0
        return found

    tools_px = []

    def reconstruct(*images, u_landmarks, **options):
        tools_px.append(np.array(u_landmarks) - world.rig.project(world.x_mm[world.frame]))
        return world.reconstruct(*images, u_landmarks=u_landmarks, **options)

    pipeline = make(world, detector=detect, reconstruct=reconstruct)
    results = run(pipeline, world, 40)
    assert results[-1].state == "tracking"
    assert not any(r.failures for r in results)
    assert len(tools_px) > 20 and np.abs(tools_px).max() < 100  # hidden where the robot reports it
    assert np.isnan(results[30].landmarks.u_left).all()
    assert np.isfinite(results[30].distance_mm).all()  # from the robot's report
    assert results[30].reconstructed_at == 30
    assert np.isnan(results[33].landmarks.u_right[2]).all()


def test_kinematics_may_pair_each_landmark_with_its_own_instant():
    world = World()
    pipeline = make(world, rig=RIG)
    x = world.advance()
    asked = []

    def pair(u_left, u_right, *, covariance_px2, confidence, linear):
        asked.append((u_left.shape, u_right.shape, covariance_px2.shape, confidence.shape, linear))
        return pair_with_robot(
            u_left, u_right, position=lambda time_s: x[None] + 0 * time_s[..., None], time_s=[3.0], height_px=1080,
            covariance_px2=covariance_px2, confidence=confidence, frame=[77],
        )  # fmt: skip

    result = pipeline.step(*world.images, pair)
    assert asked[0][:4] == ((1, 3, 2), (1, 3, 2), (1, 3, 2, 2, 2), (1, 3, 2))
    np.testing.assert_array_equal(asked[0][4], RIG.linear)
    np.testing.assert_array_equal(result.landmarks.x_mm, x)
    np.testing.assert_array_equal(result.landmarks.time_s, 3.0)
    np.testing.assert_array_equal(result.landmarks.frame, 0)  # numbered by the pipeline


def test_landmarks_are_followed_from_frame_to_frame_and_searched_anew_after_a_failure():
    world = World()
    calls = []

    class Follower:
        def __call__(self, images):
            calls.append("whole")
            if world.frame == 3:
                raise RuntimeError("dark")
            return world.detect(images)

        def track(self, images, previous):
            assert previous.u.shape == (2, 3, 2)
            calls.append("track")
            if world.frame == 2:
                raise RuntimeError("dark")
            return world.detect(images)

    results = run(make(world, detector=Follower()), world, 6)
    assert calls == ["whole", "track", "track", "whole", "whole", "track"]
    assert ["detect" in r.failures for r in results] == [False, False, True, True, False, False]


def test_a_detector_that_takes_another_tool_looks_where_the_robot_says():
    world = World(3)
    asked = []

    class Deceived:
        def __call__(self, images):
            found = world.detect(images)
            return replace(found, u=found.u + [150.0, 90.0]) if world.frame >= 20 else found

        def near(self, images, u):
            asked.append((world.frame, u))
            return world.detect(images)

    results = run(make(world, detector=Deceived(), settings=SELDOM), world, 30)
    assert all(r.state == "tracking" for r in results[8:])
    assert [frame for frame, _ in asked] == list(range(20, 30))
    told = np.stack(world.rig.project(world.x_mm[29]))
    assert np.abs(asked[-1][1] - told).max() < 15 and np.abs(results[-1].landmarks.u_left - told[0]).max() < 6


@pytest.mark.parametrize("finds", [True, False])
def test_the_difference_from_the_ground_is_searched_only_if_the_image_shows_nothing_near_the_robot(monkeypatch, finds):
    """The difference takes longer than all else that the detector does."""
    world, differences = World(3), []
    monkeypatch.setattr("lib.online.pipeline.levelled", lambda image, ground: differences.append(world.frame) or image)

    class Losing(SharedDetector):
        def __call__(self, images, *, ground=None):
            return world.detect(images) if world.frame < 20 else Landmarks.none(2)

        def near(self, images, u):
            return world.detect(images) if finds or world.frame in differences else Landmarks.none(2)

    results = run(make(world, detector=Losing(world.detect), settings=SELDOM), world, 30)
    assert all(r.state == "tracking" for r in results[8:])
    assert sorted(set(differences)) == ([] if finds else list(range(20, 30)))


def test_a_push_is_noticed_by_the_detector_that_ships():
    """The search near the robot's landmarks, which are wrong after a push, must not draw the detections there."""
    source = Recording.open(paths.SHIPPED_RECORDING)
    pipeline, results = OnlinePipeline(Detector.load(), rig=source.truth.rig, settings=SELDOM), []
    for i, shift_px in enumerate([0.0] * 3 + [34.0] * 4):
        move = np.array([[1.0, 0.0, 0.8 * shift_px], [0.0, 1.0, -0.6 * shift_px]])
        sides = [getattr(source.frames[i], side) for side in ("left", "right")]
        images = [cv2.warpAffine(image, move, image.shape[1::-1], borderMode=cv2.BORDER_REFLECT) for image in sides]
        results.append(pipeline.step(*images, partial(of_recording, source, frames=[i]), time_s=source.frames.time_s[i]))
        error_px = np.linalg.norm(results[-1].landmarks.u_left - source.truth.u_left[i] - move[:, 2], axis=1)
        assert np.nanmax(error_px) < 5
    assert [result.state for result in results[:5]] == ["tracking"] * 3 + ["moved"] * 2
    assert results[-1].state == "tracking" and results[-1].motion is not None


def test_where_the_robot_says_allows_for_the_landmarks_offsets():
    """The detector marks the base 0.2 mm, 20 px, beside where the robot reports it, and loses the tool in the end."""
    world, asked = World(2), []
    told = world.x_mm.copy()
    world.x_mm[:, 0] += np.einsum("nij,j->ni", tool_axes(world.x_mm), [0.2, 0.0, 0.0])

    class Losing:
        def __call__(self, images):
            found = world.detect(images)
            return Landmarks.none(2) if world.frame >= 30 else found

        def near(self, images, u):
            asked.append(u)
            return world.detect(images)

    pipeline = make(world, detector=Losing(), settings=SELDOM)
    for i in range(31):
        world.advance()
        pipeline.step(*world.images, told[i] + world.rng.normal(0, 0.01, (3, 3)))
    assert np.abs(asked[-1] - np.stack(world.rig.project(world.x_mm[30]))).max() < 6


def test_what_was_seen_becomes_the_ground_until_the_cameras_move():
    world, known = World(), []

    class Looking(SharedDetector):
        def __call__(self, images, *, ground=None):
            known.append(ground and ground.key)
            return world.detect(images)

    pipeline = make(world, detector=Looking(world.detect), rig=RIG, settings=SELDOM)
    run(pipeline, world, 30)
    assert known[:5] == [None] * 5 and None not in known[5:]
    world.rig = RIG.moved(random_motion(world.rng, centre_mm=CENTRE_MM, rotation_rad=0.05, translation_mm=0.4))
    results = run(pipeline, world, 30)
    moved = next(k for k, result in enumerate(results) if result.motion is not None)
    assert known[30 + moved] is not None and known[31 + moved] is None


def test_the_detectors_covariances_reach_calibration_and_drift():
    """One landmark is seen 8 times less well, and the detector says so: its large residuals raise no alarm."""
    world = World(1)

    def detect(images):
        found = world.detect(images)
        found.u[:, 1] += world.rng.normal(0, 8.0, (2, 2))
        found.covariance[:, 1] += 64.0 * np.eye(2)
        return found

    pipeline = make(world, detector=detect, settings=SELDOM)
    results = run(pipeline, world, 40)
    variance = pipeline.calibration.covariance_px2[:, 0, 0].reshape(-1, 3)
    np.testing.assert_allclose(variance, np.tile([1.0, 65.0, 1.0], (len(variance), 1)))
    assert all(r.motion is None for r in results)
    assert rig_error_mm(pipeline.rig, world) < 0.08


def test_landmark_offsets_are_learnt_and_raise_no_alarm():
    """The detector marks the base 0.06 mm beside where the robot reports it."""
    world = World(2)
    told = world.x_mm.copy()
    axes = tool_axes(world.x_mm)
    world.x_mm[:, 0] += np.einsum("nij,j->ni", axes, [0.06, 0.0, 0.0])
    pipeline = make(world, settings=SELDOM)
    results = []
    for i in range(60):
        world.advance()
        results.append(pipeline.step(*world.images, told[i] + world.rng.normal(0, 0.01, (3, 3))))
    assert abs(pipeline.calibration.offsets.offset[0, 0] - 0.06) < 0.02
    assert all(r.motion is None for r in results)
    assert all(r.state == "tracking" for r in results[10:])


def test_distances_are_those_of_the_tool_and_not_of_the_robots_report():
    """The robot reports each landmark 0.2 mm beside where it is, which a detector's own error hardly explains."""
    world = World(2)
    told = world.x_mm - np.einsum("nij,kj->nki", tool_axes(world.x_mm), [[0.2, 0.0, 0.05], [0.2, 0.0, 0.1], [0.2, 0.0, 0.1]])
    pipeline, error_mm, sd_mm = make(world, settings=SELDOM), [], []
    for i in range(60):
        world.advance()
        result = pipeline.step(*world.images, told[i] + world.rng.normal(0, 0.01, (3, 3)))
        error_mm.append(result.distance_mm - world.true_distance_mm())
        sd_mm.append(result.distance_sd_mm)
    assert np.abs(np.mean(error_mm[30:], axis=0)).max() < 0.04
    assert (np.abs(error_mm[30:]) < 3.5 * np.array(sd_mm[30:])).all() and np.max(sd_mm[30:]) < 0.1


@pytest.mark.parametrize("shut", [0, 65], ids=["now and then", "for long"])
def test_jaws_that_the_robot_reports_crossed_raise_no_alarm(shut):
    """Its tips are 0.15 mm off, so it reports shut jaws crossed; the frames before tell which tip is which."""
    world, n = World(4), 45 + shut
    t = np.arange(n) / 10
    offset = np.array([[0.02, -0.15, 0.0], [-0.05, -0.15, 0.04], [0.05, 0.15, -0.03]])
    tool = np.zeros((n, 3, 3))
    tool[:, 1:, 0], tool[:, 2, 1] = 3.0, 0.3 + 0.2 * np.sin(2.1 * t)
    tool[45:, 2, 1] = np.maximum(np.linspace(0.5, 0.1, 10)[np.minimum(np.arange(shut), 9)], 0.1)
    tool[:, 1, 1] = -tool[:, 2, 1]
    turn = np.sin(np.outer(t, [0.9, 1.3, 0.7])) * [0.5, 0.3, 0.6]
    turn[45:, 0] = turn[44, 0]  # what shut jaws do not tell
    R = Rotation.from_rotvec(turn).as_matrix() @ ROBOT_FROM_MICROSCOPE.R
    place = CENTRE_MM + np.sin(np.outer(t, [0.8, 1.1, 1.7])) * [4.0, 2.0, 1.0]
    world.x_mm, reported = tool @ R.mT + place[:, None], (tool - offset) @ R.mT + place[:, None]
    assert ((reported[:, 2] - reported[:, 1]) * R[:, :, 1]).sum(axis=1).min() < -0.05
    frame, landmark = np.divmod(np.arange(3 * n), 3)
    u = (world.rng.normal(p, 1.0) for p in RIG.project(world.x_mm.reshape(-1, 3)))
    told = world.rng.normal(reported, 0.01)
    wrong = 48 if shut else n
    told[wrong : wrong + 1, 2] += 20.0  # one report: jaws cannot be that wide
    seen = Correspondences.of_points(told.reshape(-1, 3), *u, frame=frame, landmark=landmark)
    learnt = calibrate(seen.subset(frame < 45))
    assert learnt.offsets.turns
    pipeline, results = make(world, rig=learnt, settings=SELDOM), []
    for x in told:
        world.advance()
        results.append(pipeline.step(*world.images, x))
        if len(results) != wrong + 1:
            error_mm = np.abs(results[-1].distance_mm - world.true_distance_mm())
            assert (error_mm < 4 * results[-1].distance_sd_mm).all()
    assert all(r.motion is None for r in results)
    assert {i for i, r in enumerate(results) if r.state != "tracking"} <= {wrong}


def test_after_the_last_calibration_each_frame_improves_it():
    world = World(1)
    calls = []

    def counted(data, **options):
        calls.append(len(np.unique(data.frame)))
        return calibrate(data, offsets=False, **options)

    pipeline = make(world, calibrate=counted, settings=Settings(surface_every=1000, calibration_frames=(8, 12)))
    run(pipeline, world, 14)
    early = rig_error_mm(pipeline.rig, world)
    results = run(pipeline, world, 150)
    assert calls[0] == 8
    assert len(calls) == 2
    assert rig_error_mm(pipeline.rig, world) < 0.6 * early
    assert all(r.state == "tracking" for r in results)
    assert "calibrate" in results[-1].seconds


def test_one_bad_frame_does_not_block_the_calibration_for_good():
    world = World()

    def refuse(data, **options):
        if 0 in data.frame:
            raise ValueError("x_mm: the robot stood at 99999 mm.")
        return calibrate(data, **options)

    results = run(make(world, calibrate=refuse, settings=SELDOM), world, 20)
    assert "99999" in results[7].failures["calibrate"]
    assert results[-1].state == "tracking"


def test_nan_kinematics():
    world = World()
    pipeline = make(world)
    for i in range(40):
        x = world.advance()
        x[i % 3] = np.nan
        result = pipeline.step(*world.images, x)
        assert not result.failures
    assert result.state == "tracking"
    assert np.isfinite(result.distance_mm).all()  # the missing one is taken from the triangulated landmark


def test_a_calibration_that_is_refused_is_tried_again():
    world = World()

    def refuse_at_first(data, **options):
        if len(data) < 12 * 3:
            raise ValueError("x_mm: coplanar. Move the tool in depth.")
        return calibrate(data, **options)

    results = run(make(world, calibrate=refuse_at_first), world, 14)
    assert [r.state for r in results] == ["calibrating"] * 11 + ["tracking"] * 3
    assert "Move the tool in depth" in results[10].failures["calibrate"]
    assert not results[11].failures


@pytest.mark.parametrize("stage", ["detect", "calibrate", "match", "surface", "distance"])
def test_a_failing_stage_is_named_and_the_others_go_on(stage):
    world = World()

    def fail(*args, **kwargs):
        raise RuntimeError("out of order")

    def fail_while_fitting(*args, seconds, **kwargs):
        seconds |= {"mask": 0.0, "match": 0.0, "triangulate": 0.0, "surface": 0.0}
        fail()

    def without_distance(*args, **kwargs):
        found = world.reconstruct(*args, **kwargs)
        found.surface.distance = fail
        return found

    broken = {
        "detect": {"detector": fail},
        "calibrate": {"calibrate": fail},
        "match": {"reconstruct": fail},
        "surface": {"reconstruct": fail_while_fitting},
        "distance": {"reconstruct": without_distance},
    }[stage]
    result = run(make(world, **broken), world, 12)[-1]
    assert result.failures == {stage: "RuntimeError: out of order"}
    assert result.state == ("calibrating" if stage in ("detect", "calibrate") else "tracking")
    assert (result.reconstructed_at == result.index) == (stage == "distance")


def test_interrupts_are_not_swallowed():
    world = World()

    def interrupted(images):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(make(world, detector=interrupted), world, 1)


def test_a_calibration_may_be_given():
    world, learning, _ = started(20)
    pipeline = make(world, rig=learning.calibration)
    results = run(pipeline, world, 20)
    assert all(r.state == "tracking" and not r.failures for r in results)
    assert pipeline.rig is learning.calibration.rig


def test_surface_every_other_frame():
    world = World()
    results = run(make(world, rig=RIG, settings=Settings(surface_every=2)), world, 4)
    assert ["match" in r.seconds for r in results] == [True, False, True, False]
    assert np.isfinite(results[1].distance_mm).all()


def test_bad_settings():
    with pytest.raises(ValueError, match="registration_frames"):
        Settings(registration_frames=(1, 5))
    with pytest.raises(ValueError, match="surface_every"):
        Settings(surface_every=0)
