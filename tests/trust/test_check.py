"""`python3 -m lib check`, with stand-ins for the detector on a small recording."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from lib import paths
from lib.landmarks import Landmarks
from lib.recordings import Recording
from lib.simulator import Design, Eye, Microscope, simulate
from lib.trust import check as module
from lib.trust.check import check, main
from lib.trust.verdict import LEVELS, Reason, Verdict


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Ten frames of 192 x 108 px whose truth cannot be read."""
    path = tmp_path_factory.mktemp("check") / "small"
    microscope = Microscope(pixels_per_mm=(10.0, 10.0), image_size_px=(192, 108))
    simulate(path, Design(Eye(texture_px=128), microscope=microscope, motion="sweep"), n_frames=10, progress=False)
    return path


@pytest.fixture(scope="module")
def detector(folder):
    """Knows each picture by heart; of any other it finds nothing."""
    recording, rng, known = Recording.open(folder), np.random.default_rng(0), {}
    for i, frame in enumerate(recording.frames):
        for image, u in ((frame.left, recording.truth.u_left[i]), (frame.right, recording.truth.u_right[i])):
            known[image.tobytes()] = u + rng.normal(0, 0.05, u.shape)
    for file in (folder / "truth").iterdir():
        file.write_bytes(b"")

    def detect(images):
        found = Landmarks.none(len(images))
        for i, image in enumerate(images):
            flipped, mirrored = known.get(image[:, ::-1].tobytes()), known.get(image.tobytes())
            u = mirrored if flipped is None else (np.array([191, 0]) + [-1, 1] * flipped)[[0, 2, 1]]
            if u is not None:
                found.u[i], found.covariance[i], found.confidence[i] = u, 0.0025 * np.eye(2), 1.0
        return found

    return detect


def test_a_check_is_a_page_and_a_json(folder, detector, tmp_path):
    found = check(folder, detector=detector)
    assert found.write(tmp_path) == tmp_path / "check.html"
    content = json.loads((tmp_path / "check.json").read_text(encoding="utf-8"))
    assert content["verdict"] == found.assessment.verdict.level and content["next_step"] == found.next_step
    assert {"folder", "coverage", "clock", "read-out", "tips", "detector"} <= set(content)
    assert len(content["frames"]["score"]) == 10
    page = (tmp_path / "check.html").read_text(encoding="utf-8")
    assert page.count("data:image/jpeg") == 6 and page.count("data:image/png") == 1
    assert not re.search(r"(src|href)=.http", page)
    assert found.recording.truth is None


def test_nothing_found_is_said_once_and_the_command_ends_well(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(module.Detector, "load", lambda *_: lambda images: Landmarks.none(len(images)))
    assert main([str(folder), "--out", str(tmp_path)]) == 0
    content = json.loads((tmp_path / "check.json").read_text(encoding="utf-8"))
    assert content["verdict"] == "not trustworthy" and "no_detection" in [reason["name"] for reason in content["reasons"]]
    said = capsys.readouterr().out
    assert "the detector failed on 10 frames" in said and f"lib adapt {folder}" in said and "RECORDING" not in said
    assert f"lib adapt {folder}" in content["next_step"] and "record 17 frames or more, then" in content["next_step"]


def test_where_nothing_is_calibrated_times_that_are_wrong_come_first(folder, detector):
    """All frames but one lie beyond the log's end."""
    recording = Recording.open(folder, truth=False)
    late = replace(recording, offset_s=recording.kinematics.time_s[-1] - recording.frames.time_s[0] - 0.01)
    found = check(late, detector=detector)
    assert found.assessment.calibration is None
    assert found.next_step.startswith("The robot reports a position in 1 of 10 frames") and "adapt" not in found.next_step
    vague = ("detector_unfit", "one_eye_unfit", "robot_noise", "robot_wanders")
    for name, first in ((name, name in vague) for name in (*vague, "mirrored_images")):
        best = SimpleNamespace(name=name, cure="Flip it.")
        red = Verdict((Reason("other", LEVELS[2], "", ""),))
        calibrated = replace(found.assessment, calibration=object(), diagnosis=SimpleNamespace(best=best), verdict=red)
        assert (module._next(late, calibrated, None) == late.mistimed) == first
        assert module._next(recording, calibrated, None) == "Flip it."
    off = SimpleNamespace(name="landmark_offset", cure="Robot or detector errs.")
    of_base = Reason("base", LEVELS[1], "", "Let the robot teach.")
    behind = Verdict((Reason("landmark_offset", LEVELS[2], "", off.cure), of_base))
    known = replace(found.assessment, calibration=object(), diagnosis=SimpleNamespace(best=off), verdict=behind)
    assert module._next(recording, known, None) == "Let the robot teach."


def test_the_next_step_names_the_weights_that_were_given(folder, detector, tmp_path, monkeypatch, capsys):
    good = replace(check(folder, detector=detector), next_step=f"Use it: `python3 -m lib run -p recording {folder}`.")
    monkeypatch.setattr(module.Detector, "load", lambda path: detector)
    monkeypatch.setattr(module, "check", lambda recording, detector: good)
    assert main([str(folder), "--out", str(tmp_path), "--weights", "my weights.safetensors"]) == 0
    step = f"`python3 -m lib run 07 -p weights 'my weights.safetensors' -p recording {folder}`"
    assert step in capsys.readouterr().out
    assert main([str(folder), "--out", str(tmp_path)]) == 0
    assert "run -p recording" in capsys.readouterr().out


def test_a_second_check_reads_what_the_first_has_detected(folder, detector, tmp_path, monkeypatch):
    monkeypatch.setenv(paths.SHARED_VARIABLE, str(tmp_path))

    class Counting:
        digest, calls = "one", 0

        def __call__(self, images):
            self.calls += 1
            return detector(images)

    counting = Counting()
    first = check(folder, detector=counting)
    calls = counting.calls
    again = check(folder, detector=counting)
    assert counting.calls == calls >= 10 and again.to_json() == first.to_json()


def test_a_part_is_checked_on_its_own(folder, detector, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(module.Detector, "load", lambda path: detector)
    monkeypatch.setattr(paths, "RUNS", tmp_path)
    looked = []
    known = module.assess

    def assess(recording, data, detector):
        looked.append([recording.frames[i].left.tobytes() for i in range(len(recording))])
        return known(recording, data, detector=detector)

    monkeypatch.setattr(module, "assess", assess)
    assert main([str(folder), "--frames", "2:8", "--weights", "some"]) == 0
    content = json.loads((tmp_path / "check-small-2-8" / "check.json").read_text(encoding="utf-8"))
    assert content["frames"]["frame"] == list(range(2, 8))
    pictures = [frame.left.tobytes() for frame in Recording.open(folder, truth=False).frames]
    assert looked == [[pictures[min(max(i, 2), 7)] for i in range(10)]]
    step = f"Next: Use it: `python3 -m lib calibrate --weights some {folder} --frames 2:8`."
    assert content["verdict"] != "trustworthy" or step in capsys.readouterr().out


def test_a_folder_that_is_no_recording(tmp_path):
    with pytest.raises(FileNotFoundError, match="recording.toml"):
        check(tmp_path)


def test_a_detector_that_cannot_act_is_refused(folder):
    """Of other landmarks than its own only labels tell."""
    other = replace(Recording.open(folder, truth=False), skeleton=("hinge", "left", "right"))
    with pytest.raises(ValueError, match=r"detector \(--weights\): no detector knows hinge, left, right; leave it out"):
        check(other, detector=lambda images: None)
