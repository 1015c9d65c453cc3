"""Every fault is named, with its size; what is right is left in peace."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lib import paths
from lib.calibration import calibrate
from lib.correspondences import Correspondences
from lib.geometry import RigidTransform
from lib.recordings import Kinematics, Recording
from lib.simulator import Microscope
from lib.simulator.rig import ROBOT_FROM_MICROSCOPE, reference_rig
from lib.trust import Hypothesis, diagnose
from lib.trust.diagnosis import stated
from notebooks.studies.spoiling import GOOD, SPOILED, Scene, takes


def take(way="", strength="", seed=7, **options):
    scene = Scene(np.random.default_rng(seed), **{"frames": 40, "fps": 15.0, "speed_mm_s": 6.0} | options)
    causes, spoil = SPOILED[way, strength] if way else ((), lambda scene: None)
    spoil(scene)
    return scene.take(way, strength, causes)


def found(take, *, log=True):
    return diagnose(
        take.data, kinematics=take.kinematics if log else None, offset_s=take.offset_s, readout_s=take.readout_s,
        image_size_px=take.image_size_px,
    )  # fmt: skip


@pytest.mark.parametrize("name", ["12 frames", "correlated 0.5, heavy tails"])
def test_a_good_recording_has_no_fault(name):
    assert found(take(**GOOD[name])).best is None


def zoomed_from_frame_20(factor):
    scene = take()
    data, centre = scene.data, (np.array(scene.image_size_px) - 1) / 2
    zoom = np.where(data.frame >= 20, factor, 1.0)[:, None]
    left, right = (centre + zoom * (u - centre) for u in (data.u_left, data.u_right))
    return found(replace(scene, data=replace(data, u_left=left, u_right=right))).best


def test_a_zoom_in_the_middle_is_not_said_to_be_a_move_that_one_can_follow():
    best = zoomed_from_frame_20(1.03)
    assert best.name == "camera_moved" and "zoomed at about frame 20" in best.text and "no zoom" in best.cure


def test_frames_that_may_belong_to_either_side_of_a_small_zoom_are_left_out():
    best = zoomed_from_frame_20(1.018)
    first, last = map(int, re.search(r"at about frame \d+ \((\d+) to (\d+)\)", best.text).groups())
    assert first < last and first <= 20 <= last
    assert f"(--frames 0:{first}, --frames {last}:40)" in best.cure


def test_a_microscope_that_moves_as_a_whole_needs_six_numbers():
    spoiled = take("camera moved", "0.3 degrees", seed=8)
    first, second = [h for h in found(spoiled).hypotheses if h.name == "camera_moved" and len(h.images) == 2]
    assert "moved together" in first.text and "moved or zoomed" in second.text
    assert first.gain > second.gain + 20 and found(spoiled).best == first


@pytest.mark.parametrize("name", ["setting", "judging"])
def test_a_spike_in_the_log_is_no_fault_of_the_frames(name):
    (spike,) = takes(name, only="a spike")
    assert found(spike).best is None


@pytest.mark.parametrize(
    ("way", "strength", "value"),
    [
        ("read-out time left at 0", "20 ms", 20.0),
        ("tips exchanged", "half of the frames", None), ("z scaled", "2.0", 2.0), ("rigid tips", "1.0 mm", None),
        ("axis mirrored", "z", None), ("eyes exchanged", "", None), ("frames all the same", "", 100.0),
        ("both images mirrored", "and the tips exchanged", 100.0), ("finite distance", "150 mm", 1 / 150),
        ("landmark offset", "1.0 mm", 1000.0), ("bad stretch", "40.0 px", None),
        ("robot noise", "100 um", None), ("camera moved", "1.0 degrees", None), ("detector partly wrong", "50 %", None),
        ("kinematics frozen", "25 %", 24.0), ("left camera late", "40 ms", -40.0),
        ("tips too near or far apart", "0.5", 2.0), ("lens distorts", "10 %", 10.0), ("spikes in the log", "10 %", None),
        ("one camera repeats frames", "left, 30 %", None), ("tool slips", "0.5 mm", 500.0),
        ("cameras change steadily", "10 %, -5.0 degrees", None), ("log of another recording", "", None),
        ("left image sways", "4 px, each frame", 4.0 * np.sqrt(2)), ("microscope sways", "6 px, each frame", None),
        ("left lens breathes", "2 %", 1.4), ("robot has backlash", "0.1 mm", None),
        ("frames stamped apart", "20 ms", None), ("eyes exchanged later", "", None),
        ("tool length not set", "12 mm", 12000.0), ("tool length not set", "25 mm", 25000.0),
    ],
)  # fmt: skip
def test_a_fault_is_named_with_its_size_and_its_cure(way, strength, value):
    spoiled = take(way, strength)
    best = found(spoiled).best
    assert best is not None and best.name in spoiled.causes
    assert best.gain > 12 and 0 < best.explained <= 1 and best.text.endswith(".") and best.cure.endswith(".")
    if value is not None:
        assert best.value == pytest.approx(value, abs=max(4 * best.sd, 0.1 * abs(value)))


def with_log_off(usual, off_mm):
    """The take with a log that lies `off_mm` (m, 3) beside the tool, and the rows that follow from it."""
    log = Kinematics(usual.kinematics.time_s, usual.kinematics.x_mm + off_mm[:, None])
    x_mm = log.at(usual.data.time_s + usual.offset_s)[np.arange(len(usual.data)), usual.data.landmark]
    return replace(usual, kinematics=log, data=replace(usual.data, x_mm=x_mm))


@pytest.mark.parametrize("size_mm", [0.1, 0.4])
def test_a_robot_that_errs_slowly_is_told_from_one_that_errs_from_frame_to_frame(size_mm):
    """The pivot of the shaft moves with the eye."""
    usual = take(frames=60)
    phase = 2 * np.pi * (usual.kinematics.time_s - usual.kinematics.time_s[0])[:, None] / [3.1, 2.3, 4.4]
    off_mm = size_mm * np.sin(phase + [0.0, 1.0, 2.0])
    best = found(with_log_off(usual, off_mm)).best
    assert best.name == "robot_wanders" and 0.3 * size_mm < 1e-3 * best.value < 2 * size_mm  # cameras absorb a part
    assert f"differ by {1e-3 * best.value:.2g} mm (RMS), equally for all landmarks" in best.text and "eye roll" in best.cure


@pytest.mark.parametrize("size_mm", [0.08, 0.2])
def test_backlash_along_the_shaft_is_named(size_mm):
    usual = take(frames=60)
    base, tips = usual.kinematics.x_mm[:, 0], usual.kinematics.x_mm[:, 1:].mean(axis=1)
    shaft = (tips - base) / np.linalg.norm(tips - base, axis=1, keepdims=True)
    forwards = np.sign((np.gradient(base, axis=0) * shaft).sum(axis=1, keepdims=True))
    best = found(with_log_off(usual, -size_mm / 2 * forwards * shaft)).best
    assert best.name == "backlash" and "um along the shaft" in best.text
    assert best.value == pytest.approx(1e3 * size_mm, abs=4 * best.sd)


@pytest.mark.parametrize(("seed", "frames"), [(2, 18), (8, 24)])
def test_the_curvature_of_a_near_microscope_accuses_nobody_else(seed, frames):
    """Few frames and many wrong landmarks hide a working distance, which skews the pixels of affine cameras."""
    options = {"frames": frames, "noise_px": 0.7, "inverse_distance_per_mm": 1 / 160, "outliers": 0.25}
    scene = Scene(np.random.default_rng([6, seed]), fps=10.0, speed_mm_s=4.0, **options)
    best = found(scene.take()).best
    assert best is None or best.name in ("finite_distance", "detector_unfit")


def test_rows_that_err_alike_for_a_while_accuse_no_axis_of_the_robot():
    rng, options = np.random.default_rng([77, 3, 0, 30, 5, 7]), {"outliers": 0.05, "memory": 0.7}
    best = found(Scene(rng, frames=30, fps=15.0, speed_mm_s=4.0, **options).take(), log=False).best
    assert best is None or best.name == "finite_distance"


def test_a_bend_has_the_size_by_which_the_tips_are_seen_to_move_and_is_no_finite_distance():
    bent = take("tool bends", "3 %", frames=100)
    diagnosis, x = found(bent), bent.data.x_mm[bent.data.landmark > 0]
    best = diagnosis.best
    assert not any(h.is_named for h in diagnosis.hypotheses if h.name == "finite_distance")
    lag_mm = 0.03 / 0.97 * (x - np.nanmean(x, axis=0))
    moved_px = np.sqrt(np.nanmean([((lag_mm @ A.T) ** 2).sum(axis=1) for A in bent.rigs[0].linear.reshape(2, 2, 3)]))
    assert best.name == "tool_bends" and best.value == pytest.approx(moved_px, rel=0.25)


def test_a_turned_image_is_no_wrong_readout_time():
    """Its rows are read from the bottom up; a camera takes up the turn, and the shutter alone tells."""
    scene = Scene(np.random.default_rng(7), frames=40, fps=15.0, speed_mm_s=6.0, readout_s=0.02)
    corner = np.array(scene.take().image_size_px) - 1.0
    scene.edit_pixels.append(lambda scene, u: np.stack([u[:, :, 0], corner - u[:, :, 1]], axis=2))
    best = found(scene.take()).best
    assert best.name == "turned_image" and best.value == pytest.approx(-20.0, abs=4 * best.sd)
    assert "The right image is turned by 180 degrees" in best.text and "Turn it by 180 degrees" in best.cure
    assert best.images == (1,)


@pytest.mark.parametrize("readout_s", [0.0, 0.02])
def test_two_turned_images_are_not_only_called_exchanged_eyes(readout_s):
    """Left then stands on the right.  The shutter tells, where there is one."""
    scene = Scene(np.random.default_rng(7), frames=40, fps=15.0, speed_mm_s=6.0, readout_s=readout_s)
    corner = np.array(scene.take().image_size_px) - 1.0
    scene.edit_pixels.append(lambda scene, u: corner - u)
    best = found(scene.take()).best
    assert best.name == ("turned_image" if readout_s else "exchanged_eyes")
    assert "turned by 180 degrees" in best.text and "turn" in best.cure.lower()
    assert best.images == (0, 1)


def test_no_cause_is_told_by_its_words(monkeypatch):
    """They may be said in any language; two turned images, which exchange the sides, are no mirrored axis either."""
    scene = Scene(np.random.default_rng(7), frames=40, fps=15.0, speed_mm_s=6.0, readout_s=0.02)
    corner = np.array(scene.take().image_size_px) - 1.0
    scene.edit_pixels.append(lambda scene, u: corner - u)
    both = scene.take()
    usual, said = found(both), Hypothesis.__init__

    def untold(self, name, text, *more, **known):
        said(self, name, "...", *more, **known)

    monkeypatch.setattr(Hypothesis, "__init__", untold)
    other = found(both)
    assert [(h.name, h.gain) for h in other.hypotheses] == [(h.name, h.gain) for h in usual.hypotheses]


@pytest.mark.parametrize(
    ("axis", "scale", "seed"),
    [("x", 1.05, 0), ("x", 1.05, 1), ("x", 0.9, 2), ("x", 0.9, 3), ("y", 1.1, 0), ("z", 1.1, 0), ("z", 0.9, 1)],
)
def test_an_axis_that_cameras_absorb_is_told_by_the_jaws(axis, scale, seed):
    """Jaws are as long wherever they point.  Across the view pixels tell too, but not whether x or y is scaled."""
    scene = Scene(np.random.default_rng(seed), frames=20, fps=3.0)
    scene.edit_report.append(lambda scene, t, x: x * np.where(np.array(list("xyz")) == axis, scale, 1.0))
    best = found(scene.take()).best
    assert best.name == "scaled_axis" and best.value == pytest.approx(scale, abs=0.01)
    assert "jaw lengths" in best.text and f"robot's {axis} were" in best.text
    assert best.cure.startswith(f"Check the units and the scale of the {axis} columns")
    assert best.explained > 0.5


def _slow(scene, t, x):
    """A robot that errs by 10 um for seconds on end."""
    knots = np.linspace(t[0], t[-1], 4)
    return x + 0.01 * np.stack([np.interp(t, knots, e) for e in scene.rng.normal(size=(9, 4))], axis=1).reshape(x.shape)


def _longer(scene, t, x):
    """Jaws whose pivots lie ahead of the base: they are the longer, the more they open."""
    opening = np.linalg.norm(x[:, 2] - x[:, 1], axis=1)[:, None, None]
    return x[:, :1] + (x - x[:, :1]) * (1 + 0.1 * opening)


def _sliding(scene, t, x):
    return x[:, :1] + (x - x[:, :1]) * (1 + 0.05 * np.sin(1.7 * t))[:, None, None]


def _displaced(scene, t, x):
    return x + np.array([[0.0, 0.0, 0.2], [0, 0, 0], [0, 0, 0]])


def _straight(scene, t, x):
    """A tool that does not turn."""
    return _slow(scene, t, x.mean(axis=1, keepdims=True) + (x - x.mean(axis=1, keepdims=True)).mean(axis=0))


def _bent(share):
    return lambda scene, t, x: np.concatenate([x[:, :1], x[:, 1:] - share * (x[:, 1:] - x.mean(axis=(0, 1)))], axis=1)


@pytest.mark.parametrize("edit", [_slow, _longer, _sliding, _displaced, _straight, _bent(0.03), _bent(0.1)])
def test_jaws_of_other_lengths_accuse_no_axis(edit):
    scene = Scene(np.random.default_rng(0), frames=20, fps=3.0)
    scene.edit_report.append(edit)
    axes = [h for h in found(scene.take()).hypotheses if h.name == "scaled_axis"]
    assert not any("jaw lengths" in h.text for h in axes)


def test_a_mirrored_image_is_no_scaled_axis():
    """Its optics are judged by the cameras that fit once its tips are exchanged, as the detector does in a mirror."""
    scene = Scene(np.random.default_rng(7), frames=40, fps=15.0, speed_mm_s=6.0)
    width = scene.take().image_size_px[0]
    scene.edit_pixels.append(
        lambda scene, u: np.stack([[width - 1, 0] + u[:, [0, 2, 1], 0] * [-1, 1], u[:, :, 1]], axis=2)
    )  # fmt: skip
    best = found(scene.take()).best
    assert best.name == "tip_order" and "What the left image calls" in best.text
    assert best.cure.endswith("If that image is mirrored, flip it instead.")


def test_an_image_that_one_camera_lost_is_named():
    """From the middle on its images come one frame early."""
    usual = take(frames=60)
    u_right = usual.data.grid("u_right")
    u_right[30:-1] = u_right[31:]
    best = found(replace(usual, data=replace(usual.data, u_right=u_right.reshape(-1, 2)))).best
    assert best.name == "frame_order" and "of the right images" in best.text and "+67 ms from those stated" in best.text


@pytest.mark.parametrize("side", ["left", "right"])
def test_images_of_another_recording_in_one_eye_are_told_from_an_unfit_detector(side):
    usual, other = take(frames=60), take(frames=60, seed=5)
    assert not np.allclose(usual.data.u_left, other.data.u_left, atol=50.0)
    data = replace(usual.data, **{f"u_{side}": getattr(other.data, f"u_{side}")})
    best = found(replace(usual, data=data)).best
    assert best.name == "one_eye_unfit" and best.images == (("left", "right").index(side),)
    assert best.text.startswith(f"In the {side} images") and f"Are the {side} images of this recording" in best.cure


@pytest.mark.parametrize(("share", "told"), [(0.45, True), (0.2, False)])
def test_a_base_that_is_often_marked_elsewhere_is_told(share, told):
    """At a ring on the shaft, 28 % of the tool's length behind its end.  The cameras hardly suffer from it."""
    usual = take(frames=60)
    u_left, u_right = usual.data.grid("u_left"), usual.data.grid("u_right")
    for u in (u_left, u_right):
        elsewhere = np.random.default_rng(0).random(60) < share
        u[elsewhere, 0] -= 0.28 * (u[:, 1:].mean(axis=1) - u[:, 0])[elsewhere]
    marked = replace(usual.data, u_left=u_left.reshape(-1, 2), u_right=u_right.reshape(-1, 2))
    best = found(replace(usual, data=marked)).best
    assert told == (best is not None and best.name == "detector_unfit" and "of the detections of base lie" in best.text)


def test_the_cure_of_a_lens_that_distorts_mends_it():
    spoiled = take("lens distorts", "10 %")
    model = re.search(r"--model (\S+)`", found(spoiled).best.cure)[1]
    calibration = calibrate(spoiled.data, model=model, image_size_px=spoiled.image_size_px)
    error_mm = calibration.pair.triangulate(*spoiled.rigs[0].project(spoiled.points_mm)).x_mm - spoiled.points_mm
    covariance = calibration.point_covariance(spoiled.points_mm, detection=False)
    assert (error_mm**2).sum() < 4 * np.trace(covariance, axis1=1, axis2=2).sum()


@pytest.mark.parametrize("name", ["images squeezed by 3 %", "left image squeezed by 7 %"])
def test_squeezed_images_accuse_no_axis(name):
    assert found(take(**GOOD[name], seed=1)).best is None


def test_oblong_pixels_that_an_axis_explains_as_well_name_both():
    """The robot's axes lie along those of the images, and rows without jaws tell nothing of an axis."""
    rng = np.random.default_rng(0)
    rig = Microscope(image_rotation_rad=(0.0, 0.0)).rig(RigidTransform.identity())
    x = rng.uniform(-4, 4, (90, 3))
    u = [(v + rng.normal(0, 0.5, v.shape)) * [0.8, 1.0] for v in rig.project(x)]
    best = diagnose(Correspondences.of_points(x, *u)).best
    assert best.name == "scaled_axis" and "images were resized" in best.text and best.explained < 0.5


def test_frames_that_are_lost_now_and_then_are_no_clock():
    lost, usual = np.array([10, 11, 30, 31, 32]), take(frames=60)
    kept = np.setdiff1d(np.arange(60), lost)
    rows = usual.data.of_frames(kept)
    late = rows.time_s + (np.searchsorted(kept, rows.frame) - rows.frame) / 15.0  # as if none were
    x = usual.kinematics.at(late)[np.arange(len(late)), rows.landmark]
    best = found(replace(usual, data=replace(rows, time_s=late, x_mm=x))).best
    assert best.name == "frame_order" and "lost ones" in best.cure


def test_frames_in_gaps_of_the_log_are_not_said_to_be_of_other_instants():
    """One frame is of another instant.  Those in gaps have interpolated positions, and no path to search along."""
    usual = take(frames=60)
    starts = usual.data.time_s[np.searchsorted(usual.data.frame, [8, 17, 26, 35, 44])] - 0.04
    log, rows = usual.kinematics, usual.data
    in_gap = ((log.time_s > starts[:, None]) & (log.time_s < starts[:, None] + 0.16)).any(axis=0)
    x = log.at(rows.time_s + 3 / 15)[np.arange(len(rows)), rows.landmark]
    rows = replace(rows, x_mm=np.where((rows.frame == 12)[:, None], x, rows.x_mm))
    best = found(replace(usual, data=rows, kinematics=Kinematics(log.time_s[~in_gap], log.x_mm[~in_gap]))).best
    assert best is None


@pytest.mark.parametrize(("jump_s", "wrong"), [(0.3, 0.0), (-0.23, 0.0), (0.02, 0.0), (0.1, 0.25)])
def test_a_clock_that_jumps_is_named_with_its_cure(jump_s, wrong):
    """The frames from 20 on carry times that are `jump_s` too early; a share of the detections is wrong."""
    usual, rng = take(), np.random.default_rng(0)
    rows = usual.data
    stated_s = rows.time_s - jump_s * (rows.frame >= 20)
    x = usual.kinematics.at(stated_s)[np.arange(len(rows)), rows.landmark]
    u_left = rows.u_left + (rng.random((len(rows), 1)) < wrong) * rng.normal(0, 100, rows.u_left.shape)
    jumped = replace(usual, data=replace(rows, time_s=stated_s, x_mm=x, u_left=u_left))
    best = found(jumped).best
    assert best.name == "frame_order" and best.text.startswith("From frame 20 on, the images show the tool ")
    assert 1e-3 * best.value == pytest.approx(jump_s, abs=2e-3)
    cure, where = re.search(r"Add (\S+) s to (time_s in kinematics.csv from|the times from frame 20 on)", best.cure).groups()
    assert float(cure) == pytest.approx(abs(jump_s), abs=2e-3) and ("kinematics" in where) == (jump_s < 0)


def test_clocks_of_different_rates_are_not_said_to_differ_by_a_constant():
    """In the middle they differ by 80 ms, which alone explains most of the residuals."""
    usual = take(frames=40, fps=2.5)
    rows = usual.data
    stated_s = rows.time_s / 1.01
    x = usual.kinematics.at(stated_s)[np.arange(len(rows)), rows.landmark]
    best = found(replace(usual, data=replace(rows, time_s=stated_s, x_mm=x))).best
    assert best.name == "clock_rate" and best.value == pytest.approx(1.01, abs=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_where_a_detector_marks_what_stands_still_time_does_not(seed):
    """At a rate of almost nothing all frames would show one instant, and any cameras would fit."""
    usual = take(frames=40, seed=seed)
    still = usual.data.u_left[:3], usual.data.u_right[:3]
    rng = np.random.default_rng(seed)
    left, right = (np.tile(u, (40, 1)) + rng.normal(0, 2.0, (120, 2)) for u in still)
    hypotheses = found(replace(usual, data=replace(usual.data, u_left=left, u_right=right))).hypotheses
    assert all(0.3 < abs(one.value) < 2.5 for one in hypotheses if one.name == "clock_rate")


def test_a_small_error_of_the_frame_rate_is_named():
    best = found(take(rate=1.02, frames=60)).best
    assert best.name == "clock_rate" and best.value == pytest.approx(1 / 1.02, abs=1e-3)
    assert "In one second of the video's time 0.98" in best.text
    assert re.search(r"Multiply fps in recording\.toml by 1\.0[12]\d{4}, or", best.cure)


def test_a_wrong_rate_is_corrected_where_the_times_are_read(tmp_path):
    """`fps` has no effect in a recording with frames.csv, as `stated` says."""
    own = tmp_path / "own"
    own.mkdir()
    (own / "frames.csv").touch()
    recording = Recording.open(paths.SHIPPED_RECORDING)
    assert [stated(replace(recording, folder=folder))["own_times"] for folder in (own, tmp_path)] == [True, False]
    scene = take(rate=1.02, frames=60)
    best = diagnose(scene.data, kinematics=scene.kinematics, offset_s=scene.offset_s, own_times=True).best
    assert best.name == "clock_rate" and re.match(r"Multiply time_s in frames\.csv by 0\.98\d{4}, or", best.cure)
    assert "fps" not in best.cure


@pytest.mark.parametrize("ppm", [0, 50, 200])
def test_a_slow_drift_of_the_clock_is_named_in_a_long_recording(ppm):
    best = found(take(rate=1.0 + 1e-6 * ppm, frames=60, fps=0.05)).best
    if not ppm:
        assert best is None
    else:
        assert best.name == "clock_rate" and best.value == pytest.approx(1.0 - 1e-6 * ppm, abs=1e-6)
        assert f"time 0.999{1000 - ppm} +- " in best.text and f"fps in recording.toml by 1.000{ppm:03}" in best.cure


@pytest.mark.parametrize("options", [{}, {"robot_mm": 0.015}, {"noise_px": 0.6}])
def test_jaws_of_a_constant_opening_accuse_nobody(options):
    assert found(take(seed=1, frames=90, opening_mm=(1.0, 1.0001), **options)).best is None


def _shutting(scene, t, x):
    """The opening as an encoder counts it that runs the other way."""
    across = x[:, 2] - x[:, 1]
    across *= 0.5 * (1.7 / np.linalg.norm(across, axis=1, keepdims=True) - 2.0)
    return x + across[:, None] * np.array([0.0, -1.0, 1.0])[:, None]


@pytest.mark.parametrize("seed", [7, 8, 9])
def test_a_jaw_signal_that_runs_the_other_way_is_told_from_exchanged_tips(seed):
    scene = Scene(np.random.default_rng(seed), frames=40, fps=15.0, speed_mm_s=6.0)
    scene.edit_report.append(_shutting)
    best = found(scene.take()).best
    assert best.name == "jaw_opening" and "other way" in best.text and best.value == pytest.approx(-1.0, abs=0.1)


def test_a_log_that_repeats_positions_shows_that_its_times_err():
    assert found(take("log holds positions", "80 ms", seed=31)).best.name == "time_stamps"


def test_an_opening_that_hardly_changes_is_not_accused_where_offsets_cancel_it():
    options = {"frames": 15, "fps": 2.5, "opening_mm": (0.22, 0.42), "noise_px": 1.5, "bias_mm": 0.05, "memory": 0.9}
    assert found(take(seed=17, **options)).best is None


def test_exchanged_tips_of_a_constant_opening_are_no_offsets():
    assert found(take("tips exchanged", "both images", opening_mm=(1.0, 1.0001))).best.name == "tip_order"


@pytest.mark.parametrize(("opening_mm", "least_px"), [((0.25, 0.3), 0.0), ((0.8, 1.2), 1.0)])
def test_nearly_shut_jaws_and_rounded_pixels_of_a_tool_at_rest_are_nothing_frozen(opening_mm, least_px):
    scene = Scene(np.random.default_rng(3), frames=60, fps=15.0, noise_px=0.5, robot_mm=0.0, opening_mm=opening_mm)
    path = scene.path()
    scene.path = lambda: lambda time: path(np.minimum(np.asarray(time), 2.5))  # it rests from then on
    if least_px:
        scene.edit_pixels.append(lambda scene, u: (u / least_px).round() * least_px)
    best = found(scene.take()).best
    assert best is None or not best.name.startswith("frozen")


@pytest.mark.parametrize("known", [slice(0, 0), slice(0, 1), slice(0, None)])
def test_a_log_without_a_landmark_is_no_crash(known):
    usual = take()
    x = usual.kinematics.x_mm.copy()
    x[:, 2] = np.nan
    x = np.where(np.isin(np.arange(len(x)), np.arange(len(x))[known])[:, None, None], x, np.nan)
    found(replace(usual, kinematics=Kinematics(usual.kinematics.time_s, x)))


@pytest.mark.parametrize("seed", [7, 8])
def test_of_two_faults_one_of_them_is_named(seed):
    best = found(take("rigid tips", "1.0 mm", seed, readout_s=0.02, stated_readout_s=0.0)).best
    assert best.name in ("rigid_tips", "readout")


def test_a_robot_that_stands_still_is_named():
    usual = take()
    still = np.tile(usual.data.grid("x_mm")[0], (40, 1))
    kinematics = Kinematics(usual.kinematics.time_s, np.tile(still[:3], (len(usual.kinematics.time_s), 1, 1)))
    best = found(replace(usual, data=replace(usual.data, x_mm=still), kinematics=kinematics)).best
    assert best.name == "frozen_kinematics" and "In 100 % of the frames" in best.text


def test_a_tool_at_rest_is_no_frozen_log():
    """A log is rounded, so that it repeats itself where the tool rests; the detections scatter by their noise alone."""
    usual, noise = take(frames=40), np.random.default_rng(0).normal(0, 1.0, (2, 120, 2))
    last = np.minimum(np.arange(120), 72 + np.arange(120) % 3)  # it rests from frame 24 on
    names = ("x_mm", "u_left", "u_right")
    x_mm, left, right = (getattr(usual.data, name)[last] for name in names)
    rested = np.arange(120)[:, None] >= 75
    data = replace(usual.data, x_mm=x_mm, u_left=left + rested * noise[0], u_right=right + rested * noise[1])
    assert found(replace(usual, data=data)).best is None


def test_three_frames_accuse_nobody():
    usual = take(frames=40)
    assert diagnose(usual.data.of_frames([0, 19, 39]), kinematics=usual.kinematics).hypotheses == ()


def test_cameras_that_do_not_fit_say_nothing_of_an_axis():
    """Their pixels are always skewed or oblong."""
    assert "scaled_axis" not in {h.name for h in found(take("random detections", "150.0 px")).hypotheses}


def test_exchanged_eyes_are_named_where_the_tool_tells_nothing():
    scene = take("eyes exchanged")
    base = scene.data.subset(scene.data.landmark == 0)
    names = {h.name for h in diagnose(base).hypotheses}
    assert "exchanged_eyes" in names and "mirrored_axis" not in names


def test_a_tool_across_the_view_points_neither_way():
    scene = take()
    x, view = scene.data.grid("x_mm"), np.array([0.0, 0.0, 1.0])
    flat = x - ((x - x[:, :1]) @ view)[..., None] * view - 0.01 * (np.arange(3) > 0)[:, None] * view
    rows = replace(scene.data, x_mm=flat[np.searchsorted(np.unique(scene.data.frame), scene.data.frame), scene.data.landmark])
    assert "mirrored_images" not in {h.name for h in diagnose(rows).hypotheses}


def test_a_clock_is_found_among_wrong_landmarks_and_without_the_log():
    best = found(take("clock", "183 ms", outliers=0.3)).best
    assert best.name == "clock" and best.value == pytest.approx(-183, abs=5)
    best = found(take("clock", "-20 ms"), log=False).best
    assert best.name == "clock" and best.value == pytest.approx(20, abs=5)


def trembling(**options):
    scene = Scene(np.random.default_rng(7), **{"frames": 58, "fps": 2.5, "speed_mm_s": 2.0} | options)
    steady, hertz = scene.path(), np.array([7.3, 9.1, 10.7])
    scene.path = lambda: lambda t: steady(t) + 0.15 * np.sin(2 * np.pi * hertz * t[..., None])[..., None, :]
    return found(scene.take()).best


@pytest.mark.parametrize(("offset_s", "named"), [(0.025, "clock"), (0.0, None)])
def test_a_clock_is_found_although_the_hand_trembles(offset_s, named):
    best = trembling(offset_s=offset_s)
    assert (best and best.name) == named
    assert best is None or best.value == pytest.approx(-25.0, abs=1.0)


def _hidden(scene, u):
    """Nine frames in which the tool is out of view, and the detector marks something at rest."""
    gone = u[27] + 300.0 + scene.rng.normal(0, 3, (9, *u.shape[1:]))
    return np.concatenate([u[:27], gone, u[36:]])


@pytest.mark.parametrize(("first", "last"), [(13, 19), (21, 40)])
def test_eyes_that_are_exchanged_for_some_frames_are_named(first, last):
    usual = take(frames=60)
    own = ((usual.data.frame >= first) & (usual.data.frame <= last))[:, None]
    left, right = usual.data.u_left, usual.data.u_right
    rows = replace(usual.data, u_left=np.where(own, right, left), u_right=np.where(own, left, right))
    best = found(replace(usual, data=rows)).best
    assert best.name == "exchanged_eyes" and best.text.startswith(f"In frames {first} to {last} (")
    assert best.value == pytest.approx((last - first + 1) / 0.6) and "between left/ and right/" in best.cure


def test_an_error_that_no_eye_wanders_is_not_blamed_on_the_eye():
    usual = take(frames=60)
    phase = 2 * np.pi * (usual.kinematics.time_s - usual.kinematics.time_s[0])[:, None] / [3.1, 2.3, 4.4]
    cures = [h.cure for h in found(with_log_off(usual, 4.0 * np.sin(phase))).hypotheses if h.name == "robot_wanders"]
    assert cures and all("rotations" in cure and "eye roll" not in cure for cure in cures)


def test_detections_of_a_tool_out_of_view_belong_to_no_other_instant():
    best = trembling(edit_pixels=[_hidden])
    assert best.name == "bad_stretch" and "Frames 27 to 35" in best.text


def test_rounded_times_are_found_although_the_hand_trembles():
    late_s = np.random.default_rng(0).uniform(-0.05, 0.05, 58)
    best = trembling(camera_late_s=(late_s, late_s))
    assert best.name == "time_stamps" and best.value == pytest.approx(1e3 * late_s.std(), rel=0.3)


def test_times_that_err_mostly_alike_are_told_with_their_mean():
    """Images that are stamped when they arrive, after 20 to 60 ms."""
    late_s = np.random.default_rng(0).uniform(0.02, 0.06, 40)
    best = found(take(camera_late_s=(late_s, late_s))).best
    assert best.name == "time_stamps" and best.value == pytest.approx(1e3 * late_s.std(), rel=0.3)
    mean_ms = float(re.search(r"the clocks differ by about (-\d+) ms", best.text).group(1))
    assert mean_ms == pytest.approx(-1e3 * late_s.mean(), rel=0.2)
    assert best.cure.startswith(f"Add {mean_ms / 1e3:.3f} to offset_s")


def test_a_log_whose_times_come_in_bursts_has_no_path_on_which_instants_could_be_tried():
    usual = take(fps=1.7)
    log, number = usual.kinematics, np.arange(len(usual.kinematics.time_s))
    buffered = Kinematics(log.time_s[number // 20 * 20] + 6e-5 * (number % 20), log.x_mm)
    x_mm = buffered.at(usual.data.time_s)[np.arange(len(usual.data)), usual.data.landmark]
    best = found(replace(usual, kinematics=buffered, data=replace(usual.data, x_mm=x_mm))).best
    assert best.name == "robot_noise"


@pytest.mark.parametrize("offset_s", [-2.1, 3.0])
def test_a_clock_that_is_off_by_seconds_is_found_where_log_and_video_still_overlap(offset_s):
    clock = found(take(offset_s=offset_s, frames=60)).best
    assert clock.name == "clock" and clock.value == pytest.approx(-1e3 * offset_s, abs=max(4 * clock.sd, 5))


@pytest.mark.parametrize("rate", [2.0, 0.5])
def test_a_log_of_another_rate_is_found_where_both_clocks_started_together(rate):
    usual = take(frames=60)
    log = usual.kinematics
    other = Kinematics(log.time_s[0] + rate * (log.time_s - log.time_s[0]), log.x_mm)
    rows = zip(usual.data.time_s, usual.data.landmark, strict=True)
    x_mm = np.stack([other.at(np.full((1, 3), time))[0, landmark] for time, landmark in rows])
    best = found(replace(usual, kinematics=other, data=replace(usual.data, x_mm=x_mm))).best
    assert best.name == "clock_rate" and best.value == pytest.approx(rate, abs=max(4 * best.sd, 0.002 * rate))
    shift_s = float(re.search(r"Add (-?[\d.]+) to offset_s", best.cure)[1])
    assert shift_s == pytest.approx((1 - rate) * log.time_s[0], abs=0.02)


def test_perspective_tells_a_mirrored_world_whichever_way_the_tool_points():
    mirrored = found(take("both images mirrored", "and the tips exchanged", inverse_distance_per_mm=1 / 150)).best
    assert mirrored.name == "mirrored_images" and "farther things look larger" in mirrored.text
    usual = take(inverse_distance_per_mm=1 / 150)  # where the world is not, a tool may point at the cameras
    x = usual.data.x_mm.reshape(-1, 3, 3)
    x = (2 * x.mean(axis=1, keepdims=True) - x).reshape(-1, 3)
    noise = np.random.default_rng(0).normal(0, 1, (2, len(x), 2))
    left, right = (pixels + own for pixels, own in zip(usual.rigs[0].project(x), noise, strict=True))
    data = replace(usual.data, x_mm=x, u_left=left, u_right=right)
    assert "mirrored_images" not in {h.name for h in diagnose(data, image_size_px=usual.image_size_px).hypotheses}


def test_pixels_that_no_axis_explains_accuse_none():
    """The images are sheared, and the jaws keep their lengths, whichever way they point."""
    usual, sheared = take(frames=60), np.array([[1.0, 0.0], [0.05, 1.0]])
    data = replace(usual.data, u_left=usual.data.u_left @ sheared, u_right=usual.data.u_right @ sheared)
    best = found(replace(usual, data=data)).best
    assert best.name == "odd_pixels" and best.explained < 0.5


def test_a_log_of_another_time_accuses_the_clock_and_no_detector():
    best = found(take(offset_s=100.0)).best
    assert best.name == "clock" and "100 % of the frames (100.0 to 102.6 s" in best.text


def test_too_little_to_say_anything():
    usual = take(frames=6)
    assert diagnose(usual.data.subset(slice(0, 4))).hypotheses == ()
    nothing = replace(usual.data, confidence=np.zeros_like(usual.data.confidence))
    assert diagnose(nothing).best.name == "detector_unfit"


def test_images_that_agree_accuse_no_detector():
    """Frames stamped up to 60 ms off: a third of the landmarks lie far from the robot's report, in both images alike."""
    usual = take(frames=60, fps=2.0)
    late_s = np.repeat(np.random.default_rng(0).choice([0.0, 0.0, 0.0, 0.0, -0.06, 0.06], 60), 3)
    x_mm = np.stack([usual.kinematics.at(t + np.zeros((1, 3)))[0, k] for t, k in zip(
        usual.data.time_s + usual.offset_s + late_s, usual.data.landmark, strict=True)])  # fmt: skip
    best = found(replace(usual, data=replace(usual.data, x_mm=x_mm))).best
    assert best.name == "robot_noise" and re.match(r"In \d+ % of the landmarks the images agree", best.text)
    assert "depend on its position" in best.cure and "inverse" in best.cure


@pytest.mark.parametrize(("landmark", "factor"), [(0, 1000.0), (2, 1000.0), (1, 0.1), (2, 0.001)])
def test_a_landmark_in_another_unit_than_the_others_is_named(landmark, factor):
    usual = take()
    own = (usual.data.landmark == landmark)[:, None]
    x_mm = np.where(own, (usual.data.x_mm + [30.0, -20.0, 50.0]) / factor, usual.data.x_mm + [30.0, -20.0, 50.0])
    (named,) = found(replace(usual, data=replace(usual.data, x_mm=x_mm))).hypotheses
    name = ("base", "tip_1", "tip_2")[landmark]
    assert named.name == "mixed_units" and named.value == factor and f"columns of {name} in kin" in named.cure


def test_a_base_that_hardly_moves_is_in_the_unit_of_the_tips():
    """As where the tool turns about the incision."""
    usual = take()
    x = usual.data.x_mm.reshape(-1, 3, 3)
    still = x - x[:, :1] + np.array([30.0, -20.0, 50.0]) + 0.01 * x[:, :1]
    named = found(replace(usual, data=replace(usual.data, x_mm=still.reshape(-1, 3)))).hypotheses
    assert "mixed_units" not in [h.name for h in named]


def test_copies_of_one_camera_are_named():
    usual = take()
    (named,) = found(replace(usual, data=replace(usual.data, u_right=usual.data.u_left))).hypotheses
    assert named.name == "same_images" and "the right camera's own images into RECORDING" in named.cure


def test_a_log_that_repeats_one_landmark_alone_accuses_this_landmark():
    scene = Scene(np.random.default_rng(7), frames=40, fps=15.0, speed_mm_s=6.0)

    def stuck(scene, t, x):
        held = x.copy()
        held[(t > 0.8) & (t < 1.6), 1] = x[np.searchsorted(t, 0.8), 1]
        return held

    scene.edit_report.append(stuck)
    best = found(scene.take()).best
    assert best.name == "frozen_kinematics" and best.value == pytest.approx(30, abs=6)
    assert "position of tip_1 alone stands still" in best.text and "leave them blank" in best.cure


def test_a_camera_that_lost_an_image_of_a_slow_video_did_not_move():
    """From frame 20 on, each right image is the next one."""
    usual = take(fps=2.5)
    right = usual.data.u_right.reshape(-1, 3, 2)
    right = right[np.minimum(np.arange(40) + (np.arange(40) >= 20), 39)].reshape(-1, 2)
    best = found(replace(usual, data=replace(usual.data, u_right=right))).best
    assert best.name == "frame_order" and best.images == (1,)
    assert "right images belong to other instants, mostly +400 ms from those stated, first in frame 20." in best.text


@pytest.mark.parametrize(("frames", "kept"), [(100, 60), (200, 60), (100, 95)])
def test_images_sorted_as_text_are_named_from_some_of_them(frames, kept):
    whole = take("images sorted as text", frames=frames)
    some = np.unique(np.linspace(0, frames - 1, kept).round().astype(int))
    best = found(replace(whole, data=whole.data.of_frames(some))).best
    assert best.name == "frame_order" and "as text: 0, 1, 10" in best.text


def test_far_landmarks_of_one_image_alone_have_no_other_witness():
    usual, some = take(), np.isin(take().data.frame, np.arange(0, 40, 2))
    left = usual.data.u_left + some[:, None] * np.random.default_rng(0).uniform(-400, 400, (len(some), 2))
    right = np.where(some[:, None], np.nan, usual.data.u_right)
    assert found(replace(usual, data=replace(usual.data, u_left=left, u_right=right))).best is not None


@pytest.mark.parametrize(("way", "strength", "told"), [
    ("images sorted as text", "", "sorted by their names as text: 0, 1"), ("log smoothed", "0.4 s", "smoothed over about"),
])  # fmt: skip
def test_the_habits_of_programs_that_write_files_are_named(way, strength, told):
    best = found(take(way, strength, frames=100)).best
    assert best.name in SPOILED[way, strength][0] and told in best.text


@pytest.mark.parametrize("constant_s", [0.1, 0.2])
def test_a_log_that_a_filter_delays_is_no_late_clock(constant_s):
    usual = take()
    time_s, x_mm = usual.kinematics.time_s, usual.kinematics.x_mm
    late = 1 - np.exp(-np.diff(time_s, prepend=time_s[0]) / constant_s)
    filtered = x_mm.copy()
    for k in range(1, len(x_mm)):
        filtered[k] = filtered[k - 1] + late[k] * (x_mm[k] - filtered[k - 1])
    kinematics, rows = Kinematics(time_s, filtered), usual.data
    x = kinematics.at(rows.time_s + usual.offset_s)[np.arange(len(rows)), rows.landmark]
    best = found(replace(usual, data=replace(rows, x_mm=x), kinematics=kinematics)).best
    assert best.name == "smoothed_log" and "lags behind" in best.text and "without a filter" in best.cure
    assert best.value == pytest.approx(1e3 * constant_s, rel=0.1)


def test_a_base_that_the_detector_hardly_knows_is_no_bent_tool():
    bent = take("tool bends", "3 %")
    names = [h.name for h in found(bent).hypotheses]
    base = (bent.data.landmark == 0)[:, None, None, None]
    covariance = bent.data.covariance_px2 * np.where(base, 60.0**2, 1.0)
    vague = found(replace(bent, data=replace(bent.data, covariance_px2=covariance)))
    assert "tool_bends" in names and "tool_bends" not in [h.name for h in vague.hypotheses]


def pivoting(offset_mm=(0.0, 0.0, 0.0), frames=300):
    """Detections of a tool that turns about a pivot, marked up to 0.7 px along the shaft; the robot's base has an offset."""
    rng = np.random.default_rng(0)
    place = rng.uniform(-1, 1, (frames, 3))
    middle = place * [5.0, 3.0, 1.5]
    along = middle - [-70.0, 0.0, -40.0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = Rotation.from_rotvec(rng.uniform(-1, 1, (frames, 1)) * along).apply(np.cross([0.0, 0.0, 1.0], along))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    half = rng.uniform(0.2, 0.7, (frames, 1)) * side
    x = np.stack([middle - 1.5 * along, middle + 1.5 * along - half, middle + 1.5 * along + half], axis=1)
    u = [side.reshape(x.shape[:2] + (2,)) for side in reference_rig().project(ROBOT_FROM_MICROSCOPE.apply(x.reshape(-1, 3)))]
    error_px = (place[:, 0] ** 2 + place[:, 1] ** 2 - 2 / 3)[:, None]
    marked = []
    for pixels in u:
        shown = pixels[:, 1:].mean(axis=1) - pixels[:, 0]
        error = error_px * shown / np.linalg.norm(shown, axis=1, keepdims=True)
        marked.append((pixels - error[:, None] + rng.normal(0, 0.7, pixels.shape)).reshape(-1, 2))
    x[:, 0] += np.stack([along, side, np.cross(along, side)], axis=2) @ offset_mm
    rows = {"frame": np.repeat(np.arange(frames), 3), "landmark": np.tile(np.arange(3), frames)}
    return Correspondences.of_points(ROBOT_FROM_MICROSCOPE.apply(x.reshape(-1, 3)), *marked, **rows)


def test_an_error_that_depends_on_the_pose_of_a_pivoting_tool_is_no_offset_of_all_landmarks():
    assert diagnose(pivoting()).best is None


@pytest.mark.parametrize("offset_mm", [(0.6, 0.0, 0.0), (-0.6, 0.0, 0.0)])
def test_an_offset_of_the_base_of_a_pivoting_tool_is_named_with_its_size(offset_mm):
    best = diagnose(pivoting(offset_mm)).best
    assert best.name == "landmark_offset" and best.text.split(": ")[1].startswith("base by")
    assert best.value == pytest.approx(600, abs=100)
    assert f"0.60 mm too {'short' if offset_mm[0] > 0 else 'long'}" in best.cure


@pytest.mark.parametrize(("opening_mm", "named"), [((0.5, 1.4), "same_tips"), ((0.02, 0.05), None)])
def test_tips_that_the_robot_reports_at_one_point_are_named_where_the_images_show_open_jaws(opening_mm, named):
    usual = take(opening_mm=opening_mm)
    x, log = usual.data.x_mm.reshape(-1, 3, 3).copy(), usual.kinematics.x_mm.copy()
    x[:, 1:], log[:, 1:] = x[:, 1:].mean(axis=1, keepdims=True), log[:, 1:].mean(axis=1, keepdims=True)
    log = Kinematics(usual.kinematics.time_s, log)
    best = found(replace(usual, data=replace(usual.data, x_mm=x.reshape(-1, 3)), kinematics=log)).best
    assert (best and best.name) == named
