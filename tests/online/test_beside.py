"""Surfaces in a process beside: newest first, stale dropped and counted, a killed worker started again; and the feeds."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import signal
import sys
import time

import numpy as np
import pytest

from lib import paths
from lib.online.feeds import Arrival, Live, recorded
from lib.online.surface_worker import Beside, SurfaceJob
from lib.recordings import Recording

#: How the second of two workers is started: forked where that is safe, it does not import for seconds again.
AGAIN = "fork" if sys.platform == "linux" else "spawn"


@pytest.fixture(scope="module")
def pair():
    recording = Recording.open(paths.SHIPPED_RECORDING)
    return recording.frames[0], recording.truth


def job(pair, index: int) -> SurfaceJob:
    frame, truth = pair
    tool = truth.u_left[0], truth.u_right[0]
    options = {"setting": "fast", "u_landmarks": tool, "control": (8, 6), "smoothness": 1e3}
    return SurfaceJob(frame.left, frame.right, truth.rig, index, float(index), options)


def news(surfaces: Beside) -> tuple[list[int], str]:
    """The next surfaces' numbers, or what happened to the worker."""
    for _ in range(6000):
        done, event = surfaces.collect()
        if done or event:
            assert all(not surface.failures for surface in done)
            assert all(set(surface.seconds) == {"match", "triangulate", "surface"} for surface in done)
            return [surface.index for surface in done], event
        time.sleep(0.02)
    raise TimeoutError


def test_newest_first_and_a_killed_worker_is_started_again(pair, monkeypatch):
    surfaces = Beside()
    # The first worker was started as users' are.
    monkeypatch.setattr(multiprocessing, "get_context", lambda _, get=multiprocessing.get_context: get(AGAIN))
    try:
        for index in range(5):
            surfaces.submit(job(pair, index))
        assert surfaces.dropped == 3
        assert [news(surfaces), news(surfaces)] == [([0], ""), ([4], "")]
        surfaces.submit(job(pair, 5))
        (worker,) = (process for process in multiprocessing.active_children() if process.name == "surface worker")
        os.kill(worker.pid, signal.SIGKILL)
        assert "started again" in news(surfaces)[1]
        surfaces.submit(job(pair, 6))
        surfaces.submit(job(pair, 7))
        surfaces.forget()  # its rig is not to be believed: what is in work is not given back
        surfaces.submit(job(pair, 8))
        assert news(surfaces) == ([8], "")
    finally:
        surfaces.close()


def arrivals(n: int, fps: float):
    image = np.zeros((2, 2, 3), np.uint8)
    return (Arrival(image, image, None, i / fps) for i in range(n))


def test_live_frames_come_at_their_own_times_and_late_ones_are_lost():
    start = time.monotonic()
    got = [arrival.arrived_s - start for arrival in Live(arrivals(10, 50.0))]
    assert len(got) == 10
    assert np.diff(got).sum() >= 0.17
    feed = Live(arrivals(40, 100.0))
    slow = []
    for arrival in feed:
        slow.append(arrival.time_s)
        time.sleep(0.05)
    assert feed.lost == 40 - len(slow) > 10
    assert slow == sorted(slow)
    assert slow[-1] == 0.39  # the newest comes through


def test_an_error_of_the_source_reaches_whoever_takes_the_frames():
    def broken():
        yield from arrivals(1, 25.0)
        raise ValueError("left/000001.jpg: the image is corrupt.")

    with pytest.raises(ValueError, match="corrupt"):
        list(Live(broken()))


def test_a_feed_can_be_left(pair):
    assert len(list(itertools.islice(Live(arrivals(1000, 1000.0)), 3))) == 3
    first = next(recorded(Recording.open(paths.SHIPPED_RECORDING)))
    assert first.source == 0
    np.testing.assert_array_equal(first.left, pair[0].left)
