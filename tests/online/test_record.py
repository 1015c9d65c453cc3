"""What is recorded can be given again and gives the same, byte for byte; a full disk ends the record, not the run."""

from __future__ import annotations

import errno
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from lib import paths
from lib.online import FrameResult, OnlinePipeline, Settings, command, feeds
from lib.online.feeds import Recorder, recorded, row
from lib.online.video import Dashboard, video_file
from lib.recordings import Recording
from tests.online.world import World, make, run


@pytest.fixture(scope="module")
def shipped():
    return Recording.open(paths.SHIPPED_RECORDING)


class Looked:
    """The detector's answers, looked up in the truth by the image."""

    def __init__(self, truth) -> None:
        self.truth, self.rng = truth, np.random.default_rng(0)
        self.frame = -1

    def __call__(self, images):
        self.frame += 1
        u = np.stack([self.truth.u_left[self.frame], self.truth.u_right[self.frame]])
        u = u + 0.5 * self.rng.normal(size=u.shape)
        return SimpleNamespace(u=u, covariance=np.tile(0.25 * np.eye(2), (2, 3, 1, 1)), confidence=np.ones((2, 3)))


def write(recording, truth, folder, n=10):
    recorder = Recorder(folder, recording)
    pipeline = OnlinePipeline(Looked(truth), settings=Settings(surface_every=9, calibration_frames=(6, 60)))
    for arrival in recorded(recording, range(n)):
        result = pipeline.step(arrival.left, arrival.right, arrival.kinematics, time_s=arrival.time_s)
        recorder.add(arrival, result)
    recorder.close()
    return recorder


def test_a_replay_gives_the_same_bytes(tmp_path, shipped):
    write(shipped, shipped.truth, tmp_path / "first")
    again = Recording.open(tmp_path / "first" / "input")
    assert len(again) == 10
    write(again, shipped.truth, tmp_path / "second")
    first, second = ((tmp_path / name / "frames.csv").read_bytes() for name in ("first", "second"))
    assert first == second
    lines = first.decode().splitlines()
    columns = list(row(FrameResult(0)))
    assert lines[0].split(",") == columns and columns[:5] == ["frame", "time_s", "state", "cause", "base_distance_mm"]
    assert columns[-5:] == ["working_distance_mm", "drift", "moved", "surface_frame", "failures"]
    assert len(columns) == 4 + 18 + 12 + 4 + 5
    assert len(lines) == 11
    assert all(len(line.split(",")) == len(columns) for line in lines)
    assert lines[-1].split(",")[2] == "tracking"
    assert float(lines[-1].split(",")[columns.index("tip_1_distance_mm")]) > 0
    with pytest.raises(FileExistsError, match="not empty"):
        Recorder(tmp_path / "first", shipped)


def test_the_results_of_some_frames_have_their_numbers_in_the_recording(tmp_path, shipped):
    recorder = Recorder(tmp_path, shipped)
    for k, arrival in enumerate(recorded(shipped, range(4, 7))):
        recorder.add(arrival, FrameResult(k, reconstructed_at=1 if k == 2 else None))
    recorder.close()
    results, spent, times = (
        [line.split(",") for line in (tmp_path / name).read_text().splitlines()[1:]]
        for name in ("frames.csv", "seconds.csv", "input/frames.csv")
    )
    assert [cells[0] for cells in results] == [cells[0] for cells in spent] == ["4", "5", "6"]
    assert results[2][-2] == "5"  # the frame of the surface
    assert [cells[0] for cells in times] == ["0", "1", "2"]


def test_a_full_disk_ends_the_recording_and_not_the_run(tmp_path, shipped, monkeypatch):
    copies = []

    def full(source, target):
        copies.append(target)
        if len(copies) > 10:
            raise OSError(errno.ENOSPC, "No space left on device")
        return target

    monkeypatch.setattr(feeds.shutil, "copyfile", full)
    recorder = write(shipped, shipped.truth, tmp_path / "full")
    assert "ended after 4 frames" in recorder.failure
    assert "No space left" in recorder.failure
    assert len((tmp_path / "full" / "frames.csv").read_text().splitlines()) == 5


def test_the_video_shows_every_state(tmp_path):
    world = World()
    results = run(make(world), world, 12)
    page, image = Dashboard(), np.full((216, 384, 3), 90, np.uint8)
    with video_file(tmp_path / "run.mp4", 25.0) as show:
        for result in results:
            drawn = page.draw(image, image, result)
            assert drawn.shape == (720, 1280, 3)
            show(drawn)
    film = cv2.VideoCapture(str(tmp_path / "run.mp4"))
    assert int(film.get(cv2.CAP_PROP_FRAME_COUNT)) == 12
    with pytest.raises(ValueError, match="cannot be written"):
        with video_file(tmp_path / "no" / "run.mp4", 25.0):
            pass


def test_the_command(tmp_path, shipped, monkeypatch, capsys):
    monkeypatch.setattr(command.Detector, "load", lambda _: Looked(shipped.truth))
    assert command.main([str(shipped.folder), "--frames", "0:9", "--surface-every", "8", "--record", str(tmp_path / "run"),
                         "--video", str(tmp_path / "run.mp4")]) == 0  # fmt: skip
    out = capsys.readouterr().out
    assert "9 frames in" in out
    assert "tracking" in out
    assert (tmp_path / "run" / "frames.csv").is_file()
    assert (tmp_path / "run.mp4").stat().st_size > 1000
    with pytest.raises(ValueError, match="--frames 9: two numbers and a colon are needed"):
        command.main([str(shipped.folder), "--frames", "9"])
    with pytest.raises(SystemExit):
        command.main([str(shipped.folder), "--surface-every", "0"])
    assert "at least 1" in capsys.readouterr().err
